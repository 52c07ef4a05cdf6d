//! Damages to LAS and LAZ files by their parts: header fields, variable length records, points, chunks, chunk table.
//!
//! A file is taken apart, one part is damaged, and it is put together again with offsets and a chunk table that fit, so
//! that what lies behind them is reached; sometimes a field is damaged after that.

use super::{Random, bytes};
use laz::LazVlr;
use laz::laszip::{ChunkTable, ChunkTableEntry};
use std::io::Cursor;

const VLR_HEADER: usize = 54;
const EVLR_HEADER: usize = 60;

/// Fields of the header: first byte and width; those of eight bytes from 131 to 226 are floating point numbers.
const FIELDS: [(usize, usize); 34] = [
    (4, 2),
    (6, 2),
    (24, 1),
    (25, 1),
    (94, 2),
    (96, 4),
    (100, 4),
    (104, 1),
    (105, 2),
    (107, 4),
    (111, 4),
    (115, 4),
    (119, 4),
    (123, 4),
    (127, 4),
    (131, 8),
    (139, 8),
    (147, 8),
    (155, 8),
    (163, 8),
    (171, 8),
    (179, 8),
    (187, 8),
    (195, 8),
    (203, 8),
    (211, 8),
    (219, 8),
    (227, 8),
    (235, 8),
    (243, 4),
    (247, 8),
    (255, 8),
    (263, 8),
    (367, 8),
];
const USERS: [&str; 6] = ["LASF_Spec", "LASF_Projection", "laszip encoded", "copc", "liblas", ""];
const RECORDS: [u16; 10] = [0, 1, 3, 4, 1000, 2112, 22204, 34735, 34736, 34737];
const RECORD_LENGTHS: [u16; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];

/// Damages one part of a file and keeps the others.
pub fn mutate(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let Some(mut parts) = Parts::of(seed) else {
        let mut damaged = seed.to_vec();
        let end = damaged.len();
        bytes::overwrite(&mut damaged, 0..end, random);
        return damaged;
    };
    for _ in 0..=random.below(3) {
        match random.below(8) {
            0 | 1 => field(&mut parts.header, random),
            2 => records(&mut parts.vlrs, VLR_HEADER, random),
            3 => records(&mut parts.evlrs, EVLR_HEADER, random),
            4 => parts.format(random),
            _ => parts.points(random),
        }
    }
    let mut file = parts.joined(random);
    if random.one_in(8) {
        field(&mut file, random);
    }
    file
}

fn field(header: &mut [u8], random: &mut Random) {
    let (at, width) = *random.pick(&FIELDS);
    if (131..227).contains(&at) && !random.one_in(8) {
        bytes::put(header, at, &bytes::awkward_float(random).to_le_bytes());
    } else if random.one_in(3) && at < header.len() {
        header[at] = header[at].wrapping_add(random.below(9) as u8).wrapping_sub(4);
    } else {
        bytes::put(header, at, &bytes::awkward(random).to_le_bytes()[..width]);
    }
}

/// Damages one variable length record, exchanges it, or lets it go.
fn records(all: &mut Vec<Vec<u8>>, header: usize, random: &mut Random) {
    if all.is_empty() {
        let mut record = vec![0; header];
        identity(&mut record, random);
        record.resize(header + random.below(256), random.next() as u8);
        all.push(record);
        return;
    }
    let at = random.below(all.len());
    match random.below(8) {
        0 => identity(&mut all[at], random),
        1 => bytes::overwrite(&mut all[at], 0..header, random),
        2 => drop(all.remove(at)),
        3 => {
            let record = all[at].clone();
            all.push(record);
        }
        4 => {
            let length = header + random.below(2 * (all[at].len() - header) + 8);
            all[at].resize(length, 0);
        }
        _ => {
            let end = all[at].len();
            bytes::overwrite(&mut all[at], header..end, random);
        }
    }
}

fn identity(record: &mut [u8], random: &mut Random) {
    let mut user = [0; 16];
    bytes::put(&mut user, 0, random.pick(&USERS).as_bytes());
    bytes::put(record, 2, &user);
    bytes::put(record, 18, &random.pick(&RECORDS).to_le_bytes());
}

/// The points of a file.
enum Points {
    /// Records, or one stream of compressed ones without a table.
    Whole(Vec<u8>),
    /// Chunks with their numbers of points.
    Chunked(LazVlr, Vec<(u64, Vec<u8>)>),
}

struct Parts {
    header: Vec<u8>,
    vlrs: Vec<Vec<u8>>,
    points: Points,
    evlrs: Vec<Vec<u8>>,
    /// Where the points were: a COPC tells places by the byte, and holds while nothing before the points grows.
    points_at: usize,
}

fn number<const N: usize>(bytes: &[u8], at: usize) -> Option<u64> {
    let mut whole = [0; 8];
    whole[..N].copy_from_slice(bytes.get(at..at + N)?);
    Some(u64::from_le_bytes(whole))
}

impl Parts {
    fn of(file: &[u8]) -> Option<Self> {
        let place = |v: u64| usize::try_from(v).ok().filter(|&p| p <= file.len());
        let header_len = place(number::<2>(file, 94)?)?;
        let points_at = place(number::<4>(file, 96)?)?;
        let mut at = header_len;
        let mut vlrs = Vec::new();
        for _ in 0..number::<4>(file, 100)? {
            let end = at + VLR_HEADER + place(number::<2>(file, at + 20)?)?;
            vlrs.push(file.get(at..end)?.to_vec());
            at = end;
        }
        let (mut evlrs, mut points_end) = (Vec::new(), file.len());
        if file[25] >= 4 && number::<4>(file, 243)? > 0 {
            let mut at = place(number::<8>(file, 235)?)?;
            points_end = at;
            for _ in 0..number::<4>(file, 243)? {
                let end = at.checked_add(EVLR_HEADER)?.checked_add(place(number::<8>(file, at + 20)?)?)?;
                evlrs.push(file.get(at..end)?.to_vec());
                at = end;
            }
        }
        let body = file.get(points_at..points_end)?;
        let laszip = vlrs.iter().find(|v| v[2..].starts_with(b"laszip encoded") && file[104] & 0x80 != 0);
        let vlr = laszip.and_then(|v| LazVlr::from_buffer(&v[VLR_HEADER..]).ok());
        // The first number of the record is the kind of compressor; 1 has neither chunks nor table.
        let pointwise = laszip.is_some_and(|v| v.get(VLR_HEADER) == Some(&1));
        let points = match vlr.filter(|_| !pointwise) {
            None => Points::Whole(body.to_vec()),
            Some(vlr) => {
                let mut source = Cursor::new(file);
                source.set_position(points_at as u64);
                let table = ChunkTable::read_from(&mut source, &vlr).ok()?;
                let mut at = points_at + 8;
                let mut chunks = Vec::new();
                for entry in &table {
                    let end = at.checked_add(place(entry.byte_count)?)?;
                    chunks.push((entry.point_count, file.get(at..end)?.to_vec()));
                    at = end;
                }
                Points::Chunked(vlr, chunks)
            }
        };
        Some(Self { header: file[..header_len].to_vec(), vlrs, points, evlrs, points_at })
    }

    /// Another point format, with records of a length that goes with it.
    fn format(&mut self, random: &mut Random) {
        let format = random.below(11);
        self.header[104] = self.header[104] & 0xc0 | format as u8;
        let length = RECORD_LENGTHS[format] + *random.pick(&[0, 0, 1, 4, 9]);
        bytes::put(&mut self.header, 105, &length.to_le_bytes());
    }

    fn points(&mut self, random: &mut Random) {
        let record = usize::from(u16::from_le_bytes([self.header[105], self.header[106]]));
        match &mut self.points {
            Points::Whole(all) if random.one_in(4) => all.truncate(random.below(all.len() + 1)),
            Points::Whole(all) => {
                let end = all.len();
                bytes::overwrite(all, 0..end, random);
            }
            Points::Chunked(_, chunks) if !chunks.is_empty() => {
                let at = random.below(chunks.len());
                let (count, chunk) = &mut chunks[at];
                // Layered chunks begin with a whole record, the number of points, and the sizes of the layers.
                let sizes = (record + 4..record + 4 + 4 * 12).start.min(chunk.len())..chunk.len().min(record + 52);
                match random.below(10) {
                    0 => drop(chunks.remove(at)),
                    1 => {
                        let copy = chunks[at].clone();
                        chunks.insert(at, copy);
                    }
                    2 => chunk.truncate(random.below(chunk.len() + 1)),
                    3 => *count = bytes::awkward(random),
                    4 => bytes::put(chunk, record, &bytes::awkward(random).to_le_bytes()[..4]),
                    5 | 6 if sizes.len() >= 8 => {
                        // One layer gives a byte or more to another: the sum still holds.
                        let layers = sizes.len() / 4;
                        let (a, b) = (sizes.start + 4 * random.below(layers), sizes.start + 4 * random.below(layers));
                        let moved = random.below(16) as u32;
                        for (place, sign) in [(a, 1i64), (b, -1)] {
                            let now = number::<4>(chunk, place).unwrap_or(0) as i64 + sign * i64::from(moved);
                            bytes::put(chunk, place, &(now as u32).to_le_bytes());
                        }
                    }
                    7 => bytes::overwrite(chunk, sizes, random),
                    _ => {
                        let end = chunk.len();
                        bytes::overwrite(chunk, 0..end, random);
                    }
                }
            }
            Points::Chunked(..) => {}
        }
    }

    /// The file with lengths, offsets and chunk table as the parts need them, most of the time.
    fn joined(mut self, random: &mut Random) -> Vec<u8> {
        let mend = !random.one_in(12);
        let header_len = self.header.len();
        let vlr_bytes: usize = self.vlrs.iter().map(Vec::len).sum();
        // Room between the records and the points is legal, and keeps the places that a COPC names.
        let points_at = (header_len + vlr_bytes).max(self.points_at);
        if mend {
            bytes::put(&mut self.header, 94, &(header_len as u16).to_le_bytes());
            bytes::put(&mut self.header, 96, &(points_at as u32).to_le_bytes());
            bytes::put(&mut self.header, 100, &(self.vlrs.len() as u32).to_le_bytes());
            for record in &mut self.vlrs {
                let length = record.len().saturating_sub(VLR_HEADER) as u16;
                bytes::put(record, 20, &length.to_le_bytes());
            }
            for record in &mut self.evlrs {
                let length = record.len().saturating_sub(EVLR_HEADER) as u64;
                bytes::put(record, 20, &length.to_le_bytes());
            }
        }
        let mut file = [self.header, self.vlrs.concat()].concat();
        file.resize(points_at, 0);
        match self.points {
            Points::Whole(all) => file.extend(all),
            Points::Chunked(vlr, chunks) => {
                let table_at = points_at + 8 + chunks.iter().map(|c| c.1.len()).sum::<usize>();
                file.extend((table_at as u64).to_le_bytes());
                let mut table = ChunkTable::with_capacity(chunks.len());
                for (point_count, chunk) in chunks {
                    table.push(ChunkTableEntry { point_count, byte_count: chunk.len() as u64 });
                    file.extend(chunk);
                }
                // A count that the coder cannot write leaves a file without a table, which is an input as well.
                let _ = table.write_to(&mut file, &vlr);
            }
        }
        if mend && file.len() >= 375 && file[25] >= 4 && header_len >= 375 {
            let at = if self.evlrs.is_empty() { 0 } else { file.len() as u64 };
            bytes::put(&mut file, 235, &at.to_le_bytes());
            bytes::put(&mut file, 243, &(self.evlrs.len() as u32).to_le_bytes());
        }
        file.extend(self.evlrs.concat());
        file
    }
}
