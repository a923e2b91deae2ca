//! Exact integer totals of devices, events and radio traffic, from which every metric follows.
//!
//! Integer sums do not depend on the order of addition, so any split of a run over hosts gives the same totals. The
//! totals of devices and of ended events travel on the bus, with [`MissCause`]: a change of their fields raises
//! `WIRE_VERSION`. `summary.json` holds [`Totals`] by the names of its fields. The digest hashes most fields.

use std::ops::{Add, AddAssign, Sub};

use serde::{Deserialize, Serialize};

use crate::units::Energy;

/// Number of parts per unit of information in the totals.
pub const PICO_PER_INFORMATION: f64 = 1e12;

/// Energy taken out of a battery, by the state in which it was spent (Eq. (4)). Energy drained by a failed action
/// counts for the state that failed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnergyByState {
    /// In S1: E_idle.
    pub sensing: Energy,
    /// In S4: E_WuR, and E_idle after a false or late wake-up.
    pub sleep: Energy,
    /// From S2 to S3: E_Tx.
    pub report: Energy,
}

impl EnergyByState {
    /// Returns the sum over all states.
    pub fn total(&self) -> Energy {
        self.sensing + self.sleep + self.report
    }
}

impl Add for EnergyByState {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            sensing: self.sensing + other.sensing,
            sleep: self.sleep + other.sleep,
            report: self.report + other.report,
        }
    }
}

impl Sub for EnergyByState {
    type Output = Self;
    fn sub(self, before: Self) -> Self {
        Self {
            sensing: self.sensing - before.sensing,
            sleep: self.sleep - before.sleep,
            report: self.report - before.report,
        }
    }
}

/// The sums of one or several devices from the start of the run to the end of a TTI.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceTotals {
    /// Battery at the start.
    pub initial: Energy,
    /// Energy that arrived, overflow included.
    pub harvested: Energy,
    /// Energy taken out of the battery, including energy drained by failed actions.
    pub spent: EnergyByState,
    /// Harvest that did not fit in the battery.
    pub overflow: Energy,
    /// Current battery. Always `initial + harvested - spent - overflow`.
    pub battery: Energy,
    /// Σ over TTIs of the battery at the end of the TTI, micro-units.
    pub battery_sum: u128,
    /// Device-TTIs that ended with less than E_Tx in the battery.
    pub low_ttis: u64,
    /// Device-TTIs with δ = 1.
    pub sensing_ttis: u64,
    /// Device-TTIs with δ = 1 in which the battery could not pay E_idle.
    pub failed_ttis: u64,
    /// Device-TTIs with δ = 0 in which the battery could not pay E_WuR: the device was unpowered.
    pub unpowered_ttis: u64,
    /// Device-TTIs with δ = 0 in which the device had a false or late wake-up.
    pub false_wake_ups: u64,
}

impl DeviceTotals {
    /// Whether the energy put in equals the energy taken out and left.
    pub fn is_balanced(&self) -> bool {
        // In 128 bits: a host's ledger can hold any numbers, and `Energy` panics if a sum overflows.
        let sum = |parts: &[Energy]| parts.iter().map(|part| u128::from(part.micro())).sum::<u128>();
        let EnergyByState { sensing, sleep, report } = self.spent;
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
            unpowered_ttis: self.unpowered_ttis + other.unpowered_ttis,
            false_wake_ups: self.false_wake_ups + other.false_wake_ups,
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
    /// Returns the sums of the TTIs between the earlier totals `before` and these.
    fn sub(self, before: Self) -> Self {
        Self {
            // The part starts with the battery at `before`, so that it is balanced like a whole run.
            initial: before.battery,
            harvested: self.harvested - before.harvested,
            spent: self.spent - before.spent,
            overflow: self.overflow - before.overflow,
            battery: self.battery,
            battery_sum: self.battery_sum - before.battery_sum,
            low_ttis: self.low_ttis - before.low_ttis,
            sensing_ttis: self.sensing_ttis - before.sensing_ttis,
            failed_ttis: self.failed_ttis - before.failed_ttis,
            unpowered_ttis: self.unpowered_ttis - before.unpowered_ttis,
            false_wake_ups: self.false_wake_ups - before.false_wake_ups,
        }
    }
}

/// The ledger of one device at the end of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ledger {
    /// The sums of the whole run.
    pub whole: DeviceTotals,
    /// The sums of the measured TTIs only; all 0 if the run ended in the warm-up.
    pub measured: DeviceTotals,
    /// Maximum number of consecutive measured TTIs without enough energy for δ = 1 or for the wake-up radio.
    pub longest_outage: u64,
}

impl Ledger {
    /// Whether both sums are balanced and the measured part can belong to the whole. The base station refuses other
    /// ledgers. A new count of [`DeviceTotals`] needs a check here.
    pub fn is_valid(&self) -> bool {
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
                && part.unpowered_ttis <= whole.unpowered_ttis
                && part.false_wake_ups <= whole.false_wake_ups
        };
        // In 128 bits, because the counts of an invalid ledger can overflow.
        let outages = u128::from(measured.failed_ttis) + u128::from(measured.unpowered_ttis);
        whole.is_balanced()
            && measured.is_balanced()
            // For the whole, this only checks that no more TTIs failed than had δ = 1.
            && within(whole)
            && within(measured)
            && u128::from(*longest_outage) <= outages
    }
}

/// The totals of one event.
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
    #[serde(rename = "wasted")]
    pub wasted_energy: Energy,
}

impl EventTally {
    /// Returns I_i in units of information.
    pub const fn information(&self) -> f64 {
        self.information_pico as f64 / PICO_PER_INFORMATION
    }
}

/// Sums over the counted events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventTotals {
    /// Events that started in the measured part and ended before the end of the run.
    pub events: u64,
    /// Events that ended without a report.
    pub misdetected: u64,
    /// TTIs from the start of an event to its first report, summed over the reported events.
    pub delay_ttis: u64,
    /// Reports.
    pub reports: u64,
    /// Wake-ups.
    pub wake_ups: u64,
    /// Σ I_i, in 10⁻¹² units of information.
    pub information_pico: u128,
    /// Wrong activations.
    pub wrong_activations: u64,
    /// Energy that the wrong activations spent or lost.
    #[serde(rename = "wasted")]
    pub wasted_energy: Energy,
}

impl EventTotals {
    /// Adds an ended event with its totals; its first report, if any, took `delay` TTIs. A new field of [`EventTally`]
    /// needs a sum here.
    pub fn count(&mut self, event: &EventTally, delay: Option<u64>) {
        self.events += 1;
        self.misdetected += u64::from(delay.is_none());
        self.delay_ttis += delay.unwrap_or(0);
        self.reports += event.reports;
        self.wake_ups += event.wake_ups;
        self.information_pico += u128::from(event.information_pico);
        self.wrong_activations += event.wrong_activations;
        self.wasted_energy += event.wasted_energy;
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
            wasted_energy: self.wasted_energy - before.wasted_energy,
        }
    }
}

/// The traffic on the air in one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageTotals {
    /// Number of messages sent on the air plane; a broadcast counts once.
    pub messages: u64,
    /// Bytes of the messages' payloads as encoded.
    pub bytes: u64,
}

impl MessageTotals {
    /// Adds a message of `bytes` bytes.
    pub const fn count(&mut self, bytes: u64) {
        self.messages += 1;
        self.bytes += bytes;
    }
}

/// The distribution of energy and low batteries over the devices in the measured part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Spread {
    /// Σ over devices of the square of the energy spent, micro-units².
    pub spent_squares: u128,
    /// Maximum over the devices of the number of TTIs that ended with less than E_Tx.
    pub worst_low_ttis: u64,
}

impl Spread {
    /// Computes the spread over devices with these sums.
    pub fn from_devices<'a>(devices: impl IntoIterator<Item = &'a DeviceTotals>) -> Self {
        devices.into_iter().fold(Self::default(), |so_far, device| {
            let spent = u128::from(device.spent.total().micro());
            Self {
                spent_squares: so_far.spent_squares.saturating_add(spent * spent),
                worst_low_ttis: so_far.worst_low_ttis.max(device.low_ttis),
            }
        })
    }
}

/// The cause of a missed event: the first condition for a report that no device met. Variants are in the order of the
/// conditions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum MissCause {
    /// No device is within d_max of the epicentre.
    OutOfReach,
    /// All devices within d_max were removed before the event started, or failed by an operator for its whole duration.
    Removed,
    /// The probabilistic detection of the event fails for every device within d_max.
    Undetected,
    /// The devices that would have detected the event slept throughout it.
    Asleep,
    /// Devices that would have detected the event had δ = 1, but an operator had failed them.
    Failed,
    /// Devices that would have detected the event had δ = 1, but none of them could pay for sensing.
    Unpowered,
    /// Devices were woken for the event, as only an oracle can order, and their wake-up radios received nothing: they
    /// were unpowered, or missed the signal.
    WakeMissed,
    /// Devices detected the event, and none of them could pay for a report.
    NoEnergy,
    /// Devices reported the event, and all reports were lost.
    Lost,
}

impl MissCause {
    /// Number of causes.
    pub const COUNT: usize = Self::ALL.len();

    /// All causes, in the order of the conditions.
    pub const ALL: [Self; 9] = [
        Self::OutOfReach,
        Self::Removed,
        Self::Undetected,
        Self::Asleep,
        Self::Failed,
        Self::Unpowered,
        Self::WakeMissed,
        Self::NoEnergy,
        Self::Lost,
    ];

    /// The name in tables; the metric `missed_NAME_pct` repeats it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OutOfReach => "out_of_reach",
            Self::Removed => "removed",
            Self::Undetected => "undetected",
            Self::Asleep => "asleep",
            Self::Failed => "failed",
            Self::Unpowered => "unpowered",
            Self::WakeMissed => "wake_missed",
            Self::NoEnergy => "no_energy",
            Self::Lost => "lost",
        }
    }

    /// Returns the cause with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|cause| cause.name() == name)
    }

    /// The cause as a clause about an event.
    pub const fn explanation(self) -> &'static str {
        match self {
            Self::OutOfReach => "no device within d_max",
            Self::Removed => "all devices within d_max were removed or failed",
            Self::Undetected => "detection failed for every device within d_max",
            Self::Asleep => "devices within d_max slept by plan",
            Self::Failed => "an operator had failed the devices with δ = 1",
            Self::Unpowered => "devices told to sense had no power",
            Self::WakeMissed => "no woken device received its wake-up",
            Self::NoEnergy => "devices detected it but could not pay for a report",
            Self::Lost => "every report was lost on the radio",
        }
    }
}

/// Missed counted events by [`MissCause`]. Each missed event has exactly one cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissedEvents {
    /// [`MissCause::OutOfReach`].
    pub out_of_reach: u64,
    /// [`MissCause::Removed`].
    pub removed: u64,
    /// [`MissCause::Undetected`].
    pub undetected: u64,
    /// [`MissCause::Asleep`].
    pub asleep: u64,
    /// [`MissCause::Failed`].
    pub failed: u64,
    /// [`MissCause::Unpowered`].
    pub unpowered: u64,
    /// [`MissCause::WakeMissed`].
    pub wake_missed: u64,
    /// [`MissCause::NoEnergy`].
    pub no_energy: u64,
    /// [`MissCause::Lost`].
    pub lost: u64,
}

impl MissedEvents {
    /// Returns the number of events that were missed because of `cause`.
    pub const fn by_cause(&self, cause: MissCause) -> u64 {
        match cause {
            MissCause::OutOfReach => self.out_of_reach,
            MissCause::Removed => self.removed,
            MissCause::Undetected => self.undetected,
            MissCause::Asleep => self.asleep,
            MissCause::Failed => self.failed,
            MissCause::Unpowered => self.unpowered,
            MissCause::WakeMissed => self.wake_missed,
            MissCause::NoEnergy => self.no_energy,
            MissCause::Lost => self.lost,
        }
    }

    /// Counts an event that was missed because of `cause`.
    pub const fn count(&mut self, cause: MissCause) {
        *match cause {
            MissCause::OutOfReach => &mut self.out_of_reach,
            MissCause::Removed => &mut self.removed,
            MissCause::Undetected => &mut self.undetected,
            MissCause::Asleep => &mut self.asleep,
            MissCause::Failed => &mut self.failed,
            MissCause::Unpowered => &mut self.unpowered,
            MissCause::WakeMissed => &mut self.wake_missed,
            MissCause::NoEnergy => &mut self.no_energy,
            MissCause::Lost => &mut self.lost,
        } += 1;
    }

    /// Returns the number of missed events.
    pub fn events(&self) -> u64 {
        MissCause::ALL.into_iter().map(|cause| self.by_cause(cause)).sum()
    }
}

/// The losses of the radio in the measured TTIs, and the numbers of messages sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RadioLosses {
    /// Number of reports that were sent and did not reach the BS.
    #[serde(rename = "reports")]
    pub lost_reports: u64,
    /// Number of wake-ups sent.
    #[serde(rename = "wake_ups")]
    pub sent_wake_ups: u64,
    /// Number of wake-ups that the device did not receive: its radio missed them, it was unpowered or not asleep.
    pub missed_wake_ups: u64,
    /// Number of wake-ups that took effect too late: the device woke after the end of the event.
    #[serde(rename = "late")]
    pub late_wake_ups: u64,
    /// Number of plans sent, counted for each device.
    #[serde(rename = "plans")]
    pub sent_plans: u64,
    /// Number of these plans that a device missed.
    pub missed_plans: u64,
}

/// The exact totals of the measured part of a run. Every metric follows from them and the scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    /// Number of devices N.
    pub devices: u64,
    /// Number of measured TTIs.
    pub ttis: u64,
    /// Sums over the counted events.
    pub events: EventTotals,
    /// Missed events by cause.
    pub missed: MissedEvents,
    /// Smallest number of TTIs within which 95 % of the reported events were reported; 0 without reported events.
    pub delay_p95_ttis: u64,
    /// The control channel: δ, wake-ups and synchronisation, BS → devices.
    pub control: MessageTotals,
    /// Reports, devices → BS, that arrived in the measured TTIs.
    pub uplink: MessageTotals,
    /// The losses of the radio.
    pub losses: RadioLosses,
    /// Sums over all devices.
    pub energy: DeviceTotals,
    /// The distribution over the devices.
    pub spread: Spread,
    /// TTIs from the first report of an event to its last, summed over the reported events: the cost of wake-ups in
    /// sequence.
    pub wake_up_span_ttis: u64,
    /// Device-TTIs of removed devices.
    pub removed_ttis: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ledger() -> Ledger {
        let micro = Energy::from_micro;
        let whole = DeviceTotals {
            initial: micro(100),
            harvested: micro(40),
            spent: EnergyByState {
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
            unpowered_ttis: 4,
            false_wake_ups: 2,
        };
        let at_warm_up = DeviceTotals {
            initial: micro(100),
            spent: EnergyByState {
                sensing: micro(10),
                ..EnergyByState::default()
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
    fn an_unbalanced_or_inconsistent_ledger_is_invalid() {
        let valid = ledger();
        assert!(valid.is_valid());
        assert_eq!(valid.measured.spent.total(), Energy::from_micro(50));
        let mutations: [fn(&mut Ledger); 7] = [
            |ledger| ledger.whole.spent.sleep += Energy::from_micro(1),
            |ledger| ledger.measured.spent.report += Energy::from_micro(1),
            |ledger| ledger.measured.low_ttis = 4,
            |ledger| ledger.measured.failed_ttis = 12,
            |ledger| ledger.longest_outage = 7,
            |ledger| ledger.measured.false_wake_ups = 3,
            |ledger| ledger.whole.harvested = Energy::from_micro(u64::MAX),
        ];
        for (number, mutate) in mutations.into_iter().enumerate() {
            let mut invalid = valid;
            mutate(&mut invalid);
            assert!(!invalid.is_valid(), "mutation {number}: {invalid:?}");
        }
    }

    #[test]
    fn the_spread_contains_squares_and_the_worst_device() {
        let device = |spent: u64, low_ttis| DeviceTotals {
            spent: EnergyByState {
                report: Energy::from_micro(spent),
                ..EnergyByState::default()
            },
            low_ttis,
            ..DeviceTotals::default()
        };
        let spread = Spread::from_devices(&[device(3, 1), device(4, 9), device(0, 2)]);
        assert_eq!((spread.spent_squares, spread.worst_low_ttis), (25, 9));
    }
}
