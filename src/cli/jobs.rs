//! Scans that are mapped at the same time, each in a process of its own and all within one budget.
//!
//! A process for each scan keeps the memory of a long night flat, tells the peak memory of each scan, and lets the night go on
//! when a scan brings its process down. A process ends when this one does: it watches its standard input.

use super::{Console, Exit};
use crate::pipeline::preflight::{self, Need};
use crate::pipeline::series::{Ended, Job, Verdict};
use crate::pipeline::{Kind, Pipeline, limits::Status};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};

/// What all scans may use together.
pub(super) struct Budget {
    /// Scans at the same time.
    pub(super) jobs: usize,
    /// Memory for all of them as the user set it, bytes; without it each run looks at what is free when it begins.
    pub(super) memory_bytes: Option<u64>,
    /// What may be kept for scans at the same time, bytes; `None` when the system does not tell.
    pub(super) shared_bytes: Option<u64>,
    /// Threads of each scan.
    pub(super) threads: usize,
    /// Folder for checkpoints and unfinished products.
    pub(super) tmp: Option<PathBuf>,
}

impl Budget {
    /// The budget of the options.
    pub(super) fn new(jobs: usize, memory: Option<u64>, tmp: Option<PathBuf>) -> Self {
        let threads = (rayon::current_num_threads() / jobs.max(1)).max(1);
        let shared_bytes = memory.or_else(preflight::available_memory_bytes);
        Self { jobs, memory_bytes: memory, shared_bytes, threads, tmp }
    }
}

/// Processes at work.
pub(super) struct Jobs<'a> {
    budget: Budget,
    /// The resolved pipeline.
    pipeline_file: PathBuf,
    runs: &'a Path,
    running: Vec<Running>,
}

struct Running {
    job: Job,
    child: Child,
    lines: Receiver<String>,
    /// Memory that is kept for it, bytes.
    memory_bytes: u64,
    /// The last error that it told, and its peak memory.
    error: Option<String>,
    peak_memory_bytes: u64,
}

impl<'a> Jobs<'a> {
    pub(super) fn new(budget: Budget, pipeline_file: PathBuf, runs: &'a Path) -> Self {
        Self { budget, pipeline_file, runs, running: Vec::new() }
    }

    /// Whether nothing is at work.
    pub(super) fn is_idle(&self) -> bool {
        self.running.is_empty()
    }

    /// Whether a scan of this name is at work: its folder may not be used twice.
    pub(super) fn has(&self, name: &str) -> bool {
        self.running.iter().any(|r| r.job.scan.name == name)
    }

    /// Whether a scan that needs this much can begin now. One that is too large for the whole budget begins alone, and its
    /// own estimate refuses it.
    pub(super) fn has_room(&self, need: &Need) -> bool {
        if self.running.is_empty() {
            return true;
        }
        let used: u64 = self.running.iter().map(|r| r.memory_bytes).sum();
        self.running.len() < self.budget.jobs
            && self.budget.shared_bytes.is_none_or(|all| used.saturating_add(need.memory_bytes) <= all)
    }

    /// The memory and disk that a scan will need; nothing when its header does not read (the run will say why).
    pub(super) fn need(files: &[PathBuf], pipeline: &Pipeline) -> Need {
        Need::of(files, pipeline).unwrap_or_default()
    }

    /// Starts the process of a scan.
    pub(super) fn start(&mut self, job: Job, need: &Need) -> std::io::Result<()> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("run").arg(&self.pipeline_file).arg("--out").arg(self.runs.join(&job.run));
        command.args(["--log-json", "--end-with-stdin", "--threads", &self.budget.threads.to_string()]);
        // Of a scan that vanished nothing was hashed; the run says so.
        if job.scan.files.iter().all(|f| f.exists()) {
            command.args(["--expect-sha256", &job.sha256]);
        }
        if let Some(bytes) = self.budget.memory_bytes {
            command.args(["--memory", &bytes.to_string()]);
        }
        if let Some(tmp) = &self.budget.tmp {
            command.arg("--tmp").arg(tmp);
        }
        if let Some(previous) = &job.compared_with {
            command.arg("--compare-with").arg(self.runs.join(previous));
        }
        for file in &job.scan.files {
            // Absolute, so that no name looks like an option.
            command.arg("--input").arg(std::path::absolute(file)?);
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
        let (send, lines) = channel();
        if let Some(stderr) = child.stderr.take() {
            std::thread::spawn(move || {
                let mut reader = BufReader::new(stderr);
                let mut line = Vec::new();
                while reader.read_until(b'\n', &mut line).is_ok_and(|n| n > 0) {
                    if send.send(String::from_utf8_lossy(&line).trim_end().to_owned()).is_err() {
                        return;
                    }
                    line.clear();
                }
            });
        }
        let memory_bytes = need.memory_bytes;
        self.running.push(Running { job, child, lines, memory_bytes, error: None, peak_memory_bytes: 0 });
        Ok(())
    }

    /// Passes on what the processes say, and takes those that have ended.
    pub(super) fn ended(&mut self, console: &Console) -> std::io::Result<Vec<(Job, Ended)>> {
        let mut ended = Vec::new();
        let mut i = 0;
        while i < self.running.len() {
            let running = &mut self.running[i];
            running.listen(console, false);
            match running.child.try_wait()? {
                None => i += 1,
                Some(status) => {
                    let mut running = self.running.remove(i);
                    // Its last words.
                    running.listen(console, true);
                    let how = running.how(status, &self.runs.join(&running.job.run));
                    ended.push((running.job, how));
                }
            }
        }
        Ok(ended)
    }
}

impl Running {
    fn listen(&mut self, console: &Console, to_the_end: bool) {
        loop {
            // When the process has ended, its output ends too, and with it the channel.
            let line = if to_the_end { self.lines.recv().ok() } else { self.lines.try_recv().ok() };
            let Some(line) = line else { return };
            self.hear(&line, console);
        }
    }

    fn hear(&mut self, line: &str, console: &Console) {
        let Ok(Value::Object(mut told)) = serde_json::from_str::<Value>(line) else {
            // Not a log line: the last words of a process that breaks down.
            if !line.is_empty() {
                self.error = Some(line.to_owned());
            }
            return;
        };
        let text = |key: &str| told.get(key).and_then(Value::as_str).unwrap_or("").to_owned();
        let (level, message) = (text("level"), text("message"));
        if let Some(peak) = told.get("peak_memory_bytes").and_then(Value::as_u64) {
            self.peak_memory_bytes = peak;
        }
        if level == "error" {
            // Told with the verdict.
            self.error = Some(message);
            return;
        }
        for own in ["time_unix_s", "level", "message", "run_id"] {
            told.remove(own);
        }
        let mut fields: Vec<(&str, Value)> = vec![("scan", Value::from(self.job.scan.name.clone()))];
        fields.extend(told.iter().map(|(k, v)| (k.as_str(), v.clone())));
        if !console.is_quiet() {
            console.log(&level, &format!("{}: {message}", self.job.scan.name), &fields);
        }
    }

    fn how(&self, status: ExitStatus, folder: &Path) -> Ended {
        let failed = |verdict| Ended {
            verdict,
            error: Some(self.error.clone().unwrap_or_else(|| format!("its process ended with {status}"))),
            peak_memory_bytes: self.peak_memory_bytes,
        };
        let finished = |default: Status| {
            let report = std::fs::read(folder.join("report.json")).ok();
            let report = report.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
            let status = report.and_then(|r| serde_json::from_value(r.get("status")?.clone()).ok()).unwrap_or(default);
            Ended { verdict: Verdict::of_status(status), error: None, peak_memory_bytes: self.peak_memory_bytes }
        };
        match status.code() {
            Some(0) => finished(Status::Pass),
            Some(5) => finished(Status::Fail),
            Some(2) => failed(Verdict::of_kind(Kind::Usage)),
            Some(3) => failed(Verdict::of_kind(Kind::BadInput)),
            Some(4) => failed(Verdict::of_kind(Kind::Unsupported)),
            Some(6) => failed(Verdict::of_kind(Kind::Resources)),
            Some(_) => failed(Verdict::of_kind(Kind::Internal)),
            // Ended by a signal: the system does that when memory runs out, and a failed allocation aborts.
            None => {
                let told = self.error.clone().unwrap_or_default();
                let error =
                    format!("its process was ended ({status}), probably because memory ran out; see --memory {told}");
                Ended { error: Some(error.trim_end().to_owned()), ..failed(Verdict::Resources) }
            }
        }
    }
}

/// The exit code of a verdict.
pub(super) fn exit_of(verdict: Verdict) -> Exit {
    match verdict {
        Verdict::Pass | Verdict::Warn => Exit::Done,
        Verdict::Fail => Exit::LimitBroken,
        Verdict::BadInput => Exit::BadInput,
        Verdict::Unsupported => Exit::Unsupported,
        Verdict::Resources => Exit::Resources,
        Verdict::Usage => Exit::Usage,
        Verdict::Internal => Exit::Internal,
    }
}

/// Of two ends the one that needs a person more.
pub(super) fn worse(a: Exit, b: Exit) -> Exit {
    let urgency = |e: Exit| match e {
        Exit::Done => 0,
        Exit::LimitBroken => 1,
        Exit::Unsupported => 2,
        Exit::BadInput => 3,
        Exit::Usage => 4,
        Exit::Cancelled => 5,
        Exit::Resources => 6,
        Exit::Internal => 7,
    };
    if urgency(b) > urgency(a) { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_urgent_end_wins() {
        assert_eq!(worse(worse(Exit::Done, Exit::BadInput), Exit::LimitBroken), Exit::BadInput);
    }
}
