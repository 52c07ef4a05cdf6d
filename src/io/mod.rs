//! Reading and writing files: one file of this folder per format.
