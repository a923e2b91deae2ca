//! Actions of an operator on a run: devices fail, are revived or receive energy, and settings change. An action is an
//! external input of the run and an entry of the input log. Base stations send it to hosts ([`ClockMessage`]), and
//! observers receive a copy. Fields and variants are encoded by position: a change raises `WIRE_VERSION`. Their names
//! are part of recordings and JSON lines (`view/src/schemas.rs`). A new variant also needs a form in the input log
//! (`lab/src/external_inputs/mod.rs`), in scripts (`lab/src/action_script/`) and in the digest (`score/digest.rs`), and
//! a check in `bs/src/actions.rs`.
//!
//! [`ClockMessage`]: super::ClockMessage

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;
use crate::ids::{DeviceId, Tti};
use crate::units::Energy;

/// Devices with consecutive ids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceRange {
    /// The first device.
    pub first: DeviceId,
    /// Number of devices, ≥ 1.
    pub count: u32,
}

impl DeviceRange {
    /// All devices of a run, whatever their number: only in scripts and in requests of operators, until
    /// [`Change::with_all_resolved`].
    pub const ALL: Self = Self {
        first: DeviceId(0),
        count: u32::MAX,
    };

    /// The devices, in the order of ids.
    pub fn devices(self) -> impl Iterator<Item = DeviceId> {
        (self.first.0..self.first.0.saturating_add(self.count)).map(DeviceId)
    }

    /// Whether it holds at least one device, all among the first `device_count`. [`Self::ALL`] is never valid.
    pub fn is_valid(self, device_count: u32) -> bool {
        let end = self.first.0.checked_add(self.count);
        self.count > 0 && end.is_some_and(|end| end <= device_count)
    }

    /// Whether `device` is one of the devices.
    pub const fn contains(self, device: DeviceId) -> bool {
        // Compares offsets, because first + count can overflow in a range that was not validated.
        self.first.0 <= device.0 && device.0 - self.first.0 < self.count
    }
}

impl fmt::Display for DeviceRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first, count } = *self;
        match count {
            u32::MAX => f.write_str("all devices"),
            1 => write!(f, "device {first}"),
            _ => write!(
                f,
                "devices {first} to {}",
                first.0.saturating_add(count.saturating_sub(1))
            ),
        }
    }
}

/// A setting that an operator can change during a run. `bs/src/actions.rs` checks its range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Setting {
    /// Probability α that an event starts in a TTI without an active event, `(0, 1]`. The base station keeps the α of
    /// the scenario.
    EventRate,
    /// Price θ of the policy `age-index`, in reaches, ≥ 0.
    Price,
}

impl Setting {
    /// Every setting.
    pub const ALL: [Self; 2] = [Self::EventRate, Self::Price];

    /// The scenario field with the value at the start of the run.
    pub const fn field(self) -> &'static str {
        match self {
            Self::EventRate => "events.alpha",
            Self::Price => "policy.age-index.price",
        }
    }

    /// Returns the setting of this scenario field.
    pub fn from_field(field: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|setting| setting.field() == field)
    }
}

/// The change that an action makes at the start of a TTI, before the plan, the harvest and sensing of that TTI.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Change {
    /// The electronics of these devices are off: they do not sense, receive wake-ups or pay for δ. Their batteries
    /// still receive the harvest.
    Fail(DeviceRange),
    /// The electronics of these devices are on again. The devices follow the current plan.
    Revive(DeviceRange),
    /// The battery of each device receives this energy. It counts as harvest, and as overflow above E_max.
    AddEnergy(DeviceRange, Energy),
    /// The setting has this value.
    Set(Setting, f64),
}

impl Change {
    /// The devices that the change concerns; `None` for a setting.
    pub const fn devices(&self) -> Option<DeviceRange> {
        match *self {
            Self::Fail(devices) | Self::Revive(devices) | Self::AddEnergy(devices, _) => Some(devices),
            Self::Set(..) => None,
        }
    }

    /// Returns the change with [`DeviceRange::ALL`] replaced by the `device_count` devices of a run.
    #[must_use]
    pub fn with_all_resolved(self, device_count: u32) -> Self {
        if self.devices() == Some(DeviceRange::ALL) {
            self.with_devices(DeviceRange {
                first: DeviceId(0),
                count: device_count,
            })
        } else {
            self
        }
    }

    /// Returns the same change of other `devices`; a setting is unchanged.
    #[must_use]
    pub const fn with_devices(self, devices: DeviceRange) -> Self {
        match self {
            Self::Fail(_) => Self::Fail(devices),
            Self::Revive(_) => Self::Revive(devices),
            Self::AddEnergy(_, energy) => Self::AddEnergy(devices, energy),
            Self::Set(..) => self,
        }
    }
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let is_one = self.devices().is_none_or(|devices| devices.count == 1);
        match self {
            Self::Fail(devices) => write!(f, "{devices} {}", if is_one { "fails" } else { "fail" }),
            Self::Revive(devices) => write!(f, "{devices} {} revived", if is_one { "is" } else { "are" }),
            Self::AddEnergy(devices, energy) => {
                write!(f, "{devices} {} {energy}", if is_one { "receives" } else { "receive" })?;
                f.write_str(if is_one { "" } else { " each" })
            }
            Self::Set(setting, value) => write!(f, "{} is set to {value}", setting.field()),
        }
    }
}

/// A change at the start of a TTI.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OperatorAction {
    /// The TTI.
    pub tti: Tti,
    /// The change.
    pub change: Change,
}

impl Concerns for OperatorAction {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        self.change.devices().is_some_and(|devices| devices.contains(device))
    }
}

impl fmt::Display for OperatorAction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.change.fmt(f)
    }
}

/// Emulation, operator → BS, a query: changes to make in a running run. The reply is the TTI at whose start they take
/// effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActRequest {
    /// The TTI; `None` for the first TTI that is not granted yet.
    pub at: Option<Tti>,
    /// The changes, in this order.
    pub changes: Vec<Change>,
}

impl Concerns for ActRequest {
    fn concerns(&self, _number: Option<u32>, device: DeviceId) -> bool {
        let mut ranges = self.changes.iter().filter_map(Change::devices);
        ranges.any(|devices| devices.contains(device))
    }
}

impl fmt::Display for ActRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (nth, change) in self.changes.iter().enumerate() {
            write!(f, "{}{change}", if nth == 0 { "" } else { ", " })?;
        }
        self.at.map_or(Ok(()), |tti| write!(f, " in TTI {tti}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_shown_with_their_devices() {
        let devices = |first, count| DeviceRange {
            first: DeviceId(first),
            count,
        };
        let energy = Energy::from_micro(2_500_000);
        let shown = [
            (Change::Fail(devices(7, 1)), "device 7 fails"),
            (Change::Fail(devices(7, 3)), "devices 7 to 9 fail"),
            (Change::Revive(devices(0, 1)), "device 0 is revived"),
            (Change::AddEnergy(devices(3, 1), energy), "device 3 receives 2.5 units"),
            (
                Change::AddEnergy(devices(3, 2), energy),
                "devices 3 to 4 receive 2.5 units each",
            ),
            (Change::Revive(DeviceRange::ALL), "all devices are revived"),
            (Change::Set(Setting::EventRate, 0.05), "events.alpha is set to 0.05"),
        ];
        for (change, text) in shown {
            assert_eq!(change.to_string(), text);
        }
        for setting in Setting::ALL {
            assert_eq!(Setting::from_field(setting.field()), Some(setting));
        }
    }

    #[test]
    fn a_range_outside_the_run_is_invalid_and_can_be_shown() {
        for (first, count) in [(0, 0), (u32::MAX, 2), (9, 2), (10, 1)] {
            let range = DeviceRange {
                first: DeviceId(first),
                count,
            };
            assert!(!range.is_valid(10) && !range.to_string().is_empty(), "{range:?}");
        }
    }
}
