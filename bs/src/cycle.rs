//! The steps of a TTI on the world, the base station and the score of a run. No I/O.
//!
//! [`Session`](crate::session::Session) calls the steps in their order: a grant, the reports of its last TTI, and the
//! wake-ups, one by one, until the TTI closes. Under an external policy, the cycle stops for a plan before a grant
//! (`Cycle::needs_external_plan`) and for wake-ups after reports (`CycleStep::AskExternal`).
//!
//! A grant covers one or more TTIs. All but the last are *quiet*: no device can detect an event in them, whatever its
//! battery, because no event is active or no device in range has δ = 1. The clock knows this from the plan and from the
//! world; the policy receives none of it. A run with one TTI per grant has the same outcome.
//!
//! A policy that decides in every TTI decides for all of them before the grant, since a quiet TTI brings no reports.
//! Only a policy that needs the true batteries has to wait for the devices.
//!
//! The digest covers events, plans, reports and wake-ups in the order in which the score receives them here, so this
//! order must stay the same.

use std::sync::Arc;

use reveille_common::codec;
use reveille_common::deployment::Deployment;
use reveille_common::event::Stimulus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    Change, DeviceRemoval, FailedTransmission, OperatorAction, PlanUpdate, Report, Setting, UnableDetectors,
    WakeOutcome, WakeUp,
};
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyStreams;
use reveille_common::score::{DeviceRecord, Digest, FinalScore, Metrics, Score};
use reveille_common::state::DeviceView;
use reveille_common::totals::{EventTotals, Ledger, Totals};
use reveille_common::units::Energy;
use reveille_common::world::{World, WorldChange};

use crate::base_station::BaseStation;
use crate::bounds_cache::BoundsCache;
use crate::knowledge::Knowledge;
use crate::observer::{Grant, Notification, Observer};
use crate::policy::external::{DecisionContext, DecisionStage, PlanDecision};
use crate::policy::factory::PolicyFactory;
use crate::policy::interface::{LearnedState, Policy};
use crate::scenario::Scenario;

/// Largest number of plans in a grant. More would not be faster, and all of them have to be decided, sent and kept
/// before any host answers.
const MAX_PLANS_PER_GRANT: usize = 64;

/// A wake-up to carry out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WakeOrder {
    /// The TTI that accounts for it.
    pub tti: Tti,
    /// Its number in this TTI, from 0.
    pub number: u32,
    /// The device to wake.
    pub device: DeviceId,
    /// The message on the air.
    pub message: WakeUp,
    /// The event once the device is awake; `None` if it is over by then. Ground truth.
    pub stimulus: Option<Stimulus>,
}

/// The next step after the reports of a TTI or the outcome of a wake-up.
#[derive(Clone, Copy, Debug)]
pub(crate) enum CycleStep {
    /// Carry out this wake-up, then call [`Cycle::complete_wake_up`].
    SendWakeUp(WakeOrder),
    /// Answer [`Cycle::wake_up_context`] of this TTI by [`Cycle::set_wake_ups`].
    AskExternal(Tti),
    /// The TTI is closed; the next may be granted.
    TtiClosed,
}

/// The world, the base station and the score of a run.
pub struct Cycle {
    scenario: Scenario,
    world: World,
    station: BaseStation,
    score: Score,
    /// The next TTI to be granted, or one of the open grant.
    next_tti: Tti,
    /// Whether a grant is out and its last TTI is not closed.
    is_open: bool,
    /// Number of wake-ups in the last granted TTI so far.
    wake_up_count: u32,
    /// The TTI of each device's last wake-up, in the order of ids; [`Tti::NEVER`] before the first.
    last_woken: Vec<Tti>,
    /// Changes of the world in the last grant; kept to reuse its memory.
    world_changes: Vec<WorldChange>,
}

impl Cycle {
    /// Creates the cycle of a run, before TTI 0.
    ///
    /// # Panics
    /// If the policy needs pilot runs and `prepared` has no choice.
    pub fn new(prepared: &PreparedRun) -> Self {
        Self::with_world(prepared, World::new(&prepared.scenario, &prepared.deployment))
    }

    /// Creates a cycle with a given world, such as one with scripted events.
    ///
    /// # Panics
    /// If the policy needs pilot runs and `prepared` has no choice.
    pub fn with_world(prepared: &PreparedRun, world: World) -> Self {
        let known = prepared.knowledge();
        let policy = prepared.policy(&known);
        Self::with_station(prepared, world, BaseStation::new(known, policy))
    }

    /// Creates a cycle with a given world and base station, both before TTI 0, such as one whose decisions are
    /// recorded.
    pub fn with_station(prepared: &PreparedRun, world: World, station: BaseStation) -> Self {
        Self {
            scenario: prepared.scenario.clone(),
            world,
            station,
            score: Score::new(&prepared.scenario, &prepared.deployment),
            next_tti: Tti::ZERO,
            is_open: false,
            wake_up_count: 0,
            last_woken: vec![Tti::NEVER; prepared.deployment.devices.len()],
            world_changes: Vec::new(),
        }
    }

    /// The next TTI to be granted; while a grant is open, one of its TTIs.
    pub const fn next_tti(&self) -> Tti {
        self.next_tti
    }

    /// Whether a grant is out and its last TTI is not closed.
    pub const fn is_open(&self) -> bool {
        self.is_open
    }

    /// The current plan.
    pub const fn plan(&self) -> &Plan {
        self.station.plan()
    }

    /// Sums over the counted events that have ended.
    pub(crate) const fn event_totals(&self) -> &EventTotals {
        self.score.events()
    }

    /// Devices that detect the event in the last granted TTI if their battery allows it. Ground truth, for a shell that
    /// owns all devices.
    pub fn detectors(&self) -> &[DeviceId] {
        self.world.detectors()
    }

    /// Whether the policy decides for TTI `k` and needs the true batteries for it.
    pub(crate) fn needs_true_batteries_for(&self, k: Tti) -> bool {
        self.station.needs_true_batteries_for(k)
    }

    /// Reveals the true battery `levels` at the end of the last TTI to the policy, one per device in the order of ids.
    /// Call it when [`Self::needs_true_batteries_for`] holds for the next TTI and no TTI is open.
    pub(crate) fn set_true_batteries(
        &mut self,
        levels: impl IntoIterator<Item = Energy>,
        observer: &mut impl Observer,
    ) {
        self.station.set_true_batteries(levels);
        observer.batteries_revealed(self.next_tti, self.station.batteries());
    }

    /// Whether an external policy has to decide a plan before the next grant. False if a policy of this program
    /// decides, the last plan still holds, or the decision has been made.
    #[inline]
    pub(crate) fn needs_external_plan(&self) -> bool {
        !self.is_open && self.station.needs_external_plan(self.next_tti)
    }

    /// The context of an external policy's plan for the next TTI, even if no plan is due and at the end of the run.
    /// `None` while a TTI is open or if a policy of this program decides.
    pub fn next_plan_context(&self) -> Option<DecisionContext<'_>> {
        (!self.is_open).then(|| self.station.decision_context(self.next_tti, DecisionStage::Plan))?
    }

    /// Takes the plan that [`Self::needs_external_plan`] asks for.
    ///
    /// # Panics
    /// If no decision is due.
    pub(crate) fn set_plan(&mut self, decision: PlanDecision) {
        assert!(self.needs_external_plan(), "no plan was requested");
        self.station.set_plan(decision);
    }

    /// The context of the wake-ups that an external policy has to decide in TTI `tti`, after
    /// [`CycleStep::AskExternal`].
    ///
    /// # Panics
    /// If a policy of this program decides.
    pub(crate) fn wake_up_context(&self, tti: Tti) -> DecisionContext<'_> {
        let context = self.station.decision_context(tti, DecisionStage::Wake);
        context.expect("an external policy has asked")
    }

    /// Answers [`Self::wake_up_context`]: wake these devices in this order, then ask again; an empty list ends the
    /// wake-ups of the TTI. [`external`](crate::policy::external) lists the devices that are left out.
    ///
    /// # Panics
    /// If a policy of this program decides.
    pub(crate) fn set_wake_ups(&mut self, tti: Tti, devices: &[DeviceId], observer: &mut impl Observer) -> CycleStep {
        self.station.set_wake_ups(tti, devices);
        self.next_step(tti, observer)
    }

    /// A copy that continues from here, under an external policy; `None` under any other.
    pub(crate) fn fork(&self) -> Option<Self> {
        Some(Self {
            station: self.station.fork()?,
            scenario: self.scenario.clone(),
            world: self.world.clone(),
            last_woken: self.last_woken.clone(),
            score: self.score.clone(),
            world_changes: self.world_changes.clone(),
            ..*self
        })
    }

    /// Makes `changes` at the start of [`Self::next_tti`], before its grant. The shell makes changes of devices on the
    /// devices themselves. The station receives no notice of failed devices, only silence.
    pub(crate) fn apply_changes(&mut self, changes: &[Change], observer: &mut impl Observer) {
        let tti = self.next_tti;
        for &change in changes {
            match change {
                Change::Set(Setting::EventRate, alpha) => self.world.set_event_rate(tti, alpha),
                Change::Set(Setting::Price, price) => self.station.set_price(price),
                Change::Fail(_) | Change::Revive(_) | Change::AddEnergy(..) => {}
            }
            let action = OperatorAction { tti, change };
            self.score.record_action(&action);
            observer.notify(&Notification::ActionTaken(&action));
        }
    }

    /// Grants TTIs from [`Self::next_tti`] on, all before `horizon`. The grant ends earlier at the first TTI in which a
    /// device can detect an event, and before a TTI whose plan must still be decided.
    ///
    /// Also returns the plans sent in the granted TTIs, TTI by TTI: a new plan, or the current plan again for
    /// synchronisation.
    ///
    /// # Panics
    /// If the last grant is still open, `horizon` is not after the next TTI, or [`Self::needs_external_plan`].
    pub(crate) fn grant(&mut self, horizon: Tti, observer: &mut impl Observer) -> (Grant, Vec<PlanUpdate>) {
        assert!(!self.is_open, "TTI {} is still open", self.next_tti);
        let first = self.next_tti;
        assert!(first < horizon, "a grant covers at least one TTI");
        // True batteries come from the devices, so a plan for a later TTI must wait until this grant is answered.
        let can_plan_ahead = !self.station.needs_true_batteries();
        let mut updates = Vec::new();
        let last_span = loop {
            updates.extend(self.issue_plan(observer));
            let span = self.advance_until_plan(horizon, observer);
            if !can_plan_ahead
                || updates.len() >= MAX_PLANS_PER_GRANT
                || span.stimulus.is_some()
                || span.last + 1 >= horizon
                || self.station.needs_external_plan(span.last + 1)
            {
                break span;
            }
            // A quiet TTI brings no reports, so the station can close its reports before the devices have run it.
            self.station.take_reports(span.last, &[]);
            self.next_tti = span.last + 1;
        };
        self.is_open = true;
        (Grant { first, ..last_span }, updates)
    }

    /// Begins the next TTI at the station. Returns the plan to send in it, if any.
    fn issue_plan(&mut self, observer: &mut impl Observer) -> Option<PlanUpdate> {
        let k = self.next_tti;
        let (update, is_new) = self.station.begin_tti(k)?;
        self.score.record_plan(&update, is_new, codec::encoded_len(&update));
        // Sent before the world advances: a device that misses the plan senses by the one it has.
        let missed = self.world.send_plan(k, &update.plan);
        self.score
            .record_missed_plans(k, u64::from(self.scenario.run.devices), missed);
        observer.notify(&Notification::PlanSent {
            update: &update,
            is_new,
        });
        Some(update)
    }

    /// Advances the world from the next TTI, before `horizon` and before the next plan is sent. All TTIs but the last
    /// are quiet.
    fn advance_until_plan(&mut self, horizon: Tti, observer: &mut impl Observer) -> Grant {
        // One plan must hold for the whole span: the world finds the first device that can react under that plan.
        let grant = self.advance_world(
            self.next_tti,
            horizon.min(self.station.next_plan_or_decision(self.next_tti)),
        );
        observer.notify(&Notification::TtisGranted(&grant));
        for change in self.world_changes.drain(..) {
            match change {
                WorldChange::Started(event) => {
                    self.score.record_event_start(event);
                    observer.notify(&Notification::EventStarted(&event));
                }
                WorldChange::Missed(last) => {
                    observer.notify(&Notification::EventEnded(&self.score.record_event_end(last, 0.0)));
                }
            }
        }
        grant
    }

    /// Advances the world from `first` to the first TTI in which a device can detect an event, at most to before
    /// `horizon`.
    fn advance_world(&mut self, first: Tti, horizon: Tti) -> Grant {
        let Self {
            world,
            station,
            world_changes,
            ..
        } = self;
        let (plan, oracle) = station.plan_and_oracle();
        let stimulated = world.advance(first, horizon, plan, oracle, world_changes);
        Grant {
            first,
            // No underflow: the caller's limit and the next plan are both after `first`.
            last: stimulated.unwrap_or(Tti(horizon.0 - 1)),
            stimulus: stimulated.and_then(|_| world.stimulus()),
            event_last_tti: world.event_last_tti(),
        }
    }

    /// Takes in the reports of TTI `tti`, the last of the open grant, and the devices that failed to report, in any
    /// order. Call it once per grant.
    pub(crate) fn complete_grant(
        &mut self,
        tti: Tti,
        answers: GrantAnswers<'_>,
        observer: &mut impl Observer,
    ) -> CycleStep {
        let GrantAnswers {
            reports,
            failures,
            unable,
            views: _,
        } = answers;
        // Answers arrive from the bus in any order. The digest, the score and the station need one order, by device.
        reports.sort_unstable_by_key(|report| report.device);
        failures.sort_unstable_by_key(|failure| failure.device);
        let arrived_count = self.transmit_reports(tti, reports, observer);
        for failure in failures.iter() {
            self.score.record_failed_transmission(failure);
            observer.notify(&Notification::ReportFailed { tti, failure });
        }
        self.score.record_unable_detectors(unable);
        self.station.take_reports(tti, &reports[..arrived_count]);
        // `next_step` numbers the wake-ups of a TTI from 0; queued removals refer to these numbers.
        self.wake_up_count = 0;
        self.next_step(tti, observer)
    }

    /// Transmits the `reports` of a TTI to the base station, and moves those that arrive to the front, in order.
    /// Returns their number.
    fn transmit_reports(&mut self, tti: Tti, reports: &mut [Report], observer: &mut impl Observer) -> usize {
        // The base station never sees a lost report, so the score and the observer must count it here.
        let losses = self.world.losses_at(tti);
        let mut arrived_count = 0;
        for i in 0..reports.len() {
            let report = reports[i];
            if losses.loses_report(report.device) {
                self.score.record_lost_report(&report);
                observer.notify(&Notification::ReportLost(&report));
            } else {
                self.score.record_report(&report);
                observer.notify(&Notification::ReportReceived(&report));
                reports[arrived_count] = report;
                arrived_count += 1;
            }
        }
        arrived_count
    }

    /// Removes devices in the last granted TTI. The station receives no notice, only silence.
    pub(crate) fn remove_devices(&mut self, removal: &DeviceRemoval, observer: &mut impl Observer) {
        self.score.record_removal(removal);
        observer.notify(&Notification::DevicesRemoved(removal));
    }

    /// Whether `device` is removed.
    pub(crate) fn is_removed(&self, device: DeviceId) -> bool {
        self.score.is_removed(device)
    }

    /// Takes in the outcome of the wake-up that the last [`CycleStep`] asked for.
    pub(crate) fn complete_wake_up(
        &mut self,
        order: &WakeOrder,
        outcome: WakeOutcome,
        observer: &mut impl Observer,
    ) -> CycleStep {
        let WakeOrder { tti, device, .. } = *order;
        // Only the radio model determines whether the report was lost on the way; the device does not know.
        let outcome = &outcome.after_uplink(&self.world.losses_at(tti));
        // `is_beyond_d_max` needs an open event. There is one, since the world closes it only after the last wake-up.
        self.score
            .record_wake_up_outcome(tti, device, outcome, self.world.is_beyond_d_max(device));
        observer.notify(&Notification::WakeUpCompleted { tti, device, outcome });
        let report = match outcome {
            WakeOutcome::Reported(report) => Some(report),
            WakeOutcome::Failed(_) | WakeOutcome::Missed | WakeOutcome::Lost(_) | WakeOutcome::Late { .. } => None,
        };
        self.station.take_wake_up_answer(tti, device, report);
        self.next_step(tti, observer)
    }

    /// The group of each device, in the order of ids, if the policy groups devices by place.
    pub fn groups(&self) -> Option<&[u32]> {
        self.station.policy().device_groups()
    }

    /// Returns the outcome of the run. `ledgers` has the ledgers of all devices, in the order of ids.
    ///
    /// # Panics
    /// If the last grant is still open.
    pub(crate) fn finish(self, ledgers: &[Ledger]) -> RunOutcome {
        assert!(!self.is_open, "TTI {} is still open", self.next_tti);
        let (events, measured_from) = (&self.scenario.events, self.scenario.warm_up_end());
        // The probability in the measured TTIs, which differs from α where it changes with time.
        let alpha = events.mean_start_probability(self.scenario.run.seed, measured_from, self.next_tti);
        let FinalScore {
            digest,
            metrics,
            start_probability,
            totals,
            devices,
        } = self.score.finish(alpha, self.next_tti, ledgers);
        RunOutcome {
            facts: self.station.policy().summary_facts(),
            learned: self.station.policy().learned_state(),
            digest,
            metrics,
            start_probability,
            totals,
            devices,
            ttis_done: self.next_tti.0,
            is_complete: self.next_tti.0 == self.scenario.run.ttis,
        }
    }

    /// Returns the policy's next wake-up in `tti`, or closes the TTI.
    ///
    /// # Panics
    /// If the policy names a device twice in a TTI, or a device that does not exist.
    fn next_step(&mut self, tti: Tti, observer: &mut impl Observer) -> CycleStep {
        if let Some(device) = self.station.next_wake_up(tti) {
            let number = self.wake_up_count;
            // A second wake-up in a TTI would be a retransmission to a host and a new wake-up in memory. A policy that
            // repeats a device would never end the TTI.
            assert!(
                self.last_woken.get(device.index()).is_some_and(|&last| last != tti),
                "policy {} wakes {device} in TTI {tti}, which does not exist or is woken already; `next_wake_up` must \
                 name a device of the run at most once per TTI",
                self.scenario.policy.name()
            );
            self.last_woken[device.index()] = tti;
            self.wake_up_count += 1;
            let sent = self.scenario.radio.send_tti(tti, u64::from(number));
            let message = WakeUp { tti: sent };
            let is_late = self.scenario.radio.is_late(sent, self.world.event_last_tti());
            self.score.record_wake_up(tti, codec::encoded_len(&message));
            observer.notify(&Notification::WakeUpSent { tti, device, sent });
            return CycleStep::SendWakeUp(WakeOrder {
                tti,
                number,
                device,
                message,
                stimulus: self.world.stimulus().filter(|_| !is_late),
            });
        }
        // Queued wake-ups come first: the policy process decides again only when it has seen all their outcomes.
        if self.station.needs_external_wake_ups(tti) {
            return CycleStep::AskExternal(tti);
        }
        if observer.wants_beliefs() {
            let places = self.station.belief();
            if !places.is_empty() {
                observer.notify(&Notification::BeliefUpdated { tti, places: &places });
            }
        }
        // The score takes Î before the station resets it for the next TTI.
        if self.world.close_tti(tti, self.score.is_reported()) {
            let record = self.score.record_event_end(tti, self.station.information());
            observer.notify(&Notification::EventEnded(&record));
        }
        self.station.close_tti(tti);
        observer.notify(&Notification::TtiClosed(tti));
        (self.is_open, self.next_tti) = (false, tti + 1);
        CycleStep::TtiClosed
    }
}

/// The answers of all devices to a grant.
#[derive(Debug)]
pub struct GrantAnswers<'a> {
    /// Reports, in any order; sorted by the call.
    pub reports: &'a mut [Report],
    /// Devices that detected the event and could not transmit, in any order; sorted by the call.
    pub failures: &'a mut [FailedTransmission],
    /// Devices that would have detected the event, but could not sense.
    pub unable: UnableDetectors,
    /// States and batteries of all devices at the end of the grant, in the order of ids, if the grant asks for them.
    /// The session keeps them for the policy and the observer; the cycle ignores them.
    pub views: &'a [DeviceView],
}

/// Result of a run, complete or partial.
#[derive(Clone, Debug, PartialEq)]
pub struct RunOutcome {
    /// The run's digest.
    pub digest: Digest,
    /// The metrics of its measured part.
    pub metrics: Metrics,
    /// The α of `info_p1`: the mean probability that an event starts, over the measured TTIs.
    pub start_probability: f64,
    /// The exact totals behind them.
    pub totals: Totals,
    /// Records of all devices, in the order of ids.
    pub devices: Vec<DeviceRecord>,
    /// Figures about the deployment that the policy has determined, by name.
    pub facts: Vec<(&'static str, f64)>,
    /// Tables of a learning policy at the end of the run.
    pub learned: Option<LearnedState>,
    /// TTIs that were run.
    pub ttis_done: u64,
    /// Whether the run has reached its last TTI.
    pub is_complete: bool,
}

/// A scenario with its deployment and the results of the pilot runs that its policy needs.
#[derive(Clone, Debug)]
pub struct PreparedRun {
    /// The scenario.
    pub scenario: Scenario,
    /// Its devices.
    pub deployment: Deployment,
    /// The factory chosen by pilot runs, if the policy needs any.
    pub pilot_choice: Option<Arc<dyn PolicyFactory>>,
    /// Warnings from the pilot runs, one sentence each, without a stop.
    pub warnings: Vec<String>,
    /// Random streams of the policy. A pilot run uses the streams of its run, so that both judge the same policy.
    pub streams: PolicyStreams,
    /// Bounds of P_4,2, shared with other runs.
    pub correlation_bounds: Arc<BoundsCache>,
}

impl PreparedRun {
    /// Prepares `scenario` with its deployment, for a policy that needs no pilot runs; `lab/src/preparation.rs`
    /// prepares any.
    pub fn without_pilots(scenario: &Scenario) -> Self {
        Self {
            deployment: Deployment::new(scenario),
            scenario: scenario.clone(),
            pilot_choice: None,
            streams: PolicyStreams::new(scenario.run.seed),
            warnings: Vec::new(),
            correlation_bounds: Arc::default(),
        }
    }

    /// The base station's knowledge of the run.
    pub fn knowledge(&self) -> Knowledge {
        Knowledge {
            streams: self.streams.clone(),
            ..Knowledge::from_scenario(&self.scenario, &self.deployment, Arc::clone(&self.correlation_bounds))
        }
    }

    /// The policy, for a base station with the knowledge `known`.
    ///
    /// # Panics
    /// If the policy needs pilot runs and `pilot_choice` is `None`.
    pub fn policy(&self, known: &Knowledge) -> Box<dyn Policy> {
        let pilot_choice = self.pilot_choice.as_deref();
        pilot_choice
            .unwrap_or_else(|| self.scenario.policy.settings())
            .build(known)
    }
}
