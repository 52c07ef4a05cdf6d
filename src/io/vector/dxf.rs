//! DXF: 3D polylines and points, one layer for each class. Written as R12, which every program reads, and whose few
//! groups are written here; read in all versions that the crate `dxf` knows (it writes the extended data of a polyline
//! behind its end, where it belongs to nothing).
//!
//! DXF has no attributes; they travel as extended data of the application `ADIT`, `name=value` with the value as JSON,
//! so that Adit reads back what it wrote. Lines of several parts are several entities with the same id.

use super::{Shapes, VectorFile, bad, write_whole};
use crate::io::Error;
use crate::linework::{Feature, Kind, Value};
use crate::numeric::Vec3;
use crate::warning::Warning;
use dxf::entities::EntityType;
use dxf::{Drawing, Point, XData, XDataItem};
use std::collections::BTreeMap;
use std::path::Path;

const APPLICATION: &str = "ADIT";
/// Text of extended data may have 255 bytes; longer values continue in further strings that begin with `+`.
const TEXT_BYTES: usize = 240;
/// Colours of the layers, in turn: red, green, cyan, blue, magenta, yellow.
const COLORS: [u8; 6] = [1, 3, 4, 5, 6, 2];

pub(super) fn write(path: &Path, shapes: &Shapes) -> Result<Vec<Warning>, Error> {
    let mut text = String::new();
    let mut layers: Vec<String> = Vec::new();
    let mut entities = String::new();
    for feature in shapes.features {
        let layer = layer_name(&feature.class);
        if !layers.contains(&layer) {
            layers.push(layer.clone());
        }
        let data = extended(feature);
        for part in &feature.parts {
            match feature.kind {
                Kind::Point => {
                    pair(&mut entities, 0, "POINT");
                    pair(&mut entities, 8, &layer);
                    place(&mut entities, &part[0]);
                    extend(&mut entities, &data);
                }
                Kind::Line | Kind::Area => {
                    let closed = feature.kind == Kind::Area;
                    pair(&mut entities, 0, "POLYLINE");
                    pair(&mut entities, 8, &layer);
                    pair(&mut entities, 66, "1");
                    place(&mut entities, &Vec3::zeros());
                    // 8: a polyline in space; 1: closed.
                    pair(&mut entities, 70, if closed { "9" } else { "8" });
                    extend(&mut entities, &data);
                    let end = if closed { part.len() - 1 } else { part.len() };
                    for p in &part[..end] {
                        pair(&mut entities, 0, "VERTEX");
                        pair(&mut entities, 8, &layer);
                        place(&mut entities, p);
                        pair(&mut entities, 70, "32");
                    }
                    pair(&mut entities, 0, "SEQEND");
                    pair(&mut entities, 8, &layer);
                }
            }
        }
    }
    pair(&mut text, 0, "SECTION");
    pair(&mut text, 2, "HEADER");
    pair(&mut text, 9, "$ACADVER");
    pair(&mut text, 1, "AC1009");
    pair(&mut text, 0, "ENDSEC");
    pair(&mut text, 0, "SECTION");
    pair(&mut text, 2, "TABLES");
    table(&mut text, "LTYPE", 1);
    for (code, value) in
        [(0, "LTYPE"), (2, "CONTINUOUS"), (70, "0"), (3, "Solid line"), (72, "65"), (73, "0"), (40, "0.0")]
    {
        pair(&mut text, code, value);
    }
    pair(&mut text, 0, "ENDTAB");
    table(&mut text, "LAYER", layers.len() + 1);
    for (number, layer) in std::iter::once("0").chain(layers.iter().map(String::as_str)).enumerate() {
        let color = if number == 0 { 7 } else { COLORS[(number - 1) % COLORS.len()] };
        pair(&mut text, 0, "LAYER");
        pair(&mut text, 2, layer);
        pair(&mut text, 70, "0");
        pair(&mut text, 62, &color.to_string());
        pair(&mut text, 6, "CONTINUOUS");
    }
    pair(&mut text, 0, "ENDTAB");
    table(&mut text, "APPID", 1);
    for (code, value) in [(0, "APPID"), (2, APPLICATION), (70, "0"), (0, "ENDTAB"), (0, "ENDSEC")] {
        pair(&mut text, code, value);
    }
    pair(&mut text, 0, "SECTION");
    pair(&mut text, 2, "ENTITIES");
    text += &entities;
    pair(&mut text, 0, "ENDSEC");
    pair(&mut text, 0, "EOF");
    write_whole(path, text.as_bytes())?;
    Ok(Vec::new())
}

/// A group code and its value, each a line.
fn pair(text: &mut String, code: u16, value: &str) {
    text.push_str(&format!("{code:>3}\n{value}\n"));
}

fn place(text: &mut String, p: &Vec3) {
    // Rust prints the shortest digits that give the same number again.
    for (code, value) in [(10, p.x), (20, p.y), (30, p.z)] {
        pair(text, code, &format!("{value:?}"));
    }
}

fn table(text: &mut String, name: &str, entries: usize) {
    pair(text, 0, "TABLE");
    pair(text, 2, name);
    pair(text, 70, &entries.to_string());
}

fn extend(text: &mut String, data: &[String]) {
    pair(text, 1001, APPLICATION);
    data.iter().for_each(|line| pair(text, 1000, line));
}

/// Some characters are not allowed in names of layers; R12 knows ASCII only.
fn layer_name(class: &str) -> String {
    class
        .chars()
        .flat_map(|c| match c {
            c if "<>/\\\":;?*|=,'`".contains(c) || c.is_control() => vec!['_'],
            c if c.is_ascii() => vec![c],
            c => format!("\\U+{:04X}", c as u32).chars().collect(),
        })
        .collect()
}

fn extended(feature: &Feature) -> Vec<String> {
    let mut lines = vec![format!("id={}", feature.id.map_or("null".into(), |id| id.to_string()))];
    for (name, value) in &feature.attributes {
        // DXF strings are escaped to ASCII by JSON's own escapes, so no code page matters.
        let json = serde_json::to_string(value).expect("plain data");
        let ascii: String = json
            .chars()
            .flat_map(|c| match c.is_ascii() {
                true => vec![c],
                false => {
                    let mut units = [0u16; 2];
                    c.encode_utf16(&mut units)
                        .iter()
                        .flat_map(|u| format!("\\u{u:04x}").chars().collect::<Vec<_>>())
                        .collect()
                }
            })
            .collect();
        lines.push(format!("{name}={ascii}"));
    }
    let mut items = Vec::new();
    for line in lines {
        let mut rest = line.as_str();
        let mut prefix = "";
        loop {
            let mut cut = rest.len().min(TEXT_BYTES);
            while !rest.is_char_boundary(cut) {
                cut -= 1;
            }
            items.push(format!("{prefix}{}", &rest[..cut]));
            rest = &rest[cut..];
            prefix = "+";
            if rest.is_empty() {
                break;
            }
        }
    }
    items
}

/// Id and attributes out of the extended data.
fn attributes(data: &[XData]) -> (Option<i64>, Vec<(String, Value)>) {
    let mut lines: Vec<String> = Vec::new();
    for item in data.iter().filter(|d| d.application_name == APPLICATION).flat_map(|d| &d.items) {
        let XDataItem::Str(text) = item else { continue };
        match (text.strip_prefix('+'), lines.last_mut()) {
            (Some(rest), Some(last)) => last.push_str(rest),
            _ => lines.push(text.clone()),
        }
    }
    let (mut id, mut found) = (None, Vec::new());
    for line in &lines {
        let Some((name, json)) = line.split_once('=') else { continue };
        match name {
            "id" if id.is_none() && found.is_empty() => id = json.parse().ok(),
            _ => found.push((name.to_owned(), serde_json::from_str(json).unwrap_or(Value::Text(json.to_owned())))),
        }
    }
    (id, found)
}

pub(super) fn read(path: &Path) -> Result<VectorFile, Error> {
    let drawing = Drawing::load_file(path).map_err(|e| bad(path, format!("it is not a DXF file that reads: {e}")))?;
    let mut file = VectorFile::default();
    let mut left_out: BTreeMap<String, usize> = BTreeMap::new();
    let mut arcs = 0;
    let vector = |p: &Point| Vec3::new(p.x, p.y, p.z);
    for entity in drawing.entities() {
        let (kind, mut part, closed) = match &entity.specific {
            EntityType::Line(line) => (Kind::Line, vec![vector(&line.p1), vector(&line.p2)], false),
            EntityType::ModelPoint(point) => (Kind::Point, vec![vector(&point.location)], false),
            EntityType::Polyline(line) if !line.is_polyface_mesh() && !line.is_3d_polygon_mesh() => {
                arcs += line.vertices().filter(|v| v.bulge != 0.0).count();
                (Kind::Line, line.vertices().map(|v| vector(&v.location)).collect(), line.is_closed())
            }
            EntityType::LwPolyline(line) => {
                arcs += line.vertices.iter().filter(|v| v.bulge != 0.0).count();
                let part = line.vertices.iter().map(|v| Vec3::new(v.x, v.y, entity.common.elevation)).collect();
                (Kind::Line, part, line.is_closed())
            }
            other => {
                let name = format!("{other:?}");
                let name = name.split(['(', ' ', '{']).next().unwrap_or_default().to_owned();
                *left_out.entry(name).or_insert(0) += 1;
                continue;
            }
        };
        if closed && part.len() > 2 {
            part.push(part[0]);
        }
        if part.is_empty() || (kind == Kind::Line && part.len() < 2) {
            *left_out.entry("line with less than two vertices".into()).or_insert(0) += 1;
            continue;
        }
        let kind = if closed && kind == Kind::Line { Kind::Area } else { kind };
        let (id, attributes) = attributes(&entity.common.x_data);
        let class = entity.common.layer.clone();
        // The parts of a feature follow each other.
        match file.features.last_mut() {
            Some(last) if id.is_some() && (last.id, last.kind, &last.class) == (id, kind, &class) => {
                last.parts.push(part)
            }
            _ => file.features.push(Feature { class, id, attributes, kind, parts: vec![part] }),
        }
    }
    if arcs > 0 {
        let message = format!("{arcs} arcs in polylines are read as straight lines between their ends");
        file.warnings.push(Warning::new("arcs", message));
    }
    for (name, count) in left_out {
        let message = format!("{count} x {name} left out: lines, polylines and points are read");
        file.warnings.push(Warning::new("entity-left-out", message));
    }
    Ok(file)
}
