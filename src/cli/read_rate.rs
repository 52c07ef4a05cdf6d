//! How fast a file becomes columns, for `adit info --rate`: the reading of `adit run`, guards included.

use crate::io;
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// What reading a file once took.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct ReadRate {
    /// Points that became columns.
    pub(super) points: usize,
    /// Wall time, seconds.
    pub(super) wall_s: f64,
    /// User and system time of all threads, seconds; absent where the system does not tell.
    pub(super) cpu_s: Option<f64>,
    /// Largest memory of the process so far, MiB; absent where the system does not tell.
    pub(super) peak_mib: Option<f64>,
}

/// Reads the file with all its columns and takes the time.
pub(super) fn measure(file: &Path, settings: &io::Settings) -> Result<ReadRate, io::Error> {
    let (start, cpu_before) = (Instant::now(), cpu_seconds());
    let (cloud, _) = io::read_cloud(&[file.to_owned()], settings)?;
    Ok(ReadRate {
        points: cloud.len(),
        wall_s: start.elapsed().as_secs_f64(),
        cpu_s: cpu_before.zip(cpu_seconds()).map(|(before, after)| after - before),
        peak_mib: peak_mib(),
    })
}

impl ReadRate {
    /// For a person.
    pub(super) fn describe(&self) -> String {
        let cpu = self.cpu_s.map_or_else(String::new, |s| format!(", {s:.2} CPU seconds"));
        let peak = self.peak_mib.map_or_else(String::new, |m| format!(", at most {m:.0} MiB"));
        let rate = self.points as f64 / self.wall_s.max(1e-9) / 1e6;
        format!("{:.3} s ({rate:.1} million points a second{cpu}{peak})", self.wall_s)
    }
}

/// User and system seconds of this process so far.
fn cpu_seconds() -> Option<f64> {
    /// Linux counts in hundredths of a second.
    const TICKS: f64 = 100.0;
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The twelfth and thirteenth field after the name, which may contain anything.
    let fields: Vec<&str> = stat.rsplit(')').next()?.split_whitespace().collect();
    let ticks = |i: usize| fields.get(i)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / TICKS)
}

/// Largest memory of this process so far.
fn peak_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some(line.split_whitespace().next()?.parse::<f64>().ok()? / 1024.0)
}
