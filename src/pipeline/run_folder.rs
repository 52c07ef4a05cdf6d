//! The folder of one run: lock, staged products, stage records.
//!
//! Nothing appears under its final name before it is complete and on disk: a stage writes into `.adit/tmp-<stage>/`,
//! then every file is synced and renamed into place, and only then the stage's record is written. Killed at any moment,
//! the folder holds whole files and records that tell the truth; what is missing is made again, with the same bytes.
//! With a scratch folder (`--tmp`) stages prepare their products and keep their checkpoints there; products still come into
//! the run folder by a rename. `.adit/journal.jsonl` tells what was begun and finished, and when.

use super::checkpoint;
use super::error::Kind;
use super::folder_lock::FolderLock;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// Where the folder keeps what is not for people.
const PRIVATE: &str = ".adit";

/// Why a run folder cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused.
    #[error("cannot {action} '{}': {source}; choose another folder with --out, or make room and check its permissions", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// With which file or folder.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// Another process works in the folder.
    #[error("the run folder '{}' is in use by {holder}: wait for it to finish, or choose another folder with --out", path.display())]
    Locked {
        /// The folder.
        path: PathBuf,
        /// Who holds it.
        holder: String,
    },
    /// A product would overwrite an input.
    #[error("the run would overwrite its own input '{}': choose another folder with --out", path.display())]
    InputInside {
        /// The input.
        path: PathBuf,
    },
    /// A stage record does not read.
    #[error("'{}' is damaged ({what}): run again with --force", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

impl Error {
    /// Whose problem it is.
    pub fn kind(&self) -> Kind {
        match self {
            Self::InputInside { .. } => Kind::Usage,
            _ => Kind::Resources,
        }
    }

    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, path: path.to_owned(), source }
    }
}

/// A product of a stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ProductFile {
    /// Path in the run folder, with `/`.
    pub name: String,
    /// Length in bytes.
    pub bytes: u64,
    /// Hash of the content.
    pub sha256: String,
}

/// What a finished stage leaves behind: everything that its result depends on, and what came out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Hash of version, settings and inputs: equal keys mean equal products.
    pub key: String,
    /// Version of the stage's algorithm.
    pub version: u32,
    /// The settings that matter to the stage.
    pub settings: serde_json::Value,
    /// Keys of the stages it builds on, and hashes of the files it reads.
    pub inputs: BTreeMap<String, String>,
    /// The files it made.
    pub files: Vec<ProductFile>,
    /// The stage's section of the report.
    pub summary: serde_json::Value,
    /// How long it took, seconds.
    pub seconds: f64,
    /// Greatest memory of the process up to its end, bytes.
    pub peak_memory_bytes: u64,
}

/// A run folder held by this process.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
    /// Where stages prepare products and keep checkpoints: `.adit`, or a folder below `--tmp`.
    scratch: PathBuf,
    interrupted: Option<String>,
    // Held until dropped; the operating system frees it when the process dies, so no lock can be stale.
    _lock: FolderLock,
}

/// Names the scratch folder of a run folder that has one elsewhere, so that it is removed with it.
const SCRATCH_NOTE: &str = "scratch";
const JOURNAL: &str = "journal.jsonl";

impl RunFolder {
    /// Makes the folder if needed, takes its lock and removes what an interrupted run left unfinished.
    ///
    /// # Errors
    /// [`Error::Io`], or [`Error::Locked`] with the process that holds it.
    pub fn open(path: &Path) -> Result<Self, Error> {
        Self::open_with_scratch(path, None)
    }

    /// [`Self::open`], with a folder on a fast disk for what is not a product.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_with_scratch(path: &Path, tmp: Option<&Path>) -> Result<Self, Error> {
        let private = path.join(PRIVATE);
        fs::create_dir_all(&private).map_err(Error::io("make the run folder", path))?;
        let lock_path = private.join("lock");
        let lock = FolderLock::take(path, &lock_path)?;
        let scratch = match tmp {
            None => private.clone(),
            Some(tmp) => {
                let absolute = fs::canonicalize(path).map_err(Error::io("find", path))?;
                let name = sha256_of_bytes(absolute.to_string_lossy().as_bytes());
                let scratch = tmp.join(format!("adit-{}", &name[..16]));
                fs::create_dir_all(&scratch).map_err(Error::io("make the scratch folder", &scratch))?;
                scratch
            }
        };
        remove_leftovers(&private)?;
        if scratch != private {
            remove_leftovers(&scratch)?;
        }
        let folder = Self { path: path.to_owned(), interrupted: interrupted_in(&private), scratch, _lock: lock };
        if tmp.is_some() {
            folder.write(&format!("{PRIVATE}/{SCRATCH_NOTE}"), folder.scratch.to_string_lossy().as_bytes())?;
        }
        Ok(folder)
    }

    /// The stage during which the last process that worked here died, if it did.
    pub fn interrupted(&self) -> Option<&str> {
        self.interrupted.as_deref()
    }

    /// Appends a line to the journal and waits until it is on disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn note(&self, event: &str, fields: serde_json::Value) -> Result<(), Error> {
        let path = self.path.join(PRIVATE).join(JOURNAL);
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        let mut line = serde_json::json!({
            "time_unix_s": now.as_millis() as f64 / 1000.0, "process": std::process::id(), "event": event,
        });
        if let (Some(line), serde_json::Value::Object(fields)) = (line.as_object_mut(), fields) {
            line.extend(fields);
        }
        let mut file = File::options().create(true).append(true).open(&path).map_err(Error::io("open", &path))?;
        // One write a line, beginning on a new line even after a torn one.
        file.write_all(format!("\n{line}").as_bytes())
            .and_then(|()| file.sync_data())
            .map_err(Error::io("write", &path))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Refuses a run whose products would replace one of its inputs.
    ///
    /// # Errors
    /// [`Error::InputInside`].
    pub fn refuse_inputs_inside(&self, inputs: &[PathBuf], products: &[&str]) -> Result<(), Error> {
        let real = |p: &Path| fs::canonicalize(p).ok();
        for input in inputs {
            let Some(found) = real(input) else { continue };
            if products.iter().any(|p| real(&self.path.join(p)).is_some_and(|q| q == found)) {
                return Err(Error::InputInside { path: input.clone() });
            }
        }
        Ok(())
    }

    /// An empty folder in which a stage prepares its products.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn staging(&self, stage: &str) -> Result<PathBuf, Error> {
        let path = self.scratch.join(format!("tmp-{stage}"));
        if path.exists() {
            fs::remove_dir_all(&path).map_err(Error::io("empty", &path))?;
        }
        fs::create_dir_all(&path).map_err(Error::io("make", &path))?;
        Ok(path)
    }

    /// Removes a staging folder whose products are not needed.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn discard(&self, staging: &Path) -> Result<(), Error> {
        fs::remove_dir_all(staging).map_err(Error::io("remove", staging))
    }

    /// Syncs every file of the staging folder and renames it to the same name in the run folder.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn publish(&self, staging: &Path) -> Result<Vec<ProductFile>, Error> {
        let mut names = Vec::new();
        collect_files(staging, "", &mut names)?;
        names.sort();
        let store = |name: &String| {
            let staged = staging.join(name);
            let file = File::open(&staged).map_err(Error::io("open", &staged))?;
            file.sync_all().map_err(Error::io("sync", &staged))?;
            let bytes = file.metadata().map_err(Error::io("inspect", &staged))?.len();
            Ok(ProductFile { name: name.clone(), bytes, sha256: sha256_of(&staged)? })
        };
        let files = names.par_iter().map(store).collect::<Result<Vec<_>, Error>>()?;
        for name in &names {
            let place = self.path.join(name);
            if let Some(folder) = place.parent() {
                fs::create_dir_all(folder).map_err(Error::io("make", folder))?;
            }
            self.bring(&staging.join(name), &place)?;
        }
        sync_folder(&self.path);
        sync_folder(&self.path.join("map"));
        fs::remove_dir_all(staging).map_err(Error::io("remove", staging))?;
        Ok(files)
    }

    /// Renames a synced file into place; from a scratch folder on another disk it is copied beside its place before.
    fn bring(&self, staged: &Path, place: &Path) -> Result<(), Error> {
        if self.scratch == self.path.join(PRIVATE) {
            return fs::rename(staged, place).map_err(Error::io("write", place));
        }
        let beside = self.path.join(PRIVATE).join("tmp-copy");
        fs::copy(staged, &beside).map_err(Error::io("write", &beside))?;
        File::open(&beside).and_then(|f| f.sync_all()).map_err(Error::io("sync", &beside))?;
        fs::rename(&beside, place).map_err(Error::io("write", place))
    }

    /// Writes one file under a temporary name, syncs and renames it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, name: &str, content: &[u8]) -> Result<(), Error> {
        write_atomically(
            &self.path.join(name),
            &self.path.join(PRIVATE).join(format!("tmp-{}", name.replace('/', "-"))),
            content,
        )
    }

    /// Where the checkpoint of a stage is.
    pub fn checkpoint(&self, stage: &str) -> PathBuf {
        self.scratch.join(format!("{stage}.columns"))
    }

    /// Writes the checkpoint of a stage under a temporary name and renames it.
    ///
    /// # Errors
    /// [`checkpoint::Error::Io`].
    pub(super) fn keep(&self, stage: &str, columns: &checkpoint::Writer) -> Result<(), checkpoint::Error> {
        let temporary = self.scratch.join(format!("tmp-{stage}-checkpoint"));
        columns.write(&temporary)?;
        let place = self.checkpoint(stage);
        fs::rename(&temporary, &place).map_err(|source| checkpoint::Error::Io { path: place.clone(), source })
    }

    /// The record of a stage; `None` when it has none that reads.
    pub fn record(&self, stage: &str) -> Option<Record> {
        read_record(&self.path, stage)
    }

    /// Forgets a stage: it is not finished any more.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn forget(&self, stage: &str) -> Result<(), Error> {
        for path in [self.path.join(PRIVATE).join(format!("{stage}.json")), self.checkpoint(stage)] {
            match fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io("remove", &path)(e)),
                _ => {}
            }
        }
        Ok(())
    }

    /// Removes a file of the folder if it is there.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        let path = self.path.join(name);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io("remove", &path)(e)),
            _ => Ok(()),
        }
    }

    /// Notes that a stage is finished.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(&self, stage: &str, record: &Record) -> Result<(), Error> {
        let text = serde_json::to_vec_pretty(record).expect("a record is plain data");
        self.write(&format!("{PRIVATE}/{stage}.json"), &text)
    }

    /// Whether all files of a record are there with their length.
    pub fn has_files(&self, record: &Record) -> bool {
        record.files.iter().all(|f| fs::metadata(self.path.join(&f.name)).is_ok_and(|m| m.len() == f.bytes))
    }
}

/// Removes what an interrupted run left under temporary names.
fn remove_leftovers(folder: &Path) -> Result<(), Error> {
    for entry in fs::read_dir(folder).map_err(Error::io("list", folder))?.flatten() {
        if entry.file_name().to_string_lossy().starts_with("tmp-") {
            let leftover = entry.path();
            let removed = if leftover.is_dir() { fs::remove_dir_all(&leftover) } else { fs::remove_file(&leftover) };
            removed.map_err(Error::io("remove the leftover", &leftover))?;
        }
    }
    Ok(())
}

/// The stage that the journal begins but neither finishes nor fails, in its last run. Torn lines count as not written.
fn interrupted_in(private: &Path) -> Option<String> {
    let text = fs::read_to_string(private.join(JOURNAL)).ok()?;
    // Stages ask for each other, so several can be begun at a time.
    let mut begun: Vec<String> = Vec::new();
    for line in text.lines().filter_map(|l| serde_json::from_str::<serde_json::Value>(l).ok()) {
        let stage = line.get("stage").and_then(|s| s.as_str()).unwrap_or("");
        match line.get("event").and_then(|e| e.as_str()) {
            Some("run-begun") => begun = vec!["ingest".to_owned()],
            Some("stage-begun") => begun.push(stage.to_owned()),
            Some("stage-finished") => begun.retain(|s| s != stage),
            Some("run-finished" | "run-failed") => begun.clear(),
            _ => {}
        }
    }
    begun.pop()
}

/// Removes a run folder that nobody works in, with its scratch folder.
///
/// # Errors
/// [`Error::Locked`] while somebody does, [`Error::Io`].
pub fn remove(path: &Path) -> Result<(), Error> {
    drop(RunFolder::open(path)?);
    let scratch = fs::read_to_string(path.join(PRIVATE).join(SCRATCH_NOTE)).map(PathBuf::from);
    // A note that was damaged must not remove anything else.
    let named = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with("adit-"));
    if let Ok(scratch) = scratch
        && named(&scratch)
        && scratch.is_dir()
    {
        fs::remove_dir_all(&scratch).map_err(Error::io("remove", &scratch))?;
    }
    fs::remove_dir_all(path).map_err(Error::io("remove", path))
}

/// The record of a stage in a run folder; `None` when it has none that reads.
pub fn read_record(folder: &Path, stage: &str) -> Option<Record> {
    let text = fs::read(folder.join(PRIVATE).join(format!("{stage}.json"))).ok()?;
    serde_json::from_slice(&text).ok()
}

/// Hash of a file's content, in hexadecimal.
///
/// # Errors
/// [`Error::Io`].
pub fn sha256_of(path: &Path) -> Result<String, Error> {
    let mut file = File::open(path).map_err(Error::io("read", path))?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        let read = file.read(&mut buffer).map_err(Error::io("read", path))?;
        if read == 0 {
            return Ok(hexadecimal(&hash.finalize()));
        }
        hash.update(&buffer[..read]);
    }
}

/// One hash for several files in their order: that of the only file, or the hash over all hashes.
pub fn sha256_of_all(hashes: &[String]) -> String {
    match hashes {
        [one] => one.clone(),
        _ => sha256_of_bytes(hashes.concat().as_bytes()),
    }
}

/// Hash of bytes, in hexadecimal.
pub fn sha256_of_bytes(bytes: &[u8]) -> String {
    hexadecimal(&Sha256::digest(bytes))
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// Writes a file so that it is either the old one or the whole new one, whatever happens meanwhile.
///
/// # Errors
/// [`Error::Io`].
pub fn write_atomically(path: &Path, temporary: &Path, content: &[u8]) -> Result<(), Error> {
    let mut file = File::create(temporary).map_err(Error::io("write", temporary))?;
    file.write_all(content).and_then(|()| file.sync_all()).map_err(Error::io("write", temporary))?;
    drop(file);
    fs::rename(temporary, path).map_err(Error::io("write", path))?;
    if let Some(folder) = path.parent() {
        sync_folder(folder);
    }
    Ok(())
}

/// Puts renames on disk. Not every file system can; a rename that is lost in a power cut leaves the old state, whole.
fn sync_folder(path: &Path) {
    if let Ok(folder) = File::open(path) {
        let _ = folder.sync_all();
    }
}

fn collect_files(folder: &Path, prefix: &str, names: &mut Vec<String>) -> Result<(), Error> {
    for entry in fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let entry = entry.map_err(Error::io("list", folder))?;
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        if entry.path().is_dir() {
            collect_files(&entry.path(), &format!("{name}/"), names)?;
        } else {
            names.push(name);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_process_is_told_who_holds_the_folder() {
        let place = tempfile::tempdir().unwrap();
        let first = RunFolder::open(place.path()).unwrap();
        // File locks belong to the open file, so a second handle stands for a second process.
        let error = RunFolder::open(place.path()).unwrap_err();
        assert!(error.to_string().contains(&format!("process {}", std::process::id())), "{error}");
        drop(first);
        RunFolder::open(place.path()).unwrap();
    }

    #[test]
    fn products_appear_whole_and_leftovers_vanish() {
        let place = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(place.path()).unwrap();
        let staging = folder.staging("map").unwrap();
        fs::create_dir(staging.join("map")).unwrap();
        fs::write(staging.join("map/a.png"), b"abc").unwrap();
        assert!(!place.path().join("map/a.png").exists());
        let files = folder.publish(&staging).unwrap();
        assert_eq!(files[0].name, "map/a.png");
        assert_eq!(files[0].sha256, sha256_of_bytes(b"abc"));
        assert_eq!(fs::read(place.path().join("map/a.png")).unwrap(), b"abc");
        let half = folder.staging("points").unwrap();
        fs::write(half.join("points.laz"), b"half").unwrap();
        drop(folder);
        RunFolder::open(place.path()).unwrap();
        assert!(!half.exists() && !place.path().join("points.laz").exists());
    }

    #[test]
    fn the_journal_tells_where_a_run_was_interrupted() {
        let place = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(place.path()).unwrap();
        folder.note("run-begun", serde_json::json!({})).unwrap();
        folder.note("stage-begun", serde_json::json!({ "stage": "mesh" })).unwrap();
        // A torn line.
        let path = place.path().join(".adit/journal.jsonl");
        fs::write(&path, fs::read_to_string(&path).unwrap() + "\n{\"event\": \"run-fin").unwrap();
        drop(folder);
        let folder = RunFolder::open(place.path()).unwrap();
        assert_eq!(folder.interrupted(), Some("mesh"));
        folder.note("run-finished", serde_json::json!({})).unwrap();
        drop(folder);
        assert_eq!(RunFolder::open(place.path()).unwrap().interrupted(), None);
    }

    #[test]
    fn a_scratch_folder_elsewhere_holds_what_is_no_product() {
        let (place, tmp) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let run = place.path().join("run");
        let folder = RunFolder::open_with_scratch(&run, Some(tmp.path())).unwrap();
        let staging = folder.staging("mesh").unwrap();
        assert!(staging.starts_with(tmp.path()) && folder.checkpoint("mesh").starts_with(tmp.path()));
        fs::write(staging.join("mesh.ply"), b"ply").unwrap();
        fs::write(folder.checkpoint("mesh"), b"columns").unwrap();
        folder.publish(&staging).unwrap();
        assert_eq!(fs::read(run.join("mesh.ply")).unwrap(), b"ply");
        drop(folder);
        remove(&run).unwrap();
        assert!(!run.exists() && fs::read_dir(tmp.path()).unwrap().next().is_none());
    }

    #[test]
    fn inputs_are_never_overwritten() {
        let place = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(place.path()).unwrap();
        let input = place.path().join("points.laz");
        fs::write(&input, b"scan").unwrap();
        assert!(matches!(folder.refuse_inputs_inside(&[input], &["points.laz"]), Err(Error::InputInside { .. })));
    }
}
