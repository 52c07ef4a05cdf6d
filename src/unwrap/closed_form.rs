//! Strips whose flat form is known exactly: the judges of every unwrap method. Tests only.

use crate::axis::{Axis, AxisCoordinates};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use std::f64::consts::PI;

/// A strip, its axis, and where each vertex belongs on the map.
pub struct Known {
    pub name: &'static str,
    pub strip: Strip,
    pub axis: Axis,
    /// The exact flat form; for surfaces that cannot be flattened exactly, the ideal (chainage, girth).
    pub flat: Vec<Vec2>,
}

/// A uniform pseudo-random number in [-0.5, 0.5) from two indices (SplitMix64).
fn noise(a: u32, b: u32) -> f64 {
    let mut z = (u64::from(a) << 32 | u64::from(b)).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
}

/// Triangulates the parameter rectangle [0, 1]^2 in `rows` (along the tunnel) x `columns` (around it) and maps it.
/// Faces are counter-clockwise for parameters (along, around). Inner vertices are jittered by `jitter` of a cell along
/// the tunnel; diagonals alternate.
pub fn grid(rows: u32, columns: u32, jitter: f64, place: impl Fn(f64, f64) -> Vec3) -> Mesh {
    let vertices = (0..=rows)
        .flat_map(|i| (0..=columns).map(move |j| (i, j)))
        .map(|(i, j)| {
            let shift = if i == 0 || i == rows { 0.0 } else { jitter * noise(i, j) };
            place((f64::from(i) + shift) / f64::from(rows), f64::from(j) / f64::from(columns))
        })
        .collect();
    let faces = (0..rows)
        .flat_map(|i| {
            (0..columns).flat_map(move |j| {
                let a = i * (columns + 1) + j;
                let (b, c, d) = (a + columns + 1, a + columns + 2, a + 1);
                if noise(i + 7, j) < 0.0 { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] }
            })
        })
        .collect();
    Mesh::all_observed(vertices, faces).unwrap()
}

fn straight_axis(length: f64) -> Axis {
    Axis::through(&[Vec3::zeros(), Vec3::new(length, 0.0, 0.0)], 0.0).unwrap()
}

/// Section corners of a horseshoe (right, up), from the invert over the left wall and the crown to the invert.
fn horseshoe() -> Vec<[f64; 2]> {
    let (half, wall) = (4.1, 2.6);
    let mut corners = vec![[0.0, -wall], [-half, -wall], [-half, 0.0]];
    for i in 1..12 {
        let a = -PI / 2.0 + PI * f64::from(i) / 12.0;
        corners.push([half * a.sin(), half * a.cos()]);
    }
    corners.extend([[half, 0.0], [half, -wall], [0.0, -wall]]);
    corners
}

/// A horseshoe prism: flat facets, so its flat form is exact to rounding. 12 m long.
pub fn prism() -> Known {
    let corners = horseshoe();
    // Each facet in four columns, so that creases are mesh edges.
    let mut path: Vec<([f64; 2], f64)> = vec![(corners[0], 0.0)];
    for pair in corners.windows(2) {
        let length = (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
        let from = path[path.len() - 1].1;
        for i in 1..=4 {
            let t = f64::from(i) / 4.0;
            let p = [pair[0][0] + t * (pair[1][0] - pair[0][0]), pair[0][1] + t * (pair[1][1] - pair[0][1])];
            path.push((p, from + t * length));
        }
    }
    let columns = path.len() as u32 - 1;
    let at = |around: f64| path[(around * f64::from(columns)).round() as usize];
    let mesh = grid(30, columns, 0.3, |along, around| {
        let [right, up] = at(around).0;
        Vec3::new(12.0 * along, -right, up)
    });
    let crown = path[path.len() / 2].1;
    let flat = (0..mesh.vertices().len())
        .map(|v| Vec2::new(mesh.vertices()[v].x, path[v % (columns as usize + 1)].1 - crown))
        .collect();
    Known { name: "prism", strip: Strip::from_disk(mesh).unwrap(), axis: straight_axis(12.0), flat }
}

/// A half cylinder of radius 4 m as a regular polygon: the case libigl's two-pin LSCM fails on.
pub fn half_cylinder() -> Known {
    cylinder("half cylinder", PI / 2.0)
}

/// A cylinder of radius 4 m cut open along the invert.
pub fn full_cylinder() -> Known {
    cylinder("cylinder", PI)
}

fn cylinder(name: &'static str, half_angle: f64) -> Known {
    let (columns, radius) = (48u32, 4.0);
    let mesh = grid(24, columns, 0.3, |along, around| {
        let angle = half_angle * (2.0 * around - 1.0);
        Vec3::new(9.0 * along, -radius * angle.sin(), radius * angle.cos())
    });
    let chord = 2.0 * radius * (half_angle / f64::from(columns)).sin();
    let flat = (0..mesh.vertices().len() as u32)
        .map(|v| {
            let column = f64::from(v % (columns + 1)) - f64::from(columns) / 2.0;
            Vec2::new(mesh.vertices()[v as usize].x, column * chord)
        })
        .collect();
    Known { name, strip: Strip::from_disk(mesh).unwrap(), axis: straight_axis(9.0), flat }
}

/// A cone around the axis, radius 3 m to 4 m over 10 m, cut open along the invert; `flat` is (chainage, girth).
pub fn cone() -> Known {
    let mesh = grid(40, 60, 0.0, |along, around| {
        let (angle, radius) = (PI * (2.0 * around - 1.0), 3.0 + along);
        Vec3::new(10.0 * along, -radius * angle.sin(), radius * angle.cos())
    });
    let flat = mesh.vertices().iter().map(|p| {
        let radius = 3.0 + p.x / 10.0;
        Vec2::new(p.x, radius * (-p.y).atan2(p.z))
    });
    let mut flat: Vec<Vec2> = flat.collect();
    for (v, p) in flat.iter_mut().enumerate() {
        // The seam's two sides have the same position but opposite girth.
        if v % 61 == 0 {
            p.y = -p.y.abs();
        }
    }
    Known { name: "cone", strip: Strip::from_disk(mesh).unwrap(), axis: straight_axis(10.0), flat }
}

/// A circular tunnel of radius 3 m on a left-hand bend of `bend` metres, a quarter turn; `flat` is (chainage, girth).
pub fn bend(bend: f64) -> Known {
    let points: Vec<Vec3> = (0..=200)
        .map(|i| {
            let a = f64::from(i) / 200.0 * PI / 2.0;
            Vec3::new(bend * a.sin(), bend - bend * a.cos(), 0.0)
        })
        .collect();
    let axis = Axis::through(&points, 0.0).unwrap();
    let length = axis.length();
    let mesh = grid(60, 60, 0.0, |along, around| {
        axis.point_at(&AxisCoordinates::from_polar(along * length, PI * (2.0 * around - 1.0), 3.0))
    });
    let flat = (0..mesh.vertices().len())
        .map(|v| {
            let (i, j) = ((v / 61) as f64, (v % 61) as f64);
            Vec2::new(i / 60.0 * length, (j - 30.0) * 6.0 * (PI / 60.0).sin())
        })
        .collect();
    Known { name: "bend", strip: Strip::from_disk(mesh).unwrap(), axis, flat }
}

/// A rough tunnel of radius 3.5 m on a gentle bend: waves of several lengths and random displacement of every vertex.
pub fn rough(rows: u32, columns: u32) -> Known {
    let points: Vec<Vec3> = (0..=40)
        .map(|i| {
            let a = f64::from(i) / 40.0 * 0.3;
            Vec3::new(80.0 * a.sin(), 80.0 - 80.0 * a.cos(), 0.3 * a)
        })
        .collect();
    let axis = Axis::through(&points, 10.0).unwrap();
    let length = axis.length();
    let mesh = grid(rows, columns, 0.3, |along, around| {
        let angle = PI * (2.0 * around - 1.0) * 0.999;
        let s = along * length;
        let bumps = 0.12 * (1.3 * s).sin() * (5.0 * angle).cos() + 0.05 * (4.1 * s + 11.0 * angle).sin();
        let grain = 0.02 * noise((along * 1e4) as u32, (around * 1e4) as u32);
        axis.point_at(&AxisCoordinates::from_polar(10.0 + s, angle, 3.5 + bumps + grain))
    });
    let flat = mesh.vertices().iter().map(|p| {
        let c = axis.project(p);
        Vec2::new(c.chainage, c.angle() * 3.5)
    });
    let flat = flat.collect();
    Known { name: "rough", strip: Strip::from_disk(mesh).unwrap(), axis, flat }
}

/// The surfaces that flatten without any distortion.
pub fn developable() -> Vec<Known> {
    vec![prism(), half_cylinder(), full_cylinder()]
}
