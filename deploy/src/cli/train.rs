//! Options of `reveille train`, which `commands/train/` executes. The commands in `docs/training.md` that made the
//! shipped tables rely on the defaults of `train q-learning`. `tune` takes [`EpisodeArgs`] too, and `training_command`
//! of `commands/tune.rs` repeats its options. The help of `--patience` repeats the interval of evaluations in
//! `commands/train/dt.rs`. Names of options are a public interface (see `cli`).

use std::path::PathBuf;
use std::str::FromStr;

use anyhow::bail;
use clap::{Args, Subcommand};
use reveille_bs::policy::dt::model::ModelObjective;
use reveille_bs::policy::q_learning::learned::{Lookback, QTrainingConfig};
use reveille_common::ids::MAX_DEVICES;

use super::examples::examples;
use super::parse::{any_whole, parse_number, trimmed, whole};
use super::run::ScenarioArgs;
use super::sweep::GridArgs;

/// Subcommands of `reveille train`.
#[derive(Subcommand)]
pub(crate) enum TrainCommand {
    /// Train the q-learning policy, and write its tables to a file
    ///
    /// The tables decide duty cycles and wake-ups, for each window and number of devices. Use them with `reveille run
    /// --policy q-learning --set policy.q-learning.table=FILE`.
    ///
    /// To resume an interrupted training, repeat the same command; this also works after kill -9.
    #[command(after_help = examples!(
        "reveille train q-learning --out mine.json",
        "reveille train q-learning --devices 700 --set policy.q-learning.mu1=5 --out mine.json",
    ))]
    QLearning(QLearningArgs),
    /// Record training data for `train dt` in many runs, under any policy
    ///
    /// The data are the observation, action and reward in every TTI.
    #[command(after_help = examples!(
        "reveille train record -p knn,age-index -n 50,250 --seeds 8 --out calm.parquet",
        "reveille train record --from runs/monday --from runs/tuesday --out testbed.parquet",
    ))]
    Record(RecordArgs),
    /// Train the decision transformer, the model of the `dt` policy, from recorded runs
    ///
    /// Use the model with `reveille run --policy dt --set policy.dt.model=FILE`. Training needs a build with the cargo
    /// feature `train-dt`: cargo run --release --features train-dt -- train dt …
    #[command(after_help = examples!(
        "reveille train dt calm.parquet --out model.safetensors",
        "reveille train dt calm.parquet bursts.parquet --steps 1000 --out model.safetensors",
    ))]
    Dt(DtArgs),
}

/// Arguments of `reveille train dt`.
#[derive(Args)]
pub(crate) struct DtArgs {
    /// Trajectory files of `reveille train record`.
    #[arg(required = true, value_name = "PARQUET")]
    pub trajectories: Vec<PathBuf>,
    /// Output file for the model.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace the output file if it exists.
    #[arg(long)]
    pub force: bool,
    /// Preset name or TOML file for the shape of the model. Only its fields policy.dt.memory, width and heads are used;
    /// the training data are the trajectories.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one scenario field, for example --set policy.dt.memory=4. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// Learning objective: the detected events, or the actions of the teachers (behaviour cloning).
    #[arg(long, default_value = "events", value_name = "OBJECTIVE")]
    #[arg(value_parser = ModelObjective::ALL.map(ModelObjective::name))]
    pub objective: String,
    /// Add attention between devices. `--set policy.dt.memory=Z` with Z above 1 adds attention over Z TTIs.
    #[arg(long)]
    pub attend_to_devices: bool,
    /// Maximum number of optimiser steps.
    #[arg(long, default_value_t = 3000, value_parser = whole(1..=u64::MAX), allow_negative_numbers = true)]
    pub steps: u64,
    /// Approximate number of device-TTIs in the batch of a step.
    #[arg(long, default_value_t = 16_000, value_parser = whole(1..=u32::MAX), allow_negative_numbers = true)]
    pub batch: u32,
    /// Initial learning rate.
    #[arg(long, default_value_t = 0.002, value_parser = parse_number, allow_negative_numbers = true)]
    pub rate: f64,
    /// Stop after this many consecutive evaluations on held-out data without improvement; one follows every 200 steps.
    #[arg(long, default_value_t = 6, value_parser = whole(1..=u64::MAX), allow_negative_numbers = true)]
    pub patience: u64,
    /// Seed of every random draw.
    #[arg(long, default_value_t = 1, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub seed: u64,
    /// Hide progress messages.
    #[arg(long, short)]
    pub quiet: bool,
}

/// Arguments of `reveille train record`.
#[derive(Args)]
pub(crate) struct RecordArgs {
    /// Experiment file of `reveille sweep`; options on the command line take precedence.
    pub experiment: Option<PathBuf>,
    /// Record the run of `up`, `bs` or `run` in this folder, instead of a grid. The run is replayed bit for bit in
    /// memory from its scenario, and its digest is compared. May be repeated.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["experiment", "explore", "GridArgs"])]
    pub from: Vec<PathBuf>,
    /// Runs to record.
    #[command(flatten)]
    pub grid: GridArgs,
    /// Length of a chunk in consecutive TTIs.
    #[arg(
        long,
        default_value_t = 16,
        value_name = "TTIS",
        value_parser = whole(1..=100_000_u32),
        allow_negative_numbers = true
    )]
    pub chunk: u32,
    /// TTIs from the start of one chunk to the start of the next; must exceed --chunk.
    #[arg(
        long,
        default_value_t = 100,
        value_name = "TTIS",
        value_parser = whole(2..=u32::MAX),
        allow_negative_numbers = true
    )]
    pub stride: u32,
    /// Shares of TTIs in which a device deviates from its policy, separated by commas. Runs use the shares in turn.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "0,0.02,0.1",
        value_name = "SHARE,…",
        value_parser = parse_number,
        allow_negative_numbers = true
    )]
    pub explore: Vec<f64>,
    /// Let policies that ignore batteries use the recorded levels to find devices that can pay for a report. If
    /// bs.battery_knowledge is "oracle", these are the true levels. Such policies then wake other devices than without
    /// a recording. The teachers of the shipped model were recorded with this option.
    #[arg(long, conflicts_with = "from")]
    pub true_batteries: bool,
    /// Parquet file for the trajectories.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace the output file if it exists.
    #[arg(long)]
    pub force: bool,
    /// Hide the progress bar.
    #[arg(long, short)]
    pub quiet: bool,
}

/// Arguments of `reveille train q-learning`.
#[derive(Args)]
pub(crate) struct QLearningArgs {
    /// Preset name (paper, paper-literal, quick) or TOML file.
    #[arg(long, short, default_value = "paper")]
    pub scenario: String,
    /// Override one scenario field, for example --set policy.q-learning.mu1=5. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    pub set: Vec<String>,
    /// Numbers of devices N to train for, separated by commas [default: 10,20,40,60,80,100,130,160,200,250, as in the
    /// paper; with layout.kind = "file", the number of its positions].
    #[arg(
        long,
        short = 'n',
        value_delimiter = ',',
        value_parser = whole(1..=MAX_DEVICES),
        allow_negative_numbers = true
    )]
    pub devices: Vec<u32>,
    /// Windows to train for, separated by commas. A window is the number of TTIs in which the area must be covered
    /// once; "ages" uses the ages of places instead [default: the scenario's policy.q-learning.window, or ages].
    #[arg(long, short, value_delimiter = ',', value_parser = trimmed(Lookback::from_str))]
    pub windows: Vec<Lookback>,
    /// Training options.
    #[command(flatten)]
    pub episodes: EpisodeArgs,
    /// Output file for the tables.
    #[arg(long, short)]
    pub out: PathBuf,
    /// Replace the output file if it exists.
    #[arg(long)]
    pub force: bool,
    /// Hide the progress bar.
    #[arg(long, short)]
    pub quiet: bool,
}

#[cfg(feature = "train-dt")]
impl DtArgs {
    /// Returns the scenario options for an untrained model.
    pub(crate) fn scenario(&self) -> ScenarioArgs {
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

    /// Returns the learning objective; the parser of the option accepts only its names.
    pub(crate) fn objective(&self) -> ModelObjective {
        let is_requested = |objective: &ModelObjective| objective.name() == self.objective;
        ModelObjective::ALL
            .into_iter()
            .find(is_requested)
            .unwrap_or(ModelObjective::Events)
    }
}

impl QLearningArgs {
    /// Returns the scenario options for a learner without tables.
    ///
    /// # Errors
    /// If `--set` sets a field that the training sets itself, or `--windows` mixes ages and windows.
    pub(crate) fn scenario(&self) -> anyhow::Result<ScenarioArgs> {
        let lookback_fields = ["policy.q-learning.window", "policy.q-learning.ages"];
        let sets_lookback = |set: &&String| lookback_fields.contains(&set.split('=').next().unwrap_or_default().trim());
        if let Some(set) = self.set.iter().find(sets_lookback).filter(|_| !self.windows.is_empty()) {
            bail!("--set {set}: a training takes it from --windows; leave one of them out");
        }
        let mut set = self.set.clone();
        if self.windows.contains(&Lookback::Ages) {
            if self.windows.iter().any(|lookback| *lookback != Lookback::Ages) {
                bail!(
                    "--windows: ages and windows need different weights and cannot be trained together; train ages \
                     separately, with --windows ages and another --out"
                );
            }
            set.push("policy.q-learning.ages=true".to_owned());
        }
        self.episodes.scenario(&self.scenario, &set, None)
    }
}

/// Scenario fields that a training sets itself, and the reason in the error for `--set`.
const FIXED_FIELDS: [(&str, &str); 7] = [
    ("seed", "a training takes it from --seed"),
    ("devices", "a training takes them from --devices"),
    ("ttis", "a training takes it from --episode-ttis"),
    ("policy.q-learning.epsilon", "a training takes it from --epsilon"),
    ("policy.q-learning.epsilon_last", "a training takes it from --epsilon"),
    ("policy.q-learning.learn", "a training learns: leave it out"),
    (
        "policy.q-learning.table",
        "training starts without tables; remove it, or use `reveille run --learn` to continue from tables",
    ),
];

/// Training options for tables, of `train q-learning` and `tune`.
#[derive(Args)]
pub(crate) struct EpisodeArgs {
    /// Number of episodes per table, each with a different deployment.
    #[arg(long, default_value_t = 36, value_parser = any_whole(1..=100_000_u64), allow_negative_numbers = true)]
    pub episodes: u64,
    /// Length of an episode in TTIs.
    #[arg(long, default_value_t = 3000, value_parser = any_whole(10..=100_000_000_u64), allow_negative_numbers = true)]
    pub episode_ttis: u64,
    /// Shares of random decisions in the first and in the last episode.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1,
        default_value = "0.1,0.03",
        value_name = "FIRST,LAST",
        value_parser = parse_number,
        allow_negative_numbers = true
    )]
    pub epsilon: Vec<f64>,
    /// Seed of every random draw.
    #[arg(long, default_value_t = 1, value_parser = whole(0..=u64::MAX), allow_negative_numbers = true)]
    pub seed: u64,
    /// Number of threads; the result does not depend on it [default: one per core].
    #[arg(long, value_parser = whole(1..=4096_u16), allow_negative_numbers = true)]
    pub threads: Option<u16>,
}

impl EpisodeArgs {
    /// Returns the configuration for the learner.
    ///
    /// # Errors
    /// Unless `--epsilon` has two shares. The trainer checks all ranges.
    pub(crate) fn training_config(&self) -> anyhow::Result<QTrainingConfig> {
        let &[first, last] = &self.epsilon[..] else {
            bail!("--epsilon takes two shares, for example 0.1,0.03");
        };
        Ok(QTrainingConfig {
            episodes: self.episodes,
            ttis: self.episode_ttis,
            epsilon: (first, last),
            seed: self.seed,
        })
    }

    /// Returns the number of threads.
    pub(crate) fn threads(&self) -> std::io::Result<usize> {
        match self.threads {
            Some(threads) => Ok(usize::from(threads)),
            None => Ok(std::thread::available_parallelism()?.get()),
        }
    }

    /// Returns the options of scenario `name` with the overrides in `set`, for a learner without tables.
    ///
    /// # Errors
    /// If `set` contains one of [`FIXED_FIELDS`].
    pub(super) fn scenario(&self, name: &str, set: &[String], devices: Option<String>) -> anyhow::Result<ScenarioArgs> {
        for setting in set {
            let field = setting.split('=').next().unwrap_or_default().trim();
            if let Some((_, reason)) = FIXED_FIELDS.iter().find(|(fixed, _)| *fixed == field) {
                bail!("--set {setting}: {reason}");
            }
        }
        let fixed_settings = ["name=q-learning", "q-learning.learn=true", "q-learning.table=nothing"];
        let fixed_settings = fixed_settings.map(|setting| format!("policy.{setting}"));
        Ok(ScenarioArgs {
            scenario: name.to_owned(),
            set: fixed_settings.into_iter().chain(set.iter().cloned()).collect(),
            devices,
            policy: None,
            learn: false,
            ttis: None,
            seed: Some(self.seed.to_string()),
        })
    }
}
