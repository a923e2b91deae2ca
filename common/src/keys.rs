//! The key expressions of a run, one place for all of them.
//!
//! | key | what | direction |
//! |---|---|---|
//! | `reveille/{run}/air/plan` | [`PlanUpdate`](crate::message::PlanUpdate) | BS → all |
//! | `reveille/{run}/air/wake/{device}` | [`WakeUp`](crate::message::WakeUp) | BS → one device |
//! | `reveille/{run}/air/report/{device}` | [`Report`](crate::message::Report) | device → BS |
//! | `reveille/{run}/emu/clock` | [`Clock`](crate::message::Clock) | BS → all |
//! | `reveille/{run}/emu/answer/{host}` | [`Answer`](crate::message::Answer) | host → BS |
//! | `reveille/{run}/emu/join`, `…/ready`, `…/control` | queries | host or operator → BS |
//! | `reveille/{run}/emu/alive/{bs or host}` | liveliness tokens | |
//! | `reveille/{run}/tap` | [`TapBatch`](crate::message::TapBatch) | BS → observers |

use std::fmt;
use std::str::FromStr;

use crate::ids::{DeviceId, HostId};

/// A run's name on the bus: 1 to 64 letters, digits, `-` and `_`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunName(String);

/// A text that is not a run name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("run name {0:?}: must be 1 to 64 letters, digits, '-' or '_'")]
pub struct RunNameError(String);

impl FromStr for RunName {
    type Err = RunNameError;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        let fits =
            (1..=64).contains(&s.len()) && s.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if fits {
            Ok(Self(s.to_owned()))
        } else {
            Err(RunNameError(s.to_owned()))
        }
    }
}

impl fmt::Display for RunName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The two planes on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Plane {
    /// What a real deployment would send over the radio.
    Air,
    /// What only the emulation needs.
    Emu,
}

/// The kinds of message, each with a key of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// δ, air.
    Plan,
    /// A wake-up to one device, air.
    Wake,
    /// A report, air.
    Report,
    /// The virtual clock, emulation.
    Clock,
    /// A host's answer to the clock, emulation.
    Answer,
    /// A host asks for places, emulation.
    Join,
    /// A host is ready, emulation.
    Ready,
    /// A command to the virtual clock, emulation.
    Control,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Self; 8] = [
        Self::Plan,
        Self::Wake,
        Self::Report,
        Self::Clock,
        Self::Answer,
        Self::Join,
        Self::Ready,
        Self::Control,
    ];

    /// The name of the kind in keys and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Wake => "wake",
            Self::Report => "report",
            Self::Clock => "clock",
            Self::Answer => "answer",
            Self::Join => "join",
            Self::Ready => "ready",
            Self::Control => "control",
        }
    }

    /// The plane it travels on.
    pub const fn plane(self) -> Plane {
        match self {
            Self::Plan | Self::Wake | Self::Report => Plane::Air,
            Self::Clock | Self::Answer | Self::Join | Self::Ready | Self::Control => Plane::Emu,
        }
    }
}

impl Plane {
    /// The name of the plane in keys and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Air => "air",
            Self::Emu => "emu",
        }
    }
}

/// The keys of one run.
#[derive(Clone, Debug)]
pub struct Keys {
    run: RunName,
}

impl Keys {
    /// The keys of `run`.
    pub const fn new(run: RunName) -> Self {
        Self { run }
    }

    /// The run.
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// The key of a kind that has only one.
    pub fn of(&self, kind: Kind) -> String {
        format!("reveille/{}/{}/{}", self.run, kind.plane().name(), kind.name())
    }

    /// All keys of a kind that has one per device or host.
    pub fn all(&self, kind: Kind) -> String {
        format!("{}/*", self.of(kind))
    }

    /// One device's wake-up radio.
    pub fn wake(&self, device: DeviceId) -> String {
        format!("{}/{device}", self.of(Kind::Wake))
    }

    /// One device's reports.
    pub fn report(&self, device: DeviceId) -> String {
        format!("{}/{device}", self.of(Kind::Report))
    }

    /// One host's answers.
    pub fn answer(&self, host: HostId) -> String {
        format!("{}/{host}", self.of(Kind::Answer))
    }

    /// The liveliness token of a host.
    pub fn alive(&self, host: HostId) -> String {
        format!("reveille/{}/emu/alive/{host}", self.run)
    }

    /// The liveliness tokens of all hosts.
    pub fn all_alive(&self) -> String {
        format!("reveille/{}/emu/alive/*", self.run)
    }

    /// The liveliness token of the BS.
    pub fn bs_alive(&self) -> String {
        format!("reveille/{}/emu/bs", self.run)
    }

    /// The liveliness tokens of the BSs of all runs.
    pub fn any_bs() -> &'static str {
        "reveille/*/emu/bs"
    }

    /// The copies of all traffic for observers.
    pub fn tap(&self) -> String {
        format!("reveille/{}/tap", self.run)
    }
}

/// The number at the end of a key, such as a device's or a host's.
pub fn last_number(key: &str) -> Option<u32> {
    key.rsplit('/').next()?.parse().ok()
}

/// The kind of message that `key` carries, and the number at its end if it has one.
pub fn classify(key: &str) -> Option<(Kind, Option<u32>)> {
    let mut parts = key.split('/').skip(2);
    let (plane, name) = (parts.next()?, parts.next()?);
    let kind = Kind::ALL
        .into_iter()
        .find(|k| k.plane().name() == plane && k.name() == name)?;
    Some((kind, parts.next().and_then(|n| n.parse().ok())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_names_cannot_break_out_of_their_key() {
        for bad in ["", "a/b", "*", "a b", "é", &"x".repeat(65), "a$"] {
            assert!(bad.parse::<RunName>().is_err(), "{bad:?}");
        }
        assert!("Run-7_b".parse::<RunName>().is_ok());
    }

    #[test]
    fn keys_are_classified() {
        let keys = Keys::new("r1".parse().expect("valid"));
        assert_eq!(classify(&keys.wake(DeviceId(17))), Some((Kind::Wake, Some(17))));
        assert_eq!(classify(&keys.of(Kind::Clock)), Some((Kind::Clock, None)));
        assert_eq!(classify("reveille/r1/air/clock"), None);
        assert_eq!(classify("reveille"), None);
        assert_eq!(last_number(&keys.alive(HostId(3))), Some(3));
    }
}
