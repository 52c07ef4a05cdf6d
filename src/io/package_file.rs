//! A package: a ZIP file with the same bytes for the same content, and the hash of everything in it.

use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

/// Name of the list of hashes, as `sha256sum --check` reads it.
const HASHES: &str = "SHA256SUMS";
/// What is compressed already is stored as it is.
const COMPRESSED: [&str; 7] = ["tif", "png", "jpg", "laz", "zip", "gpkg", "pdf"];
/// Files above this length need the 64-bit records of ZIP.
const LARGE: u64 = 4_000_000_000;

/// Why a package could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PackageError {
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What happened.
        source: io::Error,
    },
}

/// Writes a package; it appears under its name when it is complete.
pub struct PackageFile {
    path: PathBuf,
    partial: PathBuf,
    zip: Option<ZipWriter<BufWriter<File>>>,
    hashes: Vec<(String, String)>,
}

impl PackageFile {
    /// Starts a package.
    ///
    /// # Errors
    /// [`PackageError::Io`].
    pub fn create(path: &Path) -> Result<Self, PackageError> {
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        let file = File::create(&partial).map_err(|source| PackageError::Io { path: partial.clone(), source })?;
        let zip = ZipWriter::new(BufWriter::with_capacity(1 << 20, file));
        Ok(Self { path: path.to_owned(), partial, zip: Some(zip), hashes: Vec::new() })
    }

    /// Adds a file from disk under a name with `/`.
    ///
    /// # Errors
    /// [`PackageError::Io`].
    pub fn add_file(&mut self, name: &str, source: &Path) -> Result<(), PackageError> {
        let read = |e| PackageError::Io { path: source.to_owned(), source: e };
        let file = File::open(source).map_err(read)?;
        let length = file.metadata().map_err(read)?.len();
        self.add(name, file, length)
    }

    /// Adds bytes under a name with `/`.
    ///
    /// # Errors
    /// [`PackageError::Io`].
    pub fn add_bytes(&mut self, name: &str, bytes: &[u8]) -> Result<(), PackageError> {
        self.add(name, bytes, bytes.len() as u64)
    }

    /// Adds the list of hashes and completes the package; gives the number of files in it.
    ///
    /// # Errors
    /// [`PackageError::Io`].
    pub fn finish(mut self) -> Result<usize, PackageError> {
        let list: String = self.hashes.iter().map(|(name, hash)| format!("{hash}  {name}\n")).collect();
        self.add_bytes(HASHES, list.as_bytes())?;
        let failed = |source: io::Error| PackageError::Io { path: self.path.clone(), source };
        if let Some(zip) = self.zip.take() {
            let out = zip.finish().map_err(|e| failed(e.into()))?;
            out.into_inner().map_err(|e| failed(e.into_error()))?.sync_all().map_err(failed)?;
        }
        fs::rename(&self.partial, &self.path).map_err(failed)?;
        Ok(self.hashes.len())
    }

    fn add(&mut self, name: &str, mut from: impl Read, length: u64) -> Result<(), PackageError> {
        let failed = |source: io::Error| PackageError::Io { path: self.path.clone(), source };
        let extension = name.rsplit('.').next().unwrap_or_default().to_ascii_lowercase();
        let method = if COMPRESSED.contains(&extension.as_str()) {
            CompressionMethod::Stored
        } else {
            CompressionMethod::Deflated
        };
        // Neither the time nor the rights of the files here belong to the content.
        let options = SimpleFileOptions::default()
            .compression_method(method)
            .last_modified_time(DateTime::default())
            .unix_permissions(0o644)
            .large_file(length > LARGE);
        let Some(zip) = &mut self.zip else { return Ok(()) };
        zip.start_file(name, options).map_err(|e| failed(e.into()))?;
        let mut hash = Sha256::new();
        let mut block = vec![0u8; 1 << 20];
        loop {
            let n = from.read(&mut block).map_err(failed)?;
            if n == 0 {
                break;
            }
            hash.update(&block[..n]);
            zip.write_all(&block[..n]).map_err(failed)?;
        }
        let hex: String = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
        self.hashes.push((name.to_owned(), hex));
        Ok(())
    }
}

impl Drop for PackageFile {
    fn drop(&mut self) {
        // Only there when writing was broken off.
        self.zip = None;
        fs::remove_file(&self.partial).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_content_gives_the_same_bytes_and_true_hashes() {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("a.tif");
        fs::write(&source, [7u8; 5000]).unwrap();
        let make = |name: &str| {
            let path = folder.path().join(name);
            let mut package = PackageFile::create(&path).unwrap();
            package.add_file("map/a.tif", &source).unwrap();
            package.add_bytes("README.txt", b"read me").unwrap();
            assert_eq!(package.finish().unwrap(), 3);
            fs::read(path).unwrap()
        };
        let first = make("one.zip");
        fs::write(&source, [7u8; 5000]).unwrap();
        assert!(first == make("two.zip"));
        let mut zip = zip::ZipArchive::new(io::Cursor::new(first)).unwrap();
        let mut list = String::new();
        zip.by_name(HASHES).unwrap().read_to_string(&mut list).unwrap();
        let hash: String = Sha256::digest([7u8; 5000]).iter().map(|b| format!("{b:02x}")).collect();
        assert!(list.contains(&format!("{hash}  map/a.tif\n")) && list.contains("  README.txt\n"));
        let mut back = Vec::new();
        zip.by_name("map/a.tif").unwrap().read_to_end(&mut back).unwrap();
        assert_eq!(back, [7u8; 5000]);
        assert!(!folder.path().join("one.zip.partial").exists());
    }
}
