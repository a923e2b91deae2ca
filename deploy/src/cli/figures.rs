//! The options of pictures and of the report.

use std::path::PathBuf;

use clap::builder::PossibleValuesParser;
use clap::{Args, Subcommand, ValueEnum};
use reveille_bs::policy::q_learning::learned::Lookback;
use reveille_study::figures::robustness;

use super::ScenarioArgs;
use super::parse::{parse_device, parse_field, parse_whole};

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
    /// Only these figures, separated by commas, of: information, information-per-event, energy, misdetection,
    /// low-energy, battery, wrong, wasted, harvest, net, pareto, delay, front [default: all].
    #[arg(long, value_delimiter = ',', value_name = "FIGURE")]
    pub only: Vec<String>,
    /// Draw pareto and delay once for each preset and length of runs, with a line for each policy under each setting,
    /// for example for q-learning with tables of several weights. Other figures are drawn for each setting, as always.
    #[arg(long)]
    pub together: bool,
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
    /// What a decision of `dt` attended to: what it expected of each device in a TTI, and the TTIs that told it.
    #[command(after_help = "Example:\n  reveille figures attention --tti 1500 --set events.process=aftershocks")]
    Attention(AttentionArgs),
    /// What an imperfect radio costs: information, energy and missed events of policies against how often wake-ups,
    /// reports or plans are lost, devices wake for nothing, or nothing gets through.
    #[command(after_help = "Example:\n  reveille figures robustness --policies knn,age-index,genie --seeds 10")]
    Robustness(RobustnessArgs),
    /// Learning curves of tables of `reveille train`: reward and information by TTIs of training, for each N.
    Learning(LearningArgs),
    /// Learned tables for one N as heat maps: what sensing is worth, or what waking is worth.
    QTable(QTableArgs),
    /// A sweep of your own: any metric against any field that was swept.
    ///
    /// A line for each policy, or for each value of another field; a picture for each combination of the other fields
    /// in which the runs differ.
    #[command(
        after_help = "Examples:\n  reveille figures sweep mine --x harvest.lambda --y energy_per_device_tti\n  \
        reveille figures sweep mine --x harvest.lambda --by devices --where policy=knn --log x"
    )]
    Sweep(SweepFigureArgs),
}

/// `reveille figures sweep`.
#[derive(Args)]
pub struct SweepFigureArgs {
    /// Result tables of `reveille sweep`, or the folders of finished sweeps; runs that two of them hold count once.
    #[arg(required = true, value_name = "TABLE")]
    pub tables: Vec<PathBuf>,
    /// The field along x: one that was swept, such as harvest.lambda, or devices, or ttis.
    #[arg(long, value_name = "FIELD")]
    pub x: String,
    /// The metric along y, such as energy_per_device_tti; docs/results.md lists them.
    #[arg(long, value_name = "METRIC", default_value = "info_p1")]
    pub y: String,
    /// The field of whose values each has a line.
    #[arg(long, value_name = "FIELD", default_value = "policy")]
    pub by: String,
    /// Only runs in which a field has this value. May be repeated.
    #[arg(long = "where", value_name = "FIELD=VALUE", value_parser = parse_field)]
    pub only: Vec<(String, String)>,
    /// The axes that are logarithmic, separated by commas.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "AXIS")]
    pub log: Vec<AxisArg>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// An axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum AxisArg {
    /// From left to right.
    X,
    /// From bottom to top.
    Y,
}

/// `reveille figures learning`.
#[derive(Args)]
pub struct LearningArgs {
    /// Files of learned tables, at most 6; `shipped` and `shipped-paper-literal` for those that come with the program,
    /// with `-ages` after `shipped-paper` or `shipped-paper-literal` for those with ages.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// `reveille figures q-table`.
#[derive(Args)]
pub struct QTableArgs {
    /// A file of learned tables; `shipped` or `shipped-paper-literal` for those that come with the program, with
    /// `-ages` after `shipped-paper` or `shipped-paper-literal` for those with ages.
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The N of the tables to draw, or several, separated by commas.
    #[arg(long, short = 'n', value_delimiter = ',', required = true, value_name = "N")]
    pub devices: Vec<u32>,
    /// The window of the tables to draw, TTIs, or "ages" [default: the shortest that the file has].
    #[arg(long, short, value_name = "TTIS")]
    pub window: Option<Lookback>,
    /// Draw the wake-up table for this ranking, not the duty cycling.
    #[arg(long, value_enum, value_name = "RANKING")]
    pub wake: Option<RankingArg>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// How wake-up candidates were ranked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RankingArg {
    /// By `P_4,2`.
    P42,
    /// By the belief over the epicentre.
    Posterior,
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

/// `reveille figures attention`.
#[derive(Args)]
pub struct AttentionArgs {
    /// The scenario; its policy is dt unless said otherwise.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The TTI of the decision [default: the end of the warm-up].
    #[arg(long, short, value_parser = parse_whole, allow_negative_numbers = true)]
    pub tti: Option<u64>,
    /// Numbers of the devices whose attention is shown, separated by commas [default: the six of which most or least
    /// was expected].
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "DEVICE",
        value_parser = parse_device,
        allow_hyphen_values = true
    )]
    pub show: Vec<u32>,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// `reveille figures robustness`.
#[derive(Args)]
pub struct RobustnessArgs {
    /// The scenario; what it says of the policy and of the radio is left out.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// The policies, separated by commas [default: all].
    #[arg(long, value_delimiter = ',', value_name = "POLICY")]
    pub policies: Vec<String>,
    /// Only what fails so, separated by commas [default: all].
    #[arg(long, value_delimiter = ',', value_name = "IMPAIRMENT", value_parser = impairments())]
    pub only: Vec<String>,
    /// Runs of each policy at each level, with seeds one after another.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    pub seeds: u64,
    /// The pictures.
    #[command(flatten)]
    pub pictures: PictureArgs,
}

/// What can fail, by name.
fn impairments() -> PossibleValuesParser {
    PossibleValuesParser::new(robustness::IMPAIRMENTS.iter().map(|impairment| impairment.name))
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
