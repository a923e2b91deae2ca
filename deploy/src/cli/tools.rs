//! The options of everything that looks at scenarios, at runs, and at speed.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use reveille_bs::policy::registry;
use reveille_common::ids::Tti;
use reveille_common::keys::RunName;
use reveille_common::message::{ClockCommand, Pace};

use super::parse::{parse_duration, parse_pace, parse_sizes};

/// `reveille scenario`.
#[derive(Subcommand)]
pub enum ScenarioCommand {
    /// Print a scenario with every field; without a name, list the presets.
    Show {
        /// A preset's name or a TOML file.
        source: Option<String>,
        /// Override one field. May be repeated.
        #[arg(long, value_name = "FIELD=VALUE")]
        set: Vec<String>,
    },
    /// Print a JSON Schema of scenario files, with which editors complete and check them.
    Schema {
        /// Write it to this file.
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Print the reference page of all fields, docs/scenario.md.
    #[command(hide = true)]
    Reference {
        /// Write it to this file.
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Check scenario files and say what they come to.
    Check {
        /// Preset names or TOML files.
        #[arg(required = true)]
        sources: Vec<String>,
        /// Override one field. May be repeated.
        #[arg(long, value_name = "FIELD=VALUE")]
        set: Vec<String>,
    },
}

/// A run on the bus.
#[derive(Args, Clone, Debug)]
pub struct TargetArgs {
    /// The base station: tcp/ADDRESS:PORT [default: the run on this machine].
    #[arg(long, requires = "run", global = true)]
    pub connect: Option<String>,
    /// The run's name [default: the only run on this machine].
    #[arg(long, global = true)]
    pub run: Option<RunName>,
    /// The file with the run's key, which commands to the clock need [default: the key of a run of yours on this
    /// machine].
    #[arg(long, value_name = "FILE", global = true)]
    pub key_file: Option<PathBuf>,
}

/// `reveille clock`.
#[derive(Args)]
pub struct ClockArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// What to do.
    #[command(subcommand)]
    pub command: ClockAction,
}

/// What to do with the clock.
#[derive(Subcommand, Clone, Copy)]
pub enum ClockAction {
    /// Stop before the next TTI. Returns when the TTI in work is closed, or says after 2 s that it is not.
    Pause,
    /// Go on for some TTIs, then stop. Returns at once, without --wait.
    Step {
        /// How many TTIs to go on for.
        #[arg(default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
        ttis: u64,
        /// Return only when the clock has stopped there, or the run has ended. A run that fails or is interrupted
        /// before that, or a clock that another command stops earlier, is an error.
        #[arg(long)]
        wait: bool,
    },
    /// Go on until this TTI is the next, then stop. Returns at once, without --wait.
    RunTo {
        /// The TTI.
        tti: u64,
        /// Return only when the clock has stopped there; as for `step`.
        #[arg(long)]
        wait: bool,
    },
    /// Go on to the end.
    Resume,
    /// Let TTIs follow each other at another pace.
    Pace {
        /// The time a TTI takes, such as 4ms, or `max` for as fast as the devices answer.
        #[arg(value_parser = parse_pace, allow_hyphen_values = true)]
        pace: Pace,
    },
    /// Say where the clock is.
    Status,
}

impl ClockAction {
    /// Whether the command returns only when the clock has stopped.
    pub const fn waits(self) -> bool {
        match self {
            Self::Step { wait, .. } | Self::RunTo { wait, .. } => wait,
            Self::Pause | Self::Resume | Self::Pace { .. } | Self::Status => false,
        }
    }
}

impl From<ClockAction> for ClockCommand {
    fn from(action: ClockAction) -> Self {
        match action {
            ClockAction::Pause => Self::Pause,
            ClockAction::Step { ttis, .. } => Self::Step(ttis),
            ClockAction::RunTo { tti, .. } => Self::RunTo(Tti(tti)),
            ClockAction::Resume => Self::Resume,
            ClockAction::Pace { pace } => Self::Pace(pace),
            ClockAction::Status => Self::Status,
        }
    }
}

/// `reveille bench`.
#[derive(Subcommand)]
pub enum BenchCommand {
    /// TTIs per second over the bus, against a bare zenoh barrier and a bare unix-socket barrier, in one go.
    Bus(BusBenchArgs),
    /// Device-TTIs per second in memory, on one core.
    Memory(MemoryBenchArgs),
    /// What a device-TTI costs against the number of devices: in memory, over the bus, over the bus TTI by TTI.
    Scale(ScaleBenchArgs),
    /// TTIs per second of a run that is recorded, scraped and shown in a browser, against the same run alone.
    Watch(WatchBenchArgs),
    /// One host of a bare barrier.
    #[command(hide = true)]
    BareHost {
        /// `zenoh` or `unix`.
        kind: String,
        /// Endpoint or socket path.
        at: String,
        /// Bytes of a tick and of its answer.
        #[arg(value_parser = parse_sizes)]
        sizes: (usize, usize),
        /// Its number.
        number: u32,
    },
}

/// `reveille bench bus`.
#[derive(Args)]
pub struct BusBenchArgs {
    /// Numbers of device processes to measure.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "1,4,50,250",
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    pub processes: Vec<u32>,
    /// Time for each measurement.
    #[arg(long, default_value = "3s", value_parser = parse_duration)]
    pub time: Duration,
    /// Repetitions; the median ratio counts.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// `reveille bench scale`.
#[derive(Args)]
pub struct ScaleBenchArgs {
    /// Numbers of devices to measure.
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        default_value = "10,100,1000,10000",
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    pub devices: Vec<u32>,
    /// Device processes, where there are as many devices.
    #[arg(long, short = 'P', default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub processes: u32,
    /// Policy of the runs.
    #[arg(long, short, default_value = "knn")]
    pub policy: String,
    /// TTIs of each run.
    #[arg(long, short = 'k', default_value_t = 1_000)]
    pub ttis: u64,
    /// Let the area grow with the number of devices, as dense as 50 of them on the preset's area.
    #[arg(long)]
    pub keep_density: bool,
    /// Repetitions; the medians count.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// `reveille bench watch`.
#[derive(Args)]
pub struct WatchBenchArgs {
    /// Policy of the runs.
    #[arg(long, short, default_value = "knn")]
    pub policy: String,
    /// Devices.
    #[arg(long, short = 'n', default_value_t = 250)]
    pub devices: u32,
    /// Device processes.
    #[arg(long, short = 'P', default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub processes: u32,
    /// TTIs of each run.
    #[arg(long, short = 'k', default_value_t = 40_000)]
    pub ttis: u64,
    /// Browsers that follow the dashboard.
    #[arg(long, default_value_t = 1)]
    pub browsers: u32,
    /// Pairs of runs; the median ratio counts.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// `reveille bench memory`.
#[derive(Args)]
pub struct MemoryBenchArgs {
    /// Numbers of devices to measure.
    #[arg(long, value_delimiter = ',', default_value = "10,50,250,2500")]
    pub devices: Vec<u32>,
    /// Policies to measure.
    #[arg(long, value_delimiter = ',', default_values_t = registry::names().map(str::to_owned))]
    pub policies: Vec<String>,
    /// TTIs of each run.
    #[arg(long, default_value_t = 100_000)]
    pub ttis: u64,
    /// Let the area grow with the number of devices, as dense as 250 of them on the preset's area.
    #[arg(long)]
    pub keep_density: bool,
}
