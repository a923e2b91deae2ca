//! The device processes of `up`, kept going: one that ends is started anew, and takes over what the last one carried.

use std::collections::VecDeque;
use std::process::{Child, ExitStatus};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use reveille_bs::host::{OnLoss, Progress};
use reveille_common::bus::allowed;
use reveille_common::secret::Secret;

use crate::display::note;
use crate::launch::{self, LEAVE, Threads};
use crate::muster::Muster;
use crate::wall::now;

/// Time between two looks at the processes.
const LOOK: Duration = Duration::from_millis(20);
/// The pause before a process is started anew that has not lived for long, doubled each time.
const PAUSE: Duration = Duration::from_millis(100);
/// A process that has lived for so long did not end because it cannot live.
const LONG: Duration = Duration::from_secs(5);
/// So many processes that did not live for long, one after another in one place, end the run.
const SHORT_LIVES: u32 = 6;

/// What the thread and its owner know of each other.
struct State {
    pids: Mutex<Vec<u32>>,
    /// The run has ended: processes leave.
    is_over: AtomicBool,
    /// Nobody waits for them any more.
    is_left: AtomicBool,
}

/// One place among the device processes.
struct Place {
    command: Vec<String>,
    child: Option<Child>,
    started: Instant,
    short_lives: u32,
    /// When another process is started.
    due: Option<Instant>,
}

/// The device processes of a run, and the thread that looks after them. The kernel ends the processes when that thread
/// ends, however it does.
pub struct Launcher {
    state: Arc<State>,
    thread: Option<JoinHandle<()>>,
}

/// What processes are started with, and what for.
pub struct Orders {
    /// The arguments of each.
    pub commands: Vec<Vec<String>>,
    /// The run's key, which they are told.
    pub key: Option<Secret>,
    /// The threads that zenoh has in them.
    pub threads: Threads,
    /// What to do with one that ends before the run.
    pub on_loss: OnLoss,
}

impl Launcher {
    /// Starts processes, not more at a time than the machine can take. Where one ends before the run and that is not
    /// to be gone on with, or another one does not help, `progress` is told why the run must end. It says how many are
    /// there.
    ///
    /// # Errors
    /// If one of the first processes cannot be started.
    pub fn start(orders: Orders, progress: &Arc<Progress>) -> anyhow::Result<Self> {
        let Orders {
            commands,
            key,
            threads,
            on_loss,
        } = orders;
        let state = Arc::new(State {
            pids: Mutex::default(),
            is_over: AtomicBool::new(false),
            is_left: AtomicBool::new(false),
        });
        let keeper = Keeper {
            state: Arc::clone(&state),
            progress: Arc::clone(progress),
            muster: Muster::new(),
            leave: allowed(LEAVE, commands.len() as u32),
            key,
            threads,
            on_loss,
        };
        let (sender, begun) = channel();
        let thread = std::thread::Builder::new().name("launcher".to_owned()).spawn(move || {
            let (mut waiting, mut places) = (VecDeque::from(commands), Vec::new());
            let begun = keeper.start(&mut waiting, &mut places);
            let has_begun = begun.is_ok();
            if sender.send(begun).is_ok() && has_begun {
                keeper.keep(waiting, places);
            } else {
                end(places);
            }
        })?;
        begun.recv().context("the thread that starts processes has ended")??;
        Ok(Self {
            state,
            thread: Some(thread),
        })
    }

    /// The processes' ids.
    pub fn pids(&self) -> Vec<u32> {
        self.state.pids.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for all to leave, and ends those that do not.
    pub fn wait(mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
        self.join();
    }

    fn join(&mut self) {
        if let Some(thread) = self.thread.take() {
            let _panicked = thread.join().is_err();
        }
    }
}

impl Drop for Launcher {
    fn drop(&mut self) {
        self.state.is_left.store(true, Ordering::Relaxed);
        self.join();
    }
}

/// Looks after the processes.
struct Keeper {
    state: Arc<State>,
    progress: Arc<Progress>,
    muster: Muster,
    key: Option<Secret>,
    threads: Threads,
    on_loss: OnLoss,
    /// How long processes may take to leave by themselves.
    leave: Duration,
}

impl Keeper {
    /// How many of `waiting` processes may start now.
    fn turns(&self, waiting: usize, places: &[Place]) -> usize {
        let living = places.iter().filter(|place| place.child.is_some()).count();
        let there = self.progress.hosts.load(Ordering::Relaxed) as usize;
        self.muster.may_start(waiting, living, there)
    }

    /// Starts those of the `waiting` whose turn it is.
    fn start(&self, waiting: &mut VecDeque<Vec<String>>, places: &mut Vec<Place>) -> anyhow::Result<()> {
        let turns = self.turns(waiting.len(), places);
        for command in waiting.drain(..turns) {
            let child = launch::spawn(&command, self.key, self.threads)
                .with_context(|| format!("cannot start device process {}", places.len()))?;
            places.push(Place {
                command,
                child: Some(child),
                started: now(),
                short_lives: 0,
                due: None,
            });
        }
        if turns > 0 {
            self.show(places);
        }
        Ok(())
    }

    fn show(&self, places: &[Place]) {
        let pids = places.iter().filter_map(|place| place.child.as_ref()).map(Child::id);
        *self.state.pids.lock().unwrap_or_else(PoisonError::into_inner) = pids.collect();
    }

    fn keep(&self, mut waiting: VecDeque<Vec<String>>, mut places: Vec<Place>) {
        while !self.state.is_over.load(Ordering::Relaxed) && !self.state.is_left.load(Ordering::Relaxed) {
            if let Err(error) = self.start(&mut waiting, &mut places) {
                waiting.clear();
                self.give_up(format!("{error:#}"));
            }
            let mut has_changed = false;
            let has_ended = launch::has_one_ended();
            if has_ended {
                for place in &mut places {
                    has_changed |= self.look(place);
                }
            }
            let is_due = |place: &&mut Place| place.due.is_some_and(|due| now() >= due);
            let waiting = places.iter_mut().filter(is_due).count();
            let turns = if waiting > 0 { self.turns(waiting, &places) } else { 0 };
            for place in places.iter_mut().filter(is_due).take(turns) {
                self.start_anew(place);
                has_changed = true;
            }
            if has_changed {
                self.show(&places);
            }
            std::thread::sleep(LOOK);
        }
        let started = now();
        while started.elapsed() < self.leave && !self.state.is_left.load(Ordering::Relaxed) {
            places.retain_mut(|place| {
                place
                    .child
                    .as_mut()
                    .is_some_and(|child| matches!(child.try_wait(), Ok(None)))
            });
            if places.is_empty() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        if !self.state.is_left.load(Ordering::Relaxed) {
            tracing::warn!(processes = places.len(), "device processes did not leave by themselves");
        }
        end(places);
    }

    /// Looks at one process. Whether it has ended.
    fn look(&self, place: &mut Place) -> bool {
        if let Some(child) = &mut place.child
            && let Ok(Some(status)) = child.try_wait()
        {
            let pid = child.id();
            place.child = None;
            if !status.success() {
                self.mourn(place, pid, status);
            }
            return true;
        }
        false
    }

    fn start_anew(&self, place: &mut Place) {
        place.due = None;
        place.started = now();
        match launch::spawn(&place.command, self.key, self.threads) {
            Ok(child) => place.child = Some(child),
            Err(error) => self.give_up(format!("{error:#}")),
        }
    }

    /// A process has ended that should not have.
    fn mourn(&self, place: &mut Place, pid: u32, status: ExitStatus) {
        let why = format!("the device process with pid {pid} ended with {status}");
        match self.on_loss {
            OnLoss::End => return self.give_up(why),
            OnLoss::Continue if self.progress.has_begun.load(Ordering::Relaxed) => return note!("{why}"),
            OnLoss::Continue | OnLoss::Wait => {}
        }
        let is_short = place.started.elapsed() < LONG;
        place.short_lives = if is_short { place.short_lives + 1 } else { 0 };
        if place.short_lives >= SHORT_LIVES {
            return self.give_up(format!("{why}, as {} before it did in its place", SHORT_LIVES - 1));
        }
        let pause = if place.short_lives == 0 {
            Duration::ZERO
        } else {
            PAUSE * 2_u32.pow(place.short_lives - 1)
        };
        note!(
            "{why}; another one is started{}",
            if pause > PAUSE { " in a while" } else { "" }
        );
        place.due = Some(now() + pause);
    }

    fn give_up(&self, why: String) {
        // The first cause is the one that counts.
        let _told_before = self.progress.cause.set(why).is_err();
        self.progress.stop.store(true, Ordering::Relaxed);
    }
}

fn end(places: Vec<Place>) {
    for mut child in places.into_iter().filter_map(|place| place.child) {
        // Already gone is as good.
        let _gone = child.kill().is_err();
        let _reaped = child.wait().is_err();
    }
}
