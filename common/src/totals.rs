//! Exact integer totals: what devices, events and the control channel add up to.

use std::ops::{Add, AddAssign, Sub};

use serde::{Deserialize, Serialize};

use crate::units::Energy;

/// Parts of one unit of information in the totals.
pub const PICO_PER_INFORMATION: f64 = 1e12;

/// The ledger of one device, or its sum over several: since the start of the run, up to the end of some TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceTotals {
    /// Battery at the start.
    pub initial: Energy,
    /// Energy that arrived, overflow included.
    pub harvested: Energy,
    /// Energy taken out of the battery, what failed actions drained included.
    pub spent: Energy,
    /// Harvest that did not fit in the battery.
    pub overflow: Energy,
    /// Battery now. Always `initial + harvested - spent - overflow`.
    pub battery: Energy,
    /// Σ over TTIs of the battery at the end of the TTI, micro-units.
    pub battery_sum: u128,
    /// Device-TTIs that ended with less than E_Tx in the battery.
    pub low_ttis: u64,
}

impl DeviceTotals {
    /// Whether the ledger closes.
    pub fn closes(&self) -> bool {
        let into = u128::from(self.initial.micro()) + u128::from(self.harvested.micro());
        into == u128::from(self.spent.micro()) + u128::from(self.overflow.micro()) + u128::from(self.battery.micro())
    }
}

impl Add for DeviceTotals {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            initial: self.initial + other.initial,
            harvested: self.harvested + other.harvested,
            spent: self.spent + other.spent,
            overflow: self.overflow + other.overflow,
            battery: self.battery + other.battery,
            battery_sum: self.battery_sum + other.battery_sum,
            low_ttis: self.low_ttis + other.low_ttis,
        }
    }
}

impl AddAssign for DeviceTotals {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl std::iter::Sum for DeviceTotals {
    fn sum<I: Iterator<Item = Self>>(iter: I) -> Self {
        iter.fold(Self::default(), Add::add)
    }
}

impl Sub for DeviceTotals {
    type Output = Self;
    /// What was added between an earlier state `before` and this one: the ledger of the TTIs between.
    fn sub(self, before: Self) -> Self {
        Self {
            initial: before.battery,
            harvested: self.harvested - before.harvested,
            spent: self.spent - before.spent,
            overflow: self.overflow - before.overflow,
            battery: self.battery,
            battery_sum: self.battery_sum - before.battery_sum,
            low_ttis: self.low_ttis - before.low_ttis,
        }
    }
}

/// What one event came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventTally {
    /// Reports that reached the BS.
    pub reports: u64,
    /// Wake-ups sent.
    pub wake_ups: u64,
    /// I_i, in 10⁻¹² units of information.
    pub information_pico: u64,
    /// Devices that entered S2 and could not transmit, and woken devices farther than `d_max` from the epicentre.
    pub wrong_activations: u64,
    /// Energy that the wrong activations spent or lost.
    pub wasted: Energy,
}

/// Sums over the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventTotals {
    /// Events that started in the measured part and ended before the run did.
    pub events: u64,
    /// Events that ended without a report.
    pub misdetected: u64,
    /// Reports.
    pub reports: u64,
    /// Wake-ups.
    pub wake_ups: u64,
    /// Σ I_i, in 10⁻¹² units of information.
    pub information_pico: u128,
    /// Wrong activations.
    pub wrong_activations: u64,
    /// Energy wasted by them.
    pub wasted: Energy,
}

impl EventTotals {
    /// Counts one ended event.
    pub fn count(&mut self, event: &EventTally) {
        self.events += 1;
        self.misdetected += u64::from(event.reports == 0);
        self.reports += event.reports;
        self.wake_ups += event.wake_ups;
        self.information_pico += u128::from(event.information_pico);
        self.wrong_activations += event.wrong_activations;
        self.wasted += event.wasted;
    }
}

impl Sub for EventTotals {
    type Output = Self;
    fn sub(self, before: Self) -> Self {
        Self {
            events: self.events - before.events,
            misdetected: self.misdetected - before.misdetected,
            reports: self.reports - before.reports,
            wake_ups: self.wake_ups - before.wake_ups,
            information_pico: self.information_pico - before.information_pico,
            wrong_activations: self.wrong_activations - before.wrong_activations,
            wasted: self.wasted - before.wasted,
        }
    }
}

/// The control channel: δ, wake-ups and synchronisation, BS → devices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControlTotals {
    /// Messages put on the air plane; a broadcast is one.
    pub messages: u64,
    /// Bytes of the messages' payloads as encoded.
    pub bytes: u64,
}

/// The exact totals of the measured part of a run. Every metric follows from them and the scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    /// Number of devices N.
    pub devices: u64,
    /// Measured TTIs.
    pub ttis: u64,
    /// Events.
    pub events: EventTotals,
    /// The control channel.
    pub control: ControlTotals,
    /// Ledgers of all devices.
    pub energy: DeviceTotals,
}
