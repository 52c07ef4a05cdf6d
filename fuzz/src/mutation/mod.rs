//! Damages to sound files. Most of them know the format and keep intact what stands before the place that they aim
//! at (checksums, offsets, the table of chunks), because a reader looks at those first and goes no further when they
//! are wrong. One in six knows nothing.

pub mod bytes;
pub mod e57;
mod las;
mod random;
mod text;

pub use random::Random;

use crate::Target;

const PLY_WORDS: [&str; 30] = [
    "ply",
    "format",
    "ascii",
    "binary_little_endian",
    "binary_big_endian",
    "1.0",
    "comment",
    "obj_info",
    "element",
    "vertex",
    "face",
    "tristrips",
    "property",
    "list",
    "char",
    "uchar",
    "short",
    "ushort",
    "int",
    "uint",
    "float",
    "double",
    "int64",
    "float32",
    "x",
    "y",
    "z",
    "intensity",
    "vertex_indices",
    "end_header",
];
const PCD_WORDS: [&str; 26] = [
    "VERSION",
    "FIELDS",
    "SIZE",
    "TYPE",
    "COUNT",
    "WIDTH",
    "HEIGHT",
    "VIEWPOINT",
    "POINTS",
    "DATA",
    "ascii",
    "binary",
    "binary_compressed",
    "x",
    "y",
    "z",
    "rgb",
    "rgba",
    "_",
    "intensity",
    "F",
    "U",
    "I",
    "4",
    "8",
    "16",
];
const TEXT_WORDS: [&str; 12] = ["//X", "x", "y", "Z", "red", "g", "B", "intensity", "Scalar_Label", "\"1\"", "#", ""];
const MESH_WORDS: [&str; 14] =
    ["v", "f", "vt", "vn", "OFF", "COFF", "NOFF", "4OFF", "BINARY", "facet", "vertex", "endsolid", "1/1", "-1//-1"];
const GLTF_WORDS: [&str; 16] = [
    "nodes",
    "children",
    "mesh",
    "matrix",
    "accessors",
    "bufferView",
    "byteOffset",
    "byteStride",
    "componentType",
    "count",
    "VEC3",
    "SCALAR",
    "5123",
    "5126",
    "indices",
    "mode",
];

/// One damaged file.
pub fn mutate(target: Target, seeds: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
    let mut seed = random.pick(seeds).clone();
    if random.one_in(6) {
        bytes::damage(&mut seed, seeds, random);
        return seed;
    }
    match target {
        Target::Las | Target::Laz => las::mutate(&seed, random),
        Target::E57 => e57::mutate(&seed, random),
        Target::Ply => headed(seed, b"end_header", &PLY_WORDS, random),
        Target::Pcd => headed(seed, b"DATA", &PCD_WORDS, random),
        Target::Ptx | Target::Text => {
            let end = if random.one_in(2) { seed.len() } else { seed.len().min(200) };
            text::lines(&seed, end, &TEXT_WORDS, random)
        }
        Target::Mesh if seed.starts_with(b"glTF") => gltf(&seed, random),
        Target::Mesh if seed.contains(&0) => {
            for _ in 0..=random.below(4) {
                let end = seed.len();
                bytes::overwrite(&mut seed, 0..end, random);
            }
            seed
        }
        Target::Mesh => {
            let end = seed.len();
            text::lines(&seed, end, &MESH_WORDS, random)
        }
    }
}

/// Damages a header of lines that ends with the line that begins with `last`, or what follows it, or both.
fn headed(seed: Vec<u8>, last: &[u8], words: &[&str], random: &mut Random) -> Vec<u8> {
    let found = seed.windows(last.len()).rposition(|w| w == last).unwrap_or(0);
    let end = seed[found..].iter().position(|&b| b == b'\n').map_or(seed.len(), |p| found + p + 1);
    let what = random.below(4);
    let mut damaged = seed;
    if what == 0 || what == 3 {
        for _ in 0..=random.below(3) {
            let length = damaged.len();
            bytes::overwrite(&mut damaged, end..length, random);
        }
        if random.one_in(4) {
            let left = end + random.below(damaged.len() - end + 1);
            damaged.truncate(left);
        }
    }
    if what != 0 { text::lines(&damaged, end, words, random) } else { damaged }
}

/// Damages the JSON part of a GLB, whose lengths follow, or its binary part.
fn gltf(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let length = u32::from_le_bytes([seed[12], seed[13], seed[14], seed[15]]) as usize;
    let (json, mut rest) = (&seed[20..20 + length], seed[20 + length..].to_vec());
    let mut json = if random.one_in(5) {
        let end = rest.len();
        bytes::overwrite(&mut rest, 0..end, random);
        json.to_vec()
    } else {
        text::marked(json, b"[]{}:,\"", &GLTF_WORDS, random)
    };
    while !json.len().is_multiple_of(4) {
        json.push(b' ');
    }
    let mut file = [b"glTF\x02\0\0\0", &((20 + json.len() + rest.len()) as u32).to_le_bytes()[..]].concat();
    file.extend((json.len() as u32).to_le_bytes());
    file.extend(b"JSON");
    file.extend(json);
    file.extend(rest);
    file
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Outcome, read, seeds};

    /// The mutation is of no use if a reader never gets behind what it checks first.
    #[test]
    fn every_target_accepts_a_part_of_the_mutants() {
        for target in Target::ALL {
            let seeds = seeds::of(target);
            for (i, seed) in seeds.iter().enumerate() {
                assert_eq!(read(target, seed), Outcome::Accepted, "seed {i} of {}", target.name());
            }
            let mut random = Random::new(11);
            let outcomes: Vec<Outcome> = (0..300).map(|_| read(target, &mutate(target, &seeds, &mut random))).collect();
            let accepted = outcomes.iter().filter(|o| **o == Outcome::Accepted).count();
            assert!((15..=285).contains(&accepted), "{}: {accepted} of 300", target.name());
        }
    }

    #[test]
    fn taken_apart_and_joined_again_a_file_is_the_same() {
        for seed in seeds::of(Target::E57) {
            assert_eq!(e57::mended(&seed), seed);
        }
    }
}
