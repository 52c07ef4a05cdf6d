//! Spatial searches: who is near whom.
