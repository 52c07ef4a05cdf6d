//! Which chunks of a COPC file lie in a box: its octree says it without decompressing any point.
//!
//! Reference: *COPC - Cloud Optimized Point Cloud specification 1.0* (2021). Each chunk of points is a node of an octree
//! over a cube; the hierarchy lists key (level, x, y, z), first byte, length and number of points of every node.

use super::super::source_bytes::SourceBytes;
use super::super::stream::ScanBox;
use super::header::{Container, f64_at, u32_at, u64_at};
use crate::numeric::Vec3;
use std::collections::HashMap;

/// Bytes of one entry of the hierarchy.
const ENTRY: usize = 32;
/// Deeper trees and more pages than this are loops or damage.
const DEEPEST: u32 = 30;
const MOST_PAGES: usize = 100_000;

/// The boxes of the nodes of a COPC file, by the first byte of their points.
pub(super) struct Nodes {
    boxes: HashMap<u64, ScanBox>,
}

impl Nodes {
    /// `None` when the file is no COPC or its hierarchy is damaged: then every chunk has to be looked at.
    pub(super) fn of(source: &SourceBytes, container: &Container) -> Option<Self> {
        let info = &container.vlr("copc", 1)?.data;
        if info.len() < 72 {
            return None;
        }
        let centre = Vec3::new(f64_at(info, 0), f64_at(info, 8), f64_at(info, 16));
        let half = f64_at(info, 24);
        if !(half > 0.0) || !centre.iter().all(|c| c.is_finite()) {
            return None;
        }
        let low = centre.add_scalar(-half);
        let mut pages = vec![(u64_at(info, 40), u64_at(info, 48))];
        let mut boxes = HashMap::new();
        let mut seen = 0;
        while let Some((at, len)) = pages.pop() {
            seen += 1;
            let end = at.checked_add(len).filter(|&e| e <= source.len());
            if seen > MOST_PAGES || end.is_none() || len % ENTRY as u64 != 0 {
                return None;
            }
            let page = source.bytes(at, len as usize).ok()?;
            for entry in page.chunks_exact(ENTRY) {
                let key = [0, 4, 8, 12].map(|b| u32_at(entry, b));
                let (at, bytes, count) = (u64_at(entry, 16), u32_at(entry, 24), u32_at(entry, 28) as i32);
                if key[0] > DEEPEST {
                    return None;
                }
                if count == -1 {
                    pages.push((at, bytes.into()));
                } else if count > 0 {
                    let size = 2.0 * half / f64::from(1u32 << key[0]);
                    let corner = low + Vec3::new(key[1].into(), key[2].into(), key[3].into()) * size;
                    // Coordinates are rounded to whole steps, so a point may lie a step outside its node.
                    let step = container.scale.iter().fold(0.0f64, |m, s| m.max(s.abs()));
                    let node = ScanBox { low: corner.add_scalar(-step), high: corner.add_scalar(size + step) };
                    boxes.insert(at, node);
                }
            }
        }
        Some(Self { boxes })
    }

    /// Whether the chunk that begins at this byte may hold what is wanted, by the box around it; chunks without a node may.
    pub(super) fn may_hold(&self, chunk_at: u64, wanted: impl Fn(&ScanBox) -> bool) -> bool {
        self.boxes.get(&chunk_at).is_none_or(wanted)
    }
}
