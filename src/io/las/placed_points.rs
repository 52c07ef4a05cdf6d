//! Positions and map columns of a LAS or LAZ file that a run wrote.

use super::super::error::Error;
use super::super::placed_points::PlacedPoint;
use super::extra_bytes::{self, ExtraField};
use crate::numeric::Vec3;
use std::path::Path;

/// Records read in one go.
const RUN: u64 = 1 << 18;

/// See [`crate::io::placed_points`].
pub(in super::super) fn placed_points(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let bad = |cause: String| Error::bad(path, cause, "run again with --force points");
    let mut reader = las::Reader::from_path(path).map_err(|e| bad(e.to_string()))?;
    let header = reader.header();
    let extra_len = usize::from(header.point_format().extra_bytes);
    let described = header.vlrs().iter().find(|v| v.user_id == "LASF_Spec" && v.record_id == 4);
    let fields = described.map_or(vec![], |v| extra_bytes::parse(&v.data, extra_len).0);
    // A scan may bring a column of the same name; the run appends its own behind it.
    let column = |name: &str| -> Result<ExtraField, Error> {
        let found = fields.iter().rev().find(|f| f.name() == name);
        found.cloned().ok_or_else(|| bad(format!("its records have no column '{name}'")))
    };
    let columns = [column("chainage")?, column("girth")?, column("offset")?];
    loop {
        let records = reader.read_points(RUN).map_err(|e| bad(e.to_string()))?;
        let mut points = Vec::with_capacity(records.len());
        for point in records.points() {
            let p = point.map_err(|e| bad(e.to_string()))?;
            let [u, v, offset] = [0, 1, 2].map(|k| columns[k].value(&p.extra_bytes).unwrap_or(f64::NAN));
            points.push(PlacedPoint { position_in_scan: Vec3::new(p.x, p.y, p.z), on_map: Vec3::new(u, v, offset) });
        }
        if points.is_empty() {
            return Ok(());
        }
        each(&points);
    }
}
