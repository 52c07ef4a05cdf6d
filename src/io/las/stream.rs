//! Positions batch by batch, and the ranges of all attributes on the way.

use super::super::error::Error;
use super::super::file_scan::{FileScan, Settings};
use super::super::source_bytes::SourceBytes;
use super::super::stream::{BATCH, Pass, ScanBox, Scope, Start};
use super::copc::Nodes;
use super::ranges::{Attributes, Ranges, merge};
use super::read::{Facts, Opened};
use super::records::Chunk;
use crate::numeric::Vec3;
use laz::DecompressionSelection;
use rayon::prelude::*;

/// Points spread over the file that a pass gets beforehand, at most.
const SEEDS: usize = 48;

/// Takes the positions of all records through `pass`; returns what is known about the file and the number of points.
pub(in super::super) fn stream(
    source: &SourceBytes,
    settings: &Settings,
    scope: Scope,
    pass: &mut dyn Pass,
) -> Result<(FileScan, u64), Error> {
    let opened = Opened::new(source, settings, None)?;
    let chunks = match scope.window.and_then(|w| Some((w, Nodes::of(source, &opened.container)?))) {
        Some((window, nodes)) => opened
            .records
            .chunks
            .iter()
            .copied()
            .filter(|c| nodes.may_hold(c.begins_at(), |node| node.meets(window)))
            .collect(),
        None => opened.records.chunks.clone(),
    };
    let attributes = scope.ranges.then(|| Attributes::of(&opened.container, &opened.fields));
    let reader = Reader { opened: &opened, attributes: attributes.as_ref(), window: scope.window };
    let points = chunks.iter().map(|c| c.count).sum();
    let seeds = if points as usize <= BATCH { Vec::new() } else { reader.seeds(&chunks)? };
    pass.begin(Start { records: points, origin: opened.origin, seeds });
    let mut seen =
        Seen { facts: Facts::NONE, ranges: attributes.as_ref().map_or(vec![], Attributes::no_ranges), given: 0 };
    let mut rest = &chunks[..];
    while let Some(first) = rest.first() {
        if first.count as usize > BATCH {
            // Pointwise LAZ has one chunk for everything; it is decoded in order, a batch at a time.
            reader.one_long_chunk(first, pass, &mut seen)?;
            rest = &rest[1..];
            continue;
        }
        let mut total = 0;
        let run = rest.iter().take_while(|c| {
            total += c.count as usize;
            total <= BATCH
        });
        let (group, others) = rest.split_at(run.count());
        reader.group(group, pass, &mut seen)?;
        rest = others;
    }
    let mut scan = opened.scan(&seen.facts);
    if let Some(attributes) = &attributes {
        scan.info.attributes = attributes.described(&seen.ranges);
    }
    if scope.window.is_some() || !scope.ranges {
        // What only a look at every attribute of every record can tell is left unsaid.
        scan.warnings.retain(|w| !["no-colors", "no-intensities", "las-bounding-box"].contains(&w.code.as_str()));
    }
    Ok((scan, seen.given))
}

/// What came by so far.
struct Seen {
    facts: Facts,
    ranges: Ranges,
    given: u64,
}

struct Reader<'a> {
    opened: &'a Opened<'a>,
    attributes: Option<&'a Attributes>,
    window: Option<&'a ScanBox>,
}

impl Reader<'_> {
    fn selection(&self) -> DecompressionSelection {
        if self.attributes.is_some() {
            DecompressionSelection::all()
        } else {
            DecompressionSelection::base().decompress_z()
        }
    }

    /// First points of chunks spread over the file.
    fn seeds(&self, chunks: &[Chunk]) -> Result<Vec<Vec3>, Error> {
        let count = SEEDS.min(chunks.len());
        let mut seeds = Vec::with_capacity(count);
        for k in 0..count {
            let chunk = chunks[k * chunks.len() / count].head();
            let mut position = [[0.0; 3]];
            self.opened.records.visit(&chunk, self.selection(), &mut |_, bytes| {
                self.opened.decoder().decode_positions(bytes, &mut position, &mut Facts::NONE.clone());
            })?;
            seeds.push(Vec3::from(position[0]));
        }
        Ok(seeds)
    }

    /// Whole records: their positions, and what they tell.
    fn piece(&self, bytes: &[u8], positions: &mut [[f64; 3]], facts: &mut Facts, ranges: &mut Ranges) {
        let record_len = self.opened.container.record_len;
        self.opened.decoder().decode_positions(bytes, positions, facts);
        if let Some(attributes) = self.attributes {
            attributes.widen(bytes, record_len, ranges);
            self.opened.decoder().count_bad_labels(bytes, facts);
            facts.intensity_max = facts.intensity_max.max(range_top(ranges, 0));
            facts.color_max = facts.color_max.max(attributes.largest_color(ranges));
        }
    }

    fn group(&self, chunks: &[Chunk], pass: &mut dyn Pass, seen: &mut Seen) -> Result<(), Error> {
        let total: usize = chunks.iter().map(|c| c.count as usize).sum();
        let mut positions = vec![[0.0f64; 3]; total];
        let mut slots = Vec::with_capacity(chunks.len());
        let mut rest = &mut positions[..];
        for chunk in chunks {
            let (head, tail) = rest.split_at_mut(chunk.count as usize);
            slots.push(head);
            rest = tail;
        }
        let found: Vec<(Facts, Ranges)> = chunks
            .par_iter()
            .zip(slots)
            .map(|(chunk, slots)| {
                let mut facts = Facts::NONE;
                let mut ranges = self.attributes.map_or(vec![], Attributes::no_ranges);
                let record_len = self.opened.container.record_len;
                self.opened.records.visit(chunk, self.selection(), &mut |first, bytes| {
                    let at = (first - chunk.first) as usize;
                    self.piece(bytes, &mut slots[at..at + bytes.len() / record_len], &mut facts, &mut ranges);
                })?;
                Ok((facts, ranges))
            })
            .collect::<Result<_, Error>>()?;
        for (facts, ranges) in found {
            seen.facts = seen.facts.merge(facts);
            seen.ranges = merge(std::mem::take(&mut seen.ranges), &ranges);
        }
        self.give(positions, pass, seen);
        Ok(())
    }

    fn one_long_chunk(&self, chunk: &Chunk, pass: &mut dyn Pass, seen: &mut Seen) -> Result<(), Error> {
        let record_len = self.opened.container.record_len;
        let mut positions = Vec::with_capacity(BATCH);
        self.opened.records.visit(chunk, self.selection(), &mut |_, bytes| {
            let from = positions.len();
            positions.resize(from + bytes.len() / record_len, [0.0; 3]);
            let mut ranges = std::mem::take(&mut seen.ranges);
            self.piece(bytes, &mut positions[from..], &mut seen.facts, &mut ranges);
            seen.ranges = ranges;
            if positions.len() >= BATCH {
                self.give(std::mem::replace(&mut positions, Vec::with_capacity(BATCH)), pass, seen);
            }
        })?;
        self.give(positions, pass, seen);
        Ok(())
    }

    fn give(&self, positions: Vec<[f64; 3]>, pass: &mut dyn Pass, seen: &mut Seen) {
        let mut positions: Vec<Vec3> = bytemuck::cast_vec(positions);
        if let Some(window) = self.window {
            positions.retain(|p| window.contains(&(p + self.opened.origin)));
        }
        seen.given += positions.len() as u64;
        pass.add(&positions);
    }
}

fn range_top(ranges: &Ranges, field: usize) -> u16 {
    ranges[field][1].clamp(0.0, 65_535.0) as u16
}
