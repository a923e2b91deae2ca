//! Truth: devices that are gone.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::{DeviceId, Tti};

/// Devices, numbered one after another, that are gone from some TTI on for the rest of the run: their process was lost,
/// and the run goes on without them.
///
/// In TTI [`Self::tti`] they harvest and pay for δ once more, which is the last that is in their books. It does not
/// follow from scenario and seed: where a run has outages they are as much an input as those two.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// The first device.
    pub first: DeviceId,
    /// How many they are, ≥ 1.
    pub count: u32,
    /// The TTI in which they went.
    pub tti: Tti,
    /// Wake-ups of that TTI that had come to something before. `None`: they went before they could sense in it.
    pub wake_ups: Option<u32>,
}

impl Outage {
    /// The last device.
    pub const fn last(&self) -> DeviceId {
        DeviceId(self.first.0.saturating_add(self.count.saturating_sub(1)))
    }

    /// What it is that `devices`, by rising number, go in TTI `tti` after so many wake-ups: an outage for all that
    /// follow one another.
    pub fn of(devices: impl IntoIterator<Item = DeviceId>, tti: Tti, wake_ups: Option<u32>) -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        for device in devices {
            match all.last_mut() {
                Some(last) if last.last().0 + 1 == device.0 => last.count += 1,
                Some(_) | None => all.push(Self {
                    first: device,
                    count: 1,
                    tti,
                    wake_ups,
                }),
            }
        }
        all
    }

    /// Whether `device` is among them.
    pub const fn has(&self, device: DeviceId) -> bool {
        self.first.0 <= device.0 && device.0 - self.first.0 < self.count
    }

    /// Whether there are such devices among the first `devices`.
    pub fn is_sound(&self, devices: u32) -> bool {
        let end = self.first.0.checked_add(self.count);
        self.count > 0 && end.is_some_and(|end| end <= devices)
    }
}

impl Concerns for Outage {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.has(device)
    }
}

impl fmt::Display for Outage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first, count, .. } = self;
        if *count == 1 {
            write!(f, "device {first} is gone for good")
        } else {
            write!(f, "devices {first} to {} are gone for good", self.last())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_that_follow_one_another_go_together() {
        let went = |devices: &[u32]| -> Vec<(u32, u32)> {
            let outages = Outage::of(devices.iter().copied().map(DeviceId), Tti(4), Some(2));
            assert!(
                outages
                    .iter()
                    .all(|outage| (outage.tti, outage.wake_ups) == (Tti(4), Some(2)))
            );
            outages.iter().map(|outage| (outage.first.0, outage.last().0)).collect()
        };
        assert_eq!(went(&[]), []);
        assert_eq!(went(&[0, 1, 2]), [(0, 2)]);
        assert_eq!(went(&[3, 5, 6, 9]), [(3, 3), (5, 6), (9, 9)]);
    }

    #[test]
    fn one_that_cannot_be_is_told_in_words() {
        for (first, count) in [(0, 0), (u32::MAX, u32::MAX), (7, 0)] {
            let outage = Outage {
                first: DeviceId(first),
                count,
                tti: Tti(1),
                wake_ups: None,
            };
            assert!(
                !outage.is_sound(u32::MAX) && outage.to_string().contains("gone for good"),
                "{outage}"
            );
        }
    }
}
