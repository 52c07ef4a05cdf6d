//! XYZ, CSV, TXT and PTS: one point a line.

use super::super::crs::Crs;
use super::super::error::{COPY_AGAIN, Error};
use super::super::file_scan::{AttributeInfo, FileInfo, FileScan, Settings};
use super::super::point_table::{ColorRange, Roles};
use super::super::source_bytes::SourceBytes;
use super::columns;
use super::encoding::Text;
use super::lines::parse_rows;
use crate::numeric::Vec3;
use crate::warning::Warning;

/// Bytes looked at to understand a text.
const HEAD: usize = 1 << 18;

/// Reads a text of points; `format` is its name for people.
pub(in super::super) fn read(
    source: &SourceBytes,
    settings: &Settings,
    origin: Option<Vec3>,
    format: &'static str,
) -> Result<FileScan, Error> {
    let text = Text::of(source)?;
    let source = text.source();
    let path = source.path();
    let head = source.up_to(text.start, HEAD)?;
    if head.iter().take(4096).any(|&b| b == 0) {
        return Err(Error::bad(path, "it contains zero bytes, so it is no text", "name the right file"));
    }
    let layout = columns::detect(&head, settings.text_columns.as_deref()).map_err(|cause| {
        Error::bad(path, cause, "name a scan, or set ingest.text_columns, e.g. [\"x\", \"y\", \"z\", \"intensity\"]")
    })?;
    let roles = Roles::of(path, &layout.names, settings, |_| ColorRange::Open)?.ok_or_else(|| Error::Settings {
        key: "ingest.text_columns",
        cause: format!("{:?} lacks one of x, y, z", layout.names),
        remedy: "name all three coordinates".into(),
    })?;
    let mut warnings = Vec::new();
    if let Some((count, first)) = &layout.skipped {
        let what = if *count == 1 { "line is" } else { "lines are" };
        warnings.push(Warning::new(
            "skipped-lines",
            format!("{count} {what} neither numbers nor a header and skipped, before the first point: '{first}'"),
        ));
    }
    let (mut table, end, line) = parse_rows(
        source,
        text.start + layout.header_bytes,
        layout.header_lines + 1,
        layout.promised,
        &layout.line,
        &roles,
    )?;
    if let Some(promised) = layout.promised {
        if (table.len() as u64) < promised {
            let cause = format!("its first line promises {promised} points, but {} follow", table.len());
            if !settings.allow_truncated {
                return Err(Error::bad(path, cause, COPY_AGAIN));
            }
            warnings.push(Warning::new("truncated", cause));
        }
        // Several scans may follow each other, each with its count.
        let mut at = end;
        let mut line = line;
        while let Some((count, bytes)) = next_count(source, at)? {
            let (more, end, next) = parse_rows(source, at + bytes, line + 1, Some(count), &layout.line, &roles)?;
            if (more.len() as u64) < count && !settings.allow_truncated {
                let cause = format!("line {line} promises {count} points, but {} follow", more.len());
                return Err(Error::bad(path, cause, COPY_AGAIN));
            }
            table.append(more);
            (at, line) = (end, next);
        }
        if at < source.len() && !source.up_to(at, HEAD)?.trim_ascii().is_empty() {
            warnings.push(Warning::new(
                "trailing-text",
                format!("text after line {line} is beyond the promised number of points and is not read"),
            ));
        }
    }
    let mut info = FileInfo::new(format);
    if layout.degrees {
        info.crs = Some(Crs { text: "longitude and latitude".into(), degrees: true, metres_per_unit: None });
    }
    info.header("encoding", text.encoding);
    info.header("columns", &layout.names);
    info.header("columns_from", layout.origin);
    info.header("separator", (layout.line.separator as char).to_string());
    info.header("decimal_comma", layout.decimal_comma);
    info.header("header_lines", layout.header_lines);
    for name in layout.names.iter().filter(|n| !n.is_empty() && *n != "intensity") {
        info.attributes.push(AttributeInfo::present(name));
    }
    if layout.origin == "values" && layout.names.iter().any(String::is_empty) {
        let unknown = layout.names.iter().filter(|n| n.is_empty()).count();
        warnings.push(Warning::new(
            "unknown-columns",
            format!(
                "{unknown} of {} columns have no name and are not used; set ingest.text_columns",
                layout.names.len()
            ),
        ));
    }
    Ok(table.finish(&roles, info, warnings, origin))
}

/// A line with a single count at byte `at`, and its length.
fn next_count(source: &SourceBytes, at: u64) -> Result<Option<(u64, u64)>, Error> {
    let head = source.up_to(at, 256)?;
    let skipped = head.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(head.len());
    let rest = &head[skipped..];
    let end = rest.iter().position(|&b| b == b'\n').unwrap_or(rest.len());
    let count = std::str::from_utf8(rest[..end].trim_ascii()).ok().and_then(|t| t.parse().ok());
    Ok(count.map(|c| (c, (skipped + end + 1) as u64)))
}
