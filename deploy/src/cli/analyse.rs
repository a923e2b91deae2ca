//! Options of `reveille analyse`, which `commands/analyse/` executes. Names of options are a public interface (see
//! `cli`). The range of `--seeds` repeats `MAX_SEEDS` of `study/src/analysis/mod.rs`. The help of `--readings` lists
//! the readings by hand, and the help of `battery --ttis` states the warm-up of `commands/analyse/battery.rs`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use reveille_bs::policy::registry;
use reveille_common::ids::MAX_DEVICES;

use super::examples::examples;
use super::parse::{any_whole, parse_number, policy_help, whole};

/// Subcommands of `reveille analyse`.
#[derive(Subcommand)]
pub(crate) enum AnalyseCommand {
    /// Compare the paper's probabilities of changes between the device states S1 to S4 with their frequencies in runs
    ///
    /// The probabilities P_m,n are in Sec. IV. A frequency is the share of visits to state S_m whose next state is S_n,
    /// over all devices and measured TTIs.
    #[command(after_help = examples!(
        "reveille analyse transitions",
        "reveille analyse transitions --policy random --devices 250 --seeds 50",
    ))]
    Transitions(TransitionsArgs),
    /// Compare the paper's model of a battery with the batteries of simulated devices
    ///
    /// The model is the Markov chain of Sec. III-B and Eq. (8). The scenario sets the energy source and the costs; the
    /// duty cycle is fixed. --csv writes the distribution of battery levels, bin by bin.
    #[command(after_help = examples!(
        "reveille analyse battery --duty 1/8 --e-b 5 --activation 0.02 --set harvest.lambda=0.05",
        "reveille analyse battery --duty 1/8 --e-b 5 --activation 0 --csv levels.csv",
    ))]
    Battery(BatteryArgs),
    /// Compare the paper's estimate of I_min with its mean over random deployments
    ///
    /// I_min is the information at which waking stops. The estimate of its mean is Ψ p(√(ξ/2N)) (Sec. V-A).
    #[command(after_help = examples!(
        "reveille analyse imin",
        "reveille analyse imin --layouts uniform,grid --devices 10,50,250 --seeds 1000",
    ))]
    Imin(IminArgs),
    /// Compute harvested and net energy for many harvest rates λ, and measure them in runs
    ///
    /// The tables reproduce Figs. 13 and 14. Net energy is positive where the mean harvest exceeds the consumption. The
    /// command compares two consumptions: the measured one (as in the paper's Fig. 8), and the one with batteries that
    /// never run short.
    #[command(after_help = examples!(
        "reveille analyse harvest --csv fig13.csv",
        "reveille analyse harvest --devices 100 --policies random,adjusted",
    ))]
    Harvest(HarvestArgs),
    /// Measure the computing time of each policy against the number of devices N
    ///
    /// The command measures three times, and fits an exponent of N to each (Sec. V-D). The area is constant, so density
    /// grows with N.
    ///
    /// Set-up: deployment of the devices and configuration of the policy (clusters, search), once per deployment. The
    /// paper's complexities refer to this step.
    ///
    /// Run: one complete TTI, devices and BS.
    ///
    /// Decision: the BS's response to an event with all wake-ups, without devices.
    #[command(after_help = examples!(
        "reveille analyse runtime",
        "reveille analyse runtime --devices 100,200,400,800 --policies knn",
    ))]
    Runtime(RuntimeArgs),
}

/// Options for the scenario and the output of a study.
#[derive(Args, Clone, Debug)]
pub(crate) struct StudyArgs {
    /// Preset name (paper, paper-literal, quick) or TOML file; see `reveille scenario show`.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one scenario field, for example --set harvest.lambda=0.05. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// First seed [default: the scenario's].
    #[arg(long, allow_negative_numbers = true)]
    pub seed: Option<String>,
    /// Print JSON instead of tables; undefined numbers are null.
    #[arg(long)]
    pub json: bool,
    /// Write the first table to this CSV file, in full precision.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// Arguments of `reveille analyse transitions`: one N, one policy and one length for all runs, which differ in their
/// seeds.
#[derive(Args)]
pub(crate) struct TransitionsArgs {
    /// Study options.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Number of devices N [default: the scenario's].
    #[arg(long, short = 'n', allow_negative_numbers = true)]
    pub devices: Option<String>,
    /// Registered policy.
    #[arg(long, short, help = policy_help())]
    pub policy: Option<String>,
    /// Length of a run in TTIs, warm-up included [default: the scenario's].
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,
    /// Number of runs, each with a different seed.
    #[arg(long, default_value_t = 20, value_parser = any_whole(1..=1_000_000_u64), allow_negative_numbers = true)]
    pub seeds: u64,
}

/// Arguments of `reveille analyse battery`: lists of duty cycles, energies and probabilities, of which every
/// combination is studied.
#[derive(Args)]
pub(crate) struct BatteryArgs {
    /// Study options.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Duty cycles t_on/t_DRX in TTIs, separated by commas.
    #[arg(long, default_value = "1/2,1/8,2/16", allow_hyphen_values = true)]
    pub duty: String,
    /// Energies E_B per arrival, in units, separated by commas.
    #[arg(long, default_value = "1,5,10", allow_hyphen_values = true)]
    pub e_b: String,
    /// Probabilities P_1,2 + P_4,2 that a device must transmit in a TTI, separated by commas.
    #[arg(long, default_value = "0,0.01,0.05", allow_hyphen_values = true)]
    pub activation: String,
    /// Number of simulated devices whose battery levels are measured.
    #[arg(
        long,
        short = 'n',
        default_value_t = 16,
        value_parser = whole(2..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: u32,
    /// Measured TTIs per device, after a warm-up of a tenth of this number.
    #[arg(
        long,
        short = 'k',
        default_value_t = 1_000_000,
        value_parser = whole(1..=u64::MAX),
        allow_negative_numbers = true
    )]
    pub ttis: u64,
    /// Bin width of the distributions, in units.
    #[arg(long, default_value_t = 0.5, value_parser = parse_number, allow_negative_numbers = true)]
    pub bin: f64,
}

/// Arguments of `reveille analyse imin`: lists of N and layouts, of which every combination is studied.
#[derive(Args)]
pub(crate) struct IminArgs {
    /// Study options.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Numbers of devices N, separated by commas.
    #[arg(long, short = 'n', default_value = "10,50,100,250", allow_hyphen_values = true)]
    pub devices: String,
    /// Rules that place the devices, separated by commas.
    #[arg(long, default_value = "uniform,jittered-grid,poisson-disk,grid,hex")]
    pub layouts: String,
    /// Number of deployments, each with a different seed.
    #[arg(long, default_value_t = 200, value_parser = any_whole(1..=1_000_000_u64), allow_negative_numbers = true)]
    pub seeds: u64,
}

/// Arguments of `reveille analyse harvest`.
#[derive(Args)]
pub(crate) struct HarvestArgs {
    /// Study options.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Values of λ, separated by commas.
    #[arg(
        long,
        default_value = "0.01,0.02,0.03,0.05,0.07,0.1,0.15,0.2,0.3,0.4,0.6,0.8,1",
        allow_hyphen_values = true
    )]
    pub lambda: String,
    /// Energies E_B per arrival, in units, separated by commas.
    #[arg(long, default_value = "1,5,10", allow_hyphen_values = true)]
    pub e_b: String,
    /// Formulas that convert λ into a probability, separated by commas: eq5, exp-minus-lambda.
    #[arg(long, default_value = "eq5,exp-minus-lambda")]
    pub readings: String,
    /// Numbers of devices N, separated by commas, for the comparison of consumption. The curves use the scenario's N.
    #[arg(long, short = 'n', default_value = "10,100,250", allow_hyphen_values = true)]
    pub devices: String,
    /// Policies, separated by commas, for the comparison of consumption. The curves use the first policy.
    #[arg(long, short, visible_alias = "policy", default_value = "random,adjusted,knn")]
    pub policies: String,
    /// Length of a run in TTIs, warm-up included [default: the scenario's].
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,
    /// Runs per point, each with a different seed.
    #[arg(long, default_value_t = 10, value_parser = any_whole(1..=1_000_000_u64), allow_negative_numbers = true)]
    pub seeds: u64,
}

/// Arguments of `reveille analyse runtime`.
#[derive(Args)]
pub(crate) struct RuntimeArgs {
    /// Study options.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Numbers of devices N, separated by commas.
    #[arg(
        long,
        short = 'n',
        default_value = "10,25,50,100,250,500,1000,2500",
        allow_hyphen_values = true
    )]
    pub devices: String,
    /// Policies to time, separated by commas.
    #[arg(long, short, visible_alias = "policy", default_value_t = registry::comma_separated_names(|_| true))]
    pub policies: String,
    /// Length of a timed run in TTIs.
    #[arg(long, short = 'k', default_value = "5000", allow_hyphen_values = true)]
    pub ttis: String,
    /// Number of events in a repetition of the decision measurement; the decision time is the mean per event.
    #[arg(long, default_value_t = 1000, value_parser = whole(1..=1_000_000_u64), allow_negative_numbers = true)]
    pub events: u64,
    /// Repetitions, each with a different seed; the results are medians.
    #[arg(long, default_value_t = 5, value_parser = whole(1..=1000_u64), allow_negative_numbers = true)]
    pub repeat: u64,
}
