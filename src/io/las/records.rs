//! Where the records of a LAS or LAZ file lie, and their bytes piece by piece.

use super::super::error::{COPY_AGAIN, Error};
use super::super::source_bytes::SourceBytes;
use super::gps_times::GpsTimeField;
use super::header::{Container, STANDARD_LENGTHS, u32_at, u64_at};
use super::point14::Point14;
use crate::cloud::DroppedRecords;
use crate::warning::Warning;
use laz::laszip::ChunkTable;
use laz::record::{LayeredPointRecordDecompressor, RecordDecompressor, SequentialPointRecordDecompressor};
use laz::{DecompressionSelection, LasZipError, LazItem, LazItemRecordBuilder, LazItemType, LazVlr};
use std::io::Cursor;

/// Places of the fields in a record of one point format.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Layout {
    pub(super) classification: usize,
    /// Bits of the classification byte that hold the class (the rest are flags in formats 0 to 5).
    pub(super) classification_mask: u8,
    pub(super) source_id: usize,
    pub(super) rgb: Option<usize>,
    /// Return number: byte 14, with this mask.
    pub(super) return_mask: u8,
    pub(super) standard: usize,
}

impl Layout {
    pub(super) fn of(format: u8) -> Self {
        let standard = STANDARD_LENGTHS[format as usize];
        let rgb = match format {
            2 => Some(20),
            3 | 5 => Some(28),
            7 | 8 | 10 => Some(30),
            _ => None,
        };
        if format < 6 {
            Self { classification: 15, classification_mask: 0x1f, source_id: 18, rgb, return_mask: 0x07, standard }
        } else {
            Self { classification: 16, classification_mask: 0xff, source_id: 20, rgb, return_mask: 0x0f, standard }
        }
    }
}

/// A run of records that can be decoded on its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Chunk {
    /// First record.
    pub(super) first: u64,
    /// Number of records.
    pub(super) count: u64,
    at: u64,
    bytes: u64,
}

impl Chunk {
    /// First byte in the file.
    pub(super) fn begins_at(&self) -> u64 {
        self.at
    }

    /// Only the first record of the chunk.
    pub(super) fn head(self) -> Self {
        Self { count: self.count.min(1), ..self }
    }
}

enum Coding {
    Plain,
    Sequential(LazVlr),
    Layered(LazVlr),
}

/// The records of an opened file.
pub(super) struct Records<'a> {
    source: &'a SourceBytes,
    record_len: usize,
    coding: Coding,
    pub(super) chunks: Vec<Chunk>,
    /// Records that can be read: the header's count, or fewer where a truncated file is allowed.
    pub(super) count: u64,
}

/// Records decoded at a time: small enough to stay in the second-level cache.
const PIECE_RECORDS: usize = 4096;
/// Records of an uncompressed chunk.
const PLAIN_CHUNK_RECORDS: u64 = 65_536;
/// More points than this in one byte of compressed data are not plausible even for a scan of identical points.
const MOST_POINTS_PER_BYTE: u64 = 4096;

impl<'a> Records<'a> {
    /// Plans the chunks and proves that the file can hold what its header promises.
    pub(super) fn plan(
        source: &'a SourceBytes,
        container: &Container,
        allow_truncated: bool,
        warnings: &mut Vec<Warning>,
    ) -> Result<Self, Error> {
        let record_len = container.record_len;
        let (coding, chunks) = if container.compressed {
            plan_compressed(source, container, allow_truncated, warnings)?
        } else {
            (Coding::Plain, plan_plain(source, container, allow_truncated, warnings)?)
        };
        let count = chunks.iter().map(|c| c.count).sum();
        Ok(Self { source, record_len, coding, chunks, count })
    }

    /// Leaves out the chunks that are not wanted; returns their records.
    pub(super) fn keep(&mut self, wanted: impl Fn(&Chunk) -> bool) -> DroppedRecords {
        let mut left_out = DroppedRecords::default();
        self.chunks.retain(|chunk| {
            let keep = wanted(chunk);
            if !keep {
                left_out.push(chunk.first, chunk.count);
            }
            keep
        });
        self.count -= left_out.count();
        left_out
    }

    /// Decodes one chunk piece by piece: `visit` gets the number of the first record and whole records.
    ///
    /// Fields that `selection` leaves out may be zero in layered LAZ.
    pub(super) fn visit(
        &self,
        chunk: &Chunk,
        selection: DecompressionSelection,
        visit: &mut dyn FnMut(u64, &[u8]),
    ) -> Result<(), Error> {
        let vlr = match &self.coding {
            Coding::Plain => return self.visit_plain(chunk, visit),
            Coding::Sequential(vlr) | Coding::Layered(vlr) => vlr,
        };
        let compressed = self.source.bytes(chunk.at, chunk.bytes as usize)?;
        let path = self.source.path();
        let damaged = |record: u64, cause: &dyn std::fmt::Display| {
            let last = chunk.first + chunk.count - 1;
            let cause =
                format!("compressed records {record} to {last} (bytes from {}) do not decode: {cause}", chunk.at);
            Error::bad(path, cause, COPY_AGAIN)
        };
        let mut decoder: Box<dyn RecordDecompressor<Cursor<&[u8]>>> = match &self.coding {
            Coding::Layered(_) => {
                check_layers(vlr, &compressed).map_err(|cause| damaged(chunk.first, &cause))?;
                Box::new(layered_decoder(&compressed, vlr.items()).map_err(|e| damaged(chunk.first, &e))?)
            }
            _ => Box::new(sequential_decoder(&compressed, vlr.items()).map_err(|e| damaged(chunk.first, &e))?),
        };
        decoder.set_selection(selection);
        let mut piece = vec![0; self.record_len * (chunk.count as usize).min(PIECE_RECORDS)];
        let mut done = 0;
        while done < chunk.count {
            let records = (chunk.count - done).min(PIECE_RECORDS as u64);
            let bytes = &mut piece[..records as usize * self.record_len];
            decoder.decompress_many(bytes).map_err(|e| damaged(chunk.first + done, &e))?;
            visit(chunk.first + done, bytes);
            done += records;
        }
        Ok(())
    }

    fn visit_plain(&self, chunk: &Chunk, visit: &mut dyn FnMut(u64, &[u8])) -> Result<(), Error> {
        let mut piece = vec![0; self.record_len * (chunk.count as usize).min(PIECE_RECORDS)];
        let mut done = 0;
        while done < chunk.count {
            let records = (chunk.count - done).min(PIECE_RECORDS as u64);
            let bytes = &mut piece[..records as usize * self.record_len];
            self.source.read_at(chunk.at + done * self.record_len as u64, bytes)?;
            visit(chunk.first + done, bytes);
            done += records;
        }
        Ok(())
    }
}

const TRUNCATED_REMEDY: &str = "copy or export the file again, or set ingest.allow_truncated to use what is there";

fn plan_plain(
    source: &SourceBytes,
    container: &Container,
    allow_truncated: bool,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Chunk>, Error> {
    let record_len = container.record_len as u64;
    let room = container.points_limit(source.len()) - container.points_at;
    let there = room / record_len;
    let mut count = container.count;
    if count > there {
        let cause = format!(
            "the header promises {count} records of {record_len} bytes, but only {there} fit into the {room} bytes of \
             point data"
        );
        if !allow_truncated {
            return Err(Error::bad(source.path(), cause, TRUNCATED_REMEDY));
        }
        warnings.push(Warning::new("truncated", format!("{cause}; these can be used with ingest.allow_truncated")));
        count = there;
    } else if there > count {
        warnings.push(Warning::new(
            "las-point-count",
            format!(
                "the header promises {count} records of {record_len} bytes, but the point data has room for {there}; \
                 the rest is not read"
            ),
        ));
    }
    let mut chunks = Vec::new();
    let mut first = 0;
    while first < count {
        let run = (count - first).min(PLAIN_CHUNK_RECORDS);
        chunks.push(Chunk { first, count: run, at: container.points_at + first * record_len, bytes: run * record_len });
        first += run;
    }
    Ok(chunks)
}

fn plan_compressed(
    source: &SourceBytes,
    container: &Container,
    allow_truncated: bool,
    warnings: &mut Vec<Warning>,
) -> Result<(Coding, Vec<Chunk>), Error> {
    let path = source.path();
    let bad = |cause: String| Error::bad(path, cause, COPY_AGAIN);
    let record = container
        .vlr(LazVlr::USER_ID, LazVlr::RECORD_ID)
        .ok_or_else(|| bad("it is marked as compressed but has no LASzip record".into()))?;
    if record.data.len() < 34 {
        return Err(bad(format!("the LASzip record has {} bytes, at least 34 are needed", record.data.len())));
    }
    let payload = &record.data;
    /// One chunk with all points, without a chunk table (LASzip 1.x).
    const POINTWISE: u16 = 1;
    let compressor = u16::from_le_bytes([payload[0], payload[1]]);
    let vlr = LazVlr::from_buffer(payload).map_err(|e| bad(format!("the LASzip record is unreadable: {e}")))?;
    if vlr.items().is_empty() {
        return Err(bad("the LASzip record lists no items".into()));
    }
    // The sum is taken here in full width; a wrapped sum would pass for a valid record.
    let items_size: usize = vlr.items().iter().map(|i| usize::from(i.size())).sum();
    if items_size != container.record_len {
        return Err(bad(format!(
            "the LASzip record describes records of {items_size} bytes, the header of {}",
            container.record_len
        )));
    }
    check_items(&vlr, container.format).map_err(bad)?;
    let layered = vlr.items()[0].version() >= 3;
    if !(1..=3).contains(&compressor) || (compressor == 3) != layered {
        let cause = format!("LASzip compressor {compressor} with items of version {}", vlr.items()[0].version());
        return Err(Error::unsupported(path, cause, "compress the scan again with a current LASzip"));
    }
    let available = source.len() - container.points_at;
    if container.count / MOST_POINTS_PER_BYTE > available {
        return Err(bad(format!("{} points cannot come from {available} compressed bytes", container.count)));
    }
    if compressor == POINTWISE {
        let chunk = Chunk { first: 0, count: container.count, at: container.points_at, bytes: available };
        let chunks = if container.count == 0 { vec![] } else { vec![chunk] };
        return Ok((Coding::Sequential(vlr), chunks));
    }
    let chunks = if container.count == 0 { Vec::new() } else { chunk_table(source, container, &vlr).map_err(bad)? };
    let promised: u64 = chunks.iter().map(|c| c.count).sum();
    if promised < container.count {
        let cause = format!("the header promises {} records, the chunk table lists {promised}", container.count);
        if !allow_truncated {
            return Err(Error::bad(path, cause, TRUNCATED_REMEDY));
        }
        warnings.push(Warning::new("truncated", cause));
    }
    Ok((if layered { Coding::Layered(vlr) } else { Coding::Sequential(vlr) }, chunks))
}

/// Reads the chunk table and places every chunk; all of them lie in the file.
fn chunk_table(source: &SourceBytes, container: &Container, vlr: &LazVlr) -> Result<Vec<Chunk>, String> {
    let read = |at: u64, n: usize| source.up_to(at, n).map_err(|e| e.to_string());
    let points_at = container.points_at;
    let head = read(points_at, 8)?;
    if head.len() < 8 {
        return Err(format!("the file ends at byte {} before the compressed points", source.len()));
    }
    let mut table_at = u64_at(&head, 0);
    if table_at <= points_at + 8 || table_at >= source.len() {
        // A writer that could not seek puts the offset into the last eight bytes.
        let tail = read(source.len() - 8, 8)?;
        let stated = table_at;
        table_at = u64_at(&tail, 0);
        if table_at <= points_at + 8 || table_at >= source.len() {
            return Err(format!(
                "the chunk table is said to begin at byte {stated} of {}: the compressed points are incomplete",
                source.len()
            ));
        }
    }
    let head = read(table_at, 8)?;
    if head.len() < 8 {
        return Err(format!("the chunk table at byte {table_at} is cut off"));
    }
    let entries = u64::from(u32_at(&head, 4));
    if entries == 0 || entries > container.count {
        return Err(format!("the chunk table lists {entries} chunks for {} points", container.count));
    }
    // A chunk takes its first record uncompressed, so the file bounds the number of chunks.
    if entries * container.record_len as u64 > source.len() {
        return Err(format!("the chunk table lists {entries} chunks, more than {} bytes hold", source.len()));
    }
    /// An entry takes at most two numbers of a few bytes.
    const LARGEST_ENTRY: u64 = 32;
    let bytes = read(table_at, (64 + entries * LARGEST_ENTRY) as usize)?;
    let table = ChunkTable::read(&mut Cursor::new(&bytes[..]), vlr.uses_variable_size_chunks())
        .map_err(|e| format!("the chunk table at byte {table_at} is unreadable: {e}"))?;
    let mut chunks = Vec::with_capacity(table.len());
    let (mut first, mut at) = (0, points_at + 8);
    for (index, entry) in (&table).into_iter().enumerate() {
        let left = container.count - first;
        let count = if vlr.uses_variable_size_chunks() { entry.point_count } else { u64::from(vlr.chunk_size()) };
        let end = at.checked_add(entry.byte_count).filter(|&e| e <= table_at.max(points_at));
        let Some(end) = end.filter(|_| entry.byte_count >= container.record_len as u64 || count == 0) else {
            return Err(format!(
                "chunk {index} of {} claims {} bytes from byte {at}, but the chunk table begins at byte {table_at}",
                table.len(),
                entry.byte_count
            ));
        };
        let count = count.min(left);
        if count > 0 {
            chunks.push(Chunk { first, count, at, bytes: entry.byte_count });
        }
        first += count;
        at = end;
    }
    Ok(chunks)
}

/// Checks that the LASzip items are those of the point format, and then extra bytes only; that none is missing follows from
/// the length of a record. The decoder goes by the types of the items, everything else by the stated sizes and the format.
fn check_items(vlr: &LazVlr, format: u8) -> Result<(), String> {
    let standard = LazItemRecordBuilder::default_for_point_format_id(format, 0).map_err(|e| e.to_string())?;
    for (i, item) in vlr.items().iter().enumerate() {
        let (kind, size) = (item.item_type(), item.size());
        let fits = match standard.get(i) {
            Some(due) => (kind, size) == (due.item_type(), due.size()),
            None => matches!(kind, LazItemType::Byte(_) | LazItemType::Byte14(_)),
        };
        if !fits {
            return Err(format!(
                "LASzip item {} is {kind:?} of {size} bytes, which point format {format} has not there",
                i + 1
            ));
        }
    }
    Ok(())
}

/// The decoder of a layered chunk: the points are decoded here, what comes with them by `laz`.
pub(super) fn layered_decoder<'a>(
    chunk: &'a [u8],
    items: &[LazItem],
) -> Result<LayeredPointRecordDecompressor<'a, Cursor<&'a [u8]>>, LasZipError> {
    let mut decoder = LayeredPointRecordDecompressor::new(Cursor::new(chunk));
    for item in items {
        match (item.item_type(), item.version()) {
            (LazItemType::Point14, version @ (3 | 4)) => decoder.add_field_decompressor(Point14::new(version)),
            // Goes behind those that are there.
            _ => decoder.set_fields_from(&vec![*item])?,
        }
    }
    Ok(decoder)
}

/// The decoder of a chunk without layers: the GPS times are decoded here, everything else by `laz`.
pub(super) fn sequential_decoder<'a>(
    chunk: &'a [u8],
    items: &[LazItem],
) -> Result<SequentialPointRecordDecompressor<'a, Cursor<&'a [u8]>>, LasZipError> {
    let mut decoder = SequentialPointRecordDecompressor::new(Cursor::new(chunk));
    for item in items {
        match (item.item_type(), item.version()) {
            (LazItemType::GpsTime, 2) => decoder.add_field_decompressor(GpsTimeField::default()),
            _ => decoder.set_fields_from(&vec![*item])?,
        }
    }
    Ok(decoder)
}

/// Checks that the layers announced at the head of a layered chunk fit into it, before anything is allocated for them.
fn check_layers(vlr: &LazVlr, chunk: &[u8]) -> Result<(), String> {
    let layers: usize = vlr
        .items()
        .iter()
        .map(|item| match item.item_type() {
            LazItemType::Point14 => 9,
            LazItemType::RGB14 | LazItemType::WavePacket14 => 1,
            LazItemType::RGBNIR14 => 2,
            LazItemType::Byte14(n) => usize::from(n),
            _ => 0,
        })
        .sum();
    let sizes_at = vlr.items().iter().map(|i| usize::from(i.size())).sum::<usize>() + 4;
    let data_at = sizes_at + 4 * layers;
    if chunk.len() < data_at {
        return Err(format!("a chunk of {} bytes is shorter than its list of {layers} layers", chunk.len()));
    }
    let announced: u64 = (0..layers).map(|i| u64::from(u32_at(chunk, sizes_at + 4 * i))).sum();
    let there = (chunk.len() - data_at) as u64;
    if announced > there {
        return Err(format!("its layers claim {announced} bytes of {there}"));
    }
    Ok(())
}
