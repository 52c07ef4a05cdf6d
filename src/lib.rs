//! Adit turns a laser scan of a tunnel into a flat, metric map, and whatever is drawn on that map back into the scan.
//!
//! The module list below is the table of contents, in the order in which a scan flows through the program.
//! A module uses only the modules above it (`tests/architecture.rs` checks that).

// What everything stands on.
pub mod warning;
pub mod numeric;
pub mod spatial;

// What happens to a scan, in order.
pub mod cloud;
pub mod register;
pub mod clean;
pub mod axis;
pub mod normals;
pub mod segment;
pub mod mesh;
pub mod cut;
pub mod unwrap;
pub mod map;
pub mod linework;
pub mod lift;
pub mod planes;

// Where scans come from and where products go.
pub mod synthetic;
pub mod io;
pub mod pipeline;
pub mod cli;
