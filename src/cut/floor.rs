//! Cutting the floor away before the tube is opened: what remains is crown and walls, open from portal to portal.
//!
//! Use it for fracture maps, which leave the floor out. A face goes when its middle lies between the feet of the walls
//! that segmentation found; what hangs together no longer afterwards is dropped but for the largest piece, and told.
//! Cost: linear.

use super::Error;
use crate::axis::Axis;
use crate::mesh::{Mesh, repair};
use crate::segment::{Floor, SectionField};
use rayon::prelude::*;
use serde::Serialize;

/// What cutting the floor away took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FloorSummary {
    /// Faces of the floor.
    pub floor_faces: usize,
    /// Their area, square metres.
    pub floor_area_m2: f64,
    /// Other faces that lost their connection with the walls.
    pub loose_faces_dropped: usize,
}

/// The mesh without the faces of the floor.
///
/// # Errors
/// [`Error::Empty`] when nothing else is left.
pub fn without_floor(
    mesh: Mesh,
    axis: &Axis,
    section: &SectionField,
    floor: &Floor,
) -> Result<(Mesh, FloorSummary), Error> {
    let is_floor: Vec<bool> = (0..mesh.faces().len() as u32)
        .into_par_iter()
        .map(|f| {
            let [a, b, c] = mesh.corners(f);
            let place = axis.project(&((a + b + c) / 3.0));
            floor.contains(place.chainage, section.girth(place.chainage, place.angle()))
        })
        .collect();
    let mut summary = FloorSummary::default();
    for f in (0..is_floor.len()).filter(|&f| is_floor[f]) {
        summary.floor_faces += 1;
        summary.floor_area_m2 += mesh.double_area_vector(f as u32).norm() / 2.0;
    }
    let kept = (0..is_floor.len()).filter(|&f| !is_floor[f]);
    let (faces, observed): (Vec<_>, Vec<_>) = kept.map(|f| (mesh.faces()[f], mesh.observed()[f])).unzip();
    let walls = faces.len();
    let mut vertices = mesh.vertices().to_vec();
    let (mut faces, observed) = repair::trim_dangling(faces, observed);
    repair::split_fans(&mut vertices, &mut faces);
    let largest = repair::keep_largest(vertices, faces, observed);
    if largest.faces.is_empty() {
        return Err(Error::Empty);
    }
    summary.loose_faces_dropped = walls - largest.faces.len();
    let mesh = Mesh::new(largest.vertices, largest.faces, largest.observed)
        .expect("part of a manifold whose fans are split is a manifold");
    Ok((mesh, summary))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cut::{Settings, open};
    use crate::segment::{Class, classify_positions};
    use crate::synthetic::{Alignment, Section, Tunnel};

    #[test]
    fn walls_and_crown_are_left_and_need_no_seam() {
        let tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::bend(16.0, 40.0));
        let tube = tunnel.tube(160, 140).mesh;
        let axis = tunnel.axis();
        let (segmentation, _) =
            classify_positions(tube.vertices(), &axis, &crate::segment::Settings::default()).unwrap();
        assert!(segmentation.class.contains(&Class::Floor));
        let floor = segmentation.floor.as_ref().unwrap();
        let (walls, summary) = without_floor(tube.clone(), &axis, &segmentation.section, floor).unwrap();
        // The flat floor is 4.6 m wide; on a level bend its area is its width times the length of the axis.
        assert!((summary.floor_area_m2 - 4.6 * 16.0).abs() < 0.06 * 4.6 * 16.0, "{summary:?}");
        assert!((walls.area() + summary.floor_area_m2 - tube.area()).abs() < 0.02 * tube.area());
        let (strip, opened) = open(walls, &axis, &Settings::default()).unwrap();
        assert!(opened.already_open && strip.hole_loops().is_empty());
    }
}
