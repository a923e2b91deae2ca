//! One run in memory: a [`Session`] together with its device machines. Replays, sweeps, trainings and environments are
//! such runs. A run has the digest of the same scenario and external inputs over the bus, whatever its [`RunOptions`].
//! `view/src/device_mirror.rs` and the actors in `device/src/host/` call the machines in the same way; change all.

use reveille_bs::cycle::{Cycle, PreparedRun, RunOutcome, WakeOrder};
use reveille_bs::observer::Observer;
use reveille_bs::policy::external::{Decision, DecisionStage};
use reveille_bs::session::{Action, ActionResult, GrantAnswers, InputQueue, Session};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    Change, DeviceCheckpoint, DeviceRange, FailedTransmission, GrantMessage, HostCheckpoint, PlanUpdate, Report,
    UnableDetectors, WakeOutcome,
};
use reveille_common::radio::Air;
use reveille_common::score::WindowRecord;
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::world::World;
use reveille_device::machine::{Machine, Physics, SenseOutcome};

use crate::external_inputs::{ExternalInput, ExternalInputs};

/// The options of a run, which do not change the outcome.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Whether a grant covers as many TTIs as possible, or only one.
    pub lookahead: bool,
    /// The number of TTIs in a window of the per-window series; `u64::MAX` for none.
    pub window: u64,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            lookahead: true,
            window: u64::MAX,
        }
    }
}

/// A run in progress.
pub struct Run {
    session: Session,
    devices: Devices,
    lookahead: bool,
}

/// The devices of a run.
#[derive(Clone)]
struct Devices {
    /// The device machines, in the order of ids.
    machines: Vec<Machine>,
    physics: Physics,
    /// The losses of plans, in the order of TTIs.
    air: Air,
    /// The buffers of [`Self::gather`].
    reports: Vec<Report>,
    failures: Vec<FailedTransmission>,
    views: Vec<DeviceView>,
}

/// The reason why a run does not advance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Halt {
    /// An external policy has to make the decision of this stage, which is not queued.
    Undecided(DecisionStage),
    /// The run has ended, or the observer has ended it.
    Ended,
}

impl Run {
    /// Creates the run of `prepared`, before TTI 0.
    pub fn new(prepared: &PreparedRun, options: RunOptions) -> Self {
        let world = World::new(&prepared.scenario, &prepared.deployment);
        Self::with_world(prepared, world, options)
    }

    /// Creates the run as [`Self::new`] does, in the caller's world, such as one with scripted events.
    pub fn with_world(prepared: &PreparedRun, world: World, options: RunOptions) -> Self {
        Self::with_cycle(prepared, Cycle::with_world(prepared, world), options)
    }

    /// Creates the run of `prepared`, with the world, base station and score in `cycle`.
    pub fn with_cycle(prepared: &PreparedRun, cycle: Cycle, options: RunOptions) -> Self {
        Self {
            session: Session::with_cycle(prepared, cycle, options.window),
            devices: Devices::new(prepared),
            lookahead: options.lookahead,
        }
    }

    /// Queues an external input. Removals and decisions are queued in the order in which they take effect, and none for
    /// a past TTI: it would stay in the queue and block all later ones of its kind.
    pub fn schedule_input(&mut self, input: ExternalInput) {
        let queue = self.session.input_queue_mut();
        match input {
            ExternalInput::Removal(removal) => queue.push_removal(removal),
            ExternalInput::Decision(decision) => queue.push_decision(decision),
            ExternalInput::Action(action) => queue.add_action(action),
        }
    }

    /// Queues all `inputs`.
    pub fn schedule_inputs(&mut self, inputs: &ExternalInputs) {
        inputs.iter().for_each(|input| self.schedule_input(input));
    }

    /// The external inputs that have not taken effect.
    pub const fn input_queue(&self) -> &InputQueue {
        self.session.input_queue()
    }

    /// The TTI of the pending decision, if that decision is not queued. At [`DecisionStage::Wake`] the TTI is open, and
    /// the run has no outcome.
    pub fn missing_decision(&self) -> Option<Tti> {
        self.session.pending_decision().map(|request| request.observation.now)
    }

    /// The devices, in the order of ids. Idle ones lag behind the clock; see [`Self::advance_machines`].
    pub fn machines(&self) -> &[Machine] {
        &self.devices.machines
    }

    /// Advances the devices to the last granted TTI and returns them, in the order of ids. Has no other effect.
    ///
    /// # Panics
    /// If no TTI has been granted.
    pub fn advance_machines(&mut self) -> &[Machine] {
        let last = Tti(self
            .session
            .next_tti()
            .0
            .checked_sub(1)
            .expect("a TTI has been granted"));
        self.devices.machines.iter_mut().for_each(|machine| machine.begin(last));
        &self.devices.machines
    }

    /// The world, base station and score.
    pub const fn cycle(&self) -> &Cycle {
        self.session.cycle()
    }

    pub(crate) const fn session(&self) -> &Session {
        &self.session
    }

    /// Runs to the end, or until `observer` ends the run or a plan is missing.
    ///
    /// # Panics
    /// If an external policy has to decide a wake-up and no decision is queued.
    pub fn finish(mut self, observer: &mut impl Observer) -> RunOutcome {
        self.advance(Tti::NEVER, observer);
        self.finish_session(observer)
    }

    /// Returns the ledgers of `count` devices from `first` on, before the next TTI.
    ///
    /// # Panics
    /// If one of the devices does not exist.
    pub fn ledgers(&mut self, first: DeviceId, count: u32) -> Vec<Ledger> {
        let next = self.session.next_tti();
        let machines = &mut self.devices.machines[first.index()..][..count as usize];
        machines
            .iter_mut()
            .map(|machine| advanced_to(machine, next).ledger())
            .collect()
    }

    /// Runs until `to` is the next TTI; does nothing if the run is past it. Returns false if `observer` ends the run, a
    /// decision is missing, or the run ends before `to`. A window that ends with `to` is not closed yet.
    pub fn advance(&mut self, to: Tti, observer: &mut impl Observer) -> bool {
        while self.session.next_tti() < to {
            if self.step(to, observer).is_some() {
                return false;
            }
        }
        true
    }

    /// Ends the run before the next TTI and returns its outcome.
    ///
    /// # Panics
    /// If a TTI is open, because a wake-up decision is missing.
    pub fn partial_outcome(self) -> RunOutcome {
        self.finish_session(&mut ())
    }

    fn finish_session(mut self, observer: &mut impl Observer) -> RunOutcome {
        let ledgers = self.ledgers(DeviceId(0), self.devices.machines.len() as u32);
        self.session.finish(&ledgers, observer)
    }

    /// Returns checkpoints of `count` devices from `first` on, with which another process can resume. Devices do not
    /// advance for this: an idle one lags behind the clock and catches up after the resumption.
    ///
    /// # Panics
    /// If one of the devices does not exist.
    pub fn checkpoints(&self, first: DeviceId, count: u32) -> Vec<DeviceCheckpoint> {
        let machines = &self.devices.machines[first.index()..][..count as usize];
        machines.iter().map(Machine::checkpoint).collect()
    }

    /// Converts the run for hosts on the bus to resume before the next TTI, with its devices.
    pub fn into_resumed(mut self) -> (Session, HostCheckpoint) {
        let next = self.session.next_tti();
        // `checkpoints` does not advance devices, so they first advance to the same TTI.
        let machines = self.devices.machines.iter_mut();
        let views = machines.map(|machine| advanced_to(machine, next).view()).collect();
        let checkpoint = HostCheckpoint {
            at: self.session.hand_over(views),
            devices: self.checkpoints(DeviceId(0), self.devices.machines.len() as u32),
        };
        (self.session, checkpoint)
    }

    /// Runs through one grant with its reports and wake-ups, or until a decision is missing or the run ends.
    pub fn run_grant(&mut self, observer: &mut impl Observer) {
        let first = self.session.next_tti();
        // The last TTI of a grant stays open until its wake-ups have been answered.
        while (self.session.is_open() || self.session.next_tti() == first) && self.step(Tti::NEVER, observer).is_none()
        {
        }
    }

    /// Runs until an external policy has to decide, or to the end.
    pub(crate) fn run_to_decision(&mut self, observer: &mut impl Observer) -> Halt {
        loop {
            if let Some(halt) = self.step(Tti::NEVER, observer) {
                return halt;
            }
        }
    }

    /// Passes on the decision for which [`Self::run_to_decision`] has halted, of the same stage.
    pub(crate) fn apply_decision(&mut self, decision: Decision, observer: &mut impl Observer) {
        self.session.apply_result(ActionResult::Decided(decision), observer);
    }

    /// Returns a copy that continues from the current state, under an external policy; `None` under any other.
    pub(crate) fn fork(&self) -> Option<Self> {
        Some(Self {
            session: self.session.fork()?,
            devices: self.devices.clone(),
            lookahead: self.lookahead,
        })
    }

    /// Executes one action; grants only cover TTIs before `limit`. Returns `None` unless the run cannot advance.
    #[inline]
    fn step(&mut self, limit: Tti, observer: &mut impl Observer) -> Option<Halt> {
        let Self {
            session,
            devices,
            lookahead,
        } = self;
        // A grant covers at least one TTI: with this limit, exactly one.
        let limit = if *lookahead { limit } else { session.next_tti() + 1 };
        match session.next_action(limit, observer) {
            Action::CollectTotals(k) => {
                let totals = devices.totals(k);
                session.apply_result(ActionResult::Totals(totals), observer);
            }
            Action::RequestDecision(stage) => return Some(Halt::Undecided(stage)),
            Action::Grant { changes, updates } => {
                devices.apply_changes(session.grant_message().first, &changes);
                devices.receive_plans(&updates);
            }
            Action::Remove(removal) => {
                // The range is valid: `DeviceRemoval::is_valid` checks removals of a log, and others come from ids of
                // the run.
                let removed = &mut devices.machines[removal.first.index()..=removal.last().index()];
                for machine in removed {
                    machine.remove(removal.tti);
                }
            }
            Action::Gather => {
                let answers = devices.gather(session.grant_message(), session.cycle().detectors());
                session.apply_result(ActionResult::GrantAnswers(answers), observer);
            }
            Action::Wake(order) => {
                let outcome = devices.wake(&order);
                session.apply_result(ActionResult::Woken(outcome), observer);
            }
            Action::TtiClosed => {}
            Action::Finish(_) => return Some(Halt::Ended),
        }
        None
    }
}

impl Devices {
    fn new(prepared: &PreparedRun) -> Self {
        let PreparedRun {
            scenario, deployment, ..
        } = prepared;
        let physics = Physics::new(
            scenario.run.seed,
            scenario.warm_up_end(),
            scenario.sensing.clone(),
            scenario.radio,
            &deployment.devices,
            deployment.traces.clone(),
        );
        let setups = deployment.devices.iter();
        Self {
            machines: setups.map(|setup| Machine::new(setup, &physics)).collect(),
            air: Air::new(scenario.run.seed, &scenario.radio),
            physics,
            reports: Vec::new(),
            failures: Vec::new(),
            views: Vec::new(),
        }
    }

    /// Returns the totals of all devices before TTI `k`.
    fn totals(&mut self, k: Tti) -> DeviceTotals {
        let machines = self.machines.iter_mut();
        // Totals are integers, so their order does not matter.
        machines.map(|machine| advanced_to(machine, k).totals()).sum()
    }

    /// Makes changes at the start of TTI `tti`, before the plans of its grant.
    fn apply_changes(&mut self, tti: Tti, changes: &[Change]) {
        for change in changes {
            let devices = change.devices().into_iter().flat_map(DeviceRange::devices);
            devices.for_each(|device| self.machines[device.index()].apply(tti, change));
        }
    }

    /// Delivers plans, in the order of TTIs, to the devices that do not miss them.
    fn receive_plans(&mut self, updates: &[PlanUpdate]) {
        let Self { machines, air, .. } = self;
        let count = machines.len();
        for PlanUpdate { from, plan } in updates {
            air.deliver_plan(*from, plan, DeviceId(0), count, |j, duty| {
                machines[j].set_duty(*from, duty);
            });
        }
    }

    /// Collects the answers of the devices to a grant. Only `detectors` can have a report, in its last TTI; all others
    /// may lag behind, unless the grant wants views.
    #[inline(always)]
    fn gather(&mut self, grant: &GrantMessage, detectors: &[DeviceId]) -> GrantAnswers<'_> {
        self.reports.clear();
        self.failures.clear();
        self.views.clear();
        let mut unable = UnableDetectors::default();
        if let Some(stimulus) = &grant.stimulus {
            for device in detectors {
                match self.machines[device.index()].sense(grant.last, stimulus, &self.physics) {
                    SenseOutcome::Nothing => {}
                    SenseOutcome::Failed => unable += UnableDetectors::FAILED,
                    SenseOutcome::Unpowered => unable += UnableDetectors::UNPOWERED,
                    SenseOutcome::Reported(report) => self.reports.push(report),
                    SenseOutcome::TransmissionFailed(failure) => self.failures.push(failure),
                }
            }
        }
        if grant.wants_views {
            let machines = self.machines.iter_mut();
            self.views.extend(machines.map(|machine| {
                machine.begin(grant.last);
                machine.view()
            }));
        }
        GrantAnswers {
            reports: &mut self.reports,
            failures: &mut self.failures,
            unable,
            views: &self.views,
        }
    }

    fn wake(&mut self, order: &WakeOrder) -> WakeOutcome {
        let machine = &mut self.machines[order.device.index()];
        machine.wake(order.tti, order.stimulus.as_ref(), &self.physics)
    }
}

/// Advances `machine` to TTI `k`. An idle device lags behind the clock.
fn advanced_to(machine: &mut Machine, k: Tti) -> &Machine {
    machine.advance_to(k);
    machine
}

/// An observer that stops a run when its closure returns true, checked at the end of each window
/// ([`RunOptions::window`]) and of the warm-up.
#[derive(Clone, Copy, Debug)]
pub struct StopWhen<F>(pub F);

impl<F: Fn() -> bool> Observer for StopWhen<F> {
    fn window_closed(&mut self, _: &WindowRecord) -> bool {
        !(self.0)()
    }
}
