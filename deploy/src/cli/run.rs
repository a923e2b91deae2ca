//! The options of everything that runs a scenario.

use std::path::PathBuf;
use std::time::Duration;

use clap::builder::NonEmptyStringValueParser;
use clap::{Args, ValueEnum};
use reveille_bs::host::{OnLoss, Patience, Undecided};
use reveille_common::keys::RunName;
use reveille_common::message::Pace;

use super::parse::{one_policy, one_policy_or_outside, parse_duration, parse_pace};

/// The scenario where none is named.
const DEFAULT_SCENARIO: &str = "paper";

/// The options that choose the scenario.
#[derive(Args, Clone, Debug)]
pub struct ScenarioArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file. See `reveille scenario show`.
    #[arg(long, short, default_value = DEFAULT_SCENARIO)]
    pub scenario: String,

    /// Override one field, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,

    /// Number of devices N.
    #[arg(long, short = 'n', allow_negative_numbers = true)]
    pub devices: Option<String>,

    /// One of the registered policies, or somebody outside.
    #[arg(long, short, help = one_policy(), long_help = one_policy_or_outside())]
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

impl ScenarioArgs {
    /// Whether any of them says something.
    pub fn is_given(&self) -> bool {
        let Self {
            scenario,
            set,
            devices,
            policy,
            learn,
            ttis,
            seed,
        } = self;
        scenario != DEFAULT_SCENARIO
            || !set.is_empty()
            || *learn
            || [devices, policy, ttis, seed].into_iter().any(Option::is_some)
    }
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

    /// Go on with the run in this folder, which was killed, interrupted or has failed. The scenario is the one in the
    /// folder. The run is replayed in memory up to its last mark, a second before its end at the most.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["out", "force"])]
    pub resume: Option<PathBuf>,

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
    /// What a run over the bus depended on beside scenario and seed, the inputs.log of its folder: devices that were
    /// lost under --on-loss continue. This run then comes to the same digest. Of decisions: --policy replay=FILE.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    pub inputs: Option<PathBuf>,
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
    /// With `wait` the clock is held until the process is back or another one carries its devices, from where a replay
    /// of the run finds them: `up` starts another one by itself, under `bs` any `reveille device` will do. The run ends
    /// with the same digest. `continue` is an outage: the devices are gone for good, the base station hears no more of
    /// them and is not told. When that was is kept in inputs.log; `reveille run --inputs` gives the same digest.
    #[arg(long, value_enum, default_value = "wait")]
    pub on_loss: OnLossArg,

    /// Compare the run with a replay in memory as it goes, so that nobody changes its result unseen.
    ///
    /// A difference ends the run with an error that names the TTI. `auto` takes a twentieth of the time at the most,
    /// and says so if the replay could not follow to the end.
    #[arg(long, value_enum, default_value = "auto")]
    pub audit: AuditArg,

    /// Serve a dashboard for the browser at this address while the run goes; port 0 takes any free one.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8464")]
    pub dashboard: Option<String>,

    /// Start with the clock paused; see `reveille clock`.
    #[arg(long)]
    pub paused: bool,

    /// Decisions of another program, under --policy external.
    #[command(flatten)]
    pub outside: OutsideArgs,
}

/// How a program outside decides.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Decisions of another program (--policy external)")]
pub struct OutsideArgs {
    /// Start this shell command to decide for the run, and end it with the run. It is told where to answer by
    /// REVEILLE_CONNECT, REVEILLE_RUN and REVEILLE_KEY; without it, start one by hand.
    #[arg(long, value_name = "COMMAND", value_parser = NonEmptyStringValueParser::new())]
    pub policy_command: Option<String>,

    /// How long a decision may take, for example 30s, a program that has to be started anew included [default: as long
    /// as it takes; after 5 s it is said who is waited for].
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub decision_timeout: Option<Duration>,

    /// What to do when a decision takes longer, or three answers to a question were none.
    #[arg(long, value_enum, value_name = "WHAT", default_value = "end")]
    pub on_undecided: OnUndecidedArg,
}

/// When nobody decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnUndecidedArg {
    /// End the run with an error; --resume goes on with it.
    End,
    /// Let the plan in force hold on, and wake nobody.
    Hold,
}

impl From<&OutsideArgs> for Patience {
    fn from(args: &OutsideArgs) -> Self {
        Self {
            limit: args.decision_timeout,
            then: match args.on_undecided {
                OnUndecidedArg::End => Undecided::End,
                OnUndecidedArg::Hold => Undecided::Hold,
            },
        }
    }
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
    /// Do without what makes device processes fast, to measure what that brings.
    #[arg(long, hide = true)]
    pub untuned: bool,
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
    /// Let only processes carry devices that have the key in this file; the file is made if it is not there.
    #[arg(long, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
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
    /// How long to try to reach the base station and to join, and to wait for one that is lost.
    #[arg(long, default_value = "30s", value_parser = parse_duration)]
    pub patience: Duration,
    /// The file with the run's key, where the base station asks for it.
    #[arg(long, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
    /// The process that started this one; when it ends, this one does.
    #[arg(long, hide = true)]
    pub parent: Option<i32>,
    /// How many device processes share the machine with this one, itself included.
    #[arg(long, hide = true, default_value_t = 1)]
    pub among: u32,
    /// Do without what makes a device process fast, to measure what that brings.
    #[arg(long, hide = true)]
    pub untuned: bool,
}

/// `reveille policy-process`.
#[derive(Args)]
pub struct PolicyProcessArgs {
    /// The process that started this one; when it ends, the command is ended.
    #[arg(long)]
    pub parent: i32,
    /// For the shell.
    pub command: String,
}

/// When a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnLossArg {
    /// End the run with an error.
    End,
    /// Hold the clock until its devices are carried again.
    Wait,
    /// Go on without its devices.
    Continue,
}

/// Whether a run is audited.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum AuditArg {
    /// As far as it costs little.
    Auto,
    /// All of it.
    On,
    /// Not at all.
    Off,
}

impl From<OnLossArg> for OnLoss {
    fn from(arg: OnLossArg) -> Self {
        match arg {
            OnLossArg::End => Self::End,
            OnLossArg::Wait => Self::Wait,
            OnLossArg::Continue => Self::Continue,
        }
    }
}
