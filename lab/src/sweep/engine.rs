//! Runs what is missing, in parallel.

use std::sync::{Mutex, PoisonError};

use rayon::iter::{ParallelBridge, ParallelIterator};
use reveille_common::score::Metrics;

use super::error::SweepError;
use super::grid::Grid;
use super::journal::{Entry, Job, Keeper};
use super::shard::Shard;
use crate::preparation::Workshop;
use crate::run::{Options, Run, StopWhen};
use crate::stats::{Estimate, Moments};
use crate::table::Row;

/// Device-TTIs between two looks at whether to stop: a fraction of a second.
const STOP_DEVICE_TTIS: u64 = 20_000_000;

/// Follows a sweep while it goes. Called from all threads.
pub trait SweepProgress: Sync {
    /// `runs` more runs of `cell` will be made; cells come in order.
    fn planned(&self, cell: usize, runs: u64);
    /// A thread begins a run of `cell`.
    fn started(&self, cell: usize);
    /// The thread has finished that run.
    fn finished(&self, cell: usize);
    /// What the user should know of a run of `cell`, a sentence without its stop.
    fn warned(&self, _cell: usize, _warning: &str) {}
    /// Whether to stop; runs under way are given up.
    fn stop(&self) -> bool;
}

/// How a cell ended.
#[derive(Clone, Debug, PartialEq)]
pub struct CellEnd {
    /// Runs of the cell that count.
    pub runs: u64,
    /// With `until_ci`: the metric with the widest relative interval, and that width; `None` where nothing is defined.
    pub widest: Option<(String, f64)>,
}

/// Makes all runs of `shard` that `journal` does not hold yet, and tells for each cell how many of its runs count;
/// `None` if the observer has stopped it.
///
/// # Errors
/// The journal cannot be written, or threads cannot be started.
pub fn run(
    grid: &Grid,
    shard: Shard,
    threads: usize,
    journal: &mut impl Keeper,
    observer: &impl SweepProgress,
) -> Result<Option<Vec<CellEnd>>, SweepError> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|number| format!("sweep-{number}"))
        .build()
        .map_err(|error| SweepError::Threads {
            threads,
            reason: error.to_string(),
        })?;
    let count = grid.experiment.seeds.count;
    let first = grid
        .experiment
        .until_ci
        .as_ref()
        .map_or(count, |until| until.next_look(0, count));
    let hands = Hands {
        pool,
        workshop: Workshop::default(),
    };
    let mut looks: Vec<Look> = grid.cells.iter().map(|_| Look::at(first)).collect();
    loop {
        let open: Vec<(usize, u64)> = looks
            .iter()
            .enumerate()
            .filter(|(_, look)| !look.is_done)
            .map(|(cell, look)| (cell, look.runs))
            .collect();
        if open.is_empty() {
            break;
        }
        if !wave(grid, shard, &hands, &open, journal, observer)? {
            return Ok(None);
        }
        for (cell, _) in open {
            looks[cell].decide(grid, cell, journal);
        }
    }
    let ends = looks.into_iter().map(|look| CellEnd {
        runs: look.runs,
        widest: look.widest,
    });
    Ok(Some(ends.collect()))
}

/// What all runs of a sweep are made with.
struct Hands {
    pool: rayon::ThreadPool,
    workshop: Workshop,
}

/// The runs of `open` cells, each up to a number of seeds, that belong to the shard and are missing. Says whether all
/// of them were made.
fn wave(
    grid: &Grid,
    shard: Shard,
    Hands { pool, workshop }: &Hands,
    open: &[(usize, u64)],
    journal: &mut impl Keeper,
    observer: &impl SweepProgress,
) -> Result<bool, SweepError> {
    let mut missing: Vec<Job> = Vec::new();
    for &(cell, runs) in open {
        let before = missing.len();
        let own = shard.seeds(cell as u64, runs).map(|seed| Job {
            cell: cell as u32,
            seed: seed as u32,
        });
        missing.extend(own.filter(|job| !journal.runs().contains_key(job)));
        observer.planned(cell, (missing.len() - before) as u64);
    }
    let journal = Mutex::new(journal);
    let outcome = pool.install(|| {
        missing
            .into_iter()
            .par_bridge()
            .try_for_each(|job| match one(grid, job, workshop, observer) {
                None => Err(Halt::Stopped),
                Some(entry) => {
                    let device_ttis = grid.cells[job.cell as usize].device_ttis();
                    let mut journal = journal.lock().unwrap_or_else(PoisonError::into_inner);
                    journal.add(job, entry, device_ttis).map_err(Halt::Failed)?;
                    observer.finished(job.cell as usize);
                    Ok(())
                }
            })
    });
    let synced = journal.into_inner().unwrap_or_else(PoisonError::into_inner).sync();
    match outcome {
        Ok(()) => synced.map(|()| true),
        Err(Halt::Stopped) => synced.map(|()| false),
        Err(Halt::Failed(error)) => Err(error),
    }
}

/// Why a wave ends early.
enum Halt {
    Stopped,
    Failed(SweepError),
}

/// Makes one run; `None` if it was stopped.
fn one(grid: &Grid, job: Job, workshop: &Workshop, observer: &impl SweepProgress) -> Option<Entry> {
    if observer.stop() {
        return None;
    }
    let cell = &grid.cells[job.cell as usize];
    observer.started(job.cell as usize);
    let scenario = cell.with_seed(grid.experiment.seeds.first + u64::from(job.seed));
    let options = Options {
        window: (STOP_DEVICE_TTIS / u64::from(scenario.devices)).max(1),
        ..Options::default()
    };
    let prepared = workshop.prepare(&scenario);
    for warning in &prepared.warnings {
        observer.warned(job.cell as usize, warning);
    }
    let outcome = Run::new(&prepared, options).finish(&mut StopWhen(|| observer.stop()));
    let row = Row::new(&scenario, cell.swept.clone(), &outcome);
    outcome.complete.then(|| Entry::from(&row))
}

/// How far a cell is.
struct Look {
    /// Runs up to the look at hand.
    runs: u64,
    /// Runs that are in `moments`.
    seen: u64,
    moments: Vec<Moments>,
    widest: Option<(String, f64)>,
    is_done: bool,
}

impl Look {
    fn at(runs: u64) -> Self {
        Self {
            runs,
            seen: 0,
            moments: Vec::new(),
            widest: None,
            is_done: false,
        }
    }

    /// Decides whether the cell has enough runs; all up to the look at hand are there.
    fn decide(&mut self, grid: &Grid, cell: usize, journal: &impl Keeper) {
        let Some(until) = &grid.experiment.until_ci else {
            self.is_done = true;
            return;
        };
        self.moments.resize(until.metrics.len(), Moments::default());
        for seed in self.seen..self.runs {
            let job = Job {
                cell: cell as u32,
                seed: seed as u32,
            };
            let entry = &journal.runs()[&job];
            for (moments, name) in self.moments.iter_mut().zip(&until.metrics) {
                moments.add(metric(entry, name));
            }
        }
        self.seen = self.runs;
        self.widest = widest(&until.metrics, &self.moments);
        let is_narrow = self.widest.as_ref().is_none_or(|(_, width)| *width <= until.target);
        let next = until.next_look(self.runs, grid.experiment.seeds.count);
        self.is_done = is_narrow || next == self.runs;
        if !self.is_done {
            self.runs = next;
        }
    }
}

/// The metric whose interval is the widest relative to its mean, of those that are defined in any run.
fn widest(names: &[String], moments: &[Moments]) -> Option<(String, f64)> {
    let widths = names.iter().zip(moments).filter_map(|(name, moments)| {
        let estimate = moments.estimate()?;
        Some((name.clone(), Estimate::relative(&estimate)))
    });
    widths.reduce(|widest, next| if next.1 > widest.1 { next } else { widest })
}

fn metric(entry: &Entry, name: &str) -> f64 {
    let at = Metrics::NAMES.iter().position(|known| *known == name);
    at.map_or(entry.events as f64, |at| entry.metrics[at])
}
