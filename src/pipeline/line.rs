//! What every stage of a run gets besides its own work: laziness, timing, peak memory, saving, resume, progress.
//!
//! A [`Product`] is made when somebody asks for it, unless the run folder holds it already under the same key. The key
//! of a stage is the hash of its algorithm's version, its settings and the keys of what it builds on, so a change
//! anywhere makes stale exactly what depends on it.

use super::checkpoint::{self, Checkpoint};
use super::error::{Error, StageError};
use super::run_folder::{ProductFile, Record, RunFolder, sha256_of_bytes};
use crate::warning::Warning;
use serde::Serialize;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

/// A stage: its name everywhere, the version of its algorithm (raised when its result changes), what it builds on.
#[derive(Debug, PartialEq, Eq)]
pub struct Stage {
    /// Name of the module, the table, the section of the report.
    pub name: &'static str,
    /// Version of the algorithm.
    pub version: u32,
    /// Stages whose products it uses.
    pub needs: &'static [&'static str],
}

/// Hears what happens during a run.
pub trait Observer {
    /// A stage begins.
    fn started(&self, stage: &'static str);
    /// A stage has ended, or was found finished (`reused`).
    fn finished(&self, stage: &'static str, seconds: f64, reused: bool);
    /// A stage has something to say.
    fn warned(&self, stage: &'static str, warning: &Warning);
    /// The last process that worked in the folder died during this stage; the run goes on from there.
    fn resumed(&self, stage: &str);
}

/// What decides a stage's result.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) stage: &'static Stage,
    pub(super) key: String,
    pub(super) settings: serde_json::Value,
    pub(super) inputs: BTreeMap<String, String>,
}

/// Plans all stages: `settings` and `files` (name and hash of what a stage reads from disk) by stage.
pub(super) fn plan(
    stages: &'static [Stage],
    settings: impl Fn(&str) -> serde_json::Value,
    files: impl Fn(&str) -> BTreeMap<String, String>,
) -> Vec<Plan> {
    let mut plans: Vec<Plan> = Vec::new();
    for stage in stages {
        let mut inputs = files(stage.name);
        for need in stage.needs {
            let other = plans.iter().find(|p| p.stage.name == *need).expect("stages are listed in their order");
            inputs.insert((*need).to_owned(), other.key.clone());
        }
        let settings = settings(stage.name);
        let text = serde_json::to_vec(&(stage.name, stage.version, &settings, &inputs)).expect("plain data");
        plans.push(Plan { stage, key: sha256_of_bytes(&text), settings, inputs });
    }
    plans
}

/// The state of a run while its stages are worked through.
pub(super) struct Line<'a> {
    folder: &'a RunFolder,
    observer: &'a dyn Observer,
    plans: Vec<Plan>,
    /// Records of finished stages, fresh ones from disk included.
    records: RefCell<BTreeMap<&'static str, Record>>,
    /// Seconds spent in stages that were asked for by the stage at work.
    nested_seconds: Cell<f64>,
    worked: Cell<bool>,
}

impl<'a> Line<'a> {
    pub(super) fn new(folder: &'a RunFolder, observer: &'a dyn Observer, plans: Vec<Plan>) -> Self {
        let mut records = BTreeMap::new();
        for plan in &plans {
            if let Some(record) = folder.record(plan.stage.name)
                && record.key == plan.key
                && folder.has_files(&record)
            {
                records.insert(plan.stage.name, record);
            }
        }
        Self { folder, observer, plans, records: records.into(), nested_seconds: 0.0.into(), worked: false.into() }
    }

    pub(super) fn folder(&self) -> &RunFolder {
        self.folder
    }

    pub(super) fn plans(&self) -> &[Plan] {
        &self.plans
    }

    pub(super) fn plan(&self, stage: &str) -> &Plan {
        self.plans.iter().find(|p| p.stage.name == stage).expect("every stage is planned")
    }

    pub(super) fn is_fresh(&self, stage: &str) -> bool {
        self.records.borrow().contains_key(stage)
    }

    /// Whether any stage had to work.
    pub(super) fn has_worked(&self) -> bool {
        self.worked.get()
    }

    pub(super) fn record(&self, stage: &str) -> Option<Record> {
        self.records.borrow().get(stage).cloned()
    }

    /// A product that is made by `make` when needed and saved as a checkpoint.
    pub(super) fn product<T: Checkpoint + 'a>(
        &'a self,
        stage: &'static str,
        make: impl Fn(&Path) -> Result<(T, serde_json::Value), Error> + 'a,
    ) -> Product<'a, T> {
        Product { line: self, stage, value: RefCell::new(None), make: Box::new(make), keep: Some((T::save, T::load)) }
    }

    /// A product that is cheaper to make again than to keep.
    pub(super) fn passing<T: 'a>(
        &'a self,
        stage: &'static str,
        make: impl Fn(&Path) -> Result<(T, serde_json::Value), Error> + 'a,
    ) -> Product<'a, T> {
        Product { line: self, stage, value: RefCell::new(None), make: Box::new(make), keep: None }
    }

    /// Runs two stages that leave nothing but files at the same time, for those that do not keep all threads busy. The
    /// time that both took is divided in the ratio of what each took. One that succeeds is finished even if the other
    /// fails.
    pub(super) fn side_by_side(&self, works: [(&'static str, Work); 2]) -> Result<(), Error> {
        let begun = Instant::now();
        let folder = self.folder;
        let [first, second] = works.map(|(stage, work)| (stage, work, self.begin(stage)));
        let run = |(stage, work, staging): (&'static str, Work, Result<PathBuf, Error>)| {
            let begun = Instant::now();
            let done = staging.and_then(|staging| {
                let ((), summary) = work(&staging)?;
                Ok((folder.publish(&staging)?, summary))
            });
            (stage, done, begun.elapsed().as_secs_f64())
        };
        let (first, second) = rayon::join(|| run(first), || run(second));
        let wall_per_second = begun.elapsed().as_secs_f64() / (first.2 + second.2).max(f64::MIN_POSITIVE);
        [first, second]
            .into_iter()
            .map(|(stage, done, seconds)| {
                let (files, summary) = done?;
                self.end(stage, files, summary, seconds * wall_per_second)
            })
            // All of them, and then the first error.
            .fold(Ok(()), Result::and)
    }

    /// Makes the staging folder of a stage that begins to work.
    fn begin(&self, stage: &'static str) -> Result<PathBuf, Error> {
        if !self.is_fresh(stage) {
            self.worked.set(true);
            // From here on the folder is on its way to another state: an old verdict would lie about it.
            self.folder.forget("report")?;
            self.folder.forget(stage)?;
            self.folder.remove("report.json")?;
        }
        let staging = self.folder.staging(stage)?;
        self.folder.note("stage-begun", serde_json::json!({ "stage": stage }))?;
        self.observer.started(stage);
        Ok(staging)
    }

    /// Records a stage whose files are in place.
    fn end(
        &self,
        stage: &'static str,
        files: Vec<ProductFile>,
        summary: serde_json::Value,
        seconds: f64,
    ) -> Result<(), Error> {
        for warning in warnings_of(&summary) {
            self.observer.warned(stage, &warning);
        }
        let plan = self.plan(stage);
        let record = Record {
            key: plan.key.clone(),
            version: plan.stage.version,
            settings: plan.settings.clone(),
            inputs: plan.inputs.clone(),
            files,
            summary,
            seconds,
            peak_memory_bytes: peak_memory_bytes(),
        };
        self.folder.finish(stage, &record)?;
        self.records.borrow_mut().insert(stage, record);
        self.observer.finished(stage, seconds, false);
        Ok(self.folder.note("stage-finished", serde_json::json!({ "stage": stage, "again": false }))?)
    }
}

/// What one of two stages side by side does in its staging folder; it tells its section of the report.
pub(super) type Work<'w> = &'w (dyn Fn(&Path) -> Result<((), serde_json::Value), Error> + Sync);

type Make<'a, T> = Box<dyn Fn(&Path) -> Result<(T, serde_json::Value), Error> + 'a>;
type Keep<T> = (fn(&T, &mut checkpoint::Writer), fn(&checkpoint::Reader) -> Result<T, checkpoint::Error>);

/// The product of a stage: in memory, on disk, or still to be made.
pub(super) struct Product<'a, T> {
    line: &'a Line<'a>,
    stage: &'static str,
    value: RefCell<Option<Rc<T>>>,
    make: Make<'a, T>,
    keep: Option<Keep<T>>,
}

impl<T> Product<'_, T> {
    /// The product; made, or read from its checkpoint, if it is not in memory.
    pub(super) fn get(&self) -> Result<Rc<T>, Error> {
        if let Some(value) = self.value.borrow().as_ref() {
            return Ok(value.clone());
        }
        let value = Rc::new(self.load_or_make()?);
        *self.value.borrow_mut() = Some(value.clone());
        Ok(value)
    }

    /// The product by value, out of memory here.
    pub(super) fn take(&self) -> Result<T, Error>
    where
        T: Clone,
    {
        let value = self.get()?;
        self.release();
        Ok(Rc::try_unwrap(value).unwrap_or_else(|shared| (*shared).clone()))
    }

    /// Lets go of the memory; a later [`Self::get`] reads the checkpoint or makes the product again.
    pub(super) fn release(&self) {
        self.value.borrow_mut().take();
    }

    /// Makes the product unless the stage is finished.
    pub(super) fn ensure(&self) -> Result<(), Error> {
        if self.line.is_fresh(self.stage) {
            return Ok(());
        }
        self.get().map(|_| ())
    }

    fn load_or_make(&self) -> Result<T, Error> {
        let line = self.line;
        let begun = Instant::now();
        let nested_before = line.nested_seconds.replace(0.0);
        let fresh = line.is_fresh(self.stage);
        if fresh
            && let Some((_, load)) = self.keep
            && let Ok(value) = checkpoint::Reader::open(&line.folder.checkpoint(self.stage)).and_then(|r| load(&r))
        {
            line.nested_seconds.set(nested_before + begun.elapsed().as_secs_f64());
            return Ok(value);
        }
        let staging = line.begin(self.stage)?;
        let (value, summary) = (self.make)(&staging)?;
        if fresh {
            // Its products are in place already.
            line.folder.discard(&staging)?;
            line.folder.note("stage-finished", serde_json::json!({ "stage": self.stage, "again": true }))?;
        } else {
            let columns = self.keep.map(|(save, _)| {
                let mut columns = checkpoint::Writer::default();
                save(&value, &mut columns);
                columns
            });
            // Both wait for the disk.
            let (stage, folder) = (self.stage, line.folder);
            let (kept, files) = rayon::join(
                || columns.map_or(Ok(()), |columns| folder.keep(stage, &columns).map_err(Error::in_stage(stage))),
                || folder.publish(&staging),
            );
            kept?;
            let files = files?;
            let seconds = begun.elapsed().as_secs_f64() - line.nested_seconds.get();
            line.end(self.stage, files, summary, seconds)?;
        }
        line.nested_seconds.set(nested_before + begun.elapsed().as_secs_f64());
        Ok(value)
    }
}

/// A summary as the section of the report.
pub(super) fn section<S: Serialize>(summary: &S) -> serde_json::Value {
    serde_json::to_value(summary).expect("summaries are plain data")
}

/// Turns a stage's own result into what the line wants.
pub(super) fn done<T, S: Serialize, E: StageError>(
    stage: &'static str,
    result: Result<(T, S), E>,
) -> Result<(T, serde_json::Value), Error> {
    let (value, summary) = result.map_err(Error::in_stage(stage))?;
    Ok((value, section(&summary)))
}

/// The warnings of a section of the report.
pub(super) fn warnings_of(summary: &serde_json::Value) -> Vec<Warning> {
    summary.get("warnings").and_then(|w| serde_json::from_value(w.clone()).ok()).unwrap_or_default()
}

/// Greatest resident memory of this process so far, bytes; 0 where the system does not tell.
pub fn peak_memory_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()).map_or(0, |kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    struct Silent;

    impl Observer for Silent {
        fn started(&self, _: &'static str) {}
        fn finished(&self, _: &'static str, _: f64, _: bool) {}
        fn warned(&self, _: &'static str, _: &Warning) {}
        fn resumed(&self, _: &str) {}
    }

    const STAGES: &[Stage] =
        &[Stage { name: "one", version: 1, needs: &[] }, Stage { name: "two", version: 1, needs: &[] }];

    #[test]
    fn of_two_stages_side_by_side_the_one_that_succeeds_is_finished() {
        let place = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(place.path()).unwrap();
        let line = || Line::new(&folder, &Silent, plan(STAGES, |_| json!(null), |_| BTreeMap::new()));
        let refuse = |_: &Path| Err(Error::NoInput);
        let write = |staging: &Path| {
            std::fs::write(staging.join("a.txt"), "a").unwrap();
            Ok(((), json!({ "letters": 1 })))
        };
        let first = line();
        let error = first.side_by_side([("one", &refuse), ("two", &write)]).unwrap_err();
        assert!(matches!(error, Error::NoInput) && first.has_worked());
        let next = line();
        assert!(!next.is_fresh("one") && next.is_fresh("two"));
        assert_eq!(next.record("two").unwrap().summary["letters"], 1);
        assert_eq!(std::fs::read(place.path().join("a.txt")).unwrap(), b"a");
        next.side_by_side([("one", &write), ("two", &write)]).unwrap();
        assert!(next.is_fresh("one") && line().is_fresh("one"));
    }
}
