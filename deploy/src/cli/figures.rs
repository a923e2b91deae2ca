//! Options of `reveille figures`, which `commands/figures.rs` executes. A new figure needs its name in the help of
//! `--only`, which lists the names by hand. Limits and defaults in other help texts, such as at most 8 devices, repeat
//! constants of `study/src/figures/`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::builder::{EnumValueParser, PossibleValuesParser, StringValueParser};
use clap::{Args, Subcommand, ValueEnum};
use reveille_bs::policy::q_learning::learned::Lookback;
use reveille_common::ids::MAX_DEVICES;
use reveille_study::figures::deployment::EventChoice;
use reveille_study::figures::{energy, front, pareto, robustness, study};

use super::ScenarioArgs;
use super::examples::examples;
use super::parse::{any_whole, metric_parser, parse_field, trimmed, whole};

/// Folder and formats of the pictures.
#[derive(Args, Clone, Debug)]
pub(crate) struct FigureOutputArgs {
    /// Folder for the pictures; created if missing. Files with the same name are replaced.
    #[arg(long, short, default_value = "figures")]
    pub out: PathBuf,
    /// File formats, separated by commas. PNG files have 300 dots per inch.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "svg,png",
        value_parser = trimmed(EnumValueParser::<ImageFormatArg>::new())
    )]
    pub format: Vec<ImageFormatArg>,
}

/// Picture file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ImageFormatArg {
    /// Vector graphics, for print.
    Svg,
    /// Pixel image.
    Png,
}

/// Arguments of `reveille figures`.
#[derive(Args)]
pub(crate) struct FiguresArgs {
    /// Pictures other than the figures of the paper.
    #[command(subcommand)]
    pub command: Option<FiguresCommand>,
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; runs that occur in several tables count
    /// once.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// Only these figures, separated by commas, of: information, information-per-event, energy, misdetection,
    /// low-energy, battery, wrong, wasted, harvest, net, pareto, delay, front [default: all].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "FIGURE",
        hide_possible_values = true,
        value_parser = trimmed(PossibleValuesParser::new(figure_names()))
    )]
    pub only: Vec<String>,
    /// Draw pareto and delay once per preset and run length, with one line per policy and setting. This suits
    /// q-learning with tables for several weights, for example. Other figures are always drawn per setting.
    #[arg(long)]
    pub combine: bool,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Pictures other than the figures of the paper.
#[derive(Subcommand)]
pub(crate) enum FiguresCommand {
    /// Draw a map of the devices with their clusters and one event
    ///
    /// The map has Voronoi cells. It marks the devices that reported, were woken, or failed, with the numbers of up to
    /// 60 devices.
    #[command(after_help = examples!(
        "reveille figures deployment --policy knn --devices 80",
        "reveille figures deployment runs/knn-n50-s1 --event none --out maps",
    ))]
    Deployment(DeploymentArgs),
    /// Draw the batteries and states of some devices over time, with events and wake-ups
    #[command(after_help = examples!(
        "reveille figures timeline --policy random --show 3,7",
        "reveille figures timeline runs/knn-n50-s1 --from 2000 --length 400",
    ))]
    Timeline(TimelineArgs),
    /// Draw the places of a run's missed events, coloured by cause
    ///
    /// `reveille inspect misses` prints the same events with their times and devices.
    #[command(after_help = examples!(
        "reveille figures misses runs/knn-n50-s1",
        "reveille figures misses runs/knn-n50-s1 --out maps --format svg",
    ))]
    Misses(MissesFigureArgs),
    /// Draw the past that one decision of the `dt` policy attends to
    ///
    /// The picture shows the expectation for each device in a TTI, and the attention to past TTIs.
    #[command(after_help = examples!(
        "reveille figures attention --tti 1500 --set events.process=aftershocks",
        "reveille figures attention --show 3,7",
    ))]
    Attention(AttentionArgs),
    /// Draw the effect of an imperfect radio on policies
    ///
    /// The figures show information, energy and misdetection. They cover lost wake-ups, false wake-ups, lost reports,
    /// lost plans, slow wake-ups and interference.
    #[command(after_help = examples!(
        "reveille figures robustness --policies knn,age-index,genie --seeds 10",
        "reveille figures robustness --only uplink_loss,wake_miss --devices 100",
    ))]
    Robustness(RobustnessArgs),
    /// Draw the progress of q-learning trainings: reward and information by training TTIs, for each N
    #[command(after_help = examples!(
        "reveille figures learning shipped",
        "reveille figures learning mine.json shipped --out learning",
    ))]
    Learning(LearningArgs),
    /// Draw q-learning tables as heat maps of the value of sensing or of waking
    #[command(after_help = examples!(
        "reveille figures q-table shipped --devices 100",
        "reveille figures q-table mine.json --devices 50,100 --wake posterior",
    ))]
    QTable(QTableArgs),
    /// Draw any metric against any field that a sweep varied
    ///
    /// Each policy, or each value of another field, gets a line. Each combination of the remaining varied fields gets a
    /// picture.
    #[command(after_help = examples!(
        "reveille figures sweep study --x harvest.lambda --y info_p1,energy_per_device_tti",
        "reveille figures sweep study --x harvest.lambda --by devices --where policy=knn --log x",
    ))]
    Sweep(SweepFigureArgs),
}

/// Arguments of `reveille figures sweep`.
#[derive(Args)]
pub(crate) struct SweepFigureArgs {
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; runs that occur in several tables count
    /// once.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// Field on the x axis: a swept field such as harvest.lambda, or devices, or ttis.
    #[arg(long, value_name = "FIELD")]
    pub x: String,
    /// Metrics on the y axis, separated by commas, with a picture each, such as energy_per_device_tti; docs/results.md
    /// lists all metrics.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "METRIC",
        default_value = "info_p1",
        hide_possible_values = true,
        value_parser = metric_parser()
    )]
    pub y: Vec<String>,
    /// Field with one line per value.
    #[arg(long, value_name = "FIELD", default_value = "policy")]
    pub by: String,
    /// Only runs with this value of a field. May be repeated.
    #[arg(long = "where", value_name = "FIELD=VALUE", value_parser = parse_field)]
    pub filter: Vec<(String, String)>,
    /// Logarithmic axes, x or y, separated by commas.
    #[arg(long, value_delimiter = ',', value_name = "AXIS", value_parser = trimmed(EnumValueParser::<AxisArg>::new()))]
    pub log: Vec<AxisArg>,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Axis of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum AxisArg {
    /// Horizontal axis.
    X,
    /// Vertical axis.
    Y,
}

/// Arguments of `reveille figures learning`.
#[derive(Args)]
pub(crate) struct LearningArgs {
    /// Files of learned tables, at most 6. `shipped` and `shipped-paper-literal` select the shipped tables.
    /// `shipped-paper-ages` and `shipped-paper-literal-ages` select the shipped tables with ages.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Arguments of `reveille figures q-table`.
#[derive(Args)]
pub(crate) struct QTableArgs {
    /// File of learned tables. `shipped` and `shipped-paper-literal` select the shipped tables. `shipped-paper-ages`
    /// and `shipped-paper-literal-ages` select the shipped tables with ages.
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Numbers of devices N whose tables are drawn, separated by commas.
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        required = true,
        value_name = "N",
        value_parser = whole(1..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: Vec<u32>,
    /// Window of the tables to draw, in TTIs, or "ages" [default: the shortest window in the file].
    #[arg(long, short, value_name = "TTIS")]
    pub window: Option<Lookback>,
    /// Draw the wake-up table for this ranking instead of the duty-cycling table.
    #[arg(long, value_enum, value_name = "RANKING")]
    pub wake: Option<RankingArg>,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Ranking of the wake-up candidates.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum RankingArg {
    /// By `P_4,2`.
    P42,
    /// By the belief over the epicentre.
    Posterior,
}

/// Arguments of `reveille figures deployment`.
#[derive(Args)]
pub(crate) struct DeploymentArgs {
    /// Folder of a run, whose scenario is repeated; or a scenario file or preset [default: paper].
    #[arg(value_name = "RUN", conflicts_with = "scenario")]
    pub run: Option<PathBuf>,
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Number of the event, from 0; `none` draws a TTI without an event [default: an event with several reports and a
    /// wake-up, see docs/drawing-figures.md].
    #[arg(long, short, value_parser = parse_event, allow_negative_numbers = true)]
    pub event: Option<EventChoice>,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Parses the number of an event, or `none`.
fn parse_event(text: &str) -> Result<EventChoice, String> {
    match text.trim() {
        "none" => Ok(EventChoice::Without),
        number => number
            .parse()
            .map(EventChoice::Number)
            .map_err(|_| "must be none or a whole number from 0".to_owned()),
    }
}

/// Arguments of `reveille figures misses`.
#[derive(Args)]
pub(crate) struct MissesFigureArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Arguments of `reveille figures attention`.
#[derive(Args)]
pub(crate) struct AttentionArgs {
    /// Scenario options; the default policy is dt, with the model `attention`.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// TTI of the decision [default: the end of the warm-up].
    #[arg(long, short, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub tti: Option<u64>,
    /// Numbers of the devices whose attention is shown, separated by commas [default: the six devices with the highest
    /// or lowest expectation].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "DEVICE",
        value_parser = whole(0..=u32::MAX),
        allow_negative_numbers = true
    )]
    pub show: Vec<u32>,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// Arguments of `reveille figures robustness`.
#[derive(Args)]
pub(crate) struct RobustnessArgs {
    /// Scenario options; radio settings are ignored, and --policy acts like --policies.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Policies to compare, separated by commas [default: all].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "POLICY",
        value_parser = trimmed(StringValueParser::new())
    )]
    pub policies: Vec<String>,
    /// Only these radio impairments, separated by commas [default: all].
    #[arg(long, value_delimiter = ',', value_name = "IMPAIRMENT", value_parser = trimmed(impairments()))]
    pub only: Vec<String>,
    /// Runs per policy and level, with consecutive seeds.
    #[arg(long, default_value_t = 5, value_parser = whole(1..=10_000_u64), allow_negative_numbers = true)]
    pub seeds: u64,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}

/// The names of the figures over a whole study that `study::PAPER_FIGURES` does not list. `--only` accepts them.
pub(crate) fn other_figures() -> [&'static str; 5] {
    let ([harvest, net], [pareto, delay]) = (energy::NAMES, pareto::TRADE_OFFS.map(|trade| trade.name));
    [harvest, net, pareto, delay, front::NAME]
}

/// Returns the names of all figures that `reveille figures` draws without a subcommand.
fn figure_names() -> Vec<&'static str> {
    let names = study::PAPER_FIGURES.iter().map(|figure| figure.name);
    names.chain(other_figures()).collect()
}

/// Returns a parser for the names of radio impairments.
fn impairments() -> PossibleValuesParser {
    PossibleValuesParser::new(robustness::IMPAIRMENTS.iter().map(|impairment| impairment.name))
}

/// Arguments of `reveille figures timeline`.
#[derive(Args)]
pub(crate) struct TimelineArgs {
    /// Folder of a run, whose scenario is repeated; or a scenario file or preset [default: paper].
    #[arg(value_name = "RUN", conflicts_with = "scenario")]
    pub run: Option<PathBuf>,
    /// Scenario options.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Numbers of the devices to show, separated by commas, at most 8 [default: the three busiest devices].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "DEVICE",
        value_parser = whole(0..=u32::MAX),
        allow_negative_numbers = true
    )]
    pub show: Vec<u32>,
    /// First TTI to show [default: the end of the warm-up].
    #[arg(long, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub from: Option<u64>,
    /// Number of TTIs to show, 10 to 2000.
    #[arg(long, default_value_t = 200, value_parser = any_whole(10..=2000_u64), allow_negative_numbers = true)]
    pub length: u64,
    /// Picture options.
    #[command(flatten)]
    pub pictures: FigureOutputArgs,
}
