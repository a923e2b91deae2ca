//! Trajectories: what a base station knew, did and gained, TTI by TTI, under any policy; what the decision transformer
//! is trained from.
//!
//! A run is recorded in chunks of consecutive TTIs, far enough from each other to differ. Nothing is in them that a
//! base station could not know.

mod io;
mod parquet;

use std::sync::{Arc, Mutex, PoisonError};

use rayon::iter::{IntoParallelIterator, ParallelIterator};
use reveille_bs::cycle::Cycle;
use reveille_bs::policy::age_index::settings::AgeIndexSettings;
use reveille_bs::policy::dt::record::{Manner, Recorded, Step};
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::policy::mind::Mind;
use reveille_bs::prepared::Prepared;
use reveille_bs::station::Station;
use reveille_common::ids::Tti;
use reveille_common::rng::{Purpose, Stream};
use reveille_common::scenario::Scenario;
use reveille_common::score::Digest;
use reveille_common::units::Energy;
use reveille_common::world::World;

use crate::preparation::Workshop;
use crate::run::{Options, Run, StopWhen};
use crate::sweep::Grid;

pub use io::{read, write};
pub use parquet::TrajectoryError;

/// TTIs over which a return is the mean.
pub const HORIZON: usize = 20;

/// How runs are recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// TTIs of a chunk, ≥ 1.
    pub length: usize,
    /// TTIs from the start of one chunk to the start of the next, > `length`: what follows without a gap is one chunk.
    pub stride: usize,
    /// Probabilities, `[0, 1)`, with which a device does not do what its policy says; runs take them in turn.
    pub explore: Vec<f64>,
    /// See [`Manner::told`].
    pub told: bool,
}

impl Recording {
    /// How a run is recorded in which a device does otherwise with probability `explores`.
    const fn manner(&self, explores: f64) -> Manner {
        Manner {
            explores,
            told: self.told,
        }
    }
}

/// Consecutive TTIs of one run.
#[derive(Clone, Debug, PartialEq)]
pub struct Chunk {
    /// The run, counted from 0 over all cells and seeds.
    pub run: u32,
    /// The policy that was recorded.
    pub policy: Arc<str>,
    /// The price θ that it chose by, where it has one.
    pub price: Option<f32>,
    /// Number of devices N.
    pub devices: usize,
    /// The TTIs, one after the other.
    pub steps: Vec<Step>,
    /// By TTI, the mean of [`Step::share`] over the [`HORIZON`] TTIs from it on: the return.
    pub returns: Vec<f32>,
}

impl Chunk {
    /// Devices times TTIs.
    pub const fn device_ttis(&self) -> usize {
        self.devices * self.steps.len()
    }
}

/// What was recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectories {
    /// Where it comes from: key and value, for the metadata of files.
    pub about: Vec<(String, String)>,
    /// By run and TTI.
    pub chunks: Vec<Chunk>,
}

/// Records every run of `grid`, on the threads of the pool that this is called in. `None` if `stop` has said so.
/// `ended` hears of each run.
pub fn record(
    grid: &Grid,
    recording: &Recording,
    stop: &(dyn Fn() -> bool + Sync),
    ended: &(dyn Fn() + Sync),
) -> Option<Trajectories> {
    let seeds = grid.experiment.seeds;
    let runs: Vec<(usize, u64)> = (0..grid.cells.len())
        .flat_map(|cell| (0..seeds.count).map(move |index| (cell, index)))
        .collect();
    let workshop = Workshop::default();
    let one = |(cell, index): (usize, u64)| {
        let run = cell as u64 * seeds.count + index;
        let explores = recording.explore[(run % recording.explore.len() as u64) as usize];
        let scenario = grid.cells[cell].with_seed(seeds.first + index);
        let chunks = record_run(&workshop, &scenario, run as u32, recording, explores, stop);
        ended();
        chunks
    };
    // The first run that is stopped ends it: those that are left are not even set up.
    let chunks: Option<Vec<Vec<Chunk>>> = runs.into_par_iter().map(one).collect();
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

/// Records a run of the emulator: what it did follows from its `scenario`, so it is done again in memory. Gives the
/// digest of the run that is recorded, which is that of the run before if nothing was changed; none for the genie,
/// which decides by what no base station knows. `None` if `stop` has said so.
pub fn record_again(
    scenario: &Scenario,
    run: u32,
    recording: &Recording,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, Vec<Chunk>)> {
    record_prepared(&Workshop::default().prepare(scenario), run, recording, 0.0, stop)
}

/// The chunks of a run of `scenario` from random batteries.
fn record_run(
    workshop: &Workshop,
    scenario: &Scenario,
    run: u32,
    recording: &Recording,
    explores: f64,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<Vec<Chunk>> {
    let mut prepared = workshop.prepare(scenario);
    let mut stream = Stream::new(scenario.seed, Purpose::Training, 0);
    for device in &mut prepared.deployment.devices {
        device.energy.initial = Energy::from_micro((stream.unit() * device.energy.e_max.micro() as f64) as u64);
    }
    record_prepared(&prepared, run, recording, explores, stop).map(|(_, chunks)| chunks)
}

fn record_prepared(
    prepared: &Prepared,
    run: u32,
    recording: &Recording,
    explores: f64,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, Vec<Chunk>)> {
    let (length, stride) = (recording.length, recording.stride);
    let take = move |(shares, kept): &mut (Vec<f32>, Vec<Step>), step: Step| {
        shares.push(step.share);
        // The first TTIs of a run are like no others, and a policy begins in them: they are kept as well.
        if (step.tti.0 as usize) % stride < length {
            kept.push(step);
        }
    };
    let (digest, (shares, kept)) = watched(prepared, recording.manner(explores), take, stop)?;
    Some((digest, chunks(prepared, run, recording, &shares, kept)))
}

/// The TTIs `from` to `last` of a run of `scenario`, as they are recorded. Nothing if its policy is the genie, which
/// decides by what no base station knows, or if the run ends before.
pub fn steps(scenario: &Scenario, from: Tti, last: Tti) -> Vec<Step> {
    // A TTI is complete when the next one begins.
    let scenario = Scenario {
        ttis: scenario.ttis.min(last.0 + 2),
        ..scenario.clone()
    };
    let prepared = Workshop::default().prepare(&scenario);
    let take = move |kept: &mut Vec<Step>, step: Step| {
        if (from..=last).contains(&step.tti) {
            kept.push(step);
        }
    };
    let watched = watched(&prepared, Manner::default(), take, &|| false);
    watched.map_or_else(Vec::new, |(_, steps)| steps)
}

/// The digest of a run, none for the genie's, and what `take` has made of its steps, one after the other. `None` if
/// `stop` has said so.
fn watched<T: Default + Send + 'static>(
    prepared: &Prepared,
    manner: Manner,
    take: impl Fn(&mut T, Step) + Send + 'static,
    stop: &(dyn Fn() -> bool + Sync),
) -> Option<(Option<Digest>, T)> {
    let taken = Arc::new(Mutex::new(T::default()));
    let sink = {
        let taken = Arc::clone(&taken);
        move |step: Step| take(&mut taken.lock().unwrap_or_else(PoisonError::into_inner), step)
    };
    let known = prepared.knowledge();
    let mind = match prepared.mind(&known) {
        Mind::Policy(policy) => Mind::of(Recorded::new(policy, &known, manner, sink)),
        Mind::Genie(_) | Mind::External(_) => return Some((None, T::default())),
    };
    let world = World::new(&prepared.scenario, &prepared.deployment);
    let cycle = Cycle::with_station(prepared, world, Station::new(known, mind));
    let options = Options {
        window: 200,
        ..Options::default()
    };
    let outcome = Run::with_cycle(prepared, cycle, options).finish(&mut StopWhen(stop));
    let taken = std::mem::take(&mut *taken.lock().unwrap_or_else(PoisonError::into_inner));
    outcome.complete.then_some((Some(outcome.digest), taken))
}

fn chunks(prepared: &Prepared, run: u32, recording: &Recording, shares: &[f32], kept: Vec<Step>) -> Vec<Chunk> {
    let policy = &prepared.scenario.policy;
    let price = policy
        .settings::<AgeIndexSettings>()
        .map(|settings| settings.price)
        .or_else(|| policy.settings::<DtSettings>().and_then(DtSettings::fixed_price));
    let name: Arc<str> = policy.name().into();
    let mut chunks: Vec<Chunk> = Vec::new();
    for step in kept {
        let k = step.tti.0 as usize;
        // Near the end of a run there is no return.
        let Some(ahead) = shares.get(k..k + HORIZON) else { break };
        let mean = ahead.iter().sum::<f32>() / HORIZON as f32;
        if k.is_multiple_of(recording.stride) {
            chunks.push(Chunk {
                run,
                policy: Arc::clone(&name),
                price: price.map(|price| price as f32),
                devices: prepared.deployment.devices.len(),
                steps: Vec::with_capacity(recording.length),
                returns: Vec::with_capacity(recording.length),
            });
        }
        let chunk = chunks.last_mut().expect("a run begins with a chunk");
        chunk.steps.push(step);
        chunk.returns.push(mean);
    }
    // A chunk that the end has cut short is left out.
    chunks.retain(|chunk| chunk.steps.len() == recording.length);
    chunks
}

#[cfg(test)]
mod tests;
