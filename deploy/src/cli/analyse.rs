//! The options of `reveille analyse`.

use std::path::PathBuf;

use super::parse::one_policy;
use clap::{Args, Subcommand};
use reveille_bs::policy::registry;

/// `reveille analyse`.
#[derive(Subcommand)]
pub enum AnalyseCommand {
    /// Sec. IV: the transition probabilities P_m,n as printed, beside what is counted in runs.
    #[command(
        after_help = "A frequency is the share of the visits of S_m whose next state is S_n, over all \
            devices and measured TTIs.\n\n\
            Examples:\n  \
            reveille analyse transitions\n  \
            reveille analyse transitions --policy random --devices 250 --seeds 50"
    )]
    Transitions(TransitionsArgs),
    /// Sec. III-B: the battery Markov chain and Eq. (8), beside the batteries of device machines.
    #[command(
        after_help = "The energy source and the costs are the scenario's; the duty cycle is fixed.\n\n\
            Examples:\n  \
            reveille analyse battery\n  \
            reveille analyse battery --duty 1/8 --e-b 5 --activation 0.02 --set harvest.lambda=0.05\n  \
            reveille analyse battery --duty 1/8 --e-b 5 --activation 0 --csv levels.csv   \
            (the distribution, bin by bin)"
    )]
    Battery(BatteryArgs),
    /// Sec. V-A: E(I_min) over deployments of each layout, beside Ψ p(√(ξ/2N)).
    #[command(after_help = "Example:\n  reveille analyse imin --layouts uniform,grid --devices 10,50,250 --seeds 1000")]
    Imin(IminArgs),
    /// Figs. 13 and 14: harvest and net energy against λ, closed form and measured.
    #[command(
        after_help = "Net energy is positive where the mean harvest exceeds a consumption: that of the scenario as it \
            is (the paper's way, its Fig. 8), and what the policy would spend if no battery were ever short.\n\n\
            Examples:\n  \
            reveille analyse harvest --csv fig13.csv\n  \
            reveille analyse harvest --devices 100 --policies random,adjusted"
    )]
    Harvest(HarvestArgs),
    /// Sec. V-D: wall time of each policy against N, with a fitted exponent.
    #[command(
        after_help = "Set-up: the devices are put on the ground and the policy is configured (clusters, search), once \
            per deployment; this is what the paper's complexities are about.\n\
            Run: all that happens in a TTI, devices and BS.\n\
            Decision: the BS's answer to an event, all its wake-ups included, without devices.\n\
            The area stays as it is, so density grows with N.\n\n\
            Example:\n  \
            reveille analyse runtime --devices 100,200,400,800 --policies knn"
    )]
    Runtime(RuntimeArgs),
}

/// What is studied, and how it is shown.
#[derive(Args, Clone, Debug)]
pub struct StudyArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file. See `reveille scenario show`.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one field, for example --set harvest.lambda=0.05. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// The first seed.
    #[arg(long, allow_negative_numbers = true)]
    pub seed: Option<String>,
    /// Print JSON instead of tables; numbers that are not defined are null.
    #[arg(long)]
    pub json: bool,
    /// Write the first table, in full precision, to this CSV file.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// `reveille analyse transitions`.
#[derive(Args)]
pub struct TransitionsArgs {
    /// The study.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Number of devices N.
    #[arg(long, short = 'n', allow_negative_numbers = true)]
    pub devices: Option<String>,
    /// One of the registered policies.
    #[arg(long, short, help = one_policy())]
    pub policy: Option<String>,
    /// Length of a run in TTIs, warm-up included.
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,
    /// Runs, each with a seed of its own.
    #[arg(long, default_value_t = 20)]
    pub seeds: u64,
}

/// `reveille analyse battery`.
#[derive(Args)]
pub struct BatteryArgs {
    /// The study.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Duty cycles t_on/t_DRX in TTIs, separated by commas.
    #[arg(long, default_value = "1/2,1/8,2/16", allow_hyphen_values = true)]
    pub duty: String,
    /// Energies E_B of an arrival, units, separated by commas.
    #[arg(long, default_value = "1,5,10", allow_hyphen_values = true)]
    pub e_b: String,
    /// Probabilities P_1,2 + P_4,2 that the device is made to transmit in a TTI, separated by commas.
    #[arg(long, default_value = "0,0.01,0.05", allow_hyphen_values = true)]
    pub activation: String,
    /// Devices that are measured.
    #[arg(long, short = 'n', default_value_t = 16)]
    pub devices: u32,
    /// TTIs that each of them is measured, after a tenth of that as warm-up.
    #[arg(long, short = 'k', default_value_t = 1_000_000)]
    pub ttis: u64,
    /// Width of a bin of the distributions, units.
    #[arg(long, default_value_t = 0.5)]
    pub bin: f64,
}

/// `reveille analyse imin`.
#[derive(Args)]
pub struct IminArgs {
    /// The study.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Numbers of devices N, separated by commas.
    #[arg(long, short = 'n', default_value = "10,50,100,250", allow_hyphen_values = true)]
    pub devices: String,
    /// Layouts, separated by commas.
    #[arg(long, default_value = "uniform,jittered-grid,poisson-disk,grid,hex")]
    pub layouts: String,
    /// Deployments, each with a seed of its own.
    #[arg(long, default_value_t = 200)]
    pub seeds: u64,
}

/// `reveille analyse harvest`.
#[derive(Args)]
pub struct HarvestArgs {
    /// The study.
    #[command(flatten)]
    pub study: StudyArgs,
    /// Values of λ, separated by commas.
    #[arg(
        long,
        default_value = "0.01,0.02,0.03,0.05,0.07,0.1,0.15,0.2,0.3,0.4,0.6,0.8,1",
        allow_hyphen_values = true
    )]
    pub lambda: String,
    /// Energies E_B of an arrival, units, separated by commas.
    #[arg(long, default_value = "1,5,10", allow_hyphen_values = true)]
    pub e_b: String,
    /// How λ becomes a probability: eq5, exp-minus-lambda.
    #[arg(long, default_value = "eq5,exp-minus-lambda")]
    pub readings: String,
    /// Numbers of devices N whose consumption is compared; the curves are measured with the scenario's own.
    #[arg(long, short = 'n', default_value = "10,100,250", allow_hyphen_values = true)]
    pub devices: String,
    /// Policies whose consumption is compared; the curves are measured with the first.
    #[arg(long, short, default_value = "random,adjusted,knn")]
    pub policies: String,
    /// Length of a run in TTIs, warm-up included.
    #[arg(long, short = 'k', allow_negative_numbers = true)]
    pub ttis: Option<String>,
    /// Runs for each point, each with a seed of its own.
    #[arg(long, default_value_t = 10)]
    pub seeds: u64,
}

/// `reveille analyse runtime`.
#[derive(Args)]
pub struct RuntimeArgs {
    /// The study.
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
    /// Policies, separated by commas.
    #[arg(long, short, default_value_t = registry::list(|_| true))]
    pub policies: String,
    /// TTIs of a timed run.
    #[arg(long, short = 'k', default_value = "5000", allow_hyphen_values = true)]
    pub ttis: String,
    /// Events of a timed round of decisions.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub events: u64,
    /// Repetitions, each with a seed of its own; medians count.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub repeat: u64,
}
