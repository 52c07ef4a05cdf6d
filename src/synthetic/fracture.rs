//! Fracture planes with exact orientation, and where they meet the wall.

use crate::cloud::Label;
use crate::numeric::Vec3;

/// A plane that runs (nearly) in the wall has no sharp trace; the width of its trace stops growing here.
const LEAST_SINE: f64 = 0.05;

/// A planar fracture.
#[derive(Clone, Debug, PartialEq)]
pub struct Fracture {
    /// Label of the points on its trace.
    pub id: Label,
    /// Unit normal, pointing up; the fracture is the plane `normal . x = offset` in local metres.
    pub normal: Vec3,
    /// Distance of the plane from the local origin along the normal, metres.
    pub offset: f64,
    /// The fracture ends on a circle around this point ...
    pub centre: Vec3,
    /// ... with this radius, metres; infinite for a through-going plane.
    pub radius_m: f64,
    /// Half the width of its trace on the wall, metres.
    pub half_width_m: f64,
    /// Depth to which the trace is weathered out, metres.
    pub groove_m: f64,
}

impl Fracture {
    /// A through-going fracture: dip from horizontal and dip direction clockwise from north (+y), degrees.
    pub fn from_dip(id: Label, dip_deg: f64, dip_direction_deg: f64, through: Vec3) -> Self {
        let (dip, direction) = (dip_deg.to_radians(), dip_direction_deg.to_radians());
        let normal = Vec3::new(dip.sin() * direction.sin(), dip.sin() * direction.cos(), dip.cos());
        Self {
            id,
            normal,
            offset: normal.dot(&through),
            centre: through,
            radius_m: f64::INFINITY,
            half_width_m: 0.03,
            groove_m: 0.012,
        }
    }

    /// The same fracture, ending at a radius around the point that it was put through.
    pub fn with_radius(self, radius_m: f64) -> Self {
        Self { radius_m, ..self }
    }

    /// Dip from horizontal, degrees, 0 to 90.
    pub fn dip_deg(&self) -> f64 {
        self.normal.x.hypot(self.normal.y).atan2(self.normal.z.abs()).to_degrees()
    }

    /// Dip direction clockwise from north (+y), degrees, 0 to 360.
    pub fn dip_direction_deg(&self) -> f64 {
        let n = if self.normal.z < 0.0 { -self.normal } else { self.normal };
        n.x.atan2(n.y).to_degrees().rem_euclid(360.0)
    }

    /// Distance along a wall with the given unit normal from `point` on it to the trace; infinite beyond the end of
    /// the fracture.
    pub fn trace_distance(&self, point: &Vec3, wall_normal: &Vec3) -> f64 {
        let distance = (self.normal.dot(point) - self.offset).abs();
        // Cheap refusal first: most points are nowhere near most fractures.
        if distance > 1.0 || (point - self.centre).norm_squared() > self.radius_m * self.radius_m {
            return f64::INFINITY;
        }
        distance / self.normal.cross(wall_normal).norm().max(LEAST_SINE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orientation_is_what_was_asked_for() {
        for (dip, direction) in [(10.0, 0.0), (45.0, 90.0), (85.0, 217.0), (60.0, 359.0)] {
            let f = Fracture::from_dip(1, dip, direction, Vec3::new(1.0, 2.0, 3.0));
            assert!((f.dip_deg() - dip).abs() < 1e-9 && (f.dip_direction_deg() - direction).abs() < 1e-9);
            assert!(f.normal.z > 0.0 && (f.normal.dot(&f.centre) - f.offset).abs() < 1e-12);
        }
        // A plane that dips east goes down towards +x.
        let f = Fracture::from_dip(1, 45.0, 90.0, Vec3::zeros());
        assert!(f.normal.dot(&Vec3::new(1.0, 0.0, -1.0)).abs() < 1e-12);
    }

    #[test]
    fn trace_distance_is_measured_in_the_wall() {
        // A plane dipping 30 degrees meets a horizontal wall at 30 degrees: 1 cm off the plane is 2 cm on the wall.
        let f = Fracture::from_dip(1, 30.0, 90.0, Vec3::zeros());
        assert!((f.trace_distance(&Vec3::new(0.02, 5.0, 0.0), &Vec3::z()) - 0.02).abs() < 1e-12);
        let short = f.with_radius(2.0);
        assert_eq!(short.trace_distance(&Vec3::new(0.02, 5.0, 0.0), &Vec3::z()), f64::INFINITY);
    }
}
