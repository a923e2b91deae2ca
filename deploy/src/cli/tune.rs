//! Options of `reveille tune`, which `commands/tune.rs` executes. One that affects the training of tables also belongs
//! in `training_command` there. The ranges of `--design`, `--seeds` and `--ttis` repeat the checks in
//! `lab/src/tuning/plan.rs`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::builder::EnumValueParser;
use clap::{Args, ValueEnum};

use super::ImageFormatArg;
#[cfg(feature = "tune")]
use super::ScenarioArgs;
use super::parse::{any_whole, parse_number, parse_range, trimmed, whole};
use super::train::EpisodeArgs;

/// Arguments of `reveille tune`.
#[derive(Args)]
pub(crate) struct TuneArgs {
    /// Preset name (paper, paper-literal, quick) or TOML file.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one scenario field, for example --set bs.ranking=posterior. May be repeated. Overridden weights are
    /// tried first if they are within the ranges.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// Number of devices N.
    #[arg(long, short = 'n', default_value = "100")]
    pub devices: String,
    /// Objective to maximise.
    #[arg(long, value_enum, default_value = "balance")]
    pub objective: ObjectiveArg,
    /// Weight of energy in the balance: information (P1) per unit spent per device and TTI.
    #[arg(
        long,
        default_value_t = 1.0,
        value_name = "WEIGHT",
        value_parser = parse_number,
        allow_negative_numbers = true
    )]
    pub energy_weight: f64,
    /// Weight of misdetection in the balance: information (P1) for a misdetected share of 1, in addition to the
    /// information missing from those events.
    #[arg(
        long,
        default_value_t = 1.0,
        value_name = "WEIGHT",
        value_parser = parse_number,
        allow_negative_numbers = true
    )]
    pub miss_weight: f64,
    /// Minimum and maximum of μ1.
    #[arg(
        long,
        default_value = "0.5,20",
        value_name = "FROM,TO",
        value_parser = parse_range,
        allow_negative_numbers = true
    )]
    pub mu1: (f64, f64),
    /// Minimum and maximum of μ2.
    #[arg(
        long,
        default_value = "1,5",
        value_name = "FROM,TO",
        value_parser = parse_range,
        allow_negative_numbers = true
    )]
    pub mu2: (f64, f64),
    /// Number of initial pairs of weights, at least 3, spread over the ranges. The first is the scenario's pair if it
    /// is within the ranges.
    #[arg(
        long,
        default_value_t = 6,
        value_name = "PAIRS",
        value_parser = any_whole(3..=1000_usize),
        allow_negative_numbers = true
    )]
    pub design: usize,
    /// Number of further pairs, each chosen from all earlier results.
    #[arg(long, default_value_t = 10, value_parser = whole(0..=usize::MAX), allow_negative_numbers = true)]
    pub iterations: usize,
    /// Training options.
    #[command(flatten)]
    pub episodes: EpisodeArgs,
    /// Evaluation runs per pair; their seeds differ from all training seeds.
    #[arg(long, default_value_t = 8, value_parser = any_whole(1..=10_000_u64), allow_negative_numbers = true)]
    pub seeds: u64,
    /// Length of an evaluation run in TTIs.
    #[arg(
        long,
        short = 'k',
        default_value_t = 10_000,
        value_parser = any_whole(10..=1_000_000_000_u64),
        allow_negative_numbers = true
    )]
    pub ttis: u64,
    /// CSV file for the history; the picture is written to the same folder.
    #[arg(long, short, default_value = "tuning.csv")]
    pub out: PathBuf,
    /// Start again and replace the history file if it exists.
    #[arg(long)]
    pub force: bool,
    /// Only draw the picture of HISTORY, the CSV file that an earlier tuning wrote to --out. The picture is written to
    /// the same folder.
    #[arg(long, value_name = "HISTORY")]
    pub picture_only: Option<PathBuf>,
    /// File formats of the picture, separated by commas.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "svg,png",
        value_parser = trimmed(EnumValueParser::<ImageFormatArg>::new())
    )]
    pub format: Vec<ImageFormatArg>,
    /// Print the result as JSON.
    #[arg(long)]
    pub json: bool,
    /// Hide the progress bar, and print only the best weights.
    #[arg(long, short)]
    pub quiet: bool,
}

/// Tuning objective.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ObjectiveArg {
    /// Information (P1) − energy weight × units per device and TTI − miss weight × misdetected share.
    Balance,
    /// Information, the objective of P1.
    Information,
    /// Information per unit spent.
    Efficiency,
}

#[cfg(feature = "tune")]
impl TuneArgs {
    /// Returns the scenario options for a learner without tables.
    ///
    /// # Errors
    /// If `--set` sets a field that a training sets itself.
    pub(crate) fn scenario(&self) -> anyhow::Result<ScenarioArgs> {
        let devices = Some(self.devices.clone());
        self.episodes.scenario(&self.scenario, &self.set, devices)
    }
}
