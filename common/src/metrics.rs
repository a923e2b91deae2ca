//! The one definition of every metric, from exact integer totals.

use std::ops::{Add, AddAssign, Sub};

use serde::{Deserialize, Serialize};

use crate::scenario::Scenario;
use crate::units::{Energy, MICRO_PER_UNIT};

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
    /// Energy that those spent or lost.
    pub wasted: Energy,
}

/// Sums over the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventTotals {
    /// Events that started in the measured part and ended before the run did.
    pub events: u64,
    /// Those without a report.
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
    /// Their payloads as encoded, in bytes.
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

/// The metrics of MODEL's table; those per event are NaN where no event was counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Metrics {
    /// Σ I_i / number of events.
    pub info_per_event: f64,
    /// Σ I_i / (α · measured TTIs): the objective of P1, Eq. (`P1_I`).
    pub info_p1: f64,
    /// Events without a report, % of events.
    pub misdetection_pct: f64,
    /// Units spent per device and TTI.
    pub energy_per_device_tti: f64,
    /// Device-TTIs that ended with B < E_Tx, %.
    pub low_energy_pct: f64,
    /// Battery at the end of a TTI, units.
    pub mean_battery: f64,
    /// Wrong activations per event.
    pub wrong_activations_per_event: f64,
    /// Units spent by wrong activations, per event.
    pub wasted_energy_per_event: f64,
    /// Units harvested per device and TTI, overflow included.
    pub harvested_per_device_tti: f64,
    /// Units harvested less units spent, per device and TTI.
    pub net_per_device_tti: f64,
    /// Units harvested that did not fit in the battery, per device and TTI.
    pub overflow_per_device_tti: f64,
    /// Bytes on the control channel per TTI.
    pub ctl_bytes_per_tti: f64,
    /// Messages on the control channel per TTI.
    pub ctl_msgs_per_tti: f64,
    /// Wake-ups per event.
    pub wake_ups_per_event: f64,
    /// Events counted.
    pub events: u64,
}

impl Metrics {
    /// The metrics of a run of `scenario` that came to `totals`.
    pub fn new(scenario: &Scenario, totals: &Totals) -> Self {
        let Totals {
            devices,
            ttis,
            events,
            control,
            energy,
        } = totals;
        let device_ttis = *devices as f64 * *ttis as f64;
        let per_event = |x: f64| {
            if events.events == 0 {
                f64::NAN
            } else {
                x / events.events as f64
            }
        };
        let per_device_tti = |e: Energy| e.units() / device_ttis;
        let information = events.information_pico as f64 / PICO_PER_INFORMATION;
        Self {
            info_per_event: per_event(information),
            info_p1: information / (scenario.events.alpha * *ttis as f64),
            misdetection_pct: per_event(100.0 * events.misdetected as f64),
            energy_per_device_tti: per_device_tti(energy.spent),
            low_energy_pct: 100.0 * energy.low_ttis as f64 / device_ttis,
            mean_battery: energy.battery_sum as f64 / MICRO_PER_UNIT as f64 / device_ttis,
            wrong_activations_per_event: per_event(events.wrong_activations as f64),
            wasted_energy_per_event: per_event(events.wasted.units()),
            harvested_per_device_tti: per_device_tti(energy.harvested),
            net_per_device_tti: (energy.harvested.units() - energy.spent.units()) / device_ttis,
            overflow_per_device_tti: per_device_tti(energy.overflow),
            ctl_bytes_per_tti: control.bytes as f64 / *ttis as f64,
            ctl_msgs_per_tti: control.messages as f64 / *ttis as f64,
            wake_ups_per_event: per_event(events.wake_ups as f64),
            events: events.events,
        }
    }

    /// Every metric with its name and unit, in the order of tables.
    pub fn rows(&self) -> [(&'static str, f64, &'static str); 15] {
        [
            ("info_per_event", self.info_per_event, "information/event"),
            ("info_p1", self.info_p1, "information/(α·TTI)"),
            ("misdetection_pct", self.misdetection_pct, "% of events"),
            ("energy_per_device_tti", self.energy_per_device_tti, "units"),
            ("low_energy_pct", self.low_energy_pct, "% of device-TTIs"),
            ("mean_battery", self.mean_battery, "units"),
            (
                "wrong_activations_per_event",
                self.wrong_activations_per_event,
                "devices/event",
            ),
            ("wasted_energy_per_event", self.wasted_energy_per_event, "units/event"),
            ("harvested_per_device_tti", self.harvested_per_device_tti, "units"),
            ("net_per_device_tti", self.net_per_device_tti, "units"),
            ("overflow_per_device_tti", self.overflow_per_device_tti, "units"),
            ("ctl_bytes_per_tti", self.ctl_bytes_per_tti, "bytes/TTI"),
            ("ctl_msgs_per_tti", self.ctl_msgs_per_tti, "messages/TTI"),
            ("wake_ups_per_event", self.wake_ups_per_event, "wake-ups/event"),
            ("events", self.events as f64, "events"),
        ]
    }
}
