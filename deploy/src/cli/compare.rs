//! Options of `reveille compare`, which `commands/compare/` executes. The help of `--metric` repeats `DEFAULT_METRICS`
//! of `commands/compare/sweep.rs`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::Args;

use super::parse::metric_parser;

/// Arguments of `reveille compare`.
#[derive(Args)]
pub(crate) struct CompareArgs {
    /// Run folders or recordings, at least two, numbered in this order: differences refer to the first. Or sweep
    /// folders and result tables, whose policies follow the order of figures: the paper's, then others by name.
    #[arg(required = true, num_args = 1.., value_name = "RUN|SWEEP")]
    pub runs: Vec<PathBuf>,
    /// Reference policy within sweeps; the other policies are compared with it [default: the first of the table].
    #[arg(long, value_name = "POLICY", help_heading = "Sweeps")]
    pub against: Option<String>,
    /// Metrics of sweeps, separated by commas [default: info_p1, misdetection_pct, detection_delay_ttis,
    /// energy_per_device_tti and info_per_energy].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "METRIC,…",
        help_heading = "Sweeps",
        hide_possible_values = true,
        value_parser = metric_parser()
    )]
    pub metric: Vec<String>,
    /// Show every metric, not only those that runs are usually compared by. --json always has all.
    #[arg(long)]
    pub all_metrics: bool,
    /// Exit with 1 unless all digests are equal.
    #[arg(long)]
    pub exit_code: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}
