//! One run as a state machine without I/O. It defines the order of steps in a TTI, for runs in memory and on the bus.
//!
//! A shell asks for the next [`Action`], carries it out, and hands the result back as an [`ActionResult`]:
//!
//! ```text
//!   CollectTotals ──► RequestDecision ──► Grant ──► Remove* ──► Gather ──┬──► (next TTI)
//!   at a window's     of a plan, by an    actions,  devices     reports  │
//!   boundary          external policy     plans,    that are             ▼
//!                                         clock     lost       RequestDecision ──► Remove* ──► Wake ──┐
//!                                                              of wake-ups         ▲                  │
//!                                                                                  └──── outcome ◄────┘
//! ```
//! `RequestDecision` occurs under an external policy alone. After reports, an outcome or a decision, the next step is a
//! wake-up, another decision of wake-ups, or the next TTI; [`Action::TtiClosed`] announces it after a queued decision.
//! After the last TTI, or once the observer ends the run, [`Action::Finish`] is the only action.
//!
//! An action that has a result is repeated until the shell passes the result: a shell can stop at any of them and
//! continue later. The devices belong to the shell, as state machines in memory (`lab/src/run.rs`) or on hosts over the
//! bus (`bs/src/server/run_loop.rs`).

mod queue;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRemoval, GrantMessage, PlanUpdate, ResumePoint, WakeOutcome};
use reveille_common::score::WindowAccumulator;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{DeviceTotals, EventTotals, Ledger};
use reveille_common::units::Energy;

pub use self::queue::InputQueue;
use crate::boundaries::Boundaries;
pub use crate::cycle::GrantAnswers;
use crate::cycle::{Cycle, CycleStep, PreparedRun, RunOutcome, WakeOrder};
use crate::observer::{Notification, Observer};
use crate::policy::external::{Decision, DecisionContext, DecisionStage};

/// The view of a removed device, which no host reports.
pub(crate) const REMOVED_VIEW: DeviceView = DeviceView {
    state: DeviceState::Sleep { powered: false },
    battery: Energy::ZERO,
};

/// The next action of the shell.
#[derive(Debug)]
pub enum Action {
    /// Sum the energy of all devices before this TTI. Answer with [`ActionResult::Totals`], or with
    /// [`ActionResult::TotalsFollow`] if the answers to the next grant can carry the sums.
    CollectTotals(Tti),
    /// Obtain the answer to [`Session::pending_decision`], and pass it on as [`ActionResult::Decided`].
    RequestDecision(DecisionStage),
    /// Make these changes at the start of the grant's first TTI, send these plans and then the clock's grant,
    /// [`Session::grant_message`]. [`Action::Gather`] follows, after any [`Action::Remove`].
    Grant {
        /// The changes that operators make, in order.
        changes: Vec<Change>,
        /// The plans, TTI by TTI.
        updates: Vec<PlanUpdate>,
    },
    /// Remove these devices from the run, then ask for the next action.
    Remove(DeviceRemoval),
    /// Wait until the devices have completed the grant, and pass on their answers as [`ActionResult::GrantAnswers`].
    Gather,
    /// Wake a device, and pass on the outcome as [`ActionResult::Woken`].
    Wake(WakeOrder),
    /// Stop here, or ask for the next action: a queued decision has closed the TTI.
    TtiClosed,
    /// Collect the ledgers before this TTI and call [`Session::finish`].
    Finish(Tti),
}

/// The result of an action.
#[derive(Debug)]
pub enum ActionResult<'a> {
    /// The sums over all devices.
    Totals(DeviceTotals),
    /// The answers to the next grant carry the sums: [`ActionResult::Totals`] follows before
    /// [`ActionResult::GrantAnswers`].
    TotalsFollow,
    /// The decision that was requested.
    Decided(Decision),
    /// The answers of the devices that have completed the grant.
    GrantAnswers(GrantAnswers<'a>),
    /// The outcome of the wake-up.
    Woken(WakeOutcome),
}

/// The position of a run in the order of steps of a TTI.
#[derive(Clone, Copy, Debug)]
enum Phase {
    /// Before the next TTI.
    Between,
    /// Before the next TTI, with the sums taken and the batteries known to the policy.
    Ready,
    /// A grant is out.
    Granted,
    /// A wake-up is out.
    Waking(WakeOrder),
    /// An external policy decides which devices to wake in this TTI.
    Asking(Tti),
}

/// Sums of a window that travel with the answers to a grant.
#[derive(Clone, Copy, Debug)]
struct LateTotals {
    window_end: Tti,
    /// Counted events up to there.
    events: EventTotals,
    /// The sums, once they have arrived.
    energy: Option<DeviceTotals>,
}

/// A run with its world, base station, score and windows.
pub struct Session {
    cycle: Cycle,
    boundaries: Boundaries,
    window_accumulator: WindowAccumulator,
    input_queue: InputQueue,
    phase: Phase,
    /// The last grant.
    grant_message: GrantMessage,
    /// The first TTI of the current plan; `None` before the first plan.
    plan_from: Option<Tti>,
    /// The position before the last grant, open or closed.
    resume_point: ResumePoint,
    /// The last boundary whose sums were taken or are on their way.
    last_boundary: Tti,
    /// The boundary after it, which no grant crosses.
    next_boundary: Tti,
    late_totals: Option<LateTotals>,
    /// The devices at the end of the last TTI, in the order of ids, if the policy or the observer needs them.
    views: Vec<DeviceView>,
    /// Whether the observer wants the states at the end of the open TTI.
    wants_states: bool,
    /// Number of decisions of an external policy so far.
    decision_count: u64,
    /// Whether the observer has ended the run.
    is_stopped: bool,
}

impl Session {
    /// Creates the run `prepared`, before TTI 0, with windows of `window_ttis` TTIs; [`u64::MAX`] for none.
    ///
    /// # Panics
    /// If `window_ttis` is 0, or the policy needs pilot runs and `prepared` has no choice.
    pub fn new(prepared: &PreparedRun, window_ttis: u64) -> Self {
        Self::with_cycle(prepared, Cycle::new(prepared), window_ttis)
    }

    /// Creates a run like [`Self::new`], with a given base station and world, which must be before TTI 0.
    ///
    /// # Panics
    /// If `window_ttis` is 0.
    pub fn with_cycle(prepared: &PreparedRun, cycle: Cycle, window_ttis: u64) -> Self {
        let boundaries = Boundaries::new(&prepared.scenario, window_ttis);
        Self {
            cycle,
            next_boundary: boundaries.next_boundary(Tti::ZERO),
            boundaries,
            window_accumulator: WindowAccumulator::new(&prepared.deployment),
            input_queue: InputQueue::default(),
            phase: Phase::Between,
            grant_message: GrantMessage::default(),
            plan_from: None,
            resume_point: ResumePoint::default(),
            last_boundary: Tti::ZERO,
            late_totals: None,
            views: Vec::new(),
            wants_states: false,
            decision_count: 0,
            is_stopped: false,
        }
    }

    /// World, base station and score.
    pub const fn cycle(&self) -> &Cycle {
        &self.cycle
    }

    /// The next TTI to be granted; while a grant is open, the first TTI that still has no outcome.
    pub const fn next_tti(&self) -> Tti {
        self.cycle.next_tti()
    }

    /// Whether a grant is out and its last TTI is not closed.
    pub const fn is_open(&self) -> bool {
        self.cycle.is_open()
    }

    /// The last grant; a default before the first.
    pub const fn grant_message(&self) -> &GrantMessage {
        &self.grant_message
    }

    /// The position before the last grant: hosts that take over devices repeat that grant.
    pub const fn resume_point(&self) -> ResumePoint {
        self.resume_point
    }

    /// External inputs that have not taken effect.
    pub const fn input_queue(&self) -> &InputQueue {
        &self.input_queue
    }

    /// External inputs that have not taken effect, to add to.
    pub const fn input_queue_mut(&mut self) -> &mut InputQueue {
        &mut self.input_queue
    }

    /// Number of decisions of an external policy that have taken effect, those from the queue included.
    pub const fn decision_count(&self) -> u64 {
        self.decision_count
    }

    /// The decision that the run waits for after [`Action::RequestDecision`].
    pub fn pending_decision(&self) -> Option<DecisionContext<'_>> {
        match self.phase {
            Phase::Ready if self.cycle.needs_external_plan() => self.cycle.next_plan_context(),
            Phase::Asking(tti) => Some(self.cycle.wake_up_context(tti)),
            Phase::Between | Phase::Ready | Phase::Granted | Phase::Waking(_) => None,
        }
    }

    /// The next action. A grant covers TTIs before `limit` alone, and at least one.
    #[inline]
    pub fn next_action(&mut self, limit: Tti, observer: &mut impl Observer) -> Action {
        loop {
            match self.phase {
                Phase::Between => {
                    let k = self.next_tti();
                    if self.is_stopped || k >= self.boundaries.end() {
                        // An environment shows its last observation with true batteries; no decision follows.
                        self.update_batteries(&mut ());
                        return Action::Finish(k);
                    }
                    // `CollectTotals` leaves the phase as it is. Its result moves the boundary, so the next call
                    // continues past this check.
                    if k == self.next_boundary {
                        return Action::CollectTotals(k);
                    }
                    self.update_batteries(observer);
                    self.phase = Phase::Ready;
                }
                Phase::Ready => {
                    if self.cycle.needs_external_plan() {
                        let Some(decision) = self.input_queue.take_plan(self.next_tti()) else {
                            return Action::RequestDecision(DecisionStage::Plan);
                        };
                        self.apply_result(ActionResult::Decided(Decision::Plan(decision)), observer);
                    }
                    return self.grant(limit, observer);
                }
                Phase::Granted => {
                    // Removals come before the answers: the devices are removed before they sense in this TTI.
                    return match self.input_queue.take_removal(self.grant_message.last, None) {
                        Some(removal) => self.apply_removal(removal, observer),
                        None => Action::Gather,
                    };
                }
                Phase::Waking(order) => {
                    // The number tells where in the TTI the devices were lost; a replay must remove them before the
                    // same wake-up.
                    return match self.input_queue.take_removal(order.tti, Some(order.number)) {
                        Some(removal) => self.apply_removal(removal, observer),
                        None => Action::Wake(order),
                    };
                }
                Phase::Asking(tti) => {
                    let Some(devices) = self.input_queue.take_wake_ups(tti) else {
                        return Action::RequestDecision(DecisionStage::Wake);
                    };
                    self.apply_result(ActionResult::Decided(Decision::Wake(devices)), observer);
                    // Granting the next TTI in the same call would carry a shell past the TTI at which it wants to
                    // stop.
                    if matches!(self.phase, Phase::Between) {
                        return Action::TtiClosed;
                    }
                }
            }
        }
    }

    /// Takes in the result of the last action.
    ///
    /// # Panics
    /// If the phase has no such result, or the answers to a grant come before the sums that
    /// [`ActionResult::TotalsFollow`] announced.
    // Inlined, so that a shell that passes a known result pays for that result alone: in memory a grant costs 1 % more
    // instructions without.
    #[inline]
    pub fn apply_result(&mut self, result: ActionResult<'_>, observer: &mut impl Observer) {
        match result {
            ActionResult::Totals(energy) => self.take_totals(energy, observer),
            ActionResult::TotalsFollow => self.expect_late_totals(),
            ActionResult::Decided(decision) => self.take_decision(decision, observer),
            ActionResult::GrantAnswers(answers) => self.take_answers(answers, observer),
            ActionResult::Woken(outcome) => self.take_outcome(outcome, observer),
        }
    }

    fn take_totals(&mut self, energy: DeviceTotals, observer: &mut impl Observer) {
        let is_due = self.next_tti() == self.next_boundary;
        match (self.phase, &mut self.late_totals) {
            (Phase::Between, None) if is_due => {
                self.pass_boundary();
                self.end_window(self.last_boundary, energy, *self.cycle.event_totals(), observer);
            }
            (Phase::Granted, Some(late)) => late.energy = Some(energy),
            _ => self.panic_unexpected("sums"),
        }
    }

    fn expect_late_totals(&mut self) {
        if !matches!(self.phase, Phase::Between) || self.next_tti() != self.next_boundary {
            self.panic_unexpected("sums");
        }
        self.pass_boundary();
        // Copied here, because the next grant starts to score events of the next window before the sums arrive.
        self.late_totals = Some(LateTotals {
            window_end: self.last_boundary,
            events: *self.cycle.event_totals(),
            energy: None,
        });
    }

    fn pass_boundary(&mut self) {
        self.last_boundary = self.next_tti();
        self.next_boundary = self.boundaries.next_boundary(self.last_boundary);
    }

    fn take_decision(&mut self, decision: Decision, observer: &mut impl Observer) {
        self.decision_count += 1;
        match (decision, self.phase) {
            (Decision::Plan(plan_decision), Phase::Ready) => self.cycle.set_plan(plan_decision),
            (Decision::Wake(devices), Phase::Asking(tti)) => {
                let step = self.cycle.set_wake_ups(tti, &devices, observer);
                self.apply_step(step, observer);
            }
            (Decision::Plan(_), _) => self.panic_unexpected("a plan"),
            (Decision::Wake(_), _) => self.panic_unexpected("devices to wake"),
        }
    }

    #[inline]
    fn take_answers(&mut self, answers: GrantAnswers<'_>, observer: &mut impl Observer) {
        if !matches!(self.phase, Phase::Granted) {
            self.panic_unexpected("reports");
        }
        self.views.clear();
        self.views.extend_from_slice(answers.views);
        let step = self.cycle.complete_grant(self.grant_message.last, answers, observer);
        self.apply_step(step, observer);
    }

    fn take_outcome(&mut self, outcome: WakeOutcome, observer: &mut impl Observer) {
        let Phase::Waking(order) = self.phase else {
            self.panic_unexpected("an outcome")
        };
        // The view was taken at the end of the grant, before this wake-up changed state and battery.
        if let Some(view) = self.views.get_mut(order.device.index()) {
            *view = outcome.apply_to(*view);
        }
        let step = self.cycle.complete_wake_up(&order, outcome, observer);
        self.apply_step(step, observer);
    }

    #[cold]
    fn panic_unexpected(&self, result: &str) -> ! {
        panic!("no action of phase {:?} has {result} as its result", self.phase)
    }

    /// Removes the devices among `devices` that are still in the run, in the open TTI: their host was lost while its
    /// answer was due. `store_removal` stores each removal before it takes effect.
    ///
    /// # Errors
    /// If `store_removal` fails; the removals before it have taken effect.
    ///
    /// # Panics
    /// If no grant and no wake-up is out.
    pub fn remove_devices<E>(
        &mut self,
        devices: impl IntoIterator<Item = DeviceId>,
        observer: &mut impl Observer,
        store_removal: impl Fn(&DeviceRemoval) -> Result<(), E>,
    ) -> Result<(), E> {
        let (tti, wake_ups) = match self.phase {
            Phase::Granted => (self.grant_message.last, None),
            Phase::Waking(order) => (order.tti, Some(order.number)),
            phase @ (Phase::Between | Phase::Ready | Phase::Asking(_)) => panic!("no answer is due in phase {phase:?}"),
        };
        // A resumed run replays earlier removals, so some devices of a lost host may be removed already.
        let remaining = devices.into_iter().filter(|&device| !self.cycle.is_removed(device));
        for removal in DeviceRemoval::from_devices(remaining, tti, wake_ups) {
            store_removal(&removal)?;
            self.apply_removal(removal, observer);
        }
        Ok(())
    }

    /// Prepares a run between two grants for another shell, to which its devices move with these `views`, in the order
    /// of ids. Returns the position from which it continues.
    pub fn hand_over(&mut self, views: Vec<DeviceView>) -> ResumePoint {
        self.views = views;
        self.resume_point = self.position();
        self.resume_point
    }

    /// A copy that continues from here, under an external policy; `None` under any other.
    pub fn fork(&self) -> Option<Self> {
        Some(Self {
            cycle: self.cycle.fork()?,
            window_accumulator: self.window_accumulator.clone(),
            input_queue: self.input_queue.clone(),
            views: self.views.clone(),
            ..*self
        })
    }

    /// Closes the run before the next TTI, where its last window ends too. `ledgers` has the ledgers of all devices,
    /// in the order of ids, removed ones included.
    ///
    /// # Panics
    /// If a TTI is open.
    pub fn finish(mut self, ledgers: &[Ledger], observer: &mut impl Observer) -> RunOutcome {
        let k = self.next_tti();
        // A window that ends here is closed already, unless its sums were to come with the next grant.
        if k > self.last_boundary || self.late_totals.is_some() {
            let energy = ledgers.iter().map(|ledger| ledger.whole).sum();
            self.end_window(k, energy, *self.cycle.event_totals(), observer);
        }
        self.cycle.finish(ledgers)
    }

    const fn position(&self) -> ResumePoint {
        ResumePoint {
            next: self.cycle.next_tti(),
            plan_from: self.plan_from,
        }
    }

    fn update_batteries(&mut self, observer: &mut impl Observer) {
        if self.cycle.needs_true_batteries_for(self.next_tti()) {
            let batteries = self.views.iter().map(|view| view.battery);
            self.cycle.set_true_batteries(batteries, observer);
        }
    }

    #[inline]
    fn grant(&mut self, limit: Tti, observer: &mut impl Observer) -> Action {
        let first = self.next_tti();
        let changes = self.input_queue.take_changes(first);
        // A removal happens in the last TTI of a grant, the only one in which devices act. Changes happen at the start
        // of its first TTI, so that the clock can foresee the devices that react.
        let limit = limit
            .min(self.input_queue.next_removal_tti().saturating_add(1))
            .min(self.input_queue.next_operator_action_tti())
            .max(first + 1);
        // Taken before the cycle moves on, since a host that takes devices over repeats this grant.
        self.resume_point = self.position();
        self.cycle.apply_changes(&changes, observer);
        let limit = limit
            .min(self.next_boundary)
            .min(observer.states_due().max(first).saturating_add(1));
        let (grant, updates) = self.cycle.grant(limit, observer);
        self.wants_states = observer.states_due() <= grant.last;
        self.plan_from = updates.last().map(|update| update.from).or(self.plan_from);
        self.grant_message = GrantMessage {
            first,
            last: grant.last,
            stimulus: grant.stimulus,
            stimulus_last: grant.event_last_tti,
            wants_totals: self.late_totals.is_some(),
            // A policy that decides for the next TTI by true batteries reads them from these views.
            wants_views: self.wants_states || self.cycle.needs_true_batteries_for(grant.last + 1),
            plan_from: self.plan_from.unwrap_or_default(),
            plan_count: updates.len() as u32,
            change_count: changes.len() as u32,
        };
        self.phase = Phase::Granted;
        Action::Grant { changes, updates }
    }

    fn apply_removal(&mut self, removal: DeviceRemoval, observer: &mut impl Observer) -> Action {
        self.cycle.remove_devices(&removal, observer);
        // No views are kept unless the policy or the observer needs them.
        if let Some(views) = self.views.get_mut(removal.first.index()..=removal.last().index()) {
            views.fill(REMOVED_VIEW);
        }
        Action::Remove(removal)
    }

    /// Enters the phase of `step`; a closed TTI also ends a window whose sums came with the grant.
    #[inline]
    fn apply_step(&mut self, step: CycleStep, observer: &mut impl Observer) {
        self.phase = match step {
            CycleStep::SendWakeUp(order) => Phase::Waking(order),
            CycleStep::AskExternal(tti) => Phase::Asking(tti),
            CycleStep::TtiClosed => {
                if self.wants_states {
                    observer.notify(&Notification::DeviceStates(&self.views));
                }
                if let Some(LateTotals {
                    window_end,
                    events,
                    energy,
                }) = self.late_totals.take()
                {
                    let energy = energy.expect("the sums arrive with the answers to the grant");
                    self.end_window(window_end, energy, events, observer);
                }
                Phase::Between
            }
        };
    }

    fn end_window(&mut self, k: Tti, energy: DeviceTotals, events: EventTotals, observer: &mut impl Observer) {
        let window = self.window_accumulator.close_window(k, energy, events);
        self.is_stopped |= !observer.window_closed(&window);
    }
}
