//! Scans of profiles: the surface is made in coordinates that are compressed along the axis.
//!
//! Points every few millimetres around and profiles half a metre apart have no cell that suits both. In (compressed chainage,
//! left, up) the profiles are as far apart as the points of a cell, and the method works as on any scan; its surface is then
//! put back around the axis. Distances along the axis count less in the same proportion: profiles are bridged.

use super::{CELL_IN_POINT_DISTANCES, Options};
use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::Vec3;
use crate::segment::Sampling;

/// Coordinates compressed along an axis.
pub(in crate::mesh) struct Compressed<'a> {
    axis: &'a Axis,
    /// The axis in these coordinates: straight.
    pub straight: Axis,
    /// Cell in these coordinates, metres around the section.
    pub cell_m: f64,
    /// Compressed length over true length.
    share: f64,
}

impl<'a> Compressed<'a> {
    /// Coordinates for a scan of profiles; `None` for any other scan.
    pub fn for_profiles(sampling: &Sampling, axis: &'a Axis, options: &Options) -> Option<Self> {
        let cell_m = options.cell(sampling.around_m);
        let share = cell_m / (CELL_IN_POINT_DISTANCES * sampling.along_m);
        if !sampling.is_profiles() || share >= 1.0 {
            return None;
        }
        let ends = [axis.start_chainage(), axis.end_chainage()].map(|s| Vec3::new(share * s, 0.0, 0.0));
        let straight = Axis::through(&ends, ends[0].x).ok()?;
        Some(Self { axis, straight, cell_m, share })
    }

    /// The place of a point in these coordinates.
    pub fn place(&self, c: &AxisCoordinates) -> Vec3 {
        Vec3::new(self.share * c.chainage, -c.right, c.up)
    }

    /// The point at a place, local metres.
    pub fn point(&self, place: &Vec3) -> Vec3 {
        self.axis.point_at(&AxisCoordinates { chainage: place.x / self.share, right: -place.y, up: place.z })
    }

    /// Length of a cell along the axis, metres.
    pub fn cell_along_m(&self) -> f64 {
        self.cell_m / self.share
    }
}
