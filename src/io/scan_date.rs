//! The day on which a scan file was made, as its header tells.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Where LAS headers hold the day of the year and the year (LAS 1.4 R15, table 3).
const DAY_AT: usize = 90;

/// The creation date of a LAS or LAZ file as `2026-11-24`; `None` when there is no such file or its header says none.
pub fn las_creation_date(path: &Path) -> Option<String> {
    let mut header = [0u8; DAY_AT + 4];
    File::open(path).and_then(|mut f| f.read_exact(&mut header)).ok()?;
    let word = |at: usize| u16::from_le_bytes([header[at], header[at + 1]]);
    (&header[..4] == b"LASF").then(|| date(word(DAY_AT + 2), word(DAY_AT)))?
}

/// The date of a day (from 1) of a year.
fn date(year: u16, day: u16) -> Option<String> {
    let leap = year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let lengths = [31, if leap { 29 } else { 28 }, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let mut rest = day;
    if !(1900..=9999).contains(&year) || day == 0 {
        return None;
    }
    for (month, length) in lengths.into_iter().enumerate() {
        if rest <= length {
            return Some(format!("{year:04}-{:02}-{rest:02}", month + 1));
        }
        rest -= length;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_become_dates() {
        assert_eq!(date(2026, 328).unwrap(), "2026-11-24");
        assert_eq!(date(2024, 60).unwrap(), "2024-02-29");
        assert_eq!(date(2023, 60).unwrap(), "2023-03-01");
        assert_eq!([date(2023, 366), date(0, 1), date(2023, 0)], [None, None, None]);
    }
}
