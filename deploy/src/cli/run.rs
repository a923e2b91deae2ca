//! The options of everything that runs a scenario.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use reveille_bs::host::OnLoss;
use reveille_common::keys::RunName;
use reveille_common::message::Pace;

use super::parse::{one_policy, parse_duration, parse_pace};

/// The options that choose the scenario.
#[derive(Args, Clone, Debug)]
pub struct ScenarioArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file. See `reveille scenario show`.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,

    /// Override one field, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,

    /// Number of devices N.
    #[arg(long, short = 'n', allow_negative_numbers = true)]
    pub devices: Option<String>,

    /// One of the registered policies.
    #[arg(long, short, help = one_policy())]
    pub policy: Option<String>,

    /// Let a policy that learns go on learning in the run; the run folder keeps what it has learned.
    #[arg(long)]
    pub learn: bool,

    /// Length of the run K in TTIs, warm-up included.
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,

    /// Seed of every random draw.
    #[arg(long, allow_negative_numbers = true)]
    pub seed: Option<String>,
}

/// The options that say where results go.
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

    /// No progress bar and no table: only the digest, or what --json prints.
    #[arg(long, short)]
    pub quiet: bool,

    /// Record all messages of the run in this file, an MCAP container, for `reveille inspect` and other tools. Nothing
    /// is left out: the run waits for the disk if it must, and says how long it did.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,

    /// Record the states of all devices as well, once in so many TTIs.
    #[arg(long, value_name = "TTIS", requires = "record", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_states: Option<u64>,

    /// Serve metrics for Prometheus at http://ADDRESS:PORT/metrics while the run goes; port 0 takes any free one.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:9464")]
    pub metrics: Option<String>,

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
    #[arg(long, default_value = "max", value_parser = parse_pace, allow_hyphen_values = true)]
    pub pace: Pace,

    /// Grant every TTI by itself: the same run, more messages. A real-time --pace does so anyway.
    #[arg(long)]
    pub no_lookahead: bool,

    /// What to do when a device process is lost.
    ///
    /// `wait` is for links that break for a while and processes that freeze: the clock is held until the same process
    /// is back, and the run ends with the same digest. A process that is started anew cannot take over the devices of a
    /// lost one, whose states are gone with it: the base station refuses it.
    #[arg(long, value_enum, default_value = "end")]
    pub on_loss: OnLossArg,

    /// Serve a dashboard for the browser at this address while the run goes; port 0 takes any free one.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8464")]
    pub dashboard: Option<String>,

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
    /// Device processes; 0 carries all devices in this process, N (the number of devices) gives each its own [default:
    /// 4].
    #[arg(long, short = 'P')]
    pub processes: Option<u32>,
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

/// When a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnLossArg {
    /// End the run with an error.
    End,
    /// Hold the clock until the same process is back.
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
