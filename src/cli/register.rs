//! `adit register`: fine registration of overlapping stations, into a file of poses.

use super::run_surface::io_failure;
use super::{Console, Exit, Failure, Result};
use crate::io::{self, Pose, PoseEntry, StationScan};
use crate::numeric::Vec3;
use crate::register::{self, Motion, Overlap, Surface};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit register station_1.laz station_2.laz station_3.laz --out poses.toml
  adit register survey.e57 --out poses.toml             all scans in one file
  adit run --input station_1.laz --input station_2.laz --set ingest.poses=\\\"poses.toml\\\" --out runs/drift

Nothing is moved by this command: it writes poses, and a run uses them only when ingest.poses names the file.
The first scan stays where it is. Each of the others is brought to all those before it.";

/// Arguments of `adit register`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The scans: a file is a station, or each scan in it (E57, PTX) is one; the first one stays.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Where the poses go (TOML, for ingest.poses).
    #[arg(long, value_name = "POSES.toml")]
    out: PathBuf,
    /// Poses to start from, as for ingest.poses; without it the scans must already lie in common coordinates.
    #[arg(long, value_name = "POSES.toml")]
    poses: Option<PathBuf>,
    /// How far apart the stations may lie before, metres.
    #[arg(long, value_name = "METRES", default_value_t = 0.5)]
    distance: f64,
}

/// Registers the stations one after the other; writes nothing when one of them cannot be registered.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    if !(arguments.distance > 0.0 && arguments.distance <= 10.0) {
        return Err(Failure::message(Exit::Usage, "--distance must be more than 0 and at most 10 metres"));
    }
    let settings = io::Settings { poses: arguments.poses.clone(), ..Default::default() };
    let mut stations = Vec::new();
    for file in &arguments.files {
        stations.extend(io::read_stations(file, &settings).map_err(io_failure)?);
    }
    if stations.len() < 2 {
        let message = format!("{} is the only station; name two files, or one that holds several scans", stations[0]);
        return Err(Failure::message(Exit::Usage, message));
    }
    let unit = stations[0].metres_per_unit;
    if let Some(other) = stations.iter().find(|s| s.metres_per_unit != unit) {
        let message = format!(
            "{other} has units of {} m, {} of {unit} m: convert them to one unit first",
            other.metres_per_unit, stations[0]
        );
        return Err(Failure::message(Exit::BadInput, message));
    }
    // Local metres around the first scan: seven-digit coordinates stay exact.
    let origin = stations[0].points_in_scan.first().map_or_else(Vec3::zeros, |p| p.map(f64::floor));
    let local = |s: &StationScan| s.points_in_scan.iter().map(|p| (p - origin) * unit).collect::<Vec<Vec3>>();
    let mut fixed = local(&stations[0]);
    let entry = |station: &StationScan, pose: Pose, remark: String| PoseEntry {
        file: station.path.clone(),
        station: station.station,
        pose,
        remark,
    };
    let mut entries = vec![entry(&stations[0], stations[0].pose, "the first scan stays".to_owned())];
    for station in &stations[1..] {
        let moving = local(station);
        let found = register::align(&Surface::new(&fixed), &moving, arguments.distance)
            .map_err(|error| Failure::message(Exit::BadInput, format!("{station} cannot be registered: {error}")))?;
        let turn = nalgebra::Rotation3::from_matrix_unchecked(found.motion.rotation).angle().to_degrees();
        let remark = format!(
            "moved by {:.1} mm and turned by {turn:.4} degrees in {} iterations\nbefore: {}\nafter: {}",
            found.motion.shift.norm() * 1000.0,
            found.iterations,
            in_words(&found.before),
            in_words(&found.after)
        );
        console.print(&format!("{station}\n  {}", remark.replace('\n', "\n  ")));
        if found.after.median_m > found.before.median_m {
            console.warn(&format!("{station} agrees no better than before"));
        }
        fixed.extend(moving.iter().map(|p| found.motion.apply(p)));
        entries.push(entry(station, moved(&station.pose, &found.motion, &origin, unit), remark));
    }
    // Names are enough for ingest.poses where they differ, and survive a move of the folder.
    let names: Vec<PathBuf> = arguments.files.iter().filter_map(|f| f.file_name().map(PathBuf::from)).collect();
    let unique = names.iter().enumerate().all(|(i, name)| !names[..i].contains(name));
    for entry in &mut entries {
        entry.file = match entry.file.file_name().filter(|_| unique) {
            Some(name) => PathBuf::from(name),
            None => std::path::absolute(&entry.file).map_err(|e| Failure::new(Exit::BadInput, e))?,
        };
    }
    io::write_poses(&arguments.out, &entries).map_err(io_failure)?;
    console.say(&format!("wrote {}; use it with ingest.poses = \"{0}\"", display(&arguments.out)));
    Ok(Exit::Done)
}

fn display(path: &Path) -> String {
    path.display().to_string()
}

fn in_words(overlap: &Overlap) -> String {
    format!(
        "median {:.2} mm, 95 % within {:.2} mm (point to plane, {} points, {:.0} % of the scan)",
        overlap.median_m * 1000.0,
        overlap.p95_m * 1000.0,
        overlap.points,
        overlap.share_percent
    )
}

/// A pose, and after it a motion in local metres around `origin`.
fn moved(pose: &Pose, motion: &Motion, origin: &Vec3, metres_per_unit: f64) -> Pose {
    let centre = motion.centre / metres_per_unit + origin;
    let shift = motion.shift / metres_per_unit;
    Pose {
        rotation: motion.rotation * pose.rotation,
        translation: motion.rotation * (pose.translation - centre) + centre + shift,
    }
}
