//! The subcommands, one file each, and their shared parts: `resolve_scenario` and `experiment` for the start, `resume`
//! for a resumed run, `figure_files` for files of tables and figures.

pub(crate) mod analyse;
pub(crate) mod bs;
pub(crate) mod clock;
pub(crate) mod dashboard;
pub(crate) mod device;
mod experiment;
mod figure_files;
pub(crate) mod figures;
pub(crate) mod inspect;
pub(crate) mod merge;
pub(crate) mod report;
mod resolve_scenario;
mod resume;
pub(crate) mod run;
pub(crate) mod scenario;
pub(crate) mod sweep;
pub(crate) mod train;
#[cfg(feature = "tune")]
pub(crate) mod tune;
pub(crate) mod up;

use std::path::Path;
use std::process::ExitCode;

use reveille_bs::scenario::Scenario;

use crate::cli::OutputArgs;
use crate::display;
use crate::exit::ExitReason;
use crate::results_table::{self, Rows};
use crate::summary::Summary;

/// TTIs in a window of the per-window tables.
pub(crate) fn window(args: &OutputArgs, scenario: &Scenario) -> u64 {
    args.window.unwrap_or_else(|| scenario.run.ttis.div_ceil(100))
}

/// Prints the summary in the chosen form and returns the exit code.
pub(crate) fn conclude(args: &OutputArgs, summary: &Summary<'_>, folder: &Path) -> anyhow::Result<ExitCode> {
    if args.json {
        display::print(&summary.to_json()?)?;
    } else if args.quiet {
        display::print(&format!("digest {}\n", summary.digest))?;
    } else {
        let rows = if args.all_metrics { Rows::All } else { Rows::Main };
        display::print(&results_table::text(summary, rows))?;
        display::print(&format!("results in {}\n", folder.display()))?;
    }
    Ok(if summary.status == "complete" {
        ExitReason::Done.into()
    } else {
        ExitReason::Interrupted.into()
    })
}
