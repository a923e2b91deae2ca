//! Environments that step together on separate threads and write their observations into the caller's memory, the NumPy
//! arrays of the Python package (`python/src/batch.rs`). Results do not depend on the number of threads. `PARTS` in
//! `python/reveille/environment.py` names the reward terms of [`BatchBuffers::reward_terms`] in the same order; change
//! both. Shapes, codes and orders here are part of the package's interface.

use rayon::iter::{IndexedParallelIterator, IntoParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use reveille_bs::policy::external::{DEVICE_FEATURES, DecisionStage, GLOBAL_FEATURES};
use reveille_bs::scenario::Scenario;

use super::environment::{Environment, EpisodeTemplate, RewardTerms, RewardWeights};

/// The output buffers of a batch of K environments with N devices, one environment after another. F and G are the
/// numbers of features of a device and of the network.
#[derive(Debug)]
pub struct BatchBuffers<'a> {
    /// The features [`DEVICE_FEATURES`], `[K, N, F]`.
    pub device_features: &'a mut [f32],
    /// The features [`GLOBAL_FEATURES`], `[K, G]`.
    pub global_features: &'a mut [f32],
    /// The stage, `[K]`: 0 for a plan, 1 for wake-ups.
    pub stage: &'a mut [i64],
    /// The action mask: 2 if both values are allowed, 0 if only 0 is, `[K, N]`. These are the codes of a mask of
    /// Gymnasium's `MultiBinary` space.
    pub mask: &'a mut [i8],
    /// The reward of the last step, `[K]`.
    pub reward: &'a mut [f64],
    /// The terms of the reward, `[K, 4]`, in the order of the fields of [`RewardTerms`].
    pub reward_terms: &'a mut [f64],
    /// The number of closed TTIs, `[K]`.
    pub ttis: &'a mut [i64],
    /// Whether the run has ended, `[K]`.
    pub ended: &'a mut [bool],
}

/// The number of terms of a reward.
pub const REWARD_TERMS: usize = 4;

/// The part of the [`BatchBuffers`] of one environment.
#[derive(Debug)]
struct EnvBuffers<'a> {
    device_features: &'a mut [f32],
    global_features: &'a mut [f32],
    stage: &'a mut i64,
    mask: &'a mut [i8],
    reward: &'a mut f64,
    reward_terms: &'a mut [f64],
    ttis: &'a mut i64,
    ended: &'a mut bool,
}

impl<'a> BatchBuffers<'a> {
    /// Splits the buffers by environment, each with `n` devices. A buffer that is too short yields fewer parts.
    fn split(self, n: usize) -> Vec<EnvBuffers<'a>> {
        // The slices are disjoint, so threads write without a lock.
        let observations = self.device_features.chunks_exact_mut(n * DEVICE_FEATURES.len());
        let observations = observations.zip(self.global_features.chunks_exact_mut(GLOBAL_FEATURES.len()));
        let observations = observations.zip(self.mask.chunks_exact_mut(n)).zip(self.stage);
        let results = self
            .reward
            .iter_mut()
            .zip(self.reward_terms.chunks_exact_mut(REWARD_TERMS));
        let results = results.zip(self.ttis).zip(self.ended);
        let env_buffers =
            |((((device_features, global_features), mask), stage), (((reward, reward_terms), ttis), ended))| {
                EnvBuffers {
                    device_features,
                    global_features,
                    stage,
                    mask,
                    reward,
                    reward_terms,
                    ttis,
                    ended,
                }
            };
        observations.zip(results).map(env_buffers).collect()
    }
}

impl EnvBuffers<'_> {
    fn write(&mut self, environment: &Environment, terms: RewardTerms) {
        let RewardTerms {
            asleep,
            missed,
            information,
            woken,
        } = terms;
        *self.reward = terms.reward();
        self.reward_terms.copy_from_slice(&[asleep, missed, information, woken]);
        *self.ttis = environment.ttis_done().cast_signed();
        *self.ended = environment.pending_decision().is_none();
        // After the end of a run, the context of the decision that would follow.
        let request = environment.decision_context();
        request.write_devices(self.device_features);
        request.write_globals(self.global_features);
        request.write_mask(self.mask);
        *self.stage = i64::from(request.stage == DecisionStage::Wake);
    }
}

/// Environments with equal numbers of devices.
pub struct EnvBatch {
    environments: Vec<Environment>,
    device_count: usize,
    weights: RewardWeights,
    /// The thread pool; `None` to run on the caller's thread.
    pool: Option<ThreadPool>,
}

impl EnvBatch {
    /// Creates one environment for each of `scenarios`, on `threads` threads or one per environment, whichever is
    /// fewer.
    ///
    /// # Errors
    /// If the threads cannot be started.
    ///
    /// # Panics
    /// If `scenarios` is empty, the numbers of devices differ, or a policy is not `external`.
    pub fn new(scenarios: &[Scenario], weights: RewardWeights, threads: usize) -> Result<Self, ThreadPoolBuildError> {
        let device_count = scenarios.first().expect("at least one environment").run.devices as usize;
        assert!(
            scenarios
                .iter()
                .all(|scenario| scenario.run.devices as usize == device_count)
        );
        let threads = threads.min(scenarios.len());
        // A pool of one thread would only add a thread switch to each step.
        let pool = (threads > 1).then(|| ThreadPoolBuilder::new().num_threads(threads).build());
        let pool = pool.transpose()?;
        let new_environment = |scenario: &Scenario| Environment::new(EpisodeTemplate::new(scenario), weights);
        Ok(Self {
            environments: scenarios.iter().map(new_environment).collect(),
            device_count,
            weights,
            pool,
        })
    }

    /// The number of environments K.
    pub const fn len(&self) -> usize {
        self.environments.len()
    }

    /// Whether the batch is empty; always `false`.
    pub const fn is_empty(&self) -> bool {
        self.environments.is_empty()
    }

    /// The number of devices N of each environment.
    pub const fn device_count(&self) -> usize {
        self.device_count
    }

    /// The environments.
    pub fn environments(&self) -> &[Environment] {
        &self.environments
    }

    /// Replaces the environment with this `index`.
    ///
    /// # Panics
    /// If the new one has another number of devices, or `index` is out of range.
    pub fn replace(&mut self, index: usize, environment: Environment) {
        assert_eq!(
            environment.template().scenario().run.devices as usize,
            self.device_count
        );
        self.environments[index] = environment;
    }

    /// Restarts each environment that has a scenario in `scenarios`, `[K]`. The caller keeps the number of devices.
    ///
    /// # Panics
    /// If `scenarios` has another length, or a policy is not `external`.
    pub fn reset(&mut self, scenarios: Vec<Option<Scenario>>) {
        assert_eq!(scenarios.len(), self.environments.len());
        let weights = self.weights;
        let restart = |(environment, scenario): (&mut Environment, Option<Scenario>)| {
            if let Some(scenario) = scenario {
                *environment = Environment::new(EpisodeTemplate::new(&scenario), weights);
            }
        };
        let Self { environments, pool, .. } = self;
        match pool {
            None => environments.iter_mut().zip(scenarios).for_each(restart),
            Some(pool) => pool.install(|| environments.par_iter_mut().zip(scenarios).for_each(restart)),
        }
    }

    /// Takes a step in each environment with its row of `actions`, `[K, N]`, 0 or not 0. Environments with
    /// `is_resting`, `[K]`, take no step. Then writes the observations of all environments.
    ///
    /// # Panics
    /// If `actions` or `is_resting` has another length, or an output buffer is too short.
    pub fn step(&mut self, actions: &[i8], is_resting: &[bool], buffers: BatchBuffers<'_>) {
        let n = self.device_count;
        let env_buffers = buffers.split(n);
        let k = self.environments.len();
        // `chunks_exact_mut` and `zip` silently drop a remainder, so a short slice would skip environments.
        assert_eq!((actions.len(), is_resting.len(), env_buffers.len()), (k * n, k, k));
        let step_one = |index: usize, environment: &mut Environment, mut buffers: EnvBuffers<'_>| {
            let action = &actions[index * n..][..n];
            let terms = if is_resting[index] {
                RewardTerms::default()
            } else {
                environment.step(|j| action[j] != 0)
            };
            buffers.write(environment, terms);
        };
        match &self.pool {
            None => {
                let environments = self.environments.iter_mut().zip(env_buffers).enumerate();
                environments.for_each(|(index, (environment, buffers))| step_one(index, environment, buffers));
            }
            Some(pool) => pool.install(|| {
                let environments = self
                    .environments
                    .par_iter_mut()
                    .zip(env_buffers.into_par_iter())
                    .enumerate();
                environments.for_each(|(index, (environment, buffers))| step_one(index, environment, buffers));
            }),
        }
    }

    /// Writes the observations of all environments without a step; rewards are 0.
    ///
    /// # Panics
    /// If an output buffer is too short.
    pub fn write_observations(&mut self, buffers: BatchBuffers<'_>) {
        let k = self.environments.len();
        self.step(&vec![0; k * self.device_count], &vec![true; k], buffers);
    }
}
