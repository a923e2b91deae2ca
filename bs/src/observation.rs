//! What a policy sees in a TTI.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::units::Energy;

use crate::knowledge::Knowledge;
use crate::levels::Levels;

/// The BS's view in a TTI: what it knew before, its own δ, what was reported, and batteries as far as it may know them.
/// Epicentres and harvests are not in it.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The TTI.
    pub now: Tti,
    /// What was known before the first TTI.
    pub known: &'a Knowledge,
    /// δ as commanded.
    pub plan: &'a Plan,
    /// Î, the information gathered about the event in this TTI (Algorithm 1).
    pub information: f64,
    /// Batteries at the end of the last TTI, as far as `bs.battery_knowledge` goes; empty for a policy that does not
    /// look at them ([`crate::policy::contract::Policy::looks_at_batteries`]).
    pub batteries: &'a [Energy],
    /// What [`Self::can_report`] goes by; nothing where nobody asks.
    pub levels: Option<&'a Levels>,
}

impl Observation<'_> {
    /// Whether `device` was told to sleep in this TTI (S4, δ = 0).
    pub fn is_asleep(&self, device: DeviceId) -> bool {
        !self.plan.is_on(device, self.now)
    }

    /// Whether `device` can pay for a report in this TTI, as far as the BS knows: the Pr(B ≥ E_Tx) that a wake-up
    /// depends on (Sec. IV), taken as 1 or 0. For a policy that looks at batteries it follows from those; for others
    /// from what each device reported last, was commanded since, and harvests on average.
    pub fn can_report(&self, device: DeviceId) -> bool {
        self.levels
            .is_none_or(|levels| levels.can_report(device, self.now, self.plan))
    }
}
