//! Chunks of LAZ: what `laz` has compressed comes back, and what it decodes, whole, in part or damaged, is decoded the same.

use super::records::{layered_decoder, sequential_decoder};
use laz::las::{Point1, Point3, Point6, Point7, Point8, Point9, Point10};
use laz::record::{
    LayeredPointRecordCompressor, LayeredPointRecordDecompressor, RecordCompressor, RecordDecompressor,
    SequentialPointRecordCompressor,
};
use laz::{DecompressionSelection, LazItem, LazItemRecordBuilder};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::io::Cursor;

/// The items of point formats 6 to 10 with three extra bytes, in versions 3 and 4.
fn formats() -> Vec<Vec<LazItem>> {
    const EXTRA: u16 = 3;
    vec![
        LazItemRecordBuilder::version_3_of::<Point6>(0),
        LazItemRecordBuilder::version_4_of::<Point6>(EXTRA),
        LazItemRecordBuilder::version_3_of::<Point7>(EXTRA),
        LazItemRecordBuilder::version_4_of::<Point7>(0),
        LazItemRecordBuilder::version_3_of::<Point8>(EXTRA),
        LazItemRecordBuilder::version_4_of::<Point8>(0),
        LazItemRecordBuilder::version_3_of::<Point9>(0),
        LazItemRecordBuilder::version_4_of::<Point9>(EXTRA),
        LazItemRecordBuilder::version_3_of::<Point10>(0),
        LazItemRecordBuilder::version_4_of::<Point10>(EXTRA),
    ]
}

fn record_len(items: &[LazItem]) -> usize {
    items.iter().map(|item| usize::from(item.size())).sum()
}

/// Records without any order: every return, every channel, coordinates and times over their whole range.
fn noise(random: &mut ChaCha8Rng, len: usize, count: usize) -> Vec<u8> {
    (0..len * count).map(|_| random.random()).collect()
}

/// Records as a scanner with four channels makes them, and what a careless writer adds. Times are at byte 20 in formats 1 to 5, at
/// byte 22 in the others.
fn pulses(random: &mut ChaCha8Rng, len: usize, count: usize, time_at: usize) -> Vec<u8> {
    let mut records = Vec::with_capacity(len * count);
    // More sequences of times than the format can follow.
    let mut times: [f64; 6] = std::array::from_fn(|k| 1e5 * (k + 1) as f64);
    let (mut channel, mut record) = (0u8, vec![0u8; len]);
    while records.len() < len * count {
        if random.random_ratio(1, 5) {
            channel = random.random_range(0..4);
        }
        let sequence = if random.random_ratio(2, 3) { usize::from(channel) } else { random.random_range(0..6) };
        // Steps, multiples of them at every limit of the format, and jumps.
        const STEPS: [f64; 16] =
            [0.0, 2.0, 8.0, 9.0, 10.0, 11.0, 499.0, 500.0, 501.0, 700.0, -1.0, -9.0, -10.0, -20.0, 0.5, 7e9];
        let steps = if random.random_ratio(2, 3) { 1.0 } else { STEPS[random.random_range(0..STEPS.len())] };
        times[sequence] += 1e-5 * steps;
        record[time_at..time_at + 8].copy_from_slice(&times[sequence].to_le_bytes());
        let returns = if random.random_ratio(1, 2) { 1 } else { random.random_range(1..=15) };
        for return_number in 1..=returns {
            for place in record[..12].chunks_exact_mut(4) {
                let last = i32::from_le_bytes([place[0], place[1], place[2], place[3]]);
                let next = match random.random_range(0..200) {
                    0 => i32::MIN,
                    1 => i32::MAX,
                    _ => last.wrapping_add(random.random_range(-900..1100)),
                };
                place.copy_from_slice(&next.to_le_bytes());
            }
            record[12] = random.random();
            record[14] = returns << 4 | return_number;
            // Direction, edge and the flags of the class change rarely.
            record[15] = channel << 4 | if random.random_ratio(1, 20) { random.random::<u8>() & 0xcf } else { 0x40 };
            for at in (16..time_at).chain(time_at + 8..len) {
                // Class, user data, angle, source, and behind the time colours and what else there is.
                if random.random_ratio(1, 8) {
                    record[at] = record[at].wrapping_add(random.random_range(0..5));
                }
            }
            records.extend_from_slice(&record);
        }
    }
    records.truncate(len * count);
    records
}

fn compress(items: &[LazItem], records: &[u8]) -> Vec<u8> {
    let mut compressor = LayeredPointRecordCompressor::new(Vec::new());
    compressor.set_fields_from(&items.to_vec()).unwrap();
    compressor.compress_many(records).unwrap();
    compressor.done().unwrap();
    compressor.into_inner()
}

type Decoder<'a> = LayeredPointRecordDecompressor<'a, Cursor<&'a [u8]>>;

fn decode(mut decoder: Decoder, selection: u32, bytes: usize) -> std::io::Result<Vec<u8>> {
    decoder.set_selection(DecompressionSelection(selection));
    let mut records = vec![0; bytes];
    decoder.decompress_many(&mut records)?;
    Ok(records)
}

fn ours<'a>(items: &[LazItem], chunk: &'a [u8]) -> Decoder<'a> {
    layered_decoder(chunk, items).unwrap()
}

fn of_laz<'a>(items: &[LazItem], chunk: &'a [u8]) -> Decoder<'a> {
    let mut decoder = LayeredPointRecordDecompressor::new(Cursor::new(chunk));
    decoder.set_fields_from(&items.to_vec()).unwrap();
    decoder
}

#[test]
fn layered_records_come_back() {
    let mut random = ChaCha8Rng::seed_from_u64(14);
    for items in formats() {
        let len = record_len(&items);
        for count in [1, 2, 700, 3000] {
            for records in [noise(&mut random, len, count), pulses(&mut random, len, count, 22), vec![7; len * count]] {
                let chunk = compress(&items, &records);
                let back = decode(ours(&items, &chunk), DecompressionSelection::ALL, records.len()).unwrap();
                assert!(back == records, "{count} records of {items:?}");
            }
        }
    }
}

#[test]
fn records_without_layers_come_back() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for items in [
        LazItemRecordBuilder::version_1_of::<Point1>(0),
        LazItemRecordBuilder::version_2_of::<Point1>(0),
        LazItemRecordBuilder::version_2_of::<Point3>(2),
    ] {
        let len = record_len(&items);
        for count in [1, 3000] {
            for records in [noise(&mut random, len, count), pulses(&mut random, len, count, 20)] {
                let mut compressor = SequentialPointRecordCompressor::new(Vec::new());
                compressor.set_fields_from(&items).unwrap();
                compressor.compress_many(&records).unwrap();
                compressor.done().unwrap();
                let chunk = compressor.into_inner();
                let mut back = vec![0; records.len()];
                sequential_decoder(&chunk, &items).unwrap().decompress_many(&mut back).unwrap();
                assert!(back == records, "{count} records of {items:?}");
            }
        }
    }
}

#[test]
fn layers_left_out_are_as_laz_leaves_them() {
    let mut random = ChaCha8Rng::seed_from_u64(41);
    for items in formats() {
        let len = record_len(&items);
        for records in [noise(&mut random, len, 300), pulses(&mut random, len, 900, 22)] {
            let chunk = compress(&items, &records);
            let single = (0..12).map(|bit| 1 << bit);
            let mixed: Vec<u32> = (0..12).map(|_| random.random_range(0..1 << 12)).collect();
            for selection in single.chain(mixed).chain([DecompressionSelection::XY_RETURNS_CHANNEL]) {
                let [a, b] = [ours(&items, &chunk), of_laz(&items, &chunk)]
                    .map(|decoder| decode(decoder, selection, records.len()).unwrap());
                assert!(a == b, "selection {selection:b} of {items:?}");
            }
        }
    }
}

#[test]
fn damaged_layers_decode_as_in_laz_or_not_at_all() {
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let items = LazItemRecordBuilder::version_3_of::<Point7>(0);
    let len = record_len(&items);
    let records = pulses(&mut random, len, 400, 22);
    let chunk = compress(&items, &records);
    // Behind the first record, the count and the sizes of ten layers.
    let layers_at = len + 4 + 10 * 4;
    let (mut same, mut refused, mut sequences) = (0, 0, 0);
    for _ in 0..400 {
        let mut chunk = chunk.clone();
        let at = random.random_range(layers_at..chunk.len());
        chunk[at] = random.random();
        match decode(ours(&items, &chunk), DecompressionSelection::ALL, records.len()) {
            // What `laz` would answer with its stack.
            Err(e) if e.to_string().contains("again and again") => sequences += 1,
            a => {
                let b = decode(of_laz(&items, &chunk), DecompressionSelection::ALL, records.len());
                assert_eq!(a.as_ref().map_err(|e| e.kind()), b.as_ref().map_err(|e| e.kind()));
                *if a.is_ok() { &mut same } else { &mut refused } += 1;
            }
        }
    }
    assert!(same > 20 && refused > 20 && sequences > 0, "{same} {refused} {sequences}");
}
