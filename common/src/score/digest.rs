//! The run's fingerprint.
//!
//! SHA-256 over what happened, in the order of TTIs: events, reports, wake-ups and their outcomes, changes of the δ
//! plan; then each device's ledger by id and the totals behind the metrics. It holds nothing per TTI, so that a driver
//! may skip over quiet TTIs, and nothing of how messages are encoded: fields are hashed, each as 64 bits.

use std::fmt;

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::event::Stimulus;
use crate::ids::{DeviceId, Tti};
use crate::message::{Outage, PlanUpdate, Report, WakeOutcome};
use crate::plan::{DutyCycle, Plan};
use crate::totals::{DeviceTotals, EventTally, EventTotals, Ledger, Spent, Spread, Totals};
use crate::units::Energy;

/// The version of what is hashed. Fingerprints of different versions say nothing about each other.
pub const DIGEST_VERSION: u32 = 2;

/// A finished fingerprint; shown as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Digest([u8; 32]);

impl Digest {
    /// The SHA-256 sum.
    pub const fn bytes(self) -> [u8; 32] {
        self.0
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl Serialize for Digest {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// A fingerprint in the making.
#[derive(Clone, Debug, Default)]
pub struct Fingerprint(Sha256);

impl Fingerprint {
    /// An event has started in `tti`.
    pub fn event_started(&mut self, tti: Tti, stimulus: &Stimulus) {
        self.words(
            b'E',
            [
                tti.0,
                stimulus.event.0,
                stimulus.epicentre.x.to_bits(),
                stimulus.epicentre.y.to_bits(),
            ],
        );
    }

    /// An event's last TTI was `tti`.
    pub fn event_ended(&mut self, tti: Tti, tally: &EventTally) {
        let EventTally {
            reports,
            wake_ups,
            information_pico,
            wrong_activations,
            wasted,
        } = *tally;
        self.words(
            b'e',
            [
                tti.0,
                reports,
                wake_ups,
                information_pico,
                wrong_activations,
                wasted.micro(),
            ],
        );
    }

    /// A report has reached the BS.
    pub fn report(&mut self, report: &Report) {
        self.sent(b'R', report);
    }

    /// A report was lost.
    pub fn lost(&mut self, report: &Report) {
        self.sent(b'X', report);
    }

    fn sent(&mut self, tag: u8, report: &Report) {
        let Report {
            device,
            tti,
            information,
            battery,
        } = *report;
        self.words(
            tag,
            [tti.0, u64::from(device.0), information.to_bits(), battery.micro()],
        );
    }

    /// Devices are gone.
    pub fn gone(&mut self, outage: &Outage) {
        let Outage {
            first,
            count,
            tti,
            wake_ups,
        } = *outage;
        let wake_ups = wake_ups.map_or(0, |before| 1 + u64::from(before));
        self.words(b'G', [tti.0, u64::from(first.0), u64::from(count), wake_ups]);
    }

    /// `device` was sent a wake-up in `tti`.
    pub fn wake_up(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome) {
        let (kind, drained) = match outcome {
            WakeOutcome::Reported(_) => (0, Energy::ZERO),
            WakeOutcome::Failed(failure) => (1, failure.drained),
            WakeOutcome::Unheard => (2, Energy::ZERO),
            WakeOutcome::Lost(_) => (3, Energy::ZERO),
            WakeOutcome::Late { spent, .. } => (4, *spent),
        };
        self.words(b'W', [tti.0, u64::from(device.0), kind, drained.micro()]);
        match outcome {
            WakeOutcome::Reported(report) => self.report(report),
            WakeOutcome::Lost(report) => self.lost(report),
            WakeOutcome::Failed(_) | WakeOutcome::Unheard | WakeOutcome::Late { .. } => {}
        }
    }

    /// δ has changed.
    pub fn plan(&mut self, update: &PlanUpdate) {
        let PlanUpdate { from, plan } = update;
        match plan {
            Plan::Bits { bits } => {
                self.words(b'p', [from.0, bits.len() as u64]);
                self.0.update(bits);
            }
            Plan::Periodic(cycles) => {
                self.words(b'P', [from.0, cycles.len() as u64]);
                for cycle in cycles {
                    let DutyCycle { t_on, t_drx, offset } = *cycle;
                    self.words(b'c', [t_on, t_drx, offset].map(u64::from));
                }
            }
        }
    }

    /// The fingerprint of a run with these ledgers, in the order of device ids, and totals.
    pub fn finish<'a>(mut self, ledgers: impl IntoIterator<Item = &'a Ledger>, totals: &Totals) -> Digest {
        for ledger in ledgers {
            let Ledger {
                whole,
                measured,
                longest_outage,
            } = ledger;
            self.sums(b'L', whole);
            self.sums(b'M', measured);
            self.words(b'O', [*longest_outage]);
        }
        let Totals {
            devices,
            ttis,
            events,
            // These follow from what the fingerprint has.
            missed: _,
            losses: _,
            gone_ttis: _,
            refining_ttis: _,
            delay_p95_ttis,
            control,
            uplink,
            energy,
            spread,
        } = totals;
        let EventTotals {
            events,
            misdetected,
            delay_ttis,
            reports,
            wake_ups,
            information_pico,
            wrong_activations,
            wasted,
        } = *events;
        self.words(
            b'T',
            [*devices, *ttis, events, misdetected, delay_ttis, *delay_p95_ttis],
        );
        let [low, high] = halves(information_pico);
        self.words(b't', [reports, wake_ups, low, high, wrong_activations, wasted.micro()]);
        // How many messages there were, not how long they are: that is a matter of the encoding.
        self.words(b'C', [control.messages, uplink.messages]);
        self.sums(b'S', energy);
        let Spread {
            spent_squares,
            worst_low_ttis,
        } = *spread;
        let [low, high] = halves(spent_squares);
        self.words(b'J', [low, high, worst_low_ttis]);
        Digest(self.0.finalize().into())
    }

    fn sums(&mut self, tag: u8, sums: &DeviceTotals) {
        let DeviceTotals {
            initial,
            harvested,
            spent: Spent { sensing, sleep, report },
            overflow,
            battery,
            battery_sum,
            low_ttis,
            sensing_ttis,
            failed_ttis,
            dark_ttis,
            false_wakes,
        } = *sums;
        let energies = [initial, harvested, sensing, sleep, report, overflow, battery];
        self.words(tag, energies.map(Energy::micro));
        let [low, high] = halves(battery_sum);
        self.words(b'l', [low, high, low_ttis, sensing_ttis, failed_ttis, dark_ttis]);
        // Where there are none, the fingerprint is what it was before they could be.
        if false_wakes > 0 {
            self.words(b'f', [false_wakes]);
        }
    }

    fn words<const N: usize>(&mut self, tag: u8, words: [u64; N]) {
        self.0.update([tag]);
        for word in words {
            self.0.update(word.to_le_bytes());
        }
    }
}

const fn halves(wide: u128) -> [u64; 2] {
    [wide as u64, (wide >> 64) as u64]
}
