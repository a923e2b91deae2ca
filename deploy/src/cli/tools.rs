//! Options of `reveille scenario`, `reveille clock` and `reveille bench`, which `commands/scenario.rs`,
//! `commands/clock.rs` and `bench/` execute. Names of options are a public interface (see `cli`). `bench/bare.rs`
//! writes the arguments of the hidden `bench bare-host`. The helps of `--keep-density` repeat `REFERENCE_DEVICES` of
//! `bench/scale.rs` and `bench/memory.rs`.

use std::path::PathBuf;
use std::time::Duration;

use clap::builder::StringValueParser;
use clap::{Args, Subcommand};
use reveille_bs::policy::registry;
use reveille_common::ids::{MAX_DEVICES, MAX_TTIS, Tti};
use reveille_common::keys::RunName;
use reveille_common::message::{ActRequest, Change, ClockCommand, DeviceRange, Pace, Setting};
use reveille_common::units::Energy;
use reveille_lab::action_script::{parse_devices, parse_energy, parse_setting};

use super::examples::examples;
use super::parse::{parse_duration, parse_pace, parse_sizes, trimmed, whole};

/// Subcommands of `reveille scenario`.
#[derive(Subcommand)]
pub(crate) enum ScenarioCommand {
    /// Print a scenario with every field, or list the presets if no name is given
    #[command(after_help = examples!(
        "reveille scenario show",
        "reveille scenario show paper --set harvest.lambda=0.05",
    ))]
    Show {
        /// Preset name or TOML file.
        source: Option<String>,
        /// Override one scenario field. May be repeated.
        #[arg(long, value_name = "FIELD=VALUE")]
        set: Vec<String>,
    },
    /// Print a JSON Schema of scenario files, for completion and validation in editors
    #[command(after_help = examples!(
        "reveille scenario schema",
        "reveille scenario schema --out scenario.schema.json",
    ))]
    Schema {
        /// Write the output to this file [default: standard output].
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Print docs/scenario.md, the reference page of all fields
    #[command(hide = true)]
    Reference {
        /// Write the output to this file [default: standard output].
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Validate scenario files, and print a summary and the energy balance of each
    #[command(after_help = examples!(
        "reveille scenario check my.toml",
        "reveille scenario check paper quick --devices 100 --set harvest.lambda=0.05",
    ))]
    Check {
        /// Preset names or TOML files.
        #[arg(required = true)]
        sources: Vec<String>,
        /// Override one scenario field. May be repeated.
        #[arg(long, value_name = "FIELD=VALUE")]
        set: Vec<String>,
        /// Number of devices N.
        #[arg(long, short = 'n', allow_negative_numbers = true)]
        devices: Option<String>,
        /// Policy.
        #[arg(long, short)]
        policy: Option<String>,
        /// Length of the run K in TTIs.
        #[arg(long, short = 'k', allow_negative_numbers = true)]
        ttis: Option<String>,
        /// Seed of every random draw, such as the positions of the devices.
        #[arg(long, allow_negative_numbers = true)]
        seed: Option<String>,
    },
}

/// Options that select a run on the bus.
#[derive(Args, Clone, Debug)]
pub(crate) struct TargetArgs {
    /// Endpoint of the base station: tcp/ADDRESS:PORT, or tls/HOST:PORT with --tls [default: the run on this
    /// machine].
    #[arg(long, requires = "run", global = true)]
    pub connect: Option<String>,
    /// Run name [default: the only run on this machine].
    #[arg(long, global = true)]
    pub run: Option<RunName>,
    /// File with the run's key, which clock commands need [default: the key of the current user's run on this machine].
    #[arg(long, value_name = "FILE", global = true)]
    pub key_file: Option<PathBuf>,
    /// Folder of `reveille tls init`, for an encrypted endpoint; the subfolder of the role suffices [default: the
    /// folder of the run on this machine].
    #[arg(long, value_name = "FOLDER", global = true)]
    pub tls: Option<PathBuf>,
}

/// Arguments of `reveille clock`.
#[derive(Args)]
pub(crate) struct ClockArgs {
    /// Run to control.
    #[command(flatten)]
    pub target: TargetArgs,
    /// The clock command.
    #[command(subcommand)]
    pub command: ClockSubcommand,
}

/// Subcommands of `reveille clock`.
#[derive(Subcommand, Clone)]
pub(crate) enum ClockSubcommand {
    /// Pause the run before its next time slot (TTI)
    ///
    /// The command returns when the open TTI is closed, or reports after 2 s that it is still open.
    #[command(after_help = examples!("reveille clock pause", "reveille clock pause --run demo"))]
    Pause,
    /// Run the given number of time slots (TTIs), then pause
    ///
    /// Without --wait, the command returns immediately.
    #[command(after_help = examples!("reveille clock step", "reveille clock step 50 --wait"))]
    Step {
        /// Number of TTIs to advance.
        #[arg(default_value_t = 1, value_parser = whole(1..=u64::MAX), allow_negative_numbers = true)]
        ttis: u64,
        /// Return only when the clock has paused there or the run has ended. A run that fails or is interrupted
        /// earlier, or a clock that another command stops earlier, is an error.
        #[arg(long)]
        wait: bool,
    },
    /// Run up to the given time slot (TTI), then pause
    ///
    /// Without --wait, the command returns immediately.
    #[command(after_help = examples!("reveille clock run-to 4000", "reveille clock run-to 4000 --wait"))]
    RunTo {
        /// TTI before which the clock pauses.
        #[arg(value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
        tti: u64,
        /// Return only when the clock has paused there or the run has ended, as for `step`.
        #[arg(long)]
        wait: bool,
    },
    /// Let a paused run continue to its end; the command returns immediately
    #[command(after_help = examples!("reveille clock resume", "reveille clock resume --run demo"))]
    Resume,
    /// Set the real time that the run spends on each time slot (TTI)
    #[command(after_help = examples!("reveille clock pace 20ms", "reveille clock pace max"))]
    Pace {
        /// Real time per TTI, such as 4ms, or TTIs per second, such as 50/s; `max` runs as fast as the devices answer.
        #[arg(value_parser = parse_pace, allow_hyphen_values = true)]
        pace: Pace,
    },
    /// Fail or revive devices, add energy to them, or change a setting of the run
    ///
    /// The action takes effect at the start of a time slot (TTI), by default the first one that is not granted yet. It
    /// is stored in the input log (inputs.log) of the run, so that a replay repeats it.
    #[command(after_help = examples!("reveille clock act fail 7", "reveille clock act fail 0-9 --at 500"))]
    Act(ActArgs),
    /// Print whether the run is paused, and its next time slot (TTI)
    #[command(after_help = examples!(
        "reveille clock status",
        "reveille clock status --hosts --run demo --connect tcp/192.0.2.7:7447",
    ))]
    Status {
        /// List the device processes with their devices, machines and addresses.
        #[arg(long)]
        hosts: bool,
    },
}

impl ClockSubcommand {
    /// Whether the command returns only after the clock has paused or the run has ended.
    pub(crate) const fn waits(&self) -> bool {
        match self {
            Self::Step { wait, .. } | Self::RunTo { wait, .. } => *wait,
            Self::Pause | Self::Resume | Self::Pace { .. } | Self::Act(_) | Self::Status { .. } => false,
        }
    }

    /// Whether the command prints the hosts after the status.
    pub(crate) const fn lists_hosts(&self) -> bool {
        matches!(self, Self::Status { hosts: true })
    }

    /// Returns the command to send to the clock.
    ///
    /// # Errors
    /// The arguments of `act`, which is an action on the run and not a command.
    pub(crate) fn clock_command(&self) -> Result<ClockCommand, &ActArgs> {
        Ok(match self {
            Self::Pause => ClockCommand::Pause,
            Self::Step { ttis, .. } => ClockCommand::Step(*ttis),
            Self::RunTo { tti, .. } => ClockCommand::RunTo(Tti(*tti)),
            Self::Resume => ClockCommand::Resume,
            Self::Pace { pace } => ClockCommand::Pace(*pace),
            Self::Act(act) => return Err(act),
            Self::Status { .. } => ClockCommand::Status,
        })
    }
}

/// Arguments of `reveille clock act`.
#[derive(Args, Clone)]
pub(crate) struct ActArgs {
    /// TTI at whose start the action takes effect [default: the first TTI that is not granted yet].
    #[arg(
        long,
        value_name = "TTI",
        global = true,
        value_parser = whole(0..=MAX_TTIS),
        allow_negative_numbers = true
    )]
    pub at: Option<u64>,
    /// The action.
    #[command(subcommand)]
    pub change: ActChange,
}

/// Subcommands of `reveille clock act`: actions on a run.
#[derive(Subcommand, Clone)]
pub(crate) enum ActChange {
    /// Switch devices off: they do not sense, receive wake-ups or consume, and their batteries only charge
    #[command(after_help = examples!("reveille clock act fail 7", "reveille clock act fail 3,10-14 --at 500 --for 60"))]
    Fail {
        /// Devices and ranges of devices, such as 3,7,10-14, or `all`.
        #[arg(value_parser = parse_device_list)]
        devices: DeviceList,
        /// Revive the devices after this number of TTIs [default: they stay failed].
        #[arg(long = "for", value_name = "TTIS", value_parser = whole(1..=MAX_TTIS), allow_negative_numbers = true)]
        duration: Option<u64>,
    },
    /// Switch failed devices on again
    #[command(after_help = examples!("reveille clock act revive 7", "reveille clock act revive all --at 900"))]
    Revive {
        /// Devices and ranges of devices, such as 3,7,10-14, or `all`.
        #[arg(value_parser = parse_device_list)]
        devices: DeviceList,
    },
    /// Add energy to the battery of each device, at most up to E_max
    #[command(after_help = examples!("reveille clock act energy 7 2.5", "reveille clock act energy 0-9 10 --at 500"))]
    Energy {
        /// Devices and ranges of devices, such as 3,7,10-14, or `all`.
        #[arg(value_parser = parse_device_list)]
        devices: DeviceList,
        /// Energy for each device, units.
        #[arg(value_parser = parse_energy, allow_negative_numbers = true)]
        units: Energy,
    },
    /// Change a setting: events.alpha, or policy.age-index.price
    #[command(after_help = examples!(
        "reveille clock act set events.alpha 0.05",
        "reveille clock act set policy.age-index.price 0.5 --at 500",
    ))]
    Set {
        /// Scenario field.
        #[arg(value_parser = parse_setting)]
        field: Setting,
        /// New value.
        #[arg(value_parser = parse_setting_value, allow_negative_numbers = true)]
        value: SettingValue,
    },
}

impl ActArgs {
    /// Returns the request that revives the devices of an action that fails them for a number of TTIs from TTI `k` on.
    pub(crate) fn revival(&self, k: Tti) -> Option<ActRequest> {
        let ActChange::Fail { devices, duration } = &self.change else {
            return None;
        };
        Some(ActRequest {
            at: Some(k + (*duration)?),
            changes: devices.0.iter().copied().map(Change::Revive).collect(),
        })
    }
}

/// Devices on the command line.
#[derive(Clone, Debug)]
pub(crate) struct DeviceList(Vec<DeviceRange>);

/// The value of a setting on the command line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SettingValue(f64);

fn parse_setting_value(text: &str) -> Result<SettingValue, String> {
    let value = text.parse().map_err(|_| "must be a number".to_owned())?;
    Ok(SettingValue(value))
}

fn parse_device_list(text: &str) -> Result<DeviceList, String> {
    parse_devices(text).map(DeviceList)
}

impl From<&ActArgs> for ActRequest {
    fn from(args: &ActArgs) -> Self {
        let on_each = |devices: &DeviceList, change: &dyn Fn(DeviceRange) -> Change| {
            devices.0.iter().copied().map(change).collect()
        };
        Self {
            at: args.at.map(Tti),
            changes: match &args.change {
                ActChange::Fail { devices, .. } => on_each(devices, &Change::Fail),
                ActChange::Revive { devices } => on_each(devices, &Change::Revive),
                ActChange::Energy { devices, units } => on_each(devices, &|range| Change::AddEnergy(range, *units)),
                ActChange::Set { field, value } => vec![Change::Set(*field, value.0)],
            },
        }
    }
}

/// Subcommands of `reveille bench`.
#[derive(Subcommand)]
pub(crate) enum BenchCommand {
    /// Measure the speed of runs over the bus, in TTIs per second
    ///
    /// For comparison, the same session measures bare barriers over zenoh and over unix sockets.
    #[command(after_help = examples!("reveille bench bus", "reveille bench bus --processes 4,50 --time 10s"))]
    Bus(BusBenchArgs),
    /// Measure the speed of runs in memory on one core, in device-TTIs per second
    #[command(after_help = examples!("reveille bench memory", "reveille bench memory --devices 50,250 --policies knn"))]
    Memory(MemoryBenchArgs),
    /// Measure the cost of a device-TTI against the number of devices
    ///
    /// The runs are in memory, over the bus, and over the bus without lookahead.
    #[command(after_help = examples!("reveille bench scale", "reveille bench scale --devices 10,100 --ttis 500"))]
    Scale(ScaleBenchArgs),
    /// Measure the time of a part of the paper's study, and project the whole
    ///
    /// The study has 1000 seeds of 10 000 TTIs for each policy and each of ten numbers of devices.
    #[command(after_help = examples!("reveille bench study", "reveille bench study --policies dt --seeds 2"))]
    Study(StudyBenchArgs),
    /// Measure the slowdown of a run by a recording, a metrics reader and a browser dashboard
    #[command(after_help = examples!("reveille bench watch", "reveille bench watch --devices 50 --browsers 0"))]
    Watch(WatchBenchArgs),
    /// Run one host of a bare barrier
    #[command(hide = true)]
    BareHost {
        /// `zenoh` or `unix`.
        kind: String,
        /// Endpoint or socket path.
        at: String,
        /// Sizes of a grant and of its answer, in bytes.
        #[arg(value_name = "GRANT,ANSWER", value_parser = parse_sizes)]
        sizes: (usize, usize),
        /// Number of the host.
        #[arg(value_parser = whole(0..=u32::MAX), allow_negative_numbers = true)]
        number: u32,
        /// Parent process; this process ends when the parent ends.
        #[arg(value_parser = whole(1..=i32::MAX), allow_negative_numbers = true)]
        parent: i32,
    },
}

/// Arguments of `reveille bench bus`.
#[derive(Args)]
pub(crate) struct BusBenchArgs {
    /// Numbers of device processes to measure.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "1,4,50,250",
        value_parser = whole(1..=u32::MAX),
        allow_negative_numbers = true
    )]
    pub processes: Vec<u32>,
    /// Duration of each measurement.
    #[arg(long, default_value = "3s", value_parser = parse_duration)]
    pub time: Duration,
    /// Number of repetitions; the results are medians.
    #[arg(long, default_value_t = 3, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub repeat: u32,
}

/// Arguments of `reveille bench scale`.
#[derive(Args)]
pub(crate) struct ScaleBenchArgs {
    /// Numbers of devices to measure.
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        default_value = "10,100,1000,10000",
        value_parser = whole(1..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: Vec<u32>,
    /// Number of device processes, at most the number of devices.
    #[arg(long, short = 'P', default_value_t = 8, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub processes: u32,
    /// Policy of the runs.
    #[arg(long, short, default_value = "knn")]
    pub policy: String,
    /// Length of each run in TTIs.
    #[arg(
        long,
        short = 'k',
        default_value_t = 1_000,
        value_parser = whole(1..=MAX_TTIS),
        allow_negative_numbers = true
    )]
    pub ttis: u64,
    /// Scale the area with the number of devices, to keep the density of 50 devices on the preset's area.
    #[arg(long)]
    pub keep_density: bool,
    /// Number of repetitions; the results are medians.
    #[arg(long, default_value_t = 3, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub repeat: u32,
}

/// Arguments of `reveille bench watch`.
#[derive(Args)]
pub(crate) struct WatchBenchArgs {
    /// Policy of the runs.
    #[arg(long, short, default_value = "knn")]
    pub policy: String,
    /// Number of devices.
    #[arg(
        long,
        short = 'n',
        default_value_t = 250,
        value_parser = whole(1..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: u32,
    /// Number of device processes.
    #[arg(long, short = 'P', default_value_t = 10, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub processes: u32,
    /// Length of each run in TTIs.
    #[arg(
        long,
        short = 'k',
        default_value_t = 40_000,
        value_parser = whole(1..=MAX_TTIS),
        allow_negative_numbers = true
    )]
    pub ttis: u64,
    /// Number of browsers that show the dashboard.
    #[arg(long, default_value_t = 1, value_parser = whole(0..=u32::MAX), allow_negative_numbers = true)]
    pub browsers: u32,
    /// Number of pairs of runs; the results are medians.
    #[arg(long, default_value_t = 5, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub repeat: u32,
}

/// Option `--policies` of benchmarks in memory.
#[derive(Args)]
pub(crate) struct BenchPolicyArgs {
    /// Policies to measure.
    #[arg(
        long,
        visible_alias = "policy",
        value_delimiter = ',',
        default_values_t = registry::names().map(str::to_owned),
        value_parser = trimmed(StringValueParser::new())
    )]
    pub policies: Vec<String>,
}

/// Arguments of `reveille bench study`.
#[derive(Args)]
pub(crate) struct StudyBenchArgs {
    /// Number of seeds of each policy and number of devices; the study has 1000.
    #[arg(long, default_value_t = 10, value_parser = whole(1..=1000_u32), allow_negative_numbers = true)]
    pub seeds: u32,
    #[command(flatten)]
    pub measured: BenchPolicyArgs,
    /// Number of threads [default: one per core].
    #[arg(long, short = 'j', value_parser = whole(1..=4096_u16), allow_negative_numbers = true)]
    pub threads: Option<u16>,
}

/// Arguments of `reveille bench memory`.
#[derive(Args)]
pub(crate) struct MemoryBenchArgs {
    /// Numbers of devices to measure.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "10,50,250,2500",
        value_parser = whole(1..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: Vec<u32>,
    #[command(flatten)]
    pub measured: BenchPolicyArgs,
    /// Length of each run in TTIs.
    #[arg(long, default_value_t = 100_000, value_parser = whole(1..=MAX_TTIS), allow_negative_numbers = true)]
    pub ttis: u64,
    /// Scale the area with the number of devices, to keep the density of 250 devices on the preset's area.
    #[arg(long)]
    pub keep_density: bool,
}
