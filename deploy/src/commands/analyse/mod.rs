//! `reveille analyse`: the paper's analysis beside what the machines do.

mod battery;
mod harvest;
mod imin;
mod lists;
mod runtime;
mod sheet;
mod transitions;

use std::process::ExitCode;

use crate::cli::AnalyseCommand;

/// Studies.
pub fn run(command: &AnalyseCommand) -> anyhow::Result<ExitCode> {
    match command {
        AnalyseCommand::Transitions(args) => transitions::run(args),
        AnalyseCommand::Battery(args) => battery::run(args),
        AnalyseCommand::Imin(args) => imin::run(args),
        AnalyseCommand::Harvest(args) => harvest::run(args),
        AnalyseCommand::Runtime(args) => runtime::run(args),
    }
}
