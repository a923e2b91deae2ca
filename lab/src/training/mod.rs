//! Training of the `q-learning` policy: episodes in memory, on one deployment after another, for each look-back (a
//! window or ages) and each N.
//!
//! An episode is a run of the deployed policy, with `learn` on, from random batteries and the tables of the previous
//! episode. Wake-up rankings alternate, so that both wake-up tables are learned. Each look-back and N is trained
//! independently, one episode after another. Tables depend on every seed and draw here, and on neither threads nor
//! interruptions. `reveille train q-learning` and `tuning` train; [`learned_tables_of`] writes the tables of single
//! runs.

mod io;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};
use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::policy::interface::LearnedState;
use reveille_bs::policy::q_learning::learned::{
    CurvePoint, LearnedError, LearnedTables, Lookback, MAX_WINDOW, QTrainingConfig, QWeights, Schedule, TableSet,
    TrainingSite,
};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::scenario::{PolicyChoice, Scenario};
use reveille_common::digits::count_noun;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::scenario::WakeUpRanking;
use reveille_common::units::Energy;

use crate::run::{Run, RunOptions, StopWhen};

/// The version of Reveille, as files of tables and the history of `tuning` name it. Checkpoints of another version are
/// refused.
pub(crate) const MADE_BY: &str = concat!("reveille ", env!("CARGO_PKG_VERSION"));
/// An offset to the seeds of episodes, far from the seeds of evaluations.
pub(crate) const EPISODE_SEED_OFFSET: u64 = 0x7EA1_C0DE_0000_0000;
/// The largest number of devices for which tables are trained.
const MAX_DEVICES: u32 = 1_000_000;
/// The share of an episode that its point on the curve leaves out.
const EPISODE_WARM_UP: f64 = 0.1;
/// The largest number of TTIs between two checks whether to stop.
const TTIS_BETWEEN_STOP_CHECKS: u64 = 200;

/// A reason why a training cannot start or finish.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The scenario has another policy than `q-learning`.
    #[error("policy.name = {0}: only q-learning has tables to train")]
    Policy(String),
    /// A value is out of range.
    #[error("{option} = {value}: {requirement}")]
    Invalid {
        /// The option.
        option: &'static str,
        /// The value.
        value: String,
        /// The requirement on the value: `must be …`.
        requirement: &'static str,
    },
    /// A list of numbers is empty, or one of them is out of range.
    #[error("{name} = {numbers:?}: must be a list of numbers from 1 to {max}")]
    List {
        /// The name of the list.
        name: &'static str,
        /// The numbers.
        numbers: Vec<u32>,
        /// The largest allowed number.
        max: u32,
    },
    /// The file exists already.
    #[error("{}: file exists; use --force to replace it", .0.display())]
    FileExists(PathBuf),
    /// The checkpoint belongs to another training.
    #[error(
        "{}: is the checkpoint of another training ({differences}); finish that one, remove the file, or use another \
         --out",
        path.display()
    )]
    OtherCheckpoint {
        /// The checkpoint.
        path: PathBuf,
        /// The differences.
        differences: String,
    },
    /// The checkpoint cannot be used.
    #[error("{}: the checkpoint cannot be used: {}; remove it to start over", path.display(), error.cause())]
    Checkpoint {
        /// The checkpoint.
        path: PathBuf,
        /// The cause.
        error: LearnedError,
    },
    /// A file cannot be written.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        error: std::io::Error,
    },
    /// Threads cannot be started.
    #[error("cannot start {}: {reason}", count_noun(*threads, "thread"))]
    Threads {
        /// The requested number of threads.
        threads: usize,
        /// The cause.
        reason: String,
    },
}

/// Callbacks of a training. All threads call them.
pub trait TrainingProgress: Sync {
    /// Reports the end of a complete episode of `entry`; `point` is the last point of its curve.
    fn episode_ended(&self, entry: &TableSet, point: &CurvePoint);
    /// Returns whether to stop. The checkpoint keeps the tables trained so far.
    fn should_stop(&self) -> bool;
}

impl TrainingProgress for () {
    fn episode_ended(&self, _: &TableSet, _: &CurvePoint) {}
    fn should_stop(&self) -> bool {
        false
    }
}

/// A training that can start or resume.
pub struct Trainer {
    /// The scenario of the training, with `settings` as its policy's. Each episode replaces N, the length and the seed.
    scenario: Scenario,
    settings: QLearningSettings,
    config: QTrainingConfig,
    /// The tables, by look-back and then by N, both ascending.
    entries: Vec<TableSet>,
}

impl Trainer {
    /// Creates a training for each of `lookbacks`, or for the scenario's if the slice is empty, and each N of
    /// `devices`. It uses the scenario's area, weights and seed; `config` sets the rest, except that its seed is
    /// ignored. The caller checks `config.ttis` against `Scenario::max_ttis` with the largest N.
    ///
    /// # Errors
    /// If the policy is not `q-learning`, or a number is out of range.
    pub fn new(
        scenario: &Scenario,
        devices: &[u32],
        lookbacks: &[Lookback],
        config: &QTrainingConfig,
    ) -> Result<Self, TrainingError> {
        let Some(settings) = scenario.policy.settings().downcast_ref::<QLearningSettings>() else {
            return Err(TrainingError::Policy(scenario.policy.name().to_owned()));
        };
        // Requirements are static texts, so each repeats its limit, such as `MAX_WINDOW`.
        let invalid = |option, value: &dyn std::fmt::Display, requirement| TrainingError::Invalid {
            option,
            value: value.to_string(),
            requirement,
        };
        let devices = sorted_numbers("devices", devices, MAX_DEVICES)?;
        let mut lookbacks = lookbacks.to_vec();
        if lookbacks.is_empty() {
            lookbacks.push(settings.lookback);
        }
        if let Some(lookback) = lookbacks
            .iter()
            .find(|lookback| !(1..=MAX_WINDOW).contains(&lookback.window()))
        {
            return Err(invalid("windows", lookback, "must be from 1 to 1000 TTIs"));
        }
        lookbacks.sort_unstable();
        lookbacks.dedup();
        let QTrainingConfig {
            episodes,
            ttis,
            epsilon,
            ..
        } = config;
        // Fewer than 2²⁰: the seeds of `run_episode` rely on it.
        if !(1..=100_000).contains(episodes) {
            return Err(invalid("episodes", episodes, "must be from 1 to 100000"));
        }
        if !(10..=100_000_000).contains(ttis) {
            return Err(invalid("episode-ttis", ttis, "must be from 10 to 100000000 TTIs"));
        }
        let rates = [epsilon.0, epsilon.1];
        if let Some(rate) = rates.iter().find(|rate| !(0.0..1.0).contains(*rate)) {
            return Err(invalid("epsilon", rate, "must be at least 0 and less than 1"));
        }
        // Rounded as in a checkpoint, so that a resumed training learns the same tables.
        let new_entry = |devices: u32, lookback: Lookback| {
            let mut scenario = scenario.clone();
            scenario.run.devices = devices;
            let optimism = settings.schedule.optimism;
            let mut entry = TableSet::optimistic(&scenario.site(), &settings.weights, lookback, optimism);
            entry.round();
            entry
        };
        let entries_of = |&lookback: &Lookback| devices.iter().map(move |&n| new_entry(n, lookback));
        let entries = lookbacks.iter().flat_map(entries_of).collect();
        // The settings hold one look-back; the entries name all look-backs of the training.
        let settings = QLearningSettings {
            lookback: lookbacks[0],
            ..settings.clone()
        };
        Ok(Self {
            entries,
            config: QTrainingConfig {
                seed: scenario.run.seed,
                ..config.clone()
            },
            scenario: Scenario {
                policy: PolicyChoice::new(scenario.policy.kind(), Arc::new(settings.clone())),
                ..scenario.clone()
            },
            settings,
        })
    }

    /// The number of outstanding episodes.
    pub fn episodes_left(&self) -> u64 {
        // Each episode adds a point to the curve.
        let left_of = |entry: &TableSet| self.config.episodes.saturating_sub(entry.curve.len() as u64);
        self.entries.iter().map(left_of).sum()
    }

    /// Returns the current tables as the content of a file, also of a checkpoint.
    pub fn learned(&self) -> LearnedTables {
        // A file names the scenario of its first entry.
        let mut first_scenario = self.scenario.clone();
        first_scenario.run.devices = self.entries[0].devices;
        LearnedTables {
            made_by: MADE_BY.to_owned(),
            scenario: first_scenario.hash_hex(),
            weights: self.settings.weights,
            begun_from: None,
            schedule: self.settings.schedule,
            training: self.config.clone(),
            site: TrainingSite::from_site(&self.scenario.site()),
            entries: self.entries.clone(),
        }
    }

    /// Resumes from the tables of a checkpoint.
    ///
    /// # Errors
    /// If the checkpoint belongs to another training; the error names the differences.
    pub fn resume_from(&mut self, checkpoint: LearnedTables) -> Result<(), String> {
        let expected = self.learned();
        let device_counts =
            |learned: &LearnedTables| learned.entries.iter().map(|entry| entry.devices).collect::<Vec<_>>();
        let mut reasons = expected.site.differences(&checkpoint.site);
        let differences = [
            (checkpoint.made_by != expected.made_by, "another version of Reveille"),
            (checkpoint.scenario != expected.scenario, "another scenario"),
            (
                !is_same_weights(&checkpoint.weights, &expected.weights),
                "other weights",
            ),
            (
                !is_same_schedule(&checkpoint.schedule, &expected.schedule),
                "another learning rate or optimism",
            ),
            (
                !is_same_config(&checkpoint.training, &expected.training),
                "other episodes, epsilon or seed",
            ),
            (checkpoint.lookbacks() != expected.lookbacks(), "other windows"),
            (
                // The entries also differ with the windows, which are named above.
                checkpoint.lookbacks() == expected.lookbacks()
                    && device_counts(&checkpoint) != device_counts(&expected),
                "other numbers of devices",
            ),
        ];
        reasons.extend(
            differences
                .iter()
                .filter(|(differs, _)| *differs)
                .map(|(_, reason)| (*reason).to_owned()),
        );
        if !reasons.is_empty() {
            return Err(reasons.join(", "));
        }
        for (entry, saved) in self.entries.iter_mut().zip(checkpoint.entries) {
            // The scenario's own surface: reading a file may change its last bits.
            let surface = entry.surface;
            *entry = TableSet { surface, ..saved };
        }
        Ok(())
    }

    /// Trains to the end on `threads` threads. After each episode it passes the current tables to `save`, from one
    /// thread at a time. Returns `false` if the observer has stopped it.
    ///
    /// # Errors
    /// If `save` fails, or threads cannot be started.
    pub fn train(
        &mut self,
        threads: usize,
        save: &(impl Fn(&LearnedTables) -> Result<(), TrainingError> + Sync),
        observer: &impl TrainingProgress,
    ) -> Result<bool, TrainingError> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|error| TrainingError::Threads {
            threads,
            reason: error.to_string(),
        })?;
        let tables = Mutex::new(self.learned());
        let Self {
            scenario,
            settings,
            config,
            entries,
        } = self;
        let save_entry = |index: usize, entry: &TableSet| {
            // Held while the checkpoint is written: an older one must not replace a newer one.
            let mut tables = tables.lock().unwrap_or_else(PoisonError::into_inner);
            tables.entries[index] = entry.clone();
            save(&tables)
        };
        // The largest N of a look-back first: otherwise one thread would still train it after all others have finished.
        let mut largest_first: Vec<(usize, &mut TableSet)> = entries.iter_mut().enumerate().collect();
        largest_first.reverse();
        let are_complete = pool.install(|| {
            largest_first
                .par_iter_mut()
                .map(|(index, entry)| {
                    while (entry.curve.len() as u64) < config.episodes {
                        let Some(next) = run_episode(scenario, settings, config, entry, observer) else {
                            return Ok(false);
                        };
                        **entry = next;
                        save_entry(*index, entry)?;
                        observer.episode_ended(entry, entry.curve.last().expect("the episode's"));
                    }
                    Ok(true)
                })
                .collect::<Result<Vec<bool>, TrainingError>>()
        })?;
        Ok(are_complete.iter().all(|is_complete| *is_complete))
    }
}

/// Returns `numbers` sorted and without duplicates, if the list is not empty and all are from 1 to `max`.
fn sorted_numbers(name: &'static str, numbers: &[u32], max: u32) -> Result<Vec<u32>, TrainingError> {
    let mut numbers = numbers.to_vec();
    numbers.sort_unstable();
    numbers.dedup();
    match (numbers.first(), numbers.last()) {
        (Some(1..), Some(last)) if *last <= max => Ok(numbers),
        _ => Err(TrainingError::List { name, numbers, max }),
    }
}

/// Returns whether the numbers are equal up to the last bits, which reading a file may change.
fn are_nearly_equal(saved: &[f64], expected: &[f64]) -> bool {
    let mut pairs = saved.iter().zip(expected);
    pairs.all(|(a, b)| (a - b).abs() <= 1e-12 * a.abs().max(b.abs()))
}

// The functions below list the fields of their types: add a new field there, or checkpoints ignore it.

fn is_same_weights(saved: &QWeights, expected: &QWeights) -> bool {
    let [saved, expected] = [saved, expected].map(|weights| [weights.mu1, weights.mu2, weights.zeta]);
    are_nearly_equal(&saved, &expected)
}

fn is_same_schedule(saved: &Schedule, expected: &Schedule) -> bool {
    let [saved, expected] =
        [saved, expected].map(|schedule| [schedule.rate_decay, schedule.rate_floor, schedule.optimism]);
    are_nearly_equal(&saved, &expected)
}

fn is_same_config(saved: &QTrainingConfig, expected: &QTrainingConfig) -> bool {
    let [saved_epsilon, expected_epsilon] = [saved, expected].map(|config| [config.epsilon.0, config.epsilon.1]);
    are_nearly_equal(&saved_epsilon, &expected_epsilon)
        && (saved.episodes, saved.ttis, saved.seed) == (expected.episodes, expected.ttis, expected.seed)
}

/// Returns the tables of `entry` after another episode; `None` if the observer has stopped it.
fn run_episode(
    scenario: &Scenario,
    settings: &QLearningSettings,
    config: &QTrainingConfig,
    entry: &TableSet,
    observer: &impl TrainingProgress,
) -> Option<TableSet> {
    let episode_index = entry.curve.len() as u64;
    let (first_epsilon, last_epsilon) = config.epsilon;
    // A single episode would be 0/0; it uses the first ε.
    let progress = episode_index as f64 / (config.episodes - 1).max(1) as f64;
    let settings = QLearningSettings {
        learn: true,
        epsilon: [first_epsilon + progress * (last_epsilon - first_epsilon); 2].into(),
        initial_tables: Arc::new(entry.clone()),
        lookback: entry.lookback,
        ..settings.clone()
    };
    // There are fewer than 2²⁰ episodes, so two N never share a seed. A test in `tuning` repeats the formula.
    let seed = EPISODE_SEED_OFFSET
        .wrapping_add(config.seed.wrapping_mul(0x1_0000_0001))
        .wrapping_add(u64::from(entry.devices) << 20)
        .wrapping_add(episode_index);
    let mut episode_scenario = scenario.with_seed(seed);
    episode_scenario.run.devices = entry.devices;
    episode_scenario.run.ttis = config.ttis;
    episode_scenario.run.warm_up = EPISODE_WARM_UP;
    episode_scenario.policy = PolicyChoice::new(scenario.policy.kind(), Arc::new(settings));
    // Each ranking has a separate table, and an episode trains one of them.
    episode_scenario.bs.ranking = if episode_index.is_multiple_of(2) {
        WakeUpRanking::Posterior
    } else {
        WakeUpRanking::P42
    };
    let mut prepared = PreparedRun::without_pilots(&episode_scenario);
    // From random batteries, so that the tables cover every battery level.
    let mut stream = Stream::new(episode_scenario.run.seed, Purpose::Training, 0);
    for device in &mut prepared.deployment.devices {
        device.energy.initial = Energy::from_micro((stream.unit() * device.energy.e_max.micro() as f64) as u64);
    }
    let options = RunOptions {
        // A window of the run's series, not a look-back: `StopWhen` asks at its end.
        window: TTIS_BETWEEN_STOP_CHECKS,
        ..RunOptions::default()
    };
    let outcome = Run::new(&prepared, options).finish(&mut StopWhen(|| observer.should_stop()));
    // An interrupted episode is repeated from its start: the tables must not depend on interruptions.
    let mut next = tables_of(&outcome).filter(|_| outcome.is_complete)?;
    next.curve
        .push(curve_point(&outcome, (episode_index + 1) * config.ttis));
    next.round();
    Some(next)
}

/// Returns the tables learned in a run of `scenario` with this `outcome`, as the content of a file with one entry, for
/// run folders. Returns `None` for a policy that does not learn.
pub fn learned_tables_of(scenario: &Scenario, outcome: &RunOutcome) -> Option<LearnedTables> {
    let settings = scenario.policy.settings().downcast_ref::<QLearningSettings>()?;
    let mut entry = tables_of(outcome)?;
    (entry.devices, entry.surface, entry.lookback) = (scenario.run.devices, scenario.area.surface(), settings.lookback);
    let before = entry.curve.last().map_or(0, |point| point.ttis);
    entry.curve.push(curve_point(outcome, before + outcome.ttis_done));
    Some(LearnedTables {
        made_by: MADE_BY.to_owned(),
        scenario: scenario.hash_hex(),
        weights: settings.weights,
        begun_from: settings.begun_from.clone(),
        schedule: settings.schedule,
        training: QTrainingConfig {
            episodes: 1,
            ttis: outcome.ttis_done.max(1),
            epsilon: settings.epsilon,
            seed: scenario.run.seed,
        },
        site: TrainingSite::from_site(&scenario.site()),
        entries: vec![entry],
    })
}

/// Returns the tables at the end of a run, without a point for this run on their curve.
fn tables_of(outcome: &RunOutcome) -> Option<TableSet> {
    outcome.learned.as_ref().and_then(LearnedState::get).cloned()
}

/// Returns the point on the learning curve at `ttis`, after a run with this `outcome`.
fn curve_point(outcome: &RunOutcome, ttis: u64) -> CurvePoint {
    // The name of a fact of `q-learning`. It is absent in a run without decisions.
    let reward = outcome.facts.iter().find(|(name, _)| *name == "reward_per_tti");
    // JSON has no NaN, the value of these metrics in an episode without events.
    let defined = |x: f64| if x.is_nan() { 0.0 } else { x };
    CurvePoint {
        ttis,
        reward: reward.map_or(0.0, |(_, reward)| *reward),
        information: defined(outcome.metrics.info_p1),
        energy: defined(outcome.metrics.energy_per_device_tti),
    }
}

/// Returns the checkpoint path of a training of `q-learning` or `dt` with the output file `out`.
pub fn checkpoint_path(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".checkpoint");
    PathBuf::from(name)
}

#[cfg(test)]
mod tests;
