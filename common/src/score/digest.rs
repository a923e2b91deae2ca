//! The digest of a run, by which runs are compared: replay, audit, resumption and the recorded digests in
//! `tests/digests/`.
//!
//! SHA-256 over the run's history, in the order of TTIs: events, reports, wake-ups and their outcomes, changes of the δ
//! plan, removals and actions of operators. Each device's ledger by id and the totals behind the metrics follow. The
//! digest holds no data per TTI, so that a driver may skip quiet TTIs. It does not depend on the encoding of messages:
//! every field is hashed as 64 bits, except the bits of a plan. Each kind of record has a tag, which no other kind may
//! have. A change of the hashed data, the order or a tag raises [`DIGEST_VERSION`], and
//! `tests/digests/check.py --record` renews the recorded digests. `docs/design.md` lists the hashed data.

use std::fmt;

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::event::Stimulus;
use crate::ids::{DeviceId, Tti};
use crate::message::{Change, DeviceRange, DeviceRemoval, OperatorAction, PlanUpdate, Report, Setting, WakeOutcome};
use crate::plan::{DutyCycle, Plan};
use crate::totals::{DeviceTotals, EnergyByState, EventTally, EventTotals, Ledger, Spread, Totals};
use crate::units::Energy;

/// The version of the hashed data. Digests of different versions cannot be compared.
pub const DIGEST_VERSION: u32 = 2;

/// The digest of a finished run, shown as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Digest([u8; 32]);

impl Digest {
    /// Returns the SHA-256 hash.
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

/// The digest of an unfinished run.
#[derive(Clone, Debug, Default)]
pub struct DigestBuilder(Sha256);

impl DigestBuilder {
    /// Adds the start of an event in `tti`.
    pub fn add_event_start(&mut self, tti: Tti, stimulus: &Stimulus) {
        self.hash_words(
            b'E',
            [
                tti.0,
                stimulus.event.0,
                stimulus.epicentre.x.to_bits(),
                stimulus.epicentre.y.to_bits(),
            ],
        );
    }

    /// Adds the end of an event, with its last TTI `tti`.
    pub fn add_event_end(&mut self, tti: Tti, tally: &EventTally) {
        let EventTally {
            reports,
            wake_ups,
            information_pico,
            wrong_activations,
            wasted_energy,
        } = *tally;
        self.hash_words(
            b'e',
            [
                tti.0,
                reports,
                wake_ups,
                information_pico,
                wrong_activations,
                wasted_energy.micro(),
            ],
        );
    }

    /// Adds a report that reached the BS.
    pub fn add_report(&mut self, report: &Report) {
        self.hash_report(b'R', report);
    }

    /// Adds a lost report.
    pub fn add_lost_report(&mut self, report: &Report) {
        self.hash_report(b'X', report);
    }

    fn hash_report(&mut self, tag: u8, report: &Report) {
        let Report {
            device,
            tti,
            information,
            battery,
        } = *report;
        self.hash_words(
            tag,
            [tti.0, u64::from(device.0), information.to_bits(), battery.micro()],
        );
    }

    /// Adds the removal of devices.
    pub fn add_removal(&mut self, removal: &DeviceRemoval) {
        let DeviceRemoval {
            first,
            count,
            tti,
            wake_ups,
        } = *removal;
        // Shifted by 1, so that `None` and `Some(0)` differ.
        let wake_ups = wake_ups.map_or(0, |before| 1 + u64::from(before));
        self.hash_words(b'G', [tti.0, u64::from(first.0), u64::from(count), wake_ups]);
    }

    /// Adds an action: a record for each device, so that the split into ranges does not matter.
    pub fn add_action(&mut self, action: &OperatorAction) {
        let OperatorAction { tti, change } = *action;
        let (kind, amount) = match change {
            Change::Fail(_) => (0, 0),
            Change::Revive(_) => (1, 0),
            Change::AddEnergy(_, energy) => (2, energy.micro()),
            Change::Set(setting, value) => {
                let setting = match setting {
                    Setting::EventRate => 0,
                    Setting::Price => 1,
                };
                self.hash_words(b'A', [tti.0, 3, setting, value.to_bits()]);
                return;
            }
        };
        for device in change.devices().into_iter().flat_map(DeviceRange::devices) {
            self.hash_words(b'A', [tti.0, kind, u64::from(device.0), amount]);
        }
    }

    /// Adds a wake-up sent to `device` in `tti`, with its outcome and its report.
    pub fn add_wake_up(&mut self, tti: Tti, device: DeviceId, outcome: &WakeOutcome) {
        let (kind, energy) = match outcome {
            WakeOutcome::Reported(_) => (0, Energy::ZERO),
            WakeOutcome::Failed(failure) => (1, failure.drained_energy),
            WakeOutcome::Missed => (2, Energy::ZERO),
            WakeOutcome::Lost(_) => (3, Energy::ZERO),
            WakeOutcome::Late { spent, .. } => (4, *spent),
        };
        self.hash_words(b'W', [tti.0, u64::from(device.0), kind, energy.micro()]);
        match outcome {
            WakeOutcome::Reported(report) => self.add_report(report),
            WakeOutcome::Lost(report) => self.add_lost_report(report),
            WakeOutcome::Failed(_) | WakeOutcome::Missed | WakeOutcome::Late { .. } => {}
        }
    }

    /// Adds a change of δ.
    pub fn add_plan(&mut self, update: &PlanUpdate) {
        let PlanUpdate { from, plan } = update;
        match plan {
            Plan::Bits { bits } => {
                // The length comes first, because bits could otherwise be mistaken for the records after them.
                self.hash_words(b'p', [from.0, bits.len() as u64]);
                self.0.update(bits);
            }
            Plan::Periodic(cycles) => {
                self.hash_words(b'P', [from.0, cycles.len() as u64]);
                for cycle in cycles {
                    let DutyCycle { t_on, t_drx, offset } = *cycle;
                    self.hash_words(b'c', [t_on, t_drx, offset].map(u64::from));
                }
            }
        }
    }

    /// Returns the digest of a run with these totals and ledgers, the latter in the order of device ids.
    pub fn finish<'a>(mut self, ledgers: impl IntoIterator<Item = &'a Ledger>, totals: &Totals) -> Digest {
        for ledger in ledgers {
            let Ledger {
                whole,
                measured,
                longest_outage,
            } = ledger;
            self.hash_totals(b'L', whole);
            self.hash_totals(b'M', measured);
            self.hash_words(b'O', [*longest_outage]);
        }
        let Totals {
            devices,
            ttis,
            events,
            // These follow from the records and ledgers that are hashed above.
            missed: _,
            losses: _,
            removed_ttis: _,
            wake_up_span_ttis: _,
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
            wasted_energy,
        } = *events;
        self.hash_words(
            b'T',
            [*devices, *ttis, events, misdetected, delay_ttis, *delay_p95_ttis],
        );
        let [low, high] = low_and_high(information_pico);
        self.hash_words(
            b't',
            [reports, wake_ups, low, high, wrong_activations, wasted_energy.micro()],
        );
        // Numbers of messages, not bytes: the digest does not depend on the encoding.
        self.hash_words(b'C', [control.messages, uplink.messages]);
        self.hash_totals(b'S', energy);
        let Spread {
            spent_squares,
            worst_low_ttis,
        } = *spread;
        let [low, high] = low_and_high(spent_squares);
        self.hash_words(b'J', [low, high, worst_low_ttis]);
        Digest(self.0.finalize().into())
    }

    fn hash_totals(&mut self, tag: u8, sums: &DeviceTotals) {
        let DeviceTotals {
            initial,
            harvested,
            spent: EnergyByState { sensing, sleep, report },
            overflow,
            battery,
            battery_sum,
            low_ttis,
            sensing_ttis,
            failed_ttis,
            unpowered_ttis,
            false_wake_ups,
        } = *sums;
        let energies = [initial, harvested, sensing, sleep, report, overflow, battery];
        self.hash_words(tag, energies.map(Energy::micro));
        let [low, high] = low_and_high(battery_sum);
        self.hash_words(b'l', [low, high, low_ttis, sensing_ttis, failed_ttis, unpowered_ttis]);
        // Omitted at 0, so that runs without false wake-ups keep the digests of versions without them.
        if false_wake_ups > 0 {
            self.hash_words(b'f', [false_wake_ups]);
        }
    }

    /// Hashes the one-byte tag of a record, then each number in 8 little-endian bytes.
    fn hash_words<const N: usize>(&mut self, tag: u8, words: [u64; N]) {
        self.0.update([tag]);
        for word in words {
            self.0.update(word.to_le_bytes());
        }
    }
}

const fn low_and_high(wide: u128) -> [u64; 2] {
    [wide as u64, (wide >> 64) as u64]
}
