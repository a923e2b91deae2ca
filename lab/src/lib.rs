//! Runs of the Reveille machines in memory, without a bus: one, or a whole sweep with its result table.

pub mod adjusted;
pub mod figures;
pub mod run;
pub mod stats;
pub mod table;
