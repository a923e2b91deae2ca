//! The results of a run for each device and each device class, for the tables and the summary of a run.
//! [`super::Score`] counts the activity; the ledgers come from the devices at the end. The serialised names of
//! [`EventActivity`] are keys of the classes in `summary.json` (`SUMMARY_VERSION`). `deploy/src/run_tables.rs` repeats
//! the names of [`EventActivity::rows`] as columns of `devices.csv`, and `deploy/src/results_table.rs` finds rows by
//! their index. `docs/results.md` explains both.

use std::ops::AddAssign;

use serde::Serialize;

use super::metrics::Metrics;
use crate::geometry::Point;
use crate::ids::DeviceId;
use crate::totals::{DeviceTotals, Ledger, Spread, Totals};

/// The activity of a device during the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct EventActivity {
    /// Reports of the device that reached the BS.
    pub reports: u64,
    /// Wake-ups sent to the device.
    pub wake_ups: u64,
    /// Wake-ups that the device received.
    #[serde(rename = "heard")]
    pub received_wake_ups: u64,
    /// Number of times it entered S2 and could not transmit, or was woken beyond `d_max` from the epicentre.
    pub wrong_activations: u64,
}

impl EventActivity {
    const NONE: Self = Self {
        reports: 0,
        wake_ups: 0,
        received_wake_ups: 0,
        wrong_activations: 0,
    };
    /// The activity of a device that reported without a wake-up.
    pub(super) const REPORT: Self = Self {
        reports: 1,
        ..Self::NONE
    };
    /// The activity of a device that was woken and brought no report to the BS.
    pub(super) const WOKEN: Self = Self {
        wake_ups: 1,
        received_wake_ups: 1,
        ..Self::NONE
    };
    /// The activity of a device that was woken and reported to the BS.
    pub(super) const WOKEN_REPORT: Self = Self {
        reports: 1,
        ..Self::WOKEN
    };
    /// The activity of a device that did not receive a wake-up.
    pub(super) const MISSED_WAKE_UP: Self = Self {
        wake_ups: 1,
        ..Self::NONE
    };
    /// The activity of a device that became active without effect: it could not pay for a report, or was woken beyond
    /// `d_max`. The score adds it to the activity of the wake-up.
    pub(super) const WRONG_ACTIVATION: Self = Self {
        wrong_activations: 1,
        ..Self::NONE
    };
}

impl EventActivity {
    /// Returns each count with its name in the table of classes.
    pub const fn rows(&self) -> [(&'static str, u64); 4] {
        [
            ("reports", self.reports),
            ("wake_ups", self.wake_ups),
            ("wake_ups_received", self.received_wake_ups),
            ("wrong_activations", self.wrong_activations),
        ]
    }
}

impl AddAssign for EventActivity {
    fn add_assign(&mut self, other: Self) {
        self.reports += other.reports;
        self.wake_ups += other.wake_ups;
        self.received_wake_ups += other.received_wake_ups;
        self.wrong_activations += other.wrong_activations;
    }
}

/// The results of one device at the end of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceRecord {
    /// The number of the device.
    pub device: DeviceId,
    /// The position of the device.
    pub position: Point,
    /// The index of its class in the scenario.
    pub class: u16,
    /// The ledger of the device.
    pub ledger: Ledger,
    /// Its activity during the counted events.
    pub activity: EventActivity,
}

/// The results of all devices of a class.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassRecord {
    /// The number of devices.
    pub devices: u64,
    /// The metrics of the class; only those about devices ([`super::Metric::is_by_device`]) are meaningful.
    pub metrics: Metrics,
    /// The activity of its devices during the counted events.
    pub activity: EventActivity,
}

impl ClassRecord {
    /// Sums the records of the devices of `class` among `devices`, over `measured_ttis` TTIs.
    pub fn new(class: u16, devices: &[DeviceRecord], measured_ttis: u64) -> Self {
        let members = || devices.iter().filter(|device| device.class == class);
        let measured = || members().map(|device| &device.ledger.measured);
        let mut activity = EventActivity::default();
        members().for_each(|device| activity += device.activity);
        let totals = Totals {
            devices: members().count() as u64,
            ttis: measured_ttis,
            energy: measured().copied().sum::<DeviceTotals>(),
            spread: Spread::from_devices(measured()),
            ..Totals::default()
        };
        Self {
            devices: totals.devices,
            // α concerns events, which belong to no class.
            metrics: Metrics::from_totals(f64::NAN, &totals),
            activity,
        }
    }
}
