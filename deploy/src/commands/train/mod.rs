//! `reveille train`: learning in memory, and recording what is learned from.

#[cfg(feature = "train-dt")]
mod dt;
#[cfg(not(feature = "train-dt"))]
#[path = "without_dt.rs"]
mod dt;
mod q_learning;
mod record;

use std::process::ExitCode;

use crate::cli::TrainCommand;

pub use q_learning::Interrupted;

/// Trains or records what is asked for.
pub fn run(command: &TrainCommand) -> anyhow::Result<ExitCode> {
    match command {
        TrainCommand::QLearning(args) => q_learning::run(args),
        TrainCommand::Dt(args) => dt::run(args),
        TrainCommand::Record(args) => record::run(args),
    }
}
