//! The base station as a state machine without I/O: its knowledge, the current plan, and the policy that decides.
//!
//! It receives reports or their absence, never the ground truth.

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
pub struct Station {
    view: View,
    policy: Box<dyn Policy>,
    /// Whether the policy receives ground truth.
    is_told: bool,
    /// Whether the policy is `external`.
    is_external: bool,
    next_decision: Tti,
    /// Whether a report has arrived in this TTI.
    has_heard: bool,
}

/// The policy's view of the run.
#[derive(Clone)]
struct View {
    known: Knowledge,
    plan: Plan,
    /// The battery levels that the BS knows, for a policy that reads batteries or wakes devices.
    levels: Option<BatteryEstimator>,
    /// Whether the policy reads batteries, so that the levels advance in each TTI.
    shows_levels: bool,
    /// Î of this TTI.
    information: f64,
}

impl View {
    fn at(&self, now: Tti) -> Observation<'_> {
        Observation {
            now,
            known: &self.known,
            plan: &self.plan,
            information: self.information,
            batteries: self
                .levels
                .as_ref()
                .filter(|_| self.shows_levels)
                .map_or(&[], BatteryEstimator::all),
            levels: self.levels.as_ref(),
        }
    }

    /// Fuses a report about the event into Î.
    fn fuse(&mut self, report: &Report) {
        self.information = self.known.sensing.fuse(self.information, report.information);
    }
}

impl Station {
    /// Creates a base station with the knowledge `known` and the given policy, before TTI 0.
    pub fn new(known: Knowledge, mut policy: Box<dyn Policy>) -> Self {
        let view = View {
            plan: Plan::from_bits(known.devices.iter().map(|_| false)),
            levels: if policy.needs_batteries() {
                Some(BatteryEstimator::new(&known))
            } else {
                // A policy that only wakes devices asks whether they can pay for a report, so levels need no update in
                // each TTI.
                policy.needs_levels().then(|| BatteryEstimator::estimated(&known))
            },
            shows_levels: policy.needs_batteries(),
            known,
            information: 0.0,
        };
        Self {
            view,
            is_told: policy.oracle().is_some(),
            is_external: external(&*policy).is_some(),
            policy,
            next_decision: Tti::ZERO,
            has_heard: false,
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
        self.is_external.then(|| external(&*self.policy))?
    }

    /// The policy's belief about the place of this TTI's event. Empty if the policy has none, or no report arrived.
    pub fn belief(&self) -> Vec<WeightedPoint> {
        let belief = self.has_heard.then(|| self.policy.belief()).flatten();
        belief.map_or_else(Vec::new, EpicentreBelief::shares)
    }

    /// Whether an external policy has to decide a plan before TTI `k` begins.
    pub(crate) fn needs_plan(&self, k: Tti) -> bool {
        self.external().is_some_and(|external| external.needs_plan(k))
    }

    /// Whether an external policy has to decide wake-ups in TTI `tti`.
    pub(crate) fn needs_wake_ups(&self, tti: Tti) -> bool {
        let asked = self.external().filter(|_| self.has_heard);
        asked.is_some_and(|external| external.needs_wake_ups(&self.view.at(tti)))
    }

    /// The decision context for an external policy in TTI `k`; `None` if a policy of this program decides.
    pub fn pending_decision(&self, k: Tti, stage: DecisionStage) -> Option<DecisionContext<'_>> {
        let seen = self.view.at(k);
        let seen = match stage {
            // Nothing has been gathered in a TTI that has not begun; `information` is still the value of the last one.
            DecisionStage::Plan => Observation {
                information: 0.0,
                ..seen
            },
            DecisionStage::Wake => seen,
        };
        self.external().map(|external| external.context(stage, seen))
    }

    /// Closes TTI `tti`.
    pub fn closed(&mut self, tti: Tti) {
        if self.is_external {
            let (external, view) = self.asked();
            external.closed(tti + 1, &view.plan);
        }
    }

    /// Sets the plan of an external policy for the next TTI.
    pub(crate) fn set_plan(&mut self, decision: PlanDecision) {
        self.asked().0.set_plan(decision);
    }

    /// Sets the wake-ups of an external policy in TTI `tti`.
    pub(crate) fn set_wake_ups(&mut self, tti: Tti, devices: &[DeviceId]) {
        let (external, view) = self.asked();
        external.set_wake_ups(&view.at(tti), devices);
    }

    fn asked(&mut self) -> (&mut External, &View) {
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
    pub fn commands(&mut self) -> (&Plan, Option<&mut dyn Oracle>) {
        let Self {
            view, policy, is_told, ..
        } = self;
        (&view.plan, is_told.then(|| policy.oracle()).flatten())
    }

    /// Whether the policy needs the true batteries before it decides for TTI `k`.
    pub(crate) fn needs_batteries(&self, k: Tti) -> bool {
        // The initial levels are part of `Knowledge`, so TTI 0 needs no levels from the devices.
        k >= self.next_decision && k > Tti::ZERO && self.needs_true_batteries()
    }

    /// Whether the policy ever needs the true batteries.
    pub(crate) fn needs_true_batteries(&self) -> bool {
        self.view
            .levels
            .as_ref()
            .is_some_and(BatteryEstimator::needs_true_levels)
    }

    /// The known battery levels, in the order of ids; empty for a policy that needs none.
    pub fn batteries(&self) -> &[Energy] {
        self.view.levels.as_ref().map_or(&[], BatteryEstimator::all)
    }

    /// Sets the true battery levels of all devices, in the order of ids, at the end of the last TTI.
    pub(crate) fn set_batteries(&mut self, levels: impl IntoIterator<Item = Energy>) {
        if let Some(known) = &mut self.view.levels {
            known.set_true_levels(levels);
        }
    }

    /// Begins TTI `k` and decides if a decision is due. Returns the plan to send: a new plan (`true`), or the current
    /// plan again for synchronisation.
    pub fn announce(&mut self, k: Tti) -> Option<(PlanUpdate, bool)> {
        let mut is_new = k == Tti::ZERO;
        // The policy must not see Î of the previous TTI when it decides for this one.
        self.view.information = 0.0;
        self.has_heard = false;
        if k >= self.next_decision {
            let decided = self.policy.decide(&self.view.at(k));
            self.next_decision = self.policy.next_decision(k);
            assert!(self.next_decision > k, "a policy decides at most once per TTI");
            is_new |= decided != self.view.plan;
            let View {
                plan,
                levels,
                shows_levels,
                ..
            } = &mut self.view;
            // Levels advance under the plan that was valid in the past TTIs, so this comes before the new plan.
            if let Some(levels) = levels.as_mut().filter(|_| !*shows_levels) {
                levels.advance(k, plan);
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
    pub(crate) fn next_announcement(&self, k: Tti) -> Tti {
        let sync = self.view.known.bs.sync_interval;
        Tti((k.0 / sync + 1) * sync).min(self.next_decision)
    }

    /// Takes in the reports of TTI `tti`, in the order of ids.
    pub fn gathered(&mut self, tti: Tti, reports: &[Report]) {
        let Self {
            view,
            policy,
            has_heard,
            ..
        } = self;
        (view.information, *has_heard) = (0.0, !reports.is_empty());
        if let Some(levels) = &mut view.levels {
            if view.shows_levels {
                // Policies of this program that read batteries decide in every TTI. Only a plan of `external` may hold
                // longer.
                levels.advance(tti + 1, &view.plan);
            }
            levels.observe_reports(tti, &view.plan, reports);
        }
        for report in reports {
            view.fuse(report);
        }
        if *has_heard {
            policy.reports_received(&view.at(tti), reports);
        }
    }

    /// The next device to wake in `tti`, if any.
    pub fn next_wake_up(&mut self, tti: Tti) -> Option<DeviceId> {
        // Without a report a base station knows of no event; only the genie, which receives events, may wake anyway.
        let is_due = self.has_heard || self.is_told;
        is_due.then(|| self.policy.next_wake_up(&self.view.at(tti))).flatten()
    }

    /// Takes in the answer to the wake-up of `device`: its report, or none.
    pub fn woken(&mut self, tti: Tti, device: DeviceId, report: Option<&Report>) {
        let view = &mut self.view;
        // The policy sees the new level in `wake_up_answered`, so levels come first.
        if let Some(levels) = &mut view.levels {
            match report {
                Some(report) => levels.observe_level(device, tti, report.battery),
                None => levels.observe_no_answer(device, tti, &view.plan),
            }
        }
        if let Some(report) = report {
            view.fuse(report);
        }
        self.policy.wake_up_answered(&view.at(tti), report);
    }
}

/// Returns `policy` if an external program decides for it.
fn external(policy: &dyn Policy) -> Option<&External> {
    let policy: &dyn Any = policy;
    policy.downcast_ref()
}
