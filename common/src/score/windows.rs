//! Sums over windows of TTIs, for the rows of `windows.csv` (columns in `deploy/src/run_tables.rs`) and live metrics.
//! The session of the base station closes each window. No digest depends on windows.

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
    /// The energy totals of all devices.
    pub energy: DeviceTotals,
    /// Counted events that ended in the window.
    pub events: EventTotals,
}

/// An accumulator that turns running sums into window records.
#[derive(Clone, Debug, Default)]
pub struct WindowAccumulator {
    first: Tti,
    energy: DeviceTotals,
    events: EventTotals,
}

impl WindowAccumulator {
    /// Creates the accumulator before TTI 0, with the devices' initial batteries.
    pub fn new(deployment: &Deployment) -> Self {
        let initial: Energy = deployment.devices.iter().map(|d| d.energy.initial).sum();
        // The battery is set too: subtraction takes it as the initial level of the first window.
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

    /// Closes a window at `k`, before which all TTIs have ended. `energy` and `events` are the sums from TTI 0 on: over
    /// all devices, warm-up included, and over the counted events. No sum may be smaller than in the last call.
    pub fn close_window(&mut self, k: Tti, energy: DeviceTotals, events: EventTotals) -> WindowRecord {
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
