//! `reveille bench`: speed against stated baselines, both sides in one go.

mod bare;
mod barrier;
mod bus;
mod memory;
mod played;
mod scale;
mod watch;

use std::process::ExitCode;

use crate::cli::BenchCommand;

/// Runs the benchmark that `command` names.
pub fn run(command: &BenchCommand) -> anyhow::Result<ExitCode> {
    match command {
        BenchCommand::Bus(args) => bus::run(args),
        BenchCommand::Memory(args) => memory::run(args),
        BenchCommand::Scale(args) => scale::run(args),
        BenchCommand::Watch(args) => watch::run(args),
        BenchCommand::BareHost {
            kind,
            at,
            sizes,
            number,
        } => bare::host(kind, at, *sizes, *number),
    }
}
