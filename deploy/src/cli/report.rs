//! Options of `reveille report`, including the search over conditions that the paper leaves unstated.
//! `commands/report.rs` executes it. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::examples::examples;
use super::parse::whole;

/// Arguments of `reveille report`.
#[derive(Args)]
pub(crate) struct ReportArgs {
    /// Report on a search instead of the presets.
    #[command(subcommand)]
    pub command: Option<ReportCommand>,
    /// Result tables of `reveille sweep`, or the folders of finished sweeps, for the presets paper and paper-literal.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// Folder for report.html, report.md and their figures; created if missing.
    #[arg(long, short, default_value = "report")]
    pub out: PathBuf,
    /// Also insert the tables into this page, such as docs/reproduction.md. Each table replaces the text between the
    /// lines <!-- report NAME --> and <!-- /report NAME -->.
    #[arg(long, value_name = "FILE")]
    pub page: Option<PathBuf>,
}

/// Report on a search instead of the presets.
#[derive(Subcommand)]
pub(crate) enum ReportCommand {
    /// Judge the paper's claims under every condition of a sweep, and rank the conditions
    ///
    /// The rank uses half of the claims; the other half shows whether a rank is more than chance.
    #[command(after_help = examples!(
        "reveille sweep deploy/examples/unstated.toml --out unstated",
        "reveille report search unstated --out report",
    ))]
    Search(SearchArgs),
}

/// Arguments of `reveille report search`.
#[derive(Args)]
pub(crate) struct SearchArgs {
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; every condition in them is judged.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// Number of conditions to list, from the best on; the presets are always listed.
    #[arg(long, default_value = "20", value_parser = whole(1..=usize::MAX), allow_negative_numbers = true)]
    pub top: usize,
    /// Folder for search.md; created if missing.
    #[arg(long, short, default_value = "report")]
    pub out: PathBuf,
    /// Also insert the tables into this page, such as docs/reproduction.md. Each table replaces the text between the
    /// lines <!-- report NAME --> and <!-- /report NAME -->.
    #[arg(long, value_name = "FILE")]
    pub page: Option<PathBuf>,
}
