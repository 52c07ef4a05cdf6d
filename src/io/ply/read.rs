//! Vertices of a PLY file into columns.

use super::super::error::{COPY_AGAIN, Error};
use super::super::file_scan::{AttributeInfo, FileInfo, FileScan, Settings};
use super::super::point_table::{ColorRange, ColumnSource, PointTable, Roles};
use super::super::source_bytes::SourceBytes;
use super::header::{Element, Encoding, Header, Kind, Scalar};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;

/// Vertices decoded at a time by one thread: few enough that their bytes stay in the second-level cache.
pub(super) const RUN: usize = 8192;

/// Reads the vertices of a PLY file as points.
pub(in super::super) fn read(
    source: &SourceBytes,
    settings: &Settings,
    origin: Option<Vec3>,
) -> Result<FileScan, Error> {
    let mut header = Header::read(source)?;
    let mut info = info(&header);
    let mut warnings = std::mem::take(&mut header.warnings);
    let path = source.path();
    let Some((place, vertices)) = header.element("vertex") else {
        return Err(Error::bad(path, "it has no element 'vertex'", "export the scan again"));
    };
    let names: Vec<String> = vertices
        .properties
        .iter()
        .map(|p| if matches!(p.kind, Kind::Scalar(_)) { p.name.clone() } else { String::new() })
        .collect();
    let color_range = |column: usize| match vertices.properties[column].kind {
        Kind::Scalar(Scalar::U8 | Scalar::I8) => ColorRange::EightBit,
        Kind::Scalar(s) if s.is_float() => ColorRange::Open,
        _ => ColorRange::SixteenBit,
    };
    let Some(roles) = Roles::of(path, &names, settings, color_range)? else {
        let there = names.join(", ");
        let cause = format!("its vertices have no coordinates x, y, z (properties: {there})");
        return Err(Error::bad(path, cause, "export the scan again with all three coordinates"));
    };
    let single = roles.position.iter().any(|&c| vertices.properties[c].kind == Kind::Scalar(Scalar::F32));
    info.single_precision = single;
    let table = match (header.encoding, vertices.stride(), place) {
        (Encoding::LittleEndian | Encoding::BigEndian, Some(stride), 0) => {
            binary(source, &header, vertices, stride, &roles)?
        }
        _ => walked(source, &header, place, &roles, &mut warnings)?,
    };
    for column in &vertices.properties {
        if !["intensity", "scalar_intensity"].contains(&column.name.to_ascii_lowercase().as_str()) {
            info.attributes.push(AttributeInfo::present(&column.name));
        }
    }
    Ok(table.finish(&roles, info, warnings, origin))
}

/// What the header says, and whether the vertices have all three coordinates.
pub(in super::super) fn describe(source: &SourceBytes) -> Result<(FileInfo, bool), Error> {
    let header = Header::read(source)?;
    let has = |name: &str| {
        let properties = header.element("vertex").map_or(&[][..], |(_, e)| &e.properties);
        properties.iter().any(|p| p.name.eq_ignore_ascii_case(name))
    };
    Ok((info(&header), ["x", "y", "z"].into_iter().all(has)))
}

pub(super) fn info(header: &Header) -> FileInfo {
    let mut info = FileInfo::new("PLY");
    info.version = Some(
        match header.encoding {
            Encoding::Ascii => "ascii",
            Encoding::LittleEndian => "binary little endian",
            Encoding::BigEndian => "binary big endian",
        }
        .to_owned(),
    );
    info.faces = header.element("face").map_or(0, |(_, e)| e.count);
    info.records = header.element("vertex").map_or(0, |(_, e)| e.count);
    let elements: Vec<String> = header.elements.iter().map(|e| format!("{} {}", e.count, e.name)).collect();
    info.header("elements", elements);
    info.header("remarks", &header.remarks);
    info
}

/// Records of fixed length in memory.
struct Records<'a> {
    bytes: &'a [u8],
    stride: usize,
    columns: &'a [(usize, Scalar)],
    big_endian: bool,
}

impl ColumnSource for Records<'_> {
    #[inline(always)]
    fn each(&self, column: usize, put: impl FnMut(usize, f64)) {
        let (at, scalar) = self.columns[column];
        scalar.column(self.bytes, self.stride, at, self.big_endian, put);
    }
}

/// Place and type of each property in a record of fixed length.
pub(super) fn places(vertices: &Element) -> Vec<(usize, Scalar)> {
    vertices
        .properties
        .iter()
        .scan(0, |at, p| {
            let Kind::Scalar(scalar) = p.kind else { unreachable!("a stride means that there are no lists") };
            let here = *at;
            *at += scalar.size();
            Some((here, scalar))
        })
        .collect()
}

/// Records of fixed length: every run of vertices is read and decoded by itself.
fn binary(
    source: &SourceBytes,
    header: &Header,
    vertices: &Element,
    stride: usize,
    roles: &Roles,
) -> Result<PointTable, Error> {
    let columns = places(vertices);
    let big_endian = header.big_endian();
    let mut table = PointTable::new(vertices.count as usize, roles);
    let bad_labels = table
        .slots(RUN)
        .into_par_iter()
        .enumerate()
        .map(|(run, mut slots)| {
            let at = header.data_at + (run * RUN * stride) as u64;
            let bytes = source.bytes(at, slots.len() * stride)?;
            let mut bad_labels = 0;
            slots.set_columns(
                roles,
                &mut bad_labels,
                &Records { bytes: &bytes, stride, columns: &columns, big_endian },
            );
            Ok(bad_labels)
        })
        .collect::<Result<Vec<u64>, Error>>()?;
    table.add_bad_labels(bad_labels.iter().sum());
    Ok(table)
}

/// Text and lists: elements are walked in order.
fn walked(
    source: &SourceBytes,
    header: &Header,
    place: usize,
    roles: &Roles,
    warnings: &mut Vec<Warning>,
) -> Result<PointTable, Error> {
    let bytes = source.up_to(header.data_at, usize::MAX)?;
    let mut walker = Walker::new(source, header, &bytes);
    for element in &header.elements[..place] {
        walker.skip(element)?;
    }
    let vertices = &header.elements[place];
    let mut table = PointTable::new(vertices.count as usize, roles);
    let mut bad_labels = 0;
    let mut next = 0;
    let mut slots = table.slots(RUN);
    walker.rows(vertices, &mut |row| {
        slots[next / RUN].set(next % RUN, roles, &mut bad_labels, |column| row.scalars[column]);
        next += 1;
        Ok(())
    })?;
    drop(slots);
    warnings.extend(walker.warnings());
    table.add_bad_labels(bad_labels);
    Ok(table)
}

/// One record: a number for each property (NaN for lists) and the items of all its lists.
pub(super) struct Row {
    pub(super) scalars: Vec<f64>,
    /// Items of each list, with the place of its property.
    pub(super) lists: Vec<(usize, Vec<f64>)>,
    /// Where the record begins and ends in the data.
    pub(super) span: [usize; 2],
}

/// Walks over the elements of a file in order.
pub(super) struct Walker<'a> {
    source: &'a SourceBytes,
    encoding: Encoding,
    bytes: &'a [u8],
    pub(super) at: usize,
    /// Text with one record a line, as it should be: then words that a line has too many do no harm.
    by_line: bool,
    /// Lines that had too many words.
    long_lines: u64,
}

impl<'a> Walker<'a> {
    pub(super) fn new(source: &'a SourceBytes, header: &Header, bytes: &'a [u8]) -> Self {
        let filled = || bytes.split(|&b| b == b'\n').filter(|l| !l.trim_ascii().is_empty()).count() as u64;
        let records: u64 = header.elements.iter().map(|e| e.count).sum();
        let by_line = header.encoding == Encoding::Ascii && filled() == records;
        Self { source, encoding: header.encoding, bytes, at: 0, by_line, long_lines: 0 }
    }

    /// Words that were skipped, for people.
    pub(super) fn warnings(&self) -> Option<Warning> {
        (self.long_lines > 0).then(|| {
            Warning::new(
                "ply-long-lines",
                format!(
                    "{} lines have more words than the header says; the rest of these lines is ignored",
                    self.long_lines
                ),
            )
        })
    }

    /// Goes to the end of the line of a record.
    fn end_line(&mut self) {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&b| b == b'\n').unwrap_or(rest.len());
        self.long_lines += u64::from(!rest[..end].trim_ascii().is_empty());
        self.at += end;
    }

    fn number(&mut self, scalar: Scalar) -> Result<f64, String> {
        if self.encoding == Encoding::Ascii {
            let rest = &self.bytes[self.at..];
            let skipped = rest.iter().position(|b| !b.is_ascii_whitespace()).ok_or("the text ends")?;
            let rest = &rest[skipped..];
            let len = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
            self.at += skipped + len;
            let word = std::str::from_utf8(&rest[..len]).map_err(|_| "it is not text".to_owned())?;
            return word
                .parse()
                .map_err(|_| format!("'{}' is not a number", word.chars().take(20).collect::<String>()));
        }
        let end = self.at + scalar.size();
        let bytes = self.bytes.get(self.at..end).ok_or("the file ends")?;
        self.at = end;
        Ok(scalar.get(bytes, self.encoding == Encoding::BigEndian))
    }

    pub(super) fn skip(&mut self, element: &Element) -> Result<(), Error> {
        self.rows(element, &mut |_| Ok(()))
    }

    /// Visits the records of the next element; `visit` may refuse one with a cause.
    pub(super) fn rows(
        &mut self,
        element: &Element,
        visit: &mut dyn FnMut(&Row) -> Result<(), String>,
    ) -> Result<(), Error> {
        let mut row = Row { scalars: vec![f64::NAN; element.properties.len()], lists: Vec::new(), span: [0; 2] };
        for record in 0..element.count {
            row.span[0] = self.at;
            let result = self.row(element, &mut row);
            row.span[1] = self.at;
            if self.by_line {
                self.end_line();
            }
            result.and_then(|()| visit(&row)).map_err(|cause| {
                let cause = format!("record {record} of {} elements '{}': {cause}", element.count, element.name);
                Error::bad(self.source.path(), cause, COPY_AGAIN)
            })?;
        }
        Ok(())
    }

    fn row(&mut self, element: &Element, row: &mut Row) -> Result<(), String> {
        let mut list = 0;
        for (place, property) in element.properties.iter().enumerate() {
            match property.kind {
                Kind::Scalar(scalar) => row.scalars[place] = self.number(scalar)?,
                Kind::List(count, item) => {
                    let length = self.number(count)?;
                    let left = (self.bytes.len() - self.at) as f64;
                    let smallest = if self.encoding == Encoding::Ascii { 1 } else { item.size() };
                    if length < 0.0 || length.fract() != 0.0 || length * smallest as f64 > left {
                        return Err(format!("a list of length {length} does not fit into the file"));
                    }
                    if row.lists.len() == list {
                        row.lists.push((place, Vec::new()));
                    }
                    let (at, mut items) = std::mem::take(&mut row.lists[list]);
                    items.clear();
                    for _ in 0..length as usize {
                        items.push(self.number(item)?);
                    }
                    row.lists[list] = (at, items);
                    list += 1;
                }
            }
        }
        Ok(())
    }
}
