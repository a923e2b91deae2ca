//! The options of `reveille train`.

use std::num::NonZero;
use std::path::PathBuf;

use anyhow::bail;
use clap::{Args, Subcommand};
use reveille_bs::policy::dt::model::shape::Objective;
use reveille_bs::policy::q_learning::learned::{Lookback, Training};

use super::run::ScenarioArgs;
use super::sweep::GridArgs;

/// What to train.
#[derive(Subcommand)]
pub enum TrainCommand {
    /// Learn who senses and whom to wake, for each window and N, and write the tables to a file.
    #[command(after_help = "Examples:\n  reveille train q-learning --out mine.json\n  \
        reveille train q-learning --devices 700 --set policy.q-learning.mu1=5 --out mine.json\n  \
        reveille train q-learning --windows 1,2,4 --out mine.json\n  \
        reveille train q-learning --windows ages --out ages.json\n\
        Then:\n  reveille run --policy q-learning --set policy.q-learning.table=mine.json\n\n\
        A training that was cut short, even by kill -9, goes on when the same command is given again.")]
    QLearning(TrainArgs),
    /// Record what a base station knew, did and gained in every TTI of many runs, under any policy: what `train dt`
    /// learns from.
    #[command(
        after_help = "Examples:\n  reveille train record -p age-index --grid policy.age-index.price=0.1,0.35,1 \
        -n 50,250 --seeds 8 --out calm.parquet\n  \
        reveille train record -p q-learning,knn -n 50,250 --set events.process=bursts --explore 0,0.1 \
        --out bursts.parquet\n  \
        reveille train record --from runs/monday --from runs/tuesday --out testbed.parquet\n\
        Then:\n  reveille train dt calm.parquet bursts.parquet --out model.safetensors"
    )]
    Record(RecordArgs),
    /// Train the decision transformer from recorded trajectories alone.
    #[command(
        after_help = "Examples:\n  reveille train dt calm.parquet bursts.parquet --out model.safetensors\n\
        Then:\n  reveille run --policy dt --set policy.dt.model=model.safetensors\n\n\
        It needs a build with the cargo feature train-dt: cargo run --release --features train-dt -- train dt …"
    )]
    Dt(DtArgs),
}

/// `reveille train dt`.
#[derive(Args)]
pub struct DtArgs {
    /// Trajectories, as `reveille train record` writes them.
    #[arg(required = true, value_name = "PARQUET")]
    pub trajectories: Vec<PathBuf>,
    /// The file for the model.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace that file if it is there.
    #[arg(long)]
    pub force: bool,
    /// A preset's name or a TOML file, whose policy.dt.memory, width and heads are the shape of the model.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one field, for example --set policy.dt.memory=4. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// What is learned: the events that looks find, or the actions of the teachers (behaviour cloning).
    #[arg(long, default_value = "events", value_parser = Objective::ALL.map(Objective::name), value_name = "OBJECTIVE")]
    pub objective: String,
    /// Devices do not attend to each other.
    #[arg(long)]
    pub no_space: bool,
    /// Steps of the optimiser, at most.
    #[arg(long, default_value_t = 3000, value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: u64,
    /// Device-TTIs of a step's batch, about.
    #[arg(long, default_value_t = 16_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub batch: u32,
    /// Learning rate at the start.
    #[arg(long, default_value_t = 0.002)]
    pub rate: f64,
    /// Looks at what is held out, 200 steps apart, without a better one after which the training ends.
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u64).range(1..))]
    pub patience: u64,
    /// Seed of everything that is drawn.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// No progress.
    #[arg(long, short)]
    pub quiet: bool,
}

/// `reveille train record`.
#[derive(Args)]
pub struct RecordArgs {
    /// An experiment file, as of `reveille sweep`. Options win over what it says.
    pub experiment: Option<PathBuf>,
    /// Record the run in this folder, of `up`, `bs` or `run`, instead of a grid: it is done again in memory, bit for
    /// bit, from the scenario there, and its digest is compared. May be repeated.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["experiment", "explore", "GridArgs"])]
    pub from: Vec<PathBuf>,
    /// The runs that are recorded.
    #[command(flatten)]
    pub grid: GridArgs,
    /// TTIs of a chunk: so many are recorded one after the other.
    #[arg(long, default_value_t = 16, value_name = "TTIS", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub chunk: u32,
    /// TTIs from the start of one chunk to the start of the next, more than --chunk.
    #[arg(long, default_value_t = 100, value_name = "TTIS")]
    pub every: u32,
    /// Shares of the TTIs in which a device does not do what its policy says, separated by commas; runs take them in
    /// turn.
    #[arg(long, value_delimiter = ',', default_value = "0,0.02,0.1", value_name = "SHARE,…")]
    pub explore: Vec<f64>,
    /// Let policies that do not look at batteries go by those that are recorded when they ask who can pay for a report:
    /// by the true ones where the scenario's bs.battery_knowledge is "oracle". They wake others then than without a
    /// recording. The teachers of the model that comes with the program were recorded so.
    #[arg(long, conflicts_with = "from")]
    pub told: bool,
    /// The Parquet file of the trajectories.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace that file if it is there.
    #[arg(long)]
    pub force: bool,
    /// No progress bar.
    #[arg(long, short)]
    pub quiet: bool,
}

/// `reveille train q-learning`.
#[derive(Args)]
pub struct TrainArgs {
    /// A preset's name (paper, paper-literal, quick) or a TOML file.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one field, for example --set policy.q-learning.mu1=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// Numbers of devices to train for, separated by commas.
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        default_value = "10,20,40,60,80,100,130,160,200,250"
    )]
    pub devices: Vec<u32>,
    /// Windows to train for, TTIs within which the area is to be covered once, separated by commas; "ages" for places
    /// that have ages instead [default: the scenario's policy.q-learning.window, or ages].
    #[arg(long, short, value_delimiter = ',')]
    pub windows: Vec<Lookback>,
    #[command(flatten)]
    pub episodes: EpisodeArgs,
    /// The file for the tables.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace that file if it is there.
    #[arg(long)]
    pub force: bool,
    /// No progress bar.
    #[arg(long, short)]
    pub quiet: bool,
}

#[cfg(feature = "train-dt")]
impl DtArgs {
    /// The scenario's options, for a model that has learned nothing yet.
    pub fn scenario(&self) -> ScenarioArgs {
        let untrained = ["policy.name=dt", "policy.dt.model=untrained"].map(str::to_owned);
        ScenarioArgs {
            scenario: self.scenario.clone(),
            set: self.set.iter().cloned().chain(untrained).collect(),
            devices: None,
            policy: None,
            learn: false,
            ttis: None,
            seed: None,
        }
    }

    /// What is learned.
    pub fn objective(&self) -> Objective {
        let named = |objective: &Objective| objective.name() == self.objective;
        Objective::ALL.into_iter().find(named).unwrap_or(Objective::Events)
    }
}

impl TrainArgs {
    /// The scenario's options.
    pub fn scenario(&self) -> anyhow::Result<ScenarioArgs> {
        let fields = ["policy.q-learning.window", "policy.q-learning.ages"];
        let is_window = |set: &&String| fields.contains(&set.split('=').next().unwrap_or_default().trim());
        if let Some(set) = self.set.iter().find(is_window).filter(|_| !self.windows.is_empty()) {
            bail!("--set {set}: a training takes it from --windows; leave one of them out");
        }
        let mut set = self.set.clone();
        if self.windows.contains(&Lookback::Ages) {
            if self.windows.iter().any(|one| *one != Lookback::Ages) {
                bail!(
                    "--windows: tables for ages and for windows are learned for other weights; train those for ages \
                     with --windows ages, into a file of their own"
                );
            }
            set.push("policy.q-learning.ages=true".to_owned());
        }
        self.episodes.scenario(&self.scenario, &set, None)
    }
}

/// Fields of a scenario that a training decides, and how to.
const DECIDED: [(&str, &str); 7] = [
    ("seed", "a training takes it from --seed"),
    ("devices", "a training takes them from --devices"),
    ("ttis", "a training takes it from --episode-ttis"),
    ("policy.q-learning.epsilon", "a training takes it from --epsilon"),
    ("policy.q-learning.epsilon_last", "a training takes it from --epsilon"),
    ("policy.q-learning.learn", "a training learns: leave it out"),
    (
        "policy.q-learning.table",
        "a training begins with nothing: leave it out; to go on from tables, reveille run --learn",
    ),
];

/// How tables are trained.
#[derive(Args)]
pub struct EpisodeArgs {
    /// Episodes for each table, each on a deployment of its own.
    #[arg(long, default_value_t = 36)]
    pub episodes: u64,
    /// Length of an episode, TTIs.
    #[arg(long, default_value_t = 3000)]
    pub episode_ttis: u64,
    /// Share of decisions made at random in the first episode and in the last.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1,
        default_value = "0.1,0.03",
        value_name = "FIRST,LAST"
    )]
    pub epsilon: Vec<f64>,
    /// Seed of everything that is drawn.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Threads; the result does not depend on them [default: one for each core].
    #[arg(long)]
    pub threads: Option<NonZero<usize>>,
}

impl EpisodeArgs {
    /// These options as the learner takes them.
    pub fn training(&self) -> anyhow::Result<Training> {
        let &[first, last] = &self.epsilon[..] else {
            bail!("--epsilon takes two shares, for example 0.1,0.03");
        };
        Ok(Training {
            episodes: self.episodes,
            ttis: self.episode_ttis,
            epsilon: (first, last),
            seed: self.seed,
        })
    }

    /// How many threads.
    pub fn threads(&self) -> std::io::Result<usize> {
        match self.threads {
            Some(threads) => Ok(usize::from(threads)),
            None => Ok(std::thread::available_parallelism()?.get()),
        }
    }

    /// The scenario `name` with the overrides in `set` for a learner that begins with nothing.
    pub(super) fn scenario(&self, name: &str, set: &[String], devices: Option<String>) -> anyhow::Result<ScenarioArgs> {
        for set in set {
            let field = set.split('=').next().unwrap_or_default().trim();
            if let Some((_, instead)) = DECIDED.iter().find(|(decided, _)| *decided == field) {
                bail!("--set {set}: {instead}");
            }
        }
        let learner = ["name=q-learning", "q-learning.learn=true", "q-learning.table=nothing"];
        let learner = learner.map(|set| format!("policy.{set}"));
        Ok(ScenarioArgs {
            scenario: name.to_owned(),
            set: learner.into_iter().chain(set.iter().cloned()).collect(),
            devices,
            policy: None,
            learn: false,
            ttis: None,
            seed: Some(self.seed.to_string()),
        })
    }
}
