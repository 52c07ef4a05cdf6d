//! Damages that know nothing of a format.

use super::Random;
use std::ops::Range;

/// Whole numbers that readers trip over.
const AWKWARD: [u64; 14] = [
    0,
    1,
    2,
    3,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1 << 32,
    0x7fff_ffff_ffff_ffff,
    u64::MAX,
];
/// Floating point numbers that readers trip over.
const AWKWARD_FLOATS: [f64; 12] =
    [0.0, -0.0, 1.0, -1.0, 0.001, 1e-320, 1e300, -1e308, f64::MAX, f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
/// Words that text readers trip over.
const WORDS: [&[u8]; 14] = [
    b"nan",
    b"-inf",
    b"1e999",
    b"-1",
    b"999999999",
    b"4294967296",
    b"\n",
    b"\r\n",
    b" ",
    b",",
    b";",
    b"list uchar int",
    b"element",
    b"18446744073709551616",
];

/// An awkward whole number, or one next to it.
pub fn awkward(random: &mut Random) -> u64 {
    random.pick(&AWKWARD).wrapping_add(random.below(3) as u64).wrapping_sub(1)
}

/// An awkward floating point number, or any bits.
pub fn awkward_float(random: &mut Random) -> f64 {
    if random.one_in(4) { f64::from_bits(random.next()) } else { *random.pick(&AWKWARD_FLOATS) }
}

/// Writes the low bytes of a number over those at `at`, as far as there are any.
pub fn put(bytes: &mut [u8], at: usize, number: &[u8]) {
    for (slot, byte) in bytes.iter_mut().skip(at).zip(number) {
        *slot = *byte;
    }
}

/// Changes bytes inside a range; no byte moves.
pub fn overwrite(bytes: &mut [u8], range: Range<usize>, random: &mut Random) {
    let range = range.start.min(bytes.len())..range.end.min(bytes.len());
    if range.is_empty() {
        return;
    }
    let at = range.start + random.below(range.len());
    let place = &mut bytes[..range.end];
    match random.below(6) {
        0 | 1 => place[at] ^= 1 << random.below(8),
        2 => place[at] = random.next() as u8,
        3 => put(place, at, &awkward(random).to_le_bytes()[..*random.pick(&[1, 2, 4, 8])]),
        4 => put(place, at, &awkward_float(random).to_le_bytes()),
        _ => {
            let from = range.start + random.below(range.len());
            let run = 1 + random.below(16);
            let piece: Vec<u8> = place[from..].iter().take(run).copied().collect();
            put(place, at, &piece);
        }
    }
}

/// Up to six damages anywhere; bytes come and go.
pub fn damage(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], random: &mut Random) {
    for _ in 0..=random.below(6) {
        if bytes.is_empty() {
            bytes.push(random.next() as u8);
        }
        let at = match random.below(3) {
            // Headers are where the decisions are made.
            0 => random.below(bytes.len().min(400)),
            _ => random.below(bytes.len()),
        };
        match random.below(7) {
            0 | 1 => {
                let end = bytes.len();
                overwrite(bytes, at..end, random);
            }
            2 => bytes.truncate(at),
            3 => {
                let end = (at + 1 + random.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = random.below(bytes.len());
                bytes.splice(to..to, piece);
            }
            4 => {
                let end = (at + 1 + random.below(16)).min(bytes.len());
                bytes.drain(at..end);
            }
            5 => {
                let word = *random.pick(&WORDS);
                let end = (at + random.below(word.len() + 1)).min(bytes.len());
                bytes.splice(at..end, word.iter().copied());
            }
            _ => {
                let other = random.pick(seeds);
                let from = random.below(other.len());
                let end = (from + 1 + random.below(128)).min(other.len());
                put(bytes, at, &other[from..end]);
            }
        }
    }
}
