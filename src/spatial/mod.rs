//! Where points are: nearest neighbours and voxels, deterministic for any thread count.

pub mod kd_tree;
pub mod nearest;
pub mod voxel_grid;

pub use kd_tree::{KdTree, Neighbour};
pub use voxel_grid::VoxelGrid;
