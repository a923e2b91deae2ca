//! The observation that a policy receives in a TTI, with [`Knowledge`] as its part from before the first TTI.
//!
//! The [`BaseStation`](crate::base_station::BaseStation) makes one for each call of the policy; `policy/dt/record.rs`
//! replaces its batteries while it records. docs/policy-interface.md lists the fields.
//!
//! A field must not give ground truth, except for `batteries`, which are the true levels under
//! `bs.battery_knowledge = "oracle"`. `tests/tests/knowledge_wall.rs` checks that unobservable changes of a run change
//! no decision.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::units::Energy;

use crate::battery_estimator::BatteryEstimator;
use crate::knowledge::Knowledge;

/// The BS's view in a TTI: its prior knowledge, its plan δ, the received reports, and batteries as far as it knows
/// them. It does not contain epicentres or harvests.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The TTI.
    pub now: Tti,
    /// Knowledge from before the first TTI.
    pub known: &'a Knowledge,
    /// δ as commanded.
    pub plan: &'a Plan,
    /// Î, the information gathered about the event in this TTI (Algorithm 1); 0 when a plan is decided.
    pub information: f64,
    /// Batteries by device id, as far as `bs.battery_knowledge` allows: at the end of the last TTI when a plan is
    /// decided. After the reports of a TTI, estimates already include that TTI. Empty for a policy that does not need
    /// them ([`crate::policy::interface::Policy::needs_batteries`]).
    pub batteries: &'a [Energy],
    /// Estimator for [`Self::can_report`]; `None` for a policy that does not need it, and all devices then count as
    /// able to report.
    pub battery_estimator: Option<&'a BatteryEstimator>,
}

impl Observation<'_> {
    /// Whether the plan puts `device` to sleep in this TTI (S4, δ = 0).
    pub fn is_asleep(&self, device: DeviceId) -> bool {
        !self.plan.is_on(device, self.now)
    }

    /// Whether `device` can pay for a report in this TTI, as far as the BS knows. It stands for Pr(B ≥ E_Tx) of a
    /// wake-up (Sec. IV), taken as 1 or 0. If the policy reads batteries, it follows from their levels. Otherwise it
    /// follows from each device's last report, the plans since, and its mean harvest.
    pub fn can_report(&self, device: DeviceId) -> bool {
        self.battery_estimator
            .is_none_or(|estimator| estimator.can_report(device, self.now, self.plan))
    }
}
