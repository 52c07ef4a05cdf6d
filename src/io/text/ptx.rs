//! PTX: grids of one or several scans, each with the pose of its scanner.
//!
//! A header of ten lines (columns, rows, scanner position, three axes, 4x4 matrix whose *rows* are images of the axes
//! and of the origin) is followed by one line `x y z [intensity] [r g b]` for each direction; `0 0 0` means no echo.

use super::super::error::{COPY_AGAIN, Error};
use super::super::file_scan::{FileInfo, FileScan, Settings};
use super::super::label_column::LabelSource;
use super::super::point_table::{ColorRange, PointTable, Roles, mixed_scans};
use super::super::source_bytes::SourceBytes;
use super::encoding::Text;
use super::lines::{Line, parse_rows, shorten};
use crate::cloud::Station;
use crate::numeric::{Mat3, Vec3};
use crate::warning::Warning;

struct Head {
    columns: u64,
    rows: u64,
    rotation: Mat3,
    translation: Vec3,
    bytes: u64,
    /// Lines of the header, blank ones before it included.
    lines: u64,
    fields: Fields,
}

/// What follows the coordinates in each line.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Fields {
    intensity: bool,
    color: bool,
    /// Further numbers, which mean nothing here.
    others: usize,
}

impl Fields {
    /// From the first lines of a scan, as numbers; the reason when they are ambiguous.
    fn of(lines: &[Vec<f64>]) -> Result<Self, String> {
        let is_channel = |v: &f64| v.fract() == 0.0 && (0.0..=255.0).contains(v);
        let (intensity, color, others) = match lines.first().map_or(4, Vec::len) {
            3 => (false, false, 0),
            columns @ (4 | 5) => (true, false, columns - 4),
            6 if lines.iter().all(|l| l.len() == 6 && l[3..].iter().all(is_channel)) => (false, true, 0),
            columns @ 7.. => (true, true, columns - 7),
            columns => {
                return Err(format!(
                    "its lines have {columns} numbers, of which the last {} are neither an intensity nor colours from 0 to \
                     255",
                    columns.saturating_sub(3)
                ));
            }
        };
        Ok(Self { intensity, color, others })
    }

    fn roles(self) -> Roles {
        let first_channel = if self.intensity { 4 } else { 3 };
        Roles {
            position: [0, 1, 2],
            color: self.color.then_some(([0, 1, 2].map(|c| first_channel + c), ColorRange::EightBit)),
            intensity: self.intensity.then_some(3),
            classification: None,
            source_id: None,
            label: LabelSource::None,
        }
    }

    /// What a file has that holds scans of both.
    fn together_with(self, other: Self) -> Self {
        Self {
            intensity: self.intensity || other.intensity,
            color: self.color || other.color,
            others: self.others.max(other.others),
        }
    }

    fn columns(self) -> usize {
        3 + usize::from(self.intensity) + 3 * usize::from(self.color)
    }
}

/// Reads all scans of a PTX file into the common coordinates of their matrices.
pub(in super::super) fn read(
    source: &SourceBytes,
    settings: &Settings,
    origin: Option<Vec3>,
) -> Result<FileScan, Error> {
    let text = Text::of(source)?;
    let source = text.source();
    let path = source.path();
    let mut warnings = Vec::new();
    let mut stations: Vec<Station> = Vec::new();
    let mut station_ids: Vec<u16> = Vec::new();
    let mut all: Option<(PointTable, Fields)> = None;
    let (mut at, mut line_number, mut silent) = (text.start, 1u64, 0u64);
    let (mut grids, mut of_scans) = (Vec::new(), Vec::new());
    while let Some(head) = read_head(source, at, line_number)? {
        at += head.bytes;
        line_number += head.lines;
        let count = head.columns.checked_mul(head.rows).filter(|c| c.saturating_mul(6) <= source.len() - at + 8);
        let Some(count) = count else {
            let cause = format!(
                "line {}: a grid of {} x {} points does not fit into the {} bytes that follow",
                line_number - 10,
                head.columns,
                head.rows,
                source.len() - at
            );
            return Err(Error::bad(path, cause, COPY_AGAIN));
        };
        let roles = head.fields.roles();
        let line = Line { separator: b' ', decimal_comma: false, columns: head.fields.columns() };
        let (mut table, end, next) = parse_rows(source, at, line_number, Some(count), &line, &roles)?;
        if (table.len() as u64) < count {
            let cause = format!("scan {} promises {count} points, but only {} follow", stations.len(), table.len());
            if !settings.allow_truncated {
                return Err(Error::bad(path, cause, COPY_AGAIN));
            }
            warnings.push(Warning::new("truncated", cause));
        }
        let (rotation, translation) = (head.rotation, head.translation);
        check_matrix(&rotation, stations.len(), &mut warnings);
        table.transform(0, |p| {
            if p == Vec3::zeros() {
                silent += 1;
                return Vec3::repeat(f64::NAN);
            }
            rotation * p + translation
        });
        station_ids.resize(station_ids.len() + table.len(), stations.len() as u16);
        stations.push(Station { name: format!("scan {}", stations.len() + 1), position_in_local: Some(translation) });
        grids.push([head.columns, head.rows]);
        match &mut all {
            None => all = Some((table, head.fields)),
            Some((whole, before)) => {
                whole.append(table);
                *before = before.together_with(head.fields);
            }
        }
        of_scans.push(head.fields);
        (at, line_number) = (end, next);
    }
    let (table, fields) =
        all.ok_or_else(|| Error::bad(path, "it has no complete PTX header of ten lines", COPY_AGAIN))?;
    if fields.others > 0 {
        let text = format!("{} numbers at the end of lines have no name and are not used", fields.others);
        warnings.push(Warning::new("unknown-columns", text));
    }
    warnings.extend(mixed_scans("intensities", "0", of_scans.iter().map(|f| f.intensity)));
    warnings.extend(mixed_scans("colours", "mid grey", of_scans.iter().map(|f| f.color)));
    let mut info = FileInfo::new("PTX");
    info.header("encoding", text.encoding);
    info.header("grids", &grids);
    info.header("no_echo", silent);
    let mut scan = table.finish_absolute(&fields.roles(), info, warnings, "no echo (0, 0, 0)");
    scan.set_stations(stations, station_ids);
    Ok(scan.relative(origin))
}

fn check_matrix(rotation: &Mat3, scan: usize, warnings: &mut Vec<Warning>) {
    let determinant = rotation.determinant();
    let rigid = (rotation.transpose() * rotation - Mat3::identity()).amax() < 1e-3;
    if determinant < 0.0 {
        warnings.push(Warning::new(
            "mirrored-axes",
            format!(
                "the matrix of scan {scan} mirrors the scan (determinant {determinant:.3}); left and right would swap \
                 on the map: check the export"
            ),
        ));
    } else if !rigid {
        warnings.push(Warning::new(
            "matrix-not-rigid",
            format!(
                "the matrix of scan {scan} stretches lengths (determinant {determinant:.6}); it is applied as it is"
            ),
        ));
    }
}

fn read_head(source: &SourceBytes, at: u64, line_number: u64) -> Result<Option<Head>, Error> {
    /// Header and the first points.
    const WINDOW: usize = 4096;
    let head = source.up_to(at, WINDOW)?;
    if head.trim_ascii().is_empty() {
        return Ok(None);
    }
    let mut numbers: Vec<Vec<f64>> = Vec::new();
    let mut lines = head.split_inclusive(|&b| b == b'\n').peekable();
    let (mut bytes, mut blank) = (0, 0);
    while let Some(line) = lines.next_if(|l| l.trim_ascii().is_empty()) {
        bytes += line.len() as u64;
        blank += 1;
    }
    let line_number = line_number + blank;
    let words = |line: &[u8]| -> Option<Vec<f64>> {
        let text = std::str::from_utf8(line).ok()?;
        text.split_whitespace().map(|w| w.parse().ok()).collect()
    };
    for (index, expected) in [1, 1, 3, 3, 3, 3, 4, 4, 4, 4].into_iter().enumerate() {
        let line = lines.next().unwrap_or(b"");
        bytes += line.len() as u64;
        let row = words(line).filter(|w| w.len() == expected && w.iter().all(|v| v.is_finite()));
        let row = row.ok_or_else(|| {
            let cause = format!(
                "line {}: '{}' should be line {} of a PTX header, with {expected} numbers",
                line_number + index as u64,
                shorten(line.trim_ascii()),
                index + 1
            );
            Error::bad(source.path(), cause, COPY_AGAIN)
        })?;
        numbers.push(row);
    }
    let count = |v: f64| if (0.0..1e12).contains(&v) && v.fract() == 0.0 { v as u64 } else { u64::MAX };
    let row = |i: usize| Vec3::new(numbers[6 + i][0], numbers[6 + i][1], numbers[6 + i][2]);
    let (columns, rows) = (count(numbers[0][0]), count(numbers[1][0]));
    // The window may cut off the last line.
    let whole = |line: &&[u8]| head.len() < WINDOW || line.ends_with(b"\n");
    let points = usize::try_from(columns.saturating_mul(rows)).unwrap_or(usize::MAX);
    let first: Vec<Vec<f64>> = lines.filter(whole).map_while(words).filter(|w| !w.is_empty()).take(points).collect();
    let fields = Fields::of(&first).map_err(|cause| {
        let cause = format!("line {}: {cause}", line_number + 10);
        Error::unsupported(source.path(), cause, "export it with lines `x y z intensity` or `x y z intensity r g b`")
    })?;
    Ok(Some(Head {
        columns,
        rows,
        rotation: Mat3::from_columns(&[row(0), row(1), row(2)]),
        translation: row(3),
        bytes,
        lines: blank + 10,
        fields,
    }))
}
