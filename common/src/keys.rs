//! The key expressions of a run, one place for all of them.
//!
//! | key | what |
//! |---|---|
//! | `reveille/{run}/{plane}/{kind}` | a [kind of message](MessageKind) that has a single key |
//! | `reveille/{run}/{plane}/{kind}/{number}` | one that has a key for each device or each host |
//! | `reveille/{run}/emu/alive/{host}`, `reveille/{run}/emu/bs` | liveliness tokens |
//! | `reveille/{run}/tap` | [`TapBatch`](crate::message::TapBatch), BS → observers |
//!
//! Nothing travels on keys of the plane of truth: its kinds come to observers by the tap alone.

use std::fmt;
use std::str::FromStr;

use crate::ids::HostId;
use crate::message::{Address, MessageKind, Payload};

/// A run's name on the bus: 1 to 64 letters, digits, `-` and `_`, and no `-` to begin with, as options have it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunName(String);

/// A text that is not a run name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("run name {0:?}: must be 1 to 64 letters, digits, '-' or '_', the first of them no '-'")]
pub struct RunNameError(String);

impl FromStr for RunName {
    type Err = RunNameError;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        let fits = !s.starts_with('-')
            && (1..=64).contains(&s.len())
            && s.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
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

    /// The key of a kind that has only one; where there is one for each device or host, what they begin with.
    pub fn of(&self, kind: MessageKind) -> String {
        format!("reveille/{}/{}/{}", self.run, kind.plane().name(), kind.name())
    }

    /// The key of a kind for the device or host with this number.
    pub fn to(&self, kind: MessageKind, number: u32) -> String {
        format!("{}/{number}", self.of(kind))
    }

    /// All keys of a kind that has one for each device or host.
    pub fn all(&self, kind: MessageKind) -> String {
        format!("{}/*", self.of(kind))
    }

    /// The key that payloads of type `P` travel on.
    pub fn typed<P: Payload>(&self, address: P::Address) -> String {
        match address.number() {
            Some(number) => self.to(P::KIND, number),
            None => self.of(P::KIND),
        }
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
pub fn classify(key: &str) -> Option<(MessageKind, Option<u32>)> {
    let mut parts = key.split('/').skip(2);
    let (plane, name) = (parts.next()?, parts.next()?);
    let kind = MessageKind::ALL
        .iter()
        .copied()
        .find(|k| k.plane().name() == plane && k.name() == name)?;
    Some((kind, parts.next().and_then(|n| n.parse().ok())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::DeviceId;
    use crate::message::{Answer, PlanUpdate, WakeUp};

    #[test]
    fn run_names_cannot_break_out_of_their_key() {
        for bad in ["", "a/b", "*", "a b", "é", &"x".repeat(65), "a$", "-x"] {
            assert!(bad.parse::<RunName>().is_err(), "{bad:?}");
        }
        assert!("Run-7_b".parse::<RunName>().is_ok());
    }

    #[test]
    fn the_key_of_a_payload_is_as_it_is_declared() {
        let keys = Keys::new("r1".parse().expect("valid"));
        assert_eq!(keys.typed::<WakeUp>(DeviceId(17)), "reveille/r1/air/wake/17");
        assert_eq!(keys.typed::<Answer>(HostId(2)), "reveille/r1/emu/answer/2");
        assert_eq!(keys.typed::<PlanUpdate>(()), "reveille/r1/air/plan");
    }

    #[test]
    fn keys_are_classified() {
        let keys = Keys::new("r1".parse().expect("valid"));
        for &kind in MessageKind::ALL {
            assert_eq!(classify(&keys.of(kind)), Some((kind, None)));
            assert_eq!(classify(&keys.to(kind, 17)), Some((kind, Some(17))));
        }
        assert_eq!(classify("reveille/r1/air/clock"), None);
        assert_eq!(classify("reveille"), None);
        assert_eq!(last_number(&keys.alive(HostId(3))), Some(3));
    }
}
