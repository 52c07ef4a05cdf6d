//! GeoTIFF: tiled, compressed rasters in chart metres, laid out as Cloud Optimized GeoTIFF with overviews.
//!
//! When to use: every layer of the map that is measured or opened in a GIS. Tiles come in any order (rows of tiles from
//! the top keep the memory low); they are compressed at once, on all cores, and wait in a file next to the target. At
//! the end the header, the directories and the tiles go to the target in the order that COG readers expect: directories
//! first, then the overviews from coarse to fine, then the full map. The target appears under its name only when it is
//! complete.
//!
//! References: Adobe, "TIFF revision 6.0", 1992, and technical note 3 (predictor); OGC 19-008r4, "GeoTIFF 1.1";
//! OGC 21-026, "Cloud Optimized GeoTIFF"; Aware Systems, "The BigTIFF file format".
//!
//! Guarantees: the same tiles give the same bytes, on any number of threads. Classic TIFF below 4 GiB, BigTIFF above.
//!
//! Departures: 32-bit floats use predictor 2, the differences of their bit patterns, which readers know as well as those of
//! integers: neighbours differ little, so a way back of 12 bytes a pixel shrinks to a third. Predictor 3, made for floats,
//! is missing in light readers. There is no EPSG code for a tunnel map, so the keys say "user-defined, metres" and name it in the citation.
//!
//! Cost: one compression of each tile (Deflate), a third more for the overviews; memory of a few rows of tiles of each
//! resolution, because overviews wait in a file, too.

use crate::map::{Block, Grid, LayerDescription, NoData, Resampling, Sample, SampleType, Samples};
use flate2::{Compression, write::ZlibEncoder};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Deflate level: a quarter of the time of the usual 6 for files some percent larger.
const DEFLATE_LEVEL: u32 = 2;
/// Overviews are added until one fits into this many pixels.
const SMALLEST_OVERVIEW_PX: usize = 512;
/// Classic TIFF holds 32-bit offsets; beyond this many bytes of tiles BigTIFF is written.
const CLASSIC_LIMIT: u64 = 4_000_000_000;
/// Citation of the coordinate system.
const CITATION: &str = "Unwrapped tunnel map: x = chainage (m), y = girth from the crown (m), seen from inside";

/// Writes one raster.
pub struct GeoTiffWriter {
    path: PathBuf,
    partial: PathBuf,
    spool_path: PathBuf,
    spool: BufWriter<File>,
    spool_length: u64,
    /// The tiles of all overviews.
    overviews_path: PathBuf,
    overviews: BufWriter<File>,
    overviews_length: u64,
    grid: Grid,
    layer: LayerDescription,
    tile_px: usize,
    /// Full resolution first.
    levels: Vec<Level>,
}

/// One resolution of the raster.
struct Level {
    width: usize,
    height: usize,
    across: usize,
    down: usize,
    /// Where each tile is: its offset in the file in which it waits, and its length.
    tiles: Vec<(u64, u64)>,
    /// Overview tiles that still wait for some of their four parts.
    pending: BTreeMap<(usize, usize), (Samples, usize)>,
}

/// A tile of samples.
pub struct Tile {
    /// Column of tiles.
    pub column: usize,
    /// Row of tiles, from the top.
    pub row: usize,
    /// `tile_px * tile_px` pixels, padded with NoData.
    pub samples: Samples,
}

impl GeoTiffWriter {
    /// Starts a raster of `grid` with the samples of `layer` in square tiles.
    ///
    /// # Errors
    /// When the files cannot be created.
    pub fn create(path: &Path, grid: &Grid, layer: &LayerDescription, tile_px: usize) -> io::Result<Self> {
        let mut levels = vec![Level::new(grid.width(), grid.height(), tile_px)];
        while levels.last().is_some_and(|l| l.width.max(l.height) > SMALLEST_OVERVIEW_PX) {
            let last = &levels[levels.len() - 1];
            levels.push(Level::new(last.width.div_ceil(2), last.height.div_ceil(2), tile_px));
        }
        let spool_path = with_suffix(path, ".tiles");
        let overviews_path = with_suffix(path, ".overviews");
        Ok(Self {
            path: path.to_owned(),
            partial: with_suffix(path, ".partial"),
            spool: BufWriter::with_capacity(1 << 20, File::create(&spool_path)?),
            spool_path,
            spool_length: 0,
            overviews: BufWriter::with_capacity(1 << 18, File::create(&overviews_path)?),
            overviews_path,
            overviews_length: 0,
            grid: *grid,
            layer: layer.clone(),
            tile_px,
            levels,
        })
    }

    /// Adds tiles of the full resolution, each once.
    ///
    /// # Errors
    /// When the tiles cannot be stored.
    pub fn write_tiles(&mut self, tiles: Vec<Tile>) -> io::Result<()> {
        let compressed: Vec<Vec<u8>> = tiles.par_iter().map(|t| self.compress(&t.samples)).collect();
        for (tile, bytes) in tiles.iter().zip(&compressed) {
            let slot = tile.row * self.levels[0].across + tile.column;
            self.levels[0].tiles[slot] = (self.spool_length, bytes.len() as u64);
            self.spool.write_all(bytes)?;
            self.spool_length += bytes.len() as u64;
        }
        self.add_to_overview(1, tiles)
    }

    /// Completes the file under its name.
    ///
    /// # Errors
    /// When a tile is missing or the file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        if let Some(slot) = self.levels[0].tiles.iter().position(|t| t.1 == 0) {
            let message = format!("tile {slot} of {} was never written", self.path.display());
            return Err(io::Error::other(message));
        }
        self.spool.flush()?;
        self.overviews.flush()?;
        let tile_count: usize = self.levels.iter().map(|l| l.tiles.len()).sum();
        let big = self.spool_length + self.overviews_length + 16 * tile_count as u64 > CLASSIC_LIMIT;
        // Twice: the first pass tells how long the directories are.
        let head_length = self.head(big, 0).len() as u64;
        let head = self.head(big, head_length);
        let mut out = BufWriter::with_capacity(1 << 20, File::create(&self.partial)?);
        out.write_all(&head)?;
        let mut waiting = File::open(&self.overviews_path)?;
        let mut block = Vec::new();
        for &(offset, length) in self.levels[1..].iter().rev().flat_map(|level| &level.tiles) {
            waiting.seek(SeekFrom::Start(offset))?;
            block.resize(length as usize, 0);
            waiting.read_exact(&mut block)?;
            out.write_all(&block)?;
        }
        let mut tiles = BufReader::with_capacity(1 << 20, File::open(&self.spool_path)?);
        if self.levels[0].in_order() {
            io::copy(&mut tiles, &mut out)?;
        } else {
            for &(offset, length) in &self.levels[0].tiles {
                tiles.seek(SeekFrom::Start(offset))?;
                block.resize(length as usize, 0);
                tiles.read_exact(&mut block)?;
                out.write_all(&block)?;
            }
        }
        out.into_inner().map_err(|e| e.into_error())?.sync_all()?;
        fs::remove_file(&self.spool_path)?;
        fs::remove_file(&self.overviews_path)?;
        fs::rename(&self.partial, &self.path)
    }

    fn compress(&self, samples: &Samples) -> Vec<u8> {
        let (line, bands) = (self.tile_px * self.layer.bands.len(), self.layer.bands.len());
        let bytes = match samples {
            Samples::U8(v) => to_bytes(&differences(v, line, bands, u8::wrapping_sub), |x| [x]),
            Samples::U16(v) => to_bytes(&differences(v, line, bands, u16::wrapping_sub), u16::to_le_bytes),
            Samples::U32(v) => to_bytes(&differences(v, line, bands, u32::wrapping_sub), u32::to_le_bytes),
            Samples::F32(v) => {
                let bits: Vec<u32> = v.iter().map(|x| x.to_bits()).collect();
                to_bytes(&differences(&bits, line, bands, u32::wrapping_sub), u32::to_le_bytes)
            }
            Samples::F64(v) => to_bytes(v, f64::to_le_bytes),
        };
        let mut encoder = ZlibEncoder::new(Vec::with_capacity(bytes.len() / 2), Compression::new(DEFLATE_LEVEL));
        encoder.write_all(&bytes).and_then(|()| encoder.finish()).expect("writing to memory does not fail")
    }

    /// Halves the tiles into the overview `level`; complete overview tiles are compressed and passed on.
    fn add_to_overview(&mut self, level: usize, tiles: Vec<Tile>) -> io::Result<()> {
        if level >= self.levels.len() || tiles.is_empty() {
            return Ok(());
        }
        let (tile_px, half_px, bands) = (self.tile_px, self.tile_px / 2, self.layer.bands.len());
        let halves: Vec<Samples> = tiles.par_iter().map(|t| self.halve(&t.samples)).collect();
        let empty = no_data_tile(&self.layer, tile_px);
        let (fine_across, fine_down) = (self.levels[level - 1].across, self.levels[level - 1].down);
        let mut complete = Vec::new();
        for (tile, half) in tiles.iter().zip(halves) {
            let key = (tile.row / 2, tile.column / 2);
            let parts = (fine_across - 2 * key.1).min(2) * (fine_down - 2 * key.0).min(2);
            let (whole, count) = self.levels[level].pending.entry(key).or_insert_with(|| (empty.clone(), 0));
            let to = Block { x: tile.column % 2 * half_px, y: tile.row % 2 * half_px, picture_width: tile_px };
            let from = Block { x: 0, y: 0, picture_width: half_px };
            whole.copy_block(to, &half, from, [half_px; 2], bands);
            *count += 1;
            if *count == parts {
                complete.push(key);
            }
        }
        let ready: Vec<Tile> = complete
            .into_iter()
            .filter_map(|key| {
                let (samples, _) = self.levels[level].pending.remove(&key)?;
                Some(Tile { row: key.0, column: key.1, samples })
            })
            .collect();
        let compressed: Vec<Vec<u8>> = ready.par_iter().map(|t| self.compress(&t.samples)).collect();
        let target = &mut self.levels[level];
        for (tile, bytes) in ready.iter().zip(compressed) {
            target.tiles[tile.row * target.across + tile.column] = (self.overviews_length, bytes.len() as u64);
            self.overviews.write_all(&bytes)?;
            self.overviews_length += bytes.len() as u64;
        }
        self.add_to_overview(level + 1, ready)
    }

    /// A tile at half the resolution: `tile_px / 2` squared.
    fn halve(&self, samples: &Samples) -> Samples {
        match samples {
            Samples::U8(v) => Samples::U8(self.halve_column(v)),
            Samples::U16(v) => Samples::U16(self.halve_column(v)),
            Samples::U32(v) => Samples::U32(self.halve_column(v)),
            Samples::F32(v) => Samples::F32(self.halve_column(v)),
            Samples::F64(v) => Samples::F64(self.halve_column(v)),
        }
    }

    fn halve_column<T: Sample>(&self, fine: &[T]) -> Vec<T> {
        let (n, bands) = (self.tile_px, self.layer.bands.len());
        let mut half = Vec::with_capacity(fine.len() / 4);
        for rows in fine.chunks_exact(2 * n * bands) {
            let (upper, lower) = rows.split_at(n * bands);
            for (a, b) in upper.chunks_exact(2 * bands).zip(lower.chunks_exact(2 * bands)) {
                match self.layer.resampling {
                    Resampling::Nearest => half.extend_from_slice(&a[..bands]),
                    Resampling::Mean => {
                        mean([&a[..bands], &a[bands..], &b[..bands], &b[bands..]], self.layer.no_data, &mut half);
                    }
                }
            }
        }
        half
    }

    /// Header and directories, given where the tiles start.
    fn head(&self, big: bool, tiles_start: u64) -> Vec<u8> {
        let mut starts = vec![0u64; self.levels.len()];
        let mut next = tiles_start;
        for k in (1..self.levels.len()).rev() {
            starts[k] = next;
            next += self.levels[k].tiles.iter().map(|t| t.1).sum::<u64>();
        }
        starts[0] = next;
        let mut out = Vec::new();
        out.extend_from_slice(b"II");
        if big {
            out.extend([43u16, 8, 0].iter().flat_map(|x| x.to_le_bytes()));
            out.extend(16u64.to_le_bytes());
        } else {
            out.extend(42u16.to_le_bytes());
            out.extend(8u32.to_le_bytes());
        }
        for k in 0..self.levels.len() {
            let entries = self.entries(k, starts[k]);
            let last = k + 1 == self.levels.len();
            write_directory(&mut out, big, &entries, last);
        }
        out
    }

    fn entries(&self, k: usize, start: u64) -> Vec<Entry> {
        let (level, layer) = (&self.levels[k], &self.layer);
        let bands = layer.bands.len();
        let bits = vec![(layer.sample.bytes() * 8) as u64; bands];
        let format = match layer.sample {
            SampleType::F32 | SampleType::F64 => 3,
            _ => 1,
        };
        let is_rgba = layer.no_data == NoData::Alpha;
        let mut entries = vec![
            Entry::long(254, &[u64::from(k > 0)]),
            Entry::long(256, &[level.width as u64]),
            Entry::long(257, &[level.height as u64]),
            Entry::short(258, &bits),
            Entry::short(259, &[8]),
            Entry::short(262, &[if is_rgba { 2 } else { 1 }]),
            Entry::short(277, &[bands as u64]),
            Entry::short(284, &[1]),
            Entry::short(317, &[if has_predictor(layer.sample) { 2 } else { 1 }]),
            Entry::long(322, &[self.tile_px as u64]),
            Entry::long(323, &[self.tile_px as u64]),
            Entry::offsets(324, level.offsets(start)),
            Entry::offsets(325, level.tiles.iter().map(|t| t.1).collect()),
            Entry::short(339, &vec![format; bands]),
        ];
        if is_rgba {
            entries.push(Entry::short(338, &[2]));
        } else if bands > 1 {
            entries.push(Entry::short(338, &vec![0; bands - 1]));
        }
        if k == 0 {
            let cell = self.grid.cell_m();
            entries.push(Entry::ascii(270, layer.meaning));
            entries.push(Entry::double(33550, &[cell, cell, 0.0]));
            entries.push(Entry::double(33922, &[0.0, 0.0, 0.0, self.grid.u_min(), self.grid.v_max(), 0.0]));
            // Model type and raster type (pixel is area); user-defined projected system in metres, named.
            let citation = format!("{CITATION}|");
            let keys = [
                [1, 1, 1, 5],
                [1024, 0, 1, 1],
                [1025, 0, 1, 1],
                [1026, 34737, citation.len() as u64, 0],
                [3072, 0, 1, 32767],
                [3076, 0, 1, 9001],
            ];
            entries.push(Entry::short(34735, keys.as_flattened()));
            entries.push(Entry::ascii(34737, &citation));
            entries.push(Entry::ascii(42112, &self.metadata()));
        }
        match layer.no_data {
            NoData::Alpha => {}
            NoData::Nan => entries.push(Entry::ascii(42113, "nan")),
            NoData::Value(value) => entries.push(Entry::ascii(42113, &format!("{value}"))),
        }
        entries.sort_by_key(|e| e.tag);
        entries
    }

    /// Band names, offsets and units the way GDAL stores them.
    fn metadata(&self) -> String {
        let mut xml = String::from("<GDALMetadata>\n");
        xml += "  <Item name=\"VIEW\">seen from inside, facing increasing chainage; v up, positive over the right wall</Item>\n";
        for (band, name) in self.layer.bands.iter().enumerate() {
            xml += &format!("  <Item name=\"DESCRIPTION\" sample=\"{band}\" role=\"description\">{name}</Item>\n");
            if !self.layer.unit.is_empty() {
                let unit = self.layer.unit;
                xml += &format!("  <Item name=\"UNITTYPE\" sample=\"{band}\" role=\"unittype\">{unit}</Item>\n");
            }
            if let Some(offset) = self.layer.band_offsets.get(band) {
                xml += &format!("  <Item name=\"OFFSET\" sample=\"{band}\" role=\"offset\">{offset}</Item>\n");
                xml += &format!("  <Item name=\"SCALE\" sample=\"{band}\" role=\"scale\">1</Item>\n");
            }
        }
        xml + "</GDALMetadata>\n"
    }
}

impl Drop for GeoTiffWriter {
    fn drop(&mut self) {
        // Only there when writing was broken off.
        fs::remove_file(&self.spool_path).ok();
        fs::remove_file(&self.overviews_path).ok();
        fs::remove_file(&self.partial).ok();
    }
}

impl Level {
    fn new(width: usize, height: usize, tile_px: usize) -> Self {
        let (across, down) = (width.div_ceil(tile_px), height.div_ceil(tile_px));
        Self { width, height, across, down, tiles: vec![(0, 0); across * down], pending: BTreeMap::new() }
    }

    fn in_order(&self) -> bool {
        let mut next = 0;
        self.tiles.iter().all(|t| {
            let fits = t.0 == next;
            next += t.1;
            fits
        })
    }

    /// File offsets of the tiles, which lie one after the other in their order, given where the level starts.
    fn offsets(&self, start: u64) -> Vec<u64> {
        let mut next = start;
        let mut place = |t: &(u64, u64)| {
            next += t.1;
            next - t.1
        };
        self.tiles.iter().map(&mut place).collect()
    }
}

/// A TIFF directory entry; numbers are brought to bytes when it is known whether the file is a BigTIFF.
struct Entry {
    tag: u16,
    kind: EntryKind,
}

enum EntryKind {
    Short(Vec<u64>),
    Long(Vec<u64>),
    /// 32 bits in classic files, 64 in BigTIFF.
    Offsets(Vec<u64>),
    Double(Vec<f64>),
    Ascii(String),
}

impl Entry {
    fn short(tag: u16, values: &[u64]) -> Self {
        Self { tag, kind: EntryKind::Short(values.to_vec()) }
    }

    fn long(tag: u16, values: &[u64]) -> Self {
        Self { tag, kind: EntryKind::Long(values.to_vec()) }
    }

    fn offsets(tag: u16, values: Vec<u64>) -> Self {
        Self { tag, kind: EntryKind::Offsets(values) }
    }

    fn double(tag: u16, values: &[f64]) -> Self {
        Self { tag, kind: EntryKind::Double(values.to_vec()) }
    }

    fn ascii(tag: u16, text: &str) -> Self {
        Self { tag, kind: EntryKind::Ascii(text.to_owned()) }
    }

    /// TIFF type code, number of values, bytes of the values.
    fn encode(&self, big: bool) -> (u16, u64, Vec<u8>) {
        match &self.kind {
            EntryKind::Short(v) => (3, v.len() as u64, v.iter().flat_map(|&x| (x as u16).to_le_bytes()).collect()),
            EntryKind::Long(v) => (4, v.len() as u64, v.iter().flat_map(|&x| (x as u32).to_le_bytes()).collect()),
            EntryKind::Offsets(v) if big => (16, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            EntryKind::Offsets(v) => (4, v.len() as u64, v.iter().flat_map(|&x| (x as u32).to_le_bytes()).collect()),
            EntryKind::Double(v) => (12, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            EntryKind::Ascii(s) => (2, s.len() as u64 + 1, s.bytes().chain([0]).collect()),
        }
    }
}

/// Appends one directory and the values that do not fit into its entries.
fn write_directory(out: &mut Vec<u8>, big: bool, entries: &[Entry], last: bool) {
    let (count_size, entry_size, inline) = if big { (8, 20, 8) } else { (2, 12, 4) };
    let pointer_size = if big { 8 } else { 4 };
    let push = |out: &mut Vec<u8>, x: u64, size: usize| out.extend_from_slice(&x.to_le_bytes()[..size]);
    let values_start = out.len() + count_size + entries.len() * entry_size + pointer_size;
    let mut values: Vec<u8> = Vec::new();
    push(out, entries.len() as u64, count_size);
    for entry in entries {
        let (kind, count, mut bytes) = entry.encode(big);
        push(out, u64::from(entry.tag), 2);
        push(out, u64::from(kind), 2);
        push(out, count, pointer_size);
        if bytes.len() <= inline {
            bytes.resize(inline, 0);
            out.extend_from_slice(&bytes);
        } else {
            // Values start on even addresses (TIFF 6.0, section 2).
            if !(values_start + values.len()).is_multiple_of(2) {
                values.push(0);
            }
            push(out, (values_start + values.len()) as u64, pointer_size);
            values.extend_from_slice(&bytes);
        }
    }
    let mut end = values_start + values.len();
    if !end.is_multiple_of(8) {
        values.resize(values.len() + 8 - end % 8, 0);
        end = values_start + values.len();
    }
    push(out, if last { 0 } else { end as u64 }, pointer_size);
    out.extend_from_slice(&values);
}

/// A tile of the layer with nothing on it.
pub fn no_data_tile(layer: &LayerDescription, tile_px: usize) -> Samples {
    Samples::filled(layer.sample, layer.no_data.value(), tile_px * tile_px * layer.bands.len())
}

/// 64-bit differences are missing in older readers.
fn has_predictor(sample: SampleType) -> bool {
    sample != SampleType::F64
}

/// Appends the mean of those of four pixels that hold something.
fn mean<T: Sample>(pixels: [&[T]; 4], no_data: NoData, out: &mut Vec<T>) {
    let bands = pixels[0].len();
    if no_data == NoData::Alpha {
        let alpha = pixels.map(|p| p[bands - 1].number());
        let total: f64 = alpha.iter().sum();
        let inverse = if total > 0.0 { 1.0 / total } else { 0.0 };
        for band in 0..bands - 1 {
            let sum: f64 = pixels.iter().zip(alpha).map(|(p, a)| p[band].number() * a).sum();
            out.push(T::nearest(sum * inverse));
        }
        // Not half transparent at the edges: a pixel is there or not.
        out.push(T::nearest(if total > 0.0 { 255.0 } else { 0.0 }));
        return;
    }
    for band in 0..bands {
        let (mut sum, mut count) = (0.0, 0);
        for pixel in pixels {
            let value = pixel[band].number();
            if no_data.is_data(value) {
                sum += value;
                count += 1;
            }
        }
        out.push(T::nearest(if count > 0 { sum / f64::from(count) } else { no_data.value() }));
    }
}

/// Predictor 2: each sample minus the one to its left in the same band; `line` samples make a row.
fn differences<T: Copy>(samples: &[T], line: usize, bands: usize, minus: impl Fn(T, T) -> T) -> Vec<T> {
    let mut out = samples.to_vec();
    for (from, to) in samples.chunks_exact(line).zip(out.chunks_exact_mut(line)) {
        for ((to, &here), &left) in to[bands..].iter_mut().zip(&from[bands..]).zip(from) {
            *to = minus(here, left);
        }
    }
    out
}

/// Little-endian bytes of samples.
fn to_bytes<T: Copy, const N: usize>(samples: &[T], bytes: impl Fn(T) -> [u8; N]) -> Vec<u8> {
    let mut out = vec![0; samples.len() * N];
    for (to, &sample) in out.as_chunks_mut::<N>().0.iter_mut().zip(samples) {
        *to = bytes(sample);
    }
    out
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(suffix);
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Layer, Look};
    use crate::numeric::Vec2;

    fn layer(sample: SampleType, bands: &[&'static str], no_data: NoData) -> LayerDescription {
        LayerDescription {
            layer: Layer::Offset,
            sample,
            bands: bands.to_vec(),
            no_data,
            resampling: Resampling::Mean,
            look: Look::None,
            unit: "m",
            meaning: "test",
            band_offsets: vec![],
        }
    }

    fn write(path: &Path, width: usize, height: usize, layer: &LayerDescription, value: impl Fn(usize, usize) -> f64) {
        let extent = Vec2::new(width as f64, height as f64) * 0.01;
        let grid = Grid::covering(Vec2::new(5.0, -extent.y), Vec2::new(5.0 + extent.x, 0.0), 0.01).unwrap();
        assert_eq!((grid.width(), grid.height()), (width, height));
        let mut writer = GeoTiffWriter::create(path, &grid, layer, 256).unwrap();
        for row in 0..height.div_ceil(256) {
            let tiles = (0..width.div_ceil(256)).map(|column| {
                let mut samples = no_data_tile(layer, 256);
                for y in 0..256.min(height - row * 256) {
                    for x in 0..256.min(width - column * 256) {
                        let value = value(column * 256 + x, row * 256 + y);
                        let pixel = Samples::filled(layer.sample, value, layer.bands.len());
                        let (to, from) = (Block { x, y, picture_width: 256 }, Block { x: 0, y: 0, picture_width: 1 });
                        samples.copy_block(to, &pixel, from, [1, 1], layer.bands.len());
                    }
                }
                Tile { column, row, samples }
            });
            writer.write_tiles(tiles.collect()).unwrap();
        }
        writer.finish().unwrap();
    }

    #[test]
    fn another_reader_gets_the_samples_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tif");
        let value = |x: usize, y: usize| ((x * 7 + y * 13) % 60_000) as f64;
        write(&path, 700, 300, &layer(SampleType::U16, &["a"], NoData::Value(0.0)), value);
        let mut decoder = tiff::decoder::Decoder::new(File::open(&path).unwrap()).unwrap();
        assert_eq!(decoder.dimensions().unwrap(), (700, 300));
        let tiff::decoder::DecodingResult::U16(v) = decoder.read_image().unwrap() else { panic!("16 bit") };
        for y in 0..300 {
            for x in 0..700 {
                assert_eq!(f64::from(v[y * 700 + x]), value(x, y));
            }
        }
        let scale = decoder.get_tag_f64_vec(tiff::tags::Tag::ModelPixelScaleTag).unwrap();
        let tie = decoder.get_tag_f64_vec(tiff::tags::Tag::ModelTiepointTag).unwrap();
        assert_eq!((scale[0], tie[3], tie[4]), (0.01, 5.0, 0.0));
        assert!(decoder.more_images());
        decoder.next_image().unwrap();
        assert_eq!(decoder.dimensions().unwrap(), (350, 150));
        let tiff::decoder::DecodingResult::U16(v) = decoder.read_image().unwrap() else { panic!("16 bit") };
        let mean = (value(20, 30) + value(21, 30) + value(20, 31) + value(21, 31)) / 4.0;
        assert_eq!(f64::from(v[15 * 350 + 10]), mean.round());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file stays");
    }

    #[test]
    fn floats_and_single_tiles_work() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.tif");
        let value = |x: usize, y: usize| if x < 3 { f64::NAN } else { x as f64 * 0.5 - y as f64 };
        write(&path, 60, 40, &layer(SampleType::F32, &["a", "b"], NoData::Nan), value);
        let mut decoder = tiff::decoder::Decoder::new(File::open(&path).unwrap()).unwrap();
        let tiff::decoder::DecodingResult::F32(v) = decoder.read_image().unwrap() else { panic!("float") };
        assert!(v[0].is_nan());
        assert_eq!(v[2 * (7 * 60 + 9) + 1], 4.5 - 7.0);
        assert!(!decoder.more_images());
    }

    #[test]
    fn a_missing_tile_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.tif");
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(1.0, 1.0), 0.01).unwrap();
        let layer = layer(SampleType::U8, &["a"], NoData::Value(0.0));
        let writer = GeoTiffWriter::create(&path, &grid, &layer, 256).unwrap();
        assert!(writer.finish().unwrap_err().to_string().contains("never written"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
