//! `reveille inspect`: the messages of a run, as they go or from a recording.

mod compare;
mod export;
pub mod live;
mod past;
mod record;
pub mod source;
mod stats;
mod tail;
mod verify;

use std::process::ExitCode;

use crate::cli::InspectCommand;

/// Looks at a run.
pub async fn run(command: &InspectCommand) -> anyhow::Result<ExitCode> {
    match command {
        InspectCommand::Tail(args) => tail::run(args).await,
        InspectCommand::Stats(args) => stats::run(args).await,
        InspectCommand::Record(args) => record::run(args).await,
        InspectCommand::Export(args) => export::run(args),
        InspectCommand::Verify(args) => verify::run(args),
        InspectCommand::Compare(args) => compare::run(args),
    }
}
