//! The evaluation of a pair of weights: trains tables with it and measures runs with those tables. All random draws
//! follow from the scenario's seed, and the texts of [`TuningPlan::header`] identify a tuning in its history file.
//! `tuner` calls this for one pair after another.

use std::sync::Arc;

use rayon::ThreadPool;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use reveille_bs::cycle::PreparedRun;
use reveille_bs::policy::q_learning::learned::{CurvePoint, QTrainingConfig, QWeights, TableSet};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::scenario::{PolicyChoice, Scenario};
use reveille_common::digits::count_noun;
use reveille_common::scenario::MAX_TTIS;
use reveille_common::score::Metrics;

use super::error::TuningError;
use super::evaluation::{Evaluation, TuningPoint};
use super::objective::TuningObjective;
use super::ranges::{MIN_DESIGN_PAIRS, Ranges, WeightPair, design};
use crate::run::{Run, RunOptions, StopWhen};
use crate::stats::Estimate;
use crate::training::{self, Trainer, TrainingError, TrainingProgress};

/// An offset to the seeds of evaluation runs, far from the seeds of trainings (`EPISODE_SEED_OFFSET`) and sweeps.
const EVALUATION_SEED_OFFSET: u64 = 0xE7A1_5EED_0000_0000;
/// The largest number of TTIs between two checks whether to stop.
const TTIS_BETWEEN_STOP_CHECKS: u64 = 200;
/// The largest number of evaluation runs of a pair.
const MAX_RUNS: u64 = 10_000;
/// The largest number of pairs before the proposer chooses.
const MAX_DESIGN_PAIRS: usize = 1000;

/// Callbacks of a tuning. All threads call them.
pub trait TuningProgress: Sync {
    /// Reports the start of the evaluation of a pair, the point `number` from 0.
    fn point_started(&self, _number: usize, _weights: WeightPair) {}
    /// Reports the end of an episode of the pair's training.
    fn episode_ended(&self) {}
    /// Reports the end of one of the pair's evaluation runs, which may have been stopped.
    fn run_ended(&self) {}
    /// Reports the end of the evaluation, once its point is in the history.
    fn point_ended(&self, _point: &TuningPoint) {}
    /// Returns whether to stop, which discards the point in progress.
    fn should_stop(&self) -> bool;
}

impl TuningProgress for () {
    fn should_stop(&self) -> bool {
        false
    }
}

/// The parameters of a tuning and of its evaluations. Call [`Self::check`] before any other method.
#[derive(Clone, Debug)]
pub struct TuningPlan {
    /// The scenario for training and measurement. Its weights are tried first; its seed determines all random draws.
    pub scenario: Scenario,
    /// The search ranges of the weights.
    pub ranges: Ranges,
    /// The objective to maximise.
    pub objective: TuningObjective,
    /// The number of pairs before the proposer chooses, ≥ [`MIN_DESIGN_PAIRS`].
    pub design_pairs: usize,
    /// The training parameters, except for the seed, which is the scenario's.
    pub training: QTrainingConfig,
    /// The number of evaluation runs of each pair, ≥ 1.
    pub runs: u64,
    /// The length of an evaluation run, TTIs.
    pub ttis: u64,
}

impl TuningPlan {
    /// Checks every parameter except the ranges, which [`Ranges::new`] checks.
    ///
    /// # Errors
    /// If the policy is not `q-learning`, or a number is out of range.
    pub fn check(&self) -> Result<(), TuningError> {
        // The trainer only serves to check the policy and the training parameters.
        Trainer::new(&self.scenario, &[self.scenario.run.devices], &[], &self.training)?;
        let invalid = |option, value: &dyn std::fmt::Display, requirement: &str| {
            Err(TuningError::Invalid {
                option,
                value: value.to_string(),
                requirement: requirement.to_owned(),
            })
        };
        // The texts below repeat the limits of the constants.
        if !(MIN_DESIGN_PAIRS..=MAX_DESIGN_PAIRS).contains(&self.design_pairs) {
            return invalid("design", &self.design_pairs, "must be from 3 to 1000");
        }
        if !(1..=MAX_RUNS).contains(&self.runs) {
            return invalid("seeds", &self.runs, "must be from 1 to 10000");
        }
        if !(10..=MAX_TTIS).contains(&self.ttis) {
            return invalid("ttis", &self.ttis, "must be from 10 to 1000000000 TTIs");
        }
        let max_ttis = self.scenario.max_ttis();
        for (option, ttis) in [("ttis", self.ttis), ("episode-ttis", self.training.ttis)] {
            if ttis > max_ttis {
                let requirement =
                    format!("must be at most {max_ttis} with this many devices, or sums of energy overflow");
                return invalid(option, &ttis, &requirement);
            }
        }
        if let TuningObjective::Balance {
            energy_weight,
            miss_weight,
        } = self.objective
        {
            for (option, weight) in [("energy-weight", energy_weight), ("miss-weight", miss_weight)] {
                if !(0.0..=1e6).contains(&weight) {
                    return invalid(option, &weight, "must be from 0 to 1000000");
                }
            }
        }
        Ok(())
    }

    fn settings(&self) -> Result<&QLearningSettings, TuningError> {
        let policy = &self.scenario.policy;
        policy
            .settings()
            .downcast_ref()
            .ok_or_else(|| TrainingError::Policy(policy.name().to_owned()).into())
    }

    /// The pairs to try first: the scenario's weights, if the ranges contain them, and pairs drawn from its seed.
    pub fn design(&self) -> Vec<WeightPair> {
        let weights = self.settings().map(|settings| settings.weights);
        let start = weights.map_or([0.0; 2], |weights| [weights.mu1, weights.mu2]);
        design(&self.ranges, start, self.design_pairs, self.scenario.run.seed)
    }

    /// The parameters that identify this tuning, by name. The number of pairs after the design is not one of them. The
    /// figure of a tuning in `study` and `reveille tune` read them by these names, and `History::range` parses the
    /// ranges. After a change of a name or text, older tunings cannot be resumed.
    pub fn header(&self) -> Vec<(String, String)> {
        let Ranges { mu1, mu2 } = self.ranges;
        let QTrainingConfig {
            episodes,
            ttis,
            epsilon,
            ..
        } = &self.training;
        let entries = [
            ("made by", training::MADE_BY.to_owned()),
            ("scenario", self.scenario.hash_hex()),
            ("preset", self.scenario.run.preset.clone()),
            ("ranking", self.scenario.bs.ranking.name().to_owned()),
            ("devices", self.scenario.run.devices.to_string()),
            ("seed", self.scenario.run.seed.to_string()),
            ("objective", format!("{}: {}", self.objective.name(), self.objective)),
            ("mu1", format!("{} to {}", mu1.0, mu1.1)),
            ("mu2", format!("{} to {}", mu2.0, mu2.1)),
            ("design", format!("{} pairs", self.design_pairs)),
            (
                "training",
                format!(
                    "{} of {}, epsilon {} to {}",
                    count_noun(*episodes, "episode"),
                    count_noun(*ttis, "TTI"),
                    epsilon.0,
                    epsilon.1
                ),
            ),
            (
                "evaluation",
                format!("{} of {}", count_noun(self.runs, "run"), count_noun(self.ttis, "TTI")),
            ),
        ];
        entries.map(|(name, value)| (name.to_owned(), value)).to_vec()
    }

    /// Evaluates `weights` on the threads of `pool`. Returns `None` if the observer has stopped it.
    ///
    /// # Errors
    /// If the tables cannot be trained, or there was no event.
    pub fn evaluate(
        &self,
        weights: WeightPair,
        pool: &ThreadPool,
        observer: &impl TuningProgress,
    ) -> Result<Option<Evaluation>, TuningError> {
        let Some(scenario) = self.train_scenario(weights, observer)? else {
            return Ok(None);
        };
        let evaluate_run = |index: u64| {
            let scenario = scenario.with_seed(evaluation_seed(self.scenario.run.seed, index));
            let options = RunOptions {
                window: TTIS_BETWEEN_STOP_CHECKS,
                ..RunOptions::default()
            };
            let outcome = Run::new(&PreparedRun::without_pilots(&scenario), options)
                .finish(&mut StopWhen(|| observer.should_stop()));
            observer.run_ended();
            outcome.is_complete.then_some(outcome.metrics)
        };
        // Collected by index, so that means are summed in the same order on any number of threads.
        let metrics: Option<Vec<Metrics>> = pool.install(|| (0..self.runs).into_par_iter().map(evaluate_run).collect());
        metrics.map(|metrics| self.average(&metrics)).transpose()
    }

    /// Returns the scenario of the evaluation runs, except their seeds, with tables trained with `weights`. Returns
    /// `None` if the observer has stopped the training.
    fn train_scenario(
        &self,
        weights: WeightPair,
        observer: &impl TuningProgress,
    ) -> Result<Option<Scenario>, TuningError> {
        let settings = self.settings()?;
        let [mu1, mu2] = weights;
        let settings = QLearningSettings {
            weights: QWeights {
                mu1,
                mu2,
                ..settings.weights
            },
            ..settings.clone()
        };
        let scenario_with = |settings: QLearningSettings| Scenario {
            policy: PolicyChoice::new(self.scenario.policy.kind(), Arc::new(settings)),
            ..self.scenario.clone()
        };
        let mut trainer = Trainer::new(
            &scenario_with(settings.clone()),
            &[self.scenario.run.devices],
            &[],
            &self.training,
        )?;
        // One look-back and one N make one entry, whose episodes run in order: more threads would idle.
        if !trainer.train(1, &|_| Ok(()), &EpisodeForwarder(observer))? {
            return Ok(None);
        }
        let entry = trainer.learned().entries.swap_remove(0);
        let settings = QLearningSettings {
            learn: false,
            epsilon: (0.0, 0.0),
            initial_tables: Arc::new(entry),
            ..settings
        };
        let mut evaluation_scenario = scenario_with(settings);
        evaluation_scenario.run.ttis = self.ttis;
        Ok(Some(evaluation_scenario))
    }

    /// Returns the means over the evaluation runs with these `metrics`.
    fn average(&self, metrics: &[Metrics]) -> Result<Evaluation, TuningError> {
        let (alpha, devices) = (self.scenario.events.alpha, self.scenario.run.devices);
        let estimate = |value_of: &dyn Fn(&Metrics) -> f64| Estimate::from_values_or_nan(metrics.iter().map(value_of));
        let objective = estimate(&|m| self.objective.value_of(m, alpha, devices));
        if objective.runs == 0 {
            return Err(TuningError::NoEvent { ttis: self.ttis });
        }
        let information = estimate(&|m| m.info_p1);
        Ok(Evaluation {
            objective: objective.mean,
            objective_half_width: objective.half_width,
            information: information.mean,
            information_half_width: information.half_width,
            misdetection_pct: estimate(&|m| m.misdetection_pct).mean,
            energy: estimate(&|m| m.energy_per_device_tti).mean,
            wake_ups: estimate(&|m| m.wake_ups_per_event).mean,
        })
    }
}

/// Returns the seed of evaluation run `index` of a tuning with `seed`. A test compares it with the seeds of trainings.
pub(crate) const fn evaluation_seed(seed: u64, index: u64) -> u64 {
    EVALUATION_SEED_OFFSET
        .wrapping_add(seed.wrapping_mul(0x1_0000_0001))
        .wrapping_add(index)
}

/// Creates a pool of `threads` threads; 0 means one for each core.
pub(super) fn new_pool(threads: usize) -> Result<ThreadPool, TrainingError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(|error| TrainingError::Threads {
        threads,
        reason: error.to_string(),
    })
}

/// Forwards the episodes of a training.
struct EpisodeForwarder<'a, O>(&'a O);

impl<O: TuningProgress> TrainingProgress for EpisodeForwarder<'_, O> {
    fn episode_ended(&self, _: &TableSet, _: &CurvePoint) {
        self.0.episode_ended();
    }

    fn should_stop(&self) -> bool {
        self.0.should_stop()
    }
}
