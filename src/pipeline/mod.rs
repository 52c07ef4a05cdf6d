//! The whole run: pipeline file, stages in order, limits, report, run folder.
