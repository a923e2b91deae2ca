//! What a run leaves behind beside its metrics: a record an event, and sums a window of TTIs.

use crate::deployment::Deployment;
use crate::geometry::Point;
use crate::ids::{EventId, Tti};
use crate::totals::{DeviceTotals, EventTally, EventTotals};
use crate::units::Energy;

/// One ended event, for the per-event series.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EventRecord {
    /// Its number.
    pub event: EventId,
    /// Its place.
    pub epicentre: Point,
    /// Its first TTI.
    pub start: Tti,
    /// Its last TTI.
    pub last: Tti,
    /// Whether it counts in the metrics.
    pub counted: bool,
    /// What it came to.
    pub tally: EventTally,
}

/// One row of the per-window series: the sums of the TTIs `first .. end`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowRecord {
    /// First TTI.
    pub first: Tti,
    /// The TTI after the last.
    pub end: Tti,
    /// The energy of all devices together.
    pub energy: DeviceTotals,
    /// Counted events that ended in the window.
    pub events: EventTotals,
}

/// Turns running sums into window records, and keeps the sum at the end of the warm-up.
#[derive(Clone, Debug, Default)]
pub struct Accounts {
    first: Tti,
    energy: DeviceTotals,
    events: EventTotals,
    at_warm_up: Option<DeviceTotals>,
}

impl Accounts {
    /// Accounts that start from the devices' initial batteries; a run without warm-up is measured from there.
    pub fn new(deployment: &Deployment, warm_up_end: Tti) -> Self {
        let initial: Energy = deployment.devices.iter().map(|d| d.energy.initial).sum();
        let energy = DeviceTotals {
            initial,
            battery: initial,
            ..DeviceTotals::default()
        };
        let at_warm_up = (warm_up_end == Tti::ZERO).then_some(energy);
        Self {
            energy,
            at_warm_up,
            ..Self::default()
        }
    }

    /// The sums over all devices and counted events at boundary `k`, where all TTIs before `k` have ended.
    pub fn reach(&mut self, k: Tti, warm_up_end: Tti, energy: DeviceTotals, events: EventTotals) -> WindowRecord {
        if k == warm_up_end {
            self.at_warm_up = Some(energy);
        }
        let record = WindowRecord {
            first: self.first,
            end: k,
            energy: energy - self.energy,
            events: events - self.events,
        };
        (self.first, self.energy, self.events) = (k, energy, events);
        record
    }

    /// The sum over all devices at the end of the warm-up, once it is reached.
    pub const fn at_warm_up(&self) -> Option<DeviceTotals> {
        self.at_warm_up
    }
}
