//! `reveille inspect`: the messages of a live or recorded run, and the missed events of a run folder (`misses`). Each
//! subcommand has one file. `source` provides the frames, `live` connects to a run, and `catch_up` replays the TTIs
//! before the connection. The dashboard uses these three too, and other commands open recordings with `source`.

mod catch_up;
mod export;
mod frame_stream;
pub(crate) mod live;
mod misses;
mod passed_frames;
mod record;
pub(crate) mod source;
mod stats;
mod tail;
mod verify;

use std::process::ExitCode;

use crate::cli::InspectCommand;

/// Runs an inspection.
pub(crate) async fn run(command: &InspectCommand) -> anyhow::Result<ExitCode> {
    match command {
        InspectCommand::Tail(args) => tail::run(args).await,
        InspectCommand::Stats(args) => stats::run(args).await,
        InspectCommand::Record(args) => record::run(args).await,
        InspectCommand::Export(args) => export::run(args),
        InspectCommand::Verify(args) => verify::run(args),
        InspectCommand::Misses(args) => misses::run(args),
    }
}
