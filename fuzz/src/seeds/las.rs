//! LAS and LAZ files that Adit's writer does not choose: all versions and point formats, headers made by hand.

use laz::laszip::{ChunkTable, ChunkTableEntry};
use laz::{LasZipCompressor, LazItemRecordBuilder, LazVlr, LazVlrBuilder};
use std::io::Cursor;

const RECORD_LENGTHS: [usize; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];
/// Bytes of one value of each type of extra bytes.
const EXTRA_SIZES: [usize; 11] = [0, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8];

/// What a file is made of.
struct Recipe {
    minor: u8,
    format: u8,
    points: usize,
    /// Bytes after the standard fields of each record, described by the extra-bytes record `vlrs` may have.
    extra: usize,
    vlrs: Vec<(&'static str, u16, Vec<u8>)>,
    evlrs: Vec<(&'static str, u16, Vec<u8>)>,
}

impl Recipe {
    fn new(minor: u8, format: u8, points: usize) -> Self {
        Self { minor, format, points, extra: 0, vlrs: Vec::new(), evlrs: Vec::new() }
    }

    fn record_len(&self) -> usize {
        RECORD_LENGTHS[usize::from(self.format)] + self.extra
    }

    /// Records whose coordinates, colours and times change from one to the next.
    fn records(&self) -> Vec<u8> {
        let mut all = Vec::new();
        for point in 0..self.points {
            let mut record: Vec<u8> = (0..self.record_len()).map(|i| (i * point) as u8).collect();
            for axis in 0..3 {
                let step = (point * (axis + 1) * 7 % 100) as i32;
                record[4 * axis..4 * axis + 4].copy_from_slice(&step.to_le_bytes());
            }
            all.extend(record);
        }
        all
    }

    /// The file around point data that begins where `points` is told.
    fn around(mut self, compressed: bool, points: impl FnOnce(usize) -> Vec<u8>) -> Vec<u8> {
        let header_len: usize = match self.minor {
            4 => 375,
            3 => 235,
            _ => 227,
        };
        let mut vlrs = Vec::new();
        for (user, id, data) in std::mem::take(&mut self.vlrs) {
            vlrs.extend(record_header(user, id, &(data.len() as u16).to_le_bytes(), 54));
            vlrs.extend(data);
        }
        let points_at = header_len + vlrs.len();
        let body = points(points_at);
        let evlrs_at = if self.evlrs.is_empty() { 0 } else { (points_at + body.len()) as u64 };
        let mut file = vec![0u8; header_len];
        let mut put = |at: usize, bytes: &[u8]| file[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, b"LASF");
        put(24, &[1, self.minor]);
        put(94, &(header_len as u16).to_le_bytes());
        put(96, &(points_at as u32).to_le_bytes());
        let vlr_count = if vlrs.is_empty() { 0 } else { count_records(&vlrs) };
        put(100, &vlr_count.to_le_bytes());
        put(104, &[self.format | if compressed { 0x80 } else { 0 }]);
        put(105, &(self.record_len() as u16).to_le_bytes());
        if self.format < 6 {
            put(107, &(self.points as u32).to_le_bytes());
        }
        for axis in 0..3 {
            put(131 + 8 * axis, &0.01f64.to_le_bytes());
            put(179 + 16 * axis, &0.99f64.to_le_bytes());
        }
        if self.minor == 4 {
            put(235, &evlrs_at.to_le_bytes());
            put(243, &(self.evlrs.len() as u32).to_le_bytes());
            put(247, &(self.points as u64).to_le_bytes());
        }
        let mut file = [file, vlrs, body].concat();
        for (user, id, data) in self.evlrs {
            file.extend(record_header(user, id, &(data.len() as u64).to_le_bytes(), 60));
            file.extend(data);
        }
        file
    }

    fn plain(self) -> Vec<u8> {
        let records = self.records();
        self.around(false, |_| records)
    }

    /// Compressed in chunks of `chunk` points, which may also differ in size.
    fn chunked(mut self, chunk: usize, variable: bool) -> Vec<u8> {
        let vlr = self.laszip(chunk, variable);
        let record_len = self.record_len();
        let (records, vlr_bytes) = (self.records(), bytes_of(&vlr));
        self.vlrs.push((LazVlr::USER_ID, LazVlr::RECORD_ID, vlr_bytes));
        self.around(true, |points_at| compress(&records, record_len, vlr, points_at, variable.then_some(chunk)))
    }

    /// One stream without a table, as LASzip 1.x wrote it.
    fn pointwise(mut self) -> Vec<u8> {
        let vlr = self.laszip(1 << 20, false);
        let mut record = bytes_of(&vlr);
        record[0] = 1;
        self.vlrs.push((LazVlr::USER_ID, LazVlr::RECORD_ID, record));
        let (records, record_len) = (self.records(), self.record_len());
        self.around(true, |_| {
            let stream = compress(&records, record_len, vlr, 0, None);
            let table_at = u64::from_le_bytes(stream[..8].try_into().expect("eight bytes")) as usize;
            stream[8..table_at].to_vec()
        })
    }

    fn laszip(&self, chunk: usize, variable: bool) -> LazVlr {
        let items = LazItemRecordBuilder::default_for_point_format_id(self.format, self.extra as u16)
            .expect("a point format that LASzip knows");
        let builder = LazVlrBuilder::new(items);
        if variable {
            builder.with_variable_chunk_size().build()
        } else {
            builder.with_fixed_chunk_size(chunk as u32).build()
        }
    }
}

fn bytes_of(vlr: &LazVlr) -> Vec<u8> {
    let mut bytes = Vec::new();
    vlr.write_to(&mut &mut bytes).expect("bytes in memory");
    bytes
}

fn compress(records: &[u8], record_len: usize, vlr: LazVlr, points_at: usize, variable: Option<usize>) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![0; points_at]);
    bytes.set_position(points_at as u64);
    let mut compressor = LasZipCompressor::new(&mut bytes, vlr).expect("items of a point format");
    match variable {
        Some(chunk) => {
            for (i, run) in records.chunks(chunk * record_len).enumerate() {
                if i > 0 {
                    compressor.finish_current_chunk().expect("bytes in memory");
                }
                compressor.compress_many(run).expect("bytes in memory");
            }
        }
        None => compressor.compress_many(records).expect("bytes in memory"),
    }
    compressor.done().expect("bytes in memory");
    drop(compressor);
    bytes.into_inner().split_off(points_at)
}

fn record_header(user: &str, id: u16, length: &[u8], size: usize) -> Vec<u8> {
    let mut header = vec![0; size];
    header[2..2 + user.len()].copy_from_slice(user.as_bytes());
    header[18..20].copy_from_slice(&id.to_le_bytes());
    header[20..20 + length.len()].copy_from_slice(length);
    header
}

fn count_records(vlrs: &[u8]) -> u32 {
    let (mut at, mut count) = (0, 0);
    while at < vlrs.len() {
        at += 54 + usize::from(u16::from_le_bytes([vlrs[at + 20], vlrs[at + 21]]));
        count += 1;
    }
    count
}

/// Extra bytes of every scalar type with scale, offset and no-data, and their description.
fn extra_bytes() -> (usize, Vec<u8>) {
    let mut described = Vec::new();
    for kind in 1..=10u8 {
        let mut field = vec![0; 192];
        (field[2], field[3]) = (kind, if kind % 2 == 0 { 0b11001 } else { 0 });
        let name = if kind == 3 { "label".to_owned() } else { format!("extra {kind}") };
        field[4..4 + name.len()].copy_from_slice(name.as_bytes());
        field[112..120].copy_from_slice(&0.5f64.to_le_bytes());
        field[136..144].copy_from_slice(&2.0f64.to_le_bytes());
        described.extend(field);
    }
    (EXTRA_SIZES.iter().sum(), described)
}

/// Keys that say: a projected system in metres, by its number.
fn geo_keys() -> Vec<u8> {
    [1u16, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 25832, 3076, 0, 1, 9001].iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// LAS 1.0 to 1.4, all point formats, extra bytes, reference systems, extended records.
pub fn las() -> Vec<Vec<u8>> {
    let minors = [0, 1, 2, 2, 3, 3, 4, 4, 4, 4, 4];
    let mut all: Vec<Vec<u8>> =
        (0..11u8).map(|format| Recipe::new(minors[usize::from(format)], format, 3).plain()).collect();
    let (extra, described) = extra_bytes();
    let wkt = b"PROJCS[\"UTM 32\",GEOGCS[\"WGS 84\"],UNIT[\"metre\",1]]\0".to_vec();
    all.push(
        Recipe {
            extra,
            vlrs: vec![("LASF_Spec", 4, described), ("LASF_Projection", 34735, geo_keys())],
            ..Recipe::new(2, 3, 5)
        }
        .plain(),
    );
    all.push(
        Recipe {
            vlrs: vec![("LASF_Projection", 2112, wkt)],
            evlrs: vec![("LASF_Spec", 65535, vec![7; 40]), ("else", 9, vec![1, 2, 3])],
            ..Recipe::new(4, 7, 5)
        }
        .plain(),
    );
    all
}

/// All point formats in chunks of one size and of many, pointwise, with extra bytes, and a COPC.
pub fn laz() -> Vec<Vec<u8>> {
    let minors = [0, 1, 2, 2, 3, 3, 4, 4, 4, 4, 4];
    let recipe = |format: u8| Recipe::new(minors[usize::from(format)], format, 40);
    // The coder knows no waveforms before version 3 of its items, so formats 4 and 5 are left out.
    let mut all: Vec<Vec<u8>> = [0, 1, 2, 3, 6, 7, 8, 9, 10].map(|format| recipe(format).chunked(15, false)).into();
    all.push(recipe(7).chunked(9, true));
    all.push(recipe(3).pointwise());
    let (extra, described) = extra_bytes();
    for format in [3, 6] {
        let vlrs = vec![("LASF_Spec", 4, described.clone())];
        all.push(Recipe { extra, vlrs, ..recipe(format) }.chunked(25, false));
    }
    all.push(copc());
    all
}

/// A root and one child, each with twenty points.
fn copc() -> Vec<u8> {
    let mut recipe = Recipe::new(4, 7, 40);
    let info = vec![0; 160];
    recipe.vlrs.push(("copc", 1, info));
    recipe.evlrs.push(("copc", 1000, vec![0; 64]));
    let mut file = recipe.chunked(20, true);
    let number = |at: usize| u64::from_le_bytes(file[at..at + 8].try_into().expect("eight bytes"));
    let hierarchy_at = number(235) + 60;
    let points_at = u64::from(u32::from_le_bytes(file[96..100].try_into().expect("four bytes")));
    let mut source = Cursor::new(&file[..]);
    source.set_position(points_at);
    let laszip_at = file.windows(14).position(|w| w == b"laszip encoded").expect("the record was written") + 52;
    let vlr = LazVlr::from_buffer(&file[laszip_at..]).expect("the record was written");
    let table = ChunkTable::read_from(&mut source, &vlr).expect("the table was written");
    let mut hierarchy = Vec::new();
    let mut at = points_at + 8;
    let entries: Vec<&ChunkTableEntry> = (&table).into_iter().collect();
    for (level, entry) in entries.into_iter().enumerate() {
        [level as u32, 0, 0, 0].iter().for_each(|v| hierarchy.extend(v.to_le_bytes()));
        hierarchy.extend(at.to_le_bytes());
        hierarchy.extend((entry.byte_count as u32).to_le_bytes());
        hierarchy.extend((entry.point_count as u32).to_le_bytes());
        at += entry.byte_count;
    }
    let place = hierarchy_at as usize;
    let length = hierarchy.len();
    file[place..place + length].copy_from_slice(&hierarchy);
    // The info record stands first: centre, half size, spacing, and where the root page of the hierarchy is.
    let info_at = 375 + 54;
    for (i, value) in [0.5f64, 0.5, 0.5, 0.5, 0.1].into_iter().enumerate() {
        file[info_at + 8 * i..info_at + 8 * i + 8].copy_from_slice(&value.to_le_bytes());
    }
    file[info_at + 40..info_at + 48].copy_from_slice(&hierarchy_at.to_le_bytes());
    file[info_at + 48..info_at + 56].copy_from_slice(&(length as u64).to_le_bytes());
    file
}
