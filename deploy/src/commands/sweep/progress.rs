//! The progress bar of a sweep.
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
const REDRAW: Duration = Duration::from_millis(100);

/// Follows a sweep and shows its progress.
pub(super) struct SweepDisplay {
    bar: ProgressBar,
    signals: Signals,
    threads: usize,
    labels: Vec<String>,
    cells: Vec<CellTimes>,
    current: AtomicUsize,
    began: Instant,
    under_way: Mutex<Vec<(ThreadId, Instant)>>,
    drawn: Mutex<Instant>,
    /// The warnings already printed, by cell.
    warned: Mutex<BTreeSet<(usize, String)>>,
}

/// The progress of one cell.
struct CellTimes {
    /// Device-TTIs of one run.
    cost: u64,
    planned: AtomicU64,
    done: AtomicU64,
    /// Total time of all finished runs, nanoseconds.
    nanos: AtomicU64,
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
        let template = "{bar:24} {pos}/{len} runs  {msg}";
        let bar = display::bar(grid.share(shard).saturating_sub(found as u64), template, hidden);
        let tally = |cost| CellTimes {
            cost,
            planned: AtomicU64::new(0),
            done: AtomicU64::new(0),
            nanos: AtomicU64::new(0),
        };
        let now = crate::runtime::now();
        Self {
            bar,
            signals: signals.clone(),
            threads,
            labels: grid.cells.iter().map(|cell| cell.label.clone()).collect(),
            cells: grid.cells.iter().map(|cell| tally(cell.device_ttis())).collect(),
            current: AtomicUsize::new(0),
            began: now,
            under_way: Mutex::new(Vec::with_capacity(threads)),
            drawn: Mutex::new(now),
            warned: Mutex::default(),
        }
    }

    /// Removes the bar and returns the device-TTIs that were run.
    pub(super) fn finish(&self) -> u64 {
        self.bar.finish_and_clear();
        self.cells
            .iter()
            .map(|cell| cell.cost.saturating_mul(cell.done.load(Ordering::Relaxed)))
            .fold(0, u64::saturating_add)
    }

    /// The number of finished runs of this call.
    pub(super) fn runs(&self) -> usize {
        let done: u64 = self.cells.iter().map(|cell| cell.done.load(Ordering::Relaxed)).sum();
        usize::try_from(done).unwrap_or(usize::MAX)
    }

    fn draw(&self) {
        let now = crate::runtime::now();
        // A thread that finds another one drawing continues with its runs.
        let Ok(mut drawn) = self.drawn.try_lock() else { return };
        if now.duration_since(*drawn) < REDRAW {
            return;
        }
        *drawn = now;
        let get = |value: &AtomicU64| value.load(Ordering::Relaxed);
        let (done, planned) = self.cells.iter().fold((0, 0), |(done, planned), cell| {
            (done + get(&cell.done), planned + get(&cell.planned))
        });
        let work: f64 = self
            .cells
            .iter()
            .map(|cell| cell.cost as f64 * get(&cell.done) as f64)
            .sum();
        let rate = work / now.duration_since(self.began).as_secs_f64();
        self.bar.set_length(planned);
        self.bar.set_position(done);
        self.bar.set_message(format!(
            "{:.0} M device-TTIs/s  {} left  {}",
            rate / 1e6,
            HumanDuration(self.left()),
            self.labels[self.current.load(Ordering::Relaxed)]
        ));
    }

    /// Estimates the remaining time.
    fn left(&self) -> Duration {
        let known = self.cells.iter().map(|cell| {
            let (done, nanos) = (cell.done.load(Ordering::Relaxed), cell.nanos.load(Ordering::Relaxed));
            (cell, done, nanos)
        });
        let known: Vec<_> = known.collect();
        let (work, time) = known.iter().fold((0.0, 0.0), |(work, time), (cell, done, nanos)| {
            (work + cell.cost as f64 * *done as f64, time + *nanos as f64)
        });
        // Without a finished run this is 0, not NaN.
        let mean = time / work.max(1.0);
        let left: f64 = known
            .iter()
            .map(|&(cell, done, nanos)| {
                let left = cell.planned.load(Ordering::Relaxed).saturating_sub(done) as f64;
                let each = if done > 0 {
                    nanos as f64 / done as f64
                } else {
                    mean * cell.cost as f64
                };
                left * each
            })
            .sum();
        // Clamped, since `from_secs_f64` panics on a value that does not fit.
        Duration::from_secs_f64((left / 1e9 / self.threads as f64).min(1e9))
    }
}

impl SweepProgress for SweepDisplay {
    fn planned(&self, cell: usize, runs: u64) {
        self.cells[cell].planned.fetch_add(runs, Ordering::Relaxed);
    }

    fn started(&self, cell: usize) {
        self.current.store(cell, Ordering::Relaxed);
        let mut under_way = self.under_way.lock().unwrap_or_else(PoisonError::into_inner);
        under_way.push((std::thread::current().id(), crate::runtime::now()));
    }

    fn finished(&self, cell: usize) {
        let own = std::thread::current().id();
        let mut under_way = self.under_way.lock().unwrap_or_else(PoisonError::into_inner);
        // A thread makes one run at a time, so its id finds the start.
        let at = under_way.iter().position(|(thread, _)| *thread == own);
        let taken = at.map_or(Duration::ZERO, |at| under_way.swap_remove(at).1.elapsed());
        // Released before `draw`, which writes to the terminal.
        drop(under_way);
        let nanos = u64::try_from(taken.as_nanos()).unwrap_or(u64::MAX);
        self.cells[cell].nanos.fetch_add(nanos, Ordering::Relaxed);
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

    fn stop(&self) -> bool {
        self.signals.have_come()
    }
}
