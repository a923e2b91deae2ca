//! The base station as a state machine without I/O: its knowledge, the current plan, and the policy that decides.
//!
//! [`Cycle`](crate::cycle::Cycle) calls it in the order of a TTI. It receives reports or their absence, never the
//! ground truth; only a genie receives events, through [`BaseStation::plan_and_oracle`]. Policies keep state from call
//! to call, so digests depend on the order of these calls: [`BaseStation::begin_tti`] and
//! [`BaseStation::take_reports`], each wake-up with its answer, then [`BaseStation::close_tti`]. Quiet TTIs under one
//! plan need only the first two, for the first and for the last of them.

use std::any::Any;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{PlanUpdate, Report, WeightedPoint};
use reveille_common::plan::Plan;
use reveille_common::units::Energy;
use reveille_common::world::Oracle;

use crate::battery_estimator::BatteryEstimator;
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::policy::external::{DecisionContext, DecisionStage, External, PlanDecision};
use crate::policy::interface::Policy;

/// The base station of one run.
pub struct BaseStation {
    view: PolicyView,
    policy: Box<dyn Policy>,
    /// Whether the policy receives ground truth.
    has_oracle: bool,
    is_external: bool,
    /// TTI in which the policy decides next.
    next_decision: Tti,
    /// Whether a device with δ = 1 has reported in this TTI. Reports of woken devices do not count.
    has_report: bool,
}

/// The data from which the policy's observations are made.
#[derive(Clone)]
struct PolicyView {
    known: Knowledge,
    plan: Plan,
    /// The battery levels that the BS knows, for a policy that reads batteries or wakes devices.
    battery_estimator: Option<BatteryEstimator>,
    /// Whether the policy reads batteries, so that the levels advance in each TTI.
    reads_batteries: bool,
    /// Î of this TTI.
    information: f64,
}

impl PolicyView {
    fn observation(&self, now: Tti) -> Observation<'_> {
        Observation {
            now,
            known: &self.known,
            plan: &self.plan,
            information: self.information,
            batteries: self
                .battery_estimator
                .as_ref()
                .filter(|_| self.reads_batteries)
                .map_or(&[], BatteryEstimator::levels),
            battery_estimator: self.battery_estimator.as_ref(),
        }
    }

    /// Fuses a report about the event into Î.
    fn fuse(&mut self, report: &Report) {
        self.information = self.known.sensing.fuse(self.information, report.information);
    }
}

impl BaseStation {
    /// Creates a base station with the knowledge `known` and the given policy, before TTI 0.
    pub fn new(known: Knowledge, mut policy: Box<dyn Policy>) -> Self {
        let view = PolicyView {
            plan: Plan::from_bits(known.devices.iter().map(|_| false)),
            battery_estimator: if policy.needs_batteries() {
                Some(BatteryEstimator::new(&known))
            } else {
                // A policy that only wakes devices asks whether they can pay for a report, so levels need no update in
                // each TTI.
                policy
                    .needs_battery_estimates()
                    .then(|| BatteryEstimator::new_estimated(&known))
            },
            reads_batteries: policy.needs_batteries(),
            known,
            information: 0.0,
        };
        Self {
            view,
            has_oracle: policy.oracle().is_some(),
            is_external: downcast_external(&*policy).is_some(),
            policy,
            next_decision: Tti::ZERO,
            has_report: false,
        }
    }

    /// The current plan.
    pub const fn plan(&self) -> &Plan {
        &self.view.plan
    }

    /// Î of the TTI that is open or was closed last: the information gathered about the event, `[0, Ψ]`.
    pub const fn information(&self) -> f64 {
        self.view.information
    }

    /// The policy.
    pub fn policy(&self) -> &dyn Policy {
        &*self.policy
    }

    /// The policy if an external program decides. The flag spares all other policies the dynamic dispatch in each TTI.
    fn external(&self) -> Option<&External> {
        self.is_external.then(|| downcast_external(&*self.policy))?
    }

    /// The policy's belief about the place of this TTI's event. Empty if the policy has none, or no report arrived.
    pub fn belief(&self) -> Vec<WeightedPoint> {
        let belief = self.has_report.then(|| self.policy.epicentre_belief()).flatten();
        belief.map_or_else(Vec::new, EpicentreBelief::weighted_points)
    }

    /// Whether an external policy has to decide a plan before TTI `k` begins.
    pub(crate) fn needs_external_plan(&self, k: Tti) -> bool {
        self.external().is_some_and(|external| external.needs_plan(k))
    }

    /// Whether an external policy has to decide wake-ups in TTI `tti`.
    pub(crate) fn needs_external_wake_ups(&self, tti: Tti) -> bool {
        let external = self.external().filter(|_| self.has_report);
        external.is_some_and(|external| external.needs_wake_ups(&self.view.observation(tti)))
    }

    /// The decision context for an external policy in TTI `k`; `None` if a policy of this program decides.
    pub fn decision_context(&self, k: Tti, stage: DecisionStage) -> Option<DecisionContext<'_>> {
        let observation = self.view.observation(k);
        let observation = match stage {
            // Nothing has been gathered in a TTI that has not begun; `information` is still the value of the last one.
            DecisionStage::Plan => Observation {
                information: 0.0,
                ..observation
            },
            DecisionStage::Wake => observation,
        };
        self.external().map(|external| external.context(stage, observation))
    }

    /// Closes TTI `tti` in the history of an external policy; without effect under any other.
    pub fn close_tti(&mut self, tti: Tti) {
        if self.is_external {
            let (external, view) = self.external_and_view();
            external.end_ttis_before(tti + 1, &view.plan);
        }
    }

    /// Sets the plan of an external policy for the next TTI.
    ///
    /// # Panics
    /// If a policy of this program decides.
    pub(crate) fn set_plan(&mut self, decision: PlanDecision) {
        self.external_and_view().0.set_plan(decision);
    }

    /// Changes the price θ under `age-index`; without effect under any other policy.
    pub(crate) fn set_price(&mut self, price: f64) {
        self.policy.set_price(&self.view.known, price);
    }

    /// Sets the wake-ups of an external policy in TTI `tti`.
    ///
    /// # Panics
    /// If a policy of this program decides.
    pub(crate) fn set_wake_ups(&mut self, tti: Tti, devices: &[DeviceId]) {
        let (external, view) = self.external_and_view();
        external.set_wake_ups(&view.observation(tti), devices);
    }

    fn external_and_view(&mut self) -> (&mut External, &PolicyView) {
        let policy: &mut dyn Any = &mut *self.policy;
        let external = policy.downcast_mut();
        (
            external.expect("a policy that decides itself receives no decisions"),
            &self.view,
        )
    }

    /// A copy that continues from here, under an external policy; `None` under any other, since those cannot be copied.
    pub fn fork(&self) -> Option<Self> {
        let external = self.external()?;
        Some(Self {
            view: self.view.clone(),
            policy: Box::new(external.clone()),
            ..*self
        })
    }

    /// The current plan, and the oracle interface of a genie, which receives events.
    pub fn plan_and_oracle(&mut self) -> (&Plan, Option<&mut dyn Oracle>) {
        let Self {
            view,
            policy,
            has_oracle,
            ..
        } = self;
        (&view.plan, has_oracle.then(|| policy.oracle()).flatten())
    }

    /// Whether the policy decides for TTI `k` and needs the true batteries for it.
    pub(crate) fn needs_true_batteries_for(&self, k: Tti) -> bool {
        // The initial levels are part of `Knowledge`, so TTI 0 needs no levels from the devices.
        k >= self.next_decision && k > Tti::ZERO && self.needs_true_batteries()
    }

    /// Whether the policy needs the true batteries for its decisions after TTI 0.
    pub(crate) fn needs_true_batteries(&self) -> bool {
        self.view
            .battery_estimator
            .as_ref()
            .is_some_and(BatteryEstimator::needs_true_levels)
    }

    /// The levels of the battery estimator, in the order of ids; empty without one. They are current in each
    /// TTI only for a policy that reads batteries.
    pub fn batteries(&self) -> &[Energy] {
        self.view
            .battery_estimator
            .as_ref()
            .map_or(&[], BatteryEstimator::levels)
    }

    /// Sets the true battery levels of all devices, in the order of ids, at the end of the last TTI. Call it
    /// only if [`Self::needs_true_batteries_for`] holds for the next TTI.
    ///
    /// # Panics
    /// If `levels` has not one level per device.
    pub(crate) fn set_true_batteries(&mut self, levels: impl IntoIterator<Item = Energy>) {
        if let Some(estimator) = &mut self.view.battery_estimator {
            estimator.set_true_levels(levels);
        }
    }

    /// Begins TTI `k`. If a decision is due, the policy makes it now. Returns the plan to send, if any, and whether it
    /// is new; a plan that is not new is sent for synchronisation.
    ///
    /// # Panics
    /// If an external plan is due and not set, or the policy names no later TTI for its next decision.
    pub fn begin_tti(&mut self, k: Tti) -> Option<(PlanUpdate, bool)> {
        let mut is_new = k == Tti::ZERO;
        // The policy must not see Î of the previous TTI when it decides for this one.
        self.view.information = 0.0;
        self.has_report = false;
        if k >= self.next_decision {
            let decided = self.policy.decide(&self.view.observation(k));
            self.next_decision = self.policy.next_decision(k);
            assert!(self.next_decision > k, "a policy decides at most once per TTI");
            is_new |= decided != self.view.plan;
            let PolicyView {
                plan,
                battery_estimator,
                reads_batteries,
                ..
            } = &mut self.view;
            // Levels advance under the plan that was valid in the past TTIs, so this comes before the new plan.
            if let Some(battery_estimator) = battery_estimator.as_mut().filter(|_| !*reads_batteries) {
                battery_estimator.advance(k, plan);
            }
            *plan = decided;
        }
        // Repeating the plan also reaches devices that missed it.
        if !is_new && !k.0.is_multiple_of(self.view.known.bs.sync_interval) {
            return None;
        }
        let plan = self.view.plan.clone();
        Some((PlanUpdate { from: k, plan }, is_new))
    }

    /// The next TTI after `k` in which the station sends a plan or decides.
    pub(crate) fn next_plan_or_decision(&self, k: Tti) -> Tti {
        let sync = self.view.known.bs.sync_interval;
        Tti((k.0 / sync + 1) * sync).min(self.next_decision)
    }

    /// Takes in the reports of TTI `tti`, in the order of ids. After quiet TTIs, one call for the last of them is
    /// enough.
    pub fn take_reports(&mut self, tti: Tti, reports: &[Report]) {
        let Self {
            view,
            policy,
            has_report,
            ..
        } = self;
        (view.information, *has_report) = (0.0, !reports.is_empty());
        if let Some(battery_estimator) = &mut view.battery_estimator {
            if view.reads_batteries {
                // Policies of this program that read batteries decide in every TTI. Only a plan of `external` may hold
                // longer.
                battery_estimator.advance(tti + 1, &view.plan);
            }
            battery_estimator.update_from_reports(tti, &view.plan, reports);
        }
        for report in reports {
            view.fuse(report);
        }
        if *has_report {
            policy.reports_received(&view.observation(tti), reports);
        }
    }

    /// The next device to wake in `tti`, if any.
    pub fn next_wake_up(&mut self, tti: Tti) -> Option<DeviceId> {
        // Without a report a base station knows of no event; only the genie, which receives events, may wake anyway.
        let may_wake = self.has_report || self.has_oracle;
        may_wake
            .then(|| self.policy.next_wake_up(&self.view.observation(tti)))
            .flatten()
    }

    /// Takes in the answer to the wake-up of `device`: its report, or none.
    pub fn take_wake_up_answer(&mut self, tti: Tti, device: DeviceId, report: Option<&Report>) {
        let view = &mut self.view;
        // The policy sees the new level in `take_wake_up_answer`, so levels come first.
        if let Some(battery_estimator) = &mut view.battery_estimator {
            match report {
                Some(report) => battery_estimator.observe_level(device, tti, report.battery),
                None => battery_estimator.observe_unanswered_wake_up(device, tti, &view.plan),
            }
        }
        if let Some(report) = report {
            view.fuse(report);
        }
        self.policy.take_wake_up_answer(&view.observation(tti), report);
    }
}

fn downcast_external(policy: &dyn Policy) -> Option<&External> {
    let policy: &dyn Any = policy;
    policy.downcast_ref()
}
