//! Drawing the flat map: rasters of every layer, tile by tile.
