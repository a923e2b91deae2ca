//! `reveille analyse`: the paper's analysis next to measurements of the emulator, one file per study. `lists` reads the
//! options, `study/src/analysis/` calculates, `sheet` prints.

mod battery;
mod harvest;
mod imin;
mod lists;
mod runtime;
mod sheet;
mod transitions;

use std::process::ExitCode;

use crate::cli::AnalyseCommand;

/// Runs a study.
pub(crate) fn run(command: &AnalyseCommand) -> anyhow::Result<ExitCode> {
    match command {
        AnalyseCommand::Transitions(args) => transitions::run(args),
        AnalyseCommand::Battery(args) => battery::run(args),
        AnalyseCommand::Imin(args) => imin::run(args),
        AnalyseCommand::Harvest(args) => harvest::run(args),
        AnalyseCommand::Runtime(args) => runtime::run(args),
    }?;
    Ok(ExitCode::SUCCESS)
}
