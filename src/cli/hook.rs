//! Hooks of `adit watch` and `adit batch`: a shell command that gets one JSON object on its standard input.

use super::Console;
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Time between two looks at a hook that is running.
const LOOK_AGAIN: Duration = Duration::from_millis(20);

/// Runs a hook; whatever goes wrong with it is a warning.
pub(super) fn run(command: Option<&str>, message: &serde_json::Value, limit: Duration, console: &Console) {
    let Some(command) = command else { return };
    match attempt(command, message, limit) {
        Ok(None) => {}
        Ok(Some(problem)) => console.warn(&format!("hook `{command}` {problem}")),
        Err(error) => console.warn(&format!("hook `{command}` cannot be run: {error}")),
    }
}

fn attempt(command: &str, message: &serde_json::Value, limit: Duration) -> std::io::Result<Option<String>> {
    let mut shell = Command::new("sh");
    shell.arg("-c").arg(command).stdin(Stdio::piped()).stdout(Stdio::null());
    // A group of its own, so that what the shell started can be ended with it.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut shell, 0);
    let mut child = shell.spawn()?;
    let begun = Instant::now();
    if let Some(mut input) = child.stdin.take() {
        let text = format!("{message}\n");
        // A hook need not read its input, and must not block whoever writes it.
        std::thread::spawn(move || {
            let _ = input.write_all(text.as_bytes());
        });
    }
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok((!status.success()).then(|| format!("ended with {status}")));
        }
        if begun.elapsed() > limit {
            #[cfg(unix)]
            end_group(child.id());
            child.kill()?;
            child.wait()?;
            return Ok(Some(format!("took longer than {} s and was ended", limit.as_secs())));
        }
        std::thread::sleep(LOOK_AGAIN);
    }
}

/// Ends the group of processes that a hook has started.
#[cfg(unix)]
fn end_group(leader: u32) {
    if let Some(group) = i32::try_from(leader).ok().and_then(rustix::process::Pid::from_raw) {
        // A group that is gone already needs no ending.
        let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
    }
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_hook_gets_its_message_and_its_failure_is_told() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("got");
        let told = attempt(&format!("cat > '{}'", file.display()), &json!({ "event": "end" }), Duration::from_secs(10));
        assert_eq!(told.unwrap(), None);
        assert_eq!(std::fs::read_to_string(file).unwrap(), "{\"event\":\"end\"}\n");
        let failed = attempt("exit 3", &json!({}), Duration::from_secs(10)).unwrap().unwrap();
        assert!(failed.contains('3'), "{failed}");
    }

    #[test]
    fn a_hook_that_hangs_is_ended_with_what_it_started() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("late");
        let begun = Instant::now();
        let command = format!("(sleep 2; touch '{}') & sleep 60", file.display());
        let told = attempt(&command, &json!("x".repeat(1 << 20)), Duration::from_millis(100)).unwrap().unwrap();
        assert!(told.contains("ended") && begun.elapsed() < Duration::from_secs(30), "{told}");
        std::thread::sleep(Duration::from_secs(3));
        assert!(!file.exists(), "what the hook started lives on");
    }
}
