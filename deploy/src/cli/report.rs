//! The options of the report, and of the search over what the paper leaves unstated.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::parse::parse_count;

/// `reveille report`.
#[derive(Args)]
pub struct ReportArgs {
    /// What else is judged.
    #[command(subcommand)]
    pub command: Option<ReportCommand>,
    /// Result tables of `reveille sweep`, or the folders of finished sweeps, of the presets paper and paper-literal.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// The folder for report.html and report.md; it is made if need be.
    #[arg(long, short, default_value = "report")]
    pub out: PathBuf,
    /// Also put the tables into this page, between lines with <!-- report NAME --> and <!-- /report NAME -->;
    /// docs/reproduction.md has them.
    #[arg(long, value_name = "FILE")]
    pub page: Option<PathBuf>,
}

/// What else is judged.
#[derive(Subcommand)]
pub enum ReportCommand {
    /// Judge the paper's claims under every setting of sweeps, and rank the settings by half of the claims; the other
    /// half tells whether the rank is more than luck.
    #[command(
        after_help = "Example:\n  reveille sweep deploy/examples/unstated.toml --out unstated\n  \
        reveille report search unstated --out report"
    )]
    Search(SearchArgs),
}

/// `reveille report search`.
#[derive(Args)]
pub struct SearchArgs {
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; every setting in them is judged.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// How many settings to show; the presets are shown wherever they stand.
    #[arg(long, default_value = "20", value_parser = parse_count)]
    pub top: usize,
    /// The folder for search.md; it is made if need be.
    #[arg(long, short, default_value = "report")]
    pub out: PathBuf,
    /// Also put the tables into this page, between lines with <!-- report NAME --> and <!-- /report NAME -->;
    /// docs/reproduction.md has them.
    #[arg(long, value_name = "FILE")]
    pub page: Option<PathBuf>,
}
