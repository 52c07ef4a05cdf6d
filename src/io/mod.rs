//! Where scans come from and where products go: one file per format.
//!
//! Reading is complete and suspicious: no count in a header is believed before the file is known to hold it, panics in
//! decoders end as bad input, and whatever is dropped, scaled or guessed is counted in the [`Summary`].

mod announce;
mod assemble;
mod crs;
mod detect;
pub mod drawing;
mod e57;
mod error;
#[cfg(test)]
mod example;
mod file_scan;
pub mod geotiff;
mod guards;
mod inspect;
mod label_column;
mod las;
mod map_folder;
mod neighbourhood;
pub mod ply;
mod mesh_formats;
mod mesh_scan;
pub mod picture;
pub mod png;
pub mod raster_pixels;
mod package_file;
mod pcd;
mod part;
mod placed_points;
mod point_table;
mod poses;
mod quiet_panics;
pub mod raster_file;
mod source_bytes;
pub mod vector;
mod scan_date;
mod tile_pyramid;
mod stations;
mod stream;
mod unit_guess;
pub mod world_file;
mod text;
mod write;

pub use announce::{Announcement, announce, announce_part};
pub use assemble::{FileSummary, Summary, read_cloud, read_part};
pub use error::{Error, ErrorKind};
pub use file_scan::{AttributeInfo, Settings, Unit};
pub use guards::PointGuards;
pub use inspect::{ScanInfo, StationInfo, inspect};
pub use map_folder::{LabelsFile, MapFolder, write_picture};
pub use mesh_scan::{MeshSummary, RawMesh, read_mesh};
pub use package_file::{PackageError, PackageFile};
pub use part::Part;
pub use placed_points::{PlacedPoint, placed_points};
pub use poses::{Pose, PoseEntry, write_poses};
pub use scan_date::las_creation_date;
pub use stations::{StationOverlap, StationScan, read_stations};
pub use stream::{ScanBox, stream_positions};
pub use write::{NO_CLASS, PointColumns, WriteSummary, write_cloud, write_cloud_in_steps, write_points};

#[cfg(test)]
mod tests;
