//! The shadow of a run over the bus: it gives back the devices of a lost process, and audits what was heard.
//!
//! The BS's loop tells what it notes at the beginning of each grant, so that the shadow never is beyond a TTI that may
//! have to be asked again. A thread follows. Under [`AuditArg::Auto`] it takes a twentieth of the time at the most and
//! lags behind if that is not enough; what is left at the end is audited only if that is quick.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use reveille_bs::host::{Progress, Replay};
use reveille_bs::observe::{Happening, Observer};
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::external::Answered;
use reveille_bs::prepared::Prepared;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, Frame, Outage};
use reveille_common::totals::Ledger;
use reveille_common::units::Energy;
use reveille_lab::inputs::{Input, Inputs};
use reveille_lab::shadow::{Difference, Noting, Shadow};

use crate::cli::AuditArg;
use crate::input_log::InputLog;
use crate::wall::now;

/// The share of the time that an audit may take by default.
const SHARE: f64 = 0.05;
/// What an audit may take at the end besides.
const SHORT: Duration = Duration::from_secs(2);
/// TTIs that the shadow does at a time, so that nobody waits for it for long.
const STEP: u64 = 4096;
/// Frames that wait for the shadow at the most.
const QUEUE: u64 = 1 << 18;
/// Time between two looks of a shadow that has used up its share.
const REST: Duration = Duration::from_millis(20);

/// What has come of an audit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Audited {
    /// None was asked for.
    Off,
    /// All of the run is what a replay is.
    Whole,
    /// The TTIs before this one are; the rest would have cost too much.
    Before(Tti),
}

impl std::fmt::Display for Audited {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Off => f.write_str("off"),
            Self::Whole => f.write_str("whole"),
            Self::Before(tti) => write!(f, "before TTI {tti}"),
        }
    }
}

/// What was noted in the TTIs before one.
type Batch = (Tti, Vec<Frame>);

/// A shadow that others may ask.
#[derive(Clone)]
pub struct Shared {
    shadow: Arc<Mutex<Shadow>>,
    log: Arc<Mutex<InputLog>>,
    /// Decisions that the shadow has not been told: the run does not wait for it.
    decided: Arc<Mutex<Vec<Answered>>>,
}

impl Shared {
    /// The shadow, which knows all that has been decided.
    fn lock(&self) -> MutexGuard<'_, Shadow> {
        let mut shadow = self.shadow.lock().unwrap_or_else(PoisonError::into_inner);
        let decided = std::mem::take(&mut *self.decided.lock().unwrap_or_else(PoisonError::into_inner));
        for decision in decided {
            shadow.hear(Input::Decision(decision));
        }
        shadow
    }

    fn log(&self, input: &Input) -> Result<(), String> {
        let mut log = self.log.lock().unwrap_or_else(PoisonError::into_inner);
        log.add(input).map_err(|error| format!("{error:#}"))
    }
}

impl Replay for Shared {
    fn devices(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Checkpoint>, String> {
        Ok(self.lock().devices(k, first, count))
    }

    fn outcome(&self, k: Tti) -> Result<Outcome, String> {
        Ok(self.lock().outcome(k))
    }

    fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, String> {
        Ok(self.lock().ledgers(k, first, count))
    }

    fn lose(&self, outage: &Outage) -> Result<(), String> {
        let input = Input::Outage(*outage);
        self.log(&input)?;
        self.lock().hear(input);
        Ok(())
    }

    fn decided(&self, decision: Answered) -> Result<(), String> {
        let input = Input::Decision(decision);
        self.log(&input)?;
        if let Input::Decision(decision) = input {
            self.decided
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .push(decision);
        }
        Ok(())
    }
}

/// How a run over the bus begins.
pub struct Beginning<'a> {
    /// Its first TTI there.
    pub from: Tti,
    /// What it has had of inputs before.
    pub inputs: &'a Inputs,
    /// Where those that come are kept.
    pub log: InputLog,
}

/// The shadow of a run, and the audit that it makes.
pub struct Auditor {
    shadow: Shared,
    sender: Option<Sender<Batch>>,
    thread: Option<JoinHandle<Result<(), Difference>>>,
    flow: Arc<Flow>,
}

/// What the loop and the shadow's thread know of each other.
#[derive(Default)]
struct Flow {
    /// Frames that wait.
    waiting: AtomicU64,
    /// Microseconds that the shadow has worked.
    busy: AtomicU64,
    /// When the run ended.
    over: OnceLock<Instant>,
    /// Too much waited: no audit.
    is_given_up: AtomicBool,
}

impl Auditor {
    /// The shadow of the run that is `prepared` and goes over the bus as `start` says. It stops the run of `progress`
    /// if that is not what a replay is.
    pub fn start(prepared: &Prepared, start: Beginning<'_>, how: AuditArg, progress: &Arc<Progress>) -> Self {
        let is_audited = how != AuditArg::Off;
        let from = if is_audited { start.from } else { Tti::NEVER };
        let shadow = Shared {
            shadow: Arc::new(Mutex::new(Shadow::new(prepared, start.inputs, from))),
            log: Arc::new(Mutex::new(start.log)),
            decided: Arc::default(),
        };
        let flow = Arc::new(Flow::default());
        let begun = now();
        let (sender, thread) = if is_audited {
            let (sender, batches) = channel();
            let follower = Follower {
                shadow: shadow.clone(),
                how,
                begun,
                flow: Arc::clone(&flow),
                progress: Arc::clone(progress),
            };
            (
                Some(sender),
                Some(std::thread::spawn(move || follower.follow(&batches))),
            )
        } else {
            (None, None)
        };
        Self {
            shadow,
            sender,
            thread,
            flow,
        }
    }

    /// What can be asked for devices and outcomes.
    pub fn replay(&self) -> Arc<dyn Replay> {
        Arc::new(self.shadow.clone())
    }

    /// Tells the shadow what happens.
    pub fn ear(&self) -> Ear {
        Ear {
            noting: Noting::default(),
            frames: Vec::new(),
            sender: self.sender.clone(),
            flow: Arc::clone(&self.flow),
            closed: None,
            told: Tti::ZERO,
        }
    }

    /// Compares the outcome of the run, and says how much of the run was audited.
    ///
    /// # Errors
    /// The first difference between the run and a replay.
    pub fn finish(mut self, outcome: &Outcome) -> Result<Audited, Difference> {
        self.sender = None;
        let _ended_before = self.flow.over.set(now()).is_err();
        let Some(thread) = self.thread.take() else {
            return Ok(Audited::Off);
        };
        if let Ok(Err(difference)) = thread.join() {
            return Err(difference);
        }
        let mut shadow = self.shadow.lock();
        if self.flow.is_given_up.load(Ordering::Relaxed) {
            return Ok(Audited::Before(shadow.compared()));
        }
        shadow.conclude(outcome)?;
        Ok(Audited::Whole)
    }
}

/// Whose device a difference is about, as the end of a sentence, if that is known.
pub fn whose(progress: &Progress, difference: &Difference) -> String {
    let host = difference.device.and_then(|device| progress.carrier(device));
    host.map_or_else(String::new, |host| format!(". {host} carries that device"))
}

/// The thread that lets the shadow follow.
struct Follower {
    shadow: Shared,
    how: AuditArg,
    begun: Instant,
    flow: Arc<Flow>,
    progress: Arc<Progress>,
}

impl Follower {
    fn follow(self, batches: &Receiver<Batch>) -> Result<(), Difference> {
        for (k, frames) in batches {
            self.flow.waiting.fetch_sub(frames.len() as u64, Ordering::Relaxed);
            if self.flow.is_given_up.load(Ordering::Relaxed) {
                self.shadow.lock().forget();
                continue;
            }
            if let Err(difference) = self.compare(k, &frames) {
                let why = format!(
                    "the run is not what it should be. {difference}{}",
                    whose(&self.progress, &difference)
                );
                // The first cause is the one that counts.
                let _told_before = self.progress.cause.set(why).is_err();
                self.progress.stop.store(true, Ordering::Relaxed);
                return Err(difference);
            }
        }
        if self.flow.is_given_up.load(Ordering::Relaxed) {
            // It is still asked for lost devices, and must not keep what nobody compares.
            self.shadow.lock().forget();
        }
        Ok(())
    }

    fn compare(&self, k: Tti, frames: &[Frame]) -> Result<(), Difference> {
        loop {
            if !self.may_go_on() {
                self.flow.is_given_up.store(true, Ordering::Relaxed);
                return Ok(());
            }
            let started = now();
            let mut shadow = self.shadow.lock();
            let next = shadow.next_tti();
            let to = k.min(next + STEP);
            let is_last = to == k || next >= k;
            let compared = if is_last {
                shadow.compare(k, frames)
            } else {
                shadow.compare(to, &[])
            };
            drop(shadow);
            let took = started.elapsed().as_micros() as u64;
            self.flow.busy.fetch_add(took, Ordering::Relaxed);
            compared?;
            if is_last || self.flow.is_given_up.load(Ordering::Relaxed) {
                return Ok(());
            }
        }
    }

    /// Waits while the shadow has used up its share. False if that is no use any more.
    fn may_go_on(&self) -> bool {
        loop {
            let elapsed = self.begun.elapsed().as_secs_f64();
            let busy = Duration::from_micros(self.flow.busy.load(Ordering::Relaxed)).as_secs_f64();
            if self.how == AuditArg::On || busy <= SHARE * elapsed {
                return true;
            }
            if let Some(over) = self.flow.over.get() {
                return over.elapsed().as_secs_f64() < SHORT.as_secs_f64().max(SHARE * elapsed);
            }
            std::thread::sleep(REST);
        }
    }
}

/// An observer that tells the shadow what the run notes.
pub struct Ear {
    noting: Noting,
    frames: Vec<Frame>,
    sender: Option<Sender<Batch>>,
    flow: Arc<Flow>,
    /// The TTI after the last that is closed, if it has not been told of.
    closed: Option<Tti>,
    told: Tti,
}

impl Ear {
    fn tell(&mut self, k: Tti) {
        let Some(sender) = &self.sender else { return };
        let frames = std::mem::take(&mut self.frames);
        if frames.is_empty() && k.0 < self.told.0 + STEP {
            return;
        }
        self.told = k;
        let waiting = self.flow.waiting.fetch_add(frames.len() as u64, Ordering::Relaxed);
        if waiting > QUEUE {
            self.flow.is_given_up.store(true, Ordering::Relaxed);
            self.sender = None;
            return;
        }
        let _gone = sender.send((k, frames)).is_err();
    }
}

impl Drop for Ear {
    fn drop(&mut self) {
        if let Some(k) = self.closed.take() {
            // What came of the last grant.
            self.told = Tti::ZERO;
            self.tell(k);
        }
    }
}

impl Observer for Ear {
    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        if let Some(k) = self.closed.take() {
            self.tell(k);
        }
        if self.sender.is_some() {
            self.frames.push(Noting::told(tti, batteries));
        }
    }

    fn see(&mut self, happening: &Happening<'_>) {
        if matches!(happening, Happening::Plan { .. } | Happening::Granted(_))
            && let Some(k) = self.closed.take()
        {
            self.tell(k);
        }
        if self.sender.is_some() {
            let frames = &mut self.frames;
            self.noting.of(happening, |frame| frames.push(frame));
        }
        if let Happening::Closed(last) = happening {
            self.closed = Some(*last + 1);
        }
    }
}
