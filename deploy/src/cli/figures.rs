//! The options of pictures and of the report.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::ScenarioArgs;
use super::parse::{parse_device, parse_whole};

/// Where pictures go and in which form.
#[derive(Args, Clone, Debug)]
pub struct PictureArgs {
    /// The folder for pictures; it is made if need be, and files of the same name are replaced.
    #[arg(long, short, default_value = "figures")]
    pub out: PathBuf,
    /// File formats, separated by commas. PNG has 300 dots per inch.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "svg,png")]
    pub format: Vec<FormatArg>,
}

/// A file format of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FormatArg {
    /// Lines and outlines, for print.
    Svg,
    /// Pixels.
    Png,
}

/// `reveille figures`.
#[derive(Args)]
pub struct FiguresArgs {
    /// A picture that needs no table.
    #[command(subcommand)]
    pub command: Option<FiguresCommand>,
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; runs that two of them hold count once.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// Only these figures, separated by commas, of: information, energy, misdetection, low-energy, battery, wrong, wasted,
    /// harvest, net [default: all].
    #[arg(long, value_delimiter = ',', value_name = "FIGURE")]
    pub only: Vec<String>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// A picture that needs no table.
#[derive(Subcommand)]
pub enum FiguresCommand {
    /// The area with Voronoi cells and clusters, and one event with all who reported, were woken, or failed.
    Deployment(DeploymentArgs),
    /// Battery and states S1 to S4 of some devices, TTI by TTI, with events and wake-ups.
    Timeline(TimelineArgs),
}

/// `reveille figures deployment`.
#[derive(Args)]
pub struct DeploymentArgs {
    /// The scenario.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The number of the event, from 0 [default: the first after the warm-up in which somebody was woken].
    #[arg(long, short, value_parser = parse_whole, allow_negative_numbers = true)]
    pub event: Option<u64>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// `reveille figures timeline`.
#[derive(Args)]
pub struct TimelineArgs {
    /// The scenario.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Numbers of the devices to show, separated by commas, at most 8 [default: the three that are busiest].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "DEVICE",
        value_parser = parse_device,
        allow_hyphen_values = true
    )]
    pub show: Vec<u32>,
    /// The first TTI to show [default: the end of the warm-up].
    #[arg(long, value_parser = parse_whole, allow_negative_numbers = true)]
    pub from: Option<u64>,
    /// How many TTIs to show, 10 to 2000.
    #[arg(long, default_value_t = 200, value_parser = parse_whole, allow_negative_numbers = true)]
    pub length: u64,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// `reveille report`.
#[derive(Args)]
pub struct ReportArgs {
    /// Result tables of `reveille sweep`, or the folders of finished sweeps, of the presets paper and paper-literal.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// The folder for report.html and report.md; it is made if need be.
    #[arg(long, short, default_value = "report")]
    pub out: PathBuf,
}
