//! Executes missing runs in parallel.

use std::sync::{Mutex, PoisonError};

use rayon::iter::{ParallelBridge, ParallelIterator};
use reveille_common::score::Metrics;

use super::error::SweepError;
use super::grid::SweepGrid;
use super::journal::{JournalEntry, RunIndex, RunStore};
use super::shard::Shard;
use crate::preparation::RunPreparer;
use crate::run::{Run, RunOptions, StopWhen};
use crate::stats::{Estimate, Moments};
use crate::table::ResultRow;

/// The number of device-TTIs between two checks whether to stop: a fraction of a second.
const STOP_DEVICE_TTIS: u64 = 20_000_000;

/// Callbacks of a sweep. All threads call them.
pub trait SweepProgress: Sync {
    /// Reports that `runs` more runs of `cell` follow; cells come in order.
    fn planned(&self, cell: usize, runs: u64);
    /// Reports that a thread starts a run of `cell`.
    fn started(&self, cell: usize);
    /// Reports that the thread has finished that run.
    fn finished(&self, cell: usize);
    /// Reports a warning about a run of `cell`, a sentence without its stop.
    fn warned(&self, _cell: usize, _warning: &str) {}
    /// Returns whether to stop, which discards the runs in progress.
    fn stop(&self) -> bool;
}

/// The result of a cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellSummary {
    /// The number of the cell's runs that count.
    pub runs: u64,
    /// The metric with the widest relative interval and that width, with `until_ci`; `None` if no metric is defined.
    pub widest: Option<(String, f64)>,
}

/// Executes all runs of `shard` that `journal` does not hold yet. Returns for each cell how many of its runs count, or
/// `None` if the observer has stopped it.
///
/// # Errors
/// If the journal cannot be written, or threads cannot be started.
pub(super) fn run(
    grid: &SweepGrid,
    shard: Shard,
    threads: usize,
    journal: &mut impl RunStore,
    observer: &impl SweepProgress,
) -> Result<Option<Vec<CellSummary>>, SweepError> {
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
        .map_or(count, |until| until.next_check(0, count));
    let hands = SweepWorkers {
        pool,
        workshop: RunPreparer::default(),
    };
    let mut looks: Vec<CellProgress> = grid.cells.iter().map(|_| CellProgress::at(first)).collect();
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
    let ends = looks.into_iter().map(|look| CellSummary {
        runs: look.runs,
        widest: look.widest,
    });
    Ok(Some(ends.collect()))
}

/// The resources shared by all runs of a sweep.
struct SweepWorkers {
    pool: rayon::ThreadPool,
    workshop: RunPreparer,
}

/// Executes the shard's missing runs of the `open` cells, each up to a number of seeds. Returns whether all of them are
/// complete.
fn wave(
    grid: &SweepGrid,
    shard: Shard,
    SweepWorkers { pool, workshop }: &SweepWorkers,
    open: &[(usize, u64)],
    journal: &mut impl RunStore,
    observer: &impl SweepProgress,
) -> Result<bool, SweepError> {
    let mut missing: Vec<RunIndex> = Vec::new();
    for &(cell, runs) in open {
        let before = missing.len();
        // The casts hold: a grid has at most 100 000 cells, and a cell at most 10 000 000 seeds.
        let own = shard.seeds(cell as u64, runs).map(|seed| RunIndex {
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
            // Runs are handed out one by one, so cells start in order and no thread gets all long runs.
            .par_bridge()
            .try_for_each(|job| match one(grid, job, workshop, observer) {
                None => Err(WaveEnd::Stopped),
                Some(entry) => {
                    let device_ttis = grid.cells[job.cell as usize].device_ttis();
                    let mut journal = journal.lock().unwrap_or_else(PoisonError::into_inner);
                    journal.add(job, entry, device_ttis).map_err(WaveEnd::Failed)?;
                    observer.finished(job.cell as usize);
                    Ok(())
                }
            })
    });
    // Also after a stop or an error: finished runs must survive a power cut.
    let synced = journal.into_inner().unwrap_or_else(PoisonError::into_inner).sync();
    match outcome {
        Ok(()) => synced.map(|()| true),
        Err(WaveEnd::Stopped) => synced.map(|()| false),
        // A failed sync is not reported here, because the failed line came first.
        Err(WaveEnd::Failed(error)) => Err(error),
    }
}

/// A reason why a wave ends early.
enum WaveEnd {
    Stopped,
    Failed(SweepError),
}

/// Executes one run. Returns `None` if it was stopped.
fn one(grid: &SweepGrid, job: RunIndex, workshop: &RunPreparer, observer: &impl SweepProgress) -> Option<JournalEntry> {
    if observer.stop() {
        return None;
    }
    let cell = &grid.cells[job.cell as usize];
    observer.started(job.cell as usize);
    let scenario = cell.with_seed(grid.experiment.seeds.first + u64::from(job.seed));
    let options = RunOptions {
        // The observer is asked at the end of each window; windows do not change outcomes.
        window: (STOP_DEVICE_TTIS / u64::from(scenario.run.devices)).max(1),
        ..RunOptions::default()
    };
    let prepared = workshop.prepare(&scenario);
    for warning in &prepared.warnings {
        observer.warned(job.cell as usize, warning);
    }
    let outcome = Run::new(&prepared, options).finish(&mut StopWhen(|| observer.stop()));
    let row = ResultRow::new(&scenario, cell.swept.clone(), &outcome);
    outcome.complete.then(|| JournalEntry::from(&row))
}

/// The progress of a cell.
struct CellProgress {
    /// The number of runs at the next check.
    runs: u64,
    /// The number of runs in `moments`.
    seen: u64,
    moments: Vec<Moments>,
    widest: Option<(String, f64)>,
    is_done: bool,
}

impl CellProgress {
    fn at(runs: u64) -> Self {
        Self {
            runs,
            seen: 0,
            moments: Vec::new(),
            widest: None,
            is_done: false,
        }
    }

    /// Decides whether the cell has enough runs; all runs up to the next check are present.
    fn decide(&mut self, grid: &SweepGrid, cell: usize, journal: &impl RunStore) {
        let Some(until) = &grid.experiment.until_ci else {
            self.is_done = true;
            return;
        };
        self.moments.resize(until.metrics.len(), Moments::default());
        // By seed and not by completion: the sums, and so the decision, are equal for any number of threads.
        for seed in self.seen..self.runs {
            let job = RunIndex {
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
        // Without a defined metric, more runs would not help.
        let is_narrow = self.widest.as_ref().is_none_or(|(_, width)| *width <= until.target);
        let next = until.next_check(self.runs, grid.experiment.seeds.count);
        self.is_done = is_narrow || next == self.runs;
        if !self.is_done {
            self.runs = next;
        }
    }
}

/// Returns the metric with the widest interval relative to its mean, among the metrics that are defined in some run.
fn widest(names: &[String], moments: &[Moments]) -> Option<(String, f64)> {
    let widths = names.iter().zip(moments).filter_map(|(name, moments)| {
        let estimate = moments.estimate()?;
        Some((name.clone(), Estimate::relative(&estimate)))
    });
    widths.reduce(|widest, next| if next.1 > widest.1 { next } else { widest })
}

fn metric(entry: &JournalEntry, name: &str) -> f64 {
    let at = Metrics::NAMES.iter().position(|known| *known == name);
    at.map_or(entry.events as f64, |at| entry.metrics[at])
}
