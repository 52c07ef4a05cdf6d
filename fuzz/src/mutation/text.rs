//! Damages to lines and words: whole lines and words are swapped, doubled, lost or exchanged for others.

use super::{Random, bytes};

/// Numbers in words that readers trip over.
const NUMBERS: [&str; 24] = [
    "-1",
    "0",
    "1",
    "2",
    "3",
    "255",
    "256",
    "65535",
    "65536",
    "1000000",
    "2147483647",
    "2147483648",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "1e308",
    "1e999",
    "1e-320",
    "nan",
    "-inf",
    "1.5",
    "1,5",
    "0x10",
];

/// One word of a vocabulary, or an awkward number.
fn word(vocabulary: &[&str], random: &mut Random) -> String {
    if vocabulary.is_empty() || random.one_in(2) {
        (*random.pick(&NUMBERS)).to_owned()
    } else {
        (*random.pick(vocabulary)).to_owned()
    }
}

/// Damages the lines before byte `end`; what follows them stays as it is.
pub fn lines(text: &[u8], end: usize, vocabulary: &[&str], random: &mut Random) -> Vec<u8> {
    let (head, rest) = text.split_at(end.min(text.len()));
    let mut lines: Vec<Vec<u8>> = head.split_inclusive(|&b| b == b'\n').map(<[u8]>::to_vec).collect();
    if lines.is_empty() {
        return text.to_vec();
    }
    for _ in 0..=random.below(3) {
        let (at, other) = (random.below(lines.len()), random.below(lines.len()));
        match random.below(10) {
            0 => lines.swap(at, other),
            1 => {
                let line = lines[at].clone();
                lines.insert(other, line);
            }
            2 if lines.len() > 1 => drop(lines.remove(at)),
            3 => {
                let line = &mut lines[at];
                while line.last().is_some_and(u8::is_ascii_whitespace) {
                    line.pop();
                }
                line.extend_from_slice(*random.pick(&[&b"\r\n"[..], b"\r", b"\n\n", b"", b" \n", b"\t\n", b"\xff\n"]));
            }
            _ => {
                let donor = String::from_utf8_lossy(&lines[other]).into_owned();
                lines[at] = words(&lines[at], &donor, vocabulary, random);
            }
        }
        if lines.is_empty() {
            break;
        }
    }
    [&lines.concat(), rest].concat()
}

/// Damages the words of one line.
fn words(line: &[u8], donor: &str, vocabulary: &[&str], random: &mut Random) -> Vec<u8> {
    let text = String::from_utf8_lossy(line).into_owned();
    let separator = [';', ',', '\t'].into_iter().find(|&s| text.contains(s)).unwrap_or(' ');
    let mut words: Vec<String> = text.trim_end().split(separator).map(str::to_owned).collect();
    let at = random.below(words.len());
    match random.below(7) {
        0 | 1 => words[at] = word(vocabulary, random),
        2 => {
            let other = random.below(words.len());
            words.swap(at, other);
        }
        3 => words.insert(at, word(vocabulary, random)),
        4 => drop(words.remove(at)),
        5 => {
            let all: Vec<&str> = donor.split_whitespace().collect();
            if !all.is_empty() {
                words[at] = (*random.pick(&all)).to_owned();
            }
        }
        _ => {
            let run = 1 << random.below(12);
            words[at] = words[at].repeat(run).chars().take(1 << 16).collect();
        }
    }
    let mut line = words.join(&separator.to_string()).into_bytes();
    line.push(b'\n');
    line
}

/// Damages tags and texts of XML, or names and values of JSON: whatever stands between two `marks`.
pub fn marked(text: &[u8], marks: &[u8], vocabulary: &[&str], random: &mut Random) -> Vec<u8> {
    let mut pieces: Vec<Vec<u8>> = Vec::new();
    let mut begin = 0;
    for (i, byte) in text.iter().enumerate() {
        if marks.contains(byte) {
            pieces.push(text[begin..i].to_vec());
            pieces.push(vec![*byte]);
            begin = i + 1;
        }
    }
    pieces.push(text[begin..].to_vec());
    for _ in 0..=random.below(4) {
        if pieces.is_empty() {
            break;
        }
        let (at, other) = (random.below(pieces.len()), random.below(pieces.len()));
        match random.below(8) {
            0 => pieces.swap(at, other),
            1 => pieces[at] = pieces[other].clone(),
            2 => drop(pieces.remove(at)),
            3 => {
                // A run of pieces, often a whole element, a second time.
                let end = (at + 1 + random.below(12)).min(pieces.len());
                let run = pieces[at..end].to_vec();
                pieces.splice(end..end, run);
            }
            4 => {
                let end = (at + 1 + random.below(12)).min(pieces.len());
                pieces.drain(at..end);
            }
            5 => {
                let end = pieces[at].len();
                bytes::overwrite(&mut pieces[at], 0..end, random);
            }
            _ => {
                // Between marks that enclose a value if there is one, so that the grammar holds.
                let values: Vec<usize> = (0..pieces.len()).filter(|&i| value_like(&pieces[i])).collect();
                let at = if values.is_empty() { at } else { *random.pick(&values) };
                pieces[at] = word(vocabulary, random).into_bytes();
            }
        }
    }
    pieces.concat()
}

/// Whether a piece is a number or a single word.
fn value_like(piece: &[u8]) -> bool {
    !piece.is_empty() && piece.iter().all(|b| b.is_ascii_alphanumeric() || b".-+_:".contains(b))
}
