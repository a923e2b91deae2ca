//! The choice of the genie: the device closest to an event.

use reveille_common::event::Stimulus;
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;
use reveille_common::world::Oracle;

use crate::knowledge::Knowledge;
use crate::policy::mind::Bound;

/// The `genie` policy: the only one that is told an epicentre.
pub struct Genie {
    buckets: Buckets,
    d_max: f64,
    devices: usize,
    /// Whom to wake for the event that has just started.
    chosen: Option<DeviceId>,
}

impl Genie {
    /// The genie for the deployment in `known`.
    pub fn new(known: &Knowledge) -> Self {
        let d_max = known.sensing.d_max;
        Self {
            buckets: Buckets::new(&known.positions(), known.area, d_max),
            d_max,
            devices: known.n(),
            chosen: None,
        }
    }

    /// The device closest to `epicentre`, unless it is farther than d_max. Ties go to the lower id.
    fn closest(&self, epicentre: Point) -> Option<DeviceId> {
        let mut best: Option<(f64, usize)> = None;
        self.buckets.within(epicentre, self.d_max, |j, d| {
            if best.is_none_or(|b| (d, j) < b) {
                best = Some((d, j));
            }
        });
        best.map(|(_, j)| DeviceId(j as u32))
    }
}

impl Bound for Genie {
    /// Everyone sleeps.
    fn plan(&self) -> Plan {
        Plan::from_bits((0..self.devices).map(|_| false))
    }

    fn next_wake_up(&mut self) -> Option<DeviceId> {
        self.chosen.take()
    }
}

impl Oracle for Genie {
    fn told(&mut self, stimulus: &Stimulus) -> bool {
        self.chosen = self.closest(stimulus.epicentre);
        self.chosen.is_some()
    }
}
