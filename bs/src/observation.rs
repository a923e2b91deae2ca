//! What a base station may know.

use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

/// The BS's knowledge in a TTI: positions, its own δ, what was reported, and batteries as far as it may know them. Epicentres and
/// harvests are not in it.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The TTI.
    pub now: Tti,
    /// Positions of all devices.
    pub positions: &'a [Point],
    /// The sensing model, whose p is known and invertible.
    pub sensing: &'a Sensing,
    /// δ as commanded.
    pub plan: &'a Plan,
    /// Î, the information gathered about the event in this TTI (Algorithm 1).
    pub information: f64,
    /// Batteries at the end of the last TTI, as far as `bs.battery_knowledge` goes; empty for a policy that does not look at
    /// them ([`crate::policy::Policy::looks_at_batteries`]).
    pub batteries: &'a [Energy],
}

impl Observation<'_> {
    /// Whether `device` was told to sleep in this TTI (S4, δ = 0).
    pub fn is_asleep(&self, device: DeviceId) -> bool {
        !self.plan.duty_cycle(device).is_on(self.now)
    }
}
