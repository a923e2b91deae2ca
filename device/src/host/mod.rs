//! A host process: joins a run, carries its share of the devices, and answers the virtual clock for all of them.
//!
//! In a TTI without a stimulus the host answers at once: its devices catch up when they are next needed. With one it
//! wakes the actors of the devices that have δ = 1 and that it reaches, and the last of them to finish sends the
//! answer.

pub mod actor;
mod ear;
mod joining;
pub mod round;
pub mod uplink;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, Declared};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Assignment, Clock, Membership, PlanUpdate, Ready, Tick, WakeUp};
use tokio::runtime::Handle;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::watch;

use crate::follower::{Beginning, Call, Follower, Heed, Question, Turn};
use crate::host::actor::{Actor, Input};
use crate::host::ear::{Ear, Heard};
use crate::host::round::{Part, Round};
use crate::host::uplink::Uplink;
use crate::machine::{Machine, Physics};

pub use self::joining::{News, Offer, carry};

/// How long a BS that is back is asked whether it still knows a host: one that was started anew does not hear the
/// question, which shows at once, since its token comes after all that it answers. A host that gives up too soon has to
/// be given its places once more.
const ANOTHER: Duration = Duration::from_secs(1);

/// Why a host could not do its work.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The BS would not have it.
    #[error("the base station refused: {0}")]
    Refused(String),
    /// The BS gave places that cannot be.
    #[error("the base station's assignment cannot be: {0}")]
    Assignment(String),
    /// A device's task has ended: a bug in Reveille.
    #[error("a device has failed in a way that it never should; please report the lines above")]
    DeviceFailed,
    /// The BS says that the run has failed.
    #[error("the run has failed: {0}")]
    RunFailed(String),
    /// The BS is gone.
    #[error(
        "lost the base station of run {run} after TTI {tti}: its process ended or the link broke, and it did not come \
            back within {patience:?}"
    )]
    BsLost {
        /// The run.
        run: String,
        /// The last TTI granted.
        tti: Tti,
        /// How long it was waited for.
        patience: Duration,
    },
}

/// How far a host has come.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Progress {
    Running,
    BsMissing,
    /// The BS is there again, or another one in its place.
    BsBack,
    DeviceFailed,
    Dismissed,
    RunFailed(String),
}

/// How a host has come to the end of what it carries.
enum Left {
    /// The run is over.
    Dismissed,
    /// The BS has given the devices to another host, or is another BS.
    Replaced,
}

/// Says so when an actor's task panics, which tokio would keep to itself.
struct Obituary(watch::Sender<Progress>);

impl Drop for Obituary {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.send_modify(|progress| *progress = Progress::DeviceFailed);
        }
    }
}

/// What a host carries, shared by the callbacks of its subscriptions.
struct Shared {
    membership: Membership,
    fallback: Handle,
    mailboxes: Vec<UnboundedSender<Input>>,
    uplink: Arc<Uplink>,
    state: Mutex<HostState>,
    progress: watch::Sender<Progress>,
}

struct HostState {
    /// Actors that have not been started; see [`Shared::start_actors`].
    resting: Vec<(Actor, UnboundedReceiver<Input>)>,
    follower: Follower,
    /// The answer to the last question.
    round: Option<Arc<Round>>,
}

impl Shared {
    fn new(bus: &Bus, assignment: Assignment) -> Result<Self, HostError> {
        let Assignment {
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
                .map(|(setup, checkpoint)| Machine::resumed(setup, &physics, checkpoint))
                .collect::<Result<_, _>>()
                .map_err(HostError::Assignment)?,
        };
        let beginning = Beginning {
            first: devices.first().map_or(DeviceId(0), |d| d.id),
            positions: devices.iter().map(|d| d.position).collect(),
            duties: machines.iter().map(Machine::duty).collect(),
            next: resumption.as_ref().map_or(Tti::ZERO, |r| r.next),
            plan: resumption.and_then(|r| r.plan),
        };
        let (mut resting, mut mailboxes) = (Vec::new(), Vec::new());
        for machine in machines {
            let (mailbox, inputs) = unbounded_channel();
            mailboxes.push(mailbox);
            resting.push((Actor::new(machine, Arc::clone(&physics), Arc::clone(&uplink)), inputs));
        }
        let state = Mutex::new(HostState {
            resting,
            follower: Follower::new(beginning, d_max, Tti(ttis), seed, &radio),
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

    /// Subscribes to everything that concerns this host. The order matters: once the BS sees the token, all is in
    /// place.
    fn declare(self: &Arc<Self>, bus: &Bus, ear: Ear) -> Result<Vec<Declared>, BusError> {
        let keys = bus.keys();
        let mut declared = Vec::new();
        let host = self.membership.pass.host;
        let hear = ear.clone();
        declared.push(bus.subscribe(host, move |update: PlanUpdate| hear.take(Heard::Plan(update)))?);
        let hear = ear.clone();
        declared.push(bus.subscribe_wakes(host, move |device, wake| hear.take(Heard::Wake(device, wake)))?);
        declared.push(bus.subscribe(host, move |clock: Clock| ear.take(Heard::Clock(clock)))?);
        let this = Arc::clone(self);
        declared.push(bus.watch_alive(keys.bs_alive(), move |_, alive| this.on_bs(alive))?);
        declared.push(bus.declare_alive(keys.alive(self.membership.pass))?);
        Ok(declared)
    }

    /// Waits until the BS dismisses the host, has given its devices away, or is lost for longer than `patience`.
    async fn stay(&self, bus: &Bus, patience: Duration) -> Result<Left, HostError> {
        let mut progress = self.progress.subscribe();
        loop {
            let now = progress.borrow_and_update().clone();
            let changed = match now {
                Progress::Dismissed => return Ok(Left::Dismissed),
                Progress::RunFailed(why) => return Err(HostError::RunFailed(why)),
                Progress::DeviceFailed => return Err(HostError::DeviceFailed),
                Progress::Running => progress.changed().await.is_ok(),
                Progress::BsMissing => tokio::time::timeout(patience, progress.changed()).await.is_ok(),
                Progress::BsBack => {
                    if !self.is_still_known(bus, patience).await? {
                        return Ok(Left::Replaced);
                    }
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

    /// Whether the BS still counts on this host. One that was started anew serves other keys and does not answer.
    async fn is_still_known(&self, bus: &Bus, patience: Duration) -> Result<bool, BusError> {
        let pass = self.membership.pass;
        let ready = Ready { host: pass.host };
        let patience = patience.min(ANOTHER);
        Ok(bus.ask_until(&ready, Some(pass.token), patience).await? == Some(true))
    }

    fn on_bs(&self, alive: bool) {
        self.progress.send_modify(|progress| match (&progress, alive) {
            (Progress::Dismissed | Progress::RunFailed(_) | Progress::DeviceFailed, _)
            | (Progress::Running | Progress::BsBack, true) => {}
            (Progress::Running | Progress::BsMissing | Progress::BsBack, false) => *progress = Progress::BsMissing,
            (Progress::BsMissing, true) => *progress = Progress::BsBack,
        });
    }

    /// Starts the actors, on the runtime where this host does what it hears: there a message wakes its actor without
    /// handing over to another thread, which costs more than all that the actor does.
    fn start_actors(&self, state: &mut HostState) {
        if state.resting.is_empty() {
            return;
        }
        let runtime = Handle::try_current().unwrap_or_else(|_| self.fallback.clone());
        for (actor, inputs) in state.resting.drain(..) {
            let obituary = Obituary(self.progress.clone());
            runtime.spawn(async move {
                let _obituary = obituary;
                actor.run(inputs).await;
            });
        }
    }

    fn hear(&self, heard: Heard) {
        match heard {
            Heard::Plan(update) => self.on_plan(update),
            Heard::Wake(device, wake) => self.on_wake(device, wake),
            Heard::Clock(clock) => self.on_clock(clock),
        }
    }

    fn on_plan(&self, update: PlanUpdate) {
        let from = update.from;
        if !self.lock().follower.plan(update) {
            tracing::debug!(%from, "a plan for another TTI, one sent again as a rule");
        }
    }

    fn on_wake(&self, device: DeviceId, wake: WakeUp) {
        let woken = self.lock().follower.wake(device, wake);
        if let Some(Call { device, tti, stimulus }) = woken {
            self.send(device, Input::Wake(tti, stimulus));
        } else {
            tracing::debug!(%device, tti = %wake.tti, "a wake-up outside its TTI, or for somebody else");
        }
    }

    fn on_clock(&self, clock: Clock) {
        match clock {
            Clock::Grant(tick) => self.on_grant(tick),
            Clock::Finish(end) => self.on_finish(end),
            Clock::Dismiss => self.leave(Progress::Dismissed),
            Clock::Fail(why) => self.leave(Progress::RunFailed(why)),
        }
    }

    /// The BS has said how the run has ended: its first word counts, unless a device has failed before.
    fn leave(&self, end: Progress) {
        self.progress.send_modify(|progress| match progress {
            Progress::Dismissed | Progress::RunFailed(_) | Progress::DeviceFailed => {}
            Progress::Running | Progress::BsMissing | Progress::BsBack => *progress = end,
        });
    }

    fn on_grant(&self, tick: Tick) {
        let Some((state, turn)) = self.heed(|follower| follower.grant(tick)) else {
            return;
        };
        let Turn { changes, listeners } = turn;
        let questions = usize::from(tick.account) + usize::from(tick.views);
        let parts = questions * self.mailboxes.len() + listeners.len();
        let round = self.begin(state, Question::Grant(tick.last), parts);
        if tick.account {
            for j in 0..self.mailboxes.len() {
                self.send(j, Input::Settle(tick.first, Arc::clone(&round)));
            }
        }
        for (j, from, duty) in changes {
            self.send(j, Input::Duty(from, duty));
        }
        if let Some(stimulus) = tick.stimulus {
            for j in listeners {
                self.send(j, Input::Sense(tick.last, stimulus, Arc::clone(&round)));
            }
        }
        if tick.views {
            for j in 0..self.mailboxes.len() {
                self.send(j, Input::View(tick.last, Arc::clone(&round)));
            }
        }
        round.add(&Part::Nothing, &self.uplink);
    }

    fn on_finish(&self, end: Tti) {
        let Some((state, ())) = self.heed(|follower| follower.finish(end)) else {
            return;
        };
        let round = self.begin(state, Question::Ledgers, self.mailboxes.len());
        for j in 0..self.mailboxes.len() {
            self.send(j, Input::Settle(end, Arc::clone(&round)));
        }
        round.add(&Part::Nothing, &self.uplink);
    }

    /// What is to be done about a question, if anything; one that is asked again is answered again.
    fn heed<T>(&self, follow: impl FnOnce(&mut Follower) -> Heed<T>) -> Option<(MutexGuard<'_, HostState>, T)> {
        let mut state = self.lock();
        match follow(&mut state.follower) {
            Heed::Do(it) => {
                self.start_actors(&mut state);
                Some((state, it))
            }
            Heed::Again => {
                let round = state.round.clone();
                drop(state);
                if let Some(round) = round {
                    round.repeat(&self.uplink);
                }
                None
            }
            Heed::Wait => {
                let next = state.follower.next();
                tracing::debug!(%next, "cannot follow the clock; waiting to be asked again");
                None
            }
        }
    }

    /// Opens the answer to a question, to which the host itself and `parts` times a device adds.
    fn begin(&self, mut state: MutexGuard<'_, HostState>, question: Question, parts: usize) -> Arc<Round> {
        let round = Arc::new(Round::new(self.membership.pass.host, question, parts));
        state.round = Some(Arc::clone(&round));
        round
    }

    fn send(&self, j: usize, input: Input) {
        // A mailbox closes only when the actor's task has panicked, which its process reports.
        let _closed = self.mailboxes[j].send(input).is_err();
    }

    fn lock(&self) -> MutexGuard<'_, HostState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
