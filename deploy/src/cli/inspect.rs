//! The options of everything that looks at the messages of a run.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use reveille_common::message::{MessageKind, Plane};
use reveille_view::filter::Named;

use super::TargetArgs;
use super::parse::{kind_parser, state_parser};

/// `reveille inspect`.
#[derive(Subcommand)]
pub enum InspectCommand {
    /// Print every message of a run, decoded, one a line, as it goes or from a recording. The run never waits for it.
    ///
    /// A line has the TTI, the plane, the kind, whose key it is (a device's or a host's, where the kind has one for
    /// each), the length in bytes, and what it says.
    Tail(TailArgs),
    /// Count messages and bytes by kind and plane, a TTI and a device, until the run or the recording ends.
    Stats(StatsArgs),
    /// Record a run that goes on, by what it tells observers. `up --record` and `run --record` leave nothing out.
    Record(InspectRecordArgs),
    /// Write a recording as a file that Wireshark, Perfetto or a statistics program opens; or the dissector for
    /// Wireshark.
    #[command(after_help = EXPORTS)]
    Export(ExportArgs),
    /// Work out metrics and digest from the messages of a recording alone, and compare them with its summary.
    ///
    /// The devices are taken through the same TTIs once more: reports and batteries must be what they come to. Ends
    /// with 1 where something does not fit, and for a recording that is torn or has no summary.
    Verify(VerifyArgs),
    /// Find where two recordings first differ: in events, δ, reports, failures, wake-ups, or what came of them.
    ///
    /// Two runs of one scenario and seed under other policies part where the first plan differs; two runs that ought to
    /// be the same part where something went wrong. How they were granted, with or without lookahead, makes no
    /// difference. Ends with 1 where they differ.
    Compare(CompareArgs),
}

/// `reveille inspect tail`.
#[derive(Args)]
pub struct TailArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Read this recording instead of a run that goes on.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["connect", "run"])]
    pub from: Option<PathBuf>,
    /// Only this plane.
    #[arg(long, value_enum)]
    pub plane: Option<PlaneArg>,
    /// Only these kinds, separated by commas.
    #[arg(long, value_parser = kind_parser(), value_delimiter = ',')]
    pub kind: Vec<MessageKind>,
    /// Only messages to, from or about this device, and those to all.
    #[arg(long)]
    pub device: Option<u32>,
    /// Only messages to, from or about the devices of this cluster of the policy, and those to all.
    #[arg(long)]
    pub cluster: Option<u32>,
    /// Only messages of devices that are in one of these states before it, separated by commas.
    #[arg(long, value_parser = state_parser(), value_delimiter = ',')]
    pub state: Vec<Named>,
    /// Only messages of this TTI and later ones.
    #[arg(long, value_name = "TTI")]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI; then end.
    #[arg(long, value_name = "TTI")]
    pub until: Option<u64>,
    /// Show a wake-up with what came of it on one line.
    #[arg(long)]
    pub join: bool,
    /// One JSON object a line.
    #[arg(long)]
    pub json: bool,
    /// End after this many messages.
    #[arg(long, short = 'c')]
    pub count: Option<u64>,
    /// Colours by kind; NO_COLOR turns them off.
    #[arg(long, value_enum, default_value = "auto")]
    pub colour: ColourArg,
}

/// `reveille inspect stats`.
#[derive(Args)]
pub struct StatsArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Read this recording instead of a run that goes on.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["connect", "run", "watch"])]
    pub from: Option<PathBuf>,
    /// Show the table every second.
    #[arg(long)]
    pub watch: bool,
    /// Also by device.
    #[arg(long)]
    pub devices: bool,
    /// Only messages of this TTI and later ones.
    #[arg(long, value_name = "TTI")]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI.
    #[arg(long, value_name = "TTI")]
    pub until: Option<u64>,
    /// One JSON object.
    #[arg(long)]
    pub json: bool,
}

/// `reveille inspect record`.
#[derive(Args)]
pub struct InspectRecordArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// The file, which must not be there yet.
    pub file: PathBuf,
}

/// Examples of `reveille inspect export`.
const EXPORTS: &str = "Examples:\n  reveille inspect export run.mcap --to pcapng\n  \
    reveille inspect export --dissector reveille.lua\n  \
    tshark -X lua_script:reveille.lua -r run.pcapng -Y 'reveille.wake.device == 7'\n  \
    reveille inspect export run.mcap --to perfetto      and open it at ui.perfetto.dev";

/// `reveille inspect export`.
#[derive(Args)]
pub struct ExportArgs {
    /// The recording.
    #[arg(required_unless_present = "dissector", requires = "to")]
    pub file: Option<PathBuf>,
    /// The form.
    #[arg(long, value_enum, requires = "file")]
    pub to: Option<ToArg>,
    /// The file to write [default: the recording's name with another ending].
    #[arg(long, short, requires = "file")]
    pub out: Option<PathBuf>,
    /// Write the dissector of pcapng files for Wireshark and tshark to this file.
    #[arg(long, value_name = "FILE")]
    pub dissector: Option<PathBuf>,
    /// Only messages of this TTI and later ones.
    #[arg(long, value_name = "TTI")]
    pub since: Option<u64>,
    /// Only messages up to and including this TTI.
    #[arg(long, value_name = "TTI")]
    pub until: Option<u64>,
    /// With --to perfetto: TTIs between two values of a battery.
    #[arg(long, value_name = "TTIS", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..))]
    pub battery_every: u64,
    /// Replace files that are there.
    #[arg(long)]
    pub force: bool,
}

/// The form of an export.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ToArg {
    /// Packets with virtual time, for Wireshark and tshark.
    Pcapng,
    /// A trace for Perfetto: a track a device with its states, its battery, and arrows from wake-ups.
    Perfetto,
    /// A row for each message, columns separated by commas.
    Csv,
    /// The same as a Parquet file.
    Parquet,
}

impl ToArg {
    /// The usual ending of such files.
    pub const fn ending(self) -> &'static str {
        match self {
            Self::Pcapng => "pcapng",
            Self::Perfetto => "perfetto-trace",
            Self::Csv => "csv",
            Self::Parquet => "parquet",
        }
    }
}

/// `reveille inspect verify`.
#[derive(Args)]
pub struct VerifyArgs {
    /// The recording.
    pub file: PathBuf,
}

/// `reveille inspect compare`.
#[derive(Args)]
pub struct CompareArgs {
    /// A recording.
    pub this: PathBuf,
    /// The recording that it is compared with.
    pub other: PathBuf,
}

/// `reveille dashboard`.
#[derive(Args)]
pub struct DashboardArgs {
    /// The run.
    #[command(flatten)]
    pub target: TargetArgs,
    /// Show this recording instead of a run that goes on.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["connect", "run"])]
    pub from: Option<PathBuf>,
    /// Show this recording beside it, and where the two first differ.
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
    /// Where to serve it; port 0 takes any free one.
    #[arg(long, default_value = "127.0.0.1:8464", value_name = "ADDRESS:PORT")]
    pub listen: String,
}

/// When to use colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ColourArg {
    /// On a terminal.
    Auto,
    /// Always.
    Always,
    /// Never.
    Never,
}

/// A plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PlaneArg {
    /// What a real deployment would send.
    Air,
    /// What only the emulation needs.
    Emu,
    /// What happens in the modelled world and nobody sends.
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
