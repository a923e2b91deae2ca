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

pub use analyse::{AnalyseCommand, BatteryArgs, HarvestArgs, IminArgs, RuntimeArgs, StudyArgs, TransitionsArgs};
pub use figures::{
    AttentionArgs, AxisArg, DeploymentArgs, FiguresArgs, FiguresCommand, FormatArg, LearningArgs, PictureArgs,
    QTableArgs, RankingArg, RobustnessArgs, SweepFigureArgs, TimelineArgs,
};
pub use inspect::{
    ColourArg, CompareArgs, DashboardArgs, ExportArgs, InspectCommand, InspectRecordArgs, StatsArgs, TailArgs, ToArg,
    VerifyArgs,
};
pub use report::{ReportArgs, ReportCommand, SearchArgs};
pub use run::{
    AuditArg, BsArgs, DeviceArgs, DriveArgs, OnLossArg, OnUndecidedArg, OutputArgs, OutsideArgs, PolicyProcessArgs,
    RunArgs, ScenarioArgs, UpArgs,
};
pub use sweep::{GridArgs, MergeArgs, SweepArgs};
pub use tools::{
    BenchCommand, BusBenchArgs, ClockArgs, MemoryBenchArgs, ScaleBenchArgs, ScenarioCommand, TargetArgs, WatchBenchArgs,
};
pub use train::{DtArgs, RecordArgs, TrainArgs, TrainCommand};
#[cfg(feature = "tune")]
pub use tune::ObjectiveArg;
pub use tune::TuneArgs;

/// Emulates a base station and many battery-less IoT devices that live on harvested energy.
#[derive(Parser)]
#[command(name = "reveille", version, arg_required_else_help = true)]
#[command(after_help = after_help())]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,

    /// Log more: -v information, -vv debugging, -vvv everything. `RUST_LOG` overrides it.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,

    /// The form of log lines, which go to standard error.
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
    /// The options for logging, for processes that this one starts.
    pub fn log_options(&self) -> Vec<String> {
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
pub enum Command {
    /// Run a base station and its device processes on this machine, and sum up.
    #[command(
        after_help = "Examples:\n  reveille up\n  reveille up --policy genie --devices 250 --processes 10\n  \
        reveille up --scenario my.toml --set harvest.lambda=0.05 --json"
    )]
    Up(UpArgs),
    /// Run in memory: the same run and the same digest as `up`, without processes or a network.
    Run(RunArgs),
    /// Run a grid of scenario fields × policies × seeds in memory, one row per run, and give means with intervals.
    #[command(
        after_help = "Examples:\n  reveille sweep --policies knn,random --devices 10,50,250 --seeds 100\n  \
        reveille sweep --grid harvest.lambda=0.05,0.1,0.2 --set harvest.e_b=10 --until-ci 1%\n  \
        reveille sweep experiment.toml --shard 2/8 --out shard-2\n\n\
        A sweep that was cut short, even by kill -9, goes on when the same command is given again. With more --seeds \
        and the same --out it keeps the runs that are there."
    )]
    Sweep(SweepArgs),
    /// Put the tables of the shards of a sweep together.
    #[command(after_help = "Example:\n  reveille merge shard-1 shard-2 shard-3 --out results.parquet")]
    Merge(MergeArgs),
    /// Train a policy that learns, in memory, and keep what it has learned in a file.
    #[command(subcommand)]
    Train(TrainCommand),
    /// Look for the weights μ1 and μ2 of q-learning that serve an objective best, by Bayesian optimisation. Needs the
    /// cargo feature `tune`.
    #[command(after_help = tune::EXAMPLES)]
    Tune(TuneArgs),
    /// Start only the base station, and wait for devices to connect.
    #[command(
        after_help = "Example, on two machines:\n  reveille bs --listen tcp/0.0.0.0:7447 --run demo --devices 50\n  \
        reveille device --connect tcp/HOST:7447 --run demo --count 50"
    )]
    Bs(BsArgs),
    /// Start one process of devices, and connect it to a base station.
    Device(DeviceArgs),
    /// Guard the process of `--policy-command`.
    #[command(hide = true)]
    PolicyProcess(PolicyProcessArgs),
    /// Show or check scenarios.
    #[command(subcommand)]
    Scenario(ScenarioCommand),
    /// Look at the messages of a run, while it goes or from a recording; record it.
    #[command(
        subcommand,
        after_help = "Examples:\n  reveille inspect tail --kind wake,report --join\n  \
        reveille run --record run.mcap\n  reveille inspect verify run.mcap\n  \
        reveille inspect tail --from run.mcap --device 7 --since 1000 --until 1100\n  \
        reveille inspect stats --from run.mcap"
    )]
    Inspect(InspectCommand),
    /// Look at a run in the browser, while it goes or from a recording.
    #[command(
        after_help = "Examples:\n  reveille up --dashboard --paused\n  reveille dashboard\n  \
        reveille dashboard --from run.mcap"
    )]
    Dashboard(DashboardArgs),
    /// Pause, step and resume the virtual clock of a run.
    Clock(ClockArgs),
    /// Draw the paper's figures from result tables, or a picture of a deployment, or of batteries and states over time.
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = "Examples:\n  reveille figures results/table.parquet --out figures\n  \
        reveille figures results/table.parquet --only information,energy --format svg\n  \
        reveille figures sweep results/table.parquet --x harvest.lambda --y energy_per_device_tti\n  \
        reveille figures deployment --policy knn -n 80\n  reveille figures timeline --policy random --show 3,7"
    )]
    Figures(FiguresArgs),
    /// Hold result tables against every claim of the paper: a page of HTML and one of Markdown.
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = "Examples:\n  reveille report results/paper.parquet results/literal.parquet --out report\n  \
        reveille report search unstated --out report"
    )]
    Report(ReportArgs),
    /// Work through the paper's analysis: closed forms and Markov chains beside what the machines do.
    #[command(subcommand)]
    Analyse(AnalyseCommand),
    /// Measure the emulator's speed against stated baselines.
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// Log format.
#[derive(Clone, Copy, ValueEnum)]
pub enum LogFormatArg {
    /// For people.
    Text,
    /// One JSON object a line.
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
