//! The run's fingerprint.
//!
//! SHA-256 over what happened, in the order of TTIs: events, reports, wake-ups and their outcomes, changes of the δ
//! plan; then each device's ledger by id and the totals behind the metrics. It holds nothing per TTI, so that a driver
//! may skip over quiet TTIs.

use std::fmt;

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::event::Stimulus;
use crate::ids::{DeviceId, Tti};
use crate::message::{PlanUpdate, Report, WakeOutcome};
use crate::totals::{DeviceTotals, EventTally, Totals};
use crate::units::Energy;

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
        let Report {
            device,
            tti,
            information,
            battery,
        } = *report;
        self.words(
            b'R',
            [tti.0, u64::from(device.0), information.to_bits(), battery.micro()],
        );
    }

    /// `device` was sent a wake-up in `tti`.
    pub fn wake_up(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome) {
        let (kind, drained) = match outcome {
            WakeOutcome::Reported(_) => (0, Energy::ZERO),
            WakeOutcome::Failed(failure) => (1, failure.drained),
            WakeOutcome::Unheard => (2, Energy::ZERO),
        };
        self.words(b'W', [tti.0, u64::from(device.0), kind, drained.micro()]);
        if let WakeOutcome::Reported(report) = outcome {
            self.report(report);
        }
    }

    /// δ has changed.
    pub fn plan(&mut self, update: &PlanUpdate) {
        let payload = crate::codec::encode(update);
        self.words(b'P', [payload.len() as u64]);
        self.0.update(&payload);
    }

    /// The fingerprint of a run with these ledgers, in the order of device ids, and totals.
    pub fn finish<'a>(mut self, ledgers: impl IntoIterator<Item = &'a DeviceTotals>, totals: &Totals) -> Digest {
        for ledger in ledgers {
            self.ledger(b'L', ledger);
        }
        let Totals {
            devices,
            ttis,
            events,
            control,
            energy,
        } = totals;
        let information = events.information_pico;
        self.words(
            b'T',
            [
                *devices,
                *ttis,
                events.events,
                events.misdetected,
                events.reports,
                events.wake_ups,
            ],
        );
        self.words(
            b't',
            [
                information as u64,
                (information >> 64) as u64,
                events.wrong_activations,
                events.wasted.micro(),
            ],
        );
        self.words(b'C', [control.messages, control.bytes]);
        self.ledger(b'S', energy);
        Digest(self.0.finalize().into())
    }

    fn ledger(&mut self, tag: u8, ledger: &DeviceTotals) {
        let DeviceTotals {
            initial,
            harvested,
            spent,
            overflow,
            battery,
            battery_sum,
            low_ttis,
        } = *ledger;
        self.words(
            tag,
            [
                initial.micro(),
                harvested.micro(),
                spent.micro(),
                overflow.micro(),
                battery.micro(),
                battery_sum as u64,
                (battery_sum >> 64) as u64,
                low_ttis,
            ],
        );
    }

    fn words<const N: usize>(&mut self, tag: u8, words: [u64; N]) {
        self.0.update([tag]);
        for word in words {
            self.0.update(word.to_le_bytes());
        }
    }
}
