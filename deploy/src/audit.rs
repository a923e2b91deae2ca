//! The replay of a run over the bus: it supplies the devices of lost hosts and audits the run. `commands::bs` starts
//! it; `lab/src/replay.rs` re-executes and compares. It also writes the input log, before an input takes effect.
//!
//! The run loop passes frames on at the start of each grant, so that the replay never passes a TTI that a takeover may
//! repeat. Under [`AuditArg::Auto`] it uses at most a twentieth of the time, as the help of `--audit` states, and can
//! lag behind; the rest is audited at the end only if that is quick.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::external::RecordedDecision;
use reveille_bs::server::{ReplaySource, RunProgress};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceRemoval, Frame, OperatorAction};
use reveille_common::totals::Ledger;
use reveille_common::units::Energy;
use reveille_lab::external_inputs::{ExternalInput, ExternalInputs};
use reveille_lab::replay::{DigestFrameEncoder, Divergence, Replay};

use crate::cli::AuditArg;
use crate::input_log::InputLog;
use crate::runtime::now;

/// The share of the time for an audit under [`AuditArg::Auto`]; `docs/command-line.md` repeats it.
const AUTO_TIME_SHARE: f64 = 0.05;
/// Least time that an audit may still take after the end of the run.
const END_ALLOWANCE: Duration = Duration::from_secs(2);
/// TTIs per replay step, which bounds how long the run waits for the lock.
const STEP_TTIS: u64 = 4096;
/// Most frames that may wait for the replay.
const MAX_QUEUED_FRAMES: u64 = 1 << 18;
/// Pause between two checks of a replay that has used up its share.
const THROTTLE_PAUSE: Duration = Duration::from_millis(20);

/// The outcome of an audit. Its text is `audit` in `summary.json`; `docs/command-line.md` and `tests/chaos/cases.py`
/// repeat it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum AuditOutcome {
    /// No audit was requested.
    Off,
    /// The whole run equals its replay.
    Complete,
    /// The TTIs before this one equal the replay; the rest would have cost too much.
    Partial(Tti),
}

impl std::fmt::Display for AuditOutcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Off => f.write_str("off"),
            Self::Complete => f.write_str("complete"),
            Self::Partial(tti) => write!(f, "partial: TTI {tti}"),
        }
    }
}

/// The frames of the TTIs before the given one.
type AuditBatch = (Tti, Vec<Frame>);

/// A shared handle to the replay.
#[derive(Clone)]
pub(crate) struct SharedReplay {
    replay: Arc<Mutex<Replay>>,
    input_log: Arc<Mutex<InputLog>>,
    /// Decisions and actions not yet added to the replay, so that the run does not wait for its lock.
    pending_inputs: Arc<Mutex<Vec<ExternalInput>>>,
}

impl SharedReplay {
    /// Locks the replay and adds all pending inputs.
    fn lock(&self) -> MutexGuard<'_, Replay> {
        let mut replay = self.replay.lock().unwrap_or_else(PoisonError::into_inner);
        // Taken under the replay's lock, so that inputs keep their order.
        let inputs = std::mem::take(&mut *self.pending_inputs.lock().unwrap_or_else(PoisonError::into_inner));
        for input in inputs {
            replay.add_input(input);
        }
        replay
    }

    /// Logs an input of a TTI that the replay has not reached, and adds it later.
    fn log_for_later(&self, input: ExternalInput) -> Result<(), String> {
        // Logged before it takes effect: a killed run must find it in the log.
        self.append_to_log(&input)?;
        let mut pending = self.pending_inputs.lock().unwrap_or_else(PoisonError::into_inner);
        pending.push(input);
        Ok(())
    }

    fn append_to_log(&self, input: &ExternalInput) -> Result<(), String> {
        let mut log = self.input_log.lock().unwrap_or_else(PoisonError::into_inner);
        log.add(input).map_err(|error| format!("{error:#}"))
    }
}

impl ReplaySource for SharedReplay {
    fn device_checkpoints(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<DeviceCheckpoint>, String> {
        Ok(self.lock().checkpoints(k, first, count))
    }

    fn outcome(&self, k: Tti) -> Result<RunOutcome, String> {
        Ok(self.lock().outcome(k))
    }

    fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, String> {
        Ok(self.lock().ledgers(k, first, count))
    }

    fn record_removal(&self, removal: &DeviceRemoval) -> Result<(), String> {
        let input = ExternalInput::Removal(*removal);
        // Logged before it takes effect: a killed run must find it in the log.
        self.append_to_log(&input)?;
        self.lock().add_input(input);
        Ok(())
    }

    fn record_decision(&self, decision: RecordedDecision) -> Result<(), String> {
        self.log_for_later(ExternalInput::Decision(decision))
    }

    fn record_actions(&self, actions: &[OperatorAction]) -> Result<(), String> {
        let inputs = actions.iter().copied().map(ExternalInput::Action);
        inputs.into_iter().try_for_each(|input| self.log_for_later(input))
    }
}

/// The start of a run over the bus.
pub(crate) struct AuditStart<'a> {
    /// The first TTI over the bus.
    pub from: Tti,
    /// The external inputs before it.
    pub inputs: &'a ExternalInputs,
    /// The log for later inputs.
    pub input_log: InputLog,
}

/// The replay of a run and its audit. Without an audit, `sender` and `thread` are `None`.
pub(crate) struct Auditor {
    replay: SharedReplay,
    sender: Option<Sender<AuditBatch>>,
    thread: Option<JoinHandle<Result<(), Divergence>>>,
    backlog: Arc<AuditBacklog>,
}

/// State shared by the run's loop and the audit thread.
#[derive(Default)]
struct AuditBacklog {
    /// Frames in the queue.
    queued_frames: AtomicU64,
    /// Working time of the replay, microseconds.
    busy_us: AtomicU64,
    /// End of the run.
    run_ended_at: OnceLock<Instant>,
    /// Whether the audit was abandoned because the queue was too long.
    is_abandoned: AtomicBool,
}

impl Auditor {
    /// Starts the replay of the `prepared` run, which enters the bus at `start`. A divergence stops the run of
    /// `progress`.
    pub(crate) fn start(
        prepared: &PreparedRun,
        start: AuditStart<'_>,
        mode: AuditArg,
        progress: &Arc<RunProgress>,
    ) -> Self {
        let is_audited = mode != AuditArg::Off;
        // Without an audit the replay compares nothing, but still supplies lost devices.
        let compared_from = if is_audited { start.from } else { Tti::NEVER };
        let replay = SharedReplay {
            replay: Arc::new(Mutex::new(Replay::new(prepared, start.inputs, compared_from))),
            input_log: Arc::new(Mutex::new(start.input_log)),
            pending_inputs: Arc::default(),
        };
        let backlog = Arc::new(AuditBacklog::default());
        let started = now();
        let (sender, thread) = if is_audited {
            let (sender, batches) = channel();
            let audit_thread = AuditThread {
                replay: replay.clone(),
                mode,
                started,
                backlog: Arc::clone(&backlog),
                progress: Arc::clone(progress),
            };
            (
                Some(sender),
                Some(std::thread::spawn(move || audit_thread.audit_batches(&batches))),
            )
        } else {
            (None, None)
        };
        Self {
            replay,
            sender,
            thread,
            backlog,
        }
    }

    /// The source of devices and outcomes for a takeover.
    pub(crate) fn replay_source(&self) -> Arc<dyn ReplaySource> {
        Arc::new(self.replay.clone())
    }

    /// Returns an observer that feeds the replay.
    pub(crate) fn observer(&self) -> AuditObserver {
        AuditObserver {
            encoder: DigestFrameEncoder::default(),
            frames: Vec::new(),
            sender: self.sender.clone(),
            backlog: Arc::clone(&self.backlog),
            unsent_end: None,
            last_sent: Tti::ZERO,
        }
    }

    /// Compares the outcome of the run and returns how much of the run was audited. Drop every [`AuditObserver`]
    /// first: this waits for the audit thread, which ends when no sender is left.
    ///
    /// # Errors
    /// The first divergence of the run from its replay.
    pub(crate) fn finish(mut self, outcome: &RunOutcome) -> Result<AuditOutcome, Divergence> {
        self.sender = None;
        // Set before the join, since it bounds how long the thread pauses.
        let _ended_before = self.backlog.run_ended_at.set(now()).is_err();
        let Some(thread) = self.thread.take() else {
            return Ok(AuditOutcome::Off);
        };
        match thread.join() {
            Ok(audited) => audited?,
            // A panic of the replay is a bug in Reveille, not a divergence.
            Err(panic) => std::panic::resume_unwind(panic),
        }
        let mut replay = self.replay.lock();
        if self.backlog.is_abandoned.load(Ordering::Relaxed) {
            return Ok(AuditOutcome::Partial(replay.compared_until()));
        }
        replay.compare_outcome(outcome)?;
        Ok(AuditOutcome::Complete)
    }
}

/// The end of a sentence about `divergence` that names the host of the diverging device; empty if unknown.
pub(crate) fn device_owner_clause(progress: &RunProgress, divergence: &Divergence) -> String {
    let host = divergence.device.and_then(|device| progress.owner_of(device));
    host.map_or_else(String::new, |host| format!("; the device runs on {host}"))
}

/// The thread that advances the replay.
struct AuditThread {
    replay: SharedReplay,
    mode: AuditArg,
    started: Instant,
    backlog: Arc<AuditBacklog>,
    progress: Arc<RunProgress>,
}

impl AuditThread {
    /// Compares every batch until the last sender is dropped. The first divergence stops the run and ends the thread.
    fn audit_batches(self, batches: &Receiver<AuditBatch>) -> Result<(), Divergence> {
        for (k, frames) in batches {
            self.backlog
                .queued_frames
                .fetch_sub(frames.len() as u64, Ordering::Relaxed);
            if self.backlog.is_abandoned.load(Ordering::Relaxed) {
                // The batches are still received, or the channel would grow without bound.
                self.replay.lock().stop_comparing();
                continue;
            }
            if let Err(divergence) = self.compare(k, &frames) {
                let reason = format!(
                    "audit failed: the run diverged from its replay at {divergence}{}",
                    device_owner_clause(&self.progress, &divergence)
                );
                self.progress.request_stop_because(reason);
                return Err(divergence);
            }
        }
        if self.backlog.is_abandoned.load(Ordering::Relaxed) {
            // The replay still supplies lost devices, but must not keep frames that nothing compares.
            self.replay.lock().stop_comparing();
        }
        Ok(())
    }

    /// Advances the replay to `k`, step by step, and compares `frames`, the frames of the TTIs before it. Returns early
    /// without a comparison if the audit is abandoned.
    fn compare(&self, k: Tti, frames: &[Frame]) -> Result<(), Divergence> {
        loop {
            if !self.wait_for_time_share() {
                self.backlog.is_abandoned.store(true, Ordering::Relaxed);
                return Ok(());
            }
            let started = now();
            // Locked for one step only: the run can ask for lost devices between two steps.
            let mut replay = self.replay.lock();
            let next = replay.next_tti();
            let step_end = k.min(next + STEP_TTIS);
            let is_last = step_end == k || next >= k;
            let result = if is_last {
                replay.compare(k, frames)
            } else {
                // Only advances the replay; the frames are compared in the last step.
                replay.compare(step_end, &[])
            };
            drop(replay);
            let step_us = started.elapsed().as_micros() as u64;
            self.backlog.busy_us.fetch_add(step_us, Ordering::Relaxed);
            result?;
            if is_last || self.backlog.is_abandoned.load(Ordering::Relaxed) {
                return Ok(());
            }
        }
    }

    /// Waits while the replay has used up its share. Returns false if the audit can no longer finish in time.
    fn wait_for_time_share(&self) -> bool {
        loop {
            let elapsed = self.started.elapsed().as_secs_f64();
            let busy = Duration::from_micros(self.backlog.busy_us.load(Ordering::Relaxed)).as_secs_f64();
            if self.mode == AuditArg::On || busy <= AUTO_TIME_SHARE * elapsed {
                return true;
            }
            if let Some(run_ended_at) = self.backlog.run_ended_at.get() {
                // After the end of the run the audit may take END_ALLOWANCE, or its share of the time if longer.
                return run_ended_at.elapsed().as_secs_f64()
                    < END_ALLOWANCE.as_secs_f64().max(AUTO_TIME_SHARE * elapsed);
            }
            std::thread::sleep(THROTTLE_PAUSE);
        }
    }
}

/// An observer that sends the run's frames to the replay.
pub(crate) struct AuditObserver {
    encoder: DigestFrameEncoder,
    frames: Vec<Frame>,
    sender: Option<Sender<AuditBatch>>,
    backlog: Arc<AuditBacklog>,
    /// The TTI after the last closed one, until it is sent.
    unsent_end: Option<Tti>,
    /// The end of the last batch that was sent.
    last_sent: Tti,
}

impl AuditObserver {
    /// Sends the frames of the TTIs before `k` that were not sent yet.
    fn send_frames(&mut self, k: Tti) {
        let Some(sender) = &self.sender else { return };
        let frames = std::mem::take(&mut self.frames);
        // A batch without frames is sent only once in STEP_TTIS, which keeps the replay close enough.
        if frames.is_empty() && k.0 < self.last_sent.0 + STEP_TTIS {
            return;
        }
        self.last_sent = k;
        let queued_frames = self
            .backlog
            .queued_frames
            .fetch_add(frames.len() as u64, Ordering::Relaxed);
        // A backlog of this size would fill the memory.
        if queued_frames > MAX_QUEUED_FRAMES {
            self.backlog.is_abandoned.store(true, Ordering::Relaxed);
            self.sender = None;
            return;
        }
        // A failed send means that the audit thread has ended with a divergence, which `finish` returns.
        let _thread_ended = sender.send((k, frames)).is_err();
    }
}

impl Drop for AuditObserver {
    fn drop(&mut self) {
        if let Some(k) = self.unsent_end.take() {
            // The frames of the last grant are compared too. In a run of at least `STEP_TTIS`, the 0 lets a batch
            // without frames pass as well, so that the audit thread advances the replay to the end.
            self.last_sent = Tti::ZERO;
            self.send_frames(k);
        }
    }
}

impl Observer for AuditObserver {
    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        if let Some(k) = self.unsent_end.take() {
            self.send_frames(k);
        }
        if self.sender.is_some() {
            self.frames.push(DigestFrameEncoder::batteries_frame(tti, batteries));
        }
    }

    fn notify(&mut self, notification: &Notification<'_>) {
        // A grant is sent when the next one begins: until then a lost host can make the run repeat it.
        if matches!(
            notification,
            Notification::ActionTaken(_) | Notification::PlanSent { .. } | Notification::TtisGranted(_)
        ) && let Some(k) = self.unsent_end.take()
        {
            self.send_frames(k);
        }
        if self.sender.is_some() {
            let frames = &mut self.frames;
            self.encoder.encode(notification, |frame| frames.push(frame));
        }
        if let Notification::TtiClosed(last) = notification {
            self.unsent_end = Some(*last + 1);
        }
    }
}
