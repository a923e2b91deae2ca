//! The options of `reveille tune`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::FormatArg;
#[cfg(feature = "tune")]
use super::ScenarioArgs;
use super::train::EpisodeArgs;

/// What stands below the options.
pub(super) const EXAMPLES: &str = "Examples:\n  reveille tune -n 100 --out tuning.csv\n  \
    reveille tune -n 100 --set bs.ranking=posterior --objective efficiency --out efficiency.csv\n  \
    reveille tune --picture-only tuning.csv\n\n\
    A tuning that was cut short, even by kill -9, goes on when the same command is given again; with more --iterations \
    one that had ended does.";

/// `reveille tune`.
#[derive(Args)]
pub struct TuneArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one field, for example --set bs.ranking=posterior. May be repeated. Weights that are set are tried
    /// first, if the ranges hold them.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// Number of devices N.
    #[arg(long, short = 'n', default_value = "100")]
    pub devices: String,
    /// What to make large.
    #[arg(long, value_enum, default_value = "balance")]
    pub objective: ObjectiveArg,
    /// Balance: information (P1) that one unit per device and TTI is worth.
    #[arg(long, default_value_t = 1.0, value_name = "WEIGHT")]
    pub energy_weight: f64,
    /// Balance: information (P1) that a misdetected share of 1 is worth, beyond what those events lack.
    #[arg(long, default_value_t = 1.0, value_name = "WEIGHT")]
    pub miss_weight: f64,
    /// Least and largest μ1.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1,
        default_value = "0.5,20",
        value_name = "FROM,TO"
    )]
    pub mu1: Vec<f64>,
    /// Least and largest μ2.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1,
        default_value = "1,5",
        value_name = "FROM,TO"
    )]
    pub mu2: Vec<f64>,
    /// Pairs of weights that are spread over the ranges, at least 3. The first is the scenario's own, if the
    /// ranges hold it.
    #[arg(long, default_value_t = 6, value_name = "PAIRS")]
    pub design: usize,
    /// Pairs after those, each chosen by all before it.
    #[arg(long, default_value_t = 10)]
    pub iterations: usize,
    #[command(flatten)]
    pub episodes: EpisodeArgs,
    /// Evaluation runs of each pair, with seeds that no training has.
    #[arg(long, default_value_t = 8)]
    pub seeds: u64,
    /// Length of an evaluation run, TTIs.
    #[arg(long, short = 'k', default_value_t = 10_000)]
    pub ttis: u64,
    /// The file for the history, a CSV; the picture goes beside it.
    #[arg(long, short, default_value = "tuning.csv")]
    pub out: PathBuf,
    /// Begin anew if that file is there.
    #[arg(long)]
    pub force: bool,
    /// Only draw the picture of this history, beside it.
    #[arg(long, value_name = "HISTORY")]
    pub picture_only: Option<PathBuf>,
    /// File formats of the picture, separated by commas.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "svg,png")]
    pub format: Vec<FormatArg>,
    /// Print the result as JSON.
    #[arg(long)]
    pub json: bool,
    /// No progress bar; print the best weights alone.
    #[arg(long, short)]
    pub quiet: bool,
}

/// An objective.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ObjectiveArg {
    /// Information (P1) − energy weight × units per device and TTI − miss weight × share misdetected.
    Balance,
    /// Information, the objective of P1.
    Information,
    /// Information per unit spent.
    Efficiency,
}

#[cfg(feature = "tune")]
impl TuneArgs {
    /// The scenario's options.
    pub fn scenario(&self) -> anyhow::Result<ScenarioArgs> {
        let devices = Some(self.devices.clone());
        self.episodes.scenario(&self.scenario, &self.set, devices)
    }
}
