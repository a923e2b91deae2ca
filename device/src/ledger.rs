//! The ledger of a device, written by `machine`: its actions, their energy cost by state, and its outages.
//!
//! The ledger counts actions instead of summing costs. The energy spent follows from the counts and the costs. The
//! ledger and the battery are therefore two independent accounts of the same energy. [`DeviceTotals::is_balanced`]
//! compares them.
//!
//! `machine` records every TTI exactly once. A single TTI takes [`LedgerBuilder::record_duty`] at its start and
//! [`LedgerBuilder::record_end`] at its end. A span of paid TTIs takes [`LedgerBuilder::record_paid_span`] alone. A
//! span on an empty battery takes [`LedgerBuilder::record_outage`] and `record_end`. TTIs of a device that is switched
//! off take [`LedgerBuilder::record_off`] and `record_end`. False wake-ups and transmissions are recorded in addition.
//! The digest hashes the result, and `tests/src/reference/device.rs` counts the same.

use reveille_common::ids::Tti;
use reveille_common::scenario::EnergyModel;
use reveille_common::totals::{DeviceTotals, EnergyByState, Ledger};
use reveille_common::units::Energy;
use serde::{Deserialize, Serialize};

use crate::battery::Battery;

/// The effect of an action on the battery: paid in full, or failed after draining the remaining energy.
type Payment = Result<(), Energy>;

/// The ledger of one device since TTI 0. The fields, in this order, are part of a device's checkpoint
/// ([`Machine::checkpoint`](crate::machine::Machine::checkpoint)): a change raises `WIRE_VERSION`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct LedgerBuilder {
    /// The number of TTIs with δ = 1, paid or not.
    sensing_ttis: u64,
    /// The number of TTIs in which an action of an operator had switched the device off.
    off_ttis: u64,
    /// The number of TTIs with δ = 1 that the battery could not pay; failures by operators are `off_ttis`.
    failed_ttis: u64,
    /// The number of TTIs with δ = 0 that the battery could not pay.
    unpowered_ttis: u64,
    /// The number of false wake-ups, paid or not.
    false_wake_ups: u64,
    /// The number of false wake-ups that the battery could not pay.
    unpaid_false_wake_ups: u64,
    /// The number of paid transmissions.
    transmissions: u64,
    /// The energy drained by actions that the battery could not pay.
    drained_by_state: EnergyByState,
    /// The sum of the battery levels at the ends of all TTIs, micro-units.
    battery_sum: u128,
    /// The number of TTIs that ended with less than `E_Tx` in the battery.
    low_ttis: u64,
    /// The number of consecutive TTIs up to now whose cost the battery could not pay.
    current_outage: u64,
    /// The largest value of `current_outage` in the measured part, or so far in the warm-up.
    longest_outage: u64,
    /// The first measured TTI.
    measured_from: Tti,
    /// The totals of the warm-up; `None` before the measured part starts.
    warm_up_totals: Option<Box<DeviceTotals>>,
}

impl LedgerBuilder {
    /// Creates an empty ledger, measured from TTI `measured_from` on.
    pub const fn new(measured_from: Tti) -> Self {
        let drained_by_state = EnergyByState {
            sensing: Energy::ZERO,
            sleep: Energy::ZERO,
            report: Energy::ZERO,
        };
        Self {
            sensing_ttis: 0,
            off_ttis: 0,
            failed_ttis: 0,
            unpowered_ttis: 0,
            false_wake_ups: 0,
            unpaid_false_wake_ups: 0,
            transmissions: 0,
            drained_by_state,
            battery_sum: 0,
            low_ttis: 0,
            current_outage: 0,
            longest_outage: 0,
            measured_from,
            warm_up_totals: None,
        }
    }

    /// The first measured TTI.
    #[inline]
    pub const fn measured_from(&self) -> Tti {
        self.measured_from
    }

    /// Starts the measured part, after the warm-up with these totals. [`Machine::advance_to`] calls it before it
    /// records TTI `measured_from`. A repeated call has no effect.
    ///
    /// [`Machine::advance_to`]: crate::machine::Machine::advance_to
    pub fn start_measuring(&mut self, warm_up_totals: DeviceTotals) {
        if self.warm_up_totals.is_none() {
            self.warm_up_totals = Some(Box::new(warm_up_totals));
            // An outage that began in the warm-up counts only from here.
            (self.current_outage, self.longest_outage) = (0, 0);
        }
    }

    /// Records the start of a TTI, with δ = 1 if `is_on`.
    pub fn record_duty(&mut self, is_on: bool, payment: Payment) {
        self.sensing_ttis += u64::from(is_on);
        match payment {
            Ok(()) => self.current_outage = 0,
            Err(drained) => {
                if is_on {
                    self.drained_by_state.sensing += drained;
                } else {
                    self.drained_by_state.sleep += drained;
                }
                self.failed_ttis += u64::from(is_on);
                self.unpowered_ttis += u64::from(!is_on);
                self.lengthen_outage(1);
            }
        }
    }

    /// Records `ttis` TTIs in which the electronics are off. They are no outage, since nothing has to be paid.
    pub const fn record_off(&mut self, ttis: u64) {
        self.off_ttis += ttis;
        self.current_outage = 0;
    }

    /// Records TTIs on an empty battery, `on_ttis` with δ = 1 and `sleep_ttis` with δ = 0.
    pub fn record_outage(&mut self, on_ttis: u64, sleep_ttis: u64) {
        self.sensing_ttis += on_ttis;
        self.failed_ttis += on_ttis;
        self.unpowered_ttis += sleep_ttis;
        self.lengthen_outage(on_ttis + sleep_ttis);
    }

    /// Records TTIs in which everything was paid, `on_ttis` of them with δ = 1. Their end-of-TTI levels add up to
    /// `level_sum`, and `low_ttis` of them ended below E_Tx.
    #[inline]
    pub fn record_paid_span(&mut self, on_ttis: u64, level_sum: Energy, low_ttis: u64) {
        self.sensing_ttis += on_ttis;
        self.current_outage = 0;
        self.battery_sum += u128::from(level_sum.micro());
        self.low_ttis += low_ttis;
    }

    /// Records a false wake-up in a TTI with δ = 0. Its cost is a cost of listening and counts for S4.
    pub fn record_false_wake_up(&mut self, payment: Payment) {
        self.false_wake_ups += 1;
        if let Err(drained) = payment {
            self.unpaid_false_wake_ups += 1;
            self.drained_by_state.sleep += drained;
        }
    }

    /// Records an attempt to transmit.
    pub fn record_transmission(&mut self, payment: Payment) {
        match payment {
            Ok(()) => self.transmissions += 1,
            Err(drained) => self.drained_by_state.report += drained,
        }
    }

    /// Records the end of `ttis` TTIs with `level` in the battery.
    pub fn record_end(&mut self, level: Energy, e_tx: Energy, ttis: u64) {
        self.battery_sum += u128::from(level.micro()) * u128::from(ttis);
        self.low_ttis += if level < e_tx { ttis } else { 0 };
    }

    /// Returns the totals over the TTIs before `next`, with these costs and this battery. All of them must be recorded,
    /// the last one to its end; TTIs that are missing would count as TTIs in S4.
    pub fn totals(&self, next: Tti, costs: &EnergyModel, battery: &Battery) -> DeviceTotals {
        // Each other TTI before `next` had either δ = 1 or δ = 0.
        let sleep_ttis = next.0 - self.off_ttis - self.sensing_ttis;
        DeviceTotals {
            initial: battery.initial(),
            harvested: battery.harvested(),
            spent: EnergyByState {
                sensing: costs.e_idle.times(self.sensing_ttis - self.failed_ttis) + self.drained_by_state.sensing,
                sleep: costs.e_wur.times(sleep_ttis - self.unpowered_ttis)
                    + costs.e_idle.times(self.false_wake_ups - self.unpaid_false_wake_ups)
                    + self.drained_by_state.sleep,
                report: costs.e_tx.times(self.transmissions) + self.drained_by_state.report,
            },
            overflow: battery.overflow(),
            battery: battery.level(),
            battery_sum: self.battery_sum,
            low_ttis: self.low_ttis,
            sensing_ttis: self.sensing_ttis,
            failed_ttis: self.failed_ttis,
            unpowered_ttis: self.unpowered_ttis,
            false_wake_ups: self.false_wake_ups,
        }
    }

    /// Returns the ledger of a run with the totals `whole`, which [`Self::totals`] returned. The values of the measured
    /// part are 0 until it starts.
    pub fn ledger(&self, whole: DeviceTotals) -> Ledger {
        let measured = self.warm_up_totals.as_ref().map(|warm_up| whole - **warm_up);
        Ledger {
            whole,
            measured: measured.unwrap_or_default(),
            longest_outage: if measured.is_some() { self.longest_outage } else { 0 },
        }
    }

    fn lengthen_outage(&mut self, ttis: u64) {
        self.current_outage += ttis;
        self.longest_outage = self.longest_outage.max(self.current_outage);
    }
}
