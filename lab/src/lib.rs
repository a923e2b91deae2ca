//! Runs of the Reveille machines in memory, without a bus: one, or a whole sweep with its result table; trajectories,
//! training and tuning.

mod coming;
pub mod gym;
pub mod inputs;
pub mod io;
pub mod mark;
pub mod preparation;
pub mod reading;
pub mod run;
pub mod series;
pub mod shadow;
pub mod stats;
pub mod stepping;
pub mod sweep;
pub mod table;
pub mod training;
pub mod trajectories;
#[cfg(feature = "train-dt")]
pub mod transformer;
pub mod tuning;
