//! Products of stages on disk, so that a run can go on where it was interrupted: named columns of plain numbers.
//!
//! A file is a line of JSON (names, types and lengths of the columns) and the columns' bytes in order. Numbers keep
//! every bit, so a resumed run ends in the same bytes as an undisturbed one. The format is private to a version of
//! Adit; what others read are the products (`mesh.ply`, `chart.ply`, ...).

use crate::axis::Axis;
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use crate::segment::{Floor, Quality, SectionField};
use bytemuck::Pod;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

/// Why a checkpoint cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused.
    #[error("cannot use the checkpoint '{}': {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// The file does not hold what is expected.
    #[error("the checkpoint '{}' is damaged ({what}): run again with --force", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

/// A product that can be put on disk and read back with every bit.
pub trait Checkpoint: Sized {
    /// Adds the columns of the product.
    fn save(&self, columns: &mut Writer);
    /// Makes the product from its columns.
    ///
    /// # Errors
    /// [`Error::Damaged`] when a column is missing or the columns do not form the product.
    fn load(columns: &Reader) -> Result<Self, Error>;
}

/// Collects columns.
#[derive(Default)]
pub struct Writer {
    columns: Vec<(String, usize, Vec<u8>)>,
}

impl Writer {
    /// Adds a column.
    pub fn put<T: Pod>(&mut self, name: &str, values: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        self.columns.push((name.to_owned(), size_of::<T>(), bytes.to_vec()));
    }

    /// Writes the file and waits until it is on disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let write = || -> std::io::Result<()> {
            let mut file = std::fs::File::create(path)?;
            let header: Vec<(&str, usize, usize)> =
                self.columns.iter().map(|(name, size, bytes)| (name.as_str(), *size, bytes.len())).collect();
            writeln!(file, "{}", serde_json::to_string(&header)?)?;
            for (_, _, bytes) in &self.columns {
                file.write_all(bytes)?;
            }
            file.sync_all()
        };
        write().map_err(|source| Error::Io { path: path.to_owned(), source })
    }
}

/// Columns read back.
pub struct Reader {
    path: PathBuf,
    columns: Vec<(String, usize, Vec<u8>)>,
}

impl Reader {
    /// Reads a checkpoint file.
    ///
    /// # Errors
    /// [`Error::Io`], or [`Error::Damaged`] when the file is cut off.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let io = |source| Error::Io { path: path.to_owned(), source };
        let mut file = BufReader::new(std::fs::File::open(path).map_err(io)?);
        let length = file.get_ref().metadata().map_err(io)?.len();
        let mut line = String::new();
        file.read_line(&mut line).map_err(io)?;
        let damaged = |what: &str| Error::Damaged { path: path.to_owned(), what: what.to_owned() };
        let header: Vec<(String, usize, usize)> =
            serde_json::from_str(&line).map_err(|_| damaged("its header does not read"))?;
        if header.iter().map(|(_, _, n)| *n as u64).sum::<u64>() + line.len() as u64 != length {
            return Err(damaged("its length is wrong"));
        }
        let mut columns = Vec::new();
        for (name, size, bytes) in header {
            let mut column = vec![0; bytes];
            file.read_exact(&mut column).map_err(io)?;
            columns.push((name, size, column));
        }
        Ok(Self { path: path.to_owned(), columns })
    }

    /// A column.
    ///
    /// # Errors
    /// [`Error::Damaged`] when there is no such column of this type.
    pub fn get<T: Pod>(&self, name: &str) -> Result<Vec<T>, Error> {
        let (_, size, bytes) = self
            .columns
            .iter()
            .find(|(n, _, _)| n == name)
            .ok_or_else(|| self.damaged(format!("column '{name}' is missing")))?;
        if *size != size_of::<T>() || bytes.len() % size != 0 {
            return Err(self.damaged(format!("column '{name}' has another type")));
        }
        Ok(bytemuck::pod_collect_to_vec(bytes))
    }

    /// A value written as a column of one.
    ///
    /// # Errors
    /// [`Error::Damaged`].
    pub fn one<T: Pod>(&self, name: &str) -> Result<T, Error> {
        let column = self.get::<T>(name)?;
        column.first().copied().ok_or_else(|| self.damaged(format!("column '{name}' is empty")))
    }

    /// The error for columns that do not form the product.
    pub fn damaged(&self, what: impl ToString) -> Error {
        Error::Damaged { path: self.path.clone(), what: what.to_string() }
    }
}

fn points(values: &[Vec3]) -> &[[f64; 3]] {
    bytemuck::cast_slice(values)
}

impl Checkpoint for Mesh {
    fn save(&self, columns: &mut Writer) {
        columns.put("vertices", points(self.vertices()));
        columns.put("faces", self.faces());
        columns.put("observed", &self.observed().iter().map(|&o| u8::from(o)).collect::<Vec<_>>());
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        let vertices: Vec<[f64; 3]> = columns.get("vertices")?;
        let observed = columns.get::<u8>("observed")?.into_iter().map(|o| o != 0).collect();
        Mesh::new(vertices.into_iter().map(Vec3::from).collect(), columns.get("faces")?, observed)
            .map_err(|e| columns.damaged(e))
    }
}

impl Checkpoint for Strip {
    fn save(&self, columns: &mut Writer) {
        self.mesh().save(columns);
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        Strip::from_disk(Mesh::load(columns)?).map_err(|e| columns.damaged(e))
    }
}

impl Checkpoint for Vec<Vec2> {
    fn save(&self, columns: &mut Writer) {
        columns.put::<[f64; 2]>("uv", bytemuck::cast_slice(self));
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        Ok(columns.get::<[f64; 2]>("uv")?.into_iter().map(Vec2::from).collect())
    }
}

impl Checkpoint for Axis {
    fn save(&self, columns: &mut Writer) {
        columns.put("knots", points(self.knots()));
        columns.put("start_chainage", &[self.start_chainage()]);
        columns.put("crown_azimuth", &[self.crown_azimuth_deg().unwrap_or(f64::NAN)]);
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        let knots: Vec<[f64; 3]> = columns.get("knots")?;
        let knots: Vec<Vec3> = knots.into_iter().map(Vec3::from).collect();
        let axis = Axis::through(&knots, columns.one("start_chainage")?).map_err(|e| columns.damaged(e))?;
        let azimuth: f64 = columns.one("crown_azimuth")?;
        Ok(if azimuth.is_nan() { axis } else { axis.with_crown_azimuth(azimuth) })
    }
}

impl Checkpoint for SectionField {
    fn save(&self, columns: &mut Writer) {
        let (start, step, radius, observed) = self.columns();
        columns.put("section start and step", &[[start, step]]);
        columns.put("section radius", radius);
        columns.put("section observed", &observed.iter().map(|&o| u8::from(o)).collect::<Vec<_>>());
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        let [start, step] = columns.one::<[f64; 2]>("section start and step")?;
        let observed = columns.get::<u8>("section observed")?.into_iter().map(|o| o != 0).collect();
        SectionField::from_columns(start, step, columns.get("section radius")?, observed)
            .ok_or_else(|| columns.damaged("the section does not fit together"))
    }
}

impl Checkpoint for Quality {
    fn save(&self, columns: &mut Writer) {
        let (lengths, size, [noise, density, incidence], class) = self.columns();
        columns.put("quality start and cell", &[lengths]);
        columns.put("quality rows and columns", &[size]);
        columns.put("quality noise", noise);
        columns.put("quality density", density);
        columns.put("quality incidence", incidence);
        columns.put("quality class", class);
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        let values =
            [columns.get("quality noise")?, columns.get("quality density")?, columns.get("quality incidence")?];
        let (lengths, size) = (columns.one("quality start and cell")?, columns.one("quality rows and columns")?);
        Quality::from_columns(lengths, size, values, columns.get("quality class")?)
            .ok_or_else(|| columns.damaged("the quality does not fit together"))
    }
}

impl Checkpoint for Floor {
    fn save(&self, columns: &mut Writer) {
        let (start_and_window, feet) = self.columns();
        columns.put("floor start and window", &[start_and_window]);
        columns.put("floor feet", feet);
    }

    fn load(columns: &Reader) -> Result<Self, Error> {
        Floor::from_columns(columns.one("floor start and window")?, columns.get("floor feet")?)
            .ok_or_else(|| columns.damaged("the floor does not fit together"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bit_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        let values = [f64::NAN, -0.0, f64::MIN_POSITIVE, 0.1 + 0.2];
        let mut columns = Writer::default();
        columns.put("a", &values);
        columns.put("b", &[1u8, 2, 3]);
        columns.write(&path).unwrap();
        let back = Reader::open(&path).unwrap();
        let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&back.get::<f64>("a").unwrap()), bits(&values));
        assert!(back.get::<u32>("a").is_err() && back.get::<u8>("missing").is_err());
    }

    #[test]
    fn a_cut_off_file_is_damaged() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        let mut columns = Writer::default();
        columns.put("a", &[1.0, 2.0]);
        columns.write(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        assert!(matches!(Reader::open(&path), Err(Error::Damaged { .. })));
    }
}
