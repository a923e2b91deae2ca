//! The options of sweeps.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use reveille_common::score::Metrics;
use reveille_lab::sweep::Shard;
use reveille_lab::table::Format;

use super::parse::{parse_whole, several_policies};

/// `reveille sweep`.
#[derive(Args)]
pub struct SweepArgs {
    /// An experiment file; see deploy/examples/experiment.toml. Options win over what it says.
    pub experiment: Option<PathBuf>,

    /// The runs that the sweep makes.
    #[command(flatten)]
    pub grid: GridArgs,

    /// The folder of the sweep. Give the same command again to go on with a sweep that was cut short, or with more
    /// --seeds to add to one [default: that of EXPERIMENT if it is the experiment.toml of such a sweep, or
    /// runs/sweep-HASH, the same for the same experiment and number of seeds].
    #[arg(long, short, help_heading = "Output")]
    pub out: Option<PathBuf>,

    /// The form of the table, one row per run: results.parquet or results.csv.
    #[arg(long, value_enum, default_value = "parquet", help_heading = "Output")]
    pub format: FormatArg,

    /// Print what came out as JSON instead of the table.
    #[arg(long, help_heading = "Output")]
    pub json: bool,

    /// No progress bar and no table, only where the results are.
    #[arg(long, short, help_heading = "Output")]
    pub quiet: bool,

    /// Check every scenario, show the grid and the number of runs, and run nothing.
    #[arg(long, help_heading = "Output")]
    pub dry_run: bool,

    /// Take runs that a table holds already, of the same scenario and seed, instead of making them: a table
    /// (results.parquet, results.csv) or the folder of a finished sweep. May be repeated.
    #[arg(long, value_name = "TABLE", help_heading = "Running")]
    pub reuse: Vec<PathBuf>,

    /// Threads [default: as many as there are cores].
    #[arg(long, short = 'j', help_heading = "Running", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub threads: Option<u16>,

    /// Make only the I-th of N shares, for several machines; `reveille merge` puts their tables together.
    #[arg(long, value_name = "I/N", help_heading = "Running")]
    pub shard: Option<Shard>,
}

/// Which runs a sweep makes.
#[derive(Args)]
pub struct GridArgs {
    /// A preset's name or a TOML file, the base of all cells [default: paper].
    #[arg(long, short, help_heading = "Grid")]
    pub scenario: Option<String>,

    /// Registered policies.
    #[arg(long, short, value_delimiter = ',', help_heading = "Grid", help = several_policies())]
    pub policies: Option<Vec<String>>,

    /// Numbers of devices N, separated by commas [default: the scenario's].
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        allow_hyphen_values = true,
        help_heading = "Grid"
    )]
    pub devices: Option<Vec<String>>,

    /// Lengths of the runs K in TTIs, warm-up included, separated by commas [default: the scenario's].
    #[arg(
        long,
        short = 'k',
        value_delimiter = ',',
        allow_hyphen_values = true,
        help_heading = "Grid"
    )]
    pub ttis: Option<Vec<String>>,

    /// Sweep any field of the scenario, for example --grid harvest.lambda=0.05,0.1. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE,VALUE…", help_heading = "Grid")]
    pub grid: Vec<String>,

    /// Set one field in all cells, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE", help_heading = "Grid")]
    pub set: Vec<String>,

    /// Seeds of each cell, the same in all; with --until-ci the most of them [default: 100].
    #[arg(long, value_parser = parse_whole, allow_negative_numbers = true, help_heading = "Seeds")]
    pub seeds: Option<u64>,

    /// The first seed; the others follow one by one [default: 1].
    #[arg(long, value_parser = parse_whole, allow_negative_numbers = true, help_heading = "Seeds")]
    pub first_seed: Option<u64>,

    /// Stop a cell as soon as the 95 % intervals of its metrics are this narrow: half-width over mean, such as 1% or
    /// 0.01. Intervals of cells that stop early cover a little less than 95 %, since they were looked at repeatedly. A
    /// metric that is 0 in all runs is never narrow: leave it out by --ci-metrics.
    #[arg(long, value_name = "WIDTH", help_heading = "Seeds")]
    pub until_ci: Option<String>,

    /// The metrics that --until-ci looks at, separated by commas.
    #[arg(long, value_delimiter = ',', value_name = "METRIC,…", help_heading = "Seeds", help = ci_metrics_help())]
    pub ci_metrics: Option<Vec<String>>,

    /// Runs of a cell before --until-ci looks for the first time, at most --seeds [default: 30].
    #[arg(long, value_parser = parse_whole, allow_negative_numbers = true, help_heading = "Seeds")]
    pub min_seeds: Option<u64>,
}

/// `reveille merge`.
#[derive(Args)]
pub struct MergeArgs {
    /// Tables of shards (results.parquet, results.csv), or the folders of their sweeps.
    #[arg(required = true, value_name = "SHARD")]
    pub shards: Vec<PathBuf>,

    /// The merged table, .parquet or .csv.
    #[arg(long, short)]
    pub out: PathBuf,

    /// Replace that file if it is there.
    #[arg(long)]
    pub force: bool,

    /// Merge although shards are missing; the table says which are in it.
    #[arg(long)]
    pub partial: bool,
}

/// The form of a table.
#[derive(Clone, Copy, ValueEnum)]
pub enum FormatArg {
    /// Apache Parquet.
    Parquet,
    /// CSV, and beside it a .toml with what Parquet keeps in its metadata.
    Csv,
}

impl From<FormatArg> for Format {
    fn from(arg: FormatArg) -> Self {
        match arg {
            FormatArg::Parquet => Self::Parquet,
            FormatArg::Csv => Self::Csv,
        }
    }
}

/// What `--ci-metrics` takes.
fn ci_metrics_help() -> String {
    let names = Metrics::ALL.map(|metric| metric.name).join(", ");
    let differences = Metrics::ALL.into_iter().filter(|metric| metric.is_difference);
    let differences: Vec<&str> = differences.map(|metric| metric.name).collect();
    format!(
        "The metrics that --until-ci looks at, separated by commas, of: {names} [default: all that are defined, but \
         for events and {}, whose mean may be 0]",
        differences.join(", ")
    )
}
