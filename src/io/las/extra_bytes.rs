//! Extra bytes: named columns behind the standard fields of a LAS record, described by 192-byte descriptors.
//!
//! Source: ASPRS, *LAS Specification 1.4 - R15*, "Extra Bytes VLR" (user id `LASF_Spec`, record id 4).

use super::header::{f64_at, text};

/// Byte length of a descriptor.
pub(super) const DESCRIPTOR: usize = 192;

/// One described column.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ExtraField {
    /// The descriptor as stored.
    pub(super) raw: Vec<u8>,
    /// Offset in the extra bytes of a record.
    pub(super) at: usize,
}

const NO_DATA: u8 = 1;
const MIN: u8 = 2;
const MAX: u8 = 4;
const SCALE: u8 = 8;
const OFFSET: u8 = 16;

impl ExtraField {
    pub(super) fn data_type(&self) -> u8 {
        self.raw[2]
    }

    pub(super) fn name(&self) -> String {
        text(&self.raw[4..36])
    }

    /// Bytes that the field takes in a record.
    pub(super) fn size(&self) -> usize {
        match self.data_type() {
            0 => self.raw[3] as usize,
            t @ 1..=30 => scalar_size((t - 1) % 10 + 1) * ((t as usize - 1) / 10 + 1),
            _ => 0,
        }
    }

    /// The field's value in the extra bytes of a record, with scale and offset; `None` for no-data.
    ///
    /// Only scalar fields (types 1 to 10) have a value.
    pub(super) fn value(&self, extra: &[u8]) -> Option<f64> {
        let options = self.raw[3];
        let bytes = &extra[self.at..];
        let (raw, no_data) = match self.data_type() {
            1 => (f64::from(bytes[0]), self.no_data_u64() as f64),
            2 => (f64::from(bytes[0] as i8), self.no_data_u64() as i64 as f64),
            3 => (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])), self.no_data_u64() as f64),
            4 => (f64::from(i16::from_le_bytes([bytes[0], bytes[1]])), self.no_data_u64() as i64 as f64),
            5 => (f64::from(u32::from_le_bytes(bytes[..4].try_into().ok()?)), self.no_data_u64() as f64),
            6 => (f64::from(i32::from_le_bytes(bytes[..4].try_into().ok()?)), self.no_data_u64() as i64 as f64),
            7 => (u64::from_le_bytes(bytes[..8].try_into().ok()?) as f64, self.no_data_u64() as f64),
            8 => (i64::from_le_bytes(bytes[..8].try_into().ok()?) as f64, self.no_data_u64() as i64 as f64),
            9 => (f64::from(f32::from_le_bytes(bytes[..4].try_into().ok()?)), f64_at(&self.raw, 40)),
            10 => (f64::from_le_bytes(bytes[..8].try_into().ok()?), f64_at(&self.raw, 40)),
            _ => return None,
        };
        if options & NO_DATA != 0 && raw == no_data {
            return None;
        }
        let scale = if options & SCALE != 0 { f64_at(&self.raw, 112) } else { 1.0 };
        let offset = if options & OFFSET != 0 { f64_at(&self.raw, 136) } else { 0.0 };
        Some(raw * scale + offset)
    }

    fn no_data_u64(&self) -> u64 {
        u64::from_le_bytes(self.raw[40..48].try_into().expect("eight bytes"))
    }

    /// A field of undocumented bytes, which keeps the fields behind it in their places.
    pub(super) fn undocumented(size: u8) -> Self {
        let mut raw = vec![0; DESCRIPTOR];
        raw[3] = size;
        raw[4..16].copy_from_slice(b"undocumented");
        Self { raw, at: 0 }
    }

    /// A scalar field with its range (raw values), and scale and no-data value where it has them.
    pub(super) fn scalar(name: &str, kind: ScalarKind, range: Option<[i64; 2]>, description: &str) -> Self {
        let mut raw = vec![0; DESCRIPTOR];
        raw[2] = kind as u8;
        raw[4..4 + name.len()].copy_from_slice(name.as_bytes());
        if let Some([min, max]) = range {
            raw[3] |= MIN | MAX;
            raw[64..72].copy_from_slice(&min.to_le_bytes());
            raw[88..96].copy_from_slice(&max.to_le_bytes());
        }
        if let Some(no_data) = kind.no_data() {
            raw[3] |= NO_DATA | SCALE | OFFSET;
            raw[40..48].copy_from_slice(&no_data.to_le_bytes());
            raw[112..120].copy_from_slice(&MICROMETRE.to_le_bytes());
        }
        raw[160..160 + description.len()].copy_from_slice(description.as_bytes());
        Self { raw, at: 0 }
    }
}

/// Lengths are stored as whole micrometres.
pub(super) const MICROMETRE: f64 = 1e-6;

/// The types of the columns that Adit writes; the values are the type codes of the specification.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ScalarKind {
    /// Plain unsigned byte.
    U8 = 1,
    /// Plain unsigned integer.
    U32 = 5,
    /// Micrometres in 32 bits, up to 2.1 km.
    I32Micrometres = 6,
    /// Micrometres in 64 bits.
    I64Micrometres = 8,
}

impl ScalarKind {
    pub(super) fn no_data(self) -> Option<i64> {
        match self {
            Self::U8 | Self::U32 => None,
            Self::I32Micrometres => Some(i64::from(i32::MIN)),
            Self::I64Micrometres => Some(i64::MIN),
        }
    }
}

fn scalar_size(code: u8) -> usize {
    match code {
        1 | 2 => 1,
        3 | 4 => 2,
        5 | 6 | 9 => 4,
        _ => 8,
    }
}

/// The fields described by the payload of an extra-bytes record, as far as they fit into `extra_len` bytes.
///
/// Returns the fields and how many bytes of each record they describe.
pub(super) fn parse(payload: &[u8], extra_len: usize) -> (Vec<ExtraField>, usize) {
    let mut fields = Vec::new();
    let mut at = 0;
    for raw in payload.chunks_exact(DESCRIPTOR) {
        let field = ExtraField { raw: raw.to_vec(), at };
        let size = field.size();
        if at + size > extra_len || (size == 0 && field.data_type() != 0) {
            break;
        }
        at += size;
        fields.push(field);
    }
    (fields, at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaled_value_and_no_data() {
        let mut field = ExtraField::scalar("girth", ScalarKind::I32Micrometres, Some([-5, 7]), "m");
        field.at = 2;
        let mut extra = vec![0; 6];
        extra[2..6].copy_from_slice(&(-1_250_000i32).to_le_bytes());
        assert_eq!(field.value(&extra), Some(-1.25));
        extra[2..6].copy_from_slice(&i32::MIN.to_le_bytes());
        assert_eq!(field.value(&extra), None);
        assert_eq!(field.size(), 4);
    }

    #[test]
    fn descriptors_beyond_the_record_are_ignored() {
        let a = ExtraField::scalar("a", ScalarKind::U32, None, "");
        let b = ExtraField::scalar("b", ScalarKind::I64Micrometres, None, "");
        let payload = [a.raw, b.raw].concat();
        assert_eq!(parse(&payload, 12).0.len(), 2);
        let (fields, described) = parse(&payload, 10);
        assert_eq!((fields.len(), described), (1, 4));
    }

    #[test]
    fn arrays_take_their_elements() {
        let mut raw = vec![0; DESCRIPTOR];
        for (code, size) in [(1, 1), (10, 8), (11, 2), (13, 4), (19, 8), (20, 16), (21, 3), (30, 24)] {
            raw[2] = code;
            assert_eq!(ExtraField { raw: raw.clone(), at: 0 }.size(), size, "type {code}");
        }
    }
}
