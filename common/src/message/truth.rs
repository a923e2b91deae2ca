//! The truth plane, only for observers: the modelled world, and the beliefs of the base station. Its messages never
//! cross the bus as such; `bs/src/observer/` builds them. Fields and variants are encoded by position: a change raises
//! `WIRE_VERSION`. Their names are part of recordings (`view/src/schemas.rs`), and the dashboard's page
//! (`deploy/src/dashboard/page/`) reads some. [`DeviceRemoval`] is also an entry of the input log, by the names of its
//! fields, and of the digest.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Concerns, FailedTransmission, Report, WakeOutcome};
use crate::digits::{count_noun, format_significant};
use crate::event::{ActiveEvent, EventRecord, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::state::{DeviceState, DeviceView};

/// TTIs that the devices have been granted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorldUpdate {
    /// The first TTI.
    pub first: Tti,
    /// The last TTI. Only in this TTI can devices have anything to report.
    pub last: Tti,
    /// The stimulus in `last`, if any device might react to it.
    pub stimulus: Option<Stimulus>,
    /// The last TTI of that stimulus.
    #[serde(rename = "until")]
    pub stimulus_last: Tti,
}

impl Concerns for WorldUpdate {}

impl fmt::Display for WorldUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            first, last, stimulus, ..
        } = self;
        if first == last {
            write!(f, "TTI {first}")?;
        } else {
            write!(f, "TTIs {first} to {last}")?;
        }
        stimulus.map_or(Ok(()), |stimulus| write!(f, ", {stimulus}"))
    }
}

/// An event starts or ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum EventUpdate {
    /// The event starts.
    Started(ActiveEvent),
    /// The event has ended, reported or not.
    Ended(EventRecord),
}

impl Concerns for EventUpdate {}

impl fmt::Display for EventUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Started(event) => {
                let ActiveEvent { stimulus, start, last } = event;
                write!(
                    f,
                    "{stimulus} starts in TTI {start} and lasts to TTI {last} unless it is reported"
                )
            }
            Self::Ended(record) => {
                write!(f, "event {} has ended, ", record.event.0)?;
                match record.delay() {
                    Some(delay) => write!(f, "reported after {}", count_noun(delay, "TTI"))?,
                    None => f.write_str("missed")?,
                }
                if let Some(cause) = record.miss_cause {
                    write!(f, " ({})", cause.explanation())?;
                }
                let tally = record.tally;
                write!(
                    f,
                    ": I {}, {}, {}",
                    format_significant(tally.information(), 4),
                    count_noun(tally.reports, "report"),
                    count_noun(tally.wake_ups, "wake-up")
                )?;
                match tally.wrong_activations {
                    0 => Ok(()),
                    wrong => write!(f, ", {}", count_noun(wrong, "wrong activation")),
                }
            }
        }
    }
}

/// A device with δ = 1 detected the event and could not transmit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedReport {
    /// The failed transmission, with the energy that is now lost.
    pub failure: FailedTransmission,
}

impl Concerns for FailedReport {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.failure.device == device
    }
}

impl fmt::Display for FailedReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lost_energy = format_significant(self.failure.drained_energy.units(), 4);
        write!(
            f,
            "detected the event but could not pay for a report; {lost_energy} units lost"
        )
    }
}

/// A device with δ = 1 reported the event, and the report was lost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LostReport {
    /// The lost report.
    pub report: Report,
}

impl Concerns for LostReport {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.report.device == device
    }
}

impl fmt::Display for LostReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "reported, but the report was lost: {}", self.report)
    }
}

/// The outcome of the last wake-up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WakeUpResult {
    /// The outcome.
    pub outcome: WakeOutcome,
}

impl Concerns for WakeUpResult {
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        number == Some(device.0)
    }
}

impl fmt::Display for WakeUpResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.outcome.fmt(f)
    }
}

/// The states of the devices at the end of a TTI, in the order of ids.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceStates {
    /// State and battery of each device.
    pub views: Vec<DeviceView>,
}

impl Concerns for DeviceStates {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        device.index() < self.views.len()
    }
}

impl fmt::Display for DeviceStates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = |has_state: fn(DeviceState) -> bool| self.views.iter().filter(|view| has_state(view.state)).count();
        let idle = count(|state| state == DeviceState::Idle);
        let reported = count(|state| state == DeviceState::Transmission);
        let asleep = count(|state| state == DeviceState::Sleep { powered: true });
        let unpowered = count(|state| state == DeviceState::Sleep { powered: false });
        write!(
            f,
            "{idle} sense, {reported} have reported, {asleep} sleep, {unpowered} are unpowered"
        )
    }
}

/// Devices with consecutive ids that are removed for the rest of the run: their process was lost, and the run
/// continues without them.
///
/// In TTI [`Self::tti`] they still harvest and pay for δ, which is the last entry in their ledgers. A removal does not
/// follow from scenario and seed: it is an external input of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceRemoval {
    /// The first device.
    pub first: DeviceId,
    /// Number of devices, ≥ 1.
    pub count: u32,
    /// The TTI in which they were removed.
    pub tti: Tti,
    /// Number of wake-ups of that TTI with an outcome before the removal. `None`: removed before sensing in the TTI.
    pub wake_ups: Option<u32>,
}

impl DeviceRemoval {
    /// Returns the last device.
    pub const fn last(&self) -> DeviceId {
        // A removal in a recording or a log can hold any numbers, and showing it must not panic.
        DeviceId(self.first.0.saturating_add(self.count.saturating_sub(1)))
    }

    /// Returns the removals of `devices`, in ascending order, in TTI `tti` after `wake_ups` wake-ups: one removal for
    /// each range of consecutive ids.
    pub fn from_devices(devices: impl IntoIterator<Item = DeviceId>, tti: Tti, wake_ups: Option<u32>) -> Vec<Self> {
        let mut removals: Vec<Self> = Vec::new();
        for device in devices {
            match removals.last_mut() {
                Some(removal) if removal.last().0 + 1 == device.0 => removal.count += 1,
                Some(_) | None => removals.push(Self {
                    first: device,
                    count: 1,
                    tti,
                    wake_ups,
                }),
            }
        }
        removals
    }

    /// Whether `device` is removed by it.
    pub const fn contains(&self, device: DeviceId) -> bool {
        // Compares offsets, because first + count can overflow in a removal that was not validated.
        self.first.0 <= device.0 && device.0 - self.first.0 < self.count
    }

    /// Whether it removes at least one device, all among the first `device_count`.
    pub fn is_valid(&self, device_count: u32) -> bool {
        let end = self.first.0.checked_add(self.count);
        self.count > 0 && end.is_some_and(|end| end <= device_count)
    }
}

impl Concerns for DeviceRemoval {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.contains(device)
    }
}

impl fmt::Display for DeviceRemoval {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first, count, .. } = self;
        if *count == 1 {
            write!(f, "device {first} is removed")
        } else {
            write!(f, "devices {first} to {} are removed", self.last())
        }
    }
}

/// The BS's belief about the epicentre after the reports and wake-ups of a TTI.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BeliefUpdate {
    /// The possible positions of the epicentre, at least one.
    pub places: Vec<WeightedPoint>,
}

/// A possible position of an event. Single precision is enough, because it is only displayed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WeightedPoint {
    /// Metres from the left edge of the area.
    pub x: f32,
    /// Metres from the lower edge of the area.
    pub y: f32,
    /// The probability of this position, `[0, 1]`; the probabilities of all positions add up to 1.
    pub share: f32,
}

impl Concerns for BeliefUpdate {}

impl fmt::Display for BeliefUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A recording can hold any bits as a share, NaN included, so a total order is needed.
        let best = self.places.iter().max_by(|a, b| a.share.total_cmp(&b.share));
        match best {
            Some(WeightedPoint { x, y, .. }) if self.places.len() == 1 => {
                write!(f, "the event is at ({x:.2}, {y:.2}) m")
            }
            Some(WeightedPoint { x, y, share }) => {
                let (places, percent) = (self.places.len(), share * 100.0);
                write!(
                    f,
                    "the event is at one of {places} places, most likely ({x:.2}, {y:.2}) m, {percent:.0} %"
                )
            }
            None => f.write_str("the event may be anywhere"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_devices_form_one_removal() {
        let removed_ranges = |devices: &[u32]| -> Vec<(u32, u32)> {
            let removals = DeviceRemoval::from_devices(devices.iter().copied().map(DeviceId), Tti(4), Some(2));
            assert!(
                removals
                    .iter()
                    .all(|removal| (removal.tti, removal.wake_ups) == (Tti(4), Some(2)))
            );
            removals
                .iter()
                .map(|removal| (removal.first.0, removal.last().0))
                .collect()
        };
        assert_eq!(removed_ranges(&[]), []);
        assert_eq!(removed_ranges(&[0, 1, 2]), [(0, 2)]);
        assert_eq!(removed_ranges(&[3, 5, 6, 9]), [(3, 3), (5, 6), (9, 9)]);
    }

    #[test]
    fn an_impossible_removal_is_invalid_and_can_be_shown() {
        for (first, count) in [(0, 0), (u32::MAX, u32::MAX), (7, 0)] {
            let removal = DeviceRemoval {
                first: DeviceId(first),
                count,
                tti: Tti(1),
                wake_ups: None,
            };
            assert!(
                !removal.is_valid(u32::MAX) && removal.to_string().contains("removed"),
                "{removal}"
            );
        }
    }
}
