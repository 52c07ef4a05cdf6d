//! The page and the metrics over all runs of a folder.

use super::limits::number;
use super::page::escape;
use super::plots::Plot;
use super::series::{Entry, Verdict};
use std::fmt::Write;
use std::path::Path;

const STYLE: &str = "\
:root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:72rem;padding:1rem}
table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.3rem .5rem;border-bottom:1px solid #8884;vertical-align:top}
.pill{border-radius:1rem;padding:.1rem .6rem;color:#fff;background:#b3261e;white-space:nowrap}.pass{background:#1b7f3b}.warn{background:#8a5a00}
.scroll{overflow-x:auto}svg{width:100%;height:auto;display:block}figure{margin:.75rem 0}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,21rem),1fr));gap:0 1.5rem}";

/// Runs that a trend shows at most, the newest.
const MOST_IN_TREND: usize = 200;

/// The page over all runs: trends of each tunnel, then the runs, newest first. `runs` is the folder that they are in.
pub(super) fn index(entries: &[Entry], runs: &Path) -> String {
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>Adit runs</title>\
         <style>{STYLE}</style></head><body><h1>Runs</h1>\n"
    );
    let count = |accepted: bool| entries.iter().filter(|e| e.verdict.is_accepted() == accepted).count();
    let _ = writeln!(html, "<p>{} accepted, {} not.</p>", count(true), count(false));
    html.push_str("<div class=\"scroll\"><table><tr><th></th><th>Scan</th><th>Points</th><th>Coverage, %</th><th>Seconds</th><th></th></tr>\n");
    for e in entries.iter().rev() {
        let optional = |v: Option<f64>| v.map_or("\u{2013}".to_owned(), number);
        let name = if runs.join(&e.run).join("report.html").exists() {
            format!("<a href=\"{0}/report.html\">{1}</a>", escape(&in_address(&e.run)), escape(&e.scan))
        } else {
            escape(&e.scan)
        };
        let _ = writeln!(
            html,
            "<tr><td><span class=\"pill {0}\">{0}</span></td><td>{name}</td><td>{1}</td><td>{2}</td><td>{3}</td><td>{4}</td></tr>",
            e.verdict.name(),
            optional(e.points),
            optional(e.coverage_percent),
            number(e.seconds.round()),
            escape(&e.message)
        );
    }
    html.push_str("</table></div>\n");
    let mut tunnels: Vec<&str> = entries.iter().map(|e| e.tunnel.as_str()).collect();
    tunnels.sort_unstable();
    tunnels.dedup();
    for tunnel in tunnels {
        let of_tunnel: Vec<&Entry> = entries.iter().filter(|e| e.tunnel == tunnel).collect();
        let newest = &of_tunnel[of_tunnel.len().saturating_sub(MOST_IN_TREND)..];
        let mut plots = String::new();
        for (title, value) in [
            ("Coverage, %", (|e: &Entry| e.coverage_percent) as fn(&Entry) -> Option<f64>),
            ("Mean stretch", |e| e.stretch_mean),
            ("Scatter about the surface, mm", |e| e.noise_m.map(|n| n * 1000.0)),
            ("Points, million", |e| e.points.map(|p| p / 1e6)),
            ("Duration, s", |e| Some(e.seconds)),
            ("Peak memory, MiB", |e| Some(e.peak_memory_bytes as f64 / 1_048_576.0)),
        ] {
            plots += &trend(title, newest, value);
        }
        if !plots.is_empty() {
            let _ = writeln!(html, "<h2>Trend: {}</h2>\n<div class=\"plots\">\n{plots}</div>", escape(tunnel));
        }
    }
    html.push_str("</body></html>\n");
    html
}

/// One number over the runs of a tunnel, with a mark for each run: green accepted, red not.
fn trend(title: &str, entries: &[&Entry], value: fn(&Entry) -> Option<f64>) -> String {
    let points: Vec<(f64, Option<f64>)> = entries.iter().enumerate().map(|(i, e)| (i as f64 + 1.0, value(e))).collect();
    let known: Vec<f64> = points.iter().filter_map(|p| p.1).collect();
    if known.len() < 2 {
        return String::new();
    }
    let (low, high) = known.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let margin = ((high - low) * 0.1).max(high.abs() * 0.01).max(1e-9);
    // At least six, so that the ticks are whole runs.
    let mut plot = Plot::new((0.0, (points.len() as f64 + 1.0).max(6.0)), (low - margin, high + margin), "run", title);
    let line: Vec<(f64, Option<f64>)> = points.iter().copied().filter(|p| p.1.is_some()).collect();
    plot.line(&line, "#1a5fb4");
    for (entry, (x, y)) in entries.iter().zip(&points) {
        if let Some(y) = y {
            plot.mark(*x, *y, if entry.verdict.is_accepted() { "#1b7f3b" } else { "#b3261e" });
        }
    }
    format!("<figure>{}<figcaption>{title}</figcaption></figure>\n", plot.svg())
}

/// A folder's name as part of an address.
fn in_address(name: &str) -> String {
    let plain = |b: u8| b.is_ascii_alphanumeric() || b"-_.~".contains(&b);
    name.bytes().map(|b| if plain(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}

/// The metrics of the last run and the counts over all, in the text format of Prometheus.
pub(super) fn metrics(entries: &[Entry]) -> String {
    let mut text = String::new();
    let mut metric = |name: &str, help: &str, values: &[(String, f64)]| {
        let _ = writeln!(text, "# HELP adit_{name} {help}\n# TYPE adit_{name} gauge");
        for (labels, value) in values {
            let _ = writeln!(text, "adit_{name}{labels} {value}");
        }
    };
    let one = |value: f64| vec![(String::new(), value)];
    let success = entries.iter().filter(|e| e.verdict.is_accepted()).map(|e| e.finished_unix_s).max();
    metric(
        "last_success_time_seconds",
        "End of the last accepted run, 0 without one.",
        &one(success.unwrap_or(0) as f64),
    );
    let by_verdict = |value: &dyn Fn(Verdict) -> f64| -> Vec<(String, f64)> {
        Verdict::ALL.iter().map(|v| (format!("{{verdict=\"{}\"}}", v.name()), value(*v))).collect()
    };
    let count = |v: Verdict| entries.iter().filter(|e| e.verdict == v).count() as f64;
    metric("runs", "Runs in the folder by verdict.", &by_verdict(&count));
    let Some(last) = entries.last() else { return text };
    metric("last_run_time_seconds", "End of the last run.", &one(last.finished_unix_s as f64));
    metric(
        "last_verdict",
        "1 for the verdict of the last run.",
        &by_verdict(&|v| f64::from(u8::from(v == last.verdict))),
    );
    metric(
        "last_accepted",
        "Whether the last run was accepted.",
        &one(f64::from(u8::from(last.verdict.is_accepted()))),
    );
    metric("last_duration_seconds", "Duration of the last run.", &one(last.seconds));
    metric("last_peak_memory_bytes", "Peak memory of the last run.", &one(last.peak_memory_bytes as f64));
    // A run without a map has no points and no coverage: it gets no value instead of a false 0.
    let known = |value: Option<f64>| value.map(|v| (String::new(), v)).into_iter().collect::<Vec<_>>();
    metric("last_points", "Points of the last run, if it made a map.", &known(last.points));
    metric("last_coverage_percent", "Observed share of the last map, if there is one.", &known(last.coverage_percent));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(run: &str, verdict: Verdict, finished: u64) -> Entry {
        Entry {
            scan: run.to_owned(),
            tunnel: "drift".to_owned(),
            files: vec![],
            stamp: String::new(),
            sha256: String::new(),
            run: run.to_owned(),
            verdict,
            message: "a & b".to_owned(),
            finished_unix_s: finished,
            seconds: 1.0,
            compared_with: None,
            points: verdict.is_accepted().then_some(1e6),
            coverage_percent: verdict.is_accepted().then_some(97.5),
            stretch_mean: None,
            noise_m: None,
            peak_memory_bytes: 1 << 20,
        }
    }

    #[test]
    fn metrics_count_by_verdict() {
        let text = metrics(&[entry("a", Verdict::Pass, 10), entry("b", Verdict::BadInput, 20)]);
        for line in [
            "adit_last_success_time_seconds 10",
            "adit_runs{verdict=\"bad-input\"} 1",
            "adit_last_verdict{verdict=\"bad-input\"} 1",
            "adit_last_verdict{verdict=\"pass\"} 0",
            "adit_last_accepted 0",
            "adit_last_peak_memory_bytes 1048576",
        ] {
            assert!(text.lines().any(|l| l == line), "no '{line}' in {text}");
        }
        assert!(!text.lines().any(|l| l.starts_with("adit_last_coverage_percent")), "{text}");
        let text = metrics(&[entry("a", Verdict::Pass, 10)]);
        assert!(text.contains("\nadit_last_coverage_percent 97.5\n") && text.contains("\nadit_last_points 1000000\n"));
        // Every metric is explained and typed.
        assert_eq!(text.matches("# HELP").count(), text.matches("# TYPE").count());
    }

    #[test]
    fn the_index_tells_all_runs_and_trends() {
        let place = tempfile::tempdir().unwrap();
        std::fs::create_dir(place.path().join("b c")).unwrap();
        std::fs::write(place.path().join("b c/report.html"), "").unwrap();
        let html = index(
            &[entry("a", Verdict::Pass, 1), entry("b c", Verdict::Warn, 2), entry("d", Verdict::Fail, 3)],
            place.path(),
        );
        assert!(
            html.contains("href=\"b%20c/report.html\"")
                && html.contains("a &amp; b")
                && html.contains("2 accepted, 1 not")
        );
        assert!(html.contains("Trend: drift") && html.matches("<svg").count() == 4);
        assert!(!html.contains("http") && !html.contains("<script"));
    }
}
