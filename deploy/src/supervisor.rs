//! The supervised device processes of `up`: a process that ends is replaced by a new one, which takes over its devices.

use std::collections::VecDeque;
use std::process::{Child, ExitStatus};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use reveille_bs::server::{OnLoss, RunProgress};
use reveille_common::bus::scaled_timeout;
use reveille_common::secret::Secret;

use crate::child_process::{self, LEAVE, Threads};
use crate::display::note;
use crate::runtime::now;
use crate::start_limiter::StartLimiter;

/// Time between two checks of the processes.
const LOOK: Duration = Duration::from_millis(20);
/// First pause before a short-lived process is replaced, doubled each time.
const PAUSE: Duration = Duration::from_millis(100);
/// A process that ends within this time counts as short-lived.
const LONG: Duration = Duration::from_secs(5);
/// This many short-lived processes in a row in one slot end the run.
const SHORT_LIVES: u32 = 6;

/// State shared by the supervisor and its thread.
struct State {
    pids: Mutex<Vec<u32>>,
    /// The run has ended, and the processes leave.
    is_over: AtomicBool,
    /// The supervisor was dropped and waits no longer.
    is_left: AtomicBool,
}

/// The slot of one device process.
struct ProcessSlot {
    command: Vec<String>,
    child: Option<Child>,
    started: Instant,
    short_lives: u32,
    /// Start time of a replacement, if one is due.
    due: Option<Instant>,
}

/// The device processes of a run and the thread that supervises them. The kernel ends the processes when that thread
/// ends for any reason.
pub(crate) struct Supervisor {
    state: Arc<State>,
    thread: Option<JoinHandle<()>>,
}

/// Settings of the supervised processes.
pub(crate) struct SupervisorConfig {
    /// The arguments of each process.
    pub commands: Vec<Vec<String>>,
    /// The run's key, passed to the processes.
    pub key: Option<Secret>,
    /// zenoh's threads in the processes.
    pub threads: Threads,
    /// Reaction to a process that fails before the end of the run.
    pub on_loss: OnLoss,
}

impl Supervisor {
    /// Starts the processes, at most as many at a time as the machine can handle. Reads the number of joined hosts from
    /// `progress`. Sets the cause in `progress` if a process ends early and `on_loss` does not allow that, or
    /// replacements do not help.
    ///
    /// # Errors
    /// If one of the first processes cannot be started.
    pub(crate) fn start(orders: SupervisorConfig, progress: &Arc<RunProgress>) -> anyhow::Result<Self> {
        let SupervisorConfig {
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
        let keeper = SupervisorThread {
            state: Arc::clone(&state),
            progress: Arc::clone(progress),
            start_limiter: StartLimiter::new(),
            leave: scaled_timeout(LEAVE, commands.len() as u32),
            key,
            threads,
            on_loss,
        };
        let (sender, begun) = channel();
        // Every process is started on this thread, since the kernel ends a child with the thread that started it.
        let thread = std::thread::Builder::new().name("launcher".to_owned()).spawn(move || {
            let (mut waiting, mut places) = (VecDeque::from(commands), Vec::new());
            let begun = keeper.start(&mut waiting, &mut places);
            let has_begun = begun.is_ok();
            // If one of the first processes fails, those before it must not stay.
            if sender.send(begun).is_ok() && has_begun {
                keeper.keep(waiting, places);
            } else {
                end(places);
            }
        })?;
        begun
            .recv()
            .context("the thread that starts device processes has failed")??;
        Ok(Self {
            state,
            thread: Some(thread),
        })
    }

    /// The ids of the processes.
    pub(crate) fn pids(&self) -> Vec<u32> {
        self.state.pids.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for all processes to leave, and kills the rest.
    pub(crate) fn wait(mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
        self.join();
    }

    fn join(&mut self) {
        if let Some(thread) = self.thread.take() {
            let _panicked = thread.join().is_err();
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.state.is_left.store(true, Ordering::Relaxed);
        self.join();
    }
}

/// The supervising thread.
struct SupervisorThread {
    state: Arc<State>,
    progress: Arc<RunProgress>,
    start_limiter: StartLimiter,
    key: Option<Secret>,
    threads: Threads,
    on_loss: OnLoss,
    /// Time for the processes to leave on their own.
    leave: Duration,
}

impl SupervisorThread {
    /// The number of `waiting` processes that may start now.
    fn turns(&self, waiting: usize, places: &[ProcessSlot]) -> usize {
        let living = places.iter().filter(|place| place.child.is_some()).count();
        let there = self.progress.hosts.load(Ordering::Relaxed) as usize;
        self.start_limiter.allowed_starts(waiting, living, there)
    }

    /// Starts as many of the `waiting` processes as the limiter allows.
    fn start(&self, waiting: &mut VecDeque<Vec<String>>, places: &mut Vec<ProcessSlot>) -> anyhow::Result<()> {
        let turns = self.turns(waiting.len(), places);
        for command in waiting.drain(..turns) {
            let child = child_process::spawn(&command, self.key, self.threads)
                .with_context(|| format!("cannot start device process {}", places.len()))?;
            places.push(ProcessSlot {
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

    fn show(&self, places: &[ProcessSlot]) {
        let pids = places.iter().filter_map(|place| place.child.as_ref()).map(Child::id);
        *self.state.pids.lock().unwrap_or_else(PoisonError::into_inner) = pids.collect();
    }

    fn keep(&self, mut waiting: VecDeque<Vec<String>>, mut places: Vec<ProcessSlot>) {
        while !self.state.is_over.load(Ordering::Relaxed) && !self.state.is_left.load(Ordering::Relaxed) {
            if let Err(error) = self.start(&mut waiting, &mut places) {
                // Cleared, or every check would try again and fail.
                waiting.clear();
                self.give_up(format!("{error:#}"));
            }
            let mut has_changed = false;
            // One system call for all: a call for each of a thousand processes would cost more at every check.
            let has_ended = child_process::has_exited_child();
            if has_ended {
                for place in &mut places {
                    has_changed |= self.look(place);
                }
            }
            let is_due = |place: &&mut ProcessSlot| place.due.is_some_and(|due| now() >= due);
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
            tracing::warn!(
                processes = places.len(),
                "device processes did not exit in time and were killed"
            );
        }
        end(places);
    }

    /// Checks one process. Returns whether it has ended.
    fn look(&self, place: &mut ProcessSlot) -> bool {
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

    fn start_anew(&self, place: &mut ProcessSlot) {
        place.due = None;
        place.started = now();
        match child_process::spawn(&place.command, self.key, self.threads) {
            Ok(child) => place.child = Some(child),
            Err(error) => self.give_up(format!("{error:#}")),
        }
    }

    /// Handles a process that failed before the end of the run.
    fn mourn(&self, place: &mut ProcessSlot, pid: u32, status: ExitStatus) {
        let why = format!("the device process with pid {pid} ended with {status}");
        match self.on_loss {
            OnLoss::End => return self.give_up(why),
            // Before the run begins no device is lost, and another process takes the place.
            OnLoss::Continue if self.progress.has_begun.load(Ordering::Relaxed) => return note!("{why}"),
            OnLoss::Continue | OnLoss::Wait => {}
        }
        let is_short = place.started.elapsed() < LONG;
        place.short_lives = if is_short { place.short_lives + 1 } else { 0 };
        if place.short_lives >= SHORT_LIVES {
            return self.give_up(format!("{why}, as did {} processes before it", SHORT_LIVES - 1));
        }
        let pause = if place.short_lives == 0 {
            Duration::ZERO
        } else {
            // At most 1.6 s: SHORT_LIVES bounds the exponent.
            PAUSE * 2_u32.pow(place.short_lives - 1)
        };
        note!(
            "{why}; starting another process{}",
            if pause > PAUSE { " in a while" } else { "" }
        );
        place.due = Some(now() + pause);
    }

    fn give_up(&self, why: String) {
        // Only the first cause counts. It is set before `stop`, at which the run looks for it.
        let _told_before = self.progress.cause.set(why).is_err();
        self.progress.stop.store(true, Ordering::Relaxed);
    }
}

fn end(places: Vec<ProcessSlot>) {
    for mut child in places.into_iter().filter_map(|place| place.child) {
        // An error means that the child has already ended.
        let _gone = child.kill().is_err();
        let _reaped = child.wait().is_err();
    }
}
