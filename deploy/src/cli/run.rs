//! Options of the commands that run a scenario. `docs/command-line.md` must list every visible option of `up`, `run`,
//! `bs` and `device`; `cli/tests/option_table.rs` checks this. `child_process`, `policy_process` and `bench` write
//! the hidden ones. `cli/inspect.rs` repeats the address of `--dashboard`; the help of `ExternalPolicyArgs` repeats
//! constants of `bs/src/server/policy_port/mod.rs`. Other help texts repeat `MAIN_METRICS` (`results_table.rs`),
//! `MARK_INTERVAL` (`resume_mark.rs`) and the share of time of `--audit auto` (`audit.rs`).

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context as _;
use clap::builder::NonEmptyStringValueParser;
use clap::{Args, ValueEnum};
use reveille_bs::scenario::Scenario;
use reveille_bs::server::{DecisionTimeout, OnLoss, OnUndecided};
use reveille_common::io::Disk;
use reveille_common::keys::RunName;
use reveille_common::message::{DeviceRange, Pace};
use reveille_lab::action_script::{self, parse_devices};
use reveille_lab::external_inputs::ExternalInputs;

use super::parse::{parse_duration, parse_pace, policy_help, run_policy_help, whole};

/// Scenario used when the command line names none.
pub(crate) const DEFAULT_SCENARIO: &str = "paper";

/// Options that select the scenario.
#[derive(Args, Clone, Debug)]
pub(crate) struct ScenarioArgs {
    /// Preset name (paper, paper-literal, quick) or TOML file; see `reveille scenario show`.
    #[arg(long, short, default_value = DEFAULT_SCENARIO)]
    pub scenario: String,

    /// Override one scenario field, for example --set sensing.d_max=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,

    /// Number of devices N [default: the scenario's].
    #[arg(long, short = 'n', allow_negative_numbers = true)]
    pub devices: Option<String>,

    /// Registered policy, or a policy process.
    #[arg(long, short, help = policy_help(), long_help = run_policy_help())]
    pub policy: Option<String>,

    /// Let a learning policy continue to learn during the run. The run folder keeps the learned tables.
    #[arg(long)]
    pub learn: bool,

    /// Length of the run K in TTIs, warm-up included [default: the scenario's].
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,

    /// Seed of every random draw [default: the scenario's].
    #[arg(long, allow_negative_numbers = true)]
    pub seed: Option<String>,
}

impl Default for ScenarioArgs {
    /// Returns the options of a command line that has none of them.
    fn default() -> Self {
        Self {
            scenario: DEFAULT_SCENARIO.to_owned(),
            set: Vec::new(),
            devices: None,
            policy: None,
            learn: false,
            ttis: None,
            seed: None,
        }
    }
}

impl ScenarioArgs {
    /// Whether the command line sets any of these options to a value other than the default.
    pub(crate) fn is_given(&self) -> bool {
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

/// Options for the results of a run.
#[derive(Args, Clone, Debug)]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of the command line")]
pub(crate) struct OutputArgs {
    /// Run folder; it must not hold a run yet [default: runs/POLICY-nN-sSEED, numbered if taken].
    #[arg(long, short)]
    pub out: Option<PathBuf>,

    /// Replace the existing run in the folder given by --out.
    #[arg(long, requires = "out")]
    pub force: bool,

    /// Resume the killed, interrupted or failed run in FOLDER, with the scenario in the folder. The run first replays
    /// in memory up to its last resume mark, which is at most one second older than its end, and continues from there.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["out", "force"])]
    pub resume: Option<PathBuf>,

    /// Start the run, or resume it if the folder given by --out holds an unfinished run of this scenario. If that run
    /// is complete, print its digest and do nothing. Use it where an engine repeats the command, as for containers
    /// and batch jobs.
    #[arg(long = "continue", requires = "out", conflicts_with_all = ["resume", "force"])]
    pub continues: bool,

    /// Print summary.json to standard output instead of the table.
    #[arg(long)]
    pub json: bool,

    /// Show every metric in the table, not only the ten metrics that runs are compared by. --json always has all.
    #[arg(long)]
    pub all_metrics: bool,

    /// Hide the progress bar and the table. Print only the digest, or the JSON output of --json.
    #[arg(long, short)]
    pub quiet: bool,

    /// Record all messages of the run in this MCAP file, for `reveille inspect` and other tools. The file can be in the
    /// new folder of --out. The recording is complete: the run waits for the disk if necessary and reports the time it
    /// waited.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,

    /// Also record the states of all devices, once every TTIS TTIs.
    #[arg(
        long,
        value_name = "TTIS",
        requires = "record",
        value_parser = whole(1..=u64::MAX),
        allow_negative_numbers = true
    )]
    pub record_states: Option<u64>,

    /// Serve Prometheus metrics at http://ADDRESS:PORT/metrics during the run; port 0 selects a free port.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:9464")]
    pub metrics: Option<String>,

    /// TTIs per row of windows.csv [default: a hundredth of the run].
    #[arg(long, value_parser = whole(1..=u64::MAX), allow_negative_numbers = true)]
    pub window: Option<u64>,

    /// Parent process; the run ends when the parent ends.
    #[arg(long, hide = true, value_parser = whole(1..=i32::MAX), allow_negative_numbers = true)]
    pub parent: Option<i32>,
}

/// The script of actions.
#[derive(Args, Clone, Debug)]
pub(crate) struct ActionArgs {
    /// Script of timed actions: devices that fail, are revived or receive energy, and settings that change. See
    /// docs/actions.md for its lines. The inputs.log of any run repeats the actions of that run.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    pub actions: Option<PathBuf>,
}

impl ActionArgs {
    /// Adds the scripted actions to the `recorded_inputs`, if any, for the run of `scenario`. Logs warnings
    /// about actions in the warm-up and revivals without effect.
    ///
    /// # Errors
    /// If the script cannot be read, or a line is not an action of the run.
    pub(crate) fn read(
        &self,
        scenario: &Scenario,
        recorded_inputs: Option<ExternalInputs>,
    ) -> anyhow::Result<ExternalInputs> {
        let mut inputs = recorded_inputs.unwrap_or_default();
        if let Some(path) = &self.actions {
            let option = || format!("--actions {}", path.display());
            let text = action_script::read(path, &Disk)
                .map_err(anyhow::Error::msg)
                .with_context(option)?;
            let actions = action_script::parse(&text, scenario).with_context(option)?;
            for warning in action_script::warnings(&actions, scenario) {
                tracing::warn!("{}: {warning}", option());
            }
            inputs.actions.extend(actions);
        }
        Ok(inputs)
    }
}

/// Arguments of `reveille run`.
#[derive(Args)]
pub(crate) struct RunArgs {
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Result options.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Actions.
    #[command(flatten)]
    pub actions: ActionArgs,
    /// Process every TTI separately, like `reveille up --no-lookahead`.
    #[arg(long)]
    pub no_lookahead: bool,
    /// Input log (inputs.log) of a run over the bus. It lists the devices that were lost under --on-loss continue, and
    /// the actions of operators. With it, this run has the same digest. Without scenario options, the scenario is the
    /// scenario.toml next to FILE. To replay decisions, use --policy replay=FILE.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["resume", "actions"])]
    pub input_log: Option<PathBuf>,
}

/// Options for driving a run over the bus: clock, lost processes, audit, dashboard and policy process.
#[derive(Args, Clone, Debug)]
pub(crate) struct DriveArgs {
    /// Real time per TTI, for example 10ms, or TTIs per second, such as 50/s; `max` runs as fast as possible.
    #[arg(long, default_value = "max", value_parser = parse_pace, allow_hyphen_values = true)]
    pub pace: Pace,

    /// Grant every TTI separately. The run is the same but needs more messages. A real-time --pace also disables
    /// lookahead.
    #[arg(long)]
    pub no_lookahead: bool,

    /// Action when a device process is lost.
    ///
    /// With `wait`, the clock stops until the process returns or another process takes over its devices. A replay of
    /// the run supplies the states of these devices. `up` starts a replacement process itself; under `bs`, any
    /// `reveille device` can take over. The run ends with the same digest.
    ///
    /// With `continue`, the devices are removed permanently. The base station receives no more messages from them and
    /// no notice of the loss. The input log (inputs.log) keeps the TTI of the removal; `reveille run --input-log`
    /// reproduces the digest.
    #[arg(long, value_enum, default_value = "wait")]
    pub on_loss: OnLossArg,

    /// End the run with an error if devices are without a process for longer than this, under `--on-loss wait`. The
    /// run can be continued with --resume [default: no limit].
    #[arg(long, value_parser = parse_duration, value_name = "DURATION")]
    pub loss_timeout: Option<Duration>,

    /// Compare the run with a replay in memory, to detect any change to its result.
    ///
    /// A divergence ends the run with an error that names the TTI. `auto` uses at most a twentieth of the time and
    /// prints a note if the replay does not reach the end.
    #[arg(long, value_enum, default_value = "auto")]
    pub audit: AuditArg,

    /// Serve the browser dashboard at this address during the run; port 0 selects a free port.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8464")]
    pub dashboard: Option<String>,

    /// Serve the dashboard after the run too, until Ctrl-C.
    #[arg(long, requires = "dashboard")]
    pub hold: bool,

    /// Start with the clock paused; see `reveille clock`.
    #[arg(long)]
    pub paused: bool,

    /// Options of the policy process, for --policy external.
    #[command(flatten)]
    pub external_policy: ExternalPolicyArgs,
}

/// Options of the policy process.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Policy process (--policy external)")]
pub struct ExternalPolicyArgs {
    /// Shell command that starts the policy process; it is stopped when the run ends. It finds the policy port through
    /// REVEILLE_CONNECT, REVEILLE_RUN and REVEILLE_KEY, and certificates through REVEILLE_TLS. Without this option,
    /// start a policy process by hand.
    #[arg(long, value_name = "COMMAND", value_parser = NonEmptyStringValueParser::new())]
    pub policy_command: Option<String>,

    /// Time limit for a decision, for example 30s, including a restart of the policy process [default: no limit; after
    /// 5 s a note names the missing process].
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub decision_timeout: Option<Duration>,

    /// Action when a decision exceeds the time limit, or after three invalid answers to one decision request.
    #[arg(long, value_enum, value_name = "ACTION", default_value = "end")]
    pub on_undecided: OnUndecidedArg,
}

/// Action when a decision is missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnUndecidedArg {
    /// End the run with an error; --resume continues it.
    End,
    /// Keep the current plan and wake no device.
    Hold,
}

impl From<&ExternalPolicyArgs> for DecisionTimeout {
    fn from(args: &ExternalPolicyArgs) -> Self {
        Self {
            limit: args.decision_timeout,
            on_timeout: match args.on_undecided {
                OnUndecidedArg::End => OnUndecided::End,
                OnUndecidedArg::Hold => OnUndecided::Hold,
            },
        }
    }
}

/// Arguments of `reveille up`.
#[derive(Args)]
pub(crate) struct UpArgs {
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Result options.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Actions.
    #[command(flatten)]
    pub actions: ActionArgs,
    /// Clock, audit and dashboard options.
    #[command(flatten)]
    pub drive: DriveArgs,
    /// Number of device processes. 0 runs all devices in the base-station process; N (the number of devices) uses one
    /// process per device [default: 4, or N if that is less].
    #[arg(long, short = 'P', value_parser = whole(0..=u32::MAX), allow_negative_numbers = true)]
    pub processes: Option<u32>,
    /// Run name on the bus [default: the name of the run folder; with --resume, the earlier name].
    #[arg(long)]
    pub run: Option<RunName>,
    /// Endpoint at which the base station listens; port 0 selects a free port [default: tcp/127.0.0.1:0; with --resume,
    /// the earlier endpoint, if it is free].
    #[arg(long)]
    pub listen: Option<String>,
    /// Disable device-process tuning (for benchmarks).
    #[arg(long, hide = true)]
    pub untuned: bool,
}

/// Arguments of `reveille bs`.
#[derive(Args)]
pub(crate) struct BsArgs {
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Result options.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Actions.
    #[command(flatten)]
    pub actions: ActionArgs,
    /// Clock, audit and dashboard options.
    #[command(flatten)]
    pub drive: DriveArgs,
    /// Run name on the bus; device processes must give the same name [default with --resume: the earlier name].
    #[arg(long, required_unless_present = "resume")]
    pub run: Option<RunName>,
    /// Endpoint at which the base station listens: tcp/ADDRESS:PORT, or tls/ADDRESS:PORT with --tls [default:
    /// tcp/127.0.0.1:7447; with --resume, the earlier endpoint].
    #[arg(long)]
    pub listen: Option<String>,
    /// End with an error unless all devices have joined within this time [default: no limit].
    #[arg(long, value_parser = parse_duration)]
    pub join_timeout: Option<Duration>,
    /// Admit only device processes that hold the key in this file; the file is created if missing.
    #[arg(long, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
    /// Encrypt the bus, and admit only clients with a certificate of the CA in this folder, which `reveille tls init`
    /// makes. A certificate allows only the messages of its role.
    #[arg(long, value_name = "FOLDER")]
    pub tls: Option<PathBuf>,
}

/// Arguments of `reveille device`.
#[derive(Args)]
pub(crate) struct DeviceArgs {
    /// Endpoint of the base station: tcp/ADDRESS:PORT, or tls/HOST:PORT with --tls.
    #[arg(long)]
    pub connect: String,
    /// Run name on the bus.
    #[arg(long)]
    pub run: RunName,
    /// Maximum number of devices that this process runs [default: an equal share].
    ///
    /// By default, the base station divides the free devices equally among the processes that join at intervals of less
    /// than two seconds. A process without this option can take over any number of lost devices.
    #[arg(long, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub count: Option<u32>,
    /// The devices that this process runs, such as 0-24 or 0-9,30,40-44.
    ///
    /// The process runs these devices and no others, also after a restart. Each range of consecutive devices counts as
    /// a host. The base station refuses a range that another process shares in part.
    #[arg(long, value_name = "DEVICES", value_parser = parse_ranges, conflicts_with = "count")]
    pub range: Option<DeviceRanges>,
    /// Time limit for reaching the base station and joining the run, and for waiting for a lost base station to return.
    #[arg(long, default_value = "30s", value_parser = parse_duration)]
    pub connect_timeout: Duration,
    /// File with the run's key, if the base station requires one.
    #[arg(long, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
    /// Folder of `reveille tls init`, for an encrypted endpoint; the subfolder `device` suffices.
    #[arg(long, value_name = "FOLDER")]
    pub tls: Option<PathBuf>,
    /// Parent process; this process ends when the parent ends.
    #[arg(long, hide = true, value_parser = whole(1..=i32::MAX), allow_negative_numbers = true)]
    pub parent: Option<i32>,
    /// Number of device processes on this machine, including this one.
    #[arg(
        long,
        hide = true,
        default_value_t = 1,
        value_parser = whole(1..=u32::MAX),
        allow_negative_numbers = true
    )]
    pub host_count: u32,
    /// Disable device-process tuning (for benchmarks).
    #[arg(long, hide = true)]
    pub untuned: bool,
}

/// Arguments of `reveille router`.
#[derive(Args)]
pub(crate) struct RouterArgs {
    /// Endpoint on which device processes, observers and further routers connect: tcp/ADDRESS:PORT, or
    /// tls/ADDRESS:PORT with --tls.
    #[arg(long)]
    pub listen: String,
    /// Endpoint of the base station, or of a router on the way to it: tcp/ADDRESS:PORT, or tls/HOST:PORT with --tls.
    #[arg(long)]
    pub connect: String,
    /// Run name on the bus.
    #[arg(long)]
    pub run: RunName,
    /// File with the run's key, if the base station requires one.
    #[arg(long, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
    /// Folder of `reveille tls init`, for encrypted endpoints; the subfolder `router` suffices.
    #[arg(long, value_name = "FOLDER")]
    pub tls: Option<PathBuf>,
}

/// Devices of a process: ranges in the order of ids, with a gap between each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DeviceRanges(pub Vec<DeviceRange>);

/// Parses the devices of a process.
fn parse_ranges(text: &str) -> Result<DeviceRanges, String> {
    let mut ranges = parse_devices(text)?;
    if ranges.contains(&DeviceRange::ALL) {
        return Err("must name devices, such as 0-24; without --range and --count a process runs any".to_owned());
    }
    ranges.sort_unstable_by_key(|range| range.first);
    let mut merged: Vec<DeviceRange> = Vec::new();
    for range in ranges {
        match merged.last_mut() {
            Some(last) if last.contains(range.first) => {
                return Err(format!("names device {} more than once", range.first));
            }
            // Neighbours need one host together.
            Some(last) if last.first.0.checked_add(last.count) == Some(range.first.0) => last.count += range.count,
            Some(_) | None => merged.push(range),
        }
    }
    Ok(DeviceRanges(merged))
}

/// Arguments of `reveille policy-process`.
#[derive(Args)]
pub(crate) struct PolicyProcessArgs {
    /// Parent process; the command is stopped when the parent ends.
    #[arg(long, value_parser = whole(1..=i32::MAX), allow_negative_numbers = true)]
    pub parent: i32,
    /// Shell command to run.
    pub command: String,
}

/// Action when a host is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnLossArg {
    /// End the run with an error.
    End,
    /// Stop the clock until a process takes over its devices.
    Wait,
    /// Remove its devices and continue.
    Continue,
}

/// Extent of the audit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum AuditArg {
    /// Audit as much of the run as fits in a twentieth of the time.
    Auto,
    /// Audit the whole run.
    On,
    /// Disable the audit.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_sorted_and_neighbours_are_merged() {
        let parsed = |text| {
            let ranges = parse_ranges(text)?;
            Ok(ranges
                .0
                .iter()
                .map(|range| (range.first.0, range.count))
                .collect::<Vec<_>>())
        };
        assert_eq!(parsed("0-24"), Ok(vec![(0, 25)]));
        assert_eq!(parsed("30, 0-9,40-44,10"), Ok(vec![(0, 11), (30, 1), (40, 5)]));
        for (invalid, cause) in [
            ("all", "must name devices"),
            ("0-9,9", "names device 9 more than once"),
            ("3,1-5", "names device 3 more than once"),
            ("0,5-2", "`5-2`: 5 is larger than 2; use 2-5"),
            ("", "devices and ranges of devices"),
        ] {
            let refusal: Result<_, String> = parsed(invalid);
            assert!(
                refusal.as_ref().is_err_and(|why| why.contains(cause)),
                "{invalid}: {refusal:?}"
            );
        }
    }
}
