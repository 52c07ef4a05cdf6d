//! Which points are wall: the mean section along the axis, and what does not belong to it.
