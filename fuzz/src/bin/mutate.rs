//! A mutation fuzzer for the stable compiler, in one process: seeds, small damages, a look at what happens.
//!
//! ```text
//! cargo run --release --bin mutate -- SECONDS [TARGET...]
//! ```
//! Takes the targets in turns, a tenth of a minute each. A panic in Adit's own code, an input that takes longer than
//! [`SLOWEST`] or more memory than [`LARGEST`] is saved to `artifacts/TARGET`, and the exit code is 1. An abort ends the process:
//! the input is then still in `artifacts/TARGET/running`.

use adit_fuzz::{Target, read, seeds};
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

/// xorshift64*: the same inputs on every run with the same seed.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() >> 16) as usize % n.max(1)
    }
}

/// Numbers that readers trip over.
const AWKWARD: [u64; 12] =
    [0, 1, 2, 0x7f, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 32, 0x7fff_ffff_ffff_ffff, u64::MAX];
/// Words that text readers trip over.
const WORDS: [&[u8]; 14] = [
    b"nan",
    b"-inf",
    b"1e999",
    b"-1",
    b"999999999",
    b"4294967296",
    b"\n",
    b"\r\n",
    b" ",
    b",",
    b";",
    b"list uchar int",
    b"element",
    b"18446744073709551616",
];

fn mutate(random: &mut Random, seeds: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = seeds[random.below(seeds.len())].clone();
    for _ in 0..=random.below(6) {
        let at = match random.below(3) {
            // Headers are where the decisions are made.
            0 => random.below(bytes.len().min(400)),
            _ => random.below(bytes.len()),
        };
        match random.below(9) {
            _ if bytes.is_empty() => bytes.push(random.next() as u8),
            0 => bytes[at] ^= 1 << random.below(8),
            1 => bytes[at] = random.next() as u8,
            2 | 3 => {
                let width = [1, 2, 4, 8][random.below(4)];
                let value = AWKWARD[random.below(AWKWARD.len())].wrapping_add(random.below(3) as u64).wrapping_sub(1);
                let number = if random.below(8) == 0 {
                    f64::from_bits(random.next()).to_le_bytes()
                } else {
                    value.to_le_bytes()
                };
                for (slot, byte) in bytes[at..].iter_mut().zip(&number[..width]) {
                    *slot = *byte;
                }
            }
            4 => bytes.truncate(at),
            5 => {
                let end = (at + 1 + random.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = random.below(bytes.len());
                bytes.splice(to..to, piece);
            }
            6 => {
                let end = (at + 1 + random.below(16)).min(bytes.len());
                bytes.drain(at..end);
            }
            7 => {
                let word = WORDS[random.below(WORDS.len())];
                let end = (at + random.below(word.len() + 1)).min(bytes.len());
                bytes.splice(at..end, word.iter().copied());
            }
            _ => {
                let other = &seeds[random.below(seeds.len())];
                let from = random.below(other.len());
                let end = (from + 1 + random.below(128)).min(other.len());
                for (slot, byte) in bytes[at..].iter_mut().zip(&other[from..end]) {
                    *slot = *byte;
                }
            }
        }
    }
    bytes
}

/// User and system time of this process; wall time elsewhere than on Linux. A busy machine must not look like a hang.
fn cpu_time(start: Instant) -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    match (fields.get(11).and_then(|f| f.parse::<u64>().ok()), fields.get(12).and_then(|f| f.parse::<u64>().ok())) {
        (Some(user), Some(system)) => Duration::from_millis((user + system) * 10),
        _ => start.elapsed(),
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
    let mut random =
        Random(std::env::var("MUTATE_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(0x9e37_79b9_7f4a_7c15));
    let all: Vec<Vec<Vec<u8>>> = targets.iter().map(|&t| seeds::of(t)).collect();
    let mut runs = vec![0u64; targets.len()];
    let mut spent = vec![Duration::ZERO; targets.len()];
    let mut findings = 0;
    while start.elapsed().as_secs() < seconds {
        for (place, &target) in targets.iter().enumerate() {
            let folder = Path::new("artifacts").join(target.name());
            std::fs::create_dir_all(&folder).expect("a folder for findings");
            let turn = Instant::now();
            while turn.elapsed() < Duration::from_secs(6) && start.elapsed().as_secs() < seconds {
                let input = mutate(&mut random, &all[place]);
                std::fs::write(folder.join("running"), &input).expect("a place for the input");
                let before = IN_USE.load(Ordering::Relaxed);
                PEAK.store(before, Ordering::Relaxed);
                let cpu = cpu_time(start);
                read(target, &input);
                runs[place] += 1;
                let slow = cpu_time(start).saturating_sub(cpu);
                let memory = PEAK.load(Ordering::Relaxed).saturating_sub(before);
                let panicked = OWN_PANIC.swap(false, Ordering::SeqCst);
                if panicked || slow > SLOWEST || memory > LARGEST {
                    findings += 1;
                    let name = format!(
                        "{}_{}",
                        if panicked {
                            "panic"
                        } else if slow > SLOWEST {
                            "slow"
                        } else {
                            "memory"
                        },
                        findings
                    );
                    eprintln!("{}: {name} ({slow:?}, {} MiB)", target.name(), memory >> 20);
                    std::fs::write(folder.join(name), &input).expect("a place for the finding");
                }
            }
            let _ = std::fs::remove_file(folder.join("running"));
            spent[place] += turn.elapsed();
        }
        for (place, target) in targets.iter().enumerate() {
            println!("{} {} runs in {:.0} s", target.name(), runs[place], spent[place].as_secs_f64());
        }
        println!("{findings} findings");
    }
    std::process::exit(i32::from(findings > 0));
}
