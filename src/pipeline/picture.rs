//! Small pictures for pages: a PNG read row by row and thinned, so that a map of any size costs little memory.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// A picture read row by row, eight bits a channel.
struct Rows {
    reader: png::Reader<BufReader<File>>,
    color: png::ColorType,
    channels: usize,
    width: usize,
    height: usize,
}

impl Rows {
    fn open(path: &Path) -> Option<Self> {
        let mut decoder = png::Decoder::new(BufReader::new(File::open(path).ok()?));
        decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
        let reader = decoder.read_info().ok()?;
        let (color, depth) = reader.output_color_type();
        let (width, height) = (reader.info().width as usize, reader.info().height as usize);
        (depth == png::BitDepth::Eight).then_some(Self { reader, color, channels: color.samples(), width, height })
    }

    fn next(&mut self) -> Option<&[u8]> {
        // The row borrows from the reader.
        match self.reader.next_row() {
            Ok(Some(row)) => Some(row.data()),
            _ => None,
        }
    }
}

/// Whether a pixel of 1 to 4 channels shows anything.
fn opaque(pixel: &[u8]) -> bool {
    match pixel {
        [_, alpha] | [_, _, _, alpha] => *alpha > 0,
        _ => true,
    }
}

/// A picture thinned to at most `widest` columns, as PNG; `None` when there is no such picture that reads.
pub(super) fn thumbnail(path: &Path, widest: usize) -> Option<Vec<u8>> {
    let mut rows = Rows::open(path)?;
    let (width, step) = (rows.width, rows.width.div_ceil(widest).max(1));
    thin(&mut rows, 0, width, step)
}

/// Means of the opaque pixels of `step` x `step` blocks; only the rows of one block are held.
fn thin(rows: &mut Rows, from: usize, to: usize, step: usize) -> Option<Vec<u8>> {
    let (channels, height) = (rows.channels, rows.height);
    let (columns, lines) = ((to - from).div_ceil(step), height.div_ceil(step));
    let mut thin = Vec::with_capacity(columns * lines * channels);
    let mut sums = vec![[0u64; 4]; columns];
    let mut counts = vec![0u64; columns];
    for y in 0..height {
        let row = rows.next()?;
        let row = row.get(from * channels..to * channels)?;
        for ((block, sums), count) in row.chunks(step * channels).zip(&mut sums).zip(&mut counts) {
            for pixel in block.chunks_exact(channels).filter(|p| opaque(p)) {
                for (sum, &value) in sums.iter_mut().zip(pixel) {
                    *sum += u64::from(value);
                }
                *count += 1;
            }
        }
        if y % step == step - 1 || y == height - 1 {
            for (sum, count) in sums.iter_mut().zip(&mut counts) {
                thin.extend(sum[..channels].iter().map(|s| s.checked_div(*count).unwrap_or(0) as u8));
                (*sum, *count) = ([0; 4], 0);
            }
        }
    }
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, columns as u32, lines as u32);
    encoder.set_color(rows.color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header().ok()?.write_image_data(&thin).ok()?;
    Some(out)
}

/// For each column of a picture: pixels of one colour, and pixels between the uppermost and the lowest opaque one. `None`
/// when there is no such picture that reads.
pub(super) fn column_counts(path: &Path, color: [u8; 3]) -> Option<Vec<[u32; 2]>> {
    let mut rows = Rows::open(path)?;
    let mut found = vec![(0u32, None::<(u32, u32)>); rows.width];
    for y in 0..rows.height as u32 {
        let channels = rows.channels;
        for (pixel, (count, span)) in rows.next()?.chunks_exact(channels).zip(&mut found) {
            if opaque(pixel) {
                *count += u32::from(channels >= 3 && pixel[..3] == color);
                *span = Some((span.map_or(y, |(top, _)| top), y));
            }
        }
    }
    Some(found.into_iter().map(|(count, span)| [count, span.map_or(0, |(top, bottom)| bottom - top + 1)]).collect())
}

/// A piece of a picture from column `from` to column `to`, thinned to at most `tallest` rows, as PNG.
pub(super) fn upright_piece(path: &Path, from: usize, to: usize, tallest: usize) -> Option<Vec<u8>> {
    let mut rows = Rows::open(path)?;
    let (from, to) = (from.min(rows.width), to.min(rows.width));
    if to <= from {
        return None;
    }
    let step = rows.height.div_ceil(tallest).max(1);
    thin(&mut rows, from, to, step)
}

/// Bytes as text for a `data:` address (RFC 4648).
pub(super) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = (0..3).fold(0u32, |w, i| w << 8 | u32::from(chunk.get(i).copied().unwrap_or(0)));
        for i in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * i) & 63) as usize];
            text.push(if i <= chunk.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_pads() {
        assert_eq!(
            ["", "f", "fo", "foo", "foob"].map(|s| base64(s.as_bytes())),
            ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg=="]
        );
    }

    #[test]
    fn columns_are_counted_and_cut_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 3, 3);
        encoder.set_color(png::ColorType::Rgba);
        let (seen, other, clear) = ([1, 2, 3, 255], [9, 9, 9, 255], [0, 0, 0, 0]);
        let pixels = [seen, clear, clear, clear, seen, clear, other, other, clear].concat();
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
        // The hole between two opaque pixels counts to the whole.
        assert_eq!(column_counts(&path, [1, 2, 3]).unwrap(), [[1, 3], [1, 2], [0, 0]]);
        let piece = upright_piece(&path, 1, 2, 100).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(piece)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, [clear, seen, other].concat());
        assert!(upright_piece(&path, 5, 9, 100).is_none());
    }

    #[test]
    fn a_thumbnail_is_the_mean_of_opaque_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 4, 2);
        encoder.set_color(png::ColorType::Rgba);
        let (a, b, clear) = ([10, 20, 30, 255], [30, 40, 50, 255], [0, 0, 0, 0]);
        let pixels = [a, b, clear, clear, a, b, clear, a].concat();
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
        let thin = thumbnail(&path, 2).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(thin)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, [20, 30, 40, 255, 10, 20, 30, 255]);
    }
}
