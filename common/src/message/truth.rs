//! Truth: what happens in the modelled world and nobody sends. Only observers are told.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Concerns, Failure, Report, WakeOutcome};
use crate::event::{ActiveEvent, EventRecord, Stimulus};
use crate::ids::{DeviceId, Tti};
use crate::state::{DeviceState, DeviceView};

/// TTIs that the devices go through.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct World {
    /// The first.
    pub first: Tti,
    /// The last. Only in this one can a device have anything to report.
    pub last: Tti,
    /// What the world shows in `last`, if any device might react to it.
    pub stimulus: Option<Stimulus>,
    /// The last TTI in which it would show that.
    pub until: Tti,
}

impl Concerns for World {}

impl fmt::Display for World {
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
pub enum EventNews {
    /// It starts.
    Started(ActiveEvent),
    /// It has ended, reported or not.
    Ended(EventRecord),
}

impl Concerns for EventNews {}

impl fmt::Display for EventNews {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Started(event) => {
                let ActiveEvent { stimulus, start, last } = event;
                write!(
                    f,
                    "{stimulus} starts in TTI {start}, to last to TTI {last} unless it is reported"
                )
            }
            Self::Ended(record) => {
                write!(f, "event {} has ended, ", record.event.0)?;
                match record.delay() {
                    Some(delay) => write!(f, "reported after {delay} TTIs")?,
                    None => f.write_str("missed")?,
                }
                let tally = record.tally;
                let information = tally.information();
                write!(
                    f,
                    ": I {information:.4}, {} reports, {} wake-ups",
                    tally.reports, tally.wake_ups
                )?;
                match tally.wrong_activations {
                    0 => Ok(()),
                    wrong => write!(f, ", {wrong} wrong activations"),
                }
            }
        }
    }
}

/// A device with δ = 1 has detected the event and could not transmit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedReport {
    /// What was left in the device's battery and is now lost.
    pub failure: Failure,
}

impl Concerns for FailedReport {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.failure.device == device
    }
}

impl fmt::Display for FailedReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lost = self.failure.drained.units();
        write!(
            f,
            "has detected the event and cannot pay for a report; {lost:.2} are lost"
        )
    }
}

/// A device with δ = 1 has reported the event, and the report was lost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LostReport {
    /// What it has sent.
    pub report: Report,
}

impl Concerns for LostReport {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.report.device == device
    }
}

impl fmt::Display for LostReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "has reported, and that was lost: {}", self.report)
    }
}

/// What came of the last wake-up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Woken {
    /// What came of it.
    pub outcome: WakeOutcome,
}

impl Concerns for Woken {
    fn concerns(&self, number: Option<u32>, device: DeviceId) -> bool {
        number == Some(device.0)
    }
}

impl fmt::Display for Woken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.outcome.fmt(f)
    }
}

/// The devices at the end of a TTI, in the order of ids.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct States {
    /// State and battery of each.
    pub views: Vec<DeviceView>,
}

impl Concerns for States {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        device.index() < self.views.len()
    }
}

impl fmt::Display for States {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = |is: fn(DeviceState) -> bool| self.views.iter().filter(|view| is(view.state)).count();
        let idle = count(|state| state == DeviceState::Idle);
        let sent = count(|state| state == DeviceState::Transmission);
        let asleep = count(|state| state == DeviceState::Sleep { powered: true });
        let deaf = count(|state| state == DeviceState::Sleep { powered: false });
        write!(f, "{idle} sense, {sent} have reported, {asleep} sleep, {deaf} are deaf")
    }
}
