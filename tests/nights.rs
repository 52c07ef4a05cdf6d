//! Nights without a person, with the real program: what arrives half-copied, is killed, runs out of disk or memory.
//!
//! `ADIT_KILLS=50 cargo test --release --test nights killed` kills as often as the long check does (`scripts/kill_test.sh`).

use assert_cmd::cargo::cargo_bin;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Nothing here takes longer, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(600);
/// Maps of short tunnels with few points: quick, though not good enough for the default limits.
const QUICK: [&str; 6] =
    ["--set", "map.cell_m=0.05", "--set", "limits.coverage_percent=10", "--set", "limits.filled_percent={}"];

fn adit() -> Command {
    let mut command = Command::new(cargo_bin("adit"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout)
}

/// A short synthetic tunnel.
fn synth(file: &Path, seed: u32) {
    let seed = seed.to_string();
    let output = adit()
        .args([
            "synth",
            "--out",
            path(file),
            "--length",
            "7",
            "--points",
            "15000",
            "--furniture",
            "none",
            "--seed",
            &seed,
        ])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", told(&output));
}

/// One scan for the tests that need any.
fn a_scan() -> &'static Path {
    static SCAN: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    &SCAN
        .get_or_init(|| {
            let place = tempfile::tempdir().unwrap();
            let file = place.path().join("drift.laz");
            synth(&file, 1);
            (place, file)
        })
        .1
}

fn run_command(scan: &Path, out: &Path) -> Command {
    let mut command = adit();
    command.args(["run", "--input", path(scan), "--out", path(out), "--quiet"]).args(QUICK);
    command
}

/// The products of an undisturbed run of [`a_scan`], and how long it took.
fn undisturbed() -> &'static (BTreeMap<String, Vec<u8>>, Duration) {
    static PRODUCTS: OnceLock<(BTreeMap<String, Vec<u8>>, Duration)> = OnceLock::new();
    PRODUCTS.get_or_init(|| {
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("run");
        let begun = Instant::now();
        let output = run_command(a_scan(), &out).output().unwrap();
        let took = begun.elapsed();
        assert!(matches!(output.status.code(), Some(0 | 5)), "{}", told(&output));
        (products(&out), took)
    })
}

/// All files under their final names but the report, which tells times.
fn products(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![out.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let file = entry.path();
            let name = file.strip_prefix(out).unwrap().to_string_lossy().into_owned();
            if name.starts_with('.') || name == "report.json" {
                continue;
            }
            if file.is_dir() {
                folders.push(file);
            } else {
                found.insert(name, fs::read(&file).unwrap());
            }
        }
    }
    found
}

/// What of `found` is not what an undisturbed run makes.
fn wrong(found: &BTreeMap<String, Vec<u8>>) -> Vec<&String> {
    found.iter().filter(|(name, bytes)| undisturbed().0.get(*name) != Some(bytes)).map(|(name, _)| name).collect()
}

fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !done() {
        assert!(begun.elapsed() < PATIENCE, "waited for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Ends a process that has no end of its own.
struct Ending(Child);

impl Drop for Ending {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ledger(runs: &Path) -> Vec<Value> {
    let text = fs::read(runs.join("runs.json")).unwrap_or_default();
    serde_json::from_slice(&text).unwrap_or_default()
}

fn verdicts(runs: &Path) -> BTreeMap<String, String> {
    let pair = |e: &Value| (e["scan"].as_str().unwrap().to_owned(), e["verdict"].as_str().unwrap().to_owned());
    ledger(runs).iter().map(pair).collect()
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// A different moment each time, the same on every run of the test.
fn moments(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(|i| (i as f64 * 0.618_033_988_75 + 0.137).fract())
}

#[test]
fn killed_at_any_moment_a_run_goes_on_to_the_same_bytes() {
    let kills: usize = std::env::var("ADIT_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(4);
    let took = undisturbed().1;
    let mut interrupted = 0;
    for moment in moments(kills) {
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("run");
        let mut child = run_command(a_scan(), &out).spawn().unwrap();
        std::thread::sleep(took.mul_f64(moment));
        child.kill().unwrap();
        interrupted += usize::from(!child.wait().unwrap().success());
        let torn = products(&out);
        assert_eq!(wrong(&torn), Vec::<&String>::new(), "killed at {moment:.2}: torn under a final name");
        let output = run_command(a_scan(), &out).output().unwrap();
        assert!(matches!(output.status.code(), Some(0 | 5)), "killed at {moment:.2}: {}", told(&output));
        let resumed = products(&out);
        assert_eq!(wrong(&resumed), Vec::<&String>::new(), "killed at {moment:.2}");
        assert_eq!(resumed.len(), undisturbed().0.len(), "killed at {moment:.2}");
        let leftovers: Vec<_> = fs::read_dir(out.join(".adit")).unwrap().flatten().map(|e| e.file_name()).collect();
        assert!(leftovers.iter().all(|n| !n.to_string_lossy().starts_with("tmp-")), "{leftovers:?}");
    }
    assert!(interrupted * 2 > kills, "only {interrupted} of {kills} kills came before the end");
}

/// Fault injection without any rights: no file may grow beyond so many blocks of 512 bytes (POSIX), as if the disk were full.
#[cfg(unix)]
#[test]
fn a_file_that_cannot_be_written_ends_with_6_and_the_run_goes_on_later() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("run");
    let largest = undisturbed().0.values().map(Vec::len).max().unwrap();
    let script = format!("trap '' XFSZ; ulimit -f {}; exec \"$@\"", largest / 2 / 1024);
    let plain = run_command(a_scan(), &out);
    let output = Command::new("sh")
        .args(["-c", &script, "sh"])
        .arg(plain.get_program())
        .args(plain.get_args())
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(6), "{}", told(&output));
    assert!(told(&output).contains("cannot write"), "{}", told(&output));
    assert_eq!(wrong(&products(&out)), Vec::<&String>::new());
    let output = run_command(a_scan(), &out).output().unwrap();
    assert!(matches!(output.status.code(), Some(0 | 5)), "{}", told(&output));
    assert_eq!(products(&out), undisturbed().0);
}

/// A disk of its own, where this user may mount one.
#[cfg(target_os = "linux")]
struct SmallDisk(tempfile::TempDir);

#[cfg(target_os = "linux")]
impl SmallDisk {
    fn of(mebibytes: u32) -> Option<Self> {
        let place = tempfile::tempdir().unwrap();
        let options = format!("size={mebibytes}m");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", &options, "tmpfs", path(place.path())]).output();
        mount.is_ok_and(|o| o.status.success()).then_some(Self(place))
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").args(["-l", path(self.0.path())]).status();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_ends_with_6_and_the_run_goes_on_when_there_is_space() {
    // Too small from the start: nothing is begun.
    let Some(tiny) = SmallDisk::of(4) else { return };
    let out = tiny.0.path().join("run");
    let output = run_command(a_scan(), &out).output().unwrap();
    assert_eq!(output.status.code(), Some(6), "{}", told(&output));
    assert!(told(&output).contains("on disk") && told(&output).contains("clean-runs"), "{}", told(&output));
    assert!(products(&out).is_empty());
    // Full in the middle: somebody else fills it while the run is at work.
    let Some(disk) = SmallDisk::of(64) else { return };
    let out = disk.0.path().join("run");
    let mut child = run_command(a_scan(), &out).spawn().unwrap();
    wait_for("the axis", || out.join(".adit/axis.json").exists() || child.try_wait().unwrap().is_some());
    // It holds its breath meanwhile, so that it cannot be done before the disk is full.
    let signal = |name: &str| {
        let sent = Command::new("kill").args([name, &child.id().to_string()]).status();
        assert!(sent.unwrap().success());
    };
    signal("-STOP");
    let ballast = disk.0.path().join("ballast");
    let mut file = fs::File::create(&ballast).unwrap();
    let block = vec![1u8; 1 << 16];
    while std::io::Write::write_all(&mut file, &block).is_ok() {}
    drop(file);
    signal("-CONT");
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(6), "{}", told(&output));
    assert_eq!(wrong(&products(&out)), Vec::<&String>::new());
    fs::remove_file(ballast).unwrap();
    let output = run_command(a_scan(), &out).output().unwrap();
    assert!(matches!(output.status.code(), Some(0 | 5)), "{}", told(&output));
    assert_eq!(products(&out), undisturbed().0);
}

#[cfg(target_os = "linux")]
#[test]
fn a_read_only_target_ends_with_6() {
    let Some(disk) = SmallDisk::of(4) else { return };
    let read_only = Command::new("mount").args(["-o", "remount,ro", path(disk.0.path())]).status();
    assert!(read_only.unwrap().success());
    let output = run_command(a_scan(), &disk.0.path().join("run")).output().unwrap();
    assert_eq!(output.status.code(), Some(6), "{}", told(&output));
    assert!(told(&output).contains("--out"), "{}", told(&output));
}

#[test]
fn a_changed_map_key_redoes_only_the_map_and_what_follows() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("run");
    assert!(matches!(run_command(a_scan(), &out).status().unwrap().code(), Some(0 | 5)));
    let explain = |more: &[&str]| -> Vec<Value> {
        let output = adit().args(["explain", path(&out), "--json"]).args(more).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap()
    };
    assert!(explain(&[]).iter().all(|e| e["fresh"] == true));
    let stale: Vec<Value> =
        explain(&["--set", "map.cell_m=0.04"]).into_iter().filter(|e| e["fresh"] == false).collect();
    let names: Vec<&str> = stale.iter().map(|e| e["stage"].as_str().unwrap()).collect();
    assert_eq!(names, ["map", "profile"]);
    assert_eq!(stale[0]["reasons"][0], "map.cell_m: 0.05 -> 0.04");
    assert_eq!(stale[1]["reasons"][0], "map changed");
    let times = |name: &str| fs::metadata(out.join(name)).unwrap().modified().unwrap();
    let before = ["mesh.ply", "chart.ply", "points.laz", "map/color.png", "report.json"].map(times);
    // The same again does nothing, and says so.
    let again = adit().args(["run", "--input", path(a_scan()), "--out", path(&out)]).args(QUICK).output().unwrap();
    assert!(told(&again).contains("nothing to do"), "{}", told(&again));
    assert_eq!(["mesh.ply", "chart.ply", "points.laz", "map/color.png", "report.json"].map(times), before);
    let mut other = run_command(a_scan(), &out);
    assert!(matches!(other.args(["--set", "map.cell_m=0.04"]).status().unwrap().code(), Some(0 | 5)));
    assert_eq!(["mesh.ply", "chart.ply", "points.laz"].map(times), before[..3]);
    assert!(times("map/color.png") > before[3] && times("report.json") > before[4]);
    // The journal tells what was begun, and that it was finished.
    let journal = fs::read_to_string(out.join(".adit/journal.jsonl")).unwrap();
    let finished = journal.lines().filter(|l| l.contains("run-finished")).count();
    assert_eq!(finished, 2, "{journal}");
}

#[test]
fn a_second_process_is_told_who_holds_the_folder() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("run");
    let mut first = run_command(a_scan(), &out).spawn().unwrap();
    wait_for("the lock", || fs::read_to_string(out.join(".adit/lock")).is_ok_and(|t| t.contains("process")));
    let second = run_command(a_scan(), &out).output().unwrap();
    if first.try_wait().unwrap().is_none() {
        assert_eq!(second.status.code(), Some(6), "{}", told(&second));
        assert!(told(&second).contains(&format!("process {}", first.id())), "{}", told(&second));
    }
    assert!(matches!(first.wait().unwrap().code(), Some(0 | 5)));
}

#[test]
fn only_whole_scans_are_taken_and_each_once() {
    let place = tempfile::tempdir().unwrap();
    let (incoming, runs, elsewhere) = (place.path().join("in"), place.path().join("runs"), place.path().join("x"));
    fs::create_dir(&incoming).unwrap();
    fs::create_dir(&elsewhere).unwrap();
    let whole: Vec<Vec<u8>> = (1..=5)
        .map(|seed| {
            let file = elsewhere.join(format!("{seed}.laz"));
            synth(&file, seed);
            fs::read(file).unwrap()
        })
        .collect();
    let begun = place.path().join("begun");
    let mut watch = adit();
    watch.args(["watch", path(&incoming), "--out", path(&runs), "--settle-s", "1", "--poll-s", "1", "--hook-start"]);
    watch.arg(format!("cat >> '{}'", begun.display())).args(QUICK).stderr(Stdio::null()).stdout(Stdio::null());
    let _watch = Ending(watch.spawn().unwrap());
    // Half-copied, with a pause far longer than the time to settle.
    fs::write(incoming.join("copied.laz"), &whole[0][..whole[0].len() / 2]).unwrap();
    // Renamed into place.
    fs::write(incoming.join(".renamed.laz.part"), &whole[1]).unwrap();
    fs::rename(incoming.join(".renamed.laz.part"), incoming.join("renamed.laz")).unwrap();
    // A folder of stations that is filled slowly, and says itself when it is complete.
    fs::create_dir(incoming.join("stations")).unwrap();
    fs::write(incoming.join("stations/1.laz"), &whole[4]).unwrap();
    let sums = format!("{}  1.laz\n{}  2.laz\n", sha256(&whole[4]), sha256(&whole[4]));
    fs::write(incoming.join("stations/SHA256SUMS"), sums).unwrap();
    // Replaced while it is running.
    fs::write(incoming.join("replaced.laz"), &whole[2]).unwrap();
    let has_begun = |name: &str| {
        let text = fs::read_to_string(&begun).unwrap_or_default();
        text.lines().filter(|l| l.contains(&format!("\"scan\":\"{name}\""))).count()
    };
    wait_for("the run that is disturbed", || has_begun("replaced") > 0);
    fs::write(elsewhere.join("new.laz"), &whole[3]).unwrap();
    fs::rename(elsewhere.join("new.laz"), incoming.join("replaced.laz")).unwrap();
    wait_for("the renamed scan", || verdicts(&runs).contains_key("renamed"));
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!((has_begun("copied"), has_begun("stations")), (0, 0), "an incomplete scan was taken");
    fs::write(incoming.join("copied.laz"), &whole[0]).unwrap();
    fs::write(incoming.join("stations/2.laz"), &whole[4]).unwrap();
    let hash_of = |entry: &Value| entry["sha256"].as_str().unwrap().to_owned();
    let has = |bytes: &[u8]| ledger(&runs).iter().any(|e| hash_of(e) == sha256(bytes));
    wait_for("all scans", || {
        has(&whole[0]) && has(&whole[1]) && has(&whole[3]) && verdicts(&runs).contains_key("stations")
    });
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!([has_begun("copied"), has_begun("renamed"), has_begun("stations")], [1, 1, 1]);
    assert!(has_begun("replaced") == 2, "{}", has_begun("replaced"));
    // Every map is of a whole scan.
    let pair = sha256(sha256(&whole[4]).repeat(2).as_bytes());
    for entry in ledger(&runs) {
        let known = whole.iter().any(|w| sha256(w) == hash_of(&entry)) || hash_of(&entry) == pair;
        assert!(known, "{entry}");
        let made = runs.join(entry["run"].as_str().unwrap()).join("report.json").exists();
        assert!(made || entry["scan"] == "replaced", "{entry}");
    }
    let newest = ledger(&runs).into_iter().rfind(|e| e["scan"] == "replaced").unwrap();
    assert_eq!((hash_of(&newest), newest["verdict"] == "bad-input"), (sha256(&whole[3]), false), "{newest}");
}

#[test]
fn two_watches_never_process_a_scan_twice() {
    let place = tempfile::tempdir().unwrap();
    let (incoming, runs, begun) = (place.path().join("in"), place.path().join("runs"), place.path().join("begun"));
    fs::create_dir(&incoming).unwrap();
    for name in ["a", "b"] {
        fs::copy(a_scan(), incoming.join(format!("{name}.laz"))).unwrap();
        // A clock that jumped back: the file is of the future.
        let file = fs::File::options().append(true).open(incoming.join(format!("{name}.laz"))).unwrap();
        file.set_modified(std::time::SystemTime::now() + Duration::from_secs(7200)).unwrap();
    }
    let hook = format!("cat >> '{}'", begun.display());
    let spawn = || {
        let mut watch = adit();
        watch.args(["watch", path(&incoming), "--out", path(&runs), "--once", "--settle-s", "1", "--poll-s", "1"]);
        watch.args(["--hook-start", &hook]).args(QUICK).spawn().unwrap()
    };
    let both = [spawn(), spawn()].map(|child| child.wait_with_output().unwrap());
    let said: Vec<String> = both.iter().map(told).collect();
    assert!(both.iter().all(|o| matches!(o.status.code(), Some(0 | 5))), "{said:?}");
    assert!(said.iter().any(|t| t.contains("in use by process")), "{said:?}");
    assert_eq!(fs::read_to_string(begun).unwrap().lines().count(), 2);
    assert_eq!(ledger(&runs).len(), 2);
    // And one that does not wait says who holds the folder.
    let holder = Ending(
        adit().args(["watch", path(&incoming), "--out", path(&runs), "--poll-s", "60"]).args(QUICK).spawn().unwrap(),
    );
    let id = format!("process {}", holder.0.id());
    wait_for("the lock", || fs::read_to_string(runs.join(".lock")).is_ok_and(|t| t.contains(&id)));
    let refused = adit().args(["batch", path(a_scan()), "--out", path(&runs), "--wait-s", "0"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(6));
    assert!(told(&refused).contains(&id), "{}", told(&refused));
}

#[test]
fn ten_scans_in_a_row_give_seven_maps_and_three_clear_verdicts() {
    let place = tempfile::tempdir().unwrap();
    let scans: Vec<PathBuf> = (0..10).map(|i| place.path().join(format!("scan{i}.ply"))).collect();
    for (i, scan) in scans.iter().enumerate() {
        let header = |points: u64| {
            let properties = "property float x\nproperty float y\nproperty float z\n";
            format!("ply\nformat binary_little_endian 1.0\nelement vertex {points}\n{properties}end_header\n")
        };
        match i {
            2 => {
                synth(scan, 1);
                let bytes = fs::read(scan).unwrap();
                fs::write(scan, &bytes[..bytes.len() * 2 / 3]).unwrap();
            }
            // A floor without a tunnel.
            5 => {
                let mut bytes = header(4000).into_bytes();
                for k in 0..4000u16 {
                    let (x, y) = (f32::from(k % 63) * 0.1, f32::from(k / 63) * 0.1);
                    bytes.extend([x, y, 0.0].iter().flat_map(|v| v.to_le_bytes()));
                }
                fs::write(scan, bytes).unwrap();
            }
            // Five million points that take no room on disk.
            7 => {
                let head = header(5_000_000);
                fs::write(scan, &head).unwrap();
                let file = fs::File::options().append(true).open(scan).unwrap();
                file.set_len(head.len() as u64 + 60_000_000).unwrap();
            }
            // The same scan under seven names: what it needs is the same each time.
            _ => synth(scan, 1),
        }
    }
    let (runs, metrics, hooks) = (place.path().join("runs"), place.path().join("adit.prom"), place.path().join("ends"));
    let mut batch = adit();
    batch.arg("batch").args(&scans).args(["--out", path(&runs), "--metrics", path(&metrics), "--memory", "1G"]);
    batch.args(["--jobs", "2", "--log-json", "--hook-end", &format!("cat >> '{}'", hooks.display())]).args(QUICK);
    let output = batch.output().unwrap();
    assert_eq!(output.status.code(), Some(6), "{}", told(&output));
    let found = verdicts(&runs);
    let count = |verdict: &str| found.values().filter(|v| *v == verdict).count();
    assert_eq!((found.len(), count("pass") + count("warn")), (10, 7), "{found:?}");
    assert_eq!([&found["scan2"], &found["scan5"], &found["scan7"]], ["bad-input", "bad-input", "resources"]);
    for (scan, words) in [("scan2", "bytes"), ("scan5", "tunnel"), ("scan7", "--memory")] {
        let entry = ledger(&runs).into_iter().find(|e| e["scan"] == scan).unwrap();
        assert!(entry["message"].as_str().unwrap().contains(words), "{entry}");
    }
    let text = fs::read_to_string(metrics).unwrap();
    let accepted: f64 = ["pass", "warn"].iter().map(|v| metric(&text, &format!("adit_runs{{verdict=\"{v}\"}}"))).sum();
    assert_eq!(accepted, 7.0, "{text}");
    assert_eq!(metric(&text, "adit_runs{verdict=\"resources\"}"), 1.0, "{text}");
    assert!(
        metric(&text, "adit_last_success_time_seconds") > 1.7e9 && metric(&text, "adit_last_duration_seconds") > 0.0
    );
    assert_eq!(fs::read_to_string(hooks).unwrap().lines().filter(|l| l.contains("\"event\":\"end\"")).count(), 10);
    // Each log line is JSON with the id of this night.
    let log = String::from_utf8(output.stderr).unwrap();
    let ids: Vec<Value> = log.lines().map(|l| serde_json::from_str::<Value>(l).unwrap()["run_id"].clone()).collect();
    assert!(!ids.is_empty() && ids.iter().all(|id| id.is_string() && *id == ids[0]), "{log}");
    // Memory is flat: the last scan needs what the first one needed.
    let peaks: Vec<f64> = ledger(&runs)
        .iter()
        .filter(|e| matches!(e["verdict"].as_str(), Some("pass" | "warn")))
        .map(|e| e["peak_memory_bytes"].as_f64().unwrap())
        .collect();
    let (least, most) = peaks.iter().fold((f64::MAX, 0f64), |(l, m), p| (l.min(*p), m.max(*p)));
    assert!(least > 0.0 && most < 1.3 * least, "{peaks:?}");
    // The last accepted run is the latest, and the page knows all of them.
    let latest = fs::read_to_string(runs.join("latest.txt")).unwrap();
    assert!(runs.join(latest.trim()).join("report.html").exists());
    let index = fs::read_to_string(runs.join("index.html")).unwrap();
    assert!(index.contains("7 accepted, 3 not") && !index.contains("http"));
}

fn metric(text: &str, name: &str) -> f64 {
    let line =
        text.lines().find(|l| l.split(' ').next() == Some(name)).unwrap_or_else(|| panic!("no {name} in {text}"));
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

#[test]
fn vanished_and_changed_inputs_are_bad_input() {
    let place = tempfile::tempdir().unwrap();
    let runs = place.path().join("runs");
    let gone = place.path().join("gone.laz");
    let output = adit().args(["batch", path(&gone), "--out", path(&runs)]).output().unwrap();
    assert_eq!(output.status.code(), Some(3), "{}", told(&output));
    assert_eq!(verdicts(&runs)["gone"], "bad-input");
    assert!(ledger(&runs)[0]["message"].as_str().unwrap().contains("gone.laz"));
}

#[test]
fn a_run_is_compared_with_an_earlier_one_and_its_report_keeps_to_the_schema() {
    let place = tempfile::tempdir().unwrap();
    let (first, second) = (place.path().join("first"), place.path().join("second"));
    assert!(run_command(a_scan(), &first).status().unwrap().code() != Some(6));
    let mut later = run_command(a_scan(), &second);
    later.args(["--compare-with", path(&first), "--set", "limits.drift.length_change_m=0.5"]);
    assert!(matches!(later.status().unwrap().code(), Some(0 | 5)));
    let read =
        |folder: &Path| -> Value { serde_json::from_slice(&fs::read(folder.join("report.json")).unwrap()).unwrap() };
    let check = |report: &Value, name: &str| {
        report["limits"]
            .as_array()
            .unwrap()
            .iter()
            .find(|c| c["name"] == name)
            .unwrap_or_else(|| panic!("{name}"))
            .clone()
    };
    let (alone, compared) = (read(&first), read(&second));
    let skipped = check(&alone, "drift.coverage_loss_percent");
    assert!(
        skipped["status"] == "skipped" && skipped["message"].as_str().unwrap().contains("no accepted run"),
        "{skipped}"
    );
    let length = check(&compared, "drift.length_change_m");
    assert_eq!((&length["status"], &length["value"]), (&Value::from("pass"), &Value::from(0.0)), "{length}");
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/report.schema.json");
    let schema: Value = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
    let errors = |report: &Value| {
        let mut errors = Vec::new();
        disagreements(&schema, &schema, report, "", &mut errors);
        errors
    };
    // A mesh makes a report of another shape.
    let mesh = place.path().join("mesh");
    let output = run_command(&first.join("mesh.ply"), &mesh).output().unwrap();
    assert!(matches!(output.status.code(), Some(0 | 5)), "{}", told(&output));
    for report in [&alone, &compared, &read(&mesh)] {
        assert_eq!(errors(report), Vec::<String>::new());
    }
    // The schema is no formality.
    let mut broken = alone.clone();
    broken["limits"][0]["status"] = Value::from("fine");
    assert!(errors(&broken).iter().any(|e| e.starts_with("/limits/0/status")), "{:?}", errors(&broken));
    broken = alone.clone();
    broken["map"]["seconds"] = Value::from("long");
    assert!(errors(&broken).iter().any(|e| e.starts_with("/map")), "{:?}", errors(&broken));
    broken = alone;
    broken.as_object_mut().unwrap().remove("input");
    assert!(errors(&broken).iter().any(|e| e.contains("'input'")), "{:?}", errors(&broken));
}

/// What a value has against a JSON Schema, as far as the schema of the report goes; a keyword that is not known here fails,
/// so that nothing is left unchecked.
fn disagreements(root: &Value, schema: &Value, value: &Value, at: &str, errors: &mut Vec<String>) {
    let Some(rules) = schema.as_object() else {
        if schema == false {
            errors.push(format!("{at}: nothing may be here"));
        }
        return;
    };
    let inner = |schema: &Value, value: &Value, at: &str| {
        let mut found = Vec::new();
        disagreements(root, schema, value, at, &mut found);
        found
    };
    let is = |kind: &str| match kind {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64() || value.is_i64() || value.as_f64().is_some_and(|v| v.fract() == 0.0),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("type {other}"),
    };
    for (rule, wanted) in rules {
        let list = || wanted.as_array().unwrap_or_else(|| panic!("{rule} at {at}"));
        match rule.as_str() {
            "$schema" | "$defs" | "title" | "description" | "default" | "format" => {}
            "$ref" => {
                let place = wanted.as_str().and_then(|r| r.strip_prefix('#')).unwrap();
                errors.extend(inner(root.pointer(place).unwrap_or_else(|| panic!("{wanted}")), value, at));
            }
            "type" => {
                let kinds: Vec<&str> = match wanted {
                    Value::String(one) => vec![one],
                    _ => list().iter().map(|k| k.as_str().unwrap()).collect(),
                };
                if !kinds.iter().any(|k| is(k)) {
                    errors.push(format!("{at}: {value} is no {kinds:?}"));
                }
            }
            "enum" if !list().contains(value) => errors.push(format!("{at}: {value} is none of {wanted}")),
            "const" if value != wanted => errors.push(format!("{at}: {value} is not {wanted}")),
            "enum" | "const" => {}
            "minimum" => {
                if value.as_f64().is_some_and(|v| v < wanted.as_f64().unwrap()) {
                    errors.push(format!("{at}: {value} is below {wanted}"));
                }
            }
            "maximum" => {
                if value.as_f64().is_some_and(|v| v > wanted.as_f64().unwrap()) {
                    errors.push(format!("{at}: {value} is above {wanted}"));
                }
            }
            "minItems" | "maxItems" => {
                let (n, m) = (value.as_array().map_or(0, Vec::len) as u64, wanted.as_u64().unwrap());
                if value.is_array() && (if rule == "minItems" { n < m } else { n > m }) {
                    errors.push(format!("{at}: {n} items"));
                }
            }
            "minProperties" | "maxProperties" => {
                let (n, m) = (value.as_object().map_or(0, serde_json::Map::len) as u64, wanted.as_u64().unwrap());
                if value.is_object() && (if rule == "minProperties" { n < m } else { n > m }) {
                    errors.push(format!("{at}: {n} properties"));
                }
            }
            "allOf" => list().iter().for_each(|s| errors.extend(inner(s, value, at))),
            "anyOf" | "oneOf" => {
                let tried: Vec<Vec<String>> = list().iter().map(|s| inner(s, value, at)).collect();
                let fitting = tried.iter().filter(|t| t.is_empty()).count();
                if fitting == 0 || (rule == "oneOf" && fitting > 1) {
                    errors.push(format!("{at}: {fitting} of {} alternatives fit: {tried:?}", tried.len()));
                }
            }
            "required" => {
                for key in list().iter().filter(|k| value.is_object() && value.get(k.as_str().unwrap()).is_none()) {
                    errors.push(format!("{at}: {key} is missing").replace('"', "'"));
                }
            }
            "properties" => {
                for (key, schema) in wanted.as_object().unwrap() {
                    value.get(key).into_iter().for_each(|v| errors.extend(inner(schema, v, &format!("{at}/{key}"))));
                }
            }
            "additionalProperties" => {
                let known = rules.get("properties").and_then(Value::as_object);
                for (key, v) in value.as_object().into_iter().flatten() {
                    if !known.is_some_and(|k| k.contains_key(key)) {
                        errors.extend(inner(wanted, v, &format!("{at}/{key}")));
                    }
                }
            }
            "items" => {
                for (i, v) in value.as_array().into_iter().flatten().enumerate() {
                    errors.extend(inner(wanted, v, &format!("{at}/{i}")));
                }
            }
            other => panic!("the keyword {other} at {at} is not checked"),
        }
    }
}
