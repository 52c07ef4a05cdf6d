//! Seconds of each step that works on points alone: voxel means, outlier removal, normals.
//!
//! `cargo bench --bench points -- SCAN.laz [--cell 0.05] [--neighbours 16] [--repeat 3] [--normals OUT]`
//!
//! Every step is one call of the library on all points of the scan, as read. Wall seconds and CPU seconds (user and
//! system, all threads; Linux only) are those of the fastest of the repeats. `--normals` writes both normals, in point
//! order, as raw little-endian f64 triples to OUT.fixed and OUT.adaptive (`points_against_peers.py` measures their error).
//! Without a scan a synthetic drift of a million points is made.
#![allow(clippy::print_stdout, reason = "a bench is a program of its own")]

use adit::clean::{StatisticalOutliers, VoxelDownsample, remove_statistical_outliers, voxel_downsample};
use adit::numeric::Vec3;
use adit::spatial::nearest::BundleTree;
use adit::synthetic::{Recipe, scan};
use adit::{io, normals};
use std::path::PathBuf;
use std::time::Instant;

struct Arguments {
    scan: Option<PathBuf>,
    cell_m: f64,
    neighbours: usize,
    repeat: usize,
    normals: Option<PathBuf>,
}

fn arguments() -> Arguments {
    let mut parsed = Arguments { scan: None, cell_m: 0.05, neighbours: 16, repeat: 3, normals: None };
    let mut given = std::env::args().skip(1).filter(|a| a != "--bench");
    let number = |text: Option<String>, of: &str| -> f64 {
        text.and_then(|t| t.parse().ok()).unwrap_or_else(|| panic!("{of} needs a number"))
    };
    while let Some(argument) = given.next() {
        match argument.as_str() {
            "--cell" => parsed.cell_m = number(given.next(), "--cell"),
            "--neighbours" => parsed.neighbours = number(given.next(), "--neighbours") as usize,
            "--repeat" => parsed.repeat = number(given.next(), "--repeat").max(1.0) as usize,
            "--normals" => parsed.normals = given.next().map(PathBuf::from),
            scan => parsed.scan = Some(scan.into()),
        }
    }
    parsed
}

/// CPU seconds of this process so far; 0 where the system does not tell.
fn cpu_seconds() -> f64 {
    // Fields 14 and 15 are user and system time in hundredths of a second; the name in parentheses may hold spaces.
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = text.rsplit(')').next().unwrap_or_default();
    let ticks: f64 = after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    ticks / 100.0
}

/// Runs a step a few times and prints the fastest.
fn time<T>(name: &str, repeat: usize, step: impl Fn() -> T, tell: impl Fn(&T) -> String) -> T {
    let mut best: Option<(f64, f64, T)> = None;
    for _ in 0..repeat {
        let (wall, cpu) = (Instant::now(), cpu_seconds());
        let result = step();
        let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
        if best.as_ref().is_none_or(|b| wall < b.0) {
            best = Some((wall, cpu, result));
        }
    }
    let (wall, cpu, result) = best.expect("at least one repeat");
    println!("{name:<28} {wall:8.3} s wall {cpu:8.2} s CPU   {}", tell(&result));
    result
}

fn main() {
    let arguments = arguments();
    let points: Vec<Vec3> = match &arguments.scan {
        Some(path) => {
            let (cloud, _) = io::read_cloud(std::slice::from_ref(path), &io::Settings::default()).expect("a scan");
            cloud.positions().to_vec()
        }
        None => {
            let recipe = Recipe { points: 1_000_000, noise_m: 0.003, ..Recipe::default() };
            let tunnel = recipe.tunnel().expect("the default recipe");
            scan(&tunnel, &recipe.plan().expect("the default plan")).expect("a scan").cloud.positions().to_vec()
        }
    };
    println!("{} points, {} threads", points.len(), rayon::current_num_threads());
    let (repeat, neighbours) = (arguments.repeat, arguments.neighbours);
    let voxels = VoxelDownsample { cell_m: Some(arguments.cell_m), ..VoxelDownsample::default() };
    time("voxel_downsample", repeat, || voxel_downsample(&points, &voxels), |v| format!("kept {}", v.positions.len()));
    let outliers = StatisticalOutliers { neighbours, ..StatisticalOutliers::default() };
    time(
        "statistical_outliers",
        repeat,
        || remove_statistical_outliers(&BundleTree::new(&points), &outliers),
        |v| format!("kept {}, k {neighbours}", v.kept.iter().filter(|k| **k).count()),
    );
    let fixed =
        time("normals, fixed", repeat, || normals::unoriented(&points, neighbours), |_| format!("k {neighbours}"));
    let adaptive = time("normals, adaptive", repeat, || normals::adaptive(&points), |_| String::new());
    if let Some(path) = &arguments.normals {
        for (normals, name) in [(&fixed, "fixed"), (&adaptive, "adaptive")] {
            let bytes: Vec<u8> = normals.iter().flat_map(|n| [n.x, n.y, n.z]).flat_map(f64::to_le_bytes).collect();
            std::fs::write(path.with_extension(name), bytes).expect("the normals can be written");
        }
    }
}
