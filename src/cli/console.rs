//! What the user sees: progress bars on a terminal, plain lines otherwise, JSON lines on request.

use super::Failure;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Options of the console, the same for every subcommand.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct Options {
    /// Say nothing but errors.
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// One JSON object a line on standard error instead of text.
    #[arg(long, global = true)]
    pub log_json: bool,
}

/// The one place that prints. Results go to standard output, progress and messages to standard error.
pub struct Console {
    options: Options,
    run_id: String,
    bar: Mutex<Option<ProgressBar>>,
}

impl Console {
    /// A console for this process.
    pub fn new(options: &Options) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let run_id = format!("{:x}-{:x}", now.as_millis(), std::process::id());
        Self { options: options.clone(), run_id, bar: Mutex::new(None) }
    }

    /// Identifies this process in log lines.
    pub fn run_id(&self) -> &str {
        &self.run_id
    }

    /// Whether nothing but errors is wanted.
    pub fn is_quiet(&self) -> bool {
        self.options.quiet
    }

    /// A result of the subcommand, to standard output. A closed pipe ends the process quietly: the reader has had enough.
    pub fn print(&self, text: &str) {
        let mut out = std::io::stdout().lock();
        if writeln!(out, "{text}").and_then(|()| out.flush()).is_err() {
            std::process::exit(0);
        }
    }

    /// A message for a person who watches; silent with `--quiet`.
    pub fn say(&self, text: &str) {
        if !self.options.quiet {
            self.log("info", text, &[]);
        }
    }

    /// A warning; shown unless `--quiet`.
    pub fn warn(&self, text: &str) {
        if !self.options.quiet {
            self.log("warning", text, &[]);
        }
    }

    /// An error; always shown.
    pub fn error(&self, text: &str) {
        self.log("error", text, &[]);
    }

    /// A failure with its causes; always shown.
    pub fn failure(&self, failure: &Failure) {
        self.finish_bar();
        let fields = [
            ("exit_code", serde_json::json!(failure.exit as u8)),
            ("peak_memory_bytes", serde_json::json!(crate::pipeline::peak_memory_bytes())),
        ];
        self.log("error", &failure.line(), &fields);
    }

    /// A line with fields: text for people, a JSON object with `--log-json`.
    pub fn log(&self, level: &str, text: &str, fields: &[(&str, serde_json::Value)]) {
        if self.options.log_json {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            let mut object = serde_json::Map::new();
            object.insert("time_unix_s".into(), serde_json::json!(now.as_millis() as f64 / 1000.0));
            object.insert("run_id".into(), serde_json::json!(self.run_id));
            object.insert("level".into(), serde_json::json!(level));
            object.insert("message".into(), serde_json::json!(text));
            fields.iter().for_each(|(name, value)| {
                object.insert((*name).to_owned(), value.clone());
            });
            to_stderr(&serde_json::Value::Object(object).to_string());
            return;
        }
        let line = match level {
            "info" => text.to_owned(),
            level => format!("{level}: {text}"),
        };
        match self.bar.lock().expect("no panic while holding the bar").as_ref() {
            Some(bar) => bar.suspend(|| to_stderr(&line)),
            None => to_stderr(&line),
        }
    }

    /// Shows that `text` is being worked on (a spinner on a terminal, nothing otherwise).
    pub fn start_bar(&self, step: u64, steps: u64, text: &str) {
        if self.options.quiet || self.options.log_json || !std::io::stderr().is_terminal() {
            return;
        }
        let mut slot = self.bar.lock().expect("no panic while holding the bar");
        let bar = slot.get_or_insert_with(|| {
            let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{spinner} [{bar:30}] {pos}/{len} {msg} {elapsed}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        bar.set_position(step);
        bar.set_message(text.to_owned());
    }

    /// Takes the progress bar away.
    pub fn finish_bar(&self) {
        if let Some(bar) = self.bar.lock().expect("no panic while holding the bar").take() {
            bar.finish_and_clear();
        }
    }
}

/// One line to standard error; if nobody listens there any more, that is no error.
pub(super) fn to_stderr(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}
