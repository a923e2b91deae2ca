//! The progress bar of a sweep, fed by the threads of `lab/src/sweep/`. No result depends on it.
//!
//! The remaining time is estimated from the finished runs of each cell. A cell without finished runs counts with its
//! device-TTIs at the mean rate of the others.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar};
use reveille_lab::sweep::{Shard, SweepGrid, SweepProgress};

use crate::display;
use crate::signals::Signals;

/// Least time between two redraws.
const REDRAW_INTERVAL: Duration = Duration::from_millis(100);

/// Least time over which a rate is measured.
const LEAST_MEASURED: Duration = Duration::from_millis(500);

/// Follows a sweep and shows its progress.
pub(super) struct SweepDisplay {
    bar: ProgressBar,
    signals: Signals,
    threads: usize,
    /// The labels of the cells, by cell.
    labels: Vec<String>,
    cells: Vec<CellProgress>,
    /// The cell whose run started last, for the label next to the bar.
    current_cell: AtomicUsize,
    started_at: Instant,
    /// The starts of the runs in progress, one for each thread.
    run_starts: Mutex<Vec<(ThreadId, Instant)>>,
    last_drawn: Mutex<Instant>,
    /// The warnings already printed, by cell.
    printed_warnings: Mutex<BTreeSet<(usize, String)>>,
}

/// The progress of one cell in this call; runs found in the journal do not count.
struct CellProgress {
    /// Device-TTIs of one run.
    run_device_ttis: u64,
    /// Number of runs to make, so far: more can follow.
    planned_runs: AtomicU64,
    /// Number of finished runs.
    finished_runs: AtomicU64,
    /// Total time of all finished runs, nanoseconds.
    total_nanos: AtomicU64,
}

impl SweepDisplay {
    /// Shows a sweep of `grid` with `known_runs` finished runs, unless `hidden` or standard error is not a terminal.
    pub(super) fn start(
        grid: &SweepGrid,
        shard: Shard,
        threads: usize,
        known_runs: usize,
        signals: &Signals,
        hidden: bool,
    ) -> Self {
        let template = "{bar:12} {pos}/{len} runs  {wide_msg}";
        let bar = display::new_bar(
            grid.shard_run_count(shard).saturating_sub(known_runs as u64),
            template,
            hidden,
        );
        let new_cell = |run_device_ttis| CellProgress {
            run_device_ttis,
            planned_runs: AtomicU64::new(0),
            finished_runs: AtomicU64::new(0),
            total_nanos: AtomicU64::new(0),
        };
        let now = crate::runtime::now();
        Self {
            bar,
            signals: signals.clone(),
            threads,
            labels: grid.cells.iter().map(|cell| cell.label.clone()).collect(),
            cells: grid.cells.iter().map(|cell| new_cell(cell.device_ttis())).collect(),
            current_cell: AtomicUsize::new(0),
            started_at: now,
            run_starts: Mutex::new(Vec::with_capacity(threads)),
            last_drawn: Mutex::new(now),
            printed_warnings: Mutex::default(),
        }
    }

    /// Removes the bar and returns the device-TTIs that were run.
    pub(super) fn finish(&self) -> u64 {
        self.bar.finish_and_clear();
        self.cells
            .iter()
            .map(|cell| {
                cell.run_device_ttis
                    .saturating_mul(cell.finished_runs.load(Ordering::Relaxed))
            })
            .fold(0, u64::saturating_add)
    }

    /// The number of finished runs of this call.
    pub(super) fn finished_runs(&self) -> usize {
        let finished: u64 = self
            .cells
            .iter()
            .map(|cell| cell.finished_runs.load(Ordering::Relaxed))
            .sum();
        usize::try_from(finished).unwrap_or(usize::MAX)
    }

    /// Redraws the bar, at most once per [`REDRAW_INTERVAL`].
    fn draw(&self) {
        let now = crate::runtime::now();
        // A thread that finds another one drawing continues with its runs.
        let Ok(mut last_drawn) = self.last_drawn.try_lock() else {
            return;
        };
        if now.duration_since(*last_drawn) < REDRAW_INTERVAL {
            return;
        }
        *last_drawn = now;
        let load = |value: &AtomicU64| value.load(Ordering::Relaxed);
        let (finished_runs, planned_runs) = self.cells.iter().fold((0, 0), |(finished, planned), cell| {
            (finished + load(&cell.finished_runs), planned + load(&cell.planned_runs))
        });
        let device_ttis: f64 = self
            .cells
            .iter()
            .map(|cell| cell.run_device_ttis as f64 * load(&cell.finished_runs) as f64)
            .sum();
        let elapsed = now.duration_since(self.started_at);
        self.bar.set_length(planned_runs);
        self.bar.set_position(finished_runs);
        let label = &self.labels[self.current_cell.load(Ordering::Relaxed)];
        let mut parts: Vec<String> = label.split(", ").map(str::to_owned).collect();
        // The first runs alone do not measure a rate.
        if finished_runs > 0 && elapsed >= LEAST_MEASURED {
            parts.insert(0, format!("{:#} left", HumanDuration(self.remaining_time())));
            parts.push(display::format_speed(device_ttis / elapsed.as_secs_f64()));
        }
        let used = display::BAR_COLUMNS + format!("{finished_runs}/{planned_runs} runs  ").len();
        self.bar.set_message(display::join_fitting(&parts, used));
    }

    /// Estimates the remaining time, as the header describes.
    fn remaining_time(&self) -> Duration {
        // Read once, so that the sums and the estimates use the same counts.
        let cell_counts = self.cells.iter().map(|cell| {
            let (finished, total_nanos) = (
                cell.finished_runs.load(Ordering::Relaxed),
                cell.total_nanos.load(Ordering::Relaxed),
            );
            (cell, finished, total_nanos)
        });
        let cell_counts: Vec<_> = cell_counts.collect();
        let (device_ttis, nanos) =
            cell_counts
                .iter()
                .fold((0.0, 0.0), |(device_ttis, nanos), (cell, finished, total_nanos)| {
                    (
                        device_ttis + cell.run_device_ttis as f64 * *finished as f64,
                        nanos + *total_nanos as f64,
                    )
                });
        // Without a finished run this is 0, not NaN.
        let nanos_per_device_tti = nanos / device_ttis.max(1.0);
        let remaining_nanos: f64 = cell_counts
            .iter()
            .map(|&(cell, finished, total_nanos)| {
                let remaining_runs = cell.planned_runs.load(Ordering::Relaxed).saturating_sub(finished) as f64;
                let nanos_per_run = if finished > 0 {
                    total_nanos as f64 / finished as f64
                } else {
                    nanos_per_device_tti * cell.run_device_ttis as f64
                };
                remaining_runs * nanos_per_run
            })
            .sum();
        // Clamped, since `from_secs_f64` panics on a value that does not fit.
        Duration::from_secs_f64((remaining_nanos / 1e9 / self.threads as f64).min(1e9))
    }
}

impl SweepProgress for SweepDisplay {
    fn planned(&self, cell: usize, runs: u64) {
        self.cells[cell].planned_runs.fetch_add(runs, Ordering::Relaxed);
    }

    fn started(&self, cell: usize) {
        self.current_cell.store(cell, Ordering::Relaxed);
        let mut run_starts = self.run_starts.lock().unwrap_or_else(PoisonError::into_inner);
        run_starts.push((std::thread::current().id(), crate::runtime::now()));
    }

    fn finished(&self, cell: usize) {
        let thread_id = std::thread::current().id();
        let mut run_starts = self.run_starts.lock().unwrap_or_else(PoisonError::into_inner);
        // A thread makes one run at a time, so its id finds the start.
        let index = run_starts.iter().position(|(thread, _)| *thread == thread_id);
        let run_time = index.map_or(Duration::ZERO, |index| run_starts.swap_remove(index).1.elapsed());
        // Released before `draw`, which writes to the terminal.
        drop(run_starts);
        let run_nanos = u64::try_from(run_time.as_nanos()).unwrap_or(u64::MAX);
        self.cells[cell].total_nanos.fetch_add(run_nanos, Ordering::Relaxed);
        self.cells[cell].finished_runs.fetch_add(1, Ordering::Relaxed);
        self.draw();
    }

    /// Prints a warning once per cell, even if several of its runs cause it.
    fn warned(&self, cell: usize, warning: &str) {
        let mut printed_warnings = self.printed_warnings.lock().unwrap_or_else(PoisonError::into_inner);
        if printed_warnings.insert((cell, warning.to_owned())) {
            self.bar.suspend(|| tracing::warn!("{}: {warning}", self.labels[cell]));
        }
    }

    fn should_stop(&self) -> bool {
        self.signals.has_arrived()
    }
}
