//! How a command that made a run writes and prints what came out.

use std::path::Path;
use std::process::ExitCode;

use reveille_bs::scenario::Scenario;

use crate::cli::OutputArgs;
use crate::display;
use crate::exit::Exit;
use crate::summary::Summary;

/// TTIs in a window of the per-window series.
pub fn window(args: &OutputArgs, scenario: &Scenario) -> u64 {
    args.window.unwrap_or_else(|| scenario.ttis.div_ceil(100))
}

/// Prints the summary as asked, and gives the exit code.
pub fn conclude(args: &OutputArgs, summary: &Summary<'_>, folder: &Path) -> anyhow::Result<ExitCode> {
    if args.json {
        display::out(&summary.to_json()?)?;
    } else if args.quiet {
        display::out(&format!("digest {}\n", summary.digest))?;
    } else {
        display::out(&display::table(summary))?;
        display::out(&format!("results in {}\n", folder.display()))?;
    }
    Ok(if summary.status == "complete" {
        Exit::Done.into()
    } else {
        Exit::Interrupted.into()
    })
}
