//! The policy `genie`, the genie-aided bound (Sec. VI): every device sleeps, and the device closest to an event is
//! woken when it starts or, with a lossy radio, the devices within d_max in turn until one reports. It receives the
//! events through [`Oracle`], as no base station could. Its digests depend on the order of wake-ups, ties included;
//! `tests/src/reference/policy.rs` repeats it. The world (`common/src/world.rs`) calls the oracle.

use std::sync::Arc;

use reveille_common::declare::{FieldSink, Visit};
use reveille_common::event::Stimulus;
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::world::Oracle;

use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The policy `genie`. The text is part of docs/scenario.md.
pub const GENIE: PolicyEntry = PolicyEntry {
    is_bound: true,
    ..PolicyEntry::without_settings(
        "genie",
        "Every device sleeps. Wakes the device closest to the epicentre, which only this policy receives (Sec. VI).",
        |_, _| Ok(Arc::new(GenieFactory)),
    )
};

#[derive(Debug)]
struct GenieFactory;

impl Visit for GenieFactory {
    fn visit(&self, _sink: &mut dyn FieldSink) {}
}

impl PolicyFactory for GenieFactory {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(Genie::new(known))
    }
}

/// The `genie` policy, the only one that receives epicentres.
pub struct Genie {
    buckets: Buckets,
    d_max: f64,
    device_count: usize,
    /// Whether a woken device with power may fail to report.
    is_lossy: bool,
    /// Place of the current event; meaningless before the first.
    epicentre: Point,
    /// Devices to wake for the current event, the next one at the end. Without radio losses it is the closest one, even
    /// if it cannot pay, as the bound requires.
    wake_stack: Vec<DeviceId>,
}

impl Genie {
    /// Creates the genie for the deployment in `known`.
    pub fn new(known: &Knowledge) -> Self {
        let d_max = known.sensing.d_max;
        Self {
            buckets: Buckets::new(&known.positions(), known.area, d_max),
            d_max,
            device_count: known.n(),
            is_lossy: known.radio.no_answer_probability() > 0.0,
            epicentre: Point::new(0.0, 0.0),
            wake_stack: Vec::new(),
        }
    }

    /// Returns the device closest to `epicentre` within d_max, if any. Ties go to the lower id.
    fn closest_device(&self, epicentre: Point) -> Option<DeviceId> {
        let mut best: Option<(f64, usize)> = None;
        self.buckets.within(epicentre, self.d_max, |j, d| {
            if best.is_none_or(|b| (d, j) < b) {
                best = Some((d, j));
            }
        });
        best.map(|(_, j)| DeviceId(j as u32))
    }

    /// Returns all devices within d_max of `epicentre`, the closest at the end, ties as in [`Self::closest_device`].
    fn in_range_farthest_first(&self, epicentre: Point) -> Vec<DeviceId> {
        let mut devices = Vec::new();
        self.buckets.within(epicentre, self.d_max, |j, d| devices.push((d, j)));
        devices.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        devices.into_iter().map(|(_, j)| DeviceId(j as u32)).collect()
    }
}

impl Policy for Genie {
    /// Returns a plan in which all devices sleep.
    fn decide(&mut self, _seen: &Observation<'_>) -> Plan {
        Plan::from_bits((0..self.device_count).map(|_| false))
    }

    fn next_decision(&self, _now: Tti) -> Tti {
        Tti::NEVER
    }

    fn next_wake_up(&mut self, _seen: &Observation<'_>) -> Option<DeviceId> {
        self.wake_stack.pop()
    }

    /// Ends the wake-ups after one report of the event.
    fn take_wake_up_answer(&mut self, _seen: &Observation<'_>, report: Option<&Report>) {
        if report.is_some() {
            self.wake_stack.clear();
        }
    }

    /// Returns false: the genie knows which devices to wake.
    fn needs_battery_estimates(&self) -> bool {
        false
    }

    fn oracle(&mut self) -> Option<&mut dyn Oracle> {
        Some(self)
    }
}

impl Oracle for Genie {
    fn reveal_event(&mut self, stimulus: &Stimulus) {
        self.epicentre = stimulus.epicentre;
        self.wake_stack = if self.is_lossy {
            self.in_range_farthest_first(stimulus.epicentre)
        } else {
            self.closest_device(stimulus.epicentre).into_iter().collect()
        };
    }

    fn needs_wake_up(&self) -> bool {
        !self.wake_stack.is_empty()
    }

    /// Queues the devices again if the radio is lossy, since a later answer can succeed.
    fn needs_another_wake_up(&mut self) -> bool {
        if self.is_lossy {
            self.wake_stack = self.in_range_farthest_first(self.epicentre);
        }
        !self.wake_stack.is_empty()
    }
}
