//! The whole run: pipeline file, stages in order, limits, report, run folder.

mod checkpoint;
mod error;
mod explain;
mod known_keys;
pub mod limits;
mod line;
mod page;
mod picture;
pub mod reference;
pub mod report;
mod run;
pub mod run_folder;
pub mod series;
pub mod settings;

pub use error::{Error, Kind};
pub use explain::Explanation;
pub use line::{Observer, Stage, reset_peak_memory};
pub use run::{MESH_STAGES, Outcome, Redo, STAGES, axis_csv, explain, is_mesh, run, run_to_surface};
pub use settings::Pipeline;
