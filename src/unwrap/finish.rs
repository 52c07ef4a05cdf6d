//! What every solve ends with: unfolding of stray flips, a place for vertices without faces, and the counts of it all.

use super::SolveSummary;
use super::conformal::{centre_unused, used_vertices};
use super::triangle_shapes::Shapes;
use super::unfold::unfold;
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::warning::Warning;

/// Unfolds flipped faces, brings vertices without a face to the middle, and records both with the repaired shapes.
pub(super) fn finish(strip: &Strip, shapes: &Shapes, uv: &mut [Vec2], summary: &mut SolveSummary) {
    let unfolded = unfold(strip.mesh(), uv);
    if unfolded.flipped_before > 0 {
        summary.warnings.push(Warning::new(
            "unfolded",
            format!(
                "{} faces were flipped by the solve (obtuse or needle-shaped triangles, or sharp relief); {} vertices were \
                 moved to unfold them, {} faces stay flipped",
                unfolded.flipped_before, unfolded.moved_vertices, unfolded.flipped_after
            ),
        ));
    }
    let unused = centre_unused(&used_vertices(uv.len(), strip.mesh().faces()), uv);
    for (name, count) in [
        ("repaired_faces", shapes.repaired.len()),
        ("unused_vertices", unused),
        ("unfolded_faces", unfolded.flipped_before.saturating_sub(unfolded.flipped_after)),
        ("unfolding_moved_vertices", unfolded.moved_vertices),
    ] {
        summary.figures.insert(name.to_owned(), count as f64);
    }
    summary.warnings.extend(shapes.warning());
}
