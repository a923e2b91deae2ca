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
    labels: Vec<String>,
    cells: Vec<CellTimes>,
    current_cell: AtomicUsize,
    started_at: Instant,
    run_starts: Mutex<Vec<(ThreadId, Instant)>>,
    last_drawn: Mutex<Instant>,
    /// The warnings already printed, by cell.
    warned: Mutex<BTreeSet<(usize, String)>>,
}

/// The progress of one cell.
struct CellTimes {
    /// Device-TTIs of one run.
    run_device_ttis: u64,
    planned: AtomicU64,
    done: AtomicU64,
    /// Total time of all finished runs, nanoseconds.
    total_nanos: AtomicU64,
}

impl SweepDisplay {
    /// Shows a sweep of `grid` with `found` finished runs, unless `hidden` or standard error is not a terminal.
    pub(super) fn start(
        grid: &SweepGrid,
        shard: Shard,
        threads: usize,
        found: usize,
        signals: &Signals,
        hidden: bool,
    ) -> Self {
        let template = "{bar:12} {pos}/{len} runs  {wide_msg}";
        let bar = display::new_bar(
            grid.shard_run_count(shard).saturating_sub(found as u64),
            template,
            hidden,
        );
        let cell_times = |run_device_ttis| CellTimes {
            run_device_ttis,
            planned: AtomicU64::new(0),
            done: AtomicU64::new(0),
            total_nanos: AtomicU64::new(0),
        };
        let now = crate::runtime::now();
        Self {
            bar,
            signals: signals.clone(),
            threads,
            labels: grid.cells.iter().map(|cell| cell.label.clone()).collect(),
            cells: grid.cells.iter().map(|cell| cell_times(cell.device_ttis())).collect(),
            current_cell: AtomicUsize::new(0),
            started_at: now,
            run_starts: Mutex::new(Vec::with_capacity(threads)),
            last_drawn: Mutex::new(now),
            warned: Mutex::default(),
        }
    }

    /// Removes the bar and returns the device-TTIs that were run.
    pub(super) fn finish(&self) -> u64 {
        self.bar.finish_and_clear();
        self.cells
            .iter()
            .map(|cell| cell.run_device_ttis.saturating_mul(cell.done.load(Ordering::Relaxed)))
            .fold(0, u64::saturating_add)
    }

    /// The number of finished runs of this call.
    pub(super) fn finished_runs(&self) -> usize {
        let done: u64 = self.cells.iter().map(|cell| cell.done.load(Ordering::Relaxed)).sum();
        usize::try_from(done).unwrap_or(usize::MAX)
    }

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
        let (done, planned) = self.cells.iter().fold((0, 0), |(done, planned), cell| {
            (done + load(&cell.done), planned + load(&cell.planned))
        });
        let work: f64 = self
            .cells
            .iter()
            .map(|cell| cell.run_device_ttis as f64 * load(&cell.done) as f64)
            .sum();
        let elapsed = now.duration_since(self.started_at);
        self.bar.set_length(planned);
        self.bar.set_position(done);
        let label = &self.labels[self.current_cell.load(Ordering::Relaxed)];
        // The first runs alone do not measure a rate.
        self.bar.set_message(if done == 0 || elapsed < LEAST_MEASURED {
            label.clone()
        } else {
            format!(
                "{}  {:#} left  {label}",
                display::format_speed(work / elapsed.as_secs_f64()),
                HumanDuration(self.remaining_time())
            )
        });
    }

    /// Estimates the remaining time.
    fn remaining_time(&self) -> Duration {
        let cell_counts = self.cells.iter().map(|cell| {
            let (done, total_nanos) = (
                cell.done.load(Ordering::Relaxed),
                cell.total_nanos.load(Ordering::Relaxed),
            );
            (cell, done, total_nanos)
        });
        let cell_counts: Vec<_> = cell_counts.collect();
        let (work, time) = cell_counts
            .iter()
            .fold((0.0, 0.0), |(work, time), (cell, done, total_nanos)| {
                (
                    work + cell.run_device_ttis as f64 * *done as f64,
                    time + *total_nanos as f64,
                )
            });
        // Without a finished run this is 0, not NaN.
        let mean = time / work.max(1.0);
        let remaining: f64 = cell_counts
            .iter()
            .map(|&(cell, done, total_nanos)| {
                let remaining = cell.planned.load(Ordering::Relaxed).saturating_sub(done) as f64;
                let nanos_per_run = if done > 0 {
                    total_nanos as f64 / done as f64
                } else {
                    mean * cell.run_device_ttis as f64
                };
                remaining * nanos_per_run
            })
            .sum();
        // Clamped, since `from_secs_f64` panics on a value that does not fit.
        Duration::from_secs_f64((remaining / 1e9 / self.threads as f64).min(1e9))
    }
}

impl SweepProgress for SweepDisplay {
    fn planned(&self, cell: usize, runs: u64) {
        self.cells[cell].planned.fetch_add(runs, Ordering::Relaxed);
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
        let total_nanos = u64::try_from(run_time.as_nanos()).unwrap_or(u64::MAX);
        self.cells[cell].total_nanos.fetch_add(total_nanos, Ordering::Relaxed);
        self.cells[cell].done.fetch_add(1, Ordering::Relaxed);
        self.draw();
    }

    /// Prints a warning once per cell, even if several of its runs cause it.
    fn warned(&self, cell: usize, warning: &str) {
        let mut warned = self.warned.lock().unwrap_or_else(PoisonError::into_inner);
        if warned.insert((cell, warning.to_owned())) {
            self.bar.suspend(|| tracing::warn!("{}: {warning}", self.labels[cell]));
        }
    }

    fn should_stop(&self) -> bool {
        self.signals.has_arrived()
    }
}
