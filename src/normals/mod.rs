//! Unit normals that face the void.
