//! Adit turns a laser scan of a tunnel into a flat, metric map, and whatever is drawn on that map back into the scan.
//!
//! The module list below is the table of contents, in the order in which a scan flows through the program.
//! A module uses only the modules above it (`tests/architecture.rs` checks that).

// What everything stands on.
pub mod numeric;
pub mod spatial;
pub mod warning;

// What happens to a scan, in order.
pub mod axis;
pub mod clean;
pub mod cloud;
pub mod cut;
pub mod lift;
pub mod map;
pub mod mesh;
pub mod normals;
pub mod segment;
pub mod unwrap;

// Where scans come from and where products go.
pub mod cli;
pub mod io;
pub mod pipeline;
pub mod synthetic;
