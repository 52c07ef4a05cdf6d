//! One process per folder: an advisory lock on a file that names its holder.

use super::run_folder::Error;
use std::fs::{self, File, TryLockError};
use std::io::Write;
use std::path::Path;
use std::time::Duration;

/// How often, and how far apart, a lock is read that does not yet name its holder.
const READINGS: (u32, Duration) = (50, Duration::from_millis(20));

/// A lock that ends with this value, or with the process.
#[derive(Debug)]
pub(super) struct FolderLock(File);

impl FolderLock {
    /// Takes the lock of `folder`, the file `lock_path` in it, and writes this process into it.
    ///
    /// # Errors
    /// [`Error::Locked`] with the process that holds it, [`Error::Io`].
    pub(super) fn take(folder: &Path, lock_path: &Path) -> Result<Self, Error> {
        let mut lock = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(lock_path)
            .map_err(Error::io("open the lock", lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(Error::Locked { path: folder.to_owned(), holder: holder_of(lock_path) });
            }
            Err(TryLockError::Error(source)) => return Err(Error::io("lock", lock_path)(source)),
        }
        let host = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        lock.set_len(0)
            .and_then(|()| write!(lock, "process {} on {}", std::process::id(), host.trim()))
            .map_err(Error::io("write the lock", lock_path))?;
        Ok(Self(lock))
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // The next holder must not be called by this one's name before it has written its own.
        let _ = self.0.set_len(0);
    }
}

/// Who holds a lock. A holder writes its name just after it took the lock, so an empty one is read again.
fn holder_of(lock_path: &Path) -> String {
    let (readings, apart) = READINGS;
    for _ in 0..readings {
        let holder = fs::read_to_string(lock_path).unwrap_or_default();
        if !holder.trim().is_empty() {
            return holder.trim().to_owned();
        }
        std::thread::sleep(apart);
    }
    "another process".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_holder_that_has_not_yet_written_its_name_is_waited_for() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("lock");
        let held = File::create(&path).unwrap();
        held.lock().unwrap();
        let late = path.clone();
        let writer = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(100));
            fs::write(late, "process 7 on here").unwrap();
        });
        let refused = FolderLock::take(place.path(), &path).unwrap_err();
        assert!(matches!(&refused, Error::Locked { holder, .. } if holder == "process 7 on here"), "{refused}");
        writer.join().unwrap();
    }

    #[test]
    fn a_lock_names_this_process_and_is_free_and_nameless_afterwards() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("lock");
        let held = FolderLock::take(place.path(), &path).unwrap();
        let refused = FolderLock::take(place.path(), &path).unwrap_err();
        assert!(refused.to_string().contains(&format!("process {}", std::process::id())), "{refused}");
        drop(held);
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
        FolderLock::take(place.path(), &path).unwrap();
    }
}
