//! The header of a PLY file, read tolerantly, and the types of its numbers.

use super::super::error::{COPY_AGAIN, Error};
use super::super::source_bytes::SourceBytes;
use crate::warning::Warning;

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name.to_ascii_lowercase().as_str() {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" | "byte" | "ubyte" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" | "long" => Self::I32,
            "uint" | "uint32" | "ulong" => Self::U32,
            "int64" | "longlong" => Self::I64,
            "uint64" | "ulonglong" => Self::U64,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    pub(super) fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }

    /// The numbers at byte `at` of records of `stride` bytes, one loop for each type.
    #[inline(always)]
    pub(super) fn column(
        self,
        records: &[u8],
        stride: usize,
        at: usize,
        big_endian: bool,
        mut put: impl FnMut(usize, f64),
    ) {
        macro_rules! numbers {
            ($type:ty) => {
                for (row, record) in records.chunks_exact(stride).enumerate() {
                    let raw = record[at..at + size_of::<$type>()].try_into().expect("the slice has this length");
                    put(
                        row,
                        (if big_endian { <$type>::from_be_bytes(raw) } else { <$type>::from_le_bytes(raw) }) as f64,
                    );
                }
            };
        }
        match self {
            Self::I8 => numbers!(i8),
            Self::U8 => numbers!(u8),
            Self::I16 => numbers!(i16),
            Self::U16 => numbers!(u16),
            Self::I32 => numbers!(i32),
            Self::U32 => numbers!(u32),
            Self::I64 => numbers!(i64),
            Self::U64 => numbers!(u64),
            Self::F32 => numbers!(f32),
            Self::F64 => numbers!(f64),
        }
    }

    /// The number at the start of `bytes`, which hold at least [`Scalar::size`].
    #[inline(always)]
    pub(super) fn get(self, bytes: &[u8], big_endian: bool) -> f64 {
        macro_rules! number {
            ($type:ty) => {{
                let raw = bytes[..size_of::<$type>()].try_into().expect("the slice has this length");
                (if big_endian { <$type>::from_be_bytes(raw) } else { <$type>::from_le_bytes(raw) }) as f64
            }};
        }
        match self {
            Self::I8 => f64::from(bytes[0] as i8),
            Self::U8 => f64::from(bytes[0]),
            Self::I16 => number!(i16),
            Self::U16 => number!(u16),
            Self::I32 => number!(i32),
            Self::U32 => number!(u32),
            Self::I64 => number!(i64),
            Self::U64 => number!(u64),
            Self::F32 => number!(f32),
            Self::F64 => number!(f64),
        }
    }
}

/// What a property holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    List(Scalar, Scalar),
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// Byte length of a binary record, if it has no lists.
    pub(super) fn stride(&self) -> Option<usize> {
        self.properties
            .iter()
            .map(|p| match p.kind {
                Kind::Scalar(s) => Some(s.size()),
                Kind::List(..) => None,
            })
            .sum()
    }

    /// No record is shorter.
    fn smallest_record(&self, encoding: Encoding) -> u64 {
        let bytes: usize = self
            .properties
            .iter()
            .map(|p| match (encoding, p.kind) {
                // A digit and a separator.
                (Encoding::Ascii, _) => 2,
                (_, Kind::Scalar(s) | Kind::List(s, _)) => s.size(),
            })
            .sum();
        bytes as u64
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// How many vertices the header counts; a binary file must hold all its elements, lists with their fewest entries.
pub(in super::super) fn announced_vertices(source: &SourceBytes) -> Result<u64, Error> {
    let header = Header::read(source)?;
    if header.encoding != Encoding::Ascii {
        let record = |element: &Element| -> usize {
            let faces = element.name == "face";
            let property = |p: &Property| match p.kind {
                Kind::Scalar(s) => s.size(),
                // A face has at least three corners.
                Kind::List(count, item) => {
                    count.size() + if faces && p.name.starts_with("vert") { 3 * item.size() } else { 0 }
                }
            };
            element.properties.iter().map(property).sum()
        };
        let bytes = |e: &Element| e.count.saturating_mul(record(e) as u64);
        let needed = header.elements.iter().map(bytes).fold(header.data_at, u64::saturating_add);
        super::super::announce::must_hold(source, needed, "its element counts")?;
    }
    Ok(header.element("vertex").map_or(0, |(_, vertices)| vertices.count))
}

/// A parsed header.
#[derive(Clone, Debug)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// First byte of the data.
    pub(super) data_at: u64,
    /// Comments and `obj_info` lines, with their keyword.
    pub(super) remarks: Vec<String>,
    pub(super) warnings: Vec<Warning>,
}

/// No sensible header is longer.
const LONGEST_HEADER: usize = 1 << 20;

impl Header {
    pub(super) fn read(source: &SourceBytes) -> Result<Self, Error> {
        let bytes = source.up_to(0, LONGEST_HEADER)?;
        let bad = |cause: String| Error::bad(source.path(), cause, COPY_AGAIN);
        let mut header = Self {
            encoding: Encoding::Ascii,
            elements: Vec::new(),
            data_at: 0,
            remarks: Vec::new(),
            warnings: Vec::new(),
        };
        let mut encoding = None;
        let mut at = 0;
        let mut number = 0;
        loop {
            let (line, next) = line_at(&bytes, at).ok_or_else(|| {
                bad(format!("the PLY header has no end_header within its first {} bytes", bytes.len()))
            })?;
            number += 1;
            at = next;
            let line = String::from_utf8_lossy(line);
            let words: Vec<&str> = line.split_whitespace().collect();
            let at_line = |what: &str| bad(format!("header line {number} '{}' {what}", line.trim()));
            match words.as_slice() {
                ["ply"] if number == 1 => {}
                _ if number == 1 => return Err(at_line("should be 'ply'")),
                ["end_header"] => break,
                ["format", name, ..] => {
                    encoding = Some(match *name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return Err(at_line("names no known encoding")),
                    });
                }
                ["comment" | "obj_info", ..] => header.remarks.push(line.trim().to_owned()),
                ["element", name, count, ..] => {
                    let count = count.parse().map_err(|_| at_line("has no valid count"))?;
                    header.elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
                }
                ["property", rest @ ..] => {
                    let property = parse_property(rest).ok_or_else(|| at_line("has an unknown type"))?;
                    let element = header.elements.last_mut().ok_or_else(|| at_line("comes before any element"))?;
                    element.properties.push(property);
                }
                [] => {}
                _ => header.warnings.push(Warning::new(
                    "ply-header",
                    format!("header line {number} '{}' is not understood and ignored", line.trim()),
                )),
            }
        }
        header.encoding = encoding.ok_or_else(|| bad("the PLY header has no format line".into()))?;
        header.data_at = at as u64;
        header.elements.retain(|e| !(e.properties.is_empty() && e.name != "vertex"));
        for element in &header.elements {
            let needed = u128::from(element.count) * u128::from(element.smallest_record(header.encoding));
            let there = source.len() - header.data_at;
            // The last value of a text needs no separator.
            if needed > u128::from(there) + 1 || (element.properties.is_empty() && element.count > 0) {
                return Err(bad(format!(
                    "{} elements '{}' with {} properties need at least {needed} bytes, but only {there} follow the header",
                    element.count,
                    element.name,
                    element.properties.len()
                )));
            }
        }
        Ok(header)
    }

    pub(super) fn big_endian(&self) -> bool {
        self.encoding == Encoding::BigEndian
    }

    /// The element of this name, and its place.
    pub(super) fn element(&self, name: &str) -> Option<(usize, &Element)> {
        self.elements.iter().enumerate().find(|(_, e)| e.name == name)
    }
}

fn parse_property(words: &[&str]) -> Option<Property> {
    let (kind, name) = match words {
        ["list", count, item, name @ ..] => (Kind::List(Scalar::named(count)?, Scalar::named(item)?), name),
        [kind, name @ ..] => (Kind::Scalar(Scalar::named(kind)?), name),
        [] => return None,
    };
    if name.is_empty() || matches!(kind, Kind::List(c, _) if c.is_float()) {
        return None;
    }
    Some(Property { name: name.join(" "), kind })
}

/// The line at byte `at` and where the next one begins; lines end with `\n`, `\r\n` or a lone `\r`.
fn line_at(bytes: &[u8], at: usize) -> Option<(&[u8], usize)> {
    let rest = bytes.get(at..)?;
    let end = rest.iter().position(|&b| b == b'\n' || b == b'\r')?;
    let crlf = rest[end] == b'\r' && rest.get(end + 1) == Some(&b'\n');
    Some((&rest[..end], at + end + if crlf { 2 } else { 1 }))
}
