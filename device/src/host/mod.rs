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

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, Declared};
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Assignment, Clock, Membership, PlanUpdate, Ready, Tick, WakeUp};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::Air;
use tokio::runtime::Handle;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::watch;

use crate::host::actor::{Actor, Input};
use crate::host::ear::{Ear, Heard};
use crate::host::round::{Part, Question, Round};
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
    first: DeviceId,
    positions: Vec<Point>,
    d_max: f64,
    end: Tti,
    fallback: Handle,
    mailboxes: Vec<UnboundedSender<Input>>,
    uplink: Arc<Uplink>,
    state: Mutex<HostState>,
    progress: watch::Sender<Progress>,
}

struct HostState {
    /// Actors that have not been started; see [`Shared::start_actors`].
    resting: Vec<(Actor, UnboundedReceiver<Input>)>,
    duties: Vec<DutyCycle>,
    air: Air,
    /// The TTI from which the plan that this host has holds.
    plan_from: Option<Tti>,
    /// Plans that hold from TTIs on that have not been granted, in their order.
    coming: BTreeMap<Tti, Plan>,
    /// The first TTI that has not been granted.
    next: Tti,
    tick: Option<Tick>,
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
        let first = devices.first().map_or(DeviceId(0), |d| d.id);
        let uplink = Arc::new(Uplink::new(bus, membership.pass)?);
        let positions = devices.iter().map(|d| d.position).collect();
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
        let duties = machines.iter().map(Machine::duty).collect();
        let (mut resting, mut mailboxes) = (Vec::new(), Vec::new());
        for machine in machines {
            let (mailbox, inputs) = unbounded_channel();
            mailboxes.push(mailbox);
            resting.push((Actor::new(machine, Arc::clone(&physics), Arc::clone(&uplink)), inputs));
        }
        let state = Mutex::new(HostState {
            duties,
            air: Air::new(seed, &radio),
            resting,
            plan_from: resumption.as_ref().and_then(|r| r.plan),
            coming: BTreeMap::new(),
            next: resumption.map_or(Tti::ZERO, |r| r.next),
            tick: None,
            round: None,
        });
        Ok(Self {
            membership,
            first,
            positions,
            d_max,
            end: Tti(ttis),
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
                let tti = self.lock().tick.map_or(Tti::ZERO, |t| t.last);
                return Err(HostError::BsLost {
                    run: bus.keys().run().to_string(),
                    tti,
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

    /// A plan is kept for the grant that it goes with.
    fn on_plan(&self, update: PlanUpdate) {
        let PlanUpdate { from, plan } = update;
        let mut state = self.lock();
        if from < state.next || from >= self.end {
            let next = state.next;
            tracing::debug!(%from, %next, "a plan for another TTI, one sent again as a rule");
            return;
        }
        state.coming.insert(from, plan);
    }

    /// Takes over the plans that go with a grant up to TTI `last`. Gives what changes for which device, in order.
    fn follow(&self, state: &mut HostState, last: Tti) -> Vec<(usize, Input)> {
        let mut changes = Vec::new();
        let later = state.coming.split_off(&last.saturating_add(1));
        for (from, plan) in std::mem::replace(&mut state.coming, later) {
            state.plan_from = Some(from);
            let air = state.air.at(from);
            for (j, duty) in state.duties.iter_mut().enumerate() {
                let device = DeviceId(self.first.0 + j as u32);
                let new = plan.duty_cycle(device);
                if *duty != new && !air.misses_plan(device) {
                    *duty = new;
                    changes.push((j, Input::Duty(from, new)));
                }
            }
        }
        changes
    }

    fn on_wake(&self, device: DeviceId, wake: WakeUp) {
        let Some(j) = device
            .index()
            .checked_sub(self.first.index())
            .filter(|&j| j < self.mailboxes.len())
        else {
            tracing::debug!(%device, "a wake-up for a device that this host does not carry");
            return;
        };
        let stimulus = self
            .lock()
            .tick
            .filter(|tick| tick.last == wake.tti)
            .and_then(|tick| tick.stimulus);
        if let Some(stimulus) = stimulus {
            self.send(j, Input::Wake(wake.tti, stimulus));
        } else {
            tracing::debug!(%device, tti = %wake.tti, "a wake-up outside its TTI");
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
        let mut state = self.lock();
        if let Some(round) = state
            .round
            .as_ref()
            .filter(|r| r.question() == Question::Grant(tick.last))
        {
            let round = Arc::clone(round);
            drop(state);
            return round.repeat(&self.uplink);
        }
        let own = || state.coming.range(..=tick.last).map(|(from, _)| *from);
        let plan = own().next_back().or(state.plan_from);
        if tick.first != state.next
            || tick.last < tick.first
            || tick.last >= self.end
            || plan != Some(tick.plan)
            || own().count() != tick.plans as usize
        {
            tracing::debug!(
                ?tick,
                next = %state.next,
                "cannot follow this grant; waiting for it to be sent again with its plan"
            );
            return;
        }
        self.start_actors(&mut state);
        let changes = self.follow(&mut state, tick.last);
        state.next = tick.last.saturating_add(1);
        let listeners: Vec<usize> = match tick.stimulus {
            Some(stimulus) => (0..state.duties.len())
                .filter(|&j| state.duties[j].is_on(tick.last) && self.is_in_reach(j, &stimulus))
                .collect(),
            None => Vec::new(),
        };
        let questions = usize::from(tick.account) + usize::from(tick.views);
        let round = Arc::new(Round::new(
            self.membership.pass.host,
            Question::Grant(tick.last),
            questions * self.mailboxes.len() + listeners.len(),
        ));
        state.tick = Some(tick);
        state.round = Some(Arc::clone(&round));
        drop(state);
        if tick.account {
            for j in 0..self.mailboxes.len() {
                self.send(j, Input::Settle(tick.first, Arc::clone(&round)));
            }
        }
        for (j, change) in changes {
            self.send(j, change);
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

    /// Whether the world's stimulus reaches the `j`-th device at all.
    fn is_in_reach(&self, j: usize, stimulus: &Stimulus) -> bool {
        self.positions[j].distance(stimulus.epicentre) <= self.d_max
    }

    fn on_finish(&self, end: Tti) {
        let mut state = self.lock();
        if let Some(round) = state.round.as_ref().filter(|r| r.question() == Question::Ledgers) {
            let round = Arc::clone(round);
            drop(state);
            return round.repeat(&self.uplink);
        }
        if end != state.next {
            tracing::debug!(%end, next = %state.next, "an end at another TTI than the next; ignored");
            return;
        }
        self.start_actors(&mut state);
        let round = Arc::new(Round::new(
            self.membership.pass.host,
            Question::Ledgers,
            self.mailboxes.len(),
        ));
        state.round = Some(Arc::clone(&round));
        drop(state);
        for j in 0..self.mailboxes.len() {
            self.send(j, Input::Settle(end, Arc::clone(&round)));
        }
        round.add(&Part::Nothing, &self.uplink);
    }

    fn send(&self, j: usize, input: Input) {
        // A mailbox closes only when the actor's task has panicked, which its process reports.
        let _closed = self.mailboxes[j].send(input).is_err();
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HostState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
