//! Sweeps: a grid of scenario fields × policies × seeds, run in parallel, one row per run.
//!
//! A [`Draft`] is what a file and the command line say; [`Draft::finish`] makes an [`Experiment`] of it, [`Grid::new`]
//! the cells with their scenarios checked, and [`Sweep`] runs them in a folder. Results depend on nothing but the
//! experiment: not on the number of threads, on interruptions, or on how runs were dealt to shards.
//!
//! Every cell has the same seeds, so that policies are compared on the same deployments, events and harvests.

mod draft;
mod engine;
mod error;
mod experiment;
mod folder;
mod grid;
mod io;
pub mod journal;
mod merge;
mod reuse;
mod shard;

#[cfg(test)]
mod tests;

pub use draft::Draft;
pub use engine::{CellEnd, SweepProgress};
pub use error::SweepError;
pub use experiment::{Axis, Experiment, Seeds, UntilCi};
pub use folder::{Finished, Sweep, hash, seeds_in, table_in};
pub use grid::{Cell, Grid};
pub use merge::merge;
pub use reuse::Known;
pub use shard::Shard;
