//! The books of a device: what it did, what that cost by state, and how it fared.
//!
//! Costs are counted, not summed: what was spent follows from the counts and the prices, so that the books and the
//! battery are two independent accounts of the same energy. [`DeviceTotals::closes`] compares them.

use reveille_common::ids::Tti;
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, Ledger, Spent};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

use crate::battery::Battery;

/// What an action did to the battery: paid in full, or drained what was left and failed.
type Paid = Result<(), Energy>;

/// The books of one device since TTI 0.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Books {
    sensing_ttis: u64,
    failed_ttis: u64,
    dark_ttis: u64,
    false_wakes: u64,
    /// Those of them that the battery could not pay.
    failed_false_wakes: u64,
    transmissions: u64,
    /// What failed actions drained.
    drained: Spent,
    battery_sum: u128,
    low_ttis: u64,
    /// TTIs up to now, one after another, in which the battery could pay for nothing.
    outage: u64,
    longest_outage: u64,
    measured_from: Tti,
    /// The sums at the start of the measured part.
    at_warm_up: Option<Box<DeviceTotals>>,
}

impl Books {
    /// Empty books, measured from TTI `measured_from` on.
    pub const fn new(measured_from: Tti) -> Self {
        let drained = Spent {
            sensing: Energy::ZERO,
            sleep: Energy::ZERO,
            report: Energy::ZERO,
        };
        Self {
            sensing_ttis: 0,
            failed_ttis: 0,
            dark_ttis: 0,
            false_wakes: 0,
            failed_false_wakes: 0,
            transmissions: 0,
            drained,
            battery_sum: 0,
            low_ttis: 0,
            outage: 0,
            longest_outage: 0,
            measured_from,
            at_warm_up: None,
        }
    }

    /// The first measured TTI.
    #[inline]
    pub const fn measured_from(&self) -> Tti {
        self.measured_from
    }

    /// The measured part begins, with these sums. Saying so again changes nothing.
    pub fn begin_measuring(&mut self, so_far: DeviceTotals) {
        if self.at_warm_up.is_none() {
            self.at_warm_up = Some(Box::new(so_far));
            (self.outage, self.longest_outage) = (0, 0);
        }
    }

    /// A TTI has begun, with δ = 1 if `on`.
    pub fn duty(&mut self, on: bool, paid: Paid) {
        self.sensing_ttis += u64::from(on);
        match paid {
            Ok(()) => self.outage = 0,
            Err(drained) => {
                if on {
                    self.drained.sensing += drained;
                } else {
                    self.drained.sleep += drained;
                }
                self.failed_ttis += u64::from(on);
                self.dark_ttis += u64::from(!on);
                self.lengthen_outage(1);
            }
        }
    }

    /// TTIs have passed on an empty battery, `on` with δ = 1 and `off` with δ = 0.
    pub fn outage(&mut self, on: u64, off: u64) {
        self.sensing_ttis += on;
        self.failed_ttis += on;
        self.dark_ttis += off;
        self.lengthen_outage(on + off);
    }

    /// Some TTIs have passed in which all was paid, `on` with δ = 1. Their ends add `battery_sum` micro-units, and
    /// `low` of them were low.
    #[inline]
    pub fn span(&mut self, on: u64, battery_sum: Energy, low: u64) {
        self.sensing_ttis += on;
        self.outage = 0;
        self.battery_sum += u128::from(battery_sum.micro());
        self.low_ttis += low;
    }

    /// The device has woken for nothing in a TTI with δ = 0. What that costs is the price of listening: it goes to S4.
    pub fn false_wake(&mut self, paid: Paid) {
        self.false_wakes += 1;
        if let Err(drained) = paid {
            self.failed_false_wakes += 1;
            self.drained.sleep += drained;
        }
    }

    /// The device has tried to transmit.
    pub fn transmission(&mut self, paid: Paid) {
        match paid {
            Ok(()) => self.transmissions += 1,
            Err(drained) => self.drained.report += drained,
        }
    }

    /// `n` TTIs have ended with `level` in the battery.
    pub fn ends(&mut self, level: Energy, e_tx: Energy, n: u64) {
        self.battery_sum += u128::from(level.micro()) * u128::from(n);
        self.low_ttis += if level < e_tx { n } else { 0 };
    }

    /// The sums over the TTIs before `next`, with these prices and this battery.
    pub fn totals(&self, next: Tti, prices: &EnergyModel, battery: &Battery) -> DeviceTotals {
        let asleep = next.0 - self.sensing_ttis;
        DeviceTotals {
            initial: battery.initial(),
            harvested: battery.harvested(),
            spent: Spent {
                sensing: prices.e_idle.times(self.sensing_ttis - self.failed_ttis) + self.drained.sensing,
                sleep: prices.e_wur.times(asleep - self.dark_ttis)
                    + prices.e_idle.times(self.false_wakes - self.failed_false_wakes)
                    + self.drained.sleep,
                report: prices.e_tx.times(self.transmissions) + self.drained.report,
            },
            overflow: battery.overflow(),
            battery: battery.level(),
            battery_sum: self.battery_sum,
            low_ttis: self.low_ttis,
            sensing_ttis: self.sensing_ttis,
            failed_ttis: self.failed_ttis,
            dark_ttis: self.dark_ttis,
            false_wakes: self.false_wakes,
        }
    }

    /// The ledger of a run that has come to `whole`.
    pub fn ledger(&self, whole: DeviceTotals) -> Ledger {
        let measured = self.at_warm_up.as_ref().map(|before| whole - **before);
        Ledger {
            whole,
            measured: measured.unwrap_or_default(),
            longest_outage: if measured.is_some() { self.longest_outage } else { 0 },
        }
    }

    fn lengthen_outage(&mut self, ttis: u64) {
        self.outage += ttis;
        self.longest_outage = self.longest_outage.max(self.outage);
    }
}
