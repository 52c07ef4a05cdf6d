//! Shapefile: lines, areas or points with Z, one kind a file. Names of attributes have at most 10 characters, text at most
//! 254 bytes; the file tells no reference system. A GeoPackage has none of these limits.

use super::{Column, Shapes, VectorFile, as_text, bad, cannot_hold, columns, partial, stem};
use crate::io::Error;
use crate::linework::{Feature, Kind, Value};
use crate::numeric::Vec3;
use crate::warning::Warning;
use shapefile::dbase::{FieldName, FieldValue, Record, TableWriterBuilder};
use shapefile::{MultipointZ, NO_DATA, PointZ, PolygonRing, PolygonZ, PolylineZ, Reader, Shape, Writer};
use std::path::Path;

/// Longest text of an attribute, bytes.
const TEXT_BYTES: usize = 254;
/// Name of the attribute that holds the id, and the one that holds the class.
const ID: &str = "id";
const CLASS: &str = "class";

pub(super) fn write(path: &Path, shapes: &Shapes) -> Result<Vec<Warning>, Error> {
    let features: Vec<&Feature> = shapes.features.iter().collect();
    let Some(kind) = features.first().map(|f| f.kind) else {
        return Err(cannot_hold(path, "a Shapefile without features has no kind"));
    };
    if features.iter().any(|f| f.kind != kind) {
        return Err(cannot_hold(
            path,
            "a Shapefile holds one kind of shape, and there are points, lines or areas mixed",
        ));
    }
    let mut warnings = Vec::new();
    let attributes = columns(&features);
    let mut names: Vec<String> = vec![ID.into(), CLASS.into()];
    let mut table = TableWriterBuilder::new()
        .add_numeric_field(field(path, ID)?, 18, 0)
        .add_character_field(field(path, CLASS)?, TEXT_BYTES as u8);
    for (name, column) in &attributes {
        let mut short: String = name.chars().filter(char::is_ascii).take(10).collect();
        let mut number = 1;
        while short.is_empty() || names.iter().any(|n| n.eq_ignore_ascii_case(&short)) {
            number += 1;
            short = format!("{}_{number}", name.chars().filter(char::is_ascii).take(7).collect::<String>());
        }
        if short != *name {
            let message = format!("the attribute '{name}' is called '{short}' in the Shapefile");
            warnings.push(Warning::new("renamed-attribute", message));
        }
        table = match column {
            Column::Boolean => table.add_logical_field(field(path, &short)?),
            Column::Integer => table.add_numeric_field(field(path, &short)?, 18, 0),
            Column::Real => table.add_numeric_field(field(path, &short)?, 24, 12),
            Column::Text => table.add_character_field(field(path, &short)?, TEXT_BYTES as u8),
        };
        names.push(short);
    }
    let temporary = partial(path);
    let failed = |e: String| Error::Write { path: path.to_owned(), source: std::io::Error::other(e) };
    {
        let mut writer = Writer::from_path(&temporary, table).map_err(|e| failed(e.to_string()))?;
        for f in &features {
            let mut record = Record::default();
            record.insert(ID.into(), FieldValue::Numeric(f.id.map(|id| id as f64)));
            record.insert(CLASS.into(), FieldValue::Character(Some(f.class.clone())));
            for ((name, column), short) in attributes.iter().zip(&names[2..]) {
                let value = f.attribute(name).unwrap_or(&Value::Null);
                let text = as_text(value);
                if text.as_ref().is_some_and(|t| *column == Column::Text && t.len() > TEXT_BYTES) {
                    let cause = format!("the attribute '{name}' of {} is longer than {TEXT_BYTES} bytes", f.name());
                    return Err(cannot_hold(path, cause));
                }
                let value = match (column, value) {
                    (Column::Boolean, Value::Boolean(b)) => FieldValue::Logical(Some(*b)),
                    (Column::Boolean, _) => FieldValue::Logical(None),
                    (Column::Integer | Column::Real, Value::Integer(i)) => FieldValue::Numeric(Some(*i as f64)),
                    (Column::Integer | Column::Real, Value::Real(r)) => FieldValue::Numeric(Some(*r)),
                    (Column::Integer | Column::Real, _) => FieldValue::Numeric(None),
                    (Column::Text, _) => FieldValue::Character(text),
                };
                record.insert(short.clone(), value);
            }
            let point = |p: &Vec3| PointZ::new(p.x, p.y, p.z, NO_DATA);
            let part = |part: &Vec<Vec3>| part.iter().map(point).collect::<Vec<_>>();
            let written = match kind {
                Kind::Point if f.parts.len() == 1 && features.iter().all(|f| f.parts.len() == 1) => {
                    writer.write_shape_and_record(&point(&f.parts[0][0]), &record)
                }
                Kind::Point => {
                    let all = f.parts.iter().map(|p| point(&p[0])).collect();
                    writer.write_shape_and_record(&MultipointZ::new(all), &record)
                }
                Kind::Line => {
                    writer.write_shape_and_record(&PolylineZ::with_parts(f.parts.iter().map(part).collect()), &record)
                }
                Kind::Area => {
                    let mut rings: Vec<PolygonRing<PointZ>> = vec![PolygonRing::Outer(part(&f.parts[0]))];
                    rings.extend(f.parts[1..].iter().map(|p| PolygonRing::Inner(part(p))));
                    writer.write_shape_and_record(&PolygonZ::with_rings(rings), &record)
                }
            };
            written.map_err(|e| failed(e.to_string()))?;
        }
    }
    for extension in ["shx", "dbf", "shp"] {
        std::fs::rename(temporary.with_extension(extension), path.with_extension(extension))
            .map_err(|source| Error::Write { path: path.with_extension(extension), source })?;
    }
    let encoding = path.with_extension("cpg");
    std::fs::write(&encoding, "UTF-8\n").map_err(|source| Error::Write { path: encoding, source })?;
    Ok(warnings)
}

fn field(path: &Path, name: &str) -> Result<FieldName, Error> {
    FieldName::try_from(name).map_err(|_| cannot_hold(path, format!("'{name}' is no name for a field")))
}

pub(super) fn read(path: &Path) -> Result<VectorFile, Error> {
    let failed = |e: shapefile::Error| bad(path, format!("it is not a Shapefile that reads (.shp, .shx, .dbf): {e}"));
    let mut reader = Reader::from_path(path).map_err(failed)?;
    let mut file = VectorFile::default();
    let mut empty = 0;
    for row in reader.read().map_err(failed)? {
        let (shape, record) = row;
        let (kind, parts) = parts(shape);
        let (mut id, mut class, mut attributes) = (None, stem(path), Vec::new());
        for (name, value) in record {
            let value = match value {
                FieldValue::Character(text) => text.map_or(Value::Null, Value::Text),
                FieldValue::Memo(text) => Value::Text(text),
                FieldValue::Numeric(number) => number.map_or(Value::Null, whole_or_real),
                FieldValue::Float(number) => number.map_or(Value::Null, |n| whole_or_real(f64::from(n))),
                FieldValue::Double(n) | FieldValue::Currency(n) => Value::Real(n),
                FieldValue::Integer(i) => Value::Integer(i64::from(i)),
                FieldValue::Logical(b) => b.map_or(Value::Null, Value::Boolean),
                FieldValue::Date(date) => date
                    .map_or(Value::Null, |d| Value::Text(format!("{:04}-{:02}-{:02}", d.year(), d.month(), d.day()))),
                FieldValue::DateTime(t) => Value::Text(format!("{t:?}")),
            };
            match (name.as_str(), value) {
                (ID, Value::Integer(number)) => id = Some(number),
                (CLASS, Value::Text(text)) => class = text,
                (_, value) => attributes.push((name, value)),
            }
        }
        // The fields of a record come without order.
        attributes.sort_by(|a, b| a.0.cmp(&b.0));
        if parts.is_empty() {
            empty += 1;
            continue;
        }
        file.features.push(Feature { class, id, attributes, kind, parts });
    }
    if empty > 0 {
        let message = format!("{empty} records hold no points, lines or areas and were left out");
        file.warnings.push(Warning::new("no-geometry", message));
    }
    Ok(file)
}

fn whole_or_real(number: f64) -> Value {
    if number.fract() == 0.0 && number.abs() < 9e15 { Value::Integer(number as i64) } else { Value::Real(number) }
}

fn parts(shape: Shape) -> (Kind, Vec<Vec<Vec3>>) {
    let flat = |x: f64, y: f64| Vec3::new(x, y, 0.0);
    let (kind, parts): (Kind, Vec<Vec<Vec3>>) = match shape {
        Shape::Point(p) => (Kind::Point, vec![vec![flat(p.x, p.y)]]),
        Shape::PointM(p) => (Kind::Point, vec![vec![flat(p.x, p.y)]]),
        Shape::PointZ(p) => (Kind::Point, vec![vec![Vec3::new(p.x, p.y, p.z)]]),
        Shape::Multipoint(m) => (Kind::Point, m.points().iter().map(|p| vec![flat(p.x, p.y)]).collect()),
        Shape::MultipointM(m) => (Kind::Point, m.points().iter().map(|p| vec![flat(p.x, p.y)]).collect()),
        Shape::MultipointZ(m) => (Kind::Point, m.points().iter().map(|p| vec![Vec3::new(p.x, p.y, p.z)]).collect()),
        Shape::Polyline(l) => {
            (Kind::Line, l.parts().iter().map(|part| part.iter().map(|p| flat(p.x, p.y)).collect()).collect())
        }
        Shape::PolylineM(l) => {
            (Kind::Line, l.parts().iter().map(|part| part.iter().map(|p| flat(p.x, p.y)).collect()).collect())
        }
        Shape::PolylineZ(l) => {
            (Kind::Line, l.parts().iter().map(|part| part.iter().map(|p| Vec3::new(p.x, p.y, p.z)).collect()).collect())
        }
        Shape::Polygon(a) => {
            (Kind::Area, a.rings().iter().map(|r| r.points().iter().map(|p| flat(p.x, p.y)).collect()).collect())
        }
        Shape::PolygonM(a) => {
            (Kind::Area, a.rings().iter().map(|r| r.points().iter().map(|p| flat(p.x, p.y)).collect()).collect())
        }
        Shape::PolygonZ(a) => (
            Kind::Area,
            a.rings().iter().map(|r| r.points().iter().map(|p| Vec3::new(p.x, p.y, p.z)).collect()).collect(),
        ),
        Shape::NullShape | Shape::Multipatch(_) => (Kind::Line, Vec::new()),
    };
    (kind, parts.into_iter().filter(|p| !p.is_empty()).collect())
}
