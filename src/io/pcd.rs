//! PCD: point clouds of PCL, as text, binary and compressed binary.
//!
//! Reference: R. B. Rusu and S. Cousins, *3D is here: Point Cloud Library (PCL)*, ICRA 2011,
//! doi:10.1109/ICRA.2011.5980567; the format is described in the documentation of PCL. Compressed data is LZF in columns.

use super::error::{COPY_AGAIN, Error};
use super::file_scan::{AttributeInfo, FileInfo, FileScan, Settings};
use super::point_table::{ColorRange, PointTable, Roles};
use super::source_bytes::SourceBytes;
use super::text::{Line, parse_rows};
use crate::cloud::Station;
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Data {
    Ascii,
    Binary,
    Compressed,
}

#[derive(Clone, Debug)]
struct Field {
    name: String,
    size: usize,
    kind: u8,
    count: usize,
}

impl Field {
    /// Appends the bytes of a number given as text.
    fn put(&self, word: &str, bytes: &mut Vec<u8>) -> Option<()> {
        match (self.kind, self.size) {
            (b'F', 4) => bytes.extend(word.parse::<f32>().ok()?.to_le_bytes()),
            (b'F', _) => bytes.extend(word.parse::<f64>().ok()?.to_le_bytes()),
            // Integers may be written as 255.0; two's complement holds both signs.
            (_, size) => {
                let whole = word.parse::<i128>().ok().or_else(|| word.parse::<f64>().ok().map(|v| v as i128))?;
                bytes.extend(&whole.to_le_bytes()[..size]);
            }
        }
        Some(())
    }

    fn get(&self, bytes: &[u8]) -> f64 {
        macro_rules! number {
            ($type:ty) => {
                <$type>::from_le_bytes(bytes[..size_of::<$type>()].try_into().expect("checked with the header")) as f64
            };
        }
        match (self.kind, self.size) {
            (b'F', 4) => number!(f32),
            (b'F', _) => number!(f64),
            (b'U', 1) => f64::from(bytes[0]),
            (b'U', 2) => number!(u16),
            (b'U', 4) => number!(u32),
            (b'U', _) => number!(u64),
            (_, 1) => f64::from(bytes[0] as i8),
            (_, 2) => number!(i16),
            (_, 4) => number!(i32),
            _ => number!(i64),
        }
    }
}

struct Header {
    version: String,
    fields: Vec<Field>,
    points: u64,
    viewpoint: Vec3,
    data: Data,
    data_at: u64,
    lines: u64,
    warnings: Vec<Warning>,
}

/// Reads a PCD file.
pub(super) fn read(source: &SourceBytes, settings: &Settings, origin: Option<Vec3>) -> Result<FileScan, Error> {
    let path = source.path();
    let mut header = read_header(source)?;
    let warnings = std::mem::take(&mut header.warnings);
    // A colour is packed into the bits of one field: it is offered as three more columns.
    let holds_color = |f: &Field| ["rgb", "rgba"].contains(&f.name.as_str()) && f.size == 4 && f.count > 0;
    let packed = header.fields.iter().position(holds_color);
    let mut names: Vec<String> =
        header.fields.iter().map(|f| if f.count == 1 { f.name.clone() } else { String::new() }).collect();
    let first_packed = names.len();
    if packed.is_some() {
        names.extend(["red", "green", "blue"].map(str::to_owned));
    }
    let color_range = |column: usize| match header.fields.get(column) {
        None => ColorRange::EightBit,
        Some(f) if f.kind == b'F' => ColorRange::Open,
        Some(f) if f.size == 1 => ColorRange::EightBit,
        Some(_) => ColorRange::SixteenBit,
    };
    let Some(roles) = Roles::of(path, &names, settings, color_range)? else {
        let cause = format!("its fields {names:?} lack one of x, y, z");
        return Err(Error::bad(path, cause, "export the scan again with all three coordinates"));
    };
    let table = match header.data {
        Data::Ascii if packed.is_some() || header.fields.iter().any(|f| f.count != 1) => {
            let bytes = records_of_text(source, &header)?;
            fill(&header, &bytes, &record_places(&header), packed, first_packed, &roles)
        }
        Data::Ascii => {
            let columns = header.fields.len();
            let line = Line { separator: b' ', decimal_comma: false, columns };
            let (table, ..) = parse_rows(source, header.data_at, header.lines + 1, Some(header.points), &line, &roles)?;
            if (table.len() as u64) < header.points {
                let cause = format!("its header promises {} points, but {} follow", header.points, table.len());
                return Err(Error::bad(path, cause, COPY_AGAIN));
            }
            table
        }
        Data::Binary => {
            let bytes = source.bytes(header.data_at, record_bytes(&header) * header.points as usize)?;
            fill(&header, &bytes, &record_places(&header), packed, first_packed, &roles)
        }
        Data::Compressed => {
            let bytes = decompress(source, &header)?;
            let mut at = 0;
            let places: Vec<(usize, usize)> = header
                .fields
                .iter()
                .map(|f| {
                    let here = at;
                    at += f.size * f.count * header.points as usize;
                    (here, f.size * f.count)
                })
                .collect();
            fill(&header, &bytes, &places, packed, first_packed, &roles)
        }
    };
    let mut info = FileInfo::new("PCD");
    info.version = Some(header.version.clone());
    info.header("fields", &names);
    info.header("data", format!("{:?}", header.data).to_lowercase());
    info.single_precision = roles.position.iter().any(|&c| header.fields[c].size == 4);
    info.attributes
        .extend(names.iter().filter(|n| !n.is_empty() && *n != "intensity").map(|n| AttributeInfo::present(n)));
    let mut scan = table.finish_absolute(&roles, info, warnings, "a coordinate that is not a number");
    if header.viewpoint != Vec3::zeros() {
        let n = scan.record_count as usize;
        scan.set_stations(
            vec![Station { name: "viewpoint".into(), position_in_local: Some(header.viewpoint) }],
            vec![0; n],
        );
    }
    Ok(scan.relative(origin))
}

fn record_bytes(header: &Header) -> usize {
    header.fields.iter().map(|f| f.size * f.count).sum()
}

/// First byte of each field in records that follow one another, and the length of a record.
fn record_places(header: &Header) -> Vec<(usize, usize)> {
    let stride = record_bytes(header);
    let mut at = 0;
    let place = |f: &Field| {
        let here = at;
        at += f.size * f.count;
        (here, stride)
    };
    header.fields.iter().map(place).collect()
}

/// Text as the binary records that it would be: vectors and colours packed into the bits of a number need the bits.
fn records_of_text(source: &SourceBytes, header: &Header) -> Result<Vec<u8>, Error> {
    let text = source.up_to(header.data_at, usize::MAX)?;
    let text = String::from_utf8_lossy(&text);
    let bad = |cause: String| Error::bad(source.path(), cause, COPY_AGAIN);
    let mut bytes = Vec::new();
    let mut rows = 0;
    for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        if rows == header.points {
            break;
        }
        let at_line = |what: &str| bad(format!("line {}: {what}", header.lines + 1 + number as u64));
        let mut words = line.split_whitespace();
        for field in &header.fields {
            for _ in 0..field.count {
                let word = words.next().ok_or_else(|| at_line("fewer numbers than the fields need"))?;
                field.put(word, &mut bytes).ok_or_else(|| at_line(&format!("'{word}' is not a number")))?;
            }
        }
        rows += 1;
    }
    if rows < header.points {
        return Err(bad(format!("its header promises {} points, but {rows} follow", header.points)));
    }
    Ok(bytes)
}

/// Fills a table from fields that lie at `place + row * stride`.
fn fill(
    header: &Header,
    bytes: &[u8],
    places: &[(usize, usize)],
    packed: Option<usize>,
    first_packed: usize,
    roles: &Roles,
) -> PointTable {
    const RUN: usize = 16_384;
    let mut table = PointTable::new(header.points as usize, roles);
    let bad: Vec<u64> = table
        .slots(RUN)
        .into_par_iter()
        .enumerate()
        .map(|(run, mut slots)| {
            let mut bad_labels = 0;
            for row in 0..slots.len() {
                let record = run * RUN + row;
                slots.set(row, roles, &mut bad_labels, |column| {
                    if column >= first_packed {
                        let (place, stride) = places[packed.expect("columns beyond the fields are packed")];
                        let at = place + record * stride;
                        // Blue, green, red from the lowest byte on.
                        return f64::from(bytes[at + 2 - (column - first_packed)]);
                    }
                    let (place, stride) = places[column];
                    header.fields[column].get(&bytes[place + record * stride..])
                });
            }
            bad_labels
        })
        .collect();
    table.add_bad_labels(bad.iter().sum());
    table
}

/// How many points the header counts; a binary file must hold them.
pub(super) fn announced_points(source: &SourceBytes) -> Result<u64, Error> {
    let header = read_header(source)?;
    if header.data == Data::Binary {
        let stride: usize = header.fields.iter().map(|f| f.size * f.count).sum();
        let needed = header.points.saturating_mul(stride as u64).saturating_add(header.data_at);
        super::announce::must_hold(source, needed, "its point count")?;
    }
    Ok(header.points)
}

fn read_header(source: &SourceBytes) -> Result<Header, Error> {
    let head = source.up_to(0, 1 << 16)?;
    let bad = |cause: String| Error::bad(source.path(), cause, COPY_AGAIN);
    let mut header = Header {
        version: String::new(),
        fields: Vec::new(),
        points: 0,
        viewpoint: Vec3::zeros(),
        data: Data::Ascii,
        data_at: 0,
        lines: 0,
        warnings: Vec::new(),
    };
    let (mut names, mut sizes, mut kinds, mut counts) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let (mut width, mut height, mut points, mut data) = (1u64, 1u64, None, None);
    let mut at = 0;
    for line in head.split_inclusive(|&b| b == b'\n') {
        at += line.len();
        header.lines += 1;
        let text = String::from_utf8_lossy(line);
        let mut words = text.split_whitespace();
        let Some(key) = words.next() else { continue };
        let rest: Vec<&str> = words.collect();
        let whole = |w: Option<&&str>| w.and_then(|w| w.parse::<u64>().ok());
        let number =
            || whole(rest.first()).ok_or_else(|| bad(format!("header line '{}' has no valid number", text.trim())));
        match key {
            "VERSION" => header.version = rest.join(" "),
            // The name before version 0.7.
            "FIELDS" | "COLUMNS" => names = rest.iter().map(|n| n.to_ascii_lowercase()).collect(),
            "SIZE" => sizes = rest.iter().filter_map(|w| w.parse::<usize>().ok()).collect(),
            "TYPE" => kinds = rest.iter().map(|w| w.as_bytes()[0].to_ascii_uppercase()).collect(),
            "COUNT" => counts = rest.iter().filter_map(|w| w.parse::<usize>().ok()).collect(),
            "WIDTH" => width = number()?,
            "HEIGHT" => height = number()?,
            "POINTS" => points = Some(number()?),
            "VIEWPOINT" => {
                let v: Vec<f64> =
                    rest.iter().take(3).filter_map(|w| w.parse().ok()).filter(|v: &f64| v.is_finite()).collect();
                if let [x, y, z] = v[..] {
                    header.viewpoint = Vec3::new(x, y, z);
                } else {
                    let text = format!("its header line '{}' is no place of a scanner and ignored", text.trim());
                    header.warnings.push(Warning::new("pcd-header", text));
                }
            }
            "DATA" => {
                data = Some(match rest.first().copied() {
                    Some("ascii") => Data::Ascii,
                    Some("binary") => Data::Binary,
                    Some("binary_compressed") => Data::Compressed,
                    _ => return Err(bad(format!("header line '{}' names no known encoding", text.trim()))),
                });
                break;
            }
            _ if key.starts_with('#') => {}
            _ => {
                return Err(bad(format!(
                    "header line '{}' is unknown",
                    text.trim().chars().take(40).collect::<String>()
                )));
            }
        }
    }
    header.data = data.ok_or_else(|| bad("the PCD header has no DATA line".into()))?;
    header.data_at = at as u64;
    if counts.is_empty() {
        counts = vec![1; names.len()];
    }
    if names.is_empty() || [sizes.len(), kinds.len(), counts.len()].iter().any(|&l| l != names.len()) {
        return Err(bad(format!(
            "{} fields have {} sizes, {} types and {} counts",
            names.len(),
            sizes.len(),
            kinds.len(),
            counts.len()
        )));
    }
    for (i, name) in names.into_iter().enumerate() {
        let (size, kind, count): (usize, u8, usize) = (sizes[i], kinds[i], counts[i]);
        let valid = matches!((kind, size), (b'F', 4 | 8) | (b'I' | b'U', 1 | 2 | 4 | 8)) && count <= 1 << 16;
        if !valid {
            return Err(bad(format!("field '{name}' has type {} of {size} bytes, {count} times", kind as char)));
        }
        header.fields.push(Field { name, size, kind, count });
    }
    let product = width.checked_mul(height);
    header.points = points.or(product).unwrap_or(u64::MAX);
    if points.is_some() && points != product {
        let text = format!("its header counts {} points in a grid of {width} x {height}", header.points);
        header.warnings.push(Warning::new("pcd-header", text));
    }
    let stride: u64 = header.fields.iter().map(|f| (f.size * f.count) as u64).sum();
    let there = source.len() - header.data_at;
    let needed = match header.data {
        Data::Ascii => u128::from(header.points) * 2 * header.fields.len() as u128,
        Data::Binary => u128::from(header.points) * u128::from(stride),
        // LZF cannot do better than one part in 264 / 3.
        Data::Compressed => u128::from(header.points) * u128::from(stride) / 88,
    };
    if needed > u128::from(there) + 1 {
        return Err(bad(format!(
            "its header promises {} points of {stride} bytes, but only {there} bytes follow",
            header.points
        )));
    }
    Ok(header)
}

/// Columns of a compressed file.
fn decompress(source: &SourceBytes, header: &Header) -> Result<Vec<u8>, Error> {
    let bad = |cause: String| Error::bad(source.path(), cause, COPY_AGAIN);
    let sizes = source.up_to(header.data_at, 8)?;
    if sizes.len() < 8 {
        return Err(bad("the compressed data is cut off".into()));
    }
    let [compressed, plain] =
        [0, 4].map(|at| u32::from_le_bytes(sizes[at..at + 4].try_into().expect("four bytes")) as u64);
    let stride: u64 = header.fields.iter().map(|f| (f.size * f.count) as u64).sum();
    let there = source.len() - header.data_at - 8;
    if compressed > there || plain != stride * header.points {
        return Err(bad(format!(
            "it claims {compressed} compressed bytes of {there} for {plain} bytes, but {} points take {}",
            header.points,
            stride * header.points
        )));
    }
    let bytes = source.bytes(header.data_at + 8, compressed as usize)?;
    lzf(&bytes, plain as usize).ok_or_else(|| bad("its compressed data is damaged".into()))
}

/// Expands LZF data (M. Lehmann's LibLZF): runs of literals and back references; `None` when it is damaged.
fn lzf(bytes: &[u8], expected: usize) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(expected);
    let mut at = 0;
    while at < bytes.len() {
        let control = usize::from(bytes[at]);
        at += 1;
        if control < 32 {
            out.extend_from_slice(bytes.get(at..at + control + 1)?);
            at += control + 1;
        } else {
            let mut length = control >> 5;
            if length == 7 {
                length += usize::from(*bytes.get(at)?);
                at += 1;
            }
            let distance = ((control & 31) << 8) + usize::from(*bytes.get(at)?) + 1;
            at += 1;
            let start = out.len().checked_sub(distance)?;
            for i in 0..length + 2 {
                out.push(out[start + i]);
            }
        }
        if out.len() > expected {
            return None;
        }
    }
    (out.len() == expected).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lzf_literals_and_references() {
        // Three literals, then six bytes from three back: the copy overlaps itself.
        assert_eq!(lzf(&[2, b'a', b'b', b'c', 4 << 5, 2], 9).unwrap(), b"abcabcabc");
        // A long reference: 7 + 3 + 2 bytes from one back.
        assert_eq!(lzf(&[0, b'x', 7 << 5, 3, 0], 13).unwrap(), [b'x'; 13]);
    }

    #[test]
    fn damaged_lzf_is_refused() {
        assert_eq!(lzf(&[0, b'x', 1 << 5, 5], 4), None, "a reference before the beginning");
        assert_eq!(lzf(&[5, b'x'], 6), None, "literals that are not there");
        assert_eq!(lzf(&[0, b'x'], 2), None, "too few bytes");
        assert_eq!(lzf(&[1, b'x', b'y'], 1), None, "too many bytes");
    }
}
