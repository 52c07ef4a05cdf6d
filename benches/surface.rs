//! Seconds of the `section` and the `poisson` surface of the same oriented points.
//!
//! `cargo bench --bench surface -- ORIENTED.f64 CELL_M [--mesh OUT_PREFIX]`
//!
//! ORIENTED.f64 holds x, y, z and the unit normal into the void of each point as raw little-endian f64. `section` takes no
//! normals; it needs the axis and the classes of the points, whose seconds are told beside it. OUT_PREFIX.section and
//! OUT_PREFIX.poisson get the number of vertices and faces (i64), the vertices (f64), the corners (i32) and whether each face was
//! observed (u8);
//! `surface_against_peers.py` makes the one and measures the others. Wall seconds and CPU seconds (user and system, all
//! threads; Linux only).
#![allow(clippy::print_stdout, reason = "a bench is a program of its own")]

use adit::mesh::{Method, Settings, poisson, reconstruct};
use adit::numeric::Vec3;
use adit::{axis, segment};
use std::time::Instant;

/// CPU seconds of this process so far; 0 where the system does not tell.
fn cpu_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = text.rsplit(')').next().unwrap_or_default();
    let ticks: f64 = after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    ticks / 100.0
}

/// Does a step and tells its seconds.
fn timed<T>(name: &str, step: impl FnOnce() -> T) -> T {
    let (wall, cpu) = (Instant::now(), cpu_seconds());
    let result = step();
    println!("{name:<18} {:8.3} s wall {:8.2} s CPU", wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
    result
}

fn write(file: &str, vertices: &[Vec3], faces: &[[u32; 3]], observed: &[bool]) {
    let mut bytes = Vec::new();
    [vertices.len(), faces.len()].iter().for_each(|n| bytes.extend((*n as i64).to_le_bytes()));
    vertices.iter().flat_map(|v| [v.x, v.y, v.z]).for_each(|c| bytes.extend(c.to_le_bytes()));
    faces.iter().flatten().for_each(|&v| bytes.extend((v as i32).to_le_bytes()));
    bytes.extend(observed.iter().map(|&o| u8::from(o)));
    std::fs::write(file, bytes).expect("the mesh can be written");
}

fn main() {
    let given: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [file, cell, more @ ..] = &given[..] else {
        println!("nothing to do: give a file of oriented points and the edge of a cell in metres");
        return;
    };
    let out = match more {
        [] => None,
        [flag, prefix] if flag == "--mesh" => Some(prefix),
        other => panic!("not understood: {other:?}"),
    };
    let bytes = std::fs::read(file).expect("oriented points");
    let numbers: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) =
        numbers.as_chunks::<6>().0.iter().map(|r| (Vec3::new(r[0], r[1], r[2]), Vec3::new(r[3], r[4], r[5]))).unzip();
    let cell_m: f64 = cell.parse().expect("the edge of a cell in metres");
    println!("{} points, {} threads", points.len(), rayon::current_num_threads());

    let (axis, _) = timed("axis", || axis::trace(&points, &axis::Settings::default())).expect("a tunnel");
    let (classes, _) =
        timed("segment", || segment::classify_positions(&points, &axis, &segment::Settings::default())).expect("walls");
    let settings = Settings { method: Method::Section, ..Settings::default() };
    let (mesh, _) = timed("section", || reconstruct(&classes, &axis, &settings)).expect("a surface");
    if let Some(prefix) = out {
        write(&format!("{prefix}.section"), mesh.vertices(), mesh.faces(), mesh.observed());
    }
    drop((mesh, classes));

    let (vertices, faces, observed, summary) =
        timed("poisson", || poisson::of_oriented_points(&points, &normals, cell_m, 0.05, 0.3));
    println!("{summary:?}");
    if let Some(prefix) = out {
        write(&format!("{prefix}.poisson"), &vertices, &faces, &observed);
    }
}
