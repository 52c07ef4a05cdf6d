//! From a raw scan to the points that carry the geometry; every dropped point is counted by reason.
