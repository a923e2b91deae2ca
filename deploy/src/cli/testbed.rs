//! Options of `reveille testbed` and `reveille link`, which `commands/testbed/` and `commands/link.rs` execute.
//! `commands/testbed/compose.rs` writes the arguments of `link`.

use std::path::PathBuf;
use std::time::Duration;

use clap::builder::StringValueParser;
use clap::{Args, Subcommand, ValueEnum};
use reveille_common::message::Pace;

use super::ScenarioArgs;
use super::examples::examples;
use super::parse::{parse_duration, parse_pace, trimmed, whole};

/// Arguments of `reveille testbed`.
#[derive(Args)]
pub(crate) struct TestbedArgs {
    /// The command.
    #[command(subcommand)]
    pub command: TestbedCommand,
}

/// Subcommands of `reveille testbed`.
#[derive(Subcommand)]
pub(crate) enum TestbedCommand {
    /// Write the files of a testbed: testbed.toml, scenario.toml and compose.yml
    ///
    /// testbed.toml holds the options below; edit it to change the testbed. `testbed up` writes compose.yml again from
    /// it. compose.yml also works without this program.
    #[command(after_help = examples!(
        "reveille testbed init --scenario paper --containers 10 --out demo",
        "reveille testbed init -s two-classes.toml --delay weak=20ms --memory weak=32m --out demo",
    ))]
    Init(Box<TestbedInitArgs>),
    /// Run a testbed to its end, apply its faults, and copy its results
    ///
    /// The command starts the containers, shows the progress, pauses the clock at the TTI of each fault to apply it,
    /// and prints the results. Ctrl-C stops the containers; the same command resumes the run.
    #[command(after_help = examples!("reveille testbed up demo", "reveille testbed up demo --check"))]
    Up(TestbedUpArgs),
    /// Remove the containers, networks and volumes of a testbed; copied results stay
    #[command(after_help = examples!("reveille testbed down", "reveille testbed down demo"))]
    Down(TestbedFolder),
    /// Print the clock and the containers of a testbed, with state, devices and memory
    #[command(after_help = examples!("reveille testbed status", "reveille testbed status demo"))]
    Status(TestbedFolder),
    /// Print the logs of a testbed's containers
    #[command(after_help = examples!("reveille testbed logs demo bs", "reveille testbed logs demo --follow"))]
    Logs {
        /// Folder that `testbed init` wrote.
        folder: PathBuf,
        /// Container, such as bs [default: all].
        container: Option<String>,
        /// Print new lines until Ctrl-C.
        #[arg(long, short)]
        follow: bool,
    },
    /// Pause, step or resume a testbed's run, or act on it: `reveille clock` in the container of the base station
    #[command(after_help = examples!(
        "reveille testbed clock demo pause",
        "reveille testbed clock demo step 5",
    ))]
    Clock {
        /// Folder that `testbed init` wrote.
        folder: PathBuf,
        /// Arguments of `reveille clock`.
        #[arg(required = true, trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Copy the run folder out of a testbed
    #[command(after_help = examples!("reveille testbed results", "reveille testbed results demo"))]
    Results(TestbedFolder),
    /// Disturb a container, for a duration or until `restore`
    #[command(after_help = examples!(
        "reveille testbed fault demo kill weak-1",
        "reveille testbed fault demo disconnect weak-link 10s",
    ))]
    Fault {
        /// Folder that `testbed init` wrote.
        folder: PathBuf,
        /// Kind of fault.
        #[arg(value_enum)]
        kind: FaultKind,
        /// Container, such as bs; `testbed status` lists all.
        container: String,
        /// Time after which the container is restored, such as 10s; the command waits for it [default: none].
        #[arg(value_parser = parse_duration)]
        duration: Option<Duration>,
    },
}

/// The folder of a testbed.
#[derive(Args, Clone)]
pub(crate) struct TestbedFolder {
    /// Folder that `testbed init` wrote.
    #[arg(value_name = "FOLDER", default_value = ".")]
    pub path: PathBuf,
}

/// Arguments of `reveille testbed init`.
#[derive(Args)]
pub(crate) struct TestbedInitArgs {
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Folder to write; its name becomes the name of the testbed.
    #[arg(long, short, value_name = "FOLDER")]
    pub out: PathBuf,
    /// Number of containers, or numbers by class, such as weak=4,strong=1 [default: 5, at least one for each class].
    #[arg(long, value_name = "[CLASS=]NUMBER", value_delimiter = ',', value_parser = trimmed(StringValueParser::new()))]
    pub containers: Vec<String>,
    /// Most processor cores of a container, such as 0.5 or weak=0.25,strong=1 [default: no limit].
    #[arg(long, value_name = "[CLASS=]CORES", value_delimiter = ',', value_parser = trimmed(StringValueParser::new()))]
    pub cpus: Vec<String>,
    /// Most memory of a container, such as 32m or weak=32m,strong=1g [default: no limit].
    #[arg(long, value_name = "[CLASS=]BYTES", value_delimiter = ',', value_parser = trimmed(StringValueParser::new()))]
    pub memory: Vec<String>,
    /// One-way delay between the containers and the base station, such as 20ms or weak=20ms [default: none].
    #[arg(long, value_name = "[CLASS=]TIME", value_delimiter = ',', value_parser = trimmed(StringValueParser::new()))]
    pub delay: Vec<String>,
    /// Share of lost segments on that way, such as 1% or weak=1%; see `reveille link` [default: none].
    #[arg(long, value_name = "[CLASS=]SHARE", value_delimiter = ',', value_parser = trimmed(StringValueParser::new()))]
    pub loss: Vec<String>,
    /// File with the schedule of faults: lines such as `500 kill weak-1` and `700 disconnect strong-1 for 5s`.
    #[arg(long, value_name = "FILE")]
    pub faults: Option<PathBuf>,
    /// Image of the containers, with this version of Reveille.
    #[arg(long, default_value = "reveille:local")]
    pub image: String,
    /// Use TCP without encryption between the containers, for an image without TLS [default: mutual TLS].
    #[arg(long)]
    pub no_tls: bool,
    /// Add a container with the dashboard, whose address `testbed up` and `testbed status` print.
    #[arg(long)]
    pub dashboard: bool,
    /// Real time per TTI, for example 10ms, or TTIs per second, such as 50/s; `max` runs as fast as possible.
    #[arg(long, default_value = "max", value_parser = parse_pace, allow_hyphen_values = true)]
    pub pace: Pace,
}

/// Arguments of `reveille testbed up`.
#[derive(Args)]
pub(crate) struct TestbedUpArgs {
    /// Testbed to run.
    #[command(flatten)]
    pub testbed: TestbedFolder,
    /// Start the containers and return; only for a testbed without a schedule of faults.
    #[arg(long)]
    pub detach: bool,
    /// Repeat the run in memory, and end with an error if its digest differs.
    #[arg(long, conflicts_with = "detach")]
    pub check: bool,
}

/// A kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum FaultKind {
    /// Kill the process in the container; the engine starts it again.
    Kill,
    /// Freeze the container.
    Pause,
    /// Cut the container off its network.
    Disconnect,
    /// Limit the container to a twentieth of a core.
    Slow,
    /// End the container; the engine does not start it again.
    Stop,
    /// End the effects of all other faults.
    Restore,
}

/// Arguments of `reveille link`.
#[derive(Args)]
pub(crate) struct LinkArgs {
    /// Endpoint at which the relay listens: tcp/ADDRESS:PORT.
    #[arg(long)]
    pub listen: String,
    /// Endpoint to which it passes connections: tcp/ADDRESS:PORT.
    #[arg(long)]
    pub connect: String,
    /// Delay in each direction, for example 20ms [default: none].
    #[arg(long, value_parser = parse_duration)]
    pub delay: Option<Duration>,
    /// Share of lost segments in each direction, for example 1% or 0.01.
    ///
    /// TCP repeats a lost segment. A program therefore receives this segment, and all data behind it, later by the
    /// retransmission timeout of 200 ms, which doubles with each further loss of the segment.
    #[arg(long, default_value = "0%", value_parser = parse_loss, allow_negative_numbers = true)]
    pub loss: f64,
    /// Seed of the losses.
    #[arg(long, default_value_t = 1, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub seed: u64,
}

/// Parses a share of lost segments, such as `1%` or `0.01`. With more than half, a link would hardly pass data.
pub(crate) fn parse_loss(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let share = match text.strip_suffix('%') {
        Some(percent) => percent.trim().parse().map(|percent: f64| percent / 100.0),
        None => text.parse(),
    };
    let share = share.ok().filter(|share| (0.0..=0.5).contains(share));
    share.ok_or_else(|| "must be a number from 0 to 0.5, or a percentage such as 1%".to_owned())
}
