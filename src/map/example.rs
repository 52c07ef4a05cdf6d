//! Charts with known answers for the tests of this module.

use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use crate::unwrap::Chart;

/// A rectangle `width` x `height` metres in the plane with `columns` x `rows` vertices; the chart is the plane itself.
pub fn flat_chart(width: f64, height: f64, columns: u32, rows: u32) -> Chart {
    bent_chart(width, height, columns, rows, |u, v| Vec3::new(u, v, 0.0))
}

/// The same rectangle put in space by `position(u, v)`.
pub fn bent_chart(width: f64, height: f64, columns: u32, rows: u32, position: impl Fn(f64, f64) -> Vec3) -> Chart {
    let mut uv = Vec::new();
    for r in 0..rows {
        for c in 0..columns {
            let place = |i: u32, n: u32, length: f64| f64::from(i) / f64::from(n - 1) * length;
            uv.push(Vec2::new(place(c, columns, width), place(r, rows, height)));
        }
    }
    let mut faces = Vec::new();
    for r in 0..rows - 1 {
        for c in 0..columns - 1 {
            let a = r * columns + c;
            let (b, d, e) = (a + 1, a + columns, a + columns + 1);
            faces.push([a, b, e]);
            faces.push([a, e, d]);
        }
    }
    let vertices = uv.iter().map(|p| position(p.x, p.y)).collect();
    let mesh = Mesh::all_observed(vertices, faces).unwrap();
    Chart::new(Strip::from_disk(mesh).unwrap(), uv).unwrap()
}
