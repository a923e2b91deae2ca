//! `reveille report`.

use std::process::ExitCode;

use crate::cli::ReportArgs;

/// Writes the report.
pub fn run(_: &ReportArgs) -> anyhow::Result<ExitCode> {
    anyhow::bail!("not yet")
}
