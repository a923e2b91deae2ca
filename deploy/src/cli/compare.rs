//! Options of `reveille compare`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::Args;

/// Arguments of `reveille compare`.
#[derive(Args)]
pub(crate) struct CompareArgs {
    /// Run folders or recordings, at least two. Differences refer to the first.
    #[arg(required = true, num_args = 2.., value_name = "RUN")]
    pub runs: Vec<PathBuf>,
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
