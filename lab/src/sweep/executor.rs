//! Executes the runs that the journal of a sweep does not hold, in parallel; `folder.rs` calls it. The runs that count
//! must not depend on the number of threads, on interruptions or on shards: cells end by their runs in the order of
//! seeds. A cell is named by its index in the grid.

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

/// Callbacks of a sweep. All threads call them. `deploy`, `python` and tests implement the trait; an implementation
/// without `warned` drops the warnings.
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
    fn should_stop(&self) -> bool;
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
/// `None` if `progress` has stopped it.
///
/// # Panics
/// If `shard` is not the whole sweep and the experiment has `until_ci`, which `SweepGrid::check_shard` refuses.
///
/// # Errors
/// If the journal cannot be written, or threads cannot be started.
pub(super) fn execute_missing(
    grid: &SweepGrid,
    shard: Shard,
    threads: usize,
    journal: &mut impl RunStore,
    progress: &impl SweepProgress,
) -> Result<Option<Vec<CellSummary>>, SweepError> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|number| format!("sweep-{number}"))
        .build()
        .map_err(|error| SweepError::Threads {
            threads,
            reason: error.to_string(),
        })?;
    let seed_count = grid.experiment.seeds.count;
    let first_check = grid
        .experiment
        .until_ci
        .as_ref()
        .map_or(seed_count, |until| until.next_check(0, seed_count));
    let workers = SweepWorkers {
        pool,
        preparer: RunPreparer::default(),
    };
    let mut cell_states: Vec<CellState> = grid.cells.iter().map(|_| CellState::new(first_check)).collect();
    loop {
        let open_cells: Vec<(usize, u64)> = cell_states
            .iter()
            .enumerate()
            .filter(|(_, state)| !state.is_done)
            .map(|(cell, state)| (cell, state.due_runs))
            .collect();
        if open_cells.is_empty() {
            break;
        }
        if !execute_wave(grid, shard, &workers, &open_cells, journal, progress)? {
            return Ok(None);
        }
        for (cell, _) in open_cells {
            cell_states[cell].check_intervals(grid, cell, journal);
        }
    }
    let summaries = cell_states.into_iter().map(|state| CellSummary {
        runs: state.due_runs,
        widest: state.widest,
    });
    Ok(Some(summaries.collect()))
}

/// The threads of a sweep, and the caches that they share.
struct SweepWorkers {
    pool: rayon::ThreadPool,
    preparer: RunPreparer,
}

/// Executes the shard's missing runs of `open_cells`, each a cell with the number of seeds up to which it must be
/// complete. Returns whether all of them are; false after a stop.
fn execute_wave(
    grid: &SweepGrid,
    shard: Shard,
    SweepWorkers { pool, preparer }: &SweepWorkers,
    open_cells: &[(usize, u64)],
    journal: &mut impl RunStore,
    progress: &impl SweepProgress,
) -> Result<bool, SweepError> {
    let mut missing: Vec<RunIndex> = Vec::new();
    for &(cell, runs) in open_cells {
        let missing_before = missing.len();
        // The casts hold: a grid has at most 100 000 cells, and a cell at most 10 000 000 seeds.
        let shard_runs = shard.seed_indices(cell as u64, runs).map(|seed| RunIndex {
            cell: cell as u32,
            seed: seed as u32,
        });
        missing.extend(shard_runs.filter(|run_index| !journal.runs().contains_key(run_index)));
        progress.planned(cell, (missing.len() - missing_before) as u64);
    }
    let journal = Mutex::new(journal);
    let outcome = pool.install(|| {
        missing
            .into_iter()
            // Runs are handed out one by one, so cells start in order and no thread gets all long runs.
            .par_bridge()
            .try_for_each(|run_index| match execute_run(grid, run_index, preparer, progress) {
                None => Err(WaveEnd::Stopped),
                Some(entry) => {
                    let device_ttis = grid.cells[run_index.cell as usize].device_ttis();
                    let mut journal = journal.lock().unwrap_or_else(PoisonError::into_inner);
                    journal.add(run_index, entry, device_ttis).map_err(WaveEnd::Failed)?;
                    progress.finished(run_index.cell as usize);
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

/// The reason why a wave ends early.
enum WaveEnd {
    Stopped,
    Failed(SweepError),
}

/// Executes one run. Returns `None` if it was stopped.
fn execute_run(
    grid: &SweepGrid,
    run_index: RunIndex,
    preparer: &RunPreparer,
    progress: &impl SweepProgress,
) -> Option<JournalEntry> {
    if progress.should_stop() {
        return None;
    }
    let cell = &grid.cells[run_index.cell as usize];
    progress.started(run_index.cell as usize);
    let scenario = cell.with_seed(grid.experiment.seeds.first + u64::from(run_index.seed));
    let options = RunOptions {
        // `StopWhen` is asked at the end of each window; windows do not change outcomes.
        window: (STOP_DEVICE_TTIS / u64::from(scenario.run.devices)).max(1),
        ..RunOptions::default()
    };
    let prepared = preparer.prepare(&scenario);
    for warning in &prepared.warnings {
        progress.warned(run_index.cell as usize, warning);
    }
    let mut run = Run::new(&prepared, options);
    run.schedule_inputs(&grid.inputs(&scenario));
    let outcome = run.finish(&mut StopWhen(|| progress.should_stop()));
    let row = ResultRow::new(&scenario, cell.swept.clone(), &outcome);
    outcome.is_complete.then(|| JournalEntry::from(&row))
}

/// The state of a cell between two waves.
struct CellState {
    /// The number of runs that the next check needs; of a done cell, the number of runs that count.
    due_runs: u64,
    /// The number of runs whose metrics are in `moments`.
    checked_runs: u64,
    /// By metric of `until_ci`.
    moments: Vec<Moments>,
    widest: Option<(String, f64)>,
    is_done: bool,
}

impl CellState {
    fn new(first_check: u64) -> Self {
        Self {
            due_runs: first_check,
            checked_runs: 0,
            moments: Vec::new(),
            widest: None,
            is_done: false,
        }
    }

    /// Decides whether the cell has enough runs. With `until_ci`, all of its `due_runs` must be in `journal`.
    fn check_intervals(&mut self, grid: &SweepGrid, cell: usize, journal: &impl RunStore) {
        let Some(until) = &grid.experiment.until_ci else {
            self.is_done = true;
            return;
        };
        self.moments.resize(until.metrics.len(), Moments::default());
        // By seed and not by completion: the sums, and so the decision, are equal for any number of threads.
        for seed in self.checked_runs..self.due_runs {
            let run_index = RunIndex {
                cell: cell as u32,
                seed: seed as u32,
            };
            let entry = &journal.runs()[&run_index];
            for (moments, name) in self.moments.iter_mut().zip(&until.metrics) {
                moments.add(metric_value(entry, name));
            }
        }
        self.checked_runs = self.due_runs;
        self.widest = widest_interval(&until.metrics, &self.moments);
        // Without a defined metric, the cell ends.
        let is_narrow = self.widest.as_ref().is_none_or(|(_, width)| *width <= until.target);
        let next_check = until.next_check(self.due_runs, grid.experiment.seeds.count);
        self.is_done = is_narrow || next_check == self.due_runs;
        if !self.is_done {
            self.due_runs = next_check;
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

/// Returns the value of the metric `name`, which `until_ci` has accepted.
fn metric_value(entry: &JournalEntry, name: &str) -> f64 {
    let index = Metrics::NAMES.iter().position(|known| *known == name);
    // `until_ci` accepts metrics only, and `events` is the one without a column among `NAMES`.
    index.map_or(entry.events as f64, |index| entry.metrics[index])
}
