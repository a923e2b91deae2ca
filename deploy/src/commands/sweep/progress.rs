//! The progress bar of a sweep.
//!
//! The time that is left is estimated from what each cell's runs have taken so far; for cells of which none has
//! finished, from their device-TTIs at the mean rate of the others.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar};
use reveille_lab::sweep::{Grid, Shard, SweepProgress};

use crate::display;

/// Least time between two drawings.
const REDRAW: Duration = Duration::from_millis(100);

/// Follows a sweep and shows where it is.
pub struct Progress {
    bar: ProgressBar,
    stop: Arc<AtomicBool>,
    threads: usize,
    labels: Vec<String>,
    cells: Vec<Tally>,
    current: AtomicUsize,
    began: Instant,
    under_way: Mutex<Vec<(ThreadId, Instant)>>,
    drawn: Mutex<Instant>,
    /// The cells that were warned of.
    warned: Mutex<BTreeSet<(usize, String)>>,
}

/// How far the runs of one cell are.
struct Tally {
    /// Device-TTIs of a run.
    cost: u64,
    planned: AtomicU64,
    done: AtomicU64,
    /// Time of all finished runs.
    nanos: AtomicU64,
}

impl Progress {
    /// Shows a sweep of `grid`, of whose runs `found` are there already, unless `hidden` or standard error is no
    /// terminal.
    pub fn start(
        grid: &Grid,
        shard: Shard,
        threads: usize,
        found: usize,
        stop: &Arc<AtomicBool>,
        hidden: bool,
    ) -> Self {
        let template = "{bar:24} {pos}/{len} runs  {msg}";
        let bar = display::bar(grid.share(shard).saturating_sub(found as u64), template, hidden);
        let tally = |cost| Tally {
            cost,
            planned: AtomicU64::new(0),
            done: AtomicU64::new(0),
            nanos: AtomicU64::new(0),
        };
        let now = crate::wall::now();
        Self {
            bar,
            stop: Arc::clone(stop),
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

    /// Takes the bar away, and gives the device-TTIs that were run.
    pub fn finish(&self) -> u64 {
        self.bar.finish_and_clear();
        self.cells
            .iter()
            .map(|cell| cell.cost.saturating_mul(cell.done.load(Ordering::Relaxed)))
            .fold(0, u64::saturating_add)
    }

    /// Runs that were made.
    pub fn runs(&self) -> usize {
        let done: u64 = self.cells.iter().map(|cell| cell.done.load(Ordering::Relaxed)).sum();
        usize::try_from(done).unwrap_or(usize::MAX)
    }

    fn draw(&self) {
        let now = crate::wall::now();
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

    /// The time that is left.
    fn left(&self) -> Duration {
        let known = self.cells.iter().map(|cell| {
            let (done, nanos) = (cell.done.load(Ordering::Relaxed), cell.nanos.load(Ordering::Relaxed));
            (cell, done, nanos)
        });
        let known: Vec<_> = known.collect();
        let (work, time) = known.iter().fold((0.0, 0.0), |(work, time), (cell, done, nanos)| {
            (work + cell.cost as f64 * *done as f64, time + *nanos as f64)
        });
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
        Duration::from_secs_f64((left / 1e9 / self.threads as f64).min(1e9))
    }
}

impl SweepProgress for Progress {
    fn planned(&self, cell: usize, runs: u64) {
        self.cells[cell].planned.fetch_add(runs, Ordering::Relaxed);
    }

    fn started(&self, cell: usize) {
        self.current.store(cell, Ordering::Relaxed);
        let mut under_way = self.under_way.lock().unwrap_or_else(PoisonError::into_inner);
        under_way.push((std::thread::current().id(), crate::wall::now()));
    }

    fn finished(&self, cell: usize) {
        let own = std::thread::current().id();
        let mut under_way = self.under_way.lock().unwrap_or_else(PoisonError::into_inner);
        let at = under_way.iter().position(|(thread, _)| *thread == own);
        let taken = at.map_or(Duration::ZERO, |at| under_way.swap_remove(at).1.elapsed());
        drop(under_way);
        let nanos = u64::try_from(taken.as_nanos()).unwrap_or(u64::MAX);
        self.cells[cell].nanos.fetch_add(nanos, Ordering::Relaxed);
        self.cells[cell].done.fetch_add(1, Ordering::Relaxed);
        self.draw();
    }

    /// Says it once for a cell, however many of its runs it is true of.
    fn warned(&self, cell: usize, warning: &str) {
        let mut warned = self.warned.lock().unwrap_or_else(PoisonError::into_inner);
        if warned.insert((cell, warning.to_owned())) {
            self.bar.suspend(|| tracing::warn!("{}: {warning}", self.labels[cell]));
        }
    }

    fn stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}
