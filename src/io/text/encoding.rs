//! Texts as the readers expect them: one byte for an ASCII character, lines that end with a line feed.
//!
//! Spreadsheets save UTF-16, old exports end their lines with a carriage return alone. Such a text is converted in
//! memory, which takes its own size once more; all others are read where they are.

use super::super::error::{COPY_AGAIN, Error};
use super::super::source_bytes::SourceBytes;

/// Bytes looked at to tell how lines end.
const HEAD: usize = 1 << 18;

/// A text that can be read line by line.
pub(in super::super) struct Text<'a> {
    original: &'a SourceBytes,
    converted: Option<SourceBytes>,
    /// Byte after the mark of UTF-8, if there is one.
    pub(in super::super) start: u64,
    /// What the text is written in, for people.
    pub(in super::super) encoding: &'static str,
}

impl<'a> Text<'a> {
    /// Looks at the beginning of a file and converts it where necessary.
    pub(in super::super) fn of(original: &'a SourceBytes) -> Result<Self, Error> {
        let head = original.up_to(0, HEAD)?;
        let plain = |start, encoding| Self { original, converted: None, start, encoding };
        let text = match head[..] {
            [0xff, 0xfe, ..] => Self::of_utf16(original, u16::from_le_bytes, "UTF-16, little endian")?,
            [0xfe, 0xff, ..] => Self::of_utf16(original, u16::from_be_bytes, "UTF-16, big endian")?,
            [0xef, 0xbb, 0xbf, ..] => plain(3, "UTF-8 with a mark"),
            _ => plain(0, "ASCII or UTF-8"),
        };
        let head = text.source().up_to(text.start, HEAD)?;
        if !head.contains(&b'\r') || head.contains(&b'\n') {
            return Ok(text);
        }
        let mut bytes = text.source().up_to(text.start, usize::MAX)?;
        bytes.iter_mut().filter(|b| **b == b'\r').for_each(|b| *b = b'\n');
        Ok(Self { converted: Some(original.with_content(bytes)), start: 0, ..text })
    }

    fn of_utf16(original: &'a SourceBytes, unit: fn([u8; 2]) -> u16, encoding: &'static str) -> Result<Self, Error> {
        let bytes = original.up_to(2, usize::MAX)?;
        let (pairs, rest) = bytes.as_chunks::<2>();
        let decoded: Result<String, _> = char::decode_utf16(pairs.iter().map(|p| unit(*p))).collect();
        let text = decoded.ok().filter(|_| rest.is_empty()).ok_or_else(|| {
            Error::bad(original.path(), format!("it is marked as {encoding}, but does not decode as such"), COPY_AGAIN)
        })?;
        Ok(Self { original, converted: Some(original.with_content(text.into_bytes())), start: 0, encoding })
    }

    /// The text, in the file or converted.
    pub(in super::super) fn source(&self) -> &SourceBytes {
        self.converted.as_ref().unwrap_or(self.original)
    }
}
