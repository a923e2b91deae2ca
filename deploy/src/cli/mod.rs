//! The command line: commands, options and help, declared with clap, one file per group of commands. The modules of
//! `commands` execute them. Names of options and values are a public interface: a renamed one needs an entry in
//! `former`, a new command one in `groups`, a global option with a value one in `former::command_word_positions`, an
//! option that only some commands have one in `misplaced`. Doc comments are help texts. Tests check that every help has
//! two valid examples (`examples`), and compare the options of a run with docs/command-line.md.

mod analyse;
mod compare;
mod examples;
mod figures;
pub(crate) mod former;
mod groups;
mod inspect;
pub(crate) mod misplaced;
mod parse;
mod report;
mod run;
mod sweep;
mod testbed;
#[cfg(test)]
mod tests;
mod tls;
mod tools;
mod train;
mod tune;

use clap::{Parser, Subcommand, ValueEnum};
use reveille_common::logging::LogFormat;

use examples::examples;

pub(crate) use analyse::{AnalyseCommand, BatteryArgs, HarvestArgs, IminArgs, RuntimeArgs, StudyArgs, TransitionsArgs};
pub(crate) use compare::CompareArgs;
pub(crate) use figures::{
    AttentionArgs, AxisArg, DeploymentArgs, FigureOutputArgs, FiguresArgs, FiguresCommand, ImageFormatArg,
    LearningArgs, MissesFigureArgs, QTableArgs, RankingArg, RobustnessArgs, SweepFigureArgs, TimelineArgs,
    other_figures,
};
pub(crate) use inspect::{
    ColourArg, DashboardArgs, ExportArgs, ExportFormatArg, InspectCommand, InspectRecordArgs, MissesArgs, StatsArgs,
    TailArgs, VerifyArgs,
};
pub(crate) use parse::{most_similar_name, parse_duration, parse_pace};
pub(crate) use report::{ReportArgs, ReportCommand, SearchArgs};
pub(crate) use run::{
    AuditArg, BsArgs, DEFAULT_SCENARIO, DeviceArgs, DriveArgs, ExternalPolicyArgs, OnLossArg, OnUndecidedArg,
    OutputArgs, PolicyProcessArgs, RouterArgs, RunArgs, ScenarioArgs, UpArgs,
};
pub(crate) use sweep::{GridArgs, MergeArgs, SweepArgs};
pub(crate) use testbed::{
    FaultKind, LinkArgs, TestbedArgs, TestbedCommand, TestbedInitArgs, TestbedUpArgs, parse_loss,
};
pub(crate) use tls::TlsCommand;
#[cfg(feature = "tls")]
pub(crate) use tls::TlsInitArgs;
pub(crate) use tools::{
    ActArgs, BenchCommand, BusBenchArgs, ClockArgs, MemoryBenchArgs, ScaleBenchArgs, ScenarioCommand, StudyBenchArgs,
    TargetArgs, WatchBenchArgs,
};
#[cfg(feature = "train-dt")]
pub(crate) use train::DtArgs;
pub(crate) use train::{QLearningArgs, RecordArgs, TrainCommand};
#[cfg(feature = "tune")]
pub(crate) use tune::ObjectiveArg;
pub(crate) use tune::TuneArgs;

/// Emulate a base station and many battery-less IoT devices that run on harvested energy.
#[derive(Parser)]
#[command(name = "reveille", version, arg_required_else_help = true)]
#[command(help_template = groups::help_template(), after_help = after_help())]
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
    let examples = examples!("reveille up", "reveille up --devices 250 --processes 250");
    format!("{}\n\n{examples}", crate::exit::exit_codes_help())
}

impl Cli {
    /// Returns the logging options to pass to child processes. A new global option for logging belongs here too.
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
    /// Run a base station and its device processes on this machine, and print the results
    #[command(after_help = examples!("reveille up", "reveille up --policy genie --devices 250 --processes 10"))]
    Up(UpArgs),
    /// Run a scenario in memory: the same results as `up`, without processes or a network
    #[command(after_help = examples!("reveille run", "reveille run --policy q-learning --devices 100 --json"))]
    Run(RunArgs),
    /// Run every combination of policies, scenario fields and seeds in memory, and print mean results
    ///
    /// The result table has one row per run; the printed means have confidence intervals.
    ///
    /// To resume an interrupted sweep, repeat the same command; this also works after kill -9. With more --seeds and
    /// the same --out, the sweep keeps the existing runs and adds the new ones.
    #[command(after_help = examples!(
        "reveille sweep --policies knn,random --devices 10,50,250 --seeds 100",
        "reveille sweep --grid harvest.lambda=0.05,0.1,0.2 --until-ci 1% --out study",
    ))]
    Sweep(SweepArgs),
    /// Merge the result tables of a sweep that several machines shared
    #[command(after_help = examples!(
        "reveille merge shard-1 shard-2 shard-3 --out results.parquet",
        "reveille merge shard-1 shard-3 --partial --out part.csv",
    ))]
    Merge(MergeArgs),
    /// Train a learning policy in memory, and save the result in a file
    #[command(subcommand, after_help = examples!(
        "reveille train q-learning --out mine.json",
        "reveille train record --policies knn --devices 50 --seeds 8 --out knn.parquet",
    ))]
    Train(TrainCommand),
    /// Search for the q-learning weights that give the best results in a scenario
    ///
    /// The search is a Bayesian optimisation over the weights μ1 and μ2. It needs a build with the cargo feature
    /// `tune`.
    ///
    /// To resume an interrupted tuning, repeat the same command; this also works after kill -9. To extend a finished
    /// tuning, repeat it with more --iterations.
    #[command(after_help = examples!(
        "reveille tune -n 100 --out tuning.csv",
        "reveille tune -n 100 --objective efficiency --out efficiency.csv",
    ))]
    Tune(TuneArgs),
    /// Start only the base station, and wait for device processes to join
    ///
    /// Start device processes with `reveille device`, on this machine or on others.
    #[command(after_help = examples!(
        "reveille bs --run demo --devices 50",
        "reveille bs --run demo --devices 50 --listen tls/0.0.0.0:7447 --tls certificates",
    ))]
    Bs(BsArgs),
    /// Start one device process, and connect it to a base station
    #[command(after_help = examples!(
        "reveille device --run demo --connect tcp/127.0.0.1:7447",
        "reveille device --run demo --connect tcp/192.0.2.7:7447 --count 25 --connect-timeout 5min",
    ))]
    Device(DeviceArgs),
    /// Forward the messages of a run between device processes on one network and a base station on another
    ///
    /// Device processes, observers and further routers connect to a router as they would to the base station. The
    /// router runs until Ctrl-C. It reconnects after a lost link, and follows a base station that is started again.
    #[command(after_help = examples!(
        "reveille router --run demo --listen tcp/0.0.0.0:7447 --connect tcp/192.0.2.7:7447",
        "reveille router --run demo --listen tcp/0.0.0.0:7448 --connect tcp/bs:7447 --key-file run.key",
    ))]
    Router(RouterArgs),
    /// Make and drive a testbed of containers for a scenario
    ///
    /// `init` writes the files of a testbed, `up` runs it. The containers need Docker with compose, and an image of
    /// Reveille.
    #[command(after_help = examples!(
        "reveille testbed init --scenario paper --containers 5 --out demo",
        "reveille testbed up demo --check",
    ))]
    Testbed(TestbedArgs),
    /// Relay TCP connections with a delay and losses, as a slow link between device processes and a base station
    #[command(after_help = examples!(
        "reveille link --listen tcp/127.0.0.1:7450 --connect tcp/127.0.0.1:7447 --delay 20ms",
        "reveille link --listen tcp/0.0.0.0:7447 --connect tcp/192.0.2.7:7447 --delay 20ms --loss 1%",
    ))]
    Link(LinkArgs),
    /// Supervise the process that `--policy-command` starts
    #[command(hide = true)]
    PolicyProcess(PolicyProcessArgs),
    /// Show or validate scenarios, the complete descriptions of runs
    #[command(subcommand, after_help = examples!(
        "reveille scenario show paper",
        "reveille scenario check my.toml",
    ))]
    Scenario(ScenarioCommand),
    /// Make and show certificates for mutual TLS between the processes of a run
    ///
    /// It needs a build with the cargo feature `tls`.
    #[command(subcommand, after_help = examples!(
        "reveille tls init certificates --name 192.0.2.7",
        "reveille tls show certificates",
    ))]
    Tls(TlsCommand),
    /// Inspect the messages of an active run or of a recording, or record an active run
    #[command(subcommand, after_help = examples!(
        "reveille inspect tail --kind wake,report --pair-wake-ups",
        "reveille inspect stats run.mcap",
    ))]
    Inspect(InspectCommand),
    /// Compare runs, the policies of a sweep, or sweeps
    ///
    /// RUN is a run folder, or a recording. Metrics appear side by side, with their differences from the first run. Run
    /// folders also provide 95 % intervals. The first difference is searched in the messages of two recordings: events,
    /// δ plans, reports, failures, wake-ups and their outcomes; of run folders in their events.
    ///
    /// SWEEP is the folder of a sweep, or its result table. Each policy is compared with a reference policy over the
    /// same seeds: the mean difference of each metric with its 95 % interval, for each N. Of several sweeps with
    /// different fields or actions, each policy is also compared with itself in the first sweep.
    #[command(after_help = examples!(
        "reveille compare runs/knn-n50-s1 runs/age-index-n50-s1",
        "reveille compare study --against knn --metric misdetection_pct",
    ))]
    Compare(CompareArgs),
    /// Show an active run or a recording in the browser
    #[command(after_help = examples!("reveille dashboard", "reveille dashboard run.mcap"))]
    Dashboard(DashboardArgs),
    /// Pause, step and resume the virtual clock of a run, and act on its devices
    #[command(after_help = examples!("reveille clock pause", "reveille clock step 50"))]
    Clock(ClockArgs),
    /// Draw the figures of the paper from the result tables of sweeps
    ///
    /// The subcommands draw other pictures, such as a map of a deployment, or batteries and states over time.
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = examples!(
            "reveille figures study --out figures",
            "reveille figures study --only information,energy --format svg",
        )
    )]
    Figures(FiguresArgs),
    /// Compare the results of sweeps with every claim of the paper, and write an HTML and a Markdown page
    #[command(
        args_conflicts_with_subcommands = true,
        subcommand_negates_reqs = true,
        after_help = examples!(
            "reveille report study --out report",
            "reveille report paper.parquet literal.parquet --out report",
        )
    )]
    Report(ReportArgs),
    /// Compare the formulas of the paper with simulated devices
    #[command(subcommand, after_help = examples!(
        "reveille analyse harvest --csv fig13.csv",
        "reveille analyse runtime --devices 100,200,400 --policies knn",
    ))]
    Analyse(AnalyseCommand),
    /// Measure the speed of the emulator
    #[command(subcommand, after_help = examples!(
        "reveille bench memory",
        "reveille bench bus --processes 4,50",
    ))]
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
