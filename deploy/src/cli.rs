//! The command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use reveille_bs::actor::OnLoss;
use reveille_common::keys::{Kind, Plane, RunName};
use reveille_common::logging::LogFormat;
use reveille_common::message::ClockCommand;

/// Emulates a base station and many battery-less IoT devices that live on harvested energy.
#[derive(Parser)]
#[command(name = "reveille", version, arg_required_else_help = true)]
#[command(after_help = "Start with:  reveille up\n\
    Then try:    reveille up --devices 250 --processes 250\n             \
    reveille up --pace 20ms   and, in another terminal,   reveille inspect tail")]
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
    /// Start only the base station, and wait for devices to connect.
    #[command(
        after_help = "Example, on two machines:\n  reveille bs --listen tcp/0.0.0.0:7447 --run demo --devices 50\n  \
        reveille device --connect tcp/HOST:7447 --run demo --count 50"
    )]
    Bs(BsArgs),
    /// Start one process of devices, and connect it to a base station.
    Device(DeviceArgs),
    /// Show or check scenarios.
    #[command(subcommand)]
    Scenario(ScenarioCommand),
    /// Look at a run while it goes.
    #[command(subcommand)]
    Inspect(InspectCommand),
    /// Pause, step and resume the virtual clock of a run.
    Clock(ClockArgs),
    /// Measure the emulator's speed against stated baselines.
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// Which scenario.
#[derive(Args, Clone, Debug)]
pub struct ScenarioArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file. See `reveille scenario show`.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,

    /// Override one field, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,

    /// Number of devices N.
    #[arg(long, short = 'n')]
    pub devices: Option<String>,

    /// Policy: knn, random or genie.
    #[arg(long, short)]
    pub policy: Option<String>,

    /// Length of the run K in TTIs, warm-up included.
    #[arg(long, short = 'k')]
    pub ttis: Option<String>,

    /// Seed of every random draw.
    #[arg(long)]
    pub seed: Option<String>,
}

/// Where results go.
#[derive(Args, Clone, Debug)]
pub struct OutputArgs {
    /// The run folder, which must not hold a run yet [default: runs/POLICY-nN-sSEED, numbered if taken].
    #[arg(long, short)]
    pub out: Option<PathBuf>,

    /// Replace the run that the folder given by --out holds.
    #[arg(long, requires = "out")]
    pub force: bool,

    /// Print summary.json to standard output instead of the table.
    #[arg(long)]
    pub json: bool,

    /// No progress bar and no table.
    #[arg(long, short)]
    pub quiet: bool,

    /// TTIs in a row of windows.csv [default: a hundredth of the run].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub window: Option<u64>,
}

/// `reveille run`.
#[derive(Args)]
pub struct RunArgs {
    /// The scenario.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The results.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Step through every TTI by itself, as the emulator does with --no-lookahead.
    #[arg(long)]
    pub no_lookahead: bool,
}

/// How the base station drives a run.
#[derive(Args, Clone, Debug)]
pub struct DriveArgs {
    /// `max`, or the real time that a TTI takes, for example 10ms.
    #[arg(long, default_value = "max", value_parser = parse_pace)]
    pub pace: reveille_bs::clock::Pace,

    /// Grant every TTI by itself: the same run, more messages.
    #[arg(long)]
    pub no_lookahead: bool,

    /// What to do when a device process is lost: end the run with an error, or wait for it to come back.
    #[arg(long, value_enum, default_value = "end")]
    pub on_loss: OnLossArg,

    /// Start with the clock paused; see `reveille clock`.
    #[arg(long)]
    pub paused: bool,
}

/// `reveille up`.
#[derive(Args)]
pub struct UpArgs {
    /// The scenario.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The results.
    #[command(flatten)]
    pub output: OutputArgs,
    /// The drive.
    #[command(flatten)]
    pub drive: DriveArgs,
    /// Device processes; 0 carries all devices in this process, N (the number of devices) gives each its own.
    #[arg(long, short = 'P', default_value_t = 4)]
    pub processes: u32,
    /// The run's name on the bus [default: the name of the run folder].
    #[arg(long)]
    pub run: Option<RunName>,
    /// Where the base station listens; port 0 takes any free one.
    #[arg(long, default_value = "tcp/127.0.0.1:0")]
    pub listen: String,
}

/// `reveille bs`.
#[derive(Args)]
pub struct BsArgs {
    /// The scenario.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The results.
    #[command(flatten)]
    pub output: OutputArgs,
    /// The drive.
    #[command(flatten)]
    pub drive: DriveArgs,
    /// The run's name on the bus, which devices must name too.
    #[arg(long)]
    pub run: RunName,
    /// Where to listen: tcp/ADDRESS:PORT.
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub listen: String,
    /// Give up if not all devices have joined after this time [default: wait].
    #[arg(long, value_parser = parse_duration)]
    pub join_timeout: Option<Duration>,
}

/// `reveille device`.
#[derive(Args)]
pub struct DeviceArgs {
    /// The base station: tcp/ADDRESS:PORT.
    #[arg(long)]
    pub connect: String,
    /// The run's name on the bus.
    #[arg(long)]
    pub run: RunName,
    /// How many devices to carry, at the most.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub count: u32,
    /// How long to try to reach the base station and to join.
    #[arg(long, default_value = "30s", value_parser = parse_duration)]
    pub patience: Duration,
    /// The process that started this one; when it ends, this one does.
    #[arg(long, hide = true)]
    pub parent: Option<i32>,
}

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
    #[arg(long, requires = "run")]
    pub connect: Option<String>,
    /// The run's name [default: the only run on this machine].
    #[arg(long)]
    pub run: Option<RunName>,
}

/// `reveille inspect`.
#[derive(Subcommand)]
pub enum InspectCommand {
    /// Print every message of a run, decoded, one a line, as it goes. The run never waits for it.
    Tail(TailArgs),
}

/// `reveille inspect tail`.
#[derive(Args)]
pub struct TailArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Only this plane.
    #[arg(long, value_enum)]
    pub plane: Option<PlaneArg>,
    /// Only these kinds. May be repeated.
    #[arg(long, value_parser = parse_kind)]
    pub kind: Vec<Kind>,
    /// Only messages to or from this device.
    #[arg(long)]
    pub device: Option<u32>,
    /// One JSON object a line.
    #[arg(long)]
    pub json: bool,
    /// End after this many messages.
    #[arg(long, short = 'c')]
    pub count: Option<u64>,
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
    /// Stop before the next TTI.
    Pause,
    /// Go on for some TTIs, then stop.
    Step {
        /// How many.
        #[arg(default_value_t = 1)]
        ttis: u64,
    },
    /// Go on until this TTI is the next, then stop.
    RunTo {
        /// The TTI.
        tti: u64,
    },
    /// Go on to the end.
    Resume,
    /// Say where the clock is.
    Status,
}

impl From<ClockAction> for ClockCommand {
    fn from(action: ClockAction) -> Self {
        match action {
            ClockAction::Pause => Self::Pause,
            ClockAction::Step { ttis } => Self::Step(ttis),
            ClockAction::RunTo { tti } => Self::RunTo(reveille_common::ids::Tti(tti)),
            ClockAction::Resume => Self::Resume,
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
    #[arg(long, value_delimiter = ',', default_value = "1,4,50,250")]
    pub processes: Vec<u32>,
    /// Seconds for each measurement.
    #[arg(long, default_value_t = 3.0)]
    pub seconds: f64,
    /// Repetitions; the median ratio counts.
    #[arg(long, default_value_t = 3)]
    pub repeat: u32,
}

/// `reveille bench memory`.
#[derive(Args)]
pub struct MemoryBenchArgs {
    /// Numbers of devices to measure.
    #[arg(long, value_delimiter = ',', default_value = "10,50,250,2500")]
    pub devices: Vec<u32>,
    /// Policies to measure.
    #[arg(long, value_delimiter = ',', default_value = "knn,random,genie")]
    pub policies: Vec<String>,
    /// TTIs of each run.
    #[arg(long, default_value_t = 100_000)]
    pub ttis: u64,
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

/// When a host is lost.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum OnLossArg {
    /// End the run with an error.
    End,
    /// Hold the clock until it is back.
    Wait,
}

impl From<OnLossArg> for OnLoss {
    fn from(arg: OnLossArg) -> Self {
        match arg {
            OnLossArg::End => Self::End,
            OnLossArg::Wait => Self::Wait,
        }
    }
}

/// A plane on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PlaneArg {
    /// What a real deployment would send.
    Air,
    /// What only the emulation needs.
    Emu,
}

impl From<PlaneArg> for Plane {
    fn from(arg: PlaneArg) -> Self {
        match arg {
            PlaneArg::Air => Self::Air,
            PlaneArg::Emu => Self::Emu,
        }
    }
}

fn parse_sizes(text: &str) -> Result<(usize, usize), String> {
    let pair = text
        .split_once(',')
        .and_then(|(tick, answer)| Some((tick.parse().ok()?, answer.parse().ok()?)));
    pair.ok_or_else(|| "must be TICK,ANSWER".to_owned())
}

fn parse_kind(text: &str) -> Result<Kind, String> {
    Kind::ALL.into_iter().find(|kind| kind.name() == text).ok_or_else(|| {
        let names: Vec<&str> = Kind::ALL.iter().map(|kind| kind.name()).collect();
        format!("must be one of {}", names.join(", "))
    })
}

fn parse_pace(text: &str) -> Result<reveille_bs::clock::Pace, String> {
    if text == "max" {
        return Ok(reveille_bs::clock::Pace::Max);
    }
    parse_duration(text)
        .map(reveille_bs::clock::Pace::RealTime)
        .map_err(|e| format!("must be `max` or {e}"))
}

fn parse_duration(text: &str) -> Result<Duration, String> {
    let units = [("us", 1e-6), ("ms", 1e-3), ("s", 1.0), ("min", 60.0)];
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = units
        .iter()
        .find(|(name, _)| *name == &text[number.len()..])
        .map(|(_, seconds)| seconds);
    match (number.parse::<f64>(), unit) {
        (Ok(n), Some(seconds)) if n > 0.0 && n * seconds <= 1e6 => Ok(Duration::from_secs_f64(n * seconds)),
        _ => Err("a time above 0 such as 500us, 10ms, 2s or 1min".to_owned()),
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

    #[test]
    fn durations_are_read() {
        assert_eq!(parse_duration("10ms"), Ok(Duration::from_millis(10)));
        assert_eq!(parse_duration("1.5s"), Ok(Duration::from_millis(1500)));
        for bad in ["", "10", "ms", "-1s", "0s", "nans", "1h", "1e99s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
    }
}
