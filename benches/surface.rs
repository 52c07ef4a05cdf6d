//! Seconds of the `poisson` surface of oriented points alone.
//!
//! `cargo bench --bench surface -- ORIENTED.f64 CELL_M [--mesh OUT.bin]`
//!
//! ORIENTED.f64 holds x, y, z and the unit normal into the void of each point as raw little-endian f64. OUT.bin gets the
//! number of vertices and faces (i64), the vertices (f64) and the corners (i32); `surface_against_peers.py` makes the one
//! and measures the other. Wall seconds and CPU seconds (user and system, all threads; Linux only).
#![allow(clippy::print_stdout, reason = "a bench is a program of its own")]

use adit::mesh::poisson;
use adit::numeric::Vec3;
use std::time::Instant;

/// CPU seconds of this process so far; 0 where the system does not tell.
fn cpu_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = text.rsplit(')').next().unwrap_or_default();
    let ticks: f64 = after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    ticks / 100.0
}

fn main() {
    let given: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [file, cell, more @ ..] = &given[..] else {
        println!("nothing to do: give a file of oriented points and the edge of a cell in metres");
        return;
    };
    let bytes = std::fs::read(file).expect("oriented points");
    let numbers: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) =
        numbers.as_chunks::<6>().0.iter().map(|r| (Vec3::new(r[0], r[1], r[2]), Vec3::new(r[3], r[4], r[5]))).unzip();
    let cell_m: f64 = cell.parse().expect("the edge of a cell in metres");
    let (wall, cpu) = (Instant::now(), cpu_seconds());
    let (vertices, faces, _, summary) = poisson::of_oriented_points(&points, &normals, cell_m, 0.05, 0.3);
    println!(
        "{} points, {} threads: {:.3} s wall {:.2} s CPU, {} faces",
        points.len(),
        rayon::current_num_threads(),
        wall.elapsed().as_secs_f64(),
        cpu_seconds() - cpu,
        faces.len()
    );
    println!("{summary:?}");
    if let [flag, out] = more
        && flag == "--mesh"
    {
        let mut bytes = Vec::new();
        [vertices.len(), faces.len()].iter().for_each(|n| bytes.extend((*n as i64).to_le_bytes()));
        vertices.iter().flat_map(|v| [v.x, v.y, v.z]).for_each(|c| bytes.extend(c.to_le_bytes()));
        faces.iter().flatten().for_each(|&v| bytes.extend((v as i32).to_le_bytes()));
        std::fs::write(out, bytes).expect("the mesh can be written");
    }
}
