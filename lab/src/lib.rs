//! Runs of the Reveille machines in memory, without a bus, and what the paper's analysis says of them.

pub mod adjusted;
pub mod analysis;
pub mod run;
