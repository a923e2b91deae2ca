//! Training of the `q-learning` policy: episodes in memory, on one deployment after another, for each window, or for
//! ages, and each N.
//!
//! An episode is a run of the very policy that is used later, with `learn` on, from random batteries. It begins with
//! the tables that the one before has left. Wake-up rankings take turns, so that both tables are learned. Each
//! window and N is trained for itself and in order, so the result depends neither on the number of threads nor on where
//! a training was interrupted.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::contract::Opaque;
use reveille_bs::policy::q_learning::learned::{
    CurvePoint, Entry, LONGEST_WINDOW, Learned, LearnedError, Lookback, Schedule, Setting, Training, Weights,
};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::prepared::Prepared;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::scenario::{Scenario, WakeUpRanking};
use reveille_common::units::Energy;

use crate::run::{Options, Run, StopWhen};

mod io;

/// The version that made a file, as files name it.
pub(crate) const MADE_BY: &str = concat!("reveille ", env!("CARGO_PKG_VERSION"));
/// Added to the seeds of episodes: no evaluation comes near them.
pub(crate) const SEEDS: u64 = 0x7EA1_C0DE_0000_0000;
/// The most devices that tables are trained for.
const MOST_DEVICES: u32 = 1_000_000;
/// The share of an episode that is left out of its point on the curve.
const WARM_UP: f64 = 0.1;
/// TTIs between two looks at whether to stop.
const LOOK: u64 = 200;

/// Why a training could not be begun or finished.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The scenario has another policy than the one that is trained.
    #[error("policy.name = {0}: only q-learning is trained")]
    Policy(String),
    /// A value is out of its range.
    #[error("{what} = {value}: {allowed}")]
    Invalid {
        /// The name of the value.
        what: &'static str,
        /// The value that was given.
        value: String,
        /// What the value may be.
        allowed: &'static str,
    },
    /// A list of numbers is empty, or one of them is out of range.
    #[error("{what} = {numbers:?}: must be a list of numbers from 1 to {most}")]
    List {
        /// The name of the list.
        what: &'static str,
        /// What it holds.
        numbers: Vec<u32>,
        /// The largest that they may be.
        most: u32,
    },
    /// There is a file already.
    #[error("{}: is there already; --force replaces it", .0.display())]
    Taken(PathBuf),
    /// The checkpoint belongs to another training.
    #[error(
        "{}: is the checkpoint of another training ({why}); finish that, remove the file, or use another --out",
        path.display()
    )]
    OtherCheckpoint {
        /// The checkpoint.
        path: PathBuf,
        /// What differs.
        why: String,
    },
    /// The checkpoint cannot be used.
    #[error("{}: the checkpoint {error}, or remove it to begin anew", path.display())]
    Checkpoint {
        /// The checkpoint.
        path: PathBuf,
        /// Why it cannot be used.
        error: LearnedError,
    },
    /// A file cannot be written.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        error: std::io::Error,
    },
    /// Threads cannot be started.
    #[error("{threads} threads cannot be started: {reason}")]
    Threads {
        /// The number of threads that was asked for.
        threads: usize,
        /// Why they cannot be started.
        reason: String,
    },
}

/// Follows a training. Called from all threads.
pub trait TrainingProgress: Sync {
    /// An episode of `entry`, the last point of its curve, has ended.
    fn episode(&self, entry: &Entry, point: &CurvePoint);
    /// Whether to stop; what was trained is kept in the checkpoint.
    fn stop(&self) -> bool;
}

impl TrainingProgress for () {
    fn episode(&self, _: &Entry, _: &CurvePoint) {}
    fn stop(&self) -> bool {
        false
    }
}

/// A training, ready to begin or to go on.
pub struct Trainer {
    scenario: Scenario,
    settings: QLearningSettings,
    training: Training,
    entries: Vec<Entry>,
}

impl Trainer {
    /// A training for each of `lookbacks`, or for the scenario's if there are none, and each N of `devices`, on the
    /// scenario's ground and with its weights. `training` says how long.
    ///
    /// # Errors
    /// The policy is not `q-learning`, or a number is out of its range.
    pub fn new(
        scenario: &Scenario,
        devices: &[u32],
        lookbacks: &[Lookback],
        training: &Training,
    ) -> Result<Self, TrainingError> {
        let Some(settings) = scenario.policy.settings::<QLearningSettings>() else {
            return Err(TrainingError::Policy(scenario.policy.name().to_owned()));
        };
        let invalid = |what, value: &dyn std::fmt::Display, allowed| TrainingError::Invalid {
            what,
            value: value.to_string(),
            allowed,
        };
        let devices = listed("devices", devices, MOST_DEVICES)?;
        let mut lookbacks = lookbacks.to_vec();
        if lookbacks.is_empty() {
            lookbacks.push(settings.lookback);
        }
        if let Some(bad) = lookbacks
            .iter()
            .find(|one| !(1..=LONGEST_WINDOW).contains(&one.window()))
        {
            return Err(invalid("windows", bad, "must be from 1 to 1000"));
        }
        lookbacks.sort_unstable();
        lookbacks.dedup();
        let Training {
            episodes,
            ttis,
            epsilon,
            ..
        } = training;
        if !(1..=100_000).contains(episodes) {
            return Err(invalid("episodes", episodes, "must be at least 1 and at most 100000"));
        }
        if !(10..=100_000_000).contains(ttis) {
            return Err(invalid(
                "episode-ttis",
                ttis,
                "must be at least 10 and at most 100000000",
            ));
        }
        if let Some(bad) = [epsilon.0, epsilon.1].iter().find(|e| !(0.0..1.0).contains(*e)) {
            return Err(invalid("epsilon", bad, "must be at least 0 and less than 1"));
        }
        // Rounded as a checkpoint holds them, so that going on from one is the same.
        let begun = |devices: u32, lookback: Lookback| {
            let one = Scenario {
                devices,
                ..scenario.clone()
            };
            let mut entry = Entry::optimistic(&one.site(), &settings.weights, lookback, settings.schedule.optimism);
            entry.round();
            entry
        };
        let each = |&lookback: &Lookback| devices.iter().map(move |&n| begun(n, lookback));
        let entries = lookbacks.iter().flat_map(each).collect();
        // The first stands for all: a training says which there are by its entries.
        let settings = QLearningSettings {
            lookback: lookbacks[0],
            ..settings.clone()
        };
        Ok(Self {
            entries,
            training: Training {
                seed: scenario.seed,
                ..training.clone()
            },
            scenario: Scenario {
                policy: scenario.policy.with_settings(settings.clone()),
                ..scenario.clone()
            },
            settings,
        })
    }

    /// Episodes that are still to be run.
    pub fn episodes_left(&self) -> u64 {
        let left = |entry: &Entry| self.training.episodes.saturating_sub(entry.curve.len() as u64);
        self.entries.iter().map(left).sum()
    }

    /// The tables as they are.
    pub fn learned(&self) -> Learned {
        let first = Scenario {
            devices: self.entries[0].devices,
            ..self.scenario.clone()
        };
        Learned {
            made_by: MADE_BY.to_owned(),
            scenario: first.hash_hex(),
            weights: self.settings.weights,
            begun_from: None,
            schedule: self.settings.schedule,
            training: self.training.clone(),
            setting: Setting::of(&self.scenario.site()),
            entries: self.entries.clone(),
        }
    }

    /// Goes on from the tables of a checkpoint.
    ///
    /// # Errors
    /// They are of another training; what differs.
    pub fn go_on(&mut self, found: Learned) -> Result<(), String> {
        let mine = self.learned();
        let ns = |learned: &Learned| learned.entries.iter().map(|e| e.devices).collect::<Vec<_>>();
        let mut why = mine.setting.differences(&found.setting);
        let differences = [
            (found.made_by != mine.made_by, "another version of Reveille"),
            (found.scenario != mine.scenario, "another scenario"),
            (!is_same_weights(&found.weights, &mine.weights), "other weights"),
            (
                !is_same_schedule(&found.schedule, &mine.schedule),
                "another learning rate or optimism",
            ),
            (
                !is_same_length(&found.training, &mine.training),
                "other episodes, epsilon or seed",
            ),
            (found.lookbacks() != mine.lookbacks(), "other windows"),
            (
                found.lookbacks() == mine.lookbacks() && ns(&found) != ns(&mine),
                "other numbers of devices",
            ),
        ];
        why.extend(
            differences
                .iter()
                .filter(|(differs, _)| *differs)
                .map(|(_, why)| (*why).to_owned()),
        );
        if !why.is_empty() {
            return Err(why.join(", "));
        }
        for (own, found) in self.entries.iter_mut().zip(found.entries) {
            let surface = own.surface;
            *own = Entry { surface, ..found };
        }
        Ok(())
    }

    /// Trains to the end on `threads` threads. After each episode `keep` is handed the tables as they are, by one
    /// thread at a time. Says whether it got there: the observer may have stopped it.
    ///
    /// # Errors
    /// Those of `keep`, or threads cannot be started.
    pub fn train(
        &mut self,
        threads: usize,
        keep: &(impl Fn(&Learned) -> Result<(), TrainingError> + Sync),
        observer: &impl TrainingProgress,
    ) -> Result<bool, TrainingError> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|error| TrainingError::Threads {
            threads,
            reason: error.to_string(),
        })?;
        let kept = Mutex::new(self.learned());
        let Self {
            scenario,
            settings,
            training,
            entries,
        } = self;
        let keep_with = |index: usize, entry: &Entry| {
            let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
            kept.entries[index] = entry.clone();
            keep(&kept)
        };
        // The longest first, so that no thread is left alone with it at the end.
        let mut work: Vec<(usize, &mut Entry)> = entries.iter_mut().enumerate().collect();
        work.reverse();
        let ended = pool.install(|| {
            work.par_iter_mut()
                .map(|(index, entry)| {
                    while (entry.curve.len() as u64) < training.episodes {
                        let Some(next) = episode(scenario, settings, training, entry, observer) else {
                            return Ok(false);
                        };
                        **entry = next;
                        keep_with(*index, entry)?;
                        observer.episode(entry, entry.curve.last().expect("the episode's"));
                    }
                    Ok(true)
                })
                .collect::<Result<Vec<bool>, TrainingError>>()
        })?;
        Ok(ended.iter().all(|done| *done))
    }
}

/// `numbers` by rising size, each once, if there are any and all are from 1 to `most`.
fn listed(what: &'static str, numbers: &[u32], most: u32) -> Result<Vec<u32>, TrainingError> {
    let mut numbers = numbers.to_vec();
    numbers.sort_unstable();
    numbers.dedup();
    match (numbers.first(), numbers.last()) {
        (Some(1..), Some(last)) if *last <= most => Ok(numbers),
        _ => Err(TrainingError::List { what, numbers, most }),
    }
}

/// Whether numbers are the same but for the last bits, which reading a file may change.
fn is_same(found: &[f64], mine: &[f64]) -> bool {
    let mut pairs = found.iter().zip(mine);
    pairs.all(|(a, b)| (a - b).abs() <= 1e-12 * a.abs().max(b.abs()))
}

fn is_same_weights(found: &Weights, mine: &Weights) -> bool {
    is_same(&[found.mu1, found.mu2, found.zeta], &[mine.mu1, mine.mu2, mine.zeta])
}

fn is_same_schedule(found: &Schedule, mine: &Schedule) -> bool {
    let [a, b] = [found, mine].map(|s| [s.rate_decay, s.rate_floor, s.optimism]);
    is_same(&a, &b)
}

fn is_same_length(found: &Training, mine: &Training) -> bool {
    let [a, b] = [found, mine].map(|t| [t.epsilon.0, t.epsilon.1]);
    is_same(&a, &b) && (found.episodes, found.ttis, found.seed) == (mine.episodes, mine.ttis, mine.seed)
}

/// The tables of `entry` after one more episode; `None` if the observer has stopped it.
fn episode(
    scenario: &Scenario,
    settings: &QLearningSettings,
    training: &Training,
    entry: &Entry,
    observer: &impl TrainingProgress,
) -> Option<Entry> {
    let number = entry.curve.len() as u64;
    let (first, last) = training.epsilon;
    let progress = number as f64 / (training.episodes - 1).max(1) as f64;
    let settings = QLearningSettings {
        learn: true,
        epsilon: [first + progress * (last - first); 2].into(),
        start: Arc::new(entry.clone()),
        lookback: entry.lookback,
        ..settings.clone()
    };
    let mut one = Scenario {
        devices: entry.devices,
        ttis: training.ttis,
        warm_up: WARM_UP,
        seed: SEEDS
            .wrapping_add(training.seed.wrapping_mul(0x1_0000_0001))
            .wrapping_add(u64::from(entry.devices) << 20)
            .wrapping_add(number),
        policy: scenario.policy.with_settings(settings),
        ..scenario.clone()
    };
    one.bs.ranking = if number.is_multiple_of(2) {
        WakeUpRanking::Posterior
    } else {
        WakeUpRanking::P42
    };
    let mut prepared = Prepared::without_pilots(&one);
    let mut stream = Stream::new(one.seed, Purpose::Training, 0);
    for device in &mut prepared.deployment.devices {
        device.energy.initial = Energy::from_micro((stream.unit() * device.energy.e_max.micro() as f64) as u64);
    }
    let options = Options {
        window: LOOK,
        ..Options::default()
    };
    let outcome = Run::new(&prepared, options).finish(&mut StopWhen(|| observer.stop()));
    let mut learned = left_by(&outcome).filter(|_| outcome.complete)?;
    learned.curve.push(point(&outcome, (number + 1) * training.ttis));
    learned.round();
    Some(learned)
}

/// What the policy has learned in a run of `scenario` that came to `outcome`, as a file of one entry; `None` for one
/// that does not learn.
pub fn learned_in(scenario: &Scenario, outcome: &Outcome) -> Option<Learned> {
    let settings = scenario.policy.settings::<QLearningSettings>()?;
    let mut entry = left_by(outcome)?;
    (entry.devices, entry.surface, entry.lookback) = (scenario.devices, scenario.area.surface(), settings.lookback);
    let before = entry.curve.last().map_or(0, |point| point.ttis);
    entry.curve.push(point(outcome, before + outcome.ttis_done));
    Some(Learned {
        made_by: MADE_BY.to_owned(),
        scenario: scenario.hash_hex(),
        weights: settings.weights,
        begun_from: settings.begun_from.clone(),
        schedule: settings.schedule,
        training: Training {
            episodes: 1,
            ttis: outcome.ttis_done.max(1),
            epsilon: settings.epsilon,
            seed: scenario.seed,
        },
        setting: Setting::of(&scenario.site()),
        entries: vec![entry],
    })
}

/// The tables as the run has left them that came to `outcome`.
fn left_by(outcome: &Outcome) -> Option<Entry> {
    outcome.learned.as_ref().and_then(Opaque::get).cloned()
}

/// The point on the learning curve after a run that came to `outcome`, at `ttis`.
fn point(outcome: &Outcome, ttis: u64) -> CurvePoint {
    let reward = outcome.facts.iter().find(|(name, _)| *name == "reward_per_tti");
    let defined = |x: f64| if x.is_nan() { 0.0 } else { x };
    CurvePoint {
        ttis,
        reward: reward.map_or(0.0, |(_, reward)| *reward),
        information: defined(outcome.metrics.info_p1),
        energy: defined(outcome.metrics.energy_per_device_tti),
    }
}

/// The name of the checkpoint of a training that ends in the file `out`.
pub fn checkpoint(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".checkpoint");
    PathBuf::from(name)
}

#[cfg(test)]
#[path = "small_tests.rs"]
mod small_tests;

#[cfg(test)]
#[path = "toy_tests.rs"]
mod toy_tests;

#[cfg(test)]
#[path = "training_tests.rs"]
mod tests;
