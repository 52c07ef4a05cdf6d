//! GeoJSON. Readers take its coordinates for degrees (RFC 7946), which tunnel coordinates are not: a GeoPackage is the
//! better file to hand on; GeoJSON is what scripts and web pages like.

use super::{Shapes, Space, VectorFile, bad, stem, write_whole};
use crate::io::Error;
use crate::linework::{Feature, Kind, Value};
use crate::numeric::Vec3;
use crate::warning::Warning;
use geojson::feature::Id;
use geojson::{GeoJson, GeometryValue, Position};
use serde_json::json;
use std::path::Path;

/// Name of the property that holds the class.
const CLASS: &str = "class";

pub(super) fn write(path: &Path, shapes: &Shapes) -> Result<Vec<Warning>, Error> {
    let coordinates = |part: &[Vec3]| part.iter().map(|p| json!([p.x, p.y, p.z])).collect::<Vec<_>>();
    let features: Vec<serde_json::Value> = shapes
        .features
        .iter()
        .map(|f| {
            let parts: Vec<Vec<serde_json::Value>> = f.parts.iter().map(|p| coordinates(p)).collect();
            let geometry = match (f.kind, parts.len()) {
                (Kind::Point, 1) => json!({ "type": "Point", "coordinates": parts[0][0] }),
                (Kind::Point, _) => {
                    json!({ "type": "MultiPoint", "coordinates": parts.iter().map(|p| &p[0]).collect::<Vec<_>>() })
                }
                (Kind::Line, 1) => json!({ "type": "LineString", "coordinates": parts[0] }),
                (Kind::Line, _) => json!({ "type": "MultiLineString", "coordinates": parts }),
                (Kind::Area, _) => json!({ "type": "Polygon", "coordinates": parts }),
            };
            let mut properties = serde_json::Map::new();
            properties.insert(CLASS.into(), json!(f.class));
            for (name, value) in &f.attributes {
                properties.insert(name.clone(), json!(value));
            }
            json!({ "type": "Feature", "id": f.id, "properties": properties, "geometry": geometry })
        })
        .collect();
    let space = match shapes.space {
        Space::Map => "unwrapped tunnel map: chainage, girth, distance from the surface, metres",
        Space::Scan => "coordinates of the scan",
    };
    let collection = json!({ "type": "FeatureCollection", "coordinates_are": space, "features": features });
    write_whole(path, format!("{collection}\n").as_bytes())?;
    Ok(Vec::new())
}

pub(super) fn read(path: &Path) -> Result<VectorFile, Error> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    let json: GeoJson = text.parse().map_err(|e| bad(path, format!("it is not GeoJSON: {e}")))?;
    let features = match json {
        GeoJson::FeatureCollection(collection) => collection.features,
        GeoJson::Feature(feature) => vec![feature],
        GeoJson::Geometry(geometry) => vec![geojson::Feature { geometry: Some(geometry), ..Default::default() }],
    };
    let mut file = VectorFile::default();
    let mut empty = 0;
    for (number, feature) in features.into_iter().enumerate() {
        let wrong = |what: &str| bad(path, format!("feature {number}: {what}"));
        let mut class = stem(path);
        let mut attributes = Vec::new();
        for (name, value) in feature.properties.into_iter().flatten() {
            let value = match value {
                serde_json::Value::Null => Value::Null,
                serde_json::Value::Bool(b) => Value::Boolean(b),
                serde_json::Value::Number(n) => {
                    n.as_i64().map_or_else(|| Value::Real(n.as_f64().unwrap_or(f64::NAN)), Value::Integer)
                }
                serde_json::Value::String(s) => Value::Text(s),
                other => Value::Text(other.to_string()),
            };
            match value {
                Value::Text(text) if name == CLASS => class = text,
                value => attributes.push((name, value)),
            }
        }
        let id = match feature.id {
            Some(Id::Number(n)) => n.as_i64(),
            Some(Id::String(text)) => {
                let id = text.parse().ok();
                if id.is_none() {
                    attributes.push(("id".into(), Value::Text(text)));
                }
                id
            }
            None => None,
        };
        let Some(geometry) = feature.geometry else {
            empty += 1;
            continue;
        };
        let run = |positions: &[Position]| -> Result<Vec<Vec3>, Error> {
            positions
                .iter()
                .map(|p| match p.as_slice() {
                    [x, y] => Ok(Vec3::new(*x, *y, 0.0)),
                    [x, y, z, ..] => Ok(Vec3::new(*x, *y, *z)),
                    _ => Err(wrong("a position has fewer than two numbers")),
                })
                .collect()
        };
        let runs = |list: &[Vec<Position>]| list.iter().map(|p| run(p)).collect::<Result<Vec<_>, _>>();
        let (kind, parts) = match &geometry.value {
            GeometryValue::Point { coordinates } => (Kind::Point, vec![run(std::slice::from_ref(coordinates))?]),
            GeometryValue::MultiPoint { coordinates } => {
                (Kind::Point, run(coordinates)?.into_iter().map(|p| vec![p]).collect())
            }
            GeometryValue::LineString { coordinates } => (Kind::Line, vec![run(coordinates)?]),
            GeometryValue::MultiLineString { coordinates } => (Kind::Line, runs(coordinates)?),
            GeometryValue::Polygon { coordinates } => (Kind::Area, runs(coordinates)?),
            GeometryValue::MultiPolygon { coordinates } => {
                let mut rings = Vec::new();
                for polygon in coordinates {
                    rings.extend(runs(polygon)?);
                }
                (Kind::Area, rings)
            }
            GeometryValue::GeometryCollection { .. } => return Err(wrong("collections of geometries are not read")),
        };
        let parts: Vec<Vec<Vec3>> = parts.into_iter().filter(|p| !p.is_empty()).collect();
        if parts.is_empty() {
            empty += 1;
            continue;
        }
        file.features.push(Feature { class, id, attributes, kind, parts });
    }
    if empty > 0 {
        file.warnings.push(Warning::new("no-geometry", format!("{empty} features have no geometry and were left out")));
    }
    Ok(file)
}
