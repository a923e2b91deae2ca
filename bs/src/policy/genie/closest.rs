//! The choice of the genie: the device closest to an event.

use reveille_common::event::Stimulus;
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::world::Oracle;

use crate::knowledge::Knowledge;
use crate::policy::mind::Bound;

/// The `genie` policy: the only one that is told an epicentre.
pub struct Genie {
    buckets: Buckets,
    d_max: f64,
    devices: usize,
    /// Whether a device that is well may not answer.
    is_lossy: bool,
    /// Where the event is that has started last.
    epicentre: Point,
    /// Whom to wake for the event that has just started, the next at the end. One device, where the radio never fails:
    /// one that cannot pay is what the bound is about.
    chosen: Vec<DeviceId>,
}

impl Genie {
    /// The genie for the deployment in `known`.
    pub fn new(known: &Knowledge) -> Self {
        let d_max = known.sensing.d_max;
        Self {
            buckets: Buckets::new(&known.positions(), known.area, d_max),
            d_max,
            devices: known.n(),
            is_lossy: known.radio.no_answer() > 0.0,
            epicentre: Point::new(0.0, 0.0),
            chosen: Vec::new(),
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

    /// All devices within d_max of `epicentre`, the closest at the end.
    fn around(&self, epicentre: Point) -> Vec<DeviceId> {
        let mut around = Vec::new();
        self.buckets.within(epicentre, self.d_max, |j, d| around.push((d, j)));
        around.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        around.into_iter().map(|(_, j)| DeviceId(j as u32)).collect()
    }
}

impl Bound for Genie {
    /// Everyone sleeps.
    fn plan(&self) -> Plan {
        Plan::from_bits((0..self.devices).map(|_| false))
    }

    fn next_wake_up(&mut self) -> Option<DeviceId> {
        self.chosen.pop()
    }

    /// Nobody else is needed once the event is reported.
    fn answered(&mut self, report: Option<&Report>) {
        if report.is_some() {
            self.chosen.clear();
        }
    }
}

impl Oracle for Genie {
    fn told(&mut self, stimulus: &Stimulus) -> bool {
        self.epicentre = stimulus.epicentre;
        self.chosen = if self.is_lossy {
            self.around(stimulus.epicentre)
        } else {
            self.closest(stimulus.epicentre).into_iter().collect()
        };
        !self.chosen.is_empty()
    }

    /// A radio that fails now may not fail later.
    fn is_told_again(&mut self) -> bool {
        if self.is_lossy {
            self.chosen = self.around(self.epicentre);
        }
        !self.chosen.is_empty()
    }
}
