//! The bundled scan is exactly what the generator makes, and what its README says.

use adit::{io, synthetic};
use sha2::{Digest, Sha256};
use std::fs;
use std::path::Path;

/// `adit synth` writes in millimetres unless told otherwise.
const STEP_M: f64 = 0.001;

#[test]
fn the_bundled_scan_can_be_made_again_byte_for_byte() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("sample_scans");
    let bundled = fs::read(folder.join("bent_drift.laz")).unwrap();
    let recipe = synthetic::Recipe::default();
    let scan = synthetic::scan(&recipe.tunnel().unwrap(), &recipe.plan().unwrap()).unwrap();
    let remade = tempfile::tempdir().unwrap();
    let path = remade.path().join("bent_drift.laz");
    io::write_cloud_in_steps(&scan.cloud, None, &path, STEP_M).unwrap();
    assert!(fs::read(path).unwrap() == bundled, "the generator no longer makes the bundled scan");

    let readme = fs::read_to_string(folder.join("README.md")).unwrap();
    let checksum: String = Sha256::digest(&bundled).iter().map(|b| format!("{b:02x}")).collect();
    assert!(readme.contains(&checksum), "sample_scans/README.md does not have the checksum {checksum}");
    assert!(readme.contains(&format!("| {} |", scan.cloud.len())), "nor the count {}", scan.cloud.len());
    assert!(bundled.len() < 2_500_000);
}
