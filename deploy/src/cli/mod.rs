//! The command line.

mod analyse;
mod figures;
mod inspect;
mod parse;
mod report;
mod run;
mod sweep;
mod tools;
mod train;
mod tune;

use clap::{Parser, Subcommand, ValueEnum};
use reveille_common::logging::LogFormat;

pub(crate) use analyse::{AnalyseCommand, BatteryArgs, HarvestArgs, IminArgs, RuntimeArgs, StudyArgs, TransitionsArgs};
pub(crate) use figures::{
    AttentionArgs, AxisArg, DeploymentArgs, FigureOutputArgs, FiguresArgs, FiguresCommand, ImageFormatArg,
    LearningArgs, QTableArgs, RankingArg, RobustnessArgs, SweepFigureArgs, TimelineArgs,
};
pub(crate) use inspect::{
    ColourArg, CompareArgs, DashboardArgs, ExportArgs, InspectCommand, InspectRecordArgs, StatsArgs, TailArgs, ToArg,
    VerifyArgs,
};
pub(crate) use report::{ReportArgs, ReportCommand, SearchArgs};
pub(crate) use run::{
    AuditArg, BsArgs, DeviceArgs, DriveArgs, ExternalPolicyArgs, OnLossArg, OnUndecidedArg, OutputArgs,
    PolicyProcessArgs, RunArgs, ScenarioArgs, UpArgs,
};
pub(crate) use sweep::{GridArgs, MergeArgs, SweepArgs};
pub(crate) use tools::{
    BenchCommand, BusBenchArgs, ClockArgs, MemoryBenchArgs, ScaleBenchArgs, ScenarioCommand, TargetArgs, WatchBenchArgs,
};
#[cfg(feature = "train-dt")]
pub(crate) use train::DtArgs;
pub(crate) use train::{RecordArgs, TrainArgs, TrainCommand};
#[cfg(feature = "tune")]
pub(crate) use tune::ObjectiveArg;
pub(crate) use tune::TuneArgs;

/// Emulate a base station and many battery-less IoT devices that run on harvested energy.
#[derive(Parser)]
#[command(name = "reveille", version, arg_required_else_help = true)]
#[command(after_help = after_help())]
pub(crate) struct Cli {
    /// The subcommand.
    #[command(subcommand)]
    pub command: Command,

    /// Log more: -v for information, -vv for debugging, -vvv for everything. `RUST_LOG` overrides it.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,

    /// Format of the log lines on standard error.
    #[arg(long, global = true, value_enum, default_value = "text")]
    pub log_format: LogFormatArg,
}

fn after_help() -> String {
    let start = "Start with:  reveille up\n\
        Then try:    reveille up --devices 250 --processes 250\n             \
        reveille up --pace 20ms   and, in another terminal,   reveille inspect tail";
    format!("{start}\n\n{}", crate::exit::help())
}

impl Cli {
    /// Returns the logging options to pass to child processes.
    pub(crate) fn log_options(&self) -> Vec<String> {
        let format = match self.log_format {
            LogFormatArg::Text => "text",
            LogFormatArg::Json => "json",
        };
        let verbose = (0..self.verbose).map(|_| "-v".to_owned());
        verbose.chain(["--log-format".to_owned(), format.to_owned()]).collect()
    }
}

/// The subcommands.
#[derive(Subcommand)]
pub(crate) enum Command {
    /// Run a base station and its device processes on this machine, and print a summary.
    #[command(
        after_help = "Examples:\n  reveille up\n  reveille up --policy genie --devices 250 --processes 10\n  \
        reveille up --scenario my.toml --set harvest.lambda=0.05 --json"
    )]
    Up(UpArgs),
    /// Run a scenario in memory: the same run and digest as `up`, without processes or a network.
    Run(RunArgs),
    /// Run every combination of scenario fields, policies and seeds in memory. The result table has one row per run; a
    /// summary gives means with confidence intervals.
    #[command(
        after_help = "Examples:\n  reveille sweep --policies knn,random --devices 10,50,250 --seeds 100\n  \
        reveille sweep --grid harvest.lambda=0.05,0.1,0.2 --set harvest.e_b=10 --until-ci 1%\n  \
        reveille sweep experiment.toml --shard 2/8 --out shard-2\n\n\
        To resume an interrupted sweep, repeat the same command; this also works after kill -9. With more --seeds and \
        the same --out, the sweep keeps the existing runs and adds the new ones."
    )]
    Sweep(SweepArgs),
    /// Merge the result tables of the shards of a sweep.
    #[command(after_help = "Example:\n  reveille merge shard-1 shard-2 shard-3 --out results.parquet")]
    Merge(MergeArgs),
    /// Train a learning policy in memory, and save the result in a file.
    #[command(subcommand)]
    Train(TrainCommand),
    /// Search for the best q-learning weights μ1 and μ2 for an objective, by Bayesian optimisation. Needs the cargo
    /// feature `tune`.
    #[command(after_help = tune::EXAMPLES)]
    Tune(TuneArgs),
    /// Start only the base station, and wait for device processes to join.
    #[command(
        after_help = "Example, on two machines:\n  reveille bs --listen tcp/0.0.0.0:7447 --run demo --devices 50\n  \
        reveille device --connect tcp/HOST:7447 --run demo --count 50"
    )]
    Bs(BsArgs),
    /// Start one device process, and connect it to a base station.
    Device(DeviceArgs),
    /// Supervise the process that `--policy-command` starts.
    #[command(hide = true)]
    PolicyProcess(PolicyProcessArgs),
    /// Show or validate scenarios.
    #[command(subcommand)]
    Scenario(ScenarioCommand),
    /// Inspect the messages of an active run or of a recording; record an active run.
    #[command(
        subcommand,
        after_help = "Examples:\n  reveille inspect tail --kind wake,report --join\n  \
        reveille run --record run.mcap\n  reveille inspect verify run.mcap\n  \
        reveille inspect tail --from run.mcap --device 7 --since 1000 --until 1100\n  \
        reveille inspect stats --from run.mcap"
    )]
    Inspect(InspectCommand),
    /// Show an active run or a recording in the browser.
    #[command(
        after_help = "Examples:\n  reveille up --dashboard --paused\n  reveille dashboard\n  \
        reveille dashboard --from run.mcap"
    )]
    Dashboard(DashboardArgs),
    /// Pause, step and resume the virtual clock of a run.
    Clock(ClockArgs),
    /// Draw the paper's figures from result tables, a map of a deployment, or batteries and states over time.
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = "Examples:\n  reveille figures results/table.parquet --out figures\n  \
        reveille figures results/table.parquet --only information,energy --format svg\n  \
        reveille figures sweep results/table.parquet --x harvest.lambda --y energy_per_device_tti\n  \
        reveille figures deployment --policy knn -n 80\n  reveille figures timeline --policy random --show 3,7"
    )]
    Figures(FiguresArgs),
    /// Compare result tables with every claim of the paper, and write an HTML and a Markdown page.
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = "Examples:\n  reveille report results/paper.parquet results/literal.parquet --out report\n  \
        reveille report search unstated --out report"
    )]
    Report(ReportArgs),
    /// Compare the paper's closed forms and Markov chains with simulated devices.
    #[command(subcommand)]
    Analyse(AnalyseCommand),
    /// Measure the emulator's speed against stated baselines.
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// Log format.
#[derive(Clone, Copy, ValueEnum)]
pub enum LogFormatArg {
    /// Readable text.
    Text,
    /// One JSON object per line.
    Json,
}

impl From<LogFormatArg> for LogFormat {
    fn from(arg: LogFormatArg) -> Self {
        match arg {
            LogFormatArg::Text => Self::Text,
            LogFormatArg::Json => Self::Json,
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
