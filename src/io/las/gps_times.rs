//! GPS times of LAZ: four sequences, each of which goes on in steps.
//!
//! When to use: [`GpsTimes`] for each scanner channel of [`super::point14`]; [`GpsTimeField`] for version 2 of the item `GpsTime`
//! of point formats 1 and 3 to 5. The decoders of the crate `laz` call themselves for each change of the sequence, without a limit
//! where the bytes are damaged (`docs/decisions/0010-own-decoder-of-layered-points.md`).
//! Reference: rapidlasso, *LAZ Specification 1.4 - R1* (2022). Times are taken as whole numbers, by their bits, so that equal
//! steps of time are nearly equal differences. Lasers whose pulses are mixed give several sequences; a time says which
//! sequence it goes on, and how many steps further it lies.
//! Guarantees: a time takes a bounded amount of work, whatever the bytes are.

use laz::decoders::ArithmeticDecoder;
use laz::decompressors::{IntegerDecompressor, IntegerDecompressorBuilder};
use laz::models::{ArithmeticModel, ArithmeticModelBuilder};
use laz::record::FieldDecompressor;
use std::io::{self, Read};

/// Changes of sequence before one time. Any of the four is reached by one change, so a writer needs one at most; a writer that goes
/// from one to the next needs three. More than twice as many are damage, and there damage may ask for millions.
const MOST_CHANGES: usize = 8;

/// Symbols of a sequence that has a step yet are its multiples, from 0 to the largest, then from -1 to the smallest; ...
const LARGEST_MULTIPLE: i32 = 500;
const SMALLEST_MULTIPLE: i32 = -10;
/// ... behind them come a new sequence and the changes to the next one, two and three further.
const MULTIPLES: i32 = LARGEST_MULTIPLE - SMALLEST_MULTIPLE + 1;

/// Where the next time is.
enum Next {
    /// In the current sequence.
    Read,
    /// So many sequences further.
    Further(usize),
}

#[derive(Clone, Copy, Default)]
struct Sequence {
    /// The last time, by its bits.
    time: i64,
    /// The usual difference between two times; 0 when it is not known yet.
    step: i32,
    /// Differences far from the step since the last one close to it. More than three replace the step.
    far: u32,
}

impl Sequence {
    fn advance(&mut self, difference: i32) {
        // Damaged differences may lead anywhere.
        self.time = self.time.wrapping_add(difference.into());
    }

    fn count_far(&mut self, difference: i32) {
        self.far += 1;
        if self.far > 3 {
            *self = Self { step: difference, far: 0, ..*self };
        }
    }
}

/// The times of one channel.
pub(super) struct GpsTimes {
    /// 1 where a symbol of its own says that a time is that before; in layers it is among the changes of the point.
    unchanged: i32,
    sequences: [Sequence; 4],
    current: usize,
    newest: usize,
    without_step: ArithmeticModel,
    with_step: ArithmeticModel,
    differences: IntegerDecompressor,
}

impl GpsTimes {
    /// Those of a layer, beginning at a time, given by its bits.
    pub(super) fn new(time: u64) -> Self {
        Self::with_symbols(time, 0)
    }

    fn with_symbols(time: u64, unchanged: i32) -> Self {
        let mut sequences = [Sequence::default(); 4];
        sequences[0].time = time as i64;
        Self {
            unchanged,
            sequences,
            current: 0,
            newest: 0,
            without_step: ArithmeticModelBuilder::new(5 + unchanged as u32).build(),
            with_step: ArithmeticModelBuilder::new((MULTIPLES + 4 + unchanged) as u32).build(),
            differences: IntegerDecompressorBuilder::new().bits(32).contexts(9).build_initialized(),
        }
    }

    /// Bits of the next time.
    pub(super) fn read<R: Read>(&mut self, layer: &mut ArithmeticDecoder<R>) -> io::Result<u64> {
        for _ in 0..=MOST_CHANGES {
            let next = if self.sequence().step == 0 { self.read_step(layer)? } else { self.read_multiple(layer)? };
            match next {
                Next::Read => return Ok(self.sequence().time as u64),
                Next::Further(by) => self.current = (self.current + by) % 4,
            }
        }
        Err(io::Error::new(io::ErrorKind::InvalidData, "GPS times change between sequences again and again"))
    }

    fn sequence(&mut self) -> &mut Sequence {
        &mut self.sequences[self.current % 4]
    }

    /// The first difference of a sequence, which becomes its step.
    fn read_step<R: Read>(&mut self, layer: &mut ArithmeticDecoder<R>) -> io::Result<Next> {
        match layer.decode_symbol(&mut self.without_step)? as i32 - self.unchanged {
            -1 => Ok(Next::Read),
            0 => {
                let step = self.differences.decompress(layer, 0, 0)?;
                let sequence = self.sequence();
                sequence.step = step;
                sequence.advance(step);
                Ok(Next::Read)
            }
            1 => self.begin_sequence(layer),
            symbol => Ok(Next::Further(symbol as usize - 1)),
        }
    }

    /// A difference that is told as a multiple of the step.
    fn read_multiple<R: Read>(&mut self, layer: &mut ArithmeticDecoder<R>) -> io::Result<Next> {
        let symbol = layer.decode_symbol(&mut self.with_step)? as i32;
        if symbol >= MULTIPLES {
            return match symbol - MULTIPLES - self.unchanged {
                -1 => Ok(Next::Read),
                0 => self.begin_sequence(layer),
                by => Ok(Next::Further(by as usize)),
            };
        }
        let multiple = if symbol > LARGEST_MULTIPLE { LARGEST_MULTIPLE - symbol } else { symbol };
        let context = match multiple {
            0 => 7,
            1 => 1,
            2..=9 => 2,
            LARGEST_MULTIPLE => 4,
            10.. => 3,
            SMALLEST_MULTIPLE => 6,
            _ => 5,
        };
        let expected = self.sequence().step.wrapping_mul(multiple);
        let difference = self.differences.decompress(layer, expected, context)?;
        let sequence = self.sequence();
        match multiple {
            1 => sequence.far = 0,
            0 | LARGEST_MULTIPLE | SMALLEST_MULTIPLE => sequence.count_far(difference),
            _ => {}
        }
        sequence.advance(difference);
        Ok(Next::Read)
    }

    /// A time far from all sequences replaces the oldest: its upper half is told beside that of the last time, the lower as it is.
    fn begin_sequence<R: Read>(&mut self, layer: &mut ArithmeticDecoder<R>) -> io::Result<Next> {
        let expected = (self.sequence().time >> 32) as i32;
        let upper = self.differences.decompress(layer, expected, 8)?;
        let time = i64::from(upper) << 32 | i64::from(layer.read_int()?);
        self.newest = (self.newest + 1) % 4;
        self.current = self.newest;
        *self.sequence() = Sequence { time, ..Sequence::default() };
        Ok(Next::Read)
    }
}

/// The field `GpsTime` in version 2.
pub(super) struct GpsTimeField(GpsTimes);

impl Default for GpsTimeField {
    fn default() -> Self {
        Self(GpsTimes::with_symbols(0, 1))
    }
}

impl<R: Read> FieldDecompressor<R> for GpsTimeField {
    fn size_of_field(&self) -> usize {
        size_of::<u64>()
    }

    fn decompress_first(&mut self, src: &mut R, first_point: &mut [u8]) -> io::Result<()> {
        let mut time = [0; 8];
        src.read_exact(&mut time)?;
        first_point.copy_from_slice(&time);
        self.0 = GpsTimes::with_symbols(u64::from_le_bytes(time), 1);
        Ok(())
    }

    fn decompress_with(&mut self, decoder: &mut ArithmeticDecoder<R>, buf: &mut [u8]) -> io::Result<()> {
        buf.copy_from_slice(&self.0.read(decoder)?.to_le_bytes());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use laz::compressors::IntegerCompressorBuilder;
    use laz::encoders::ArithmeticEncoder;
    use std::io::Cursor;

    /// A layer that changes the sequence so many times before its only time.
    fn layer(changes: usize) -> ArithmeticDecoder<Cursor<Vec<u8>>> {
        let mut encoder = ArithmeticEncoder::new(Cursor::new(Vec::new()));
        let mut symbols = ArithmeticModelBuilder::new(5).build();
        for _ in 0..changes {
            encoder.encode_symbol(&mut symbols, 2).unwrap();
        }
        encoder.encode_symbol(&mut symbols, 0).unwrap();
        let mut differences = IntegerCompressorBuilder::new().bits(32).contexts(9).build_initialized();
        differences.compress(&mut encoder, 0, 77, 0).unwrap();
        encoder.done().unwrap();
        let mut decoder = ArithmeticDecoder::new(Cursor::new(encoder.into_inner().into_inner()));
        decoder.read_init_bytes().unwrap();
        decoder
    }

    #[test]
    fn a_few_changes_of_sequence_are_followed_and_millions_are_not() {
        for changes in [0, 1, 4, MOST_CHANGES] {
            // Only the first sequence begins at the time given.
            let begin = if changes % 4 == 0 { 5 } else { 0 };
            assert_eq!(GpsTimes::new(5).read(&mut layer(changes)).unwrap(), begin + 77, "{changes}");
        }
        for changes in [MOST_CHANGES + 1, 1_000_000] {
            let error = GpsTimes::new(5).read(&mut layer(changes)).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidData);
            assert!(error.to_string().contains("again and again"), "{error}");
        }
    }

    #[test]
    fn damaged_steps_go_round_instead_of_over() {
        let mut times = GpsTimes::new(i64::MAX as u64);
        assert_eq!(times.read(&mut layer(0)).unwrap(), (i64::MIN + 76) as u64);
        assert_eq!(times.sequences[0].step, 77);
    }
}
