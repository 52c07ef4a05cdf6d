//! A part of a scan: what lies along a stretch of a known axis.

use super::error::Error;
use super::stream::ScanBox;
use crate::axis::Axis;
use crate::cloud::ScanFrame;
use crate::numeric::Vec3;

/// What lies between two chainages of an axis, and near it.
#[derive(Clone, Debug)]
pub struct Part {
    axis: Axis,
    frame: ScanFrame,
    chainage_m: [f64; 2],
    /// Boxes around all of it, one for each step along the axis, scan coordinates.
    boxes: Vec<ScanBox>,
}

impl Part {
    /// Points farther from the axis belong to no part, metres: no tunnel is as wide, and the other tube of a road is not
    /// meant.
    pub const REACH_M: f64 = 30.0;

    /// The part between two chainages of `axis`, whose frame says where the axis lies in scan coordinates.
    ///
    /// # Errors
    /// [`Error::Settings`] when the chainages are no interval, or the axis does not reach it.
    pub fn along(axis: Axis, frame: ScanFrame, chainage_m: [f64; 2]) -> Result<Self, Error> {
        let [from, to] = chainage_m;
        let refused = |cause: String, remedy: &str| Error::Settings {
            key: "ingest.chainage_m",
            cause,
            remedy: remedy.to_owned(),
        };
        if !(from < to && from.is_finite() && to.is_finite()) {
            return Err(refused(
                format!("{from} to {to} is no stretch"),
                "give two finite numbers, the smaller one first",
            ));
        }
        let (start, end) = (axis.start_chainage(), axis.end_chainage());
        if to <= start || from >= end {
            let cause = format!("{from} to {to} lies outside the alignment, which runs from {start:.3} to {end:.3}");
            return Err(refused(cause, "name chainages of the alignment"));
        }
        /// Steps short enough for the axis to be straight within each, metres.
        const STEP_M: f64 = 2.0;
        /// What a bend may add to the box between two sections, metres.
        const MARGIN_M: f64 = 0.5;
        let [from, to] = [from.max(start), to.min(end)];
        let steps = ((to - from) / STEP_M).ceil().max(1.0) as usize;
        let section = |i: usize| {
            let frame = axis.frame_at(from + (to - from) * i as f64 / steps as f64);
            // A disk reaches farthest in the directions that lie in it.
            let reach = frame.forward.map(|f| Self::REACH_M * (1.0 - f * f).max(0.0).sqrt() + MARGIN_M);
            [frame.origin - reach, frame.origin + reach]
        };
        let boxes = (0..steps)
            .map(|i| {
                let ([a, b], [c, d]) = (section(i), section(i + 1));
                ScanBox { low: frame.scan_from_local(&a.inf(&c)), high: frame.scan_from_local(&b.sup(&d)) }
            })
            .collect();
        Ok(Self { axis, frame, chainage_m, boxes })
    }

    /// Whether a point in scan coordinates belongs to it.
    pub(super) fn contains(&self, point_in_scan: &Vec3) -> bool {
        let [from, to] = self.chainage_m;
        self.boxes.iter().any(|b| b.contains(point_in_scan)) && {
            let at = self.axis.project(&self.frame.local_from_scan(point_in_scan));
            (from..=to).contains(&at.chainage) && at.radius() <= Self::REACH_M
        }
    }

    /// Whether a box in scan coordinates may hold points of it.
    pub(super) fn may_meet(&self, other: &ScanBox) -> bool {
        self.boxes.iter().any(|b| b.meets(other))
    }

    /// Length of the scan unit that it was made for, metres.
    pub(super) fn metres_per_unit(&self) -> f64 {
        self.frame.metres_per_unit
    }

    /// In words.
    pub(super) fn in_words(&self) -> String {
        let [from, to] = self.chainage_m;
        format!("between the chainages {from} and {to} of the alignment, within {} m of it", Self::REACH_M)
    }
}
