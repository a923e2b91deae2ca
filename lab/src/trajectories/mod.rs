//! Trajectories: the knowledge, actions and gains of a base station, TTI by TTI, under any policy. They are the
//! training data of the decision transformer.
//!
//! A run is recorded in chunks of consecutive TTIs, far enough apart to differ. Chunks only hold data that a base
//! station can know. `reveille train record` writes them, `transformer` trains from them, and the figure `attention` of
//! `study` reads the steps of a run. The number of a run and the position of its file decide whether `transformer`
//! holds it out. The trajectories of the Python package are something else: steps of an environment.

mod io;
mod parquet;

use std::sync::{Arc, Mutex, PoisonError};

use rayon::iter::{IntoParallelIterator, ParallelIterator};
use reveille_bs::base_station::BaseStation;
use reveille_bs::cycle::{Cycle, PreparedRun};
use reveille_bs::policy::age_index::AgeIndexSettings;
use reveille_bs::policy::dt::record::{RecordingOptions, RecordingPolicy, TrajectoryStep};
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::Tti;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::score::Digest;
use reveille_common::units::Energy;
use reveille_common::world::World;

use crate::preparation::RunPreparer;
use crate::run::{Run, RunOptions, StopWhen};
use crate::sweep::SweepGrid;

pub use parquet::TrajectoryError;

/// The number of TTIs over which a return is the mean. It defines a stored column: a change raises `VERSION` in
/// `parquet`, and recordings and trained models must be made again.
pub const HORIZON: usize = 20;

/// The parameters of a recording. Their `Debug` text is in the metadata of files and identifies trainings: after a
/// rename, no training from a new file resumes an older one.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordingConfig {
    /// The number of TTIs in a chunk, ≥ 1.
    pub length: usize,
    /// The number of TTIs from one chunk's start to the next, > `length`: chunks without a gap would be one chunk.
    pub stride: usize,
    /// The probabilities, `[0, 1)`, that a device deviates from its policy, at least one; runs use them in turn.
    /// [`record_from_scenario`] ignores them.
    pub explore: Vec<f64>,
    /// See [`RecordingOptions::true_batteries`].
    pub true_batteries: bool,
}

impl RecordingConfig {
    /// Returns the options for a run in which a device deviates with probability `exploration`.
    const fn run_options(&self, exploration: f64) -> RecordingOptions {
        RecordingOptions {
            exploration,
            true_batteries: self.true_batteries,
        }
    }
}

/// Consecutive TTIs of one run, [`RecordingConfig::length`] of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Chunk {
    /// The index of the run, from 0 over all cells and seeds.
    pub run: u32,
    /// The recorded policy.
    pub policy: Arc<str>,
    /// The price θ of the policy, if it has a fixed one.
    pub price: Option<f32>,
    /// The number of devices N.
    pub devices: usize,
    /// The TTIs, in order.
    pub steps: Vec<TrajectoryStep>,
    /// The returns by TTI: the mean of [`TrajectoryStep::covered_share`] over the next [`HORIZON`] TTIs, the current
    /// one included.
    pub returns: Vec<f32>,
}

impl Chunk {
    /// The number of devices times the number of TTIs.
    pub const fn device_ttis(&self) -> usize {
        self.devices * self.steps.len()
    }
}

/// The recorded data of several runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectories {
    /// The origin of the data as key and value, for the metadata of files.
    pub about: Vec<(String, String)>,
    /// The chunks, by run and TTI.
    pub chunks: Vec<Chunk>,
}

/// Records every run of `grid`, from random battery levels, on the threads of the current pool. Calls `on_run_end`
/// after each run. Returns `None` if `stop` returns true. It ignores `until_ci` and the actions of the experiment;
/// `reveille train record` therefore refuses both.
///
/// # Panics
/// If [`RecordingConfig::explore`] is empty or [`RecordingConfig::stride`] is 0; `reveille train record` checks both.
pub fn record(
    grid: &SweepGrid,
    recording: &RecordingConfig,
    stop: &(dyn Fn() -> bool + Sync),
    on_run_end: &(dyn Fn() + Sync),
) -> Option<Trajectories> {
    let seeds = grid.experiment.seeds;
    let runs: Vec<(usize, u64)> = (0..grid.cells.len())
        .flat_map(|cell| (0..seeds.count).map(move |index| (cell, index)))
        .collect();
    let preparer = RunPreparer::default();
    let record_cell_run = |(cell, index): (usize, u64)| {
        let run_number = cell as u64 * seeds.count + index;
        let exploration = recording.explore[(run_number % recording.explore.len() as u64) as usize];
        let scenario = grid.cells[cell].with_seed(seeds.first + index);
        // The cast holds: a sweep has at most 100 000 000 runs.
        let chunks = record_run(&preparer, &scenario, run_number as u32, recording, exploration, stop);
        on_run_end();
        chunks
    };
    // `None` from one run ends the iteration, so the remaining runs are not even prepared.
    let chunks: Option<Vec<Vec<Chunk>>> = runs.into_par_iter().map(record_cell_run).collect();
    let about = vec![
        ("experiment".to_owned(), grid.experiment.to_toml()),
        ("scenarios".to_owned(), grid.fingerprint().to_string()),
        ("seeds".to_owned(), format!("{} {}", seeds.first, seeds.count)),
        ("recording".to_owned(), format!("{recording:?}")),
    ];
    Some(Trajectories {
        about,
        chunks: chunks?.concat(),
    })
}

/// Records a run of the emulator by repeating it in memory from its `scenario`, as the run `run_number` of a file. Also
/// returns the digest, which equals the original run's if that run had no external inputs and
/// [`RecordingConfig::true_batteries`] is off. The digest is `None`, and there are no chunks, for the genie, which uses
/// knowledge that no base station has. Returns `None` if `stop` returns true.
pub fn record_from_scenario(
    scenario: &Scenario,
    run_number: u32,
    recording: &RecordingConfig,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, Vec<Chunk>)> {
    // No device deviates: the recorded run must make the decisions of the original run.
    let prepared = RunPreparer::default().prepare(scenario);
    record_prepared(&prepared, run_number, recording, 0.0, stop)
}

/// Returns the chunks of a run of `scenario` from random batteries.
fn record_run(
    preparer: &RunPreparer,
    scenario: &Scenario,
    run_number: u32,
    recording: &RecordingConfig,
    exploration: f64,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<Vec<Chunk>> {
    let mut prepared = preparer.prepare(scenario);
    let mut stream = Stream::new(scenario.run.seed, Purpose::Training, 0);
    for device in &mut prepared.deployment.devices {
        device.energy.initial = Energy::from_micro((stream.unit() * device.energy.e_max.micro() as f64) as u64);
    }
    record_prepared(&prepared, run_number, recording, exploration, stop).map(|(_, chunks)| chunks)
}

/// Runs `prepared` and returns its digest and chunks.
fn record_prepared(
    prepared: &PreparedRun,
    run_number: u32,
    recording: &RecordingConfig,
    exploration: f64,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, Vec<Chunk>)> {
    let (length, stride) = (recording.length, recording.stride);
    let add_step = move |(shares, steps): &mut (Vec<f32>, Vec<TrajectoryStep>), step: TrajectoryStep| {
        shares.push(step.covered_share);
        // TTI 0 starts a chunk: a policy starts there without history, so the model must learn these TTIs too.
        if (step.tti.0 as usize) % stride < length {
            steps.push(step);
        }
    };
    let (digest, (shares, steps)) = collect_steps(prepared, recording.run_options(exploration), add_step, stop)?;
    Some((digest, build_chunks(prepared, run_number, recording, &shares, steps)))
}

/// Records the TTIs `first` to `last` of a run of `scenario`. Returns fewer steps if the run ends earlier, and none for
/// the genie, which uses knowledge that no base station has.
pub fn record_steps(scenario: &Scenario, first: Tti, last: Tti) -> Vec<TrajectoryStep> {
    // A step is complete when the next TTI begins, so one more TTI is run.
    let mut scenario = scenario.clone();
    scenario.run.ttis = scenario.run.ttis.min(last.0 + 2);
    let prepared = RunPreparer::default().prepare(&scenario);
    let add_step = move |steps: &mut Vec<TrajectoryStep>, step: TrajectoryStep| {
        if (first..=last).contains(&step.tti) {
            steps.push(step);
        }
    };
    let collected = collect_steps(&prepared, RecordingOptions::default(), add_step, &|| false);
    collected.map_or_else(Vec::new, |(_, steps)| steps)
}

/// Runs `prepared` and collects its steps in order with `add_step`. Also returns the digest, which is `None` for the
/// genie. Returns `None` if `stop` returns true.
fn collect_steps<T: Default + Send + 'static>(
    prepared: &PreparedRun,
    options: RecordingOptions,
    add_step: impl Fn(&mut T, TrajectoryStep) + Send + 'static,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, T)> {
    let collected = Arc::new(Mutex::new(T::default()));
    let sink = {
        let collected = Arc::clone(&collected);
        move |step: TrajectoryStep| add_step(&mut collected.lock().unwrap_or_else(PoisonError::into_inner), step)
    };
    let known = prepared.knowledge();
    let mut policy = prepared.policy(&known);
    // Data for a base station must not come from a policy that knows the ground truth.
    if policy.oracle().is_some() {
        return Some((None, T::default()));
    }
    let recording_policy = Box::new(RecordingPolicy::new(policy, &known, options, sink));
    let world = World::new(&prepared.scenario, &prepared.deployment);
    let cycle = Cycle::with_station(prepared, world, BaseStation::new(known, recording_policy));
    let options = RunOptions {
        // A run stops at the end of a window; the length of windows changes no outcome.
        window: 200,
        ..RunOptions::default()
    };
    let outcome = Run::with_cycle(prepared, cycle, options).finish(&mut StopWhen(stop));
    let collected = std::mem::take(&mut *collected.lock().unwrap_or_else(PoisonError::into_inner));
    outcome.is_complete.then_some((Some(outcome.digest), collected))
}

/// Builds the chunks of a run from their `steps`. `shares` are the covered shares of all TTIs, from TTI 0.
fn build_chunks(
    prepared: &PreparedRun,
    run_number: u32,
    recording: &RecordingConfig,
    shares: &[f32],
    steps: Vec<TrajectoryStep>,
) -> Vec<Chunk> {
    let policy = &prepared.scenario.policy;
    let settings = policy.settings();
    let price = settings
        .downcast_ref::<AgeIndexSettings>()
        .map(|settings| settings.price)
        .or_else(|| settings.downcast_ref::<DtSettings>().and_then(DtSettings::fixed_price));
    let name: Arc<str> = policy.name().into();
    let mut chunks: Vec<Chunk> = Vec::new();
    for step in steps {
        let k = step.tti.0 as usize;
        // The last TTIs of a run have too few TTIs after them for a return.
        let Some(next_shares) = shares.get(k..k + HORIZON) else {
            break;
        };
        // Summed in the order of TTIs, so that the mean is equal on every machine.
        let mean_share = next_shares.iter().sum::<f32>() / HORIZON as f32;
        if k.is_multiple_of(recording.stride) {
            chunks.push(Chunk {
                run: run_number,
                policy: Arc::clone(&name),
                price: price.map(|price| price as f32),
                devices: prepared.deployment.devices.len(),
                steps: Vec::with_capacity(recording.length),
                returns: Vec::with_capacity(recording.length),
            });
        }
        let chunk = chunks.last_mut().expect("a run begins with a chunk");
        chunk.steps.push(step);
        chunk.returns.push(mean_share);
    }
    // The end of the run can cut the last chunk short; a batch holds chunks of one length only.
    chunks.retain(|chunk| chunk.steps.len() == recording.length);
    chunks
}

#[cfg(test)]
mod tests;
