//! Small pictures for pages: a PNG read row by row and thinned, so that a map of any size costs little memory.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// A picture thinned to at most `widest` columns, as PNG; `None` when there is no such picture that reads.
pub(super) fn thumbnail(path: &Path, widest: usize) -> Option<Vec<u8>> {
    let mut decoder = png::Decoder::new(BufReader::new(File::open(path).ok()?));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().ok()?;
    let (color, depth) = reader.output_color_type();
    if depth != png::BitDepth::Eight {
        return None;
    }
    let channels = color.samples();
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    let step = width.div_ceil(widest).max(1);
    let (columns, rows) = (width.div_ceil(step), height.div_ceil(step));
    let mut thin = Vec::with_capacity(columns * rows * channels);
    // Means of opaque pixels of a step x step block; only the rows of one block are held.
    let mut sums = vec![[0u64; 4]; columns];
    let mut counts = vec![0u64; columns];
    for y in 0..height {
        let row = reader.next_row().ok()??;
        for (x, pixel) in row.data().chunks_exact(channels).enumerate() {
            let alpha = match channels {
                2 => pixel[1],
                4 => pixel[3],
                _ => 255,
            };
            if alpha > 0 {
                for (sum, &value) in sums[x / step].iter_mut().zip(pixel) {
                    *sum += u64::from(value);
                }
                counts[x / step] += 1;
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
    let mut encoder = png::Encoder::new(&mut out, columns as u32, rows as u32);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header().ok()?.write_image_data(&thin).ok()?;
    Some(out)
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
