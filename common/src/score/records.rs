//! What a run leaves behind beside its metrics and a record an event: sums a window of TTIs.

use crate::deployment::Deployment;
use crate::ids::Tti;
use crate::totals::{DeviceTotals, EventTotals};
use crate::units::Energy;

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

/// Turns running sums into window records.
#[derive(Clone, Debug, Default)]
pub struct Accounts {
    first: Tti,
    energy: DeviceTotals,
    events: EventTotals,
}

impl Accounts {
    /// Accounts that start from the devices' initial batteries.
    pub fn new(deployment: &Deployment) -> Self {
        let initial: Energy = deployment.devices.iter().map(|d| d.energy.initial).sum();
        let energy = DeviceTotals {
            initial,
            battery: initial,
            ..DeviceTotals::default()
        };
        Self {
            energy,
            ..Self::default()
        }
    }

    /// The sums over all devices and counted events at boundary `k`, where all TTIs before `k` have ended.
    pub fn reach(&mut self, k: Tti, energy: DeviceTotals, events: EventTotals) -> WindowRecord {
        let record = WindowRecord {
            first: self.first,
            end: k,
            energy: energy - self.energy,
            events: events - self.events,
        };
        (self.first, self.energy, self.events) = (k, energy, events);
        record
    }
}
