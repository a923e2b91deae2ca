//! `reveille bench`: speed against baselines that are measured in the same call. Runs of the emulator are timed by the
//! fields of `timing` in their `summary.json`.

mod bare;
mod barrier;
mod bus;
mod memory;
mod scale;
mod study;
mod watch;

use std::process::ExitCode;

use rustix::process::Signal;

use crate::child_process;
use crate::cli::BenchCommand;

/// Runs the benchmark `command`.
pub(crate) fn run(command: &BenchCommand) -> anyhow::Result<ExitCode> {
    match command {
        BenchCommand::Bus(args) => bus::run(args),
        BenchCommand::Memory(args) => memory::run(args),
        BenchCommand::Scale(args) => scale::run(args),
        BenchCommand::Study(args) => study::run(args),
        BenchCommand::Watch(args) => watch::run(args),
        BenchCommand::BareHost {
            kind,
            at,
            sizes,
            number,
            parent,
        } => {
            // A host that connects while its parent ends never sees the parent's liveliness, and would wait for ever.
            child_process::exit_with_parent(*parent, Signal::KILL)?;
            bare::host(kind, at, *sizes, *number)
        }
    }
}
