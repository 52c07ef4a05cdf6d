//! The whole run: pipeline file, stages in order, limits, report, run folder.

mod arrivals;
mod checkpoint;
mod error;
mod explain;
mod folder_lock;
mod judge;
mod known_keys;
pub mod limits;
mod line;
mod page;
mod picture;
mod plan_view;
mod plots;
pub mod preflight;
mod profile;
pub mod reference;
pub mod report;
mod run;
pub mod run_folder;
pub mod series;
mod series_page;
pub mod settings;

pub use arrivals::{Patience, Readiness, Scan};
pub use error::{Error, Kind};
pub use explain::Explanation;
pub use line::{Observer, Stage, peak_memory_bytes};
pub use run::{MESH_STAGES, Options, Outcome, Redo, STAGES, axis_csv, explain, is_mesh, run, run_to_surface};
pub use settings::Pipeline;
