//! How a pair of weights is judged: tables are trained with it, and runs with those tables are measured.

use std::sync::Arc;

use rayon::ThreadPool;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use reveille_bs::policy::q_learning::learned::{CurvePoint, Entry, Training, Weights};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::prepared::Prepared;
use reveille_common::scenario::{MAX_TTIS, Scenario};
use reveille_common::score::Metrics;

use super::error::TuningError;
use super::evaluation::{Evaluation, Point};
use super::objective::Objective;
use super::ranges::{LEAST_DESIGN, Pair, Ranges, design};
use crate::run::{Options, Run, StopWhen};
use crate::stats::Estimate;
use crate::training::{self, Trainer, TrainingError, TrainingProgress};

/// Added to the seeds of evaluation runs: no training and no sweep comes near them.
const SEEDS: u64 = 0xE7A1_5EED_0000_0000;
/// TTIs between two looks at whether to stop.
const LOOK: u64 = 200;
/// The most evaluation runs of a pair.
const MOST_RUNS: u64 = 10_000;
/// The most pairs of a design.
const MOST_DESIGN: usize = 1000;

/// Follows a tuning. Called from all threads.
pub trait TuningProgress: Sync {
    /// The evaluation of a pair, the point `number` from 0, has begun.
    fn begun(&self, _number: usize, _weights: Pair) {}
    /// An episode of the pair's training has ended.
    fn episode(&self) {}
    /// One of the pair's evaluation runs has ended.
    fn run(&self) {}
    /// The evaluation has ended, and its point is in the history.
    fn point(&self, _point: &Point) {}
    /// Whether to stop; the point under way is lost.
    fn stop(&self) -> bool;
}

impl TuningProgress for () {
    fn stop(&self) -> bool {
        false
    }
}

/// What is tuned, and how each pair is judged.
#[derive(Clone, Debug)]
pub struct Plan {
    /// What tables are trained and measured on. Its weights are tried first, its seed decides everything drawn.
    pub scenario: Scenario,
    /// Where weights are looked for.
    pub ranges: Ranges,
    /// The objective that is maximised.
    pub objective: Objective,
    /// Pairs before the first that is chosen by the others, ≥ [`LEAST_DESIGN`].
    pub design: usize,
    /// How tables are trained.
    pub training: Training,
    /// Evaluation runs of each pair, ≥ 1.
    pub runs: u64,
    /// The length of an evaluation run, TTIs.
    pub ttis: u64,
}

impl Plan {
    /// Checks every number.
    ///
    /// # Errors
    /// The policy is not `q-learning`, or a number is out of its range.
    pub fn check(&self) -> Result<(), TuningError> {
        Trainer::new(&self.scenario, &[self.scenario.devices], &[], &self.training)?;
        let invalid = |what, value: &dyn std::fmt::Display, allowed: &str| {
            Err(TuningError::Invalid {
                what,
                value: value.to_string(),
                allowed: allowed.to_owned(),
            })
        };
        if !(LEAST_DESIGN..=MOST_DESIGN).contains(&self.design) {
            return invalid("design", &self.design, "must be at least 3 and at most 1000");
        }
        if !(1..=MOST_RUNS).contains(&self.runs) {
            return invalid("seeds", &self.runs, "must be at least 1 and at most 10000");
        }
        if !(10..=MAX_TTIS).contains(&self.ttis) {
            return invalid("ttis", &self.ttis, "must be at least 10 and at most 1000000000");
        }
        let longest = self.scenario.longest();
        for (what, ttis) in [("ttis", self.ttis), ("episode-ttis", self.training.ttis)] {
            if ttis > longest {
                let allowed = format!("must be at most {longest} with so many devices, or sums of energy overflow");
                return invalid(what, &ttis, &allowed);
            }
        }
        if let Objective::Balance { energy, miss } = self.objective {
            for (what, weight) in [("energy-weight", energy), ("miss-weight", miss)] {
                if !(0.0..=1e6).contains(&weight) {
                    return invalid(what, &weight, "must be at least 0 and at most 1000000");
                }
            }
        }
        Ok(())
    }

    fn settings(&self) -> Result<&QLearningSettings, TuningError> {
        let policy = &self.scenario.policy;
        policy
            .settings()
            .ok_or_else(|| TrainingError::Policy(policy.name().to_owned()).into())
    }

    /// The pairs that are tried first.
    pub fn design(&self) -> Vec<Pair> {
        let start = self.settings().map_or([0.0; 2], |s| [s.weights.mu1, s.weights.mu2]);
        design(&self.ranges, start, self.design, self.scenario.seed)
    }

    /// What makes this tuning another than others, by name. The number of pairs after the design is no part of it.
    pub fn header(&self) -> Vec<(String, String)> {
        let Ranges { mu1, mu2 } = self.ranges;
        let Training {
            episodes,
            ttis,
            epsilon,
            ..
        } = &self.training;
        let all = [
            ("made by", training::MADE_BY.to_owned()),
            ("scenario", self.scenario.hash_hex()),
            ("preset", self.scenario.preset.clone()),
            ("ranking", self.scenario.bs.ranking.name().to_owned()),
            ("devices", self.scenario.devices.to_string()),
            ("seed", self.scenario.seed.to_string()),
            ("objective", format!("{}: {}", self.objective.name(), self.objective)),
            ("mu1", format!("{} to {}", mu1.0, mu1.1)),
            ("mu2", format!("{} to {}", mu2.0, mu2.1)),
            ("design", format!("{} pairs", self.design)),
            (
                "training",
                format!(
                    "{episodes} episodes of {ttis} TTIs, epsilon {} to {}",
                    epsilon.0, epsilon.1
                ),
            ),
            ("evaluation", format!("{} runs of {} TTIs", self.runs, self.ttis)),
        ];
        all.map(|(name, value)| (name.to_owned(), value)).to_vec()
    }

    /// The evaluation of `weights`, on the threads of `pool`; `None` if the observer has stopped it.
    ///
    /// # Errors
    /// The tables cannot be trained, or there was no event.
    pub fn evaluate(
        &self,
        weights: Pair,
        pool: &ThreadPool,
        observer: &impl TuningProgress,
    ) -> Result<Option<Evaluation>, TuningError> {
        let Some(scenario) = self.trained(weights, observer)? else {
            return Ok(None);
        };
        let one = |index: u64| {
            let own = Scenario {
                seed: evaluation_seed(self.scenario.seed, index),
                ..scenario.clone()
            };
            let options = Options {
                window: LOOK,
                ..Options::default()
            };
            let outcome = Run::new(&Prepared::without_pilots(&own), options).finish(&mut StopWhen(|| observer.stop()));
            observer.run();
            outcome.complete.then_some(outcome.metrics)
        };
        let metrics: Option<Vec<Metrics>> = pool.install(|| (0..self.runs).into_par_iter().map(one).collect());
        metrics.map(|metrics| self.judge(&metrics)).transpose()
    }

    /// The scenario of the evaluation runs but for their seeds, with tables that were trained with `weights`.
    fn trained(&self, weights: Pair, observer: &impl TuningProgress) -> Result<Option<Scenario>, TuningError> {
        let settings = self.settings()?;
        let [mu1, mu2] = weights;
        let settings = QLearningSettings {
            weights: Weights {
                mu1,
                mu2,
                ..settings.weights
            },
            ..settings.clone()
        };
        let with = |settings: QLearningSettings| Scenario {
            policy: self.scenario.policy.with_settings(settings),
            ..self.scenario.clone()
        };
        let mut trainer = Trainer::new(&with(settings.clone()), &[self.scenario.devices], &[], &self.training)?;
        if !trainer.train(1, &|_| Ok(()), &Episodes(observer))? {
            return Ok(None);
        }
        let entry = trainer.learned().entries.swap_remove(0);
        let settings = QLearningSettings {
            learn: false,
            epsilon: (0.0, 0.0),
            start: Arc::new(entry),
            ..settings
        };
        Ok(Some(Scenario {
            ttis: self.ttis,
            ..with(settings)
        }))
    }

    /// The means over `metrics`, those of runs.
    fn judge(&self, metrics: &[Metrics]) -> Result<Evaluation, TuningError> {
        let (alpha, devices) = (self.scenario.events.alpha, self.scenario.devices);
        let over = |of: &dyn Fn(&Metrics) -> f64| Estimate::over(metrics.iter().map(of));
        let objective = over(&|m| self.objective.of(m, alpha, devices));
        if objective.runs == 0 {
            return Err(TuningError::NoEvent { ttis: self.ttis });
        }
        let information = over(&|m| m.info_p1);
        Ok(Evaluation {
            objective: objective.mean,
            objective_half: objective.half_width,
            information: information.mean,
            information_half: information.half_width,
            misdetection_pct: over(&|m| m.misdetection_pct).mean,
            energy: over(&|m| m.energy_per_device_tti).mean,
            wake_ups: over(&|m| m.wake_ups_per_event).mean,
        })
    }
}

/// The seed of evaluation run `index` of a tuning with `seed`.
pub const fn evaluation_seed(seed: u64, index: u64) -> u64 {
    SEEDS.wrapping_add(seed.wrapping_mul(0x1_0000_0001)).wrapping_add(index)
}

/// `threads` threads.
pub(super) fn pool(threads: usize) -> Result<ThreadPool, TrainingError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(|error| TrainingError::Threads {
        threads,
        reason: error.to_string(),
    })
}

/// Tells of the episodes of a training.
struct Episodes<'a, O>(&'a O);

impl<O: TuningProgress> TrainingProgress for Episodes<'_, O> {
    fn episode(&self, _: &Entry, _: &CurvePoint) {
        self.0.episode();
    }

    fn stop(&self) -> bool {
        self.0.stop()
    }
}
