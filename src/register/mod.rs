//! Fine registration of overlapping stations: how well two scans agree, and the rigid motion that makes them agree.
//!
//! When to use: stations that are already placed to within a few decimetres (by targets, by a pose of the scanner) and
//! share a part of the wall. Not for scans without any placement, and not where nothing holds a direction: a smooth
//! straight tunnel slides along its axis, and then [`align`] refuses and names the direction instead of inventing one.
//! Reference: Y. Chen and G. Medioni, "Object modelling by registration of multiple range images", Image and Vision
//! Computing 10(3), 1992, doi:10.1016/0262-8856(92)90066-C (point to plane); P. J. Huber, *Robust Statistics*, 1981,
//! doi:10.1002/0471725250, for the scale; the weights are Tukey's biweight.
//! Departures: planes come from eight neighbours of a thinned scan; what can be observed is not judged by the condition
//! of the normal matrix alone, which noise in the normals makes look good, but by moving the result and looking whether
//! the misfit rises.
//! Guarantees: sums in fixed order, so the same motion on any number of threads; the motion is a rotation and a shift.
//! Cost: a k-d tree and eight neighbours for each thinned point, then one nearest neighbour a point and iteration.

mod align;
mod surface;

pub use align::{Alignment, Motion, align};
pub use surface::{Overlap, Surface, Thinned};

/// Why two scans cannot be registered.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// Hardly any point of one scan has a wall of the other near it.
    #[error(
        "only {matched} of {points} thinned points lie within {distance_m} m of the other scans, {needed} are needed; \
         place the station better first, or allow a larger distance"
    )]
    NoOverlap {
        /// Points with a partner.
        matched: usize,
        /// Points there are.
        points: usize,
        /// Points needed.
        needed: usize,
        /// Distance allowed, metres.
        distance_m: f64,
    },
    /// Nothing in the overlap holds some direction.
    #[error(
        "nothing in the overlap holds {}: moved by {probe_m} m that way, the scans fit as well as before; add targets, \
         or let the stations overlap where the tunnel bends or has a face",
        directions.join(" and ")
    )]
    Unobservable {
        /// The directions, in words.
        directions: Vec<String>,
        /// How far the scans were moved to find out, metres.
        probe_m: f64,
    },
    /// The iteration did not come to rest.
    #[error(
        "not at rest after {iterations} iterations (the last one moved {last_m:.4} m); place the station better first"
    )]
    NoRest {
        /// Iterations made.
        iterations: usize,
        /// Movement of the last iteration, metres.
        last_m: f64,
    },
}
