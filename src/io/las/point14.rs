//! The field `Point14` of layered LAZ: the first 30 bytes of each record of point formats 6 to 10.
//!
//! When to use: for every layered chunk. The crate `laz` brings the arithmetic decoder and decodes all other fields; its decoder of
//! this field calls itself without a limit where GPS times are damaged (`docs/decisions/0010-own-decoder-of-layered-points.md`).
//! Reference: rapidlasso, *LAZ Specification 1.4 - R1* (2022); M. Isenburg, *LASzip: lossless compression of lidar data*,
//! Photogrammetric Engineering & Remote Sensing 79 (2013), 209-217. Each value is told by how it differs from what came before in
//! the same scanner channel; models that learn how often each symbol comes are kept apart by what is already known of the point.
//! Guarantees: damaged bytes give wrong values or an error; layers that are not wanted, or empty, leave their values at those of
//! the last point of the channel, as `laz` does.

use super::gps_times::GpsTimes;
use laz::DecompressionSelection;
use laz::decoders::ArithmeticDecoder;
use laz::decompressors::{IntegerDecompressor, IntegerDecompressorBuilder};
use laz::models::{ArithmeticModel, ArithmeticModelBuilder};
use laz::record::LayeredFieldDecompressor;
use std::io::{self, Cursor, Read, Seek};

/// Bytes of the field.
const SIZE: usize = 30;
/// Layers that may be left out; they follow the one of positions in the plane.
const OPTIONAL: usize = 8;

type LayerDecoder = ArithmeticDecoder<Cursor<Vec<u8>>>;

/// Decoder of one chunk.
pub(super) struct Point14 {
    /// Version 3 tells the fields behind this one the channel of a point only where it changes, version 4 always.
    tells_every_channel: bool,
    wanted: [bool; OPTIONAL],
    sizes: [u32; 1 + OPTIONAL],
    layers: Layers,
    /// Made when their first point comes.
    channels: [Option<Box<Channel>>; 4],
    current: usize,
}

impl Point14 {
    /// For version 3 or 4 of the item.
    pub(super) fn new(version: u16) -> Self {
        Self {
            tells_every_channel: version >= 4,
            wanted: [true; OPTIONAL],
            sizes: [0; 1 + OPTIONAL],
            layers: Layers::default(),
            channels: Default::default(),
            current: 0,
        }
    }

    /// Reads what differs from the last point, and goes over to the channel of this one.
    fn enter_channel(&mut self, context: &mut usize) -> io::Result<Changes> {
        let Some(channel) = &mut self.channels[self.current] else {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "there is no first point"));
        };
        let xy = &mut self.layers.xy;
        let changes = Changes(xy.decode_symbol(&mut channel.changes[channel.last.kind_with_gps_change()])?);
        if changes.channel() {
            let step = xy.decode_symbol(&mut channel.next_channel)? as usize + 1;
            let last = channel.last;
            self.current = (self.current + step) % 4;
            let channel = self.channels[self.current].get_or_insert_with(|| Box::new(Channel::new(last)));
            channel.last.set_channel(self.current as u8);
        }
        if changes.channel() || self.tells_every_channel {
            *context = self.current;
        }
        Ok(changes)
    }
}

impl<R: Read + Seek> LayeredFieldDecompressor<R> for Point14 {
    fn size_of_field(&self) -> usize {
        SIZE
    }

    fn set_selection(&mut self, selection: DecompressionSelection) {
        // In the order of the layers.
        self.wanted = [
            selection.should_decompress_z(),
            selection.should_decompress_classification(),
            selection.should_decompress_flags(),
            selection.should_decompress_intensity(),
            selection.should_decompress_scan_angle(),
            selection.should_decompress_user_data(),
            selection.should_decompress_point_source_id(),
            selection.should_decompress_gps_time(),
        ];
    }

    fn init_first_point(&mut self, src: &mut R, first_point: &mut [u8], context: &mut usize) -> io::Result<()> {
        src.read_exact(first_point)?;
        let first = Point::from_record(record(first_point)?);
        self.channels = Default::default();
        self.current = first.channel();
        self.channels[self.current] = Some(Box::new(Channel::new(first)));
        *context = self.current;
        Ok(())
    }

    fn decompress_field_with(&mut self, current_point: &mut [u8], context: &mut usize) -> io::Result<()> {
        let changes = self.enter_channel(context)?;
        if let Some(channel) = &mut self.channels[self.current] {
            channel.read(changes, &mut self.layers)?;
            channel.last.write(record(current_point)?);
        }
        Ok(())
    }

    fn read_layers_sizes(&mut self, src: &mut R) -> io::Result<()> {
        for size in &mut self.sizes {
            let mut bytes = [0; 4];
            src.read_exact(&mut bytes)?;
            *size = u32::from_le_bytes(bytes);
        }
        Ok(())
    }

    fn read_layers(&mut self, src: &mut R) -> io::Result<()> {
        let [xy, sizes @ ..] = self.sizes;
        self.layers.xy = layer_decoder(src, xy)?;
        for ((layer, size), wanted) in self.layers.optional().into_iter().zip(sizes).zip(self.wanted) {
            *layer = None;
            if size > 0 && wanted {
                *layer = Some(layer_decoder(src, size)?);
            } else {
                src.seek_relative(size.into())?;
            }
        }
        Ok(())
    }
}

fn record(bytes: &mut [u8]) -> io::Result<&mut [u8; SIZE]> {
    bytes.try_into().map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "a point takes 30 bytes"))
}

/// Takes a layer out of the chunk; its size is only believed as far as there are bytes.
fn layer_decoder(src: &mut impl Read, size: u32) -> io::Result<LayerDecoder> {
    let mut bytes = Vec::new();
    src.take(size.into()).read_to_end(&mut bytes)?;
    if bytes.len() < size as usize {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let mut decoder = ArithmeticDecoder::new(Cursor::new(bytes));
    if size > 0 {
        decoder.read_init_bytes()?;
    }
    Ok(decoder)
}

/// The layers of a chunk; absent are those that are empty or not wanted.
struct Layers {
    xy: LayerDecoder,
    z: Option<LayerDecoder>,
    classification: Option<LayerDecoder>,
    flags: Option<LayerDecoder>,
    intensity: Option<LayerDecoder>,
    scan_angle: Option<LayerDecoder>,
    user_data: Option<LayerDecoder>,
    source_id: Option<LayerDecoder>,
    gps_time: Option<LayerDecoder>,
}

impl Default for Layers {
    fn default() -> Self {
        Self {
            xy: ArithmeticDecoder::new(Cursor::default()),
            z: None,
            classification: None,
            flags: None,
            intensity: None,
            scan_angle: None,
            user_data: None,
            source_id: None,
            gps_time: None,
        }
    }
}

impl Layers {
    /// In the order of the file.
    fn optional(&mut self) -> [&mut Option<LayerDecoder>; OPTIONAL] {
        [
            &mut self.z,
            &mut self.classification,
            &mut self.flags,
            &mut self.intensity,
            &mut self.scan_angle,
            &mut self.user_data,
            &mut self.source_id,
            &mut self.gps_time,
        ]
    }
}

/// What differs from the last point of the channel: seven bits.
#[derive(Clone, Copy)]
struct Changes(u32);

impl Changes {
    fn channel(self) -> bool {
        self.0 & 64 != 0
    }

    fn source_id(self) -> bool {
        self.0 & 32 != 0
    }

    fn gps_time(self) -> bool {
        self.0 & 16 != 0
    }

    fn scan_angle(self) -> bool {
        self.0 & 8 != 0
    }

    fn number_of_returns(self) -> bool {
        self.0 & 4 != 0
    }

    /// 0 same, 1 one more, 2 one less, 3 told apart.
    fn return_number(self) -> u32 {
        self.0 & 3
    }
}

/// The values of one point.
#[derive(Clone, Copy)]
struct Point {
    x: i32,
    y: i32,
    z: i32,
    intensity: u16,
    /// Number of returns in the upper four bits, return number in the lower.
    returns: u8,
    /// From the top: edge of flight line, scan direction, channel (two bits), flags of the class (four).
    flags: u8,
    classification: u8,
    user_data: u8,
    scan_angle: i16,
    source_id: u16,
    /// The bits of the number.
    gps_time: u64,
    /// Whether the time differed from the one before; no part of the record.
    gps_time_changed: bool,
}

impl Point {
    fn from_record(record: &[u8; SIZE]) -> Self {
        let int = |at: usize| i32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]);
        let short = |at: usize| u16::from_le_bytes([record[at], record[at + 1]]);
        Self {
            x: int(0),
            y: int(4),
            z: int(8),
            intensity: short(12),
            returns: record[14],
            flags: record[15],
            classification: record[16],
            user_data: record[17],
            scan_angle: short(18) as i16,
            source_id: short(20),
            gps_time: u64::from(int(22) as u32) | u64::from(int(26) as u32) << 32,
            gps_time_changed: false,
        }
    }

    fn write(&self, record: &mut [u8; SIZE]) {
        record[0..4].copy_from_slice(&self.x.to_le_bytes());
        record[4..8].copy_from_slice(&self.y.to_le_bytes());
        record[8..12].copy_from_slice(&self.z.to_le_bytes());
        record[12..14].copy_from_slice(&self.intensity.to_le_bytes());
        record[14..18].copy_from_slice(&[self.returns, self.flags, self.classification, self.user_data]);
        record[18..20].copy_from_slice(&self.scan_angle.to_le_bytes());
        record[20..22].copy_from_slice(&self.source_id.to_le_bytes());
        record[22..30].copy_from_slice(&self.gps_time.to_le_bytes());
    }

    fn channel(&self) -> usize {
        usize::from(self.flags >> 4 & 3)
    }

    fn set_channel(&mut self, channel: u8) {
        self.flags = self.flags & !0x30 | (channel & 3) << 4;
    }

    fn return_number(&self) -> u8 {
        self.returns & 15
    }

    fn number_of_returns(&self) -> u8 {
        self.returns >> 4
    }

    fn is_first(&self) -> bool {
        self.return_number() == 1
    }

    fn is_last(&self) -> bool {
        self.return_number() >= self.number_of_returns()
    }

    /// Eight kinds of last points.
    fn kind_with_gps_change(&self) -> usize {
        usize::from(self.is_first()) | usize::from(self.is_last()) << 1 | usize::from(self.gps_time_changed) << 2
    }

    /// Four kinds of points: in between, last, first, single.
    fn kind(&self) -> usize {
        usize::from(self.is_last()) | usize::from(self.is_first()) << 1
    }

    /// The flags without the channel, as the layer has them: six bits.
    fn flag_symbol(&self) -> usize {
        usize::from(self.flags & 15 | self.flags >> 6 << 4)
    }

    fn set_flag_symbol(&mut self, symbol: u32) {
        let symbol = symbol as u8;
        self.flags = self.flags & 0x30 | symbol & 15 | (symbol >> 4) << 6;
    }
}

/// Kinds of returns, by which the steps in x and y are expected.
const RETURN_KINDS: usize = 6;

/// The kind of a return, by the byte of its two numbers.
const RETURN_KIND: [u8; 256] = {
    let mut kinds = [0; 256];
    let mut returns = 0;
    while returns < 256 {
        kinds[returns] = return_kind(returns as u8 >> 4, returns as u8 & 15);
        returns += 1;
    }
    kinds
};

/// Single returns (0), the first and the last of two (1, 2), the first (3), the inner (4) and the last (5) of more; writers that
/// mix the two numbers up or leave one out get kinds as well, so the rule takes them in either order.
const fn return_kind(number: u8, return_number: u8) -> u8 {
    let (few, many) = if number < return_number { (number, return_number) } else { (return_number, number) };
    match (few, many) {
        (0, 0..=5) => many,
        (0, 6) => 3,
        (0, 7 | 8) => 4,
        (0, _) => 5,
        (1, 1) => 0,
        (1, 2) => 1,
        (1, _) => 3,
        (2, 2) => 2,
        (2, 3..=10) => 4,
        (2, _) => 3,
        // Of many returns the last but one is like the last.
        _ if many == few || few >= 11 && many == few + 1 => 5,
        _ => 4,
    }
}

/// The middle of the recent values: the largest and the smallest are replaced in turns, so that it follows.
#[derive(Clone, Copy)]
struct RecentMedian {
    /// In rising order.
    values: [i32; 5],
    replace_largest: bool,
}

impl RecentMedian {
    const NEW: Self = Self { values: [0; 5], replace_largest: true };

    fn get(&self) -> i32 {
        self.values[2]
    }

    fn add(&mut self, value: i32) {
        let [a, b, c, d, e] = self.values;
        let kept = if self.replace_largest { [a, b, c, d] } else { [b, c, d, e] };
        // The side of the new value is the side that goes on growing, unless it is the middle.
        self.replace_largest = if self.replace_largest { value < c } else { value <= c };
        // Sorted in without branches: which way they go cannot be foreseen.
        self.values = [
            kept[0].min(value),
            kept[1].min(value).max(kept[0]),
            kept[2].min(value).max(kept[1]),
            kept[3].min(value).max(kept[2]),
            kept[3].max(value),
        ];
    }
}

/// Models of one number of symbols, one for each context, made when they are first needed: most never are.
struct Models<const CONTEXTS: usize> {
    symbols: u32,
    models: [Option<ArithmeticModel>; CONTEXTS],
}

impl<const CONTEXTS: usize> Models<CONTEXTS> {
    fn new(symbols: u32) -> Self {
        Self { symbols, models: [const { None }; CONTEXTS] }
    }

    fn of(&mut self, context: usize) -> &mut ArithmeticModel {
        let symbols = self.symbols;
        self.models[context % CONTEXTS].get_or_insert_with(|| ArithmeticModelBuilder::new(symbols).build())
    }
}

/// What is known from the points of one scanner channel so far.
struct Channel {
    last: Point,
    /// Heights by how many returns lie between this one and the last of its pulse.
    last_z: [i32; 8],
    /// Intensities by the kind of the point and whether its time is new.
    last_intensity: [u16; 8],
    /// Steps in x and y by the kind of the return and whether its time is new.
    steps: [[[RecentMedian; 2]; 2]; RETURN_KINDS],
    gps_times: GpsTimes,

    changes: [ArithmeticModel; 8],
    next_channel: ArithmeticModel,
    number_of_returns: Models<16>,
    return_number: Models<16>,
    return_number_same_time: ArithmeticModel,
    classification: Models<64>,
    flags: Models<64>,
    user_data: Models<64>,
    dx: IntegerDecompressor,
    dy: IntegerDecompressor,
    z: IntegerDecompressor,
    intensity: IntegerDecompressor,
    scan_angle: IntegerDecompressor,
    source_id: IntegerDecompressor,
}

impl Channel {
    /// A channel whose first point is told beside this one.
    fn new(last: Point) -> Self {
        let model = |symbols: u32| ArithmeticModelBuilder::new(symbols).build();
        let integers = |bits: u32, contexts: u32| {
            IntegerDecompressorBuilder::new().bits(bits).contexts(contexts).build_initialized()
        };
        Self {
            last,
            last_z: [last.z; 8],
            last_intensity: [last.intensity; 8],
            steps: [[[RecentMedian::NEW; 2]; 2]; RETURN_KINDS],
            gps_times: GpsTimes::new(last.gps_time),
            changes: std::array::from_fn(|_| model(128)),
            next_channel: model(3),
            number_of_returns: Models::new(16),
            return_number: Models::new(16),
            return_number_same_time: model(13),
            classification: Models::new(256),
            flags: Models::new(64),
            user_data: Models::new(256),
            dx: integers(32, 2),
            dy: integers(32, 22),
            z: integers(32, 20),
            intensity: integers(16, 4),
            scan_angle: integers(16, 2),
            source_id: integers(16, 1),
        }
    }

    /// Turns `last` into the next point.
    fn read(&mut self, changes: Changes, layers: &mut Layers) -> io::Result<()> {
        self.read_returns(changes, &mut layers.xy)?;
        self.read_xy(changes, &mut layers.xy)?;
        if let Some(layer) = &mut layers.z {
            self.read_z(layer)?;
        }
        if let Some(layer) = &mut layers.classification {
            self.read_classification(layer)?;
        }
        if let Some(layer) = &mut layers.flags {
            let symbol = layer.decode_symbol(self.flags.of(self.last.flag_symbol()))?;
            self.last.set_flag_symbol(symbol);
        }
        if let Some(layer) = &mut layers.intensity {
            self.read_intensity(changes, layer)?;
        }
        if let Some(layer) = &mut layers.scan_angle
            && changes.scan_angle()
        {
            let expected = self.last.scan_angle.into();
            self.last.scan_angle = self.scan_angle.decompress(layer, expected, changes.gps_time().into())? as i16;
        }
        if let Some(layer) = &mut layers.user_data {
            let model = self.user_data.of(usize::from(self.last.user_data / 4));
            self.last.user_data = layer.decode_symbol(model)? as u8;
        }
        if let Some(layer) = &mut layers.source_id
            && changes.source_id()
        {
            self.last.source_id = self.source_id.decompress(layer, self.last.source_id.into(), 0)? as u16;
        }
        if let Some(layer) = &mut layers.gps_time
            && changes.gps_time()
        {
            self.last.gps_time = self.gps_times.read(layer)?;
        }
        self.last.gps_time_changed = changes.gps_time();
        Ok(())
    }

    fn read_returns(&mut self, changes: Changes, layer: &mut LayerDecoder) -> io::Result<()> {
        let (mut number, last) = (self.last.number_of_returns(), self.last.return_number());
        if changes.number_of_returns() {
            number = layer.decode_symbol(self.number_of_returns.of(number.into()))? as u8;
        }
        let return_number = match changes.return_number() {
            0 => last,
            1 => last + 1,
            2 => last + 15,
            _ if changes.gps_time() => layer.decode_symbol(self.return_number.of(last.into()))? as u8,
            // Steps of 2 to 14; smaller ones are among the changes.
            _ => last + 2 + layer.decode_symbol(&mut self.return_number_same_time)? as u8,
        };
        self.last.returns = number << 4 | return_number & 15;
        Ok(())
    }

    fn read_xy(&mut self, changes: Changes, layer: &mut LayerDecoder) -> io::Result<()> {
        let single = self.single();
        let kind = usize::from(RETURN_KIND[usize::from(self.last.returns)]);
        let [step_x, step_y] = &mut self.steps[kind][usize::from(changes.gps_time())];
        let dx = self.dx.decompress(layer, step_x.get(), single)?;
        let dy = self.dy.decompress(layer, step_y.get(), single + even(self.dx.k(), 20))?;
        step_x.add(dx);
        step_y.add(dy);
        self.last.x = self.last.x.wrapping_add(dx);
        self.last.y = self.last.y.wrapping_add(dy);
        Ok(())
    }

    fn read_z(&mut self, layer: &mut LayerDecoder) -> io::Result<()> {
        // Rough where x and y are rough.
        let context = self.single() + even((self.dx.k() + self.dy.k()) / 2, 18);
        let level = self.last.number_of_returns().abs_diff(self.last.return_number()).min(7);
        let last_z = &mut self.last_z[usize::from(level)];
        *last_z = self.z.decompress(layer, *last_z, context)?;
        self.last.z = *last_z;
        Ok(())
    }

    fn read_classification(&mut self, layer: &mut LayerDecoder) -> io::Result<()> {
        let is_single = self.last.is_first() && self.last.is_last();
        let context = usize::from(self.last.classification & 31) << 1 | usize::from(is_single);
        self.last.classification = layer.decode_symbol(self.classification.of(context))? as u8;
        Ok(())
    }

    fn read_intensity(&mut self, changes: Changes, layer: &mut LayerDecoder) -> io::Result<()> {
        let kind = self.last.kind();
        let last = &mut self.last_intensity[kind << 1 | usize::from(changes.gps_time())];
        *last = self.intensity.decompress(layer, (*last).into(), kind as u32)? as u16;
        self.last.intensity = *last;
        Ok(())
    }

    /// 1 for the only return of a pulse.
    fn single(&self) -> u32 {
        u32::from(self.last.number_of_returns() == 1)
    }
}

/// The number of bits of a difference as a context: even, beside it the odd one of single returns.
fn even(bits: u32, most: u32) -> u32 {
    bits.min(most) & !1
}
