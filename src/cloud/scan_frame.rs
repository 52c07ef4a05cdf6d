//! The frame that keeps seven-digit coordinates exact: local metres plus an `f64` origin.

use crate::numeric::Vec3;

/// Takes local metres to the coordinates of the scan and back.
///
/// `scan = local / metres_per_unit + origin`. The origin is chosen on whole units near the scan, so that local
/// numbers are small and the subtraction is exact to the last bit that the file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanFrame {
    /// Origin of the local frame in scan coordinates (in the scan's own unit).
    pub origin_in_scan: Vec3,
    /// Length of the scan's unit in metres: 1 for metres, 0.001 for millimetres, 0.3048 for feet.
    pub metres_per_unit: f64,
    /// Coordinate reference system as the file states it (WKT or GeoTIFF keys as text), if it does.
    pub crs: Option<String>,
}

impl ScanFrame {
    /// A frame whose local coordinates are the scan's own, in metres.
    pub fn local() -> Self {
        Self::with_origin(Vec3::zeros())
    }

    /// A frame in metres with the given origin.
    pub fn with_origin(origin_in_scan: Vec3) -> Self {
        Self { origin_in_scan, metres_per_unit: 1.0, crs: None }
    }

    /// Local metres of a point given in scan coordinates.
    pub fn local_from_scan(&self, point_in_scan: &Vec3) -> Vec3 {
        (point_in_scan - self.origin_in_scan) * self.metres_per_unit
    }

    /// Scan coordinates of a point given in local metres.
    pub fn scan_from_local(&self, point_in_local: &Vec3) -> Vec3 {
        point_in_local / self.metres_per_unit + self.origin_in_scan
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utm_coordinates_survive() {
        let frame = ScanFrame::with_origin(Vec3::new(244_398.0, 6_010_935.0, 18.0));
        let p = Vec3::new(244_399.123_4, 6_010_940.567_8, 19.000_1);
        let back = frame.scan_from_local(&frame.local_from_scan(&p));
        assert!((back - p).amax() < 1e-9);
    }

    #[test]
    fn units_scale_both_ways() {
        let frame = ScanFrame { metres_per_unit: 0.001, ..ScanFrame::with_origin(Vec3::new(1000.0, 0.0, 0.0)) };
        assert_eq!(frame.local_from_scan(&Vec3::new(2000.0, 500.0, 0.0)), Vec3::new(1.0, 0.5, 0.0));
        assert_eq!(frame.scan_from_local(&Vec3::new(1.0, 0.5, 0.0)), Vec3::new(2000.0, 500.0, 0.0));
    }
}
