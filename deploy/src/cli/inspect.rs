//! Options of `reveille inspect` and `reveille dashboard`, which `commands/inspect/` and `commands/dashboard.rs`
//! execute. Names of options are a public interface (see `cli`); `cli/run.rs` repeats the default address of the
//! dashboard.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use reveille_common::message::{MessageKind, Plane};
use reveille_view::filter::StateName;

use super::TargetArgs;
use super::examples::examples;
use super::parse::{kind_parser, state_parser, trimmed, whole};

/// Subcommands of `reveille inspect`.
#[derive(Subcommand)]
pub(crate) enum InspectCommand {
    /// Print the messages of an active run or of a recording, one per line
    ///
    /// Each line has the TTI, plane, kind, key, length in bytes and content. The key is the device or host, for kinds
    /// that have one key for each. The run never waits for this command.
    #[command(after_help = examples!(
        "reveille inspect tail --kind wake,report --pair-wake-ups",
        "reveille inspect tail run.mcap --device 7 --since 1000 --until 1100",
    ))]
    Tail(TailArgs),
    /// Count the messages and bytes of an active run or of a recording
    ///
    /// The table counts by kind and plane, per TTI and per device, until the run or the recording ends.
    #[command(after_help = examples!(
        "reveille inspect stats --watch",
        "reveille inspect stats run.mcap --devices",
    ))]
    Stats(StatsArgs),
    /// Record the messages of an active run in a file
    ///
    /// The recording can lack messages if this command is too slow. Only `up --record` and `run --record` guarantee a
    /// complete recording.
    #[command(after_help = examples!(
        "reveille inspect record run.mcap",
        "reveille inspect record run.mcap --run demo",
    ))]
    Record(InspectRecordArgs),
    /// Convert a recording for Wireshark, Perfetto or a statistics program
    ///
    /// Wireshark and tshark need the dissector that `--dissector reveille.lua` writes:
    /// tshark -X lua_script:reveille.lua -r run.pcapng -Y 'reveille.wake.device == 7'.
    /// Open a Perfetto trace at ui.perfetto.dev.
    #[command(after_help = examples!(
        "reveille inspect export run.mcap --to pcapng",
        "reveille inspect export run.mcap --to devices --every 10",
    ))]
    Export(ExportArgs),
    /// Check that the messages of a recording lead to the metrics and digest in its summary
    ///
    /// The devices go through the same TTIs again, and their reports and batteries must match the recording. The exit
    /// code is 1 after a mismatch, and for a truncated recording or one without a summary.
    #[command(after_help = examples!(
        "reveille run --record run.mcap",
        "reveille inspect verify run.mcap",
    ))]
    Verify(VerifyArgs),
    /// Show where, when and why the events of a run were missed
    ///
    /// The report has a map of missed events and devices, the causes over time, the nearest devices and suggested
    /// changes. After actions, it compares the phases of the run. The run can still be active. docs/results.md explains
    /// the causes.
    #[command(after_help = examples!(
        "reveille inspect misses runs/knn-n50-s1",
        "reveille inspect misses runs/knn-n50-s1 --try",
    ))]
    Misses(MissesArgs),
}

/// Arguments of `reveille inspect tail`.
#[derive(Args)]
pub(crate) struct TailArgs {
    /// Run to observe.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Recording to read instead of an active run, or the run folder that holds it.
    #[arg(value_name = "FILE", conflicts_with_all = ["connect", "run"])]
    pub file: Option<PathBuf>,
    /// Only messages of this plane.
    #[arg(long, value_enum)]
    pub plane: Option<PlaneArg>,
    /// Only messages of these kinds, separated by commas.
    #[arg(long, value_parser = trimmed(kind_parser()), value_delimiter = ',')]
    pub kind: Vec<MessageKind>,
    /// Only messages to, from or about this device, and messages to all devices.
    #[arg(long, value_parser = whole(0..=u32::MAX), allow_negative_numbers = true)]
    pub device: Option<u32>,
    /// Only messages to, from or about the devices in this cluster of the policy, and messages to all devices.
    #[arg(long, value_parser = whole(0..=u32::MAX), allow_negative_numbers = true)]
    pub cluster: Option<u32>,
    /// Only messages of devices that were in one of these states before the message, separated by commas.
    #[arg(long, value_parser = trimmed(state_parser()), value_delimiter = ',')]
    pub state: Vec<StateName>,
    /// Only messages from this TTI on.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI; then exit.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub until: Option<u64>,
    /// Show each wake-up and its outcome on one line.
    #[arg(long)]
    pub pair_wake_ups: bool,
    /// Print one JSON object per line.
    #[arg(long)]
    pub json: bool,
    /// Exit after this many messages.
    #[arg(long, short = 'c', value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub count: Option<u64>,
    /// Colour messages by kind; NO_COLOR disables colours.
    #[arg(long, value_enum, default_value = "auto")]
    pub colour: ColourArg,
}

/// Arguments of `reveille inspect stats`.
#[derive(Args)]
pub(crate) struct StatsArgs {
    /// Run to observe.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Recording to read instead of an active run, or the run folder that holds it.
    #[arg(value_name = "FILE", conflicts_with_all = ["connect", "run", "watch"])]
    pub file: Option<PathBuf>,
    /// Update the table every second.
    #[arg(long)]
    pub watch: bool,
    /// Also count by device.
    #[arg(long)]
    pub devices: bool,
    /// Only messages from this TTI on.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub until: Option<u64>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `reveille inspect record`.
#[derive(Args)]
pub(crate) struct InspectRecordArgs {
    /// Run to observe.
    #[command(flatten)]
    pub target: TargetArgs,
    /// File to write; it must not exist yet.
    pub file: PathBuf,
}

/// Arguments of `reveille inspect export`.
#[derive(Args)]
pub(crate) struct ExportArgs {
    /// Recording to read, or the run folder that holds it.
    #[arg(required_unless_present = "dissector")]
    pub file: Option<PathBuf>,
    /// Format of the output file [default: by the extension of --out].
    #[arg(long, value_enum, requires = "file", required_unless_present_any = ["out", "dissector"])]
    pub to: Option<ExportFormatArg>,
    /// File to write [default: next to the recording, with its name and the extension of the format].
    #[arg(long, short, requires = "file")]
    pub out: Option<PathBuf>,
    /// Write the pcapng dissector for Wireshark and tshark to this file.
    #[arg(long, value_name = "FILE")]
    pub dissector: Option<PathBuf>,
    /// Only messages from this TTI on; not with --to perfetto or devices, whose states depend on all earlier messages.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI.
    #[arg(long, value_name = "TTI", value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub until: Option<u64>,
    /// TTIs between two battery values, for --to perfetto.
    #[arg(
        long,
        value_name = "TTIS",
        default_value_t = 10,
        value_parser = whole(1..=u64::MAX),
        allow_negative_numbers = true
    )]
    pub battery_every: u64,
    /// TTIs between two rows of a device, for --to devices [default: a hundredth of the run, as in windows.csv].
    #[arg(long, value_name = "TTIS", value_parser = whole(1..=u64::MAX), allow_negative_numbers = true)]
    pub every: Option<u64>,
    /// Replace existing files.
    #[arg(long)]
    pub force: bool,
}

/// Export format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportFormatArg {
    /// Packets with virtual time, for Wireshark and tshark.
    Pcapng,
    /// Perfetto trace: one track per device with its states and battery, and arrows from wake-ups.
    Perfetto,
    /// Comma-separated table with one row per message.
    Csv,
    /// Parquet table with one row per message.
    Parquet,
    /// Comma-separated table of the devices over time: states, batteries, and energies since TTI 0.
    Devices,
}

impl ExportFormatArg {
    /// The usual extension of such files, without the dot.
    pub(crate) const fn extension(self) -> &'static str {
        match self {
            Self::Pcapng => "pcapng",
            Self::Perfetto => "perfetto-trace",
            Self::Csv => "csv",
            Self::Parquet => "parquet",
            Self::Devices => "devices.csv",
        }
    }
}

/// Arguments of `reveille inspect verify`.
#[derive(Args)]
pub(crate) struct VerifyArgs {
    /// Recording to read, or the run folder that holds it.
    pub file: PathBuf,
}

/// Arguments of `reveille inspect misses`.
#[derive(Args)]
pub(crate) struct MissesArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Number of devices to list, those with most missed events first.
    #[arg(long, default_value_t = 8, value_parser = whole(0..=1_000_000_usize), allow_negative_numbers = true)]
    pub devices: usize,
    /// Run the suggested values in memory, with the seed, the length and the actions of the run, and print a table of
    /// the results with the command of the best one.
    #[arg(long = "try")]
    pub tries: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `reveille dashboard`.
#[derive(Args)]
pub(crate) struct DashboardArgs {
    /// Run to observe.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Recording to show instead of an active run, or the run folder that holds it.
    #[arg(value_name = "FILE", conflicts_with_all = ["connect", "run"])]
    pub file: Option<PathBuf>,
    /// Also show this recording, and mark the first difference.
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
    /// Address at which to serve the dashboard; port 0 selects a free port.
    #[arg(long, default_value = "127.0.0.1:8464", value_name = "ADDRESS:PORT")]
    pub listen: String,
}

/// Use of colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ColourArg {
    /// Use colours on a terminal.
    Auto,
    /// Always use colours.
    Always,
    /// Never use colours.
    Never,
}

/// Message plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PlaneArg {
    /// Messages that a real deployment also sends.
    Air,
    /// Messages that only the emulation needs.
    Emu,
    /// Ground truth of the model, which no real device sends.
    Truth,
}

impl From<PlaneArg> for Plane {
    fn from(arg: PlaneArg) -> Self {
        match arg {
            PlaneArg::Air => Self::Air,
            PlaneArg::Emu => Self::Emu,
            PlaneArg::Truth => Self::Truth,
        }
    }
}
