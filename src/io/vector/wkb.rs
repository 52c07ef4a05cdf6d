//! Well-known binary, as GeoPackage stores it: little endian out, both endians in, with or without Z and M.

use crate::linework::Kind;
use crate::numeric::Vec3;

/// Bytes of a geometry with Z.
pub(super) fn write(kind: Kind, parts: &[Vec<Vec3>], multi: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let head = |bytes: &mut Vec<u8>, code: u32| {
        bytes.push(1);
        bytes.extend((1000 + code).to_le_bytes());
    };
    let point = |bytes: &mut Vec<u8>, p: &Vec3| [p.x, p.y, p.z].iter().for_each(|c| bytes.extend(c.to_le_bytes()));
    let run = |bytes: &mut Vec<u8>, points: &[Vec3]| {
        bytes.extend((points.len() as u32).to_le_bytes());
        points.iter().for_each(|p| point(bytes, p));
    };
    let code = match kind {
        Kind::Point => 1,
        Kind::Line => 2,
        Kind::Area => 3,
    };
    if multi {
        head(&mut bytes, code + 3);
        bytes.extend((if kind == Kind::Area { 1 } else { parts.len() as u32 }).to_le_bytes());
    }
    match kind {
        Kind::Point => parts.iter().for_each(|part| {
            head(&mut bytes, code);
            point(&mut bytes, &part[0]);
        }),
        Kind::Line => parts.iter().for_each(|part| {
            head(&mut bytes, code);
            run(&mut bytes, part);
        }),
        Kind::Area => {
            head(&mut bytes, code);
            bytes.extend((parts.len() as u32).to_le_bytes());
            parts.iter().for_each(|ring| run(&mut bytes, ring));
        }
    }
    bytes
}

/// Reads a geometry; `Err` tells what is wrong. An empty geometry has no parts.
pub(super) fn read(bytes: &[u8]) -> Result<(Kind, Vec<Vec<Vec3>>), String> {
    let mut reader = Reader { bytes, at: 0 };
    let mut parts = Vec::new();
    let kind = reader.geometry(&mut parts, 0)?;
    parts.retain(|part| !part.is_empty() && part.iter().all(|p| !p.x.is_nan()));
    Ok((kind, parts))
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let found = self.bytes.get(self.at..self.at + N).ok_or("the geometry is cut off")?;
        self.at += N;
        Ok(found.try_into().expect("the length is right"))
    }

    fn count(&mut self, little: bool) -> Result<u32, String> {
        let bytes = self.take()?;
        Ok(if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    fn number(&mut self, little: bool) -> Result<f64, String> {
        let bytes = self.take()?;
        Ok(if little { f64::from_le_bytes(bytes) } else { f64::from_be_bytes(bytes) })
    }

    fn geometry(&mut self, parts: &mut Vec<Vec<Vec3>>, depth: usize) -> Result<Kind, String> {
        let little = self.take::<1>()?[0] == 1;
        let code = self.count(little)?;
        // ISO adds thousands for Z and M, the older extended form sets bits.
        let (extended_z, extended_m) = (code & 0x8000_0000 != 0, code & 0x4000_0000 != 0);
        if code & 0x2000_0000 != 0 {
            self.take::<4>()?;
        }
        let plain = code & 0x0fff_ffff;
        let (z, m) = (extended_z || matches!(plain / 1000, 1 | 3), extended_m || matches!(plain / 1000, 2 | 3));
        let point = |r: &mut Self| -> Result<Vec3, String> {
            let mut p = Vec3::new(r.number(little)?, r.number(little)?, 0.0);
            if z {
                p.z = r.number(little)?;
            }
            if m {
                r.number(little)?;
            }
            Ok(p)
        };
        let run = |r: &mut Self| -> Result<Vec<Vec3>, String> {
            let count = r.count(little)?;
            (0..count).map(|_| point(r)).collect()
        };
        match plain % 1000 {
            1 => {
                parts.push(vec![point(self)?]);
                Ok(Kind::Point)
            }
            2 => {
                parts.push(run(self)?);
                Ok(Kind::Line)
            }
            3 => {
                for _ in 0..self.count(little)? {
                    parts.push(run(self)?);
                }
                Ok(Kind::Area)
            }
            code @ 4..=6 if depth == 0 => {
                for _ in 0..self.count(little)? {
                    self.geometry(parts, 1)?;
                }
                Ok([Kind::Point, Kind::Line, Kind::Area][code as usize - 4])
            }
            code => Err(format!("geometries of type {code} are not read (points, lines and polygons are)")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_reads_back() {
        let part = vec![Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)];
        for (kind, parts, multi) in [
            (Kind::Line, vec![part.clone()], false),
            (Kind::Line, vec![part.clone(), part.clone()], true),
            (Kind::Point, vec![vec![part[0]]], false),
            (Kind::Area, vec![part.clone(), part.clone()], true),
        ] {
            assert_eq!(read(&write(kind, &parts, multi)).unwrap(), (kind, parts));
        }
    }

    #[test]
    fn both_endians_with_and_without_z() {
        let mut big = vec![0, 0, 0, 0, 1];
        big.extend(1.5f64.to_be_bytes());
        big.extend(2.5f64.to_be_bytes());
        assert_eq!(read(&big).unwrap(), (Kind::Point, vec![vec![Vec3::new(1.5, 2.5, 0.0)]]));
        assert!(read(&big[..9]).unwrap_err().contains("cut off"));
        assert!(read(&[1, 15, 0, 0, 0]).unwrap_err().contains("15"));
    }
}
