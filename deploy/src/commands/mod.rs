//! The subcommands, one file or folder each, which execute the options of `cli`; `main.rs` calls them. Shared parts:
//! `resolve_scenario` and `experiment` for the start, `resume` and `continued_run` for a resumed run, `figure_files`
//! for files of tables and figures, `energy_balance` for a scenario. Start with `run` for a run in memory, and `bs` for
//! a run over the bus.

pub(crate) mod analyse;
pub(crate) mod bs;
pub(crate) mod clock;
pub(crate) mod compare;
pub(crate) mod continued_run;
pub(crate) mod dashboard;
pub(crate) mod device;
mod energy_balance;
mod experiment;
mod figure_files;
pub(crate) mod figures;
pub(crate) mod inspect;
pub(crate) mod link;
pub(crate) mod merge;
pub(crate) mod report;
mod resolve_scenario;
mod resume;
pub(crate) mod router;
pub(crate) mod run;
pub(crate) mod scenario;
pub(crate) mod sweep;
pub(crate) mod testbed;
#[cfg(feature = "tls")]
pub(crate) mod tls;
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
use crate::terminal;

/// Length of a window of `windows.csv`, TTIs.
pub(crate) fn window_length(args: &OutputArgs, scenario: &Scenario) -> u64 {
    args.window.unwrap_or_else(|| default_window(scenario))
}

/// Default length of a window, TTIs. The help of `--window` and of `inspect export --every` states it.
pub(crate) const fn default_window(scenario: &Scenario) -> u64 {
    scenario.run.ttis.div_ceil(100)
}

/// Prints the summary in the chosen form and returns the exit code. Scripts and tests read the line `digest …` of
/// `--quiet`; `docs/tutorial.md` shows the whole text, which a test compares.
pub(crate) fn print_results(args: &OutputArgs, summary: &Summary<'_>, folder: &Path) -> anyhow::Result<ExitCode> {
    let is_complete = summary.status == "complete";
    if args.json {
        display::print_stdout(&summary.to_json()?)?;
    } else if args.quiet {
        display::print_stdout(&format!("digest {}\n", summary.digest))?;
    } else {
        let rows = if args.all_metrics { Rows::All } else { Rows::Main };
        display::print_stdout(&results_table::format_results(summary, rows, terminal::shows_colours()))?;
        let resume_hint = if is_complete {
            String::new()
        } else {
            let command = if summary.timing.hosts > 0 { "up" } else { "run" };
            format!(
                "; resume with `reveille {command} --resume {}`",
                display::shell_word(folder)
            )
        };
        display::print_stdout(&format!("results in {}{resume_hint}\n", folder.display()))?;
        if summary.totals.events.misdetected > 0 {
            let folder = folder.display();
            display::print_stdout(&format!("missed events: reveille inspect misses {folder}\n"))?;
        }
    }
    Ok(if is_complete {
        ExitReason::Done.into()
    } else {
        ExitReason::Interrupted.into()
    })
}
