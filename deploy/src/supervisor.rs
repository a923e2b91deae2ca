//! The supervised device processes of `up`: a process that fails is replaced by a new one, which takes over its
//! devices, unless `--on-loss` ends the run or continues without them. `child_process` starts a process,
//! `start_limiter` sets how many start together. `docs/command-line.md` states [`MAX_SHORT_LIVES`]. A process that ends
//! with exit code 0 is not replaced.

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

use crate::child_process::{self, EXIT_TIMEOUT, ZenohThreads};
use crate::display::note;
use crate::runtime::now;
use crate::start_limiter::StartLimiter;

/// Time between two checks of the processes.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// First pause before a short-lived process is replaced, doubled each time.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// A process that ends within this time counts as short-lived.
const SHORT_LIFE: Duration = Duration::from_secs(5);
/// This many short-lived processes in a row in one slot end the run.
const MAX_SHORT_LIVES: u32 = 6;

/// State shared by the supervisor and its thread.
struct SupervisorState {
    /// The ids of the running processes, for the measurement of their memory.
    pids: Mutex<Vec<u32>>,
    /// The run has ended, and the processes leave.
    is_over: AtomicBool,
    /// The supervisor was dropped and waits no longer.
    is_dropped: AtomicBool,
}

/// The slot of one device process.
struct ProcessSlot {
    command: Vec<String>,
    child: Option<Child>,
    /// Start time of the current or last process.
    started: Instant,
    /// The number of short-lived processes in a row, up to [`MAX_SHORT_LIVES`].
    short_lives: u32,
    /// Start time of a replacement, if one is due.
    restart_at: Option<Instant>,
}

/// The device processes of a run and the thread that supervises them. The kernel ends the processes when that thread
/// ends for any reason.
pub(crate) struct Supervisor {
    state: Arc<SupervisorState>,
    thread: Option<JoinHandle<()>>,
}

/// Settings of the supervised processes.
pub(crate) struct SupervisorConfig {
    /// The arguments of each process.
    pub commands: Vec<Vec<String>>,
    /// The run's key, passed to the processes.
    pub key: Option<Secret>,
    /// zenoh's threads in the processes.
    pub threads: ZenohThreads,
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
    pub(crate) fn start(config: SupervisorConfig, progress: &Arc<RunProgress>) -> anyhow::Result<Self> {
        let SupervisorConfig {
            commands,
            key,
            threads,
            on_loss,
        } = config;
        let state = Arc::new(SupervisorState {
            pids: Mutex::default(),
            is_over: AtomicBool::new(false),
            is_dropped: AtomicBool::new(false),
        });
        let supervising = SupervisorThread {
            state: Arc::clone(&state),
            progress: Arc::clone(progress),
            start_limiter: StartLimiter::new(),
            exit_timeout: scaled_timeout(EXIT_TIMEOUT, commands.len() as u32),
            key,
            threads,
            on_loss,
        };
        let (sender, first_starts) = channel();
        // Every process is started on this thread, since the kernel ends a child with the thread that started it.
        let thread = std::thread::Builder::new().name("launcher".to_owned()).spawn(move || {
            let (mut waiting, mut slots) = (VecDeque::from(commands), Vec::new());
            let started = supervising.start_waiting(&mut waiting, &mut slots);
            let has_started = started.is_ok();
            // If one of the first processes fails, those before it must not stay.
            if sender.send(started).is_ok() && has_started {
                supervising.supervise(waiting, slots);
            } else {
                kill_all(slots);
            }
        })?;
        first_starts
            .recv()
            .context("the thread that starts device processes has failed")??;
        Ok(Self {
            state,
            thread: Some(thread),
        })
    }

    /// The ids of the running processes; a process can have ended since the last check.
    pub(crate) fn pids(&self) -> Vec<u32> {
        self.state.pids.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for all processes to leave, and kills the rest. Call it once the base station has dismissed the hosts.
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
        self.state.is_dropped.store(true, Ordering::Relaxed);
        self.join();
    }
}

/// The supervising thread.
struct SupervisorThread {
    state: Arc<SupervisorState>,
    progress: Arc<RunProgress>,
    start_limiter: StartLimiter,
    key: Option<Secret>,
    threads: ZenohThreads,
    on_loss: OnLoss,
    /// Time for the processes to leave on their own.
    exit_timeout: Duration,
}

impl SupervisorThread {
    /// The number of `waiting` processes that may start now.
    fn allowed_starts_now(&self, waiting: usize, slots: &[ProcessSlot]) -> usize {
        let living = slots.iter().filter(|slot| slot.child.is_some()).count();
        let joined = self.progress.active_host_count.load(Ordering::Relaxed) as usize;
        self.start_limiter.allowed_starts(waiting, living, joined)
    }

    /// Starts as many of the `waiting` processes as the limiter allows.
    fn start_waiting(&self, waiting: &mut VecDeque<Vec<String>>, slots: &mut Vec<ProcessSlot>) -> anyhow::Result<()> {
        let allowed_starts_now = self.allowed_starts_now(waiting.len(), slots);
        for command in waiting.drain(..allowed_starts_now) {
            let child = child_process::spawn(&command, self.key, self.threads)
                .with_context(|| format!("cannot start device process {}", slots.len()))?;
            slots.push(ProcessSlot {
                command,
                child: Some(child),
                started: now(),
                short_lives: 0,
                restart_at: None,
            });
        }
        if allowed_starts_now > 0 {
            self.publish_pids(slots);
        }
        Ok(())
    }

    fn publish_pids(&self, slots: &[ProcessSlot]) {
        let pids = slots.iter().filter_map(|slot| slot.child.as_ref()).map(Child::id);
        *self.state.pids.lock().unwrap_or_else(PoisonError::into_inner) = pids.collect();
    }

    /// Replaces failed processes until the run is over, then waits for all of them to leave.
    fn supervise(&self, mut waiting: VecDeque<Vec<String>>, mut slots: Vec<ProcessSlot>) {
        while !self.state.is_over.load(Ordering::Relaxed) && !self.state.is_dropped.load(Ordering::Relaxed) {
            if let Err(error) = self.start_waiting(&mut waiting, &mut slots) {
                // Cleared, or every check would try again and fail.
                waiting.clear();
                self.progress.request_stop_because(format!("{error:#}"));
            }
            let mut have_pids_changed = false;
            // One system call for all: a call for each of a thousand processes would cost more at every check.
            if child_process::has_exited_child() {
                for slot in &mut slots {
                    have_pids_changed |= self.reap(slot);
                }
            }
            let is_due = |slot: &&mut ProcessSlot| slot.restart_at.is_some_and(|restart_at| now() >= restart_at);
            let due_slots = slots.iter_mut().filter(is_due).count();
            let allowed_starts_now = if due_slots > 0 {
                self.allowed_starts_now(due_slots, &slots)
            } else {
                0
            };
            for slot in slots.iter_mut().filter(is_due).take(allowed_starts_now) {
                self.restart(slot);
                have_pids_changed = true;
            }
            if have_pids_changed {
                self.publish_pids(&slots);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        let run_end = now();
        while run_end.elapsed() < self.exit_timeout && !self.state.is_dropped.load(Ordering::Relaxed) {
            slots.retain_mut(|slot| {
                slot.child
                    .as_mut()
                    .is_some_and(|child| matches!(child.try_wait(), Ok(None)))
            });
            if slots.is_empty() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        if !self.state.is_dropped.load(Ordering::Relaxed) {
            tracing::warn!(
                processes = slots.len(),
                "device processes did not exit in time and were killed"
            );
        }
        kill_all(slots);
    }

    /// Checks the process of `slot`, and handles its end. Returns whether it has ended since the last check.
    fn reap(&self, slot: &mut ProcessSlot) -> bool {
        if let Some(child) = &mut slot.child
            && let Ok(Some(status)) = child.try_wait()
        {
            let pid = child.id();
            slot.child = None;
            if !status.success() {
                self.handle_failure(slot, pid, status);
            }
            return true;
        }
        false
    }

    /// Starts another process in `slot`.
    fn restart(&self, slot: &mut ProcessSlot) {
        slot.restart_at = None;
        slot.started = now();
        match child_process::spawn(&slot.command, self.key, self.threads) {
            Ok(child) => slot.child = Some(child),
            Err(error) => self.progress.request_stop_because(format!("{error:#}")),
        }
    }

    /// Handles a process that failed before the end of the run: stops the run, drops the process, or sets
    /// [`ProcessSlot::restart_at`].
    fn handle_failure(&self, slot: &mut ProcessSlot, pid: u32, status: ExitStatus) {
        let why = format!("the device process with pid {pid} ended with {status}");
        match self.on_loss {
            OnLoss::End => return self.progress.request_stop_because(why),
            // Before the run begins no device is lost, and another process takes the slot.
            OnLoss::Continue if self.progress.has_begun.load(Ordering::Relaxed) => return note!("{why}"),
            OnLoss::Continue | OnLoss::Wait => {}
        }
        let is_short = slot.started.elapsed() < SHORT_LIFE;
        slot.short_lives = if is_short { slot.short_lives + 1 } else { 0 };
        if slot.short_lives >= MAX_SHORT_LIVES {
            return self
                .progress
                .request_stop_because(format!("{why}, as did {} processes before it", MAX_SHORT_LIVES - 1));
        }
        let pause = if slot.short_lives == 0 {
            Duration::ZERO
        } else {
            // At most 1.6 s: MAX_SHORT_LIVES bounds the exponent.
            FIRST_PAUSE * 2_u32.pow(slot.short_lives - 1)
        };
        if pause > FIRST_PAUSE {
            note!("{why}; starting another process in {:.1} s", pause.as_secs_f64());
        } else {
            note!("{why}; starting another process");
        }
        slot.restart_at = Some(now() + pause);
    }
}

fn kill_all(slots: Vec<ProcessSlot>) {
    for mut child in slots.into_iter().filter_map(|slot| slot.child) {
        // An error means that the child has already ended.
        let _gone = child.kill().is_err();
        let _reaped = child.wait().is_err();
    }
}
