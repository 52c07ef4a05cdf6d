//! GeoPackage 1.3 (an SQLite file): the format in which map and scan geometry stay together.
//!
//! Each feature class is two tables, `<class>_map` and `<class>_scan`, with the same `fid`. The map lies in a local
//! engineering reference system; scan coordinates are registered as undefined Cartesian (-1), because a scan rarely
//! tells its reference system in a form that may be trusted.
//! Reference: OGC 12-128r17, GeoPackage Encoding Standard 1.3.

use super::{Column, Shapes, Space, VectorFile, as_text, bad, cannot_hold, columns, partial, wkb};
use crate::io::Error;
use crate::linework::{Feature, Kind, Value};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags, params, params_from_iter};
use std::path::Path;

/// Number of the reference system of the map in the file.
const MAP_SRS: i32 = 100_000;
const MAP_WKT: &str = "LOCAL_CS[\"Unwrapped tunnel map (chainage, girth)\",UNIT[\"metre\",1],AXIS[\"Chainage\",EAST],AXIS[\"Girth\",NORTH]]";
/// Date of content, fixed so that the same linework gives the same bytes.
const LAST_CHANGE: &str = "2000-01-01T00:00:00.000Z";

const TABLES: &str = "
PRAGMA application_id = 1196444487;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
INSERT INTO gpkg_spatial_ref_sys VALUES ('Undefined Cartesian SRS', -1, 'NONE', -1, 'undefined',
  'undefined Cartesian coordinate reference system');
INSERT INTO gpkg_spatial_ref_sys VALUES ('Undefined geographic SRS', 0, 'NONE', 0, 'undefined',
  'undefined geographic coordinate reference system');
INSERT INTO gpkg_spatial_ref_sys VALUES ('WGS 84 geodetic', 4326, 'EPSG', 4326,
  'GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563,AUTHORITY[\"EPSG\",\"7030\"]],AUTHORITY[\"EPSG\",\"6326\"]],PRIMEM[\"Greenwich\",0,AUTHORITY[\"EPSG\",\"8901\"]],UNIT[\"degree\",0.0174532925199433,AUTHORITY[\"EPSG\",\"9122\"]],AUTHORITY[\"EPSG\",\"4326\"]]',
  'longitude/latitude coordinates in decimal degrees');";

pub(super) fn write(path: &Path, shapes: &[Shapes]) -> Result<Vec<Warning>, Error> {
    let temporary = partial(path);
    std::fs::remove_file(&temporary).ok();
    let failed = |e: rusqlite::Error| Error::Write { path: path.to_owned(), source: std::io::Error::other(e) };
    let mut warnings = Vec::new();
    let result = (|| {
        let mut database = Connection::open(&temporary).map_err(failed)?;
        database.execute_batch("PRAGMA journal_mode = MEMORY; PRAGMA synchronous = OFF;").map_err(failed)?;
        let transaction = database.transaction().map_err(failed)?;
        transaction.execute_batch(TABLES).map_err(failed)?;
        transaction
            .execute(
                "INSERT INTO gpkg_spatial_ref_sys VALUES ('Unwrapped tunnel map', ?1, 'NONE', ?1, ?2,
                 'chainage to the right, girth upwards from the crown, metres, seen from inside')",
                params![MAP_SRS, MAP_WKT],
            )
            .map_err(failed)?;
        for shapes in shapes {
            let mut classes: Vec<(&str, Kind)> = Vec::new();
            for f in shapes.features {
                if !classes.contains(&(f.class.as_str(), f.kind)) {
                    classes.push((&f.class, f.kind));
                }
            }
            for &(class, kind) in &classes {
                // A table holds one kind of geometry; a class of several kinds has a table for each.
                let mixed = classes.iter().filter(|(c, _)| *c == class).count() > 1;
                let kind_name = ["", "_points", "_lines", "_areas"][if mixed { kind as usize + 1 } else { 0 }];
                let table = format!("{class}{kind_name}{}", shapes.space.suffix());
                let members: Vec<&Feature> =
                    shapes.features.iter().filter(|f| f.class == class && f.kind == kind).collect();
                write_table(&transaction, path, &table, shapes.space, kind, &members, &mut warnings)?;
            }
        }
        transaction.commit().map_err(failed)?;
        drop(database);
        std::fs::rename(&temporary, path).map_err(|source| Error::Write { path: path.to_owned(), source })
    })();
    if result.is_err() {
        std::fs::remove_file(&temporary).ok();
    }
    result.map(|()| warnings)
}

fn quoted(name: &str) -> String {
    format!("\"{}\"", name.replace('"', "\"\""))
}

fn write_table(
    database: &Connection,
    path: &Path,
    table: &str,
    space: Space,
    kind: Kind,
    features: &[&Feature],
    warnings: &mut Vec<Warning>,
) -> Result<(), Error> {
    let failed = |e: rusqlite::Error| Error::Write { path: path.to_owned(), source: std::io::Error::other(e) };
    let multi = kind != Kind::Area && features.iter().any(|f| f.parts.len() > 1);
    let type_name = match (kind, multi) {
        (Kind::Point, false) => "POINT",
        (Kind::Point, true) => "MULTIPOINT",
        (Kind::Line, false) => "LINESTRING",
        (Kind::Line, true) => "MULTILINESTRING",
        (Kind::Area, _) => "POLYGON",
    };
    let srs = if space == Space::Map { MAP_SRS } else { -1 };
    let attributes = columns(features);
    // SQLite does not tell small from capital letters in names, and two names are taken.
    let mut names: Vec<String> = vec!["fid".into(), "geom".into()];
    for (name, _) in &attributes {
        let mut free = name.clone();
        while names.iter().any(|n| n.eq_ignore_ascii_case(&free)) {
            free.push('_');
        }
        if free != *name {
            let message =
                format!("the attribute '{name}' of {table} is called '{free}' in the GeoPackage: its name is taken");
            warnings.push(Warning::new("renamed-attribute", message));
        }
        names.push(free);
    }
    let mut create = format!("CREATE TABLE {} (fid INTEGER PRIMARY KEY NOT NULL, geom {type_name}", quoted(table));
    for (name, (_, column)) in names[2..].iter().zip(&attributes) {
        let sql = match column {
            Column::Boolean => "BOOLEAN",
            Column::Integer => "INTEGER",
            Column::Real => "REAL",
            Column::Text => "TEXT",
        };
        create += &format!(", {} {sql}", quoted(name));
    }
    database.execute_batch(&(create + ")")).map_err(failed)?;
    let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
    for p in features.iter().flat_map(|f| &f.parts).flatten() {
        low = low.inf(p);
        high = high.sup(p);
    }
    let identifier = match space {
        Space::Map => "on the map: chainage, girth, distance from the surface (m)",
        Space::Scan => "in the coordinates of the scan",
    };
    database
        .execute(
            "INSERT INTO gpkg_contents VALUES (?1, 'features', ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
            params![table, identifier, LAST_CHANGE, low.x, low.y, high.x, high.y, srs],
        )
        .map_err(failed)?;
    database
        .execute("INSERT INTO gpkg_geometry_columns VALUES (?1, 'geom', ?2, ?3, 1, 0)", params![table, type_name, srs])
        .map_err(failed)?;
    let marks: Vec<String> = (1..=names.len()).map(|i| format!("?{i}")).collect();
    let mut insert =
        database.prepare(&format!("INSERT INTO {} VALUES ({})", quoted(table), marks.join(", "))).map_err(failed)?;
    for feature in features {
        let id = feature.id.ok_or_else(|| cannot_hold(path, format!("{} has no id", feature.name())))?;
        let mut row: Vec<rusqlite::types::Value> = vec![id.into(), blob(feature, kind, multi, srs).into()];
        for (name, column) in &attributes {
            row.push(match (feature.attribute(name).unwrap_or(&Value::Null), column) {
                (Value::Null, _) => rusqlite::types::Value::Null,
                (Value::Boolean(b), Column::Boolean) => i64::from(*b).into(),
                (Value::Integer(i), Column::Integer) => (*i).into(),
                (Value::Integer(i), Column::Real) => (*i as f64).into(),
                (Value::Real(r), Column::Real) => (*r).into(),
                (other, _) => as_text(other).expect("not null").into(),
            });
        }
        insert.execute(params_from_iter(row)).map_err(failed)?;
    }
    Ok(())
}

/// Header with envelope, and the geometry.
fn blob(feature: &Feature, kind: Kind, multi: bool, srs: i32) -> Vec<u8> {
    let mut bytes = vec![b'G', b'P', 0, 0b0000_0011];
    bytes.extend(srs.to_le_bytes());
    let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
    for p in feature.parts.iter().flatten() {
        low = low.inf(p);
        high = high.sup(p);
    }
    [low.x, high.x, low.y, high.y].iter().for_each(|c| bytes.extend(c.to_le_bytes()));
    bytes.extend(wkb::write(kind, &feature.parts, multi));
    bytes
}

pub(super) fn read(path: &Path, wanted: Space) -> Result<VectorFile, Error> {
    let failed = |e: rusqlite::Error| bad(path, format!("it is no GeoPackage that reads: {e}"));
    let database = Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_ONLY).map_err(failed)?;
    let mut layers: Vec<(String, String)> = Vec::new();
    {
        let mut query = database
            .prepare(
                "SELECT g.table_name, g.column_name FROM gpkg_geometry_columns g JOIN gpkg_contents c
                 ON g.table_name = c.table_name WHERE c.data_type = 'features' ORDER BY c.rowid",
            )
            .map_err(failed)?;
        let rows = query.query_map([], |r| Ok((r.get(0)?, r.get(1)?))).map_err(failed)?;
        for row in rows {
            layers.push(row.map_err(failed)?);
        }
    }
    let marked = |space: Space| layers.iter().any(|(table, _)| table.ends_with(space.suffix()));
    let both = marked(Space::Map) || marked(Space::Scan);
    let mut file = VectorFile::default();
    for (table, geometry) in &layers {
        let class = match table.strip_suffix(wanted.suffix()) {
            Some(class) => class,
            None if both => {
                if !table.ends_with(Space::Map.suffix()) && !table.ends_with(Space::Scan.suffix()) {
                    let message = format!(
                        "the layer {table} was left out: its name does not end on {} or {}",
                        Space::Map.suffix(),
                        Space::Scan.suffix()
                    );
                    file.warnings.push(Warning::new("layer-left-out", message));
                }
                continue;
            }
            None => table,
        };
        read_table(&database, path, table, geometry, class, &mut file)?;
    }
    Ok(file)
}

fn read_table(
    database: &Connection,
    path: &Path,
    table: &str,
    geometry: &str,
    class: &str,
    file: &mut VectorFile,
) -> Result<(), Error> {
    let failed = |e: rusqlite::Error| bad(path, format!("its layer {table} does not read: {e}"));
    let mut types: Vec<(String, String, bool)> = Vec::new();
    {
        let mut info = database.prepare(&format!("PRAGMA table_info({})", quoted(table))).map_err(failed)?;
        let rows = info
            .query_map([], |r| Ok((r.get::<_, String>(1)?, r.get::<_, String>(2)?, r.get::<_, i64>(5)? > 0)))
            .map_err(failed)?;
        for row in rows {
            types.push(row.map_err(failed)?);
        }
    }
    let mut query = database.prepare(&format!("SELECT * FROM {}", quoted(table))).map_err(failed)?;
    let mut rows = query.query([]).map_err(failed)?;
    let mut empty = 0;
    while let Some(row) = rows.next().map_err(failed)? {
        let (mut id, mut shape, mut attributes) = (None, None, Vec::new());
        for (i, (name, sql, key)) in types.iter().enumerate() {
            let value = row.get_ref(i).map_err(failed)?;
            if *key {
                id = value.as_i64().ok();
            } else if name == geometry {
                shape = value.as_blob_or_null().ok().flatten().map(<[u8]>::to_vec);
            } else {
                attributes.push((name.clone(), attribute(value, sql)));
            }
        }
        let named = || format!("{table} {}", id.unwrap_or_default());
        let Some((kind, parts)) = shape
            .map(|bytes| geometry_of(&bytes).map_err(|what| bad(path, format!("feature {}: {what}", named()))))
            .transpose()?
            .filter(|(_, parts)| !parts.is_empty())
        else {
            empty += 1;
            continue;
        };
        file.features.push(Feature { class: class.to_owned(), id, attributes, kind, parts });
    }
    if empty > 0 {
        let message = format!("{empty} features of {table} have no geometry and were left out");
        file.warnings.push(Warning::new("no-geometry", message));
    }
    Ok(())
}

fn attribute(value: ValueRef, sql: &str) -> Value {
    match value {
        ValueRef::Null => Value::Null,
        ValueRef::Integer(i) if sql.eq_ignore_ascii_case("BOOLEAN") => Value::Boolean(i != 0),
        ValueRef::Integer(i) => Value::Integer(i),
        ValueRef::Real(r) => Value::Real(r),
        ValueRef::Text(t) => Value::Text(String::from_utf8_lossy(t).into_owned()),
        ValueRef::Blob(b) => Value::Text(b.iter().map(|b| format!("{b:02x}")).collect()),
    }
}

fn geometry_of(bytes: &[u8]) -> Result<(Kind, Vec<Vec<Vec3>>), String> {
    if bytes.len() < 8 || &bytes[..2] != b"GP" {
        return Err("its geometry is not in GeoPackage form".into());
    }
    let flags = bytes[3];
    let envelope = match (flags >> 1) & 7 {
        0 => 0,
        1 => 32,
        2 | 3 => 48,
        4 => 64,
        other => return Err(format!("its geometry has an envelope of unknown kind {other}")),
    };
    if flags & 0b0010_0000 != 0 {
        return Err("its geometry is of an extended kind (curves?)".into());
    }
    wkb::read(bytes.get(8 + envelope..).ok_or("its geometry is cut off")?)
}
