//! The way back: what was drawn on the map becomes labels on points and faces.
