//! OBJ, OFF, STL and GLB meshes.

use super::error::{COPY_AGAIN, Error};
use super::mesh_scan::MeshBuilder;
use super::source_bytes::SourceBytes;
use super::text::Text;
use crate::numeric::{Vec2, Vec3};
use crate::warning::Warning;
use std::borrow::Cow;
use std::collections::HashMap;

fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split_whitespace()
}

fn number(word: Option<&str>) -> Option<f64> {
    word?.parse().ok()
}

fn at_line(source: &SourceBytes, line: usize, text: &str, cause: &str) -> Error {
    let text: String = text.trim().chars().take(40).collect();
    Error::bad(source.path(), format!("line {}: '{text}' {cause}", line + 1), COPY_AGAIN)
}

/// Wavefront OBJ: `v`, `vt`, `f` (polygons, negative indices); everything else does not matter here.
pub(super) fn obj(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    let text = Text::of(source)?;
    let bytes = text.source().up_to(text.start, usize::MAX)?;
    let text = String::from_utf8_lossy(&bytes);
    let mut builder = MeshBuilder::new("OBJ");
    let mut uvs: Vec<Vec2> = Vec::new();
    // The texture coordinate of each vertex, while all its corners agree.
    let mut uv_of: Vec<Option<usize>> = Vec::new();
    let mut seams = false;
    let mut corners: Vec<f64> = Vec::new();
    let mut other: u64 = 0;
    for (number_of, line) in whole_lines(&text) {
        let line = &*line;
        let mut parts = words(line);
        let bad = |cause: &str| at_line(source, number_of, line, cause);
        match parts.next() {
            Some("v") => {
                let v = [number(parts.next()), number(parts.next()), number(parts.next())];
                let [Some(x), Some(y), Some(z)] = v else { return Err(bad("has not three numbers")) };
                builder.vertices.push(Vec3::new(x, y, z));
                uv_of.push(None);
            }
            Some("vt") => {
                let (Some(u), v) = (number(parts.next()), number(parts.next()).unwrap_or(0.0)) else {
                    return Err(bad("has no number"));
                };
                uvs.push(Vec2::new(u, v));
            }
            Some("f") => {
                corners.clear();
                for corner in parts {
                    let mut indices = corner.split('/');
                    let vertex = index(indices.next(), builder.vertices.len())
                        .ok_or_else(|| bad("names a vertex that was not given before"))?;
                    if let Some(uv) = indices.next().filter(|t| !t.is_empty()) {
                        let uv = index(Some(uv), uvs.len()).ok_or_else(|| bad("names a missing texture coordinate"))?;
                        seams |= uv_of[vertex].is_some_and(|known| known != uv);
                        uv_of[vertex] = Some(uv);
                    }
                    corners.push(vertex as f64);
                }
                builder.polygon(&corners, None).map_err(|e| bad(&e))?;
            }
            Some("o" | "g" | "s" | "vn" | "usemtl" | "mtllib" | "l" | "p") | None => {}
            Some(comment) if comment.starts_with('#') => {}
            Some(_) => other += 1,
        }
    }
    if builder.vertices.is_empty() {
        return Err(Error::bad(source.path(), "it has no vertices", COPY_AGAIN));
    }
    if other > 0 {
        builder.warnings.push(Warning::new("obj-lines", format!("{other} lines are of an unknown kind and ignored")));
    }
    if !uvs.is_empty() && !seams && uv_of.iter().all(Option::is_some) {
        builder.uv = uv_of.into_iter().flatten().map(|i| uvs[i]).collect();
    }
    Ok(builder)
}

/// Lines with their numbers; those that end with a backslash go on in the next one.
fn whole_lines(text: &str) -> impl Iterator<Item = (usize, Cow<'_, str>)> {
    let mut lines = text.lines().enumerate();
    std::iter::from_fn(move || {
        let (number, first) = lines.next()?;
        let mut line = Cow::Borrowed(first);
        while let Some(begun) = line.trim_end().strip_suffix('\\') {
            let next = lines.next().map_or("", |(_, l)| l);
            line = Cow::Owned(format!("{begun} {next}"));
        }
        Some((number, line))
    })
}

/// A one-based or, from the end, negative OBJ index.
fn index(word: Option<&str>, count: usize) -> Option<usize> {
    let index: i64 = word?.parse().ok()?;
    let index = if index < 0 { index + count as i64 } else { index - 1 };
    usize::try_from(index).ok().filter(|&i| i < count)
}

/// Object File Format with its prefixes (`COFF`, `NOFF`, ...) and comments.
pub(super) fn off(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    let bytes = source.up_to(0, usize::MAX)?;
    if let Some((prefix, data)) = binary_off_head(&bytes) {
        return binary_off(source, prefix, data);
    }
    let text = String::from_utf8_lossy(&bytes);
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(n, l)| (n, l.split('#').next().unwrap_or("").trim()))
        .filter(|(_, l)| !l.is_empty());
    let ended = || Error::bad(source.path(), "it ends too early", COPY_AGAIN);
    let (mut line, mut head) = lines.next().ok_or_else(ended)?;
    let prefix_end = head.find(|c: char| !c.is_ascii_alphabetic() && c != '4').unwrap_or(head.len());
    let prefix = &head[..prefix_end];
    // The keyword may be missing: then the counts come first.
    let counts_first = words(head).count() >= 2 && words(head).all(|w| w.parse::<u64>().is_ok());
    if !counts_first && (!prefix.ends_with("OFF") || prefix.contains('4')) {
        return Err(at_line(source, line, head, "is no OFF header"));
    }
    if !counts_first {
        head = head[prefix_end..].trim();
    }
    if head.is_empty() {
        (line, head) = lines.next().ok_or_else(ended)?;
    }
    let counts: Vec<u64> = words(head).filter_map(|w| w.parse().ok()).collect();
    let [vertices, faces, ..] = counts[..] else { return Err(at_line(source, line, head, "should be the counts")) };
    if vertices.saturating_add(faces).saturating_mul(4) > source.len() + 4 {
        let cause = format!("{vertices} vertices and {faces} faces do not fit into {} bytes", source.len());
        return Err(Error::bad(source.path(), cause, COPY_AGAIN));
    }
    let mut builder = MeshBuilder::new("OFF");
    for _ in 0..vertices {
        let (n, text) = lines.next().ok_or_else(ended)?;
        let mut parts = words(text);
        let v = [number(parts.next()), number(parts.next()), number(parts.next())];
        let [Some(x), Some(y), Some(z)] = v else { return Err(at_line(source, n, text, "has not three numbers")) };
        builder.vertices.push(Vec3::new(x, y, z));
    }
    let mut corners = Vec::new();
    for _ in 0..faces {
        let (n, text) = lines.next().ok_or_else(ended)?;
        let mut parts = words(text);
        let count = number(parts.next()).filter(|c| (0.0..1e6).contains(c));
        let count = count.ok_or_else(|| at_line(source, n, text, "has no number of corners"))? as usize;
        corners.clear();
        corners.extend(parts.take(count).map_while(|w| w.parse::<f64>().ok()));
        if corners.len() < count {
            return Err(at_line(source, n, text, "has fewer corners than it says"));
        }
        builder.polygon(&corners, None).map_err(|e| at_line(source, n, text, &e))?;
    }
    Ok(builder)
}

/// Prefix of the keyword and what follows the first line, if that says `OFF BINARY`.
fn binary_off_head(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let end = bytes.iter().take(100).position(|&b| b == b'\n')?;
    let mut head = words(std::str::from_utf8(&bytes[..end]).ok()?);
    let prefix = head.next()?.strip_suffix("OFF")?;
    (head.next() == Some("BINARY")).then_some((prefix, &bytes[end + 1..]))
}

/// OFF whose numbers are big-endian, 32 bits each: counts, vertices with what the prefix adds to them, and for each face its
/// corners and the channels of its colour (Geomview manual, "Object File Format").
fn binary_off(source: &SourceBytes, prefix: &str, data: &[u8]) -> Result<MeshBuilder, Error> {
    let extra = match prefix {
        "" => 0,
        "ST" => 2,
        "N" => 3,
        "C" => 4,
        "STN" => 5,
        "STC" => 6,
        "CN" => 7,
        "STCN" => 9,
        _ => {
            return Err(Error::unsupported(source.path(), format!("binary {prefix}OFF"), "save it as PLY"));
        }
    };
    let mut numbers = data.as_chunks::<4>().0.iter().copied();
    let ended = || Error::bad(source.path(), "it ends too early", COPY_AGAIN);
    let mut take = || numbers.next().ok_or_else(ended);
    let [vertices, faces, _edges] = [take()?, take()?, take()?].map(u32::from_be_bytes);
    let mut builder = MeshBuilder::new("OFF");
    builder.single_precision = true;
    for _ in 0..vertices {
        let [x, y, z] = [take()?, take()?, take()?].map(|b| f64::from(f32::from_be_bytes(b)));
        builder.vertices.push(Vec3::new(x, y, z));
        for _ in 0..extra {
            take()?;
        }
    }
    let mut corners = Vec::new();
    for face in 0..faces {
        corners.clear();
        for _ in 0..u32::from_be_bytes(take()?) {
            corners.push(f64::from(u32::from_be_bytes(take()?)));
        }
        for _ in 0..u32::from_be_bytes(take()?) {
            take()?;
        }
        builder
            .polygon(&corners, None)
            .map_err(|cause| Error::bad(source.path(), format!("face {face} {cause}"), COPY_AGAIN))?;
    }
    let rest = 4 * numbers.len() + data.len() % 4;
    if rest > 0 {
        let text = format!("{rest} bytes after its {faces} faces are not read");
        builder.warnings.push(Warning::new("trailing-bytes", text));
    }
    Ok(builder)
}

/// STL, text and binary; corners at the same position become one vertex.
pub(super) fn stl(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    let bytes = source.up_to(0, usize::MAX)?;
    let mut builder = MeshBuilder::new("STL");
    let mut known: HashMap<[u64; 3], u32> = HashMap::new();
    let mut corners = 0;
    let mut vertex = |builder: &mut MeshBuilder, p: [f64; 3]| {
        corners += 1;
        // Adding zero joins the two zeros.
        *known.entry(p.map(|c| (c + 0.0).to_bits())).or_insert_with(|| {
            builder.vertices.push(Vec3::from(p));
            builder.vertices.len() as u32 - 1
        })
    };
    let count = bytes.get(80..84).map(|b| u32::from_le_bytes(b.try_into().expect("four bytes")) as usize);
    let needed = count.map(|c| 84 + 50 * c as u128);
    let is_text = bytes.trim_ascii_start().get(..5).is_some_and(|w| w.eq_ignore_ascii_case(b"solid"));
    // Binary files may begin with "solid" too: then only a size that fits to the byte tells them from text.
    let binary =
        count.filter(|_| needed.is_some_and(|n| bytes.len() as u128 == n || (!is_text && bytes.len() as u128 > n)));
    if let Some(count) = binary {
        if needed.is_some_and(|n| bytes.len() as u128 > n) {
            let rest = bytes.len() - 84 - 50 * count;
            builder
                .warnings
                .push(Warning::new("trailing-bytes", format!("{rest} bytes after its {count} facets are not read")));
        }
        builder.single_precision = true;
        for facet in bytes[84..].chunks_exact(50).take(count) {
            let corner = |k: usize| {
                [0, 4, 8].map(|b| {
                    let at = 12 + 12 * k + b;
                    f64::from(f32::from_le_bytes(facet[at..at + 4].try_into().expect("four bytes")))
                })
            };
            let triangle = [0, 1, 2].map(|k| vertex(&mut builder, corner(k)));
            builder.triangle(triangle, None);
        }
    } else if is_text {
        let text = String::from_utf8_lossy(&bytes);
        let mut triangle = Vec::new();
        for (n, line) in text.lines().enumerate() {
            let mut parts = words(line);
            match parts.next().map(str::to_ascii_lowercase).as_deref() {
                Some("vertex") => {
                    let v = [number(parts.next()), number(parts.next()), number(parts.next())];
                    let [Some(x), Some(y), Some(z)] = v else {
                        return Err(at_line(source, n, line, "has not three numbers"));
                    };
                    triangle.push(vertex(&mut builder, [x, y, z]));
                }
                Some("endloop") => {
                    let [a, b, c] = triangle[..] else {
                        return Err(at_line(source, n, line, "closes a facet that is no triangle"));
                    };
                    builder.triangle([a, b, c], None);
                    triangle.clear();
                }
                _ => {}
            }
        }
    } else {
        let cause = format!(
            "its {} bytes are neither text nor the {} that its {} facets take",
            bytes.len(),
            count.map_or(0, |c| 84 + 50 * c),
            count.unwrap_or(0)
        );
        return Err(Error::bad(source.path(), cause, COPY_AGAIN));
    }
    builder.merged_vertices = corners - builder.vertices.len();
    Ok(builder)
}

/// Binary glTF 2.0: triangles of all nodes of the default scene, in scene coordinates.
///
/// glTF has y up; Adit has z up, so (x, y, z) becomes (x, -z, y), and that is said.
pub(super) fn glb(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    let bytes = source.up_to(0, usize::MAX)?;
    let bad = |cause: &str| Error::bad(source.path(), cause, COPY_AGAIN);
    let u32_at =
        |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes(b.try_into().expect("four bytes")) as usize);
    let json_len = u32_at(12).ok_or_else(|| bad("it is cut off"))?;
    let json = bytes.get(20..20usize.saturating_add(json_len)).ok_or_else(|| bad("its JSON chunk is cut off"))?;
    let json: serde_json::Value =
        serde_json::from_slice(json).map_err(|e| bad(&format!("its JSON chunk is invalid: {e}")))?;
    let bin_at = 20 + json_len;
    let bin_len = u32_at(bin_at).unwrap_or(0);
    let bin = bytes.get(bin_at + 8..(bin_at + 8).saturating_add(bin_len)).ok_or_else(|| bad("its data is cut off"))?;
    let mut glb = Glb { json: &json, bin, builder: MeshBuilder::new("GLB"), visited: 0 };
    glb.builder.single_precision = true;
    let scene = json["scene"].as_u64().unwrap_or(0) as usize;
    let roots: Vec<usize> = match json["scenes"][scene]["nodes"].as_array() {
        Some(nodes) => nodes.iter().filter_map(|n| Some(n.as_u64()? as usize)).collect(),
        None => (0..json["nodes"].as_array().map_or(0, Vec::len)).collect(),
    };
    for node in roots {
        glb.node(node, &nalgebra::Matrix4::identity(), 0).map_err(|e| bad(&e))?;
    }
    let mut builder = glb.builder;
    for v in &mut builder.vertices {
        *v = Vec3::new(v.x, -v.z, v.y);
    }
    builder.warnings.push(Warning::new("y-up", "GLB has y up; the mesh was turned so that z is up"));
    Ok(builder)
}

struct Glb<'a> {
    json: &'a serde_json::Value,
    bin: &'a [u8],
    builder: MeshBuilder,
    visited: usize,
}

impl Glb<'_> {
    fn node(&mut self, index: usize, parent: &nalgebra::Matrix4<f64>, depth: usize) -> Result<(), String> {
        /// Deeper scenes are loops.
        const DEEPEST: usize = 64;
        /// More visits than this are loops too.
        const MOST: usize = 100_000;
        self.visited += 1;
        if depth > DEEPEST || self.visited > MOST {
            return Err("its nodes form a loop".into());
        }
        let node = &self.json["nodes"][index];
        let matrix = parent * local_matrix(node);
        if let Some(mesh) = node["mesh"].as_u64() {
            for primitive in self.json["meshes"][mesh as usize]["primitives"].as_array().into_iter().flatten() {
                self.primitive(primitive, &matrix)?;
            }
        }
        for child in node["children"].as_array().into_iter().flatten() {
            self.node(child.as_u64().unwrap_or(u64::MAX) as usize, &matrix, depth + 1)?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &serde_json::Value, matrix: &nalgebra::Matrix4<f64>) -> Result<(), String> {
        const TRIANGLES: u64 = 4;
        const STRIP: u64 = 5;
        const FAN: u64 = 6;
        let mode = primitive["mode"].as_u64().unwrap_or(TRIANGLES);
        if !(TRIANGLES..=FAN).contains(&mode) {
            let warning = Warning::new("glb-primitives", "points and lines of the GLB are left out");
            if !self.builder.warnings.contains(&warning) {
                self.builder.warnings.push(warning);
            }
            return Ok(());
        }
        let positions = self.accessor(&primitive["attributes"]["POSITION"], 3)?;
        let first = self.builder.vertices.len();
        /// A small file may show one mesh a hundred thousand times; no mesh of a tunnel does.
        const MOST_COPIES: usize = 64;
        let most = (self.bin.len() / 12).saturating_mul(MOST_COPIES);
        if first + positions.len() / 3 > most {
            return Err(format!("its nodes show more than {most} vertices, {MOST_COPIES} times what its data holds"));
        }
        for p in positions.chunks_exact(3) {
            let p = matrix * nalgebra::Vector4::new(p[0], p[1], p[2], 1.0);
            self.builder.vertices.push(p.xyz());
        }
        let indices = match &primitive["indices"] {
            serde_json::Value::Null => (0..positions.len() / 3).map(|i| i as f64).collect(),
            indices => self.accessor(indices, 1)?,
        };
        let triangles = match mode {
            TRIANGLES => indices.len() / 3,
            _ => indices.len().saturating_sub(2),
        };
        for i in 0..triangles {
            let corners = match mode {
                TRIANGLES => [3 * i, 3 * i + 1, 3 * i + 2],
                // Every second triangle of a strip runs the other way round.
                STRIP => [i, i + 1 + i % 2, i + 2 - i % 2],
                _ => [i + 1, i + 2, 0],
            };
            self.builder.polygon(&corners.map(|k| indices[k] + first as f64), None)?;
        }
        Ok(())
    }

    /// The numbers of an accessor with `width` numbers an element.
    fn accessor(&self, index: &serde_json::Value, width: usize) -> Result<Vec<f64>, String> {
        let accessor = index.as_u64().map(|i| &self.json["accessors"][i as usize]).ok_or("a mesh has no positions")?;
        let view = accessor["bufferView"].as_u64().ok_or("compressed or sparse data is not read")?;
        let view = &self.json["bufferViews"][view as usize];
        let at = |value: &serde_json::Value| value.as_u64().unwrap_or(0) as usize;
        let count = at(&accessor["count"]);
        let size = match accessor["componentType"].as_u64() {
            Some(5121) => 1,
            Some(5123) => 2,
            Some(5125 | 5126) => 4,
            other => return Err(format!("component type {other:?} is not read")),
        };
        let float = accessor["componentType"].as_u64() == Some(5126);
        let stride = view["byteStride"].as_u64().map_or(size * width, |s| s as usize);
        let start = at(&view["byteOffset"]).saturating_add(at(&accessor["byteOffset"]));
        let end = count.checked_mul(stride).and_then(|b| b.checked_add(start));
        if at(&view["buffer"]) != 0 || stride < size * width || end.is_none_or(|e| e > self.bin.len() + stride) {
            return Err(format!("{count} elements of {stride} bytes leave the data of {} bytes", self.bin.len()));
        }
        let mut values = Vec::with_capacity(count * width);
        for element in 0..count {
            for component in 0..width {
                let from = start + element * stride + component * size;
                let bytes = self.bin.get(from..from + size).ok_or("an element leaves the data")?;
                values.push(match bytes {
                    [a] => f64::from(*a),
                    [a, b] => f64::from(u16::from_le_bytes([*a, *b])),
                    _ => {
                        let raw: [u8; 4] = bytes.try_into().expect("four bytes");
                        if float { f64::from(f32::from_le_bytes(raw)) } else { f64::from(u32::from_le_bytes(raw)) }
                    }
                });
            }
        }
        Ok(values)
    }
}

fn local_matrix(node: &serde_json::Value) -> nalgebra::Matrix4<f64> {
    let numbers =
        |key: &str| -> Option<Vec<f64>> { node[key].as_array()?.iter().map(serde_json::Value::as_f64).collect() };
    if let Some(m) = numbers("matrix").filter(|m| m.len() == 16) {
        return nalgebra::Matrix4::from_column_slice(&m);
    }
    let mut matrix = nalgebra::Matrix4::identity();
    if let Some([x, y, z]) = numbers("translation").as_deref() {
        matrix = nalgebra::Matrix4::new_translation(&Vec3::new(*x, *y, *z));
    }
    if let Some([x, y, z, w]) = numbers("rotation").as_deref() {
        let rotation = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(*w, *x, *y, *z));
        matrix *= rotation.to_homogeneous();
    }
    if let Some([x, y, z]) = numbers("scale").as_deref() {
        matrix *= nalgebra::Matrix4::new_nonuniform_scaling(&Vec3::new(*x, *y, *z));
    }
    matrix
}
