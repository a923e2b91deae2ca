//! Runs of the Reveille machines in memory, without a bus.

pub mod adjusted;
pub mod figures;
pub mod run;
