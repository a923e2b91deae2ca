//! Environments that step together, on threads of their own, and write what they show into memory of the caller's.

use rayon::iter::{IndexedParallelIterator, IntoParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use reveille_bs::policy::external::{DEVICE, GLOBAL, Stage};
use reveille_common::scenario::Scenario;

use super::environment::{Environment, Ground, Step, Weights};

/// Where the environments of a batch write what they show, one after the other.
#[derive(Debug)]
pub struct Views<'a> {
    /// [`DEVICE`], `[K, N, F]`.
    pub devices: &'a mut [f32],
    /// [`GLOBAL`], `[K, G]`.
    pub global: &'a mut [f32],
    /// 0 or 1, `[K]`.
    pub stage: &'a mut [i64],
    /// What can be answered, 2 for either and 0 for 0 alone, `[K, N]`.
    pub mask: &'a mut [i8],
    /// The reward of the last step, `[K]`.
    pub reward: &'a mut [f64],
    /// Its parts as in [`Step`], `[K, 4]`.
    pub parts: &'a mut [f64],
    /// TTIs that are closed, `[K]`.
    pub ttis: &'a mut [i64],
    /// Whether the run is at its end, `[K]`.
    pub ended: &'a mut [bool],
}

/// The parts of a reward.
pub const PARTS: usize = 4;

/// Where one environment writes.
#[derive(Debug)]
struct Place<'a> {
    devices: &'a mut [f32],
    global: &'a mut [f32],
    stage: &'a mut i64,
    mask: &'a mut [i8],
    reward: &'a mut f64,
    parts: &'a mut [f64],
    ttis: &'a mut i64,
    ended: &'a mut bool,
}

impl<'a> Views<'a> {
    /// The place of each of the environments, which have `n` devices.
    fn places(self, n: usize) -> Vec<Place<'a>> {
        let rows = self.devices.chunks_exact_mut(n * DEVICE.len());
        let rows = rows.zip(self.global.chunks_exact_mut(GLOBAL.len()));
        let rows = rows.zip(self.mask.chunks_exact_mut(n)).zip(self.stage);
        let results = self.reward.iter_mut().zip(self.parts.chunks_exact_mut(PARTS));
        let results = results.zip(self.ttis).zip(self.ended);
        let place = |((((devices, global), mask), stage), (((reward, parts), ttis), ended))| Place {
            devices,
            global,
            stage,
            mask,
            reward,
            parts,
            ttis,
            ended,
        };
        rows.zip(results).map(place).collect()
    }
}

impl Place<'_> {
    fn show(&mut self, environment: &Environment, step: Step) {
        let Step {
            asleep,
            missed,
            information,
            woken,
        } = step;
        *self.reward = step.reward();
        self.parts.copy_from_slice(&[asleep, missed, information, woken]);
        *self.ttis = environment.ttis_done().cast_signed();
        *self.ended = environment.question().is_none();
        let question = environment.view();
        question.write_devices(self.devices);
        question.write_global(self.global);
        question.write_mask(self.mask);
        *self.stage = i64::from(question.stage == Stage::Wake);
    }
}

/// Environments of equally many devices.
pub struct Batch {
    environments: Vec<Environment>,
    devices: usize,
    weights: Weights,
    /// None for the caller's thread.
    pool: Option<ThreadPool>,
}

impl Batch {
    /// Environments of these `scenarios`, at least one, with equally many devices each, on `threads` threads, or as
    /// many as there are environments if that is fewer.
    ///
    /// # Errors
    /// There are no such threads to be had.
    ///
    /// # Panics
    /// If there is none, or the numbers of devices differ.
    pub fn new(scenarios: &[Scenario], weights: Weights, threads: usize) -> Result<Self, ThreadPoolBuildError> {
        let devices = scenarios.first().expect("at least one environment").devices as usize;
        assert!(scenarios.iter().all(|scenario| scenario.devices as usize == devices));
        let threads = threads.min(scenarios.len());
        let pool = (threads > 1).then(|| ThreadPoolBuilder::new().num_threads(threads).build());
        let pool = pool.transpose()?;
        let make = |scenario: &Scenario| Environment::new(Ground::new(scenario), weights);
        Ok(Self {
            environments: scenarios.iter().map(make).collect(),
            devices,
            weights,
            pool,
        })
    }

    /// Number of environments K.
    pub const fn len(&self) -> usize {
        self.environments.len()
    }

    /// Whether there is none; there is always one.
    pub const fn is_empty(&self) -> bool {
        self.environments.is_empty()
    }

    /// Number of devices N of each.
    pub const fn devices(&self) -> usize {
        self.devices
    }

    /// The environments.
    pub fn environments(&self) -> &[Environment] {
        &self.environments
    }

    /// Puts `environment` in the place of another.
    ///
    /// # Panics
    /// If it has another number of devices, or there is no such place.
    pub fn put(&mut self, at: usize, environment: Environment) {
        assert_eq!(environment.ground().scenario().devices as usize, self.devices);
        self.environments[at] = environment;
    }

    /// Begins again where there is a scenario.
    ///
    /// # Panics
    /// If one has another number of devices.
    pub fn reset(&mut self, scenarios: Vec<Option<Scenario>>) {
        assert_eq!(scenarios.len(), self.environments.len());
        let weights = self.weights;
        let begin = |(environment, scenario): (&mut Environment, Option<Scenario>)| {
            if let Some(scenario) = scenario {
                *environment = Environment::new(Ground::new(&scenario), weights);
            }
        };
        let Self { environments, pool, .. } = self;
        match pool {
            None => environments.iter_mut().zip(scenarios).for_each(begin),
            Some(pool) => pool.install(|| environments.par_iter_mut().zip(scenarios).for_each(begin)),
        }
    }

    /// A step of each environment with its row of `actions`, `[K, N]`, 0 or not 0; where it `rests`, `[K]`, none. Then
    /// all of them are shown.
    ///
    /// # Panics
    /// If a slice is of another length.
    pub fn step(&mut self, actions: &[i8], rests: &[bool], views: Views<'_>) {
        let n = self.devices;
        let places = views.places(n);
        let all = self.environments.len();
        assert_eq!((actions.len(), rests.len(), places.len()), (all * n, all, all));
        let step = |at: usize, environment: &mut Environment, mut place: Place<'_>| {
            let action = &actions[at * n..][..n];
            let step = if rests[at] {
                Step::default()
            } else {
                environment.step(|j| action[j] != 0)
            };
            place.show(environment, step);
        };
        match &self.pool {
            None => {
                let each = self.environments.iter_mut().zip(places).enumerate();
                each.for_each(|(at, (environment, place))| step(at, environment, place));
            }
            Some(pool) => pool.install(|| {
                let each = self.environments.par_iter_mut().zip(places.into_par_iter()).enumerate();
                each.for_each(|(at, (environment, place))| step(at, environment, place));
            }),
        }
    }

    /// Shows all environments without a step.
    ///
    /// # Panics
    /// If a slice is of another length.
    pub fn show(&mut self, views: Views<'_>) {
        let all = self.environments.len();
        self.step(&vec![0; all * self.devices], &vec![true; all], views);
    }
}
