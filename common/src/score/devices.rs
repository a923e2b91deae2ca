//! What a run leaves behind of each device, and of each class of them.

use std::ops::AddAssign;

use serde::Serialize;

use super::metrics::Metrics;
use crate::geometry::Point;
use crate::ids::DeviceId;
use crate::totals::{DeviceTotals, Ledger, Spread, Totals};

/// What a device did for the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Acts {
    /// Reports of its that reached the BS.
    pub reports: u64,
    /// Wake-ups that were sent to it.
    pub wake_ups: u64,
    /// Those of them that it heard.
    pub heard: u64,
    /// How often it entered S2 and could not transmit, or was woken farther than `d_max` from the epicentre.
    pub wrong_activations: u64,
}

impl Acts {
    const NONE: Self = Self {
        reports: 0,
        wake_ups: 0,
        heard: 0,
        wrong_activations: 0,
    };
    /// It reported by itself.
    pub(super) const REPORT: Self = Self {
        reports: 1,
        ..Self::NONE
    };
    /// It was woken.
    pub(super) const WOKEN: Self = Self {
        wake_ups: 1,
        heard: 1,
        ..Self::NONE
    };
    /// It was woken and reported.
    pub(super) const WOKEN_REPORT: Self = Self {
        reports: 1,
        ..Self::WOKEN
    };
    /// It was sent a wake-up that it did not hear.
    pub(super) const UNHEARD: Self = Self {
        wake_ups: 1,
        ..Self::NONE
    };
    /// It was activated for nothing.
    pub(super) const WRONG: Self = Self {
        wrong_activations: 1,
        ..Self::NONE
    };
}

impl Acts {
    /// Each of them with its name.
    pub const fn rows(&self) -> [(&'static str, u64); 4] {
        [
            ("reports", self.reports),
            ("wake_ups", self.wake_ups),
            ("wake_ups_heard", self.heard),
            ("wrong_activations", self.wrong_activations),
        ]
    }
}

impl AddAssign for Acts {
    fn add_assign(&mut self, other: Self) {
        self.reports += other.reports;
        self.wake_ups += other.wake_ups;
        self.heard += other.heard;
        self.wrong_activations += other.wrong_activations;
    }
}

/// One device at the end of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceRecord {
    /// Its number.
    pub device: DeviceId,
    /// Where it stands.
    pub position: Point,
    /// Its class, an index into the scenario's.
    pub class: u16,
    /// Its books.
    pub ledger: Ledger,
    /// What it did for the counted events.
    pub acts: Acts,
}

/// The devices of one class together.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassRecord {
    /// How many they are.
    pub devices: u64,
    /// Their metrics; only those about devices ([`super::Group::is_by_device`]) mean anything.
    pub metrics: Metrics,
    /// What they did for the counted events.
    pub acts: Acts,
}

impl ClassRecord {
    /// The record of the devices of `class` among `devices`, over `ttis` measured TTIs.
    pub fn of(class: u16, devices: &[DeviceRecord], ttis: u64) -> Self {
        let own = || devices.iter().filter(|device| device.class == class);
        let measured = || own().map(|device| &device.ledger.measured);
        let mut acts = Acts::default();
        own().for_each(|device| acts += device.acts);
        let totals = Totals {
            devices: own().count() as u64,
            ttis,
            energy: measured().copied().sum::<DeviceTotals>(),
            spread: Spread::of(measured()),
            ..Totals::default()
        };
        Self {
            devices: totals.devices,
            metrics: Metrics::of(f64::NAN, &totals),
            acts,
        }
    }
}
