//! Scans as lines of numbers: XYZ, CSV, TXT, PTS and PTX.
//!
//! When to use: exchange with programs that write nothing else; ten times larger and slower than LAZ.
//! Guarantees: encoding, separator, header and columns are detected from the text and shown by `adit info`; a line that does not
//! fit is an error with its number, never a skipped point.
//! Cost: windows of the file are parsed in parallel, one window in memory.

mod columns;
mod encoding;
mod lines;
mod ptx;
mod xyz;

pub(super) use encoding::Text;
pub(super) use lines::{Line, parse_rows};
pub(super) use ptx::read as read_ptx;
pub(super) use xyz::read as read_xyz;
