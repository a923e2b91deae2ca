//! A host process: joins a run, runs the devices of its assignment, and answers the grants for all of them.
//!
//! In a TTI without a stimulus the host answers immediately; its devices catch up when they are next needed. In a TTI
//! with a stimulus it wakes the actors of the devices that have δ = 1 and are within range. The last of them to finish
//! sends the answer.

pub(crate) mod actor;
pub mod answer_round;
mod dispatch;
mod join;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, DeclarationGuard};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    BusCredentials, ClockMessage, GrantMessage, HostSetup, PlanUpdate, Ready, ResumePoint, WakeUp,
};
use tokio::runtime::Handle;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::watch;

use self::actor::{Actor, DeviceCommand};
use self::answer_round::{DeviceAnswer, Round, Uplink};
use self::dispatch::{Dispatcher, HostMessage};
use crate::grant_follower::{Disposition, FollowerStart, GrantFollower, GrantTask, HostRequest, WakeUpTask};
use crate::machine::{Machine, Physics};

pub use self::join::{HostConfig, HostEvent, run_host};

/// Time limit for asking a base station that is back whether it still knows this host. A restarted base station serves
/// other keys, so no answer comes. This shows immediately, because its token follows everything that it answers. A host
/// that gives up too soon needs a new assignment.
const ANOTHER: Duration = Duration::from_secs(1);

/// A reason why a host cannot do its work.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The base station refused the join request.
    #[error("the base station refused: {0}")]
    Refused(String),
    /// The base station sent an invalid assignment.
    #[error("invalid assignment from the base station: {0}")]
    Assignment(String),
    /// A device task has ended, which is a bug in Reveille.
    #[error("a device task failed, which is a bug; please report the lines above")]
    DeviceFailed,
    /// The base station reports that the run has failed.
    #[error("the run has failed: {0}")]
    RunFailed(String),
    /// The base station is lost.
    #[error(
        "lost the base station of run {run} after TTI {tti}: its process ended or the link broke, and it did not come \
            back within {patience:?}"
    )]
    BsLost {
        /// The run's name.
        run: String,
        /// The last TTI granted.
        tti: Tti,
        /// The time limit of the host's wait.
        patience: Duration,
    },
}

/// The state of a host.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Progress {
    Running,
    BsMissing,
    /// The base station, or its replacement, is back.
    BsBack,
    DeviceFailed,
    Dismissed,
    RunFailed(String),
}

/// The reason why a host stops running its devices.
enum HostExit {
    /// The run is over.
    Dismissed,
    /// The base station has assigned the devices to another host, or has been replaced.
    Replaced,
}

/// Reports a panic in a device task, which tokio would otherwise hide.
struct PanicGuard(watch::Sender<Progress>);

impl Drop for PanicGuard {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.send_modify(|progress| *progress = Progress::DeviceFailed);
        }
    }
}

/// The state of a host, shared by the callbacks of its subscriptions.
struct Shared {
    membership: BusCredentials,
    fallback: Handle,
    mailboxes: Vec<UnboundedSender<DeviceCommand>>,
    uplink: Arc<Uplink>,
    state: Mutex<HostState>,
    progress: watch::Sender<Progress>,
}

struct HostState {
    /// Actors that are not started yet; see [`Shared::start_actors`].
    resting: Vec<(Actor, UnboundedReceiver<DeviceCommand>)>,
    follower: GrantFollower,
    /// The answer to the last request.
    round: Option<Arc<Round>>,
}

impl Shared {
    fn new(bus: &Bus, assignment: HostSetup) -> Result<Self, HostError> {
        let HostSetup {
            membership,
            resumption,
            seed,
            ttis,
            measured_from,
            sensing,
            radio,
            devices,
            traces,
        } = assignment;
        let uplink = Arc::new(Uplink::new(bus, membership.pass)?);
        let d_max = sensing.d_max;
        let physics = Arc::new(Physics::new(seed, measured_from, sensing, radio, &devices, traces));
        let machines: Vec<Machine> = match &resumption {
            None => devices.iter().map(|setup| Machine::new(setup, &physics)).collect(),
            Some(resumption) => devices
                .iter()
                .zip(&resumption.devices)
                .map(|(setup, checkpoint)| Machine::from_checkpoint(setup, &physics, checkpoint))
                .collect::<Result<_, _>>()
                .map_err(HostError::Assignment)?,
        };
        let beginning = FollowerStart {
            first: devices.first().map_or(DeviceId(0), |d| d.id),
            positions: devices.iter().map(|d| d.position).collect(),
            duties: machines.iter().map(Machine::duty).collect(),
            at: resumption.map_or(ResumePoint::default(), |resumption| resumption.at),
        };
        let (mut resting, mut mailboxes) = (Vec::new(), Vec::new());
        for machine in machines {
            // Unbounded, because the thread that delivers messages must not wait for a device.
            let (mailbox, inputs) = unbounded_channel();
            mailboxes.push(mailbox);
            resting.push((Actor::new(machine, Arc::clone(&physics), Arc::clone(&uplink)), inputs));
        }
        let state = Mutex::new(HostState {
            resting,
            follower: GrantFollower::new(beginning, d_max, Tti(ttis), seed, &radio),
            round: None,
        });
        Ok(Self {
            membership,
            fallback: Handle::current(),
            mailboxes,
            uplink,
            state,
            progress: watch::Sender::new(Progress::Running),
        })
    }

    /// Declares all subscriptions of this host, then its liveliness token. The token comes last, so that every
    /// subscription is in place when the base station sees it.
    fn declare(self: &Arc<Self>, bus: &Bus, ear: Dispatcher) -> Result<Vec<DeclarationGuard>, BusError> {
        let keys = bus.keys();
        let mut declared = Vec::new();
        let host = self.membership.pass.host;
        let hear = ear.clone();
        declared.push(bus.subscribe(host, move |update: PlanUpdate| hear.dispatch(HostMessage::Plan(update)))?);
        let hear = ear.clone();
        declared.push(bus.subscribe_wakes(host, move |device, wake| hear.dispatch(HostMessage::Wake(device, wake)))?);
        declared.push(bus.subscribe(host, move |clock: ClockMessage| ear.dispatch(HostMessage::Clock(clock)))?);
        let this = Arc::clone(self);
        declared.push(bus.watch_alive(keys.bs_alive(), move |_, alive| this.on_bs(alive))?);
        declared.push(bus.declare_alive(keys.alive(self.membership.pass))?);
        Ok(declared)
    }

    /// Waits until the base station dismisses the host, reassigns its devices, or is lost for longer than `patience`.
    async fn stay(&self, bus: &Bus, patience: Duration) -> Result<HostExit, HostError> {
        let mut progress = self.progress.subscribe();
        loop {
            let now = progress.borrow_and_update().clone();
            let changed = match now {
                Progress::Dismissed => return Ok(HostExit::Dismissed),
                Progress::RunFailed(why) => return Err(HostError::RunFailed(why)),
                Progress::DeviceFailed => return Err(HostError::DeviceFailed),
                Progress::Running => progress.changed().await.is_ok(),
                Progress::BsMissing => tokio::time::timeout(patience, progress.changed()).await.is_ok(),
                Progress::BsBack => {
                    if !self.is_still_known(bus, patience).await? {
                        return Ok(HostExit::Replaced);
                    }
                    // Only if nothing else has happened meanwhile, such as a second loss of the base station.
                    self.progress.send_if_modified(|progress| {
                        let is_back = *progress == Progress::BsBack;
                        if is_back {
                            *progress = Progress::Running;
                        }
                        is_back
                    });
                    true
                }
            };
            if !changed {
                return Err(HostError::BsLost {
                    run: bus.keys().run().to_string(),
                    tti: self.lock().follower.granted(),
                    patience,
                });
            }
        }
    }

    /// Returns whether the base station still counts on this host. A restarted one serves other keys and does not
    /// answer.
    async fn is_still_known(&self, bus: &Bus, patience: Duration) -> Result<bool, BusError> {
        let pass = self.membership.pass;
        let ready = Ready { host: pass.host };
        let patience = patience.min(ANOTHER);
        Ok(bus.query_until(&ready, Some(pass.token), patience).await? == Some(true))
    }

    fn on_bs(&self, alive: bool) {
        self.progress.send_modify(|progress| match (&progress, alive) {
            (Progress::Dismissed | Progress::RunFailed(_) | Progress::DeviceFailed, _)
            | (Progress::Running | Progress::BsBack, true) => {}
            (Progress::Running | Progress::BsMissing | Progress::BsBack, false) => *progress = Progress::BsMissing,
            (Progress::BsMissing, true) => *progress = Progress::BsBack,
        });
    }

    /// Starts the actors on the runtime that processes this host's messages. A message then wakes its actor without a
    /// switch to another thread, which would cost more than the actor's work.
    fn start_actors(&self, state: &mut HostState) {
        if state.resting.is_empty() {
            return;
        }
        let runtime = Handle::try_current().unwrap_or_else(|_| self.fallback.clone());
        for (actor, inputs) in state.resting.drain(..) {
            let obituary = PanicGuard(self.progress.clone());
            runtime.spawn(async move {
                let _obituary = obituary;
                actor.run(inputs).await;
            });
        }
    }

    fn dispatch(&self, heard: HostMessage) {
        match heard {
            HostMessage::Plan(update) => self.on_plan(update),
            HostMessage::Wake(device, wake) => self.on_wake(device, wake),
            HostMessage::Clock(clock) => self.on_clock(clock),
        }
    }

    fn on_plan(&self, update: PlanUpdate) {
        let from = update.from;
        if !self.lock().follower.receive_plan(update) {
            tracing::debug!(%from, "ignored a plan for another TTI, usually a resent one");
        }
    }

    fn on_wake(&self, device: DeviceId, wake: WakeUp) {
        let woken = self.lock().follower.receive_wake_up(device, wake);
        if let Some(WakeUpTask { device, tti, stimulus }) = woken {
            self.send(device, DeviceCommand::Wake(tti, stimulus));
        } else {
            tracing::debug!(%device, tti = %wake.tti, "ignored a wake-up for another TTI or host");
        }
    }

    fn on_clock(&self, clock: ClockMessage) {
        match clock {
            ClockMessage::Grant(tick) => self.on_grant(tick),
            ClockMessage::CollectLedgers(end) => self.on_finish(end),
            ClockMessage::Dismiss => self.leave(Progress::Dismissed),
            ClockMessage::RunFailed(why) => self.leave(Progress::RunFailed(why)),
        }
    }

    /// Records how the run has ended. The base station's first message counts, unless a device has failed before.
    fn leave(&self, end: Progress) {
        self.progress.send_modify(|progress| match progress {
            Progress::Dismissed | Progress::RunFailed(_) | Progress::DeviceFailed => {}
            Progress::Running | Progress::BsMissing | Progress::BsBack => *progress = end,
        });
    }

    fn on_grant(&self, tick: GrantMessage) {
        let Some((state, turn)) = self.heed(|follower| follower.receive_grant(tick)) else {
            return;
        };
        let GrantTask { changes, listeners } = turn;
        let questions = usize::from(tick.account) + usize::from(tick.views);
        let parts = questions * self.mailboxes.len() + listeners.len();
        let round = self.begin(state, HostRequest::Grant(tick.last), parts);
        // The order matters: `Settle` at `first` would panic after a later δ, and views show the state after sensing.
        if tick.account {
            for j in 0..self.mailboxes.len() {
                self.send(j, DeviceCommand::AdvanceTo(tick.first, Arc::clone(&round)));
            }
        }
        for (j, from, duty) in changes {
            self.send(j, DeviceCommand::Duty(from, duty));
        }
        if let Some(stimulus) = tick.stimulus {
            for j in listeners {
                self.send(j, DeviceCommand::Sense(tick.last, stimulus, Arc::clone(&round)));
            }
        }
        if tick.views {
            for j in 0..self.mailboxes.len() {
                self.send(j, DeviceCommand::View(tick.last, Arc::clone(&round)));
            }
        }
        // The host's own part. It completes the answer if no device has a part in it.
        round.add(&DeviceAnswer::Nothing, &self.uplink);
    }

    fn on_finish(&self, end: Tti) {
        let Some((state, ())) = self.heed(|follower| follower.receive_finish(end)) else {
            return;
        };
        let round = self.begin(state, HostRequest::Ledgers, self.mailboxes.len());
        for j in 0..self.mailboxes.len() {
            self.send(j, DeviceCommand::AdvanceTo(end, Arc::clone(&round)));
        }
        round.add(&DeviceAnswer::Nothing, &self.uplink);
    }

    /// Returns the task of a request, if any. A repeated request gets the same answer again.
    fn heed<T>(
        &self,
        follow: impl FnOnce(&mut GrantFollower) -> Disposition<T>,
    ) -> Option<(MutexGuard<'_, HostState>, T)> {
        let mut state = self.lock();
        match follow(&mut state.follower) {
            Disposition::Execute(it) => {
                self.start_actors(&mut state);
                Some((state, it))
            }
            Disposition::Resend => {
                let round = state.round.clone();
                // Released before sending, which blocks while the link is congested.
                drop(state);
                if let Some(round) = round {
                    round.resend(&self.uplink);
                }
                None
            }
            Disposition::NotReady => {
                let next = state.follower.next();
                tracing::debug!(%next, "cannot follow the clock; waiting for the grant to be resent");
                None
            }
        }
    }

    /// Opens the answer to a request, with one part of the host and `parts` parts of devices.
    fn begin(&self, mut state: MutexGuard<'_, HostState>, question: HostRequest, parts: usize) -> Arc<Round> {
        let round = Arc::new(Round::new(self.membership.pass.host, question, parts));
        state.round = Some(Arc::clone(&round));
        round
    }

    fn send(&self, j: usize, input: DeviceCommand) {
        // A mailbox closes only after a panic in the actor's task, which `PanicGuard` reports.
        let _closed = self.mailboxes[j].send(input).is_err();
    }

    fn lock(&self) -> MutexGuard<'_, HostState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
