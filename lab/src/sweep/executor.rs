//! Executes the runs that the journal of a sweep does not hold, in parallel. Which runs count must not depend on the
//! number of threads, on interruptions or on shards: cells end by their runs in the order of seeds.

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
    /// The number of the cell's runs that count, in all shards.
    pub runs: u64,
    /// The metric with the widest relative interval and that width, with `until_ci`; `None` if no metric is defined.
    pub widest: Option<(String, f64)>,
}

/// Executes all runs of `shard` that `journal` does not hold yet. Returns for each cell how many of its runs count, or
/// `None` if the observer has stopped it.
///
/// # Errors
/// If the journal cannot be written, or threads cannot be started.
pub(super) fn execute_missing(
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
    let first_check = grid
        .experiment
        .until_ci
        .as_ref()
        .map_or(count, |until| until.next_check(0, count));
    let workers = SweepWorkers {
        pool,
        preparer: RunPreparer::default(),
    };
    let mut progress: Vec<CellProgress> = grid.cells.iter().map(|_| CellProgress::new(first_check)).collect();
    loop {
        let open_cells: Vec<(usize, u64)> = progress
            .iter()
            .enumerate()
            .filter(|(_, cell)| !cell.is_done)
            .map(|(number, cell)| (number, cell.next_check))
            .collect();
        if open_cells.is_empty() {
            break;
        }
        if !execute_wave(grid, shard, &workers, &open_cells, journal, observer)? {
            return Ok(None);
        }
        for (cell, _) in open_cells {
            progress[cell].check_intervals(grid, cell, journal);
        }
    }
    let summaries = progress.into_iter().map(|cell| CellSummary {
        runs: cell.next_check,
        widest: cell.widest,
    });
    Ok(Some(summaries.collect()))
}

struct SweepWorkers {
    pool: rayon::ThreadPool,
    preparer: RunPreparer,
}

/// Executes the shard's missing runs of `open_cells`, each up to a number of seeds. Returns whether all of them are
/// complete.
fn execute_wave(
    grid: &SweepGrid,
    shard: Shard,
    SweepWorkers { pool, preparer }: &SweepWorkers,
    open_cells: &[(usize, u64)],
    journal: &mut impl RunStore,
    observer: &impl SweepProgress,
) -> Result<bool, SweepError> {
    let mut missing: Vec<RunIndex> = Vec::new();
    for &(cell, runs) in open_cells {
        let before = missing.len();
        // The casts hold: a grid has at most 100 000 cells, and a cell at most 10 000 000 seeds.
        let shard_runs = shard.seed_indices(cell as u64, runs).map(|seed| RunIndex {
            cell: cell as u32,
            seed: seed as u32,
        });
        missing.extend(shard_runs.filter(|run_index| !journal.runs().contains_key(run_index)));
        observer.planned(cell, (missing.len() - before) as u64);
    }
    let journal = Mutex::new(journal);
    let outcome = pool.install(|| {
        missing
            .into_iter()
            // Runs are handed out one by one, so cells start in order and no thread gets all long runs.
            .par_bridge()
            .try_for_each(|run_index| match execute_run(grid, run_index, preparer, observer) {
                None => Err(WaveEnd::Stopped),
                Some(entry) => {
                    let device_ttis = grid.cells[run_index.cell as usize].device_ttis();
                    let mut journal = journal.lock().unwrap_or_else(PoisonError::into_inner);
                    journal.add(run_index, entry, device_ttis).map_err(WaveEnd::Failed)?;
                    observer.finished(run_index.cell as usize);
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

enum WaveEnd {
    Stopped,
    Failed(SweepError),
}

/// Executes one run. Returns `None` if it was stopped.
fn execute_run(
    grid: &SweepGrid,
    run_index: RunIndex,
    preparer: &RunPreparer,
    observer: &impl SweepProgress,
) -> Option<JournalEntry> {
    if observer.stop() {
        return None;
    }
    let cell = &grid.cells[run_index.cell as usize];
    observer.started(run_index.cell as usize);
    let scenario = cell.with_seed(grid.experiment.seeds.first + u64::from(run_index.seed));
    let options = RunOptions {
        // The observer is asked at the end of each window; windows do not change outcomes.
        window: (STOP_DEVICE_TTIS / u64::from(scenario.run.devices)).max(1),
        ..RunOptions::default()
    };
    let prepared = preparer.prepare(&scenario);
    for warning in &prepared.warnings {
        observer.warned(run_index.cell as usize, warning);
    }
    let mut run = Run::new(&prepared, options);
    run.schedule_inputs(&grid.inputs(&scenario));
    let outcome = run.finish(&mut StopWhen(|| observer.stop()));
    let row = ResultRow::new(&scenario, cell.swept.clone(), &outcome);
    outcome.is_complete.then(|| JournalEntry::from(&row))
}

struct CellProgress {
    /// The number of runs at the next check; of a done cell, the number of runs that count.
    next_check: u64,
    added_runs: u64,
    moments: Vec<Moments>,
    widest: Option<(String, f64)>,
    is_done: bool,
}

impl CellProgress {
    fn new(first_check: u64) -> Self {
        Self {
            next_check: first_check,
            added_runs: 0,
            moments: Vec::new(),
            widest: None,
            is_done: false,
        }
    }

    /// Decides whether the cell has enough runs; all runs up to the next check are present.
    fn check_intervals(&mut self, grid: &SweepGrid, cell: usize, journal: &impl RunStore) {
        let Some(until) = &grid.experiment.until_ci else {
            self.is_done = true;
            return;
        };
        self.moments.resize(until.metrics.len(), Moments::default());
        // By seed and not by completion: the sums, and so the decision, are equal for any number of threads.
        for seed in self.added_runs..self.next_check {
            let run_index = RunIndex {
                cell: cell as u32,
                seed: seed as u32,
            };
            let entry = &journal.runs()[&run_index];
            for (moments, name) in self.moments.iter_mut().zip(&until.metrics) {
                moments.add(metric_value(entry, name));
            }
        }
        self.added_runs = self.next_check;
        self.widest = widest_interval(&until.metrics, &self.moments);
        // Without a defined metric, the cell ends.
        let is_narrow = self.widest.as_ref().is_none_or(|(_, width)| *width <= until.target);
        let next = until.next_check(self.next_check, grid.experiment.seeds.count);
        self.is_done = is_narrow || next == self.next_check;
        if !self.is_done {
            self.next_check = next;
        }
    }
}

/// Returns the metric with the widest interval relative to its mean, among the metrics that are defined in some run.
fn widest_interval(names: &[String], moments: &[Moments]) -> Option<(String, f64)> {
    let widths = names.iter().zip(moments).filter_map(|(name, moments)| {
        let estimate = moments.estimate()?;
        Some((name.clone(), Estimate::relative_half_width(&estimate)))
    });
    widths.reduce(|widest, next| if next.1 > widest.1 { next } else { widest })
}

fn metric_value(entry: &JournalEntry, name: &str) -> f64 {
    let index = Metrics::NAMES.iter().position(|known| *known == name);
    // `until_ci` accepts metrics only, and `events` is the one without a column among `NAMES`.
    index.map_or(entry.events as f64, |index| entry.metrics[index])
}
