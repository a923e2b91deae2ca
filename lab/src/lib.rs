//! Runs of the Reveille machines in memory, without a bus: one, or a whole sweep with its result table; and what the paper's
//! analysis says of them.

pub mod adjusted;
pub mod analysis;
pub mod run;
pub mod stats;
pub mod sweep;
pub mod table;
