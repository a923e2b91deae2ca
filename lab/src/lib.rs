//! Runs of the Reveille machines in memory, without a bus: single runs, sweeps with their result tables, trajectories,
//! training and tuning.

pub mod external_inputs;
pub mod gym;
pub mod io;
pub mod metric_estimate;
pub mod preparation;
pub mod replay;
pub mod resume_mark;
pub mod run;
pub mod series;
pub mod stats;
pub mod stepped_run;
pub mod sweep;
pub mod table;
pub mod training;
pub mod trajectories;
#[cfg(feature = "train-dt")]
pub mod transformer;
pub mod tuning;
