//! The genie-aided bound (Sec. VI): every device sleeps, and the one closest to an event is woken when it starts.

use reveille_common::event::Stimulus;
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;

/// The `genie` policy: the only one that is told an epicentre.
pub struct Genie {
    buckets: Buckets,
    d_max: f64,
    devices: u32,
}

impl Genie {
    /// The genie for devices at `positions`.
    pub fn new(scenario: &Scenario, positions: &[Point]) -> Self {
        let d_max = scenario.sensing.d_max;
        Self {
            buckets: Buckets::new(positions, scenario.area, d_max),
            d_max,
            devices: scenario.devices,
        }
    }

    /// Everyone sleeps.
    pub fn plan(&self) -> Plan {
        Plan::from_bits((0..self.devices).map(|_| false))
    }

    /// Whom to wake for an event that starts: the closest device, unless it is farther than d_max. Ties go to the lower id.
    pub fn closest(&self, stimulus: &Stimulus) -> Option<DeviceId> {
        let mut best: Option<(f64, usize)> = None;
        self.buckets.within(stimulus.epicentre, self.d_max, |j, d| {
            if best.is_none_or(|b| (d, j) < b) {
                best = Some((d, j));
            }
        });
        best.map(|(_, j)| DeviceId(j as u32))
    }
}
