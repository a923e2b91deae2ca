//! Sweeps: a grid of scenario fields × policies × seeds, run in parallel, one row per run.
//!
//! An [`ExperimentBuilder`] holds the fields of a file and the command line. [`ExperimentBuilder::build`] creates an
//! [`Experiment`] from it, [`SweepGrid::new`] the cells with checked scenarios, and [`Sweep`] runs them in a folder.
//! `reveille sweep`, `merge` and `train record` and the Python package call these items; the module `journal` is public
//! for the fuzz target `files`.
//!
//! Results depend on the experiment, the files that it names, and the version of the program: not on the number of
//! threads, on interruptions, or on the shards. Every cell has the same seeds, so policies are compared on the same
//! deployments, harvests and event places.

mod error;
mod executor;
mod experiment;
mod experiment_builder;
mod folder;
mod grid;
pub mod journal;
mod merge;
mod shard;

pub use error::SweepError;
pub use executor::{CellSummary, SweepProgress};
pub use experiment::{Experiment, Seeds, SweepActions, SweepAxis, UntilCi};
pub use experiment_builder::ExperimentBuilder;
pub use folder::{ReusableRuns, Sweep, SweepResult, experiment_hash, find_table, read_seed_count};
pub use grid::{GridCell, SweepGrid};
pub use merge::merge;
pub use shard::Shard;

#[cfg(test)]
mod tests;
