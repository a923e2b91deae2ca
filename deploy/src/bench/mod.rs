//! `reveille bench`.

use std::process::ExitCode;

use crate::cli::BenchCommand;

/// Measures.
pub fn run(_command: &BenchCommand) -> anyhow::Result<ExitCode> {
    anyhow::bail!("not yet")
}
