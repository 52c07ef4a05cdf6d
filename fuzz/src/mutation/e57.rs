//! Damages to E57 files behind the page checksums: the pages are taken apart, damaged, and put together again.
//!
//! Reference: ASTM E2807-11. Pages of 1024 bytes end in the CRC-32C of their first 1020, most significant byte first;
//! offsets in the header count physical bytes, lengths of the XML part logical ones.

use super::{Random, bytes, text};
use std::ops::Range;

const PAGE: usize = 1024;
const PAYLOAD: usize = PAGE - 4;
const HEADER: usize = 48;
/// Header of a compressed vector: id, length, first data packet, first index packet.
const SECTION_HEADER: usize = 32;

const WORDS: [&str; 34] = [
    "Integer",
    "Float",
    "ScaledInteger",
    "Structure",
    "Vector",
    "CompressedVector",
    "String",
    "Blob",
    "single",
    "double",
    "cartesianX",
    "cartesianY",
    "cartesianZ",
    "sphericalRange",
    "sphericalAzimuth",
    "sphericalElevation",
    "cartesianInvalidState",
    "sphericalInvalidState",
    "intensity",
    "isIntensityInvalid",
    "colorRed",
    "colorGreen",
    "colorBlue",
    "isColorInvalid",
    "rowIndex",
    "columnIndex",
    "returnIndex",
    "timeStamp",
    "minimum",
    "maximum",
    "scale",
    "offset",
    "recordCount",
    "fileOffset",
];

/// Damages the XML part, the binary sections or the header; the checksums are right again, most of the time.
pub fn mutate(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let mut file: Vec<u8> = seed.chunks(PAGE).flat_map(|page| &page[..page.len().min(PAYLOAD)]).copied().collect();
    let xml = xml_range(&file);
    match random.below(8) {
        0 => bytes::overwrite(&mut file, 8..HEADER, random),
        1..=3 => xml_part(&mut file, &xml, random),
        4..=6 => sections(&mut file, xml.start, random),
        _ => {
            sections(&mut file, xml.start, random);
            xml_part(&mut file, &xml, random);
        }
    }
    let mut pages = paged(&file);
    if random.one_in(16) {
        let end = pages.len();
        bytes::overwrite(&mut pages, 0..end, random);
    }
    pages
}

/// The same file with the right checksum in every page.
pub fn mended(file: &[u8]) -> Vec<u8> {
    file.chunks(PAGE)
        .flat_map(|page| {
            let payload = &page[..page.len().min(PAYLOAD)];
            [payload, &crc32c::crc32c(payload).to_be_bytes()[..page.len() - payload.len()]].concat()
        })
        .collect()
}

fn paged(file: &[u8]) -> Vec<u8> {
    file.chunks(PAYLOAD)
        .flat_map(|payload| {
            let mut page = payload.to_vec();
            page.resize(PAYLOAD, 0);
            let sum = crc32c::crc32c(&page).to_be_bytes();
            page.extend(sum);
            page
        })
        .collect()
}

fn u64_at(bytes: &[u8], at: usize) -> usize {
    let number = bytes.get(at..at + 8).map_or(0, |b| u64::from_le_bytes(b.try_into().expect("eight bytes")));
    usize::try_from(number).unwrap_or(usize::MAX)
}

/// Where the XML lies in the file without checksums.
fn xml_range(file: &[u8]) -> Range<usize> {
    let physical = u64_at(file, 24);
    let start = (physical / PAGE * PAYLOAD).saturating_add(physical % PAGE).min(file.len());
    start..start.saturating_add(u64_at(file, 32)).min(file.len())
}

/// Damages the XML; its length in the header follows, most of the time. The writer puts it last.
fn xml_part(file: &mut Vec<u8>, xml: &Range<usize>, random: &mut Random) {
    let damaged = text::marked(&file[xml.clone()], b"<>\"", &WORDS, random);
    let length = damaged.len() as u64;
    file.splice(xml.clone(), damaged);
    if random.one_in(12) {
        return;
    }
    bytes::put(file, 32, &length.to_le_bytes());
    let physical = (file.len().div_ceil(PAYLOAD) * PAGE) as u64;
    bytes::put(file, 16, &physical.to_le_bytes());
}

/// Damages section headers, packet headers, lengths of byte streams, or the bits of the points.
fn sections(file: &mut [u8], end: usize, random: &mut Random) {
    let places = packets(file, end);
    for _ in 0..=random.below(4) {
        match (random.below(4), places.is_empty()) {
            (0, _) => bytes::overwrite(file, HEADER..HEADER + SECTION_HEADER, random),
            (1, false) => {
                let packet = random.pick(&places).clone();
                let field = *random.pick(&[0usize, 1, 2, 4]);
                let number = bytes::awkward(random).to_le_bytes();
                bytes::put(file, packet.start + field, &number[..if field < 2 { 1 } else { 2 }]);
            }
            (2, false) => {
                let packet = random.pick(&places).clone();
                bytes::overwrite(file, packet.start + 6..packet.start + 22, random);
            }
            (_, false) => {
                let packet = random.pick(&places).clone();
                bytes::overwrite(file, packet, random);
            }
            _ => bytes::overwrite(file, HEADER..end, random),
        }
    }
}

/// Data packets, as far as their lengths lead from one to the next.
fn packets(file: &[u8], end: usize) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    let mut at = HEADER;
    while at + SECTION_HEADER < end {
        match file[at] {
            // A section's header looks like a packet with reserved bytes; its length field is eight bytes long.
            1 if file[at + 1..at + 8].iter().all(|&b| b == 0) => at += SECTION_HEADER,
            0..=2 => {
                let length = usize::from(u16::from_le_bytes([file[at + 2], file[at + 3]])) + 1;
                found.push(at..(at + length).min(end));
                at += length;
            }
            _ => break,
        }
    }
    found
}
