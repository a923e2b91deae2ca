//! Models that several policies share: ages, coverage, clusters, rankings and beliefs about events.

pub mod ages;
pub mod candidates;
pub mod clusters;
pub mod correlation;
pub mod coverage;
pub(crate) mod grid;
pub(crate) mod information_target;
mod neighbours;
pub mod posterior;
pub mod ranking;
pub mod reward;
