//! Lines of numbers into rows, in parallel.

use super::super::error::{COPY_AGAIN, Error};
use super::super::point_table::{PointTable, Roles};
use super::super::source_bytes::SourceBytes;
use rayon::prelude::*;

/// Bytes of text parsed at a time.
const WINDOW: usize = 32 << 20;
/// Bytes of text parsed by one thread at a time.
const BLOCK: usize = 1 << 20;
/// No sensible line is longer.
const LONGEST_LINE: usize = 1 << 16;

/// How a line is split into numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Line {
    /// The separator; blanks and tabs always separate too, unless they are all there is.
    pub(in super::super) separator: u8,
    /// A comma in a number is a decimal comma.
    pub(in super::super) decimal_comma: bool,
    /// Words of a line that are looked at; more are ignored.
    pub(in super::super) columns: usize,
}

impl Line {
    /// Splits a line into words.
    pub(super) fn words<'a>(&self, line: &'a [u8]) -> impl Iterator<Item = &'a [u8]> {
        let separator = self.separator;
        let blank = separator == b' ';
        line.split(move |&b| if blank { b == b' ' || b == b'\t' } else { b == separator })
            .map(<[u8]>::trim_ascii)
            .filter(move |w| !blank || !w.is_empty())
    }

    /// The number that a word means.
    pub(super) fn number(&self, word: &[u8]) -> Option<f64> {
        let text = std::str::from_utf8(word).ok()?.trim_matches('"');
        text.parse().ok().or_else(|| self.unusual_number(text))
    }

    /// A number with a decimal comma, or with the exponent `D` of Fortran.
    fn unusual_number(&self, text: &str) -> Option<f64> {
        if !text.bytes().all(|b| b.is_ascii_digit() || b"+-.,eEdD".contains(&b)) || text.ends_with(',') {
            return None;
        }
        let text = text.replace(['d', 'D'], "e");
        if self.decimal_comma { text.replace(',', ".").parse().ok() } else { text.parse().ok() }
    }

    /// The numbers of a line, or why it has not enough; columns that are not `used` are not looked at.
    fn row(&self, line: &[u8], used: &[bool], row: &mut Vec<f64>) -> Result<(), String> {
        row.clear();
        for (word, used) in self.words(line).zip(used) {
            // An empty field of a CSV is a missing value.
            let number = if word.is_empty() || !used { Some(f64::NAN) } else { self.number(word) };
            row.push(number.ok_or_else(|| format!("'{}' is not a number", shorten(word)))?);
        }
        if row.len() < self.columns {
            return Err(format!("{} numbers where {} are expected", row.len(), self.columns));
        }
        Ok(())
    }
}

pub(super) fn shorten(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).chars().take(40).collect()
}

/// Whether a line carries no numbers: blank or a comment.
pub(super) fn is_void(line: &[u8]) -> bool {
    let line = line.trim_ascii();
    line.is_empty() || line.starts_with(b"#") || line.starts_with(b"//")
}

/// Parses `rows` lines (all, if `None`) from byte `from` on; returns the table and the byte after the last line.
///
/// `first_line` is the number of the first line, for messages.
pub(in super::super) fn parse_rows(
    source: &SourceBytes,
    from: u64,
    first_line: u64,
    rows: Option<u64>,
    line: &Line,
    roles: &Roles,
) -> Result<(PointTable, u64, u64), Error> {
    let used: Vec<bool> = (0..line.columns).map(|column| roles.use_column(column)).collect();
    let mut table = PointTable::new(0, roles);
    let mut at = from;
    let mut number = first_line;
    loop {
        let left = rows.map(|r| r - table.len() as u64);
        if left == Some(0) || at >= source.len() {
            break;
        }
        let mut window = source.up_to(at, WINDOW)?;
        let last = at + window.len() as u64 == source.len();
        if !last {
            let cut = window.iter().rposition(|&b| b == b'\n').map_or(0, |p| p + 1);
            if cut == 0 {
                let cause = format!("line {number} is longer than {WINDOW} bytes");
                return Err(Error::bad(source.path(), cause, "it is no text scan"));
            }
            window.truncate(cut);
        }
        if let Some(left) = left {
            window.truncate(end_of_lines(&window, left));
        }
        let blocks = split_blocks(&window);
        let parsed: Vec<Block> = blocks.par_iter().map(|block| parse_block(block, line, &used, roles)).collect();
        for block in parsed {
            if let Some((offset, cause)) = block.failure {
                let cause = format!("line {}: {cause}", number + offset);
                return Err(Error::bad(source.path(), cause, COPY_AGAIN));
            }
            number += block.lines;
            table.append(block.table);
        }
        at += window.len() as u64;
    }
    Ok((table, at, number))
}

struct Block {
    table: PointTable,
    lines: u64,
    failure: Option<(u64, String)>,
}

fn parse_block(text: &[u8], line: &Line, used: &[bool], roles: &Roles) -> Block {
    let lines: Vec<&[u8]> = text.split_inclusive(|&b| b == b'\n').collect();
    let rows = lines.iter().filter(|l| !is_void(l)).count();
    let mut table = PointTable::new(rows, roles);
    let mut bad_labels = 0;
    let mut failure = None;
    {
        let mut slots = table.slots(rows.max(1));
        let mut row = Vec::with_capacity(line.columns);
        for (next, (offset, text)) in lines.iter().enumerate().filter(|(_, l)| !is_void(l)).enumerate() {
            let parsed = if text.len() > LONGEST_LINE {
                Err("it is too long".into())
            } else {
                line.row(text.trim_ascii(), used, &mut row)
            };
            match parsed {
                Ok(()) => slots[0].set(next, roles, &mut bad_labels, |column| row[column]),
                Err(cause) => {
                    failure = Some((offset as u64, cause));
                    break;
                }
            }
        }
    }
    table.add_bad_labels(bad_labels);
    Block { table, lines: lines.len() as u64, failure }
}

/// Blocks that end at line ends.
fn split_blocks(window: &[u8]) -> Vec<&[u8]> {
    let mut blocks = Vec::new();
    let mut rest = window;
    while rest.len() > BLOCK {
        let cut = rest[BLOCK..].iter().position(|&b| b == b'\n').map_or(rest.len(), |p| BLOCK + p + 1);
        let (block, tail) = rest.split_at(cut);
        blocks.push(block);
        rest = tail;
    }
    blocks.push(rest);
    blocks
}

/// The byte after the first `lines` lines that carry numbers.
fn end_of_lines(window: &[u8], lines: u64) -> usize {
    let mut at = 0;
    let mut seen = 0;
    for line in window.split_inclusive(|&b| b == b'\n') {
        at += line.len();
        seen += u64::from(!is_void(line));
        if seen == lines {
            break;
        }
    }
    at
}
