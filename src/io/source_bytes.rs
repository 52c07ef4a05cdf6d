//! Positioned reads of a file, shared by threads without a common cursor.

use super::error::Error;
use std::fs::File;
use std::path::{Path, PathBuf};

/// An opened input whose length is known.
#[derive(Debug)]
pub(super) struct SourceBytes {
    content: Content,
    path: PathBuf,
    len: u64,
}

#[derive(Debug)]
enum Content {
    File(File),
    /// What a file was converted to.
    Memory(Vec<u8>),
}

impl SourceBytes {
    pub(super) fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|e| Error::read(path, e))?;
        let metadata = file.metadata().map_err(|e| Error::read(path, e))?;
        if metadata.is_dir() {
            return Err(Error::bad(path, "it is a folder", "name a scan file"));
        }
        let len = metadata.len();
        if len == 0 {
            return Err(Error::bad(path, "the file is empty (0 bytes)", super::error::COPY_AGAIN));
        }
        Ok(Self { content: Content::File(file), path: path.to_owned(), len })
    }

    /// The same file with other content.
    pub(super) fn with_content(&self, content: Vec<u8>) -> Self {
        Self { len: content.len() as u64, content: Content::Memory(content), path: self.path.clone() }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn len(&self) -> u64 {
        self.len
    }

    /// Fills `buffer` from byte `at` of the file.
    pub(super) fn read_at(&self, at: u64, buffer: &mut [u8]) -> Result<(), Error> {
        let read = match &self.content {
            Content::File(file) => read_exact_at(file, buffer, at),
            Content::Memory(bytes) => usize::try_from(at)
                .ok()
                .and_then(|at| bytes.get(at..at.checked_add(buffer.len())?))
                .map(|found| buffer.copy_from_slice(found))
                .ok_or_else(|| std::io::ErrorKind::UnexpectedEof.into()),
        };
        read.map_err(|e| Error::read(&self.path, e))
    }

    /// `count` bytes from byte `at`; the caller has checked that the file holds them.
    pub(super) fn bytes(&self, at: u64, count: usize) -> Result<Vec<u8>, Error> {
        let mut buffer = vec![0; count];
        self.read_at(at, &mut buffer)?;
        Ok(buffer)
    }

    /// Up to `count` bytes from byte `at`, fewer at the end of the file.
    pub(super) fn up_to(&self, at: u64, count: usize) -> Result<Vec<u8>, Error> {
        let left = self.len.saturating_sub(at);
        self.bytes(at.min(self.len), left.min(count as u64) as usize)
    }
}

#[cfg(unix)]
fn read_exact_at(file: &File, buffer: &mut [u8], at: u64) -> std::io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, buffer, at)
}

#[cfg(windows)]
fn read_exact_at(file: &File, mut buffer: &mut [u8], mut at: u64) -> std::io::Result<()> {
    while !buffer.is_empty() {
        let read = std::os::windows::fs::FileExt::seek_read(file, buffer, at)?;
        if read == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
        buffer = &mut buffer[read..];
        at += read as u64;
    }
    Ok(())
}
