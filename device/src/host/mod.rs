//! A host process: joins a run, runs the devices of its assignment, and answers the grants for all of them.
//!
//! A grant covers one or more TTIs. Without a stimulus the host answers it immediately; its devices catch up when they
//! are next needed. With a stimulus, which is in the last TTI, it sends commands to the actors of the devices that have
//! δ = 1 and are within range. A grant that wants totals or views needs all actors. The last actor to finish sends the
//! answer. An actor must receive its commands in the order of the steps within a TTI.

pub(crate) mod actor;
pub mod answer_round;
mod dispatch;
mod join;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, DeclarationGuard};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    BusCredentials, Change, ClockMessage, GrantMessage, HostSetup, PlanUpdate, Ready, ResumePoint, WakeUp,
};
use tokio::runtime::Handle;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::watch;

use self::actor::{Actor, DeviceCommand};
use self::answer_round::{AnswerRound, DeviceAnswer, Uplink};
use self::dispatch::{Dispatcher, HostMessage};
use crate::grant_follower::{Disposition, FollowerStart, GrantFollower, GrantTask, HostRequest, WakeUpTask};
use crate::machine::{Machine, Physics};

pub use self::dispatch::MAX_INLINE_DEVICES;
pub use self::join::{HostConfig, HostEvent, run_host};

/// Time limit for asking a base station that is back whether it still knows this host. A restarted base station serves
/// other keys, so no answer comes. The limit can be short: a base station declares its liveliness token last, so it can
/// answer as soon as it is back. A host that gives up too soon needs a new assignment.
const STILL_KNOWN_TIMEOUT: Duration = Duration::from_secs(1);

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

/// The progress of a host from joining to its exit. The last three are final.
#[derive(Clone, Debug, PartialEq, Eq)]
enum HostStatus {
    Running,
    /// No base station is alive.
    BsMissing,
    /// A base station is back, but may be a new one that does not know this host.
    BsBack,
    /// A device task has panicked.
    DeviceFailed,
    /// The base station reports the end of the run.
    Dismissed,
    /// The base station reports that the run has failed, with the reason.
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
struct PanicGuard(watch::Sender<HostStatus>);

impl Drop for PanicGuard {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.send_modify(|status| *status = HostStatus::DeviceFailed);
        }
    }
}

/// The state of a host, shared by the callbacks of its subscriptions.
struct HostShared {
    credentials: BusCredentials,
    /// The runtime of the actors if the thread that starts them has none.
    fallback_runtime: Handle,
    /// The first device of the assignment, whose ids are consecutive.
    first_device: DeviceId,
    /// The senders to the actors. Index `j` is the offset of a device from `first_device`, here and in tasks.
    mailboxes: Vec<UnboundedSender<DeviceCommand>>,
    uplink: Arc<Uplink>,
    state: Mutex<HostState>,
    status: watch::Sender<HostStatus>,
}

struct HostState {
    /// Actors that are not started yet; see [`HostShared::start_actors`].
    unstarted_actors: Vec<(Actor, UnboundedReceiver<DeviceCommand>)>,
    follower: GrantFollower,
    /// The answer to the last request.
    round: Option<Arc<AnswerRound>>,
}

impl HostShared {
    /// Creates the host of `assignment`, which `HostSetup::validate` has accepted, on the current tokio runtime.
    fn new(bus: &Bus, assignment: HostSetup) -> Result<Self, HostError> {
        let HostSetup {
            credentials,
            checkpoint,
            seed,
            ttis,
            measured_from,
            sensing,
            radio,
            devices,
            traces,
        } = assignment;
        let uplink = Arc::new(Uplink::new(bus, credentials.credential)?);
        let d_max = sensing.d_max;
        let physics = Arc::new(Physics::new(seed, measured_from, sensing, radio, &devices, traces));
        let machines: Vec<Machine> = match &checkpoint {
            None => devices.iter().map(|setup| Machine::new(setup, &physics)).collect(),
            Some(checkpoint) => devices
                .iter()
                .zip(&checkpoint.devices)
                .map(|(setup, device)| Machine::from_checkpoint(setup, &physics, device))
                .collect::<Result<_, _>>()
                .map_err(HostError::Assignment)?,
        };
        let first_device = devices.first().map_or(DeviceId(0), |d| d.id);
        let start = FollowerStart {
            first: first_device,
            positions: devices.iter().map(|d| d.position).collect(),
            duties: machines.iter().map(Machine::duty).collect(),
            resume_point: checkpoint.map_or(ResumePoint::default(), |checkpoint| checkpoint.at),
        };
        let (mut unstarted_actors, mut mailboxes) = (Vec::new(), Vec::new());
        for machine in machines {
            // Unbounded, because the thread that delivers messages must not wait for a device.
            let (mailbox, commands) = unbounded_channel();
            mailboxes.push(mailbox);
            unstarted_actors.push((Actor::new(machine, Arc::clone(&physics), Arc::clone(&uplink)), commands));
        }
        let state = Mutex::new(HostState {
            unstarted_actors,
            follower: GrantFollower::new(start, d_max, Tti(ttis), seed, &radio),
            round: None,
        });
        Ok(Self {
            credentials,
            fallback_runtime: Handle::current(),
            first_device,
            mailboxes,
            uplink,
            state,
            status: watch::Sender::new(HostStatus::Running),
        })
    }

    /// Declares all subscriptions of this host, then its liveliness token. The token comes last, so that every
    /// subscription is in place when the base station sees it.
    fn declare(self: &Arc<Self>, bus: &Bus, dispatcher: Dispatcher) -> Result<Vec<DeclarationGuard>, BusError> {
        let keys = bus.key_exprs();
        let mut guards = Vec::new();
        let host = self.credentials.credential.host;
        let plan_dispatcher = dispatcher.clone();
        guards.push(bus.subscribe(host, move |update: PlanUpdate| {
            plan_dispatcher.dispatch(HostMessage::Plan(update));
        })?);
        let wake_dispatcher = dispatcher.clone();
        guards.push(bus.subscribe_wake_ups(host, move |device, wake| {
            wake_dispatcher.dispatch(HostMessage::Wake(device, wake));
        })?);
        guards.push(bus.subscribe(host, move |clock: ClockMessage| {
            dispatcher.dispatch(HostMessage::Clock(clock));
        })?);
        let this = Arc::clone(self);
        guards.push(bus.watch_alive(keys.bs_liveliness(), move |_, alive| this.on_bs_liveliness(alive))?);
        guards.push(bus.declare_alive(keys.host_liveliness(self.credentials.credential))?);
        Ok(guards)
    }

    /// Waits until the base station dismisses the host, reassigns its devices, or is lost for longer than `patience`.
    async fn wait_for_exit(&self, bus: &Bus, patience: Duration) -> Result<HostExit, HostError> {
        let mut status = self.status.subscribe();
        loop {
            let current = status.borrow_and_update().clone();
            let has_changed = match current {
                HostStatus::Dismissed => return Ok(HostExit::Dismissed),
                HostStatus::RunFailed(reason) => return Err(HostError::RunFailed(reason)),
                HostStatus::DeviceFailed => return Err(HostError::DeviceFailed),
                HostStatus::Running => status.changed().await.is_ok(),
                HostStatus::BsMissing => tokio::time::timeout(patience, status.changed()).await.is_ok(),
                HostStatus::BsBack => {
                    if !self.is_still_known(bus, patience).await? {
                        return Ok(HostExit::Replaced);
                    }
                    // Only if nothing else has happened meanwhile, such as a second loss of the base station.
                    self.status.send_if_modified(|status| {
                        let is_back = *status == HostStatus::BsBack;
                        if is_back {
                            *status = HostStatus::Running;
                        }
                        is_back
                    });
                    true
                }
            };
            // Only a wait for a missing base station ends without a change.
            if !has_changed {
                return Err(HostError::BsLost {
                    run: bus.key_exprs().run().to_string(),
                    tti: self.lock().follower.last_granted(),
                    patience,
                });
            }
        }
    }

    /// Returns whether the base station still counts on this host. A restarted one serves other keys and does not
    /// answer.
    async fn is_still_known(&self, bus: &Bus, patience: Duration) -> Result<bool, BusError> {
        let credential = self.credentials.credential;
        let ready = Ready { host: credential.host };
        let patience = patience.min(STILL_KNOWN_TIMEOUT);
        Ok(bus.query_until(&ready, Some(credential.token), patience).await? == Some(true))
    }

    fn on_bs_liveliness(&self, alive: bool) {
        self.status.send_modify(|status| match (&status, alive) {
            (HostStatus::Dismissed | HostStatus::RunFailed(_) | HostStatus::DeviceFailed, _)
            | (HostStatus::Running | HostStatus::BsBack, true) => {}
            (HostStatus::Running | HostStatus::BsMissing | HostStatus::BsBack, false) => {
                *status = HostStatus::BsMissing;
            }
            (HostStatus::BsMissing, true) => *status = HostStatus::BsBack,
        });
    }

    /// Starts the actors on the runtime that processes this host's messages. A message then wakes its actor without a
    /// switch to another thread, which would cost more than the actor's work.
    fn start_actors(&self, state: &mut HostState) {
        if state.unstarted_actors.is_empty() {
            return;
        }
        let runtime = Handle::try_current().unwrap_or_else(|_| self.fallback_runtime.clone());
        for (actor, commands) in state.unstarted_actors.drain(..) {
            let panic_guard = PanicGuard(self.status.clone());
            runtime.spawn(async move {
                let _panic_guard = panic_guard;
                actor.run(commands).await;
            });
        }
    }

    /// Processes a message. Calls must not overlap: the link and [`Dispatcher`] deliver messages one by one, in order.
    /// Overlapping calls would mix the commands of two messages in a mailbox, because commands are sent without the
    /// lock.
    fn dispatch(&self, message: HostMessage) {
        match message {
            HostMessage::Plan(update) => self.on_plan(update),
            HostMessage::Wake(device, wake) => self.on_wake(device, wake),
            HostMessage::Clock(clock) => self.on_clock(clock),
        }
    }

    fn on_plan(&self, update: PlanUpdate) {
        let from = update.from;
        if !self.lock().follower.receive_plan(update) {
            tracing::debug!(%from, "ignored a plan for another TTI, usually a retransmitted one");
        }
    }

    fn on_changes(&self, tti: Tti, changes: Vec<Change>) {
        if !self.lock().follower.receive_changes(tti, changes) {
            tracing::debug!(%tti, "ignored actions in another TTI, usually retransmitted ones");
        }
    }

    fn on_wake(&self, device: DeviceId, wake: WakeUp) {
        let woken = self.lock().follower.receive_wake_up(device, wake);
        if let Some(WakeUpTask { device, tti, stimulus }) = woken {
            self.send_command(device, DeviceCommand::Wake(tti, stimulus));
        } else {
            tracing::debug!(%device, tti = %wake.tti, "ignored a wake-up for another TTI or host");
        }
    }

    fn on_clock(&self, clock: ClockMessage) {
        match clock {
            ClockMessage::Grant(grant) => self.on_grant(grant),
            ClockMessage::Act(tti, changes) => self.on_changes(tti, changes),
            ClockMessage::CollectLedgers(end) => self.on_collect_ledgers(end),
            ClockMessage::Dismiss => self.record_run_end(HostStatus::Dismissed),
            ClockMessage::RunFailed(reason) => self.record_run_end(HostStatus::RunFailed(reason)),
        }
    }

    /// Records how the run has ended. The base station's first message counts, unless a device has failed before.
    fn record_run_end(&self, final_status: HostStatus) {
        self.status.send_modify(|status| match status {
            HostStatus::Dismissed | HostStatus::RunFailed(_) | HostStatus::DeviceFailed => {}
            HostStatus::Running | HostStatus::BsMissing | HostStatus::BsBack => *status = final_status,
        });
    }

    fn on_grant(&self, grant: GrantMessage) {
        let Some((state, task)) = self.accept_request(|follower| follower.receive_grant(grant)) else {
            return;
        };
        let GrantTask {
            changes,
            duty_changes,
            sensing_devices,
        } = task;
        // One part for each command with `round` below: with fewer commands the answer would never be complete.
        let parts_per_device = usize::from(grant.wants_totals) + usize::from(grant.wants_views);
        let device_parts = parts_per_device * self.mailboxes.len() + sensing_devices.len();
        let round = self.open_round(state, HostRequest::Grant(grant.last), device_parts);
        // The order matters: `AdvanceTo(first)` would panic after a later δ, and views show the state after sensing.
        if grant.wants_totals {
            for j in 0..self.mailboxes.len() {
                self.send_command(j, DeviceCommand::AdvanceTo(grant.first, Arc::clone(&round)));
            }
        }
        for change in changes {
            let is_concerned = |j: &usize| {
                change
                    .devices()
                    .is_some_and(|devices| devices.contains(DeviceId(self.first_device.0 + *j as u32)))
            };
            for j in (0..self.mailboxes.len()).filter(is_concerned) {
                self.send_command(j, DeviceCommand::Change(grant.first, change));
            }
        }
        for (j, from, duty) in duty_changes {
            self.send_command(j, DeviceCommand::Duty(from, duty));
        }
        if let Some(stimulus) = grant.stimulus {
            for j in sensing_devices {
                self.send_command(j, DeviceCommand::Sense(grant.last, stimulus, Arc::clone(&round)));
            }
        }
        if grant.wants_views {
            for j in 0..self.mailboxes.len() {
                self.send_command(j, DeviceCommand::View(grant.last, Arc::clone(&round)));
            }
        }
        // The host's own part. It completes the answer if no device has a part in it.
        round.add(&DeviceAnswer::Nothing, &self.uplink);
    }

    fn on_collect_ledgers(&self, end: Tti) {
        let Some((state, ())) = self.accept_request(|follower| follower.receive_collect_ledgers(end)) else {
            return;
        };
        let round = self.open_round(state, HostRequest::Ledgers, self.mailboxes.len());
        for j in 0..self.mailboxes.len() {
            self.send_command(j, DeviceCommand::AdvanceTo(end, Arc::clone(&round)));
        }
        round.add(&DeviceAnswer::Nothing, &self.uplink);
    }

    /// Accepts a request for the clock: returns the task of a new one, with the state still locked until
    /// [`Self::open_round`]. A repeated request gets its earlier answer again, and has no task.
    fn accept_request<T>(
        &self,
        follow: impl FnOnce(&mut GrantFollower) -> Disposition<T>,
    ) -> Option<(MutexGuard<'_, HostState>, T)> {
        let mut state = self.lock();
        match follow(&mut state.follower) {
            Disposition::Execute(task) => {
                self.start_actors(&mut state);
                Some((state, task))
            }
            Disposition::Retransmit => {
                let round = state.round.clone();
                // Released before sending, which blocks while the link is congested.
                drop(state);
                if let Some(round) = round {
                    round.retransmit(&self.uplink);
                }
                None
            }
            Disposition::NotReady => {
                let next = state.follower.next();
                tracing::debug!(%next, "cannot follow the clock; waiting for the grant to be retransmitted");
                None
            }
        }
    }

    /// Opens the answer to a request, with one part of the host and `device_parts` parts of devices, and unlocks
    /// `state`.
    fn open_round(
        &self,
        mut state: MutexGuard<'_, HostState>,
        request: HostRequest,
        device_parts: usize,
    ) -> Arc<AnswerRound> {
        let host = self.credentials.credential.host;
        let round = Arc::new(AnswerRound::new(host, request, device_parts));
        state.round = Some(Arc::clone(&round));
        round
    }

    fn send_command(&self, j: usize, command: DeviceCommand) {
        // A mailbox closes only after a panic in the actor's task, which `PanicGuard` reports.
        let _closed = self.mailboxes[j].send(command).is_err();
    }

    fn lock(&self) -> MutexGuard<'_, HostState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
