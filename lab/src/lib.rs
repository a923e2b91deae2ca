//! Runs of the Reveille machines in memory, without a bus: one, or a whole sweep with its result table; what the paper's
//! analysis says of them; and figures and a report that hold them against the paper.

pub mod adjusted;
pub mod analysis;
pub mod figures;
pub mod report;
pub mod run;
pub mod stats;
pub mod sweep;
pub mod table;
pub mod training;
pub mod tuning;
