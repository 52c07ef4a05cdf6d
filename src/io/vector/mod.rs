//! Linework in vector files: GeoPackage, GeoJSON, DXF and Shapefile, one file per format.
//!
//! Coordinates stay as the file has them: map metres or scan coordinates, [`Space`] tells which. A GeoPackage holds both:
//! two layers for each feature class, `<class>_map` and `<class>_scan`, with the same ids. The other formats hold one.

mod dxf;
mod geojson;
mod geopackage;
mod shapefile;
mod wkb;

use super::Error;
use crate::linework::{Feature, Value};
use crate::warning::Warning;
use std::collections::BTreeMap;
use std::path::Path;

/// What the coordinates of linework mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Space {
    /// Chainage, girth and distance from the surface, metres.
    Map,
    /// Coordinates of the scan.
    Scan,
}

impl Space {
    /// What layers of this space end on in a GeoPackage.
    pub fn suffix(self) -> &'static str {
        match self {
            Self::Map => "_map",
            Self::Scan => "_scan",
        }
    }
}

/// Features of one space.
#[derive(Clone, Copy, Debug)]
pub struct Shapes<'a> {
    /// Their space.
    pub space: Space,
    /// The features, with ids.
    pub features: &'a [Feature],
}

/// Linework that was read.
#[derive(Clone, Debug, Default)]
pub struct VectorFile {
    /// The features; each has an id that is its own within its class.
    pub features: Vec<Feature>,
    /// What was left out or changed.
    pub warnings: Vec<Warning>,
}

/// The extensions that are read and written.
pub const EXTENSIONS: [&str; 5] = ["gpkg", "geojson", "json", "dxf", "shp"];

fn extension(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn unknown_format(path: &Path) -> Error {
    Error::Unsupported {
        path: path.to_owned(),
        cause: "linework is read and written as GeoPackage, GeoJSON, DXF or Shapefile".into(),
        remedy: "use a name that ends on .gpkg, .geojson, .dxf or .shp".into(),
    }
}

/// Reads linework; of a GeoPackage the layers of the wanted space, or all layers when none is marked.
///
/// # Errors
/// [`Error`] with the file, the feature and the cause.
pub fn read(path: &Path, wanted: Space) -> Result<VectorFile, Error> {
    let known = EXTENSIONS.contains(&extension(path).as_str());
    if known && let Err(source) = std::fs::metadata(path) {
        return Err(Error::Read { path: path.to_owned(), source });
    }
    let mut file = match extension(path).as_str() {
        "gpkg" => geopackage::read(path, wanted)?,
        "geojson" | "json" => geojson::read(path)?,
        "dxf" => dxf::read(path)?,
        "shp" => shapefile::read(path)?,
        _ => return Err(unknown_format(path)),
    };
    if file.features.is_empty() {
        let told: Vec<&str> = file.warnings.iter().map(|w| w.message.as_str()).collect();
        return Err(bad(path, format!("it holds no points, lines or areas {}", told.join("; ")).trim_end()));
    }
    number(&mut file);
    Ok(file)
}

/// Writes linework under a temporary name and puts it in its place. A GeoPackage takes both spaces, every other format
/// the first.
///
/// # Errors
/// [`Error`] with the file and what it cannot hold.
pub fn write(path: &Path, shapes: &[Shapes]) -> Result<Vec<Warning>, Error> {
    match extension(path).as_str() {
        "gpkg" => geopackage::write(path, shapes),
        "geojson" | "json" => geojson::write(path, &shapes[0]),
        "dxf" => dxf::write(path, &shapes[0]),
        "shp" => shapefile::write(path, &shapes[0]),
        _ => Err(unknown_format(path)),
    }
}

/// Gives features without an id, or with one that is taken, the next free number of their class.
fn number(file: &mut VectorFile) {
    let mut used: BTreeMap<String, Vec<i64>> = BTreeMap::new();
    let mut open = Vec::new();
    for (i, feature) in file.features.iter().enumerate() {
        let ids = used.entry(feature.class.clone()).or_default();
        match feature.id {
            Some(id) if !ids.contains(&id) => ids.push(id),
            given => open.push((i, given)),
        }
    }
    for (i, given) in open {
        let feature = &mut file.features[i];
        let ids = used.entry(feature.class.clone()).or_default();
        let id = ids.iter().copied().max().unwrap_or(0) + 1;
        ids.push(id);
        feature.id = Some(id);
        if let Some(given) = given {
            let message = format!("a second feature of class {} has the id {given}; it is now {id}", feature.class);
            file.warnings.push(Warning::new("doubled-id", message));
        }
    }
}

fn bad(path: &Path, cause: impl Into<String>) -> Error {
    Error::BadInput {
        path: path.to_owned(),
        cause: cause.into(),
        remedy: "open it in QGIS and save it again, or take another format".into(),
    }
}

fn cannot_hold(path: &Path, cause: impl Into<String>) -> Error {
    Error::Output { path: path.to_owned(), cause: cause.into(), remedy: "write a GeoPackage (.gpkg) instead".into() }
}

/// Name of the file without folder and extension: the class of what has no other.
fn stem(path: &Path) -> String {
    path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_else(|| "linework".into())
}

/// Type of a column that holds all values of an attribute.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Column {
    Boolean,
    Integer,
    Real,
    Text,
}

/// The attributes of features in the order in which they appear, with a type that holds all their values.
fn columns(features: &[&Feature]) -> Vec<(String, Column)> {
    let mut columns: Vec<(String, Option<Column>)> = Vec::new();
    for (name, value) in features.iter().flat_map(|f| &f.attributes) {
        let own = match value {
            Value::Null => None,
            Value::Boolean(_) => Some(Column::Boolean),
            Value::Integer(_) => Some(Column::Integer),
            Value::Real(_) => Some(Column::Real),
            Value::Text(_) => Some(Column::Text),
        };
        match columns.iter_mut().find(|(n, _)| n == name) {
            None => columns.push((name.clone(), own)),
            Some((_, column)) => {
                *column = match (*column, own) {
                    (None, one) | (one, None) => one,
                    (Some(a), Some(b)) if a == b => Some(a),
                    (Some(Column::Integer | Column::Real), Some(Column::Integer | Column::Real)) => Some(Column::Real),
                    _ => Some(Column::Text),
                }
            }
        }
    }
    columns.into_iter().map(|(name, column)| (name, column.unwrap_or(Column::Text))).collect()
}

/// A value as text, for columns of mixed types.
fn as_text(value: &Value) -> Option<String> {
    match value {
        Value::Null => None,
        Value::Boolean(b) => Some(b.to_string()),
        Value::Integer(i) => Some(i.to_string()),
        Value::Real(r) => Some(r.to_string()),
        Value::Text(t) => Some(t.clone()),
    }
}

/// A name for a file that is not finished, with the same extension.
fn partial(path: &Path) -> std::path::PathBuf {
    let mut name = std::ffi::OsString::from(".partial-");
    name.push(path.file_name().unwrap_or_default());
    path.with_file_name(name)
}

fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let temporary = partial(path);
    std::fs::write(&temporary, bytes)
        .and_then(|()| std::fs::rename(&temporary, path))
        .map_err(|source| Error::Write { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linework::Kind;
    use crate::numeric::Vec3;

    fn feature(class: &str, id: i64, kind: Kind, parts: Vec<Vec<Vec3>>) -> Feature {
        let attributes = vec![
            ("note".to_owned(), Value::Text("fault, with clay — 5 mm".into())),
            ("aperture_m".to_owned(), Value::Real(0.005)),
            ("count".to_owned(), Value::Integer(3)),
            ("wet".to_owned(), Value::Boolean(true)),
        ];
        Feature { class: class.into(), id: Some(id), attributes, kind, parts }
    }

    fn lines() -> Vec<Feature> {
        let far = |x: f64, y: f64, z: f64| Vec3::new(568_200.123_456 + x, 6_010_935.654_321 + y, z);
        vec![
            feature("joints", 4, Kind::Line, vec![vec![far(0.0, 0.0, 1.5), far(1.25, 0.001, 2.5)]]),
            feature(
                "joints",
                9,
                Kind::Line,
                vec![
                    vec![far(0.0, 0.5, 1.0), far(1.0, 2.0, 3.0), far(1.0, 2.5, 3.5)],
                    vec![far(3.0, 0.5, 1.0), far(4.0, 2.0, 3.0)],
                ],
            ),
        ]
    }

    fn round_trip(name: &str, features: &[Feature]) -> VectorFile {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        write(&path, &[Shapes { space: Space::Scan, features }]).unwrap();
        assert_eq!(
            std::fs::read_dir(folder.path())
                .unwrap()
                .filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().starts_with('.'))
                .count(),
            0
        );
        read(&path, Space::Scan).unwrap()
    }

    #[test]
    fn every_format_keeps_shapes_ids_and_attributes() {
        for name in ["a.gpkg", "a.geojson", "a.dxf", "a.shp"] {
            let given = lines();
            let back = round_trip(name, &given).features;
            assert_eq!(back.len(), given.len(), "{name}");
            for (a, b) in given.iter().zip(&back) {
                assert_eq!((a.id, a.kind, a.parts.len()), (b.id, b.kind, b.parts.len()), "{name}");
                for (p, q) in a.parts.iter().flatten().zip(b.parts.iter().flatten()) {
                    assert!((p - q).amax() < 1e-8, "{name}: {p} {q}");
                }
                for (key, value) in &a.attributes {
                    let found = b.attributes.iter().find(|(k, _)| k.eq_ignore_ascii_case(key));
                    assert_eq!(found.map(|(_, v)| v), Some(value), "{name}: {key} of {:?}", b.attributes);
                }
            }
        }
    }

    #[test]
    fn points_and_areas_survive_where_the_format_has_them() {
        let ring = |x: f64| {
            [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)].map(|(a, b)| Vec3::new(x + a, b, 0.5)).to_vec()
        };
        let bolt = feature("bolts", 1, Kind::Point, vec![vec![Vec3::new(1.0, 2.0, 3.0)]]);
        let area = feature("wet", 1, Kind::Area, vec![ring(0.0)]);
        for name in ["a.gpkg", "a.geojson", "a.dxf"] {
            let back = round_trip(name, &[bolt.clone(), area.clone()]).features;
            assert_eq!(back.len(), 2, "{name}");
            let point = back.iter().find(|f| f.kind == Kind::Point).unwrap();
            assert_eq!(point.parts, bolt.parts, "{name}");
            let other = back.iter().find(|f| f.kind != Kind::Point).unwrap();
            assert_eq!(other.parts, area.parts, "{name}");
        }
        let folder = tempfile::tempdir().unwrap();
        let shapes = [bolt, area];
        let error =
            write(&folder.path().join("a.shp"), &[Shapes { space: Space::Map, features: &shapes }]).unwrap_err();
        assert!(error.to_string().contains("gpkg"), "{error}");
    }

    #[test]
    fn a_geopackage_holds_both_spaces_under_the_same_ids() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("both.gpkg");
        let (scan, mut map) = (lines(), lines());
        for p in map.iter_mut().flat_map(|f| &mut f.parts).flatten() {
            *p = Vec3::new(p.x - 568_200.0, 1.0, 0.0);
        }
        write(&path, &[Shapes { space: Space::Scan, features: &scan }, Shapes { space: Space::Map, features: &map }])
            .unwrap();
        let (on_map, in_scan) = (read(&path, Space::Map).unwrap(), read(&path, Space::Scan).unwrap());
        assert_eq!((&on_map.features, &in_scan.features), (&map, &scan));
        assert_eq!(on_map.features[0].class, "joints");
    }

    #[test]
    fn broken_files_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["x.gpkg", "x.geojson", "x.dxf", "x.shp", "x.kml"] {
            let path = folder.path().join(name);
            std::fs::write(&path, b"no such format").unwrap();
            let error = read(&path, Space::Map).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
        assert!(matches!(read(&folder.path().join("none.gpkg"), Space::Map), Err(Error::Read { .. })));
    }
}
