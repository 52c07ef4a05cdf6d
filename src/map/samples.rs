//! Samples of a layer: columns of numbers of one of a few types.

/// Type of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleType {
    /// Unsigned 8 bit.
    U8,
    /// Unsigned 16 bit.
    U16,
    /// Unsigned 32 bit.
    U32,
    /// 32-bit float.
    F32,
    /// 64-bit float.
    F64,
}

impl SampleType {
    /// Bytes of a sample.
    pub fn bytes(self) -> usize {
        match self {
            SampleType::U8 => 1,
            SampleType::U16 => 2,
            SampleType::U32 | SampleType::F32 => 4,
            SampleType::F64 => 8,
        }
    }
}

/// Samples of a piece of a layer, row by row, bands of a pixel together.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// Unsigned 8 bit.
    U8(Vec<u8>),
    /// Unsigned 16 bit.
    U16(Vec<u16>),
    /// Unsigned 32 bit.
    U32(Vec<u32>),
    /// 32-bit float.
    F32(Vec<f32>),
    /// 64-bit float.
    F64(Vec<f64>),
}

/// A number of one of the types of [`Samples`].
pub trait Sample: Copy {
    /// As a float; exact for all of them.
    fn number(self) -> f64;

    /// The nearest sample.
    fn nearest(number: f64) -> Self;
}

macro_rules! whole_samples {
    ($($type:ty),*) => {$(
        impl Sample for $type {
            fn number(self) -> f64 {
                f64::from(self)
            }

            fn nearest(number: f64) -> Self {
                (number + 0.5) as $type
            }
        }
    )*};
}

whole_samples!(u8, u16, u32);

impl Sample for f32 {
    fn number(self) -> f64 {
        f64::from(self)
    }

    fn nearest(number: f64) -> Self {
        number as f32
    }
}

impl Sample for f64 {
    fn number(self) -> f64 {
        self
    }

    fn nearest(number: f64) -> Self {
        number
    }
}

/// A rectangle of pixels in a picture that is so many pixels wide.
#[derive(Clone, Copy, Debug)]
pub struct Block {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns of the whole picture.
    pub picture_width: usize,
}

impl Samples {
    /// So many samples with the same value.
    pub fn filled(sample: SampleType, value: f64, len: usize) -> Self {
        match sample {
            SampleType::U8 => Samples::U8(vec![u8::nearest(value); len]),
            SampleType::U16 => Samples::U16(vec![u16::nearest(value); len]),
            SampleType::U32 => Samples::U32(vec![u32::nearest(value); len]),
            SampleType::F32 => Samples::F32(vec![f32::nearest(value); len]),
            SampleType::F64 => Samples::F64(vec![value; len]),
        }
    }

    /// Sample `i` as a number.
    pub fn get(&self, i: usize) -> f64 {
        match self {
            Samples::U8(v) => v[i].number(),
            Samples::U16(v) => v[i].number(),
            Samples::U32(v) => v[i].number(),
            Samples::F32(v) => v[i].number(),
            Samples::F64(v) => v[i],
        }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        match self {
            Samples::U8(v) => v.len(),
            Samples::U16(v) => v.len(),
            Samples::U32(v) => v.len(),
            Samples::F32(v) => v.len(),
            Samples::F64(v) => v.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Copies `width` x `height` pixels of `bands` samples from another column of the same type; columns of different
    /// types are left as they are.
    pub fn copy_block(&mut self, to: Block, source: &Samples, from: Block, [width, height]: [usize; 2], bands: usize) {
        fn copy<T: Copy>(target: &mut [T], to: Block, source: &[T], from: Block, size: [usize; 2], bands: usize) {
            let length = size[0] * bands;
            for y in 0..size[1] {
                let start = |block: Block| ((block.y + y) * block.picture_width + block.x) * bands;
                target[start(to)..][..length].copy_from_slice(&source[start(from)..][..length]);
            }
        }
        let size = [width, height];
        match (self, source) {
            (Samples::U8(t), Samples::U8(s)) => copy(t, to, s, from, size, bands),
            (Samples::U16(t), Samples::U16(s)) => copy(t, to, s, from, size, bands),
            (Samples::U32(t), Samples::U32(s)) => copy(t, to, s, from, size, bands),
            (Samples::F32(t), Samples::F32(s)) => copy(t, to, s, from, size, bands),
            (Samples::F64(t), Samples::F64(s)) => copy(t, to, s, from, size, bands),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_goes_to_its_place() {
        let source = Samples::U16((0..24).collect());
        let mut target = Samples::filled(SampleType::U16, 99.0, 4 * 3 * 2);
        // Two bands: the source is 6 x 2 pixels, the target 4 x 3.
        let (to, from) = (Block { x: 1, y: 1, picture_width: 4 }, Block { x: 3, y: 0, picture_width: 6 });
        target.copy_block(to, &source, from, [2, 2], 2);
        let Samples::U16(values) = &target else { panic!("{target:?}") };
        assert_eq!(values[8..16], [99, 99, 6, 7, 8, 9, 99, 99]);
        assert_eq!(values[16..], [99, 99, 18, 19, 20, 21, 99, 99]);
        assert!(values[..8].iter().all(|&x| x == 99));
    }

    #[test]
    fn whole_samples_are_rounded() {
        assert_eq!((u8::nearest(2.5), u8::nearest(300.0), u16::nearest(1.49)), (3, 255, 1));
        assert!(Samples::filled(SampleType::F32, f64::NAN, 1).get(0).is_nan());
    }
}
