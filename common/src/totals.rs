//! Exact integer totals: what devices, events and the control channel add up to.

use std::ops::{Add, AddAssign, Sub};

use serde::{Deserialize, Serialize};

use crate::units::Energy;

/// Parts of one unit of information in the totals.
pub const PICO_PER_INFORMATION: f64 = 1e12;

/// Energy taken out of a battery, by the state that it was spent in (Eq. (4)). What a failed action drained is in the
/// state that failed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Spent {
    /// In S1: E_idle.
    pub sensing: Energy,
    /// In S4: E_WuR, and E_idle where a device has woken for nothing.
    pub sleep: Energy,
    /// From S2 to S3: E_Tx.
    pub report: Energy,
}

impl Spent {
    /// All of it.
    pub fn total(&self) -> Energy {
        self.sensing + self.sleep + self.report
    }
}

impl Add for Spent {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            sensing: self.sensing + other.sensing,
            sleep: self.sleep + other.sleep,
            report: self.report + other.report,
        }
    }
}

impl Sub for Spent {
    type Output = Self;
    fn sub(self, before: Self) -> Self {
        Self {
            sensing: self.sensing - before.sensing,
            sleep: self.sleep - before.sleep,
            report: self.report - before.report,
        }
    }
}

/// The sums of one device, or of several: since the start of the run, up to the end of some TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceTotals {
    /// Battery at the start.
    pub initial: Energy,
    /// Energy that arrived, overflow included.
    pub harvested: Energy,
    /// Energy taken out of the battery, what failed actions drained included.
    pub spent: Spent,
    /// Harvest that did not fit in the battery.
    pub overflow: Energy,
    /// Battery now. Always `initial + harvested - spent - overflow`.
    pub battery: Energy,
    /// Σ over TTIs of the battery at the end of the TTI, micro-units.
    pub battery_sum: u128,
    /// Device-TTIs that ended with less than E_Tx in the battery.
    pub low_ttis: u64,
    /// Device-TTIs with δ = 1.
    pub sensing_ttis: u64,
    /// Those of them in which the battery could not pay E_idle.
    pub failed_ttis: u64,
    /// Device-TTIs with δ = 0 in which the battery could not pay E_WuR: the wake-up radio was deaf.
    pub dark_ttis: u64,
    /// Device-TTIs with δ = 0 in which the device woke for nothing.
    pub false_wakes: u64,
}

impl DeviceTotals {
    /// Whether what went in is what came out and what is left.
    pub fn closes(&self) -> bool {
        let sum = |parts: &[Energy]| parts.iter().map(|part| u128::from(part.micro())).sum::<u128>();
        let Spent { sensing, sleep, report } = self.spent;
        sum(&[self.initial, self.harvested]) == sum(&[sensing, sleep, report, self.overflow, self.battery])
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
            sensing_ttis: self.sensing_ttis + other.sensing_ttis,
            failed_ttis: self.failed_ttis + other.failed_ttis,
            dark_ttis: self.dark_ttis + other.dark_ttis,
            false_wakes: self.false_wakes + other.false_wakes,
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
    /// What was added between an earlier state `before` and this one: the sums of the TTIs between.
    fn sub(self, before: Self) -> Self {
        Self {
            initial: before.battery,
            harvested: self.harvested - before.harvested,
            spent: self.spent - before.spent,
            overflow: self.overflow - before.overflow,
            battery: self.battery,
            battery_sum: self.battery_sum - before.battery_sum,
            low_ttis: self.low_ttis - before.low_ttis,
            sensing_ttis: self.sensing_ttis - before.sensing_ttis,
            failed_ttis: self.failed_ttis - before.failed_ttis,
            dark_ttis: self.dark_ttis - before.dark_ttis,
            false_wakes: self.false_wakes - before.false_wakes,
        }
    }
}

/// The books of one device at the end of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ledger {
    /// The sums of the whole run.
    pub whole: DeviceTotals,
    /// Those of the measured TTIs alone; nothing if the run ended in the warm-up.
    pub measured: DeviceTotals,
    /// The most measured TTIs one after another in which the battery could pay for nothing: δ = 1 that failed, or a
    /// wake-up radio without power.
    pub longest_outage: u64,
}

impl Ledger {
    /// Whether both sums close and the measured part can be one of the whole.
    pub fn is_sound(&self) -> bool {
        let Self {
            whole,
            measured,
            longest_outage,
        } = self;
        let within = |part: &DeviceTotals| {
            part.harvested <= whole.harvested
                && part.overflow <= whole.overflow
                && part.spent.sensing <= whole.spent.sensing
                && part.spent.sleep <= whole.spent.sleep
                && part.spent.report <= whole.spent.report
                && part.battery_sum <= whole.battery_sum
                && part.low_ttis <= whole.low_ttis
                && part.sensing_ttis <= whole.sensing_ttis
                && part.failed_ttis <= part.sensing_ttis.min(whole.failed_ttis)
                && part.dark_ttis <= whole.dark_ttis
                && part.false_wakes <= whole.false_wakes
        };
        let outages = u128::from(measured.failed_ttis) + u128::from(measured.dark_ttis);
        whole.closes()
            && measured.closes()
            && within(whole)
            && within(measured)
            && u128::from(*longest_outage) <= outages
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

impl EventTally {
    /// I_i, in units of information.
    pub const fn information(&self) -> f64 {
        self.information_pico as f64 / PICO_PER_INFORMATION
    }
}

/// Sums over the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventTotals {
    /// Events that started in the measured part and ended before the run did.
    pub events: u64,
    /// Events that ended without a report.
    pub misdetected: u64,
    /// TTIs from the start of an event to its first report, summed over the events that were reported.
    pub delay_ttis: u64,
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
    /// Counts one ended event, which came to this and whose first report took `delay` TTIs, if there was one.
    pub fn count(&mut self, event: &EventTally, delay: Option<u64>) {
        self.events += 1;
        self.misdetected += u64::from(delay.is_none());
        self.delay_ttis += delay.unwrap_or(0);
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
            delay_ttis: self.delay_ttis - before.delay_ttis,
            reports: self.reports - before.reports,
            wake_ups: self.wake_ups - before.wake_ups,
            information_pico: self.information_pico - before.information_pico,
            wrong_activations: self.wrong_activations - before.wrong_activations,
            wasted: self.wasted - before.wasted,
        }
    }
}

/// What went over the air in one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Traffic {
    /// Messages put on the air plane; a broadcast is one.
    pub messages: u64,
    /// Bytes of the messages' payloads as encoded.
    pub bytes: u64,
}

impl Traffic {
    /// One more message, `bytes` long.
    pub const fn count(&mut self, bytes: u64) {
        self.messages += 1;
        self.bytes += bytes;
    }
}

/// How evenly the devices share what they go through in the measured part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Spread {
    /// Σ over devices of the square of the energy spent, micro-units².
    pub spent_squares: u128,
    /// The most TTIs that one device ended with less than E_Tx.
    pub worst_low_ttis: u64,
}

impl Spread {
    /// The spread over devices with these sums.
    pub fn of<'a>(devices: impl IntoIterator<Item = &'a DeviceTotals>) -> Self {
        devices.into_iter().fold(Self::default(), |so_far, device| {
            let spent = u128::from(device.spent.total().micro());
            Self {
                spent_squares: so_far.spent_squares.saturating_add(spent * spent),
                worst_low_ttis: so_far.worst_low_ttis.max(device.low_ttis),
            }
        })
    }
}

/// Why counted events were missed: each missed event has one cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missed {
    /// No device stands within `d_max` of the epicentre.
    pub out_of_reach: u64,
    /// Somebody reported it, and all reports were lost on their way.
    pub lost: u64,
    /// Somebody detected it, and nobody who did could pay for a report.
    pub unpaid: u64,
    /// Devices stand within `d_max`, and while it lasted none of them detected it: they slept, or could not pay for
    /// sensing, or, with detection by chance, it escaped them.
    pub unseen: u64,
}

impl Missed {
    /// All of them.
    pub const fn events(&self) -> u64 {
        self.out_of_reach + self.lost + self.unpaid + self.unseen
    }
}

/// What the radio lost in the measured TTIs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Losses {
    /// Reports that were sent and did not reach the BS.
    pub reports: u64,
    /// Wake-ups sent.
    pub wake_ups: u64,
    /// Those of them that the device did not hear: its radio missed it or had no power, or it was not asleep.
    pub unheard: u64,
    /// Those of them that the device heard too late: it woke when the event was over.
    pub late: u64,
    /// Plans sent, one for each device.
    pub plans: u64,
    /// Those of them that the device missed.
    pub missed_plans: u64,
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
    /// Why events were missed.
    pub missed: Missed,
    /// The least number of TTIs within which 95 % of the reported events were reported; 0 if none was.
    pub delay_p95_ttis: u64,
    /// The control channel: δ, wake-ups and synchronisation, BS → devices.
    pub control: Traffic,
    /// Reports, devices → BS, of measured TTIs, those that arrived.
    pub uplink: Traffic,
    /// What was lost.
    pub losses: Losses,
    /// Sums over all devices.
    pub energy: DeviceTotals,
    /// How they differ.
    pub spread: Spread,
    /// TTIs from the first report of an event to its last, summed over the events that were reported: what it takes to
    /// wake devices one after another.
    pub refining_ttis: u64,
    /// Device-TTIs of devices that were gone.
    pub gone_ttis: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ledger() -> Ledger {
        let micro = Energy::from_micro;
        let whole = DeviceTotals {
            initial: micro(100),
            harvested: micro(40),
            spent: Spent {
                sensing: micro(30),
                sleep: micro(20),
                report: micro(10),
            },
            overflow: micro(5),
            battery: micro(75),
            battery_sum: 900,
            low_ttis: 3,
            sensing_ttis: 12,
            failed_ttis: 2,
            dark_ttis: 4,
            false_wakes: 2,
        };
        let at_warm_up = DeviceTotals {
            initial: micro(100),
            spent: Spent {
                sensing: micro(10),
                ..Spent::default()
            },
            battery: micro(90),
            battery_sum: 90,
            sensing_ttis: 1,
            ..DeviceTotals::default()
        };
        Ledger {
            whole,
            measured: whole - at_warm_up,
            longest_outage: 6,
        }
    }

    #[test]
    fn a_ledger_closes_by_state_and_its_parts_fit() {
        let good = ledger();
        assert!(good.is_sound());
        assert_eq!(good.measured.spent.total(), Energy::from_micro(50));
        let breaks: [fn(&mut Ledger); 7] = [
            |ledger| ledger.whole.spent.sleep += Energy::from_micro(1),
            |ledger| ledger.measured.spent.report += Energy::from_micro(1),
            |ledger| ledger.measured.low_ttis = 4,
            |ledger| ledger.measured.failed_ttis = 12,
            |ledger| ledger.longest_outage = 7,
            |ledger| ledger.measured.false_wakes = 3,
            |ledger| ledger.whole.harvested = Energy::from_micro(u64::MAX),
        ];
        for (number, spoil) in breaks.into_iter().enumerate() {
            let mut bad = good;
            spoil(&mut bad);
            assert!(!bad.is_sound(), "{number}");
        }
    }

    #[test]
    fn the_spread_is_that_of_the_devices() {
        let device = |spent: u64, low_ttis| DeviceTotals {
            spent: Spent {
                report: Energy::from_micro(spent),
                ..Spent::default()
            },
            low_ttis,
            ..DeviceTotals::default()
        };
        let spread = Spread::of(&[device(3, 1), device(4, 9), device(0, 2)]);
        assert_eq!((spread.spent_squares, spread.worst_low_ttis), (25, 9));
    }
}
