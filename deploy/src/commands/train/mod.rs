//! `reveille train`: training in memory, and the recording of training data. `docs/training.md` explains the use.

#[cfg(feature = "train-dt")]
mod dt;
mod q_learning;
mod record;

use std::process::ExitCode;

use crate::cli::TrainCommand;

/// Runs the requested training or recording.
pub(crate) fn run(command: &TrainCommand) -> anyhow::Result<ExitCode> {
    match command {
        TrainCommand::QLearning(args) => q_learning::run(args),
        #[cfg(feature = "train-dt")]
        TrainCommand::Dt(args) => dt::run(args),
        #[cfg(not(feature = "train-dt"))]
        TrainCommand::Dt(_) => Ok(report_missing_feature()),
        TrainCommand::Record(args) => record::run(args),
    }
}

/// Explains how to build with `reveille train dt`; exit code 2.
#[cfg(not(feature = "train-dt"))]
fn report_missing_feature() -> ExitCode {
    crate::display::note!(
        "reveille: this build cannot train dt, which needs the cargo feature train-dt (150 more crates); use `cargo \
         run --release --features train-dt -- train dt …`"
    );
    crate::exit::ExitReason::Usage.into()
}
