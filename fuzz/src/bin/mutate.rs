//! A mutation fuzzer for the stable compiler, in one process: seeds, small damages, a look at what happens.
//!
//! ```text
//! cargo run --release --bin mutate -- SECONDS [TARGET...]
//! ```
//! Takes the targets in turns, a tenth of a minute each, and tells how many inputs each reader accepted, read in part and
//! refused, and how much CPU time that took. A panic in Adit's own code, an input that takes longer than
//! [`SLOWEST`] or more memory than [`LARGEST`] is saved to `artifacts/TARGET`, and the exit code is 1. An abort ends the
//! process: the input is then still in `artifacts/TARGET/running_*`.

use adit_fuzz::mutation::{Random, mutate};
use adit_fuzz::{Outcome, Target, read, seeds};
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// No input of a few kilobytes may take longer, in CPU time of the process.
const SLOWEST: Duration = Duration::from_secs(5);
/// No input of a few kilobytes may take more memory.
const LARGEST: usize = 500 << 20;

static IN_USE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);
static OWN_PANIC: AtomicBool = AtomicBool::new(false);

/// Counts what is allocated.
struct Counting;

// SAFETY: everything is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = IN_USE.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(now, Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// User and system time of this process; wall time elsewhere than on Linux. A busy machine must not look like a hang.
fn cpu_time(start: Instant) -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    match (fields.get(11).and_then(|f| f.parse::<u64>().ok()), fields.get(12).and_then(|f| f.parse::<u64>().ok())) {
        (Some(user), Some(system)) => Duration::from_millis((user + system) * 10),
        _ => start.elapsed(),
    }
}

/// What happened to the inputs of one target.
#[derive(Clone, Copy, Default)]
struct Tally {
    accepted: u64,
    partial: u64,
    refused: u64,
    cpu: Duration,
}

impl Tally {
    fn count(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Accepted => self.accepted += 1,
            Outcome::Partial => self.partial += 1,
            Outcome::Refused => self.refused += 1,
        }
    }

    fn told(&self, target: Target) -> String {
        let runs = self.accepted + self.partial + self.refused;
        let percent = |n: u64| 100.0 * n as f64 / runs.max(1) as f64;
        format!(
            "{:<5} {runs:>10} runs in {:>7.1} min CPU: {:>5.1} % accepted, {:>5.1} % in part, {:>5.1} % refused",
            target.name(),
            self.cpu.as_secs_f64() / 60.0,
            percent(self.accepted),
            percent(self.partial),
            percent(self.refused)
        )
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let seconds: u64 = arguments.next().and_then(|s| s.parse().ok()).expect("usage: mutate SECONDS [TARGET...]");
    let mut targets: Vec<Target> = arguments.map(|n| Target::named(&n).expect("a known target")).collect();
    if targets.is_empty() {
        targets = Target::ALL.to_vec();
    }
    // Readers silence panics of other crates; what still arrives here is ours.
    std::panic::set_hook(Box::new(|info| {
        eprintln!("{info}");
        OWN_PANIC.store(true, Ordering::SeqCst);
    }));
    let start = Instant::now();
    let seed = std::env::var("MUTATE_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(0x9e37_79b9_7f4a_7c15);
    let mut random = Random::new(seed);
    let all: Vec<Vec<Vec<u8>>> = targets.iter().map(|&t| seeds::of(t)).collect();
    let mut tallies = vec![Tally::default(); targets.len()];
    let mut findings = 0;
    while start.elapsed().as_secs() < seconds {
        for (place, &target) in targets.iter().enumerate() {
            let folder = Path::new("artifacts").join(target.name());
            std::fs::create_dir_all(&folder).expect("a folder for findings");
            // Several processes may run at a time.
            let running = folder.join(format!("running_{}", std::process::id()));
            let (turn, cpu) = (Instant::now(), cpu_time(start));
            while turn.elapsed() < Duration::from_secs(6) && start.elapsed().as_secs() < seconds {
                let input = mutate(target, &all[place], &mut random);
                std::fs::write(&running, &input).expect("a place for the input");
                let before = IN_USE.load(Ordering::Relaxed);
                PEAK.store(before, Ordering::Relaxed);
                let cpu = cpu_time(start);
                tallies[place].count(read(target, &input));
                let slow = cpu_time(start).saturating_sub(cpu);
                let memory = PEAK.load(Ordering::Relaxed).saturating_sub(before);
                let panicked = OWN_PANIC.swap(false, Ordering::SeqCst);
                if panicked || slow > SLOWEST || memory > LARGEST {
                    findings += 1;
                    let kind = match (panicked, slow > SLOWEST) {
                        (true, _) => "panic",
                        (_, true) => "slow",
                        _ => "memory",
                    };
                    let name = format!("{kind}_{}_{findings}", std::process::id());
                    eprintln!("{}: {name} ({slow:?}, {} MiB)", target.name(), memory >> 20);
                    std::fs::write(folder.join(name), &input).expect("a place for the finding");
                }
            }
            let _ = std::fs::remove_file(&running);
            tallies[place].cpu += cpu_time(start).saturating_sub(cpu);
        }
    }
    for (tally, target) in tallies.iter().zip(&targets) {
        println!("{}", tally.told(*target));
    }
    println!("{findings} findings, seed {seed}");
    std::process::exit(i32::from(findings > 0));
}
