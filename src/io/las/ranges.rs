//! Lowest and highest value of every attribute of LAS records, for `adit info`.

use super::super::file_scan::AttributeInfo;
use super::extra_bytes::ExtraField;
use super::header::Container;

/// Where an attribute lies in a record.
#[derive(Clone, Debug)]
enum Place {
    /// Some bits of a byte.
    Bits {
        at: usize,
        shift: u8,
        mask: u8,
    },
    I8(usize),
    U16(usize),
    I16(usize),
    F64(usize),
    /// A scalar column of extra bytes, which begin at this byte.
    Extra {
        at: usize,
        field: Box<ExtraField>,
    },
    /// Extra bytes whose values are not interpreted.
    Opaque,
}

/// The attributes of a file.
#[derive(Clone, Debug)]
pub(super) struct Attributes {
    fields: Vec<(String, Place)>,
}

/// Range of each attribute, empty ones from +inf to -inf.
pub(super) type Ranges = Vec<[f64; 2]>;

impl Attributes {
    pub(super) fn of(container: &Container, extra: &[ExtraField]) -> Self {
        let bits = |at, shift, mask| Place::Bits { at, shift, mask };
        let format = container.format;
        let mut fields: Vec<(&str, Place)> = vec![("intensity", Place::U16(12))];
        if format < 6 {
            fields.extend([
                ("return_number", bits(14, 0, 0x07)),
                ("number_of_returns", bits(14, 3, 0x07)),
                ("classification", bits(15, 0, 0x1f)),
                ("scan_angle_rank", Place::I8(16)),
                ("user_data", bits(17, 0, 0xff)),
                ("point_source_id", Place::U16(18)),
            ]);
        } else {
            fields.extend([
                ("return_number", bits(14, 0, 0x0f)),
                ("number_of_returns", bits(14, 4, 0x0f)),
                ("scanner_channel", bits(15, 4, 0x03)),
                ("classification", bits(16, 0, 0xff)),
                ("user_data", bits(17, 0, 0xff)),
                // In steps of 0.006 degrees.
                ("scan_angle", Place::I16(18)),
                ("point_source_id", Place::U16(20)),
            ]);
        }
        match format {
            0 | 2 => {}
            1 | 3..=5 => fields.push(("gps_time", Place::F64(20))),
            _ => fields.push(("gps_time", Place::F64(22))),
        }
        if let Some(rgb) = super::records::Layout::of(format).rgb {
            fields.extend(
                ["red", "green", "blue"].iter().zip([rgb, rgb + 2, rgb + 4]).map(|(n, at)| (*n, Place::U16(at))),
            );
            if format == 8 || format == 10 {
                fields.push(("near_infrared", Place::U16(36)));
            }
        }
        let mut fields: Vec<(String, Place)> =
            fields.into_iter().map(|(name, place)| (name.to_owned(), place)).collect();
        let at = super::header::STANDARD_LENGTHS[format as usize];
        fields.extend(extra.iter().map(|field| {
            let scalar = (1..=10).contains(&field.data_type());
            (field.name(), if scalar { Place::Extra { at, field: Box::new(field.clone()) } } else { Place::Opaque })
        }));
        Self { fields }
    }

    pub(super) fn no_ranges(&self) -> Ranges {
        vec![[f64::INFINITY, f64::NEG_INFINITY]; self.fields.len()]
    }

    /// Widens the ranges by whole records.
    pub(super) fn widen(&self, records: &[u8], record_len: usize, ranges: &mut Ranges) {
        let all = || records.chunks_exact(record_len);
        for ((_, place), range) in self.fields.iter().zip(ranges) {
            match place {
                Place::Bits { at, shift, mask } => integers(all().map(|r| i32::from((r[*at] >> shift) & mask)), range),
                Place::I8(at) => integers(all().map(|r| i32::from(r[*at] as i8)), range),
                Place::U16(at) => integers(all().map(|r| i32::from(u16::from_le_bytes([r[*at], r[at + 1]]))), range),
                Place::I16(at) => integers(all().map(|r| i32::from(i16::from_le_bytes([r[*at], r[at + 1]]))), range),
                Place::F64(at) => numbers(all().map(|r| super::header::f64_at(r, *at)), range),
                Place::Extra { at, field } => numbers(all().filter_map(|r| field.value(&r[*at..])), range),
                Place::Opaque => {}
            }
        }
    }

    /// Largest value of a colour channel so far.
    pub(super) fn largest_color(&self, ranges: &Ranges) -> u16 {
        let channels =
            self.fields.iter().zip(ranges).filter(|((name, _), _)| ["red", "green", "blue"].contains(&&name[..]));
        channels.map(|(_, range)| range[1].clamp(0.0, 65_535.0) as u16).max().unwrap_or(0)
    }

    /// The attributes with their ranges.
    pub(super) fn described(&self, ranges: &Ranges) -> Vec<AttributeInfo> {
        let describe = |((name, _), range): (&(String, Place), &[f64; 2])| match range {
            [low, high] if low <= high => AttributeInfo::range(name, *low, *high),
            _ => AttributeInfo::present(name),
        };
        self.fields.iter().zip(ranges).map(describe).collect()
    }
}

pub(super) fn merge(mut mine: Ranges, theirs: &Ranges) -> Ranges {
    for (a, b) in mine.iter_mut().zip(theirs) {
        *a = [a[0].min(b[0]), a[1].max(b[1])];
    }
    mine
}

fn integers(values: impl Iterator<Item = i32>, range: &mut [f64; 2]) {
    let (mut low, mut high) = (i32::MAX, i32::MIN);
    for v in values {
        low = low.min(v);
        high = high.max(v);
    }
    if low <= high {
        *range = [range[0].min(low.into()), range[1].max(high.into())];
    }
}

/// NaN is no value.
fn numbers(values: impl Iterator<Item = f64>, range: &mut [f64; 2]) {
    let [mut low, mut high] = *range;
    for v in values {
        low = low.min(v);
        high = high.max(v);
    }
    *range = [low, high];
}
