//! Options of `reveille sweep` and `reveille merge`, which `commands/sweep/` and `commands/merge.rs` execute. `train
//! record` takes [`GridArgs`] too, and refers to the group by the name of this type. Defaults in its help texts repeat
//! `lab/src/sweep/experiment_builder.rs`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::builder::StringValueParser;
use clap::{Args, ValueEnum};
use reveille_common::score::Metrics;
use reveille_lab::sweep::Shard;
use reveille_lab::table::Format;

use super::parse::{metric_parser, policies_help, trimmed, whole};

/// Largest number of seeds of a cell, as in `lab/src/sweep/experiment.rs`.
const MAX_SEEDS: u64 = 10_000_000;

/// Arguments of `reveille sweep`.
#[derive(Args)]
pub(crate) struct SweepArgs {
    /// Experiment file; see deploy/examples/experiment.toml. Options on the command line take precedence.
    pub experiment: Option<PathBuf>,

    /// Runs of the sweep.
    #[command(flatten)]
    pub grid: GridArgs,

    /// Script of timed actions of every run: devices that fail, are revived or receive energy, and settings that
    /// change. See docs/actions.md for its lines.
    #[arg(long, value_name = "FILE", help_heading = "Grid")]
    pub actions: Option<PathBuf>,

    /// Folder of the sweep. Repeat the same command to resume an interrupted sweep, or add runs with more --seeds
    /// [default: the folder of EXPERIMENT if that is the experiment.toml of a sweep; otherwise runs/sweep-HASH, fixed
    /// by experiment and number of seeds].
    #[arg(long, short, help_heading = "Output")]
    pub out: Option<PathBuf>,

    /// Format of the result table: results.parquet or results.csv, with one row per run.
    #[arg(long, value_enum, default_value = "parquet", help_heading = "Output")]
    pub format: TableFormatArg,

    /// Print the results as JSON instead of a table.
    #[arg(long, help_heading = "Output")]
    pub json: bool,

    /// Hide the progress bar and the table. Print only the location of the results.
    #[arg(long, short, help_heading = "Output")]
    pub quiet: bool,

    /// Check every scenario, and show the grid and the number of runs, without running them.
    #[arg(long, help_heading = "Output")]
    pub dry_run: bool,

    /// Reuse runs with the same scenario and seed from this table (results.parquet, results.csv) or folder of a
    /// finished sweep. May be repeated.
    #[arg(long, value_name = "TABLE", help_heading = "Running")]
    pub reuse: Vec<PathBuf>,

    /// Number of threads [default: one per core].
    #[arg(
        long,
        short = 'j',
        help_heading = "Running",
        value_parser = whole(1..=4096_u16),
        allow_negative_numbers = true
    )]
    pub threads: Option<u16>,

    /// Run only shard I of N, to share a sweep between machines. `reveille merge` combines their tables.
    #[arg(long, value_name = "I/N", help_heading = "Running")]
    pub shard: Option<Shard>,
}

/// Options that select the runs of a sweep.
#[derive(Args)]
pub(crate) struct GridArgs {
    /// Preset name or TOML file, the base of all cells [default: paper].
    #[arg(long, short, help_heading = "Grid")]
    pub scenario: Option<String>,

    /// Registered policies.
    #[arg(
        long,
        short,
        visible_alias = "policy",
        value_delimiter = ',',
        help_heading = "Grid",
        help = policies_help(),
        value_parser = trimmed(StringValueParser::new())
    )]
    pub policies: Option<Vec<String>>,

    /// Numbers of devices N, separated by commas [default: the scenario's].
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        allow_hyphen_values = true,
        help_heading = "Grid",
        value_parser = trimmed(StringValueParser::new())
    )]
    pub devices: Option<Vec<String>>,

    /// Run lengths K in TTIs, warm-up included, separated by commas [default: the scenario's].
    #[arg(
        long,
        short = 'k',
        value_delimiter = ',',
        allow_hyphen_values = true,
        help_heading = "Grid",
        value_parser = trimmed(StringValueParser::new())
    )]
    pub ttis: Option<Vec<String>>,

    /// Sweep a scenario field, for example --grid harvest.lambda=0.05,0.1. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE,VALUE…", help_heading = "Grid")]
    pub grid: Vec<String>,

    /// Override one scenario field in all cells, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE", help_heading = "Grid")]
    pub set: Vec<String>,

    /// Number of seeds, the same in every cell; the maximum with --until-ci [default: 100].
    #[arg(long, value_parser = whole(1..=MAX_SEEDS), allow_negative_numbers = true, help_heading = "Seeds")]
    pub seeds: Option<u64>,

    /// First seed; the other seeds follow consecutively [default: 1].
    #[arg(long, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true, help_heading = "Seeds")]
    pub first_seed: Option<u64>,

    /// Stop a cell when the 95 % confidence intervals of its metrics reach this width: half-width over mean, such as 1%
    /// or 0.01. Intervals of cells that stop early cover slightly less than 95 %, because they are checked repeatedly.
    /// A metric that is 0 in all runs never reaches the width; exclude it with --ci-metrics.
    #[arg(long, value_name = "WIDTH", help_heading = "Seeds")]
    pub until_ci: Option<String>,

    /// Metrics that --until-ci checks, separated by commas.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "METRIC,…",
        help_heading = "Seeds",
        help = ci_metrics_help(),
        hide_possible_values = true,
        value_parser = metric_parser()
    )]
    pub ci_metrics: Option<Vec<String>>,

    /// Runs per cell before the first check of --until-ci, at most --seeds [default: 30].
    #[arg(long, value_parser = whole(2..=MAX_SEEDS), allow_negative_numbers = true, help_heading = "Seeds")]
    pub min_seeds: Option<u64>,
}

/// Arguments of `reveille merge`.
#[derive(Args)]
pub(crate) struct MergeArgs {
    /// Shard tables (results.parquet, results.csv), or the folders of their sweeps.
    #[arg(required = true, value_name = "SHARD")]
    pub shards: Vec<PathBuf>,

    /// Output file for the merged table, .parquet or .csv.
    #[arg(long, short)]
    pub out: PathBuf,

    /// Replace the output file if it exists.
    #[arg(long)]
    pub force: bool,

    /// Merge even if shards are missing; the table records which shards it contains.
    #[arg(long)]
    pub partial: bool,
}

/// Table format.
#[derive(Clone, Copy, ValueEnum)]
pub enum TableFormatArg {
    /// Apache Parquet.
    Parquet,
    /// CSV, with the metadata of the Parquet format in a separate .toml file.
    Csv,
}

impl From<TableFormatArg> for Format {
    fn from(arg: TableFormatArg) -> Self {
        match arg {
            TableFormatArg::Parquet => Self::Parquet,
            TableFormatArg::Csv => Self::Csv,
        }
    }
}

/// Returns the help text of `--ci-metrics`. Its default is `UntilCi::default_metrics` in `lab/src/sweep/experiment.rs`.
fn ci_metrics_help() -> String {
    let names = Metrics::ALL.map(|metric| metric.name).join(", ");
    let differences = Metrics::ALL.into_iter().filter(|metric| metric.is_difference);
    let difference_names: Vec<&str> = differences.map(|metric| metric.name).collect();
    format!(
        "Metrics that --until-ci checks, separated by commas: {names} [default: all defined metrics except events, \
         and except {} because its mean can be 0]",
        difference_names.join(", ")
    )
}
