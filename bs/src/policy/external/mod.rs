//! The policy `external`, whose decisions come from a policy process. [`External`] holds their state; the base
//! station (`base_station.rs`) asks it which decision is due and passes the decisions on.
//!
//! The driver of the cycle sends a decision request and continues once it has the decision; the cycle never waits.
//!
//! ```text
//!           plan request                    wake request
//!   TTI k ─────────────► δ ──► reports? ──yes──────────────► wake? ──► each is woken ──┐
//!     ▲                           │ no            ▲            │ none, or none left     │
//!     └───────────────────────────┴───────────────┼────────────┘                        │
//!                                                 └─────────────────────────────────────┘
//! ```
//! A plan request is sent only from [`PlanDecision::next`] on. A wake request is sent only while a device can be woken;
//! otherwise the TTI has no further wake-ups.
//!
//! On the bus, `bs/src/server/policy_port/` sends the requests ([`wire`] holds the messages). In memory, the code that
//! steps the run asks directly. A run with recorded decisions needs no requests.
//!
//! A decision cannot break a run, since it is projected on the allowed actions. A δ plan is fitted to the devices
//! ([`PlanDecision::plan`]). A wake-up is dropped if its device does not exist, does not sleep by the plan, or was
//! already woken ([`DecisionContext::may_wake`]). If no wake-up remains, the TTI has no further wake-ups. Actions of
//! devices without energy fail. The input log holds unprojected decisions, so replays need the same projection.

mod decision;
mod features;
mod history;
pub mod wire;

use std::collections::VecDeque;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};

pub use self::decision::{Decision, DecisionContext, DecisionStage, PlanDecision, RecordedDecision};
pub use self::features::{DEVICE_FEATURES, Feature, GLOBAL_FEATURES};
pub use self::history::ReportHistory;
use super::interface::Policy;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Decision state of the `external` policy. `BaseStation::fork` clones it, so it holds no link to a policy process.
#[derive(Clone, Debug)]
pub struct External {
    /// Plan decision for the coming TTI, fitted to the devices.
    pending_plan: Option<PlanDecision>,
    /// TTI of the next plan request.
    next_plan_request: Tti,
    /// See [`DecisionContext::reports`].
    reports: Vec<Report>,
    /// See [`DecisionContext::woken`].
    woken: Vec<bool>,
    /// Devices that are still to be woken.
    wake_queue: VecDeque<DeviceId>,
    /// Whether no wake-up decision is needed until the next reports.
    are_wake_ups_done: bool,
    history: ReportHistory,
}

impl External {
    /// Creates the state before TTI 0, for the devices in `known`.
    pub fn new(known: &Knowledge) -> Self {
        Self {
            pending_plan: None,
            next_plan_request: Tti::ZERO,
            reports: Vec::new(),
            woken: vec![false; known.n()],
            wake_queue: VecDeque::new(),
            are_wake_ups_done: true,
            history: ReportHistory::new(known),
        }
    }

    /// Whether a plan decision is needed before TTI `k` begins.
    pub(crate) fn needs_plan(&self, k: Tti) -> bool {
        self.pending_plan.is_none() && k >= self.next_plan_request
    }

    /// Whether a wake-up decision is needed in the TTI of `seen`: a report arrived, a device can be woken, and the last
    /// decision of this TTI, if any, woke at least one device, with all its wake-ups complete.
    pub(crate) fn needs_wake_ups(&self, seen: &Observation<'_>) -> bool {
        let mut devices = (0..self.woken.len() as u32).map(DeviceId);
        // If no device can be woken, every decision would be empty, so no request is sent.
        !self.are_wake_ups_done
            && self.wake_queue.is_empty()
            && devices.any(|j| decision::may_wake(seen, &self.woken, j))
    }

    /// Returns the decision context of `stage` for the given observation.
    pub fn context<'a>(&'a self, stage: DecisionStage, observation: Observation<'a>) -> DecisionContext<'a> {
        DecisionContext {
            stage,
            observation,
            reports: &self.reports,
            woken: &self.woken,
            history: &self.history,
        }
    }

    /// Sets the decision at [`DecisionStage::Plan`].
    pub(crate) fn set_plan(&mut self, decision: PlanDecision) {
        let PlanDecision { plan, next } = decision;
        let plan = fit_to_devices(&plan, self.woken.len() as u32);
        self.pending_plan = Some(PlanDecision { plan, next });
    }

    /// Sets the decision at [`DecisionStage::Wake`]: the devices to wake, in this order.
    pub(crate) fn set_wake_ups(&mut self, seen: &Observation<'_>, devices: &[DeviceId]) {
        for &device in devices {
            if decision::may_wake(seen, &self.woken, device) {
                // Marked when queued, so that a device listed twice is woken once.
                self.woken[device.index()] = true;
                self.wake_queue.push_back(device);
            }
        }
        self.are_wake_ups_done = self.wake_queue.is_empty();
    }

    /// Ends the TTIs before `end`; TTIs still open passed under `plan`.
    pub fn end_ttis_before(&mut self, end: Tti, plan: &Plan) {
        self.history.advance(end, plan);
    }
}

impl Policy for External {
    /// # Panics
    /// If there is no plan for this TTI: the driver must call `set_plan` whenever `needs_plan` holds.
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let PlanDecision { plan, next } = self.pending_plan.take().expect("a driver supplies the requested plan");
        // The decision can name a TTI that has passed, but the base station requires a later one.
        self.next_plan_request = next.max(seen.now + 1);
        plan
    }

    fn next_decision(&self, _: Tti) -> Tti {
        self.next_plan_request
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        // The TTIs before this one pass first, since the reports belong to this one.
        self.history.advance(seen.now, seen.plan);
        self.history.start_event(reports);
        self.reports.clear();
        self.reports.extend_from_slice(reports);
        self.woken.fill(false);
        self.wake_queue.clear();
        self.are_wake_ups_done = false;
    }

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        self.wake_queue.pop_front()
    }

    fn take_wake_up_answer(&mut self, _: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            self.history.add_report(report);
            self.reports.push(*report);
        }
    }

    fn needs_batteries(&self) -> bool {
        true
    }
}

/// Fits `plan` to the devices 0 to `device_count` − 1.
fn fit_to_devices(plan: &Plan, device_count: u32) -> Plan {
    let cycles = (0..device_count).map(|j| plan.duty_cycle(DeviceId(j)));
    match plan {
        Plan::Bits { .. } => Plan::from_bits(cycles.map(|cycle| cycle == DutyCycle::SENSING)),
        Plan::Periodic(_) => Plan::Periodic(cycles.collect()),
    }
}
