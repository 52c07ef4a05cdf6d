//! Vertices back to PLY: every property as it was, with columns appended.

use super::super::error::Error;
use super::super::source_bytes::SourceBytes;
use super::super::write::{NO_CLASS, PointColumns, PointOfRecord, WriteSummary};
use super::header::{Element, Encoding, Header, Kind};
use super::read::Walker;
use crate::cloud::{Cloud, SourceFile};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Names and types of the appended properties, in their order.
static APPENDED: [(&str, &str); 5] =
    [("uint", "label"), ("double", "chainage"), ("double", "girth"), ("double", "offset"), ("uchar", "surface_class")];

/// The properties that these columns append; those of the source with the same names give way.
fn appended(columns: &PointColumns) -> &'static [(&'static str, &'static str)] {
    if columns.surface_classes.is_some() { &APPENDED } else { &APPENDED[..4] }
}

fn is_appended(columns: &PointColumns, name: &str) -> bool {
    appended(columns).iter().any(|(_, n)| *n == name)
}

fn append(columns: &PointColumns, point: Option<usize>, encoding: Encoding, out: &mut Vec<u8>) {
    let label = point.map_or(0, |p| columns.labels[p]);
    let lengths = [columns.chainage, columns.girth, columns.offset].map(|c| point.map_or(f64::NAN, |p| c[p]));
    let class = columns.surface_classes.map(|classes| point.map_or(NO_CLASS, |p| classes[p]));
    match encoding {
        Encoding::Ascii => {
            out.extend_from_slice(label.to_string().as_bytes());
            for v in lengths {
                // Lower case: what C libraries print and read.
                let text = if v.is_nan() { " nan".to_owned() } else { format!(" {v}") };
                out.extend_from_slice(text.as_bytes());
            }
            if let Some(class) = class {
                out.extend_from_slice(format!(" {class}").as_bytes());
            }
            out.push(b'\n');
        }
        Encoding::LittleEndian => {
            out.extend_from_slice(&label.to_le_bytes());
            lengths.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
            out.extend(class);
        }
        Encoding::BigEndian => {
            out.extend_from_slice(&label.to_be_bytes());
            lengths.iter().for_each(|v| out.extend_from_slice(&v.to_be_bytes()));
            out.extend(class);
        }
    }
}

/// Writes all vertices of the cloud's PLY source with the columns appended; other elements follow unchanged.
///
/// Several sources are written as one new file, because their properties may differ.
pub(in super::super) fn rewrite(
    cloud: &Cloud,
    columns: &PointColumns,
    destination: &Path,
) -> Result<WriteSummary, Error> {
    let [source] = cloud.sources() else {
        return write_new(cloud, Some(columns), destination);
    };
    rewrite_one(source, columns, destination)
}

fn rewrite_one(source: &SourceFile, columns: &PointColumns, destination: &Path) -> Result<WriteSummary, Error> {
    let bytes = SourceBytes::open(&source.path)?;
    let header = Header::read(&bytes)?;
    let changed = || Error::bad(&source.path, "it changed since it was read", "run again on the new file");
    let (place, vertices) = header.element("vertex").ok_or_else(changed)?;
    if vertices.count != source.record_count {
        return Err(changed());
    }
    let replaced: Vec<String> =
        vertices.properties.iter().filter(|p| is_appended(columns, &p.name)).map(|p| p.name.clone()).collect();
    let fail = |e: std::io::Error| Error::write(destination, e);
    let mut out = BufWriter::with_capacity(1 << 20, File::create(destination).map_err(fail)?);
    out.write_all(&new_header(&bytes, &header, columns)?).map_err(fail)?;
    let points = PointOfRecord::new(source);
    match (header.encoding, vertices.stride(), place) {
        (Encoding::LittleEndian | Encoding::BigEndian, Some(stride), 0) => {
            let kept = kept_ranges(vertices, columns);
            const RUN: usize = 16_384;
            let mut records = Vec::with_capacity(RUN * (stride + 32));
            let mut first = 0;
            while first < vertices.count {
                let run = (vertices.count - first).min(RUN as u64) as usize;
                records.clear();
                let block = bytes.bytes(header.data_at + first * stride as u64, run * stride)?;
                for (i, record) in block.chunks_exact(stride).enumerate() {
                    for range in &kept {
                        records.extend_from_slice(&record[range.clone()]);
                    }
                    append(columns, points.get(first + i as u64), header.encoding, &mut records);
                }
                out.write_all(&records).map_err(fail)?;
                first += run as u64;
            }
            let mut at = header.data_at + vertices.count * stride as u64;
            while at < bytes.len() {
                let block = bytes.up_to(at, 1 << 20)?;
                out.write_all(&block).map_err(fail)?;
                at += block.len() as u64;
            }
        }
        _ => {
            let data = bytes.up_to(header.data_at, usize::MAX)?;
            let mut walker = Walker::new(&bytes, &header, &data);
            for element in &header.elements[..place] {
                walker.skip(element)?;
            }
            out.write_all(&data[..walker.at]).map_err(fail)?;
            if header.encoding == Encoding::Ascii && walker.at > 0 {
                out.write_all(b"\n").map_err(fail)?;
            }
            let mut record = 0;
            let mut line = Vec::new();
            let mut failure = None;
            walker
                .rows(vertices, &mut |row| {
                    line.clear();
                    let span = &data[row.span[0]..row.span[1]];
                    if header.encoding == Encoding::Ascii {
                        keep_words(vertices, columns, &row.lists, span, &mut line);
                    } else {
                        keep_bytes(vertices, columns, &row.lists, span, &mut line);
                    }
                    append(columns, points.get(record), header.encoding, &mut line);
                    record += 1;
                    out.write_all(&line).map_err(|e| {
                        failure = Some(e);
                        String::new()
                    })
                })
                .map_err(|e| failure.map_or(e, fail))?;
            let mut at = walker.at;
            if header.encoding == Encoding::Ascii {
                // The line end of the last vertex is written already.
                let rest = &data[at..];
                at += rest.iter().position(|&b| b == b'\n').map_or(rest.len(), |p| p + 1);
            }
            out.write_all(&data[at..]).map_err(fail)?;
        }
    }
    out.into_inner().map_err(|e| fail(e.into_error()))?.sync_all().map_err(fail)?;
    Ok(WriteSummary { points: source.record_count, replaced_columns: replaced, warnings: Vec::new() })
}

/// The source's header line by line, with the vertex properties changed.
fn new_header(source: &SourceBytes, header: &Header, columns: &PointColumns) -> Result<Vec<u8>, Error> {
    let raw = source.bytes(0, header.data_at as usize)?;
    let mut out = Vec::with_capacity(raw.len() + 128);
    let mut in_vertex = false;
    let mut done = false;
    for line in raw.split_inclusive(|&b| b == b'\n') {
        let text = String::from_utf8_lossy(line);
        let mut words = text.split_whitespace();
        let (first, last) = (words.next(), words.next_back());
        let leaves = in_vertex && matches!(first, Some("element" | "end_header"));
        if leaves && !done {
            for (kind, name) in appended(columns) {
                out.extend_from_slice(format!("property {kind} {name}\n").as_bytes());
            }
            done = true;
        }
        match first {
            Some("element") => in_vertex = text.split_whitespace().nth(1) == Some("vertex"),
            Some("property") if in_vertex && last.is_some_and(|name| is_appended(columns, name)) => continue,
            _ => {}
        }
        out.extend_from_slice(line);
    }
    Ok(out)
}

/// Byte ranges of a fixed-length record without the properties that are replaced.
fn kept_ranges(vertices: &Element, columns: &PointColumns) -> Vec<std::ops::Range<usize>> {
    let mut ranges: Vec<std::ops::Range<usize>> = Vec::new();
    let mut at = 0;
    for property in &vertices.properties {
        let Kind::Scalar(scalar) = property.kind else { continue };
        let range = at..at + scalar.size();
        at = range.end;
        if is_appended(columns, &property.name) {
            continue;
        }
        match ranges.last_mut() {
            Some(last) if last.end == range.start => last.end = range.end,
            _ => ranges.push(range),
        }
    }
    ranges
}

/// Copies the words of a text record that are kept, each followed by a blank.
fn keep_words(vertices: &Element, columns: &PointColumns, lists: &[(usize, Vec<f64>)], span: &[u8], out: &mut Vec<u8>) {
    let mut words = span.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
    for (place, property) in vertices.properties.iter().enumerate() {
        let items = lists.iter().find(|(p, _)| *p == place).map_or(0, |(_, items)| items.len());
        for word in words.by_ref().take(1 + items) {
            if !is_appended(columns, &property.name) {
                out.extend_from_slice(word);
                out.push(b' ');
            }
        }
    }
}

/// Copies the bytes of a binary record with lists that are kept.
fn keep_bytes(vertices: &Element, columns: &PointColumns, lists: &[(usize, Vec<f64>)], span: &[u8], out: &mut Vec<u8>) {
    let mut at = 0;
    for (place, property) in vertices.properties.iter().enumerate() {
        let size = match property.kind {
            Kind::Scalar(scalar) => scalar.size(),
            Kind::List(count, item) => {
                let items = lists.iter().find(|(p, _)| *p == place).map_or(0, |(_, items)| items.len());
                count.size() + items * item.size()
            }
        };
        if !is_appended(columns, &property.name) {
            out.extend_from_slice(&span[at..at + size]);
        }
        at += size;
    }
}

/// Writes a cloud as a new binary little endian PLY with all its attributes.
pub(in super::super) fn write_new(
    cloud: &Cloud,
    columns: Option<&PointColumns>,
    destination: &Path,
) -> Result<WriteSummary, Error> {
    let attributes = cloud.attributes();
    let own_labels = attributes.labels.as_ref().filter(|_| columns.is_none());
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::with_capacity(1 << 20, File::create(destination)?);
        writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}", cloud.len())?;
        writeln!(out, "property double x\nproperty double y\nproperty double z")?;
        if attributes.colors.is_some() {
            writeln!(out, "property ushort red\nproperty ushort green\nproperty ushort blue")?;
        }
        let named = [
            (attributes.intensities.is_some(), "ushort intensity"),
            (attributes.classifications.is_some(), "uchar classification"),
            (attributes.source_ids.is_some(), "ushort point_source_id"),
            (own_labels.is_some(), "uint label"),
        ];
        for (_, property) in named.iter().filter(|n| n.0) {
            writeln!(out, "property {property}")?;
        }
        if let Some(columns) = columns {
            for (kind, name) in appended(columns) {
                writeln!(out, "property {kind} {name}")?;
            }
        }
        writeln!(out, "end_header")?;
        let mut record = Vec::new();
        for (i, p) in cloud.positions().iter().enumerate() {
            record.clear();
            for c in cloud.frame().scan_from_local(p).iter() {
                record.extend_from_slice(&c.to_le_bytes());
            }
            if let Some(colors) = &attributes.colors {
                colors[i].iter().for_each(|c| record.extend_from_slice(&c.to_le_bytes()));
            }
            if let Some(column) = &attributes.intensities {
                record.extend_from_slice(&column[i].to_le_bytes());
            }
            if let Some(column) = &attributes.classifications {
                record.push(column[i]);
            }
            if let Some(column) = &attributes.source_ids {
                record.extend_from_slice(&column[i].to_le_bytes());
            }
            if let Some(column) = own_labels {
                record.extend_from_slice(&column[i].to_le_bytes());
            }
            if let Some(columns) = columns {
                append(columns, Some(i), Encoding::LittleEndian, &mut record);
            }
            out.write_all(&record)?;
        }
        out.into_inner()?.sync_all()
    };
    write().map_err(|e| Error::write(destination, e))?;
    Ok(WriteSummary { points: cloud.len() as u64, ..WriteSummary::default() })
}
