//! GPS times of layered LAZ: four sequences, each of which goes on in steps.
//!
//! When to use: below [`super::point14`], one for each scanner channel.
//! Reference: rapidlasso, *LAZ Specification 1.4 - R1* (2022). Times are taken as whole numbers, by their bits, so that
//! equal steps of time are nearly equal differences. Lasers whose pulses are mixed give several sequences; a time says which
//! sequence it goes on, and how many steps further it lies.
//! Guarantees: a time takes a bounded amount of work, whatever the bytes are.

use laz::decoders::ArithmeticDecoder;
use laz::decompressors::{IntegerDecompressor, IntegerDecompressorBuilder};
use laz::models::{ArithmeticModel, ArithmeticModelBuilder};
use std::io::{self, Read};

/// Changes of sequence before one time. Any of the four is reached by one change, so a writer needs one at most; a writer that goes
/// from one to the next needs three. More than twice as many are damage, and there damage may ask for millions.
const MOST_CHANGES: usize = 8;

/// Symbols of a sequence that has a step yet: the largest multiple of it, ...
const LARGEST_MULTIPLE: i32 = 500;
/// ... the smallest, ...
const SMALLEST_MULTIPLE: i32 = -10;
/// ... a new sequence; behind it come the changes to another one, by 1 to 3.
const NEW_SEQUENCE: i32 = LARGEST_MULTIPLE - SMALLEST_MULTIPLE + 1;

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
    /// Differences far from the step since the last one that was close. Many of them replace the step.
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
    sequences: [Sequence; 4],
    current: usize,
    newest: usize,
    without_step: ArithmeticModel,
    with_step: ArithmeticModel,
    differences: IntegerDecompressor,
}

impl GpsTimes {
    /// Beginning at a time, given by its bits.
    pub(super) fn new(time: u64) -> Self {
        let mut sequences = [Sequence::default(); 4];
        sequences[0].time = time as i64;
        Self {
            sequences,
            current: 0,
            newest: 0,
            without_step: ArithmeticModelBuilder::new(5).build(),
            with_step: ArithmeticModelBuilder::new(NEW_SEQUENCE as u32 + 4).build(),
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
        match layer.decode_symbol(&mut self.without_step)? {
            0 => {
                let step = self.differences.decompress(layer, 0, 0)?;
                let sequence = self.sequence();
                *sequence = Sequence { step, far: 0, ..*sequence };
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
        if symbol == NEW_SEQUENCE {
            return self.begin_sequence(layer);
        }
        if symbol > NEW_SEQUENCE {
            return Ok(Next::Further((symbol - NEW_SEQUENCE) as usize));
        }
        // Negative multiples come behind the positive ones.
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
