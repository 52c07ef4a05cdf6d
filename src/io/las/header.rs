//! The public header block and the variable length records of LAS 1.0 to 1.4, kept as the bytes that they are.
//!
//! Source: ASPRS, *LAS Specification 1.4 - R15* (2019). Adit keeps the raw header and record bytes, so that a file
//! that is written again differs from its source only where it must.

use super::super::error::{COPY_AGAIN, Error};
use super::super::source_bytes::SourceBytes;
use crate::warning::Warning;

/// Byte length of the header of a variable length record.
pub(super) const VLR_HEADER: usize = 54;
/// Byte length of the header of an extended variable length record.
pub(super) const EVLR_HEADER: usize = 60;
/// No header of LAS 1.0 to 1.4 is shorter.
const SMALLEST_HEADER: usize = 227;

/// A variable length record: header fields and payload.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Vlr {
    /// The record's header as stored (54 bytes; 60 for an extended one).
    pub(super) header: Vec<u8>,
    /// The payload.
    pub(super) data: Vec<u8>,
}

impl Vlr {
    /// The user id, without padding.
    pub(super) fn user_id(&self) -> String {
        text(&self.header[2..18])
    }

    pub(super) fn record_id(&self) -> u16 {
        u16::from_le_bytes([self.header[18], self.header[19]])
    }

    pub(super) fn is(&self, user_id: &str, record_id: u16) -> bool {
        self.record_id() == record_id && self.user_id() == user_id
    }

    /// A new (short) record.
    pub(super) fn new(user_id: &str, record_id: u16, description: &str, data: Vec<u8>) -> Self {
        let mut header = vec![0; VLR_HEADER];
        header[2..2 + user_id.len()].copy_from_slice(user_id.as_bytes());
        header[18..20].copy_from_slice(&record_id.to_le_bytes());
        header[20..22].copy_from_slice(&(data.len() as u16).to_le_bytes());
        let description = &description.as_bytes()[..description.len().min(32)];
        header[22..22 + description.len()].copy_from_slice(description);
        Self { header, data }
    }
}

/// Text of a fixed field up to the first zero byte; bytes that are not ASCII become `?`.
pub(super) fn text(bytes: &[u8]) -> String {
    bytes.iter().take_while(|&&b| b != 0).map(|&b| if b.is_ascii() { b as char } else { '?' }).collect::<String>()
}

/// Everything in a LAS or LAZ file but the points.
#[derive(Clone, Debug)]
pub(super) struct Container {
    /// The public header block as stored.
    pub(super) raw: Vec<u8>,
    pub(super) minor: u8,
    pub(super) format: u8,
    pub(super) compressed: bool,
    pub(super) record_len: usize,
    pub(super) count: u64,
    pub(super) scale: [f64; 3],
    pub(super) offset: [f64; 3],
    pub(super) min: [f64; 3],
    pub(super) max: [f64; 3],
    pub(super) vlrs: Vec<Vlr>,
    /// Bytes between the last variable length record and the first point.
    pub(super) gap: Vec<u8>,
    pub(super) points_at: u64,
    /// Extended records, read only when small enough to be of interest.
    pub(super) evlrs: Vec<Vlr>,
    /// First byte and length (header included) of each extended record.
    pub(super) evlr_spans: Vec<[u64; 2]>,
    /// Where the extended records begin, 0 when there are none.
    pub(super) evlrs_at: u64,
    pub(super) evlr_count: u32,
    /// Start of the waveform data record, 0 when there is none.
    pub(super) waveform_at: u64,
    pub(super) warnings: Vec<Warning>,
}

pub(super) fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

pub(super) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

pub(super) fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

/// Byte length of a record of each point format, without extra bytes.
pub(super) const STANDARD_LENGTHS: [usize; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];

impl Container {
    /// Reads the header and all variable length records, and checks what can be checked without the points.
    pub(super) fn read(source: &SourceBytes) -> Result<Self, Error> {
        let path = source.path();
        let head = source.up_to(0, 375)?;
        if head.len() < SMALLEST_HEADER {
            let cause = format!("{} bytes are fewer than the {SMALLEST_HEADER} of the smallest LAS header", head.len());
            return Err(Error::bad(path, cause, COPY_AGAIN));
        }
        if &head[..4] != b"LASF" {
            let cause = format!("it begins with {:?} instead of \"LASF\"", text(&head[..4]));
            return Err(Error::bad(path, cause, "it is not a LAS or LAZ file"));
        }
        let (major, minor) = (head[24], head[25]);
        if major != 1 || minor > 4 {
            let cause = format!("LAS version {major}.{minor}");
            return Err(Error::unsupported(path, cause, "export it as LAS 1.0 to 1.4"));
        }
        let header_size = u16_at(&head, 94) as usize;
        let needed = match minor {
            4 => 375,
            3 => 235,
            _ => SMALLEST_HEADER,
        };
        if header_size < needed || header_size as u64 > source.len() {
            let cause = format!(
                "header size {header_size} is impossible for LAS 1.{minor} (at least {needed}) in a file of {} bytes",
                source.len()
            );
            return Err(Error::bad(path, cause, COPY_AGAIN));
        }
        let raw = source.bytes(0, header_size)?;
        let points_at = u64::from(u32_at(&raw, 96));
        let vlr_count = u32_at(&raw, 100);
        // Bit 7 marks LAZ; bit 6 does in files of very old compressors.
        let compressed = raw[104] & 0b1100_0000 != 0;
        let format = raw[104] & 0b0011_1111;
        let record_len = u16_at(&raw, 105) as usize;
        let mut warnings = Vec::new();
        if format > 10 {
            let cause = format!("point format {format}");
            return Err(Error::unsupported(path, cause, "formats 0 to 10 exist; export the scan again"));
        }
        let standard = STANDARD_LENGTHS[format as usize];
        if record_len < standard {
            let cause = format!("records of {record_len} bytes cannot hold point format {format} ({standard} bytes)");
            return Err(Error::bad(path, cause, COPY_AGAIN));
        }
        if points_at < header_size as u64 || points_at > source.len() {
            let cause = format!(
                "points are said to begin at byte {points_at}, outside the file's {header_size}..{} bytes",
                source.len()
            );
            return Err(Error::bad(path, cause, COPY_AGAIN));
        }
        let count = point_count(&raw, minor, format, &mut warnings);
        let triple = |at: usize, step: usize| [0, 1, 2].map(|i| f64_at(&raw, at + i * step));
        let (scale, offset) = (triple(131, 8), triple(155, 8));
        for (name, values) in [("scale", scale), ("offset", offset)] {
            if let Some(axis) = values.iter().position(|v| !v.is_finite() || (name == "scale" && *v == 0.0)) {
                let cause = format!("the {name} of {} is {}", ["x", "y", "z"][axis], values[axis]);
                return Err(Error::bad(path, cause, "export the scan again with a valid scale and offset"));
            }
        }
        if let Some(axis) = (0..3).find(|&i| !(scale[i] * f64::from(i32::MIN) + offset[i]).is_finite()) {
            let cause = format!("scale {:e} overflows on {}", scale[axis], ["x", "y", "z"][axis]);
            return Err(Error::bad(path, cause, "export the scan again with a valid scale and offset"));
        }
        let (vlrs, vlr_end) = read_vlrs(source, header_size, points_at, vlr_count, &mut warnings)?;
        let gap = source.bytes(vlr_end, (points_at - vlr_end) as usize)?;
        let waveform_at = if minor >= 3 { u64_at(&raw, 227) } else { 0 };
        let (evlrs_at, evlr_count) = if minor >= 4 { (u64_at(&raw, 235), u32_at(&raw, 243)) } else { (0, 0) };
        let mut container = Self {
            minor,
            format,
            compressed,
            record_len,
            count,
            scale,
            offset,
            // Stored as max x, min x, max y, min y, max z, min z.
            max: triple(179, 16),
            min: triple(187, 16),
            vlrs,
            gap,
            points_at,
            evlrs: Vec::new(),
            evlr_spans: Vec::new(),
            evlrs_at,
            evlr_count,
            waveform_at,
            warnings,
            raw,
        };
        container.read_evlrs(source)?;
        Ok(container)
    }

    /// Reads the extended records; a table that leaves the file is reported and skipped.
    fn read_evlrs(&mut self, source: &SourceBytes) -> Result<(), Error> {
        /// Larger payloads are waveforms or indexes; none of them is interpreted here.
        const LARGEST_OF_INTEREST: u64 = 1 << 20;
        if self.evlr_count == 0 {
            self.evlrs_at = 0;
            return Ok(());
        }
        let mut at = self.evlrs_at;
        for index in 0..self.evlr_count {
            let fits = at >= self.points_at && at.checked_add(EVLR_HEADER as u64).is_some_and(|e| e <= source.len());
            let size = if fits { u64_at(&source.bytes(at, EVLR_HEADER)?, 20) } else { 0 };
            let end = at.checked_add(EVLR_HEADER as u64).and_then(|b| b.checked_add(size));
            let Some(end) = end.filter(|&e| fits && e <= source.len()) else {
                self.warnings.push(Warning::new(
                    "las-extended-records",
                    format!(
                        "extended variable length record {index} of {} at byte {at} leaves the file of {} bytes; \
                         it and those after it are ignored",
                        self.evlr_count,
                        source.len()
                    ),
                ));
                break;
            };
            let header = source.bytes(at, EVLR_HEADER)?;
            let data = if size <= LARGEST_OF_INTEREST {
                source.bytes(at + EVLR_HEADER as u64, size as usize)?
            } else {
                vec![]
            };
            self.evlrs.push(Vlr { header, data });
            self.evlr_spans.push([at, end - at]);
            at = end;
        }
        Ok(())
    }

    /// Changes the offset of the coordinates, here and in the stored header.
    pub(super) fn set_offset(&mut self, offset: [f64; 3]) {
        self.offset = offset;
        for (axis, value) in offset.iter().enumerate() {
            self.raw[155 + 8 * axis..163 + 8 * axis].copy_from_slice(&value.to_le_bytes());
        }
    }

    /// The first variable length record (extended ones last) with this identity.
    pub(super) fn vlr(&self, user_id: &str, record_id: u16) -> Option<&Vlr> {
        self.vlrs.iter().chain(&self.evlrs).find(|v| v.is(user_id, record_id))
    }

    /// Byte length of the extra bytes of each record.
    pub(super) fn extra_len(&self) -> usize {
        self.record_len - STANDARD_LENGTHS[self.format as usize]
    }

    /// Where the point data of an uncompressed file must end at the latest.
    pub(super) fn points_limit(&self, file_len: u64) -> u64 {
        let mut limit = file_len;
        for at in [self.evlrs_at, self.waveform_at] {
            if at > self.points_at && at < limit {
                limit = at;
            }
        }
        limit
    }
}

fn point_count(raw: &[u8], minor: u8, format: u8, warnings: &mut Vec<Warning>) -> u64 {
    let legacy = u64::from(u32_at(raw, 107));
    if minor < 4 {
        return legacy;
    }
    let count = u64_at(raw, 247);
    if count == 0 && legacy > 0 {
        warnings.push(Warning::new(
            "las-point-count",
            format!("the 64-bit point count is 0, the legacy count of {legacy} is used"),
        ));
        return legacy;
    }
    if legacy != 0 && legacy != count && count <= u64::from(u32::MAX) {
        let note = if format < 6 { "" } else { " (formats 6 to 10 should leave it 0)" };
        warnings.push(Warning::new(
            "las-point-count",
            format!("the legacy point count {legacy}{note} contradicts the 64-bit count {count}, which is used"),
        ));
    }
    count
}

fn read_vlrs(
    source: &SourceBytes,
    header_size: usize,
    points_at: u64,
    count: u32,
    warnings: &mut Vec<Warning>,
) -> Result<(Vec<Vlr>, u64), Error> {
    let mut vlrs = Vec::new();
    let mut at = header_size as u64;
    for index in 0..count {
        if at + VLR_HEADER as u64 > points_at {
            warnings.push(Warning::new(
                "las-variable-length-records",
                format!("the header promises {count} variable length records, but only {index} fit before the points"),
            ));
            break;
        }
        let header = source.bytes(at, VLR_HEADER)?;
        let size = u64::from(u16_at(&header, 20));
        if at + VLR_HEADER as u64 + size > points_at {
            warnings.push(Warning::new(
                "las-variable-length-records",
                format!(
                    "variable length record {index} of {count} claims {size} bytes and would reach into the points \
                     at byte {points_at}; it and those after it are ignored"
                ),
            ));
            break;
        }
        let data = source.bytes(at + VLR_HEADER as u64, size as usize)?;
        at += VLR_HEADER as u64 + size;
        vlrs.push(Vlr { header, data });
    }
    Ok((vlrs, at))
}
