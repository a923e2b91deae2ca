//! The key expressions of a run, one place for all of them.
//!
//! | key | what |
//! |---|---|
//! | `reveille/{run}/{plane}/{kind}` | queries that anyone may ask |
//! | `reveille/{run}/@{secret}/{plane}/{kind}` | a host's query |
//! | `…/{plane}/{kind}/*` | what the BS tells all hosts; each listens on its own number |
//! | `…/air/wake/{host}/{device}` | a wake-up, to the host that carries the device |
//! | `…/{plane}/{kind}/{host}/{token}` | what a host sends: reports and answers |
//! | `…/emu/alive/{host}/{token}` | liveliness tokens of hosts |
//! | `reveille/{run}/emu/bs` | the liveliness token of the BS |
//! | `reveille/{run}/policy/v1` | what a program outside is asked to decide, BS → policy process |
//! | `reveille/{run}/tap` | [`TapBatch`](crate::message::TapBatch), BS → observers |
//!
//! The secret is told to hosts with their places, the token to one host alone. No wildcard of zenoh matches a part of a
//! key that begins with `@`: who does not know the secret can neither name those keys nor hear of them, and who does
//! cannot speak for another host. What all hosts hear, each hears on a key of its own: where they share one, zenoh
//! looks at all pairs of hosts whenever one more comes. Nothing travels on keys of the plane of truth: its kinds come
//! to observers by the tap alone.

use std::fmt;
use std::str::FromStr;

use crate::ids::{DeviceId, HostId};
use crate::message::{Access, MessageKind};
use crate::secret::{HostPass, Secret};

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
    /// What the keys of members begin with; without it, as observers have them, they are nobody's.
    secret: Option<Secret>,
}

impl Keys {
    /// The keys of `run` for who is no member of it.
    pub const fn new(run: RunName) -> Self {
        Self { run, secret: None }
    }

    /// The keys of `run` for its members.
    pub const fn of_members(run: RunName, secret: Secret) -> Self {
        Self {
            run,
            secret: Some(secret),
        }
    }

    /// The run.
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// What members were told, if these keys are a member's.
    pub const fn secret(&self) -> Option<Secret> {
        self.secret
    }

    /// The key of a kind that has only one; where there are more, what they begin with.
    pub fn of(&self, kind: MessageKind) -> String {
        let prefix = match kind.access() {
            Access::Anyone => format!("reveille/{}", self.run),
            Access::Members => self.members(),
        };
        format!("{prefix}/{}/{}", kind.plane().name(), kind.name())
    }

    /// The key on which the BS tells all hosts messages of `kind`.
    pub fn to_all(&self, kind: MessageKind) -> String {
        format!("{}/*", self.of(kind))
    }

    /// The key on which `host` hears what all are told.
    pub fn to_one_of_all(&self, kind: MessageKind, host: HostId) -> String {
        format!("{}/{host}", self.of(kind))
    }

    /// The key of wake-ups for `device`, which `host` carries.
    pub fn wake(&self, host: HostId, device: DeviceId) -> String {
        format!("{}/{host}/{device}", self.of(MessageKind::Wake))
    }

    /// The keys of wake-ups for all devices that `host` carries.
    pub fn wakes_of(&self, host: HostId) -> String {
        format!("{}/{host}/*", self.of(MessageKind::Wake))
    }

    /// The key on which the host with this pass sends messages of `kind`.
    pub fn uplink(&self, kind: MessageKind, pass: HostPass) -> String {
        format!("{}/{pass}", self.of(kind))
    }

    /// The keys on which hosts send messages of `kind`.
    pub fn uplinks(&self, kind: MessageKind) -> String {
        format!("{}/*/*", self.of(kind))
    }

    /// The liveliness token of the host with this pass.
    pub fn alive(&self, pass: HostPass) -> String {
        format!("{}/emu/alive/{pass}", self.members())
    }

    /// The liveliness tokens of all hosts.
    pub fn all_alive(&self) -> String {
        format!("{}/emu/alive/*/*", self.members())
    }

    /// The liveliness token of the BS.
    pub fn bs_alive(&self) -> String {
        format!("reveille/{}/emu/bs", self.run)
    }

    /// The liveliness tokens of the BSs of all runs.
    pub fn any_bs() -> &'static str {
        "reveille/*/emu/bs"
    }

    /// The policy port. It ends with the version of what is spoken there, of which all that follow can be told apart.
    pub fn policy(&self) -> String {
        format!("reveille/{}/policy/v1", self.run)
    }

    /// The copies of all traffic for observers.
    pub fn tap(&self) -> String {
        format!("reveille/{}/tap", self.run)
    }

    fn members(&self) -> String {
        match self.secret {
            Some(secret) => format!("reveille/{}/@{secret}", self.run),
            None => format!("reveille/{}/@", self.run),
        }
    }
}

/// The number at the end of a key, such as a device's.
pub fn last_number(key: &str) -> Option<u32> {
    key.rsplit('/').next()?.parse().ok()
}

/// The kind of message that `key` carries, and the number that follows, a host's, if it has one.
pub fn classify(key: &str) -> Option<(MessageKind, Option<u32>)> {
    let mut parts = key.split('/').skip(2).filter(|part| !part.starts_with('@'));
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

    const SECRET: Secret = Secret::new([0xab; 16]);

    fn pass() -> HostPass {
        HostPass {
            host: HostId(2),
            token: Secret::new([0x01; 16]),
        }
    }

    #[test]
    fn run_names_cannot_break_out_of_their_key() {
        for bad in ["", "a/b", "*", "a b", "é", &"x".repeat(65), "a$", "-x", "@x"] {
            assert!(bad.parse::<RunName>().is_err(), "{bad:?}");
        }
        assert!("Run-7_b".parse::<RunName>().is_ok());
    }

    #[test]
    fn members_have_keys_that_no_wildcard_matches() {
        let keys = Keys::of_members("r1".parse().expect("valid"), SECRET);
        let secret = "ab".repeat(16);
        let token = "01".repeat(16);
        assert_eq!(keys.of(MessageKind::Clock), format!("reveille/r1/@{secret}/emu/clock"));
        assert_eq!(
            [
                keys.to_all(MessageKind::Clock),
                keys.to_one_of_all(MessageKind::Clock, HostId(3))
            ],
            ["*", "3"].map(|host| format!("reveille/r1/@{secret}/emu/clock/{host}"))
        );
        assert_eq!(
            keys.wake(HostId(2), DeviceId(17)),
            format!("reveille/r1/@{secret}/air/wake/2/17")
        );
        assert_eq!(
            keys.uplink(MessageKind::Report, pass()),
            format!("reveille/r1/@{secret}/air/report/2/{token}")
        );
        assert_eq!(keys.of(MessageKind::Join), "reveille/r1/emu/join");
        let stranger = Keys::new("r1".parse().expect("valid"));
        assert_eq!(stranger.of(MessageKind::Join), keys.of(MessageKind::Join));
        assert_eq!(stranger.of(MessageKind::Clock), "reveille/r1/@/emu/clock");
    }

    #[test]
    fn a_pass_is_read_off_the_keys_that_carry_it() {
        let keys = Keys::of_members("r1".parse().expect("valid"), SECRET);
        for key in [keys.uplink(MessageKind::Answer, pass()), keys.alive(pass())] {
            assert_eq!(HostPass::at_end_of(&key), Some(pass()), "{key}");
        }
        for other in ["", "2", "x/2/3", "reveille/r1/emu/answer/2/0101", "-2/01", "*/*"] {
            assert_eq!(HostPass::at_end_of(other), None, "{other}");
        }
    }

    #[test]
    fn keys_are_classified() {
        let keys = Keys::of_members("r1".parse().expect("valid"), SECRET);
        for &kind in MessageKind::ALL {
            assert_eq!(classify(&keys.of(kind)), Some((kind, None)));
            assert_eq!(classify(&keys.to_all(kind)), Some((kind, None)));
            assert_eq!(classify(&keys.uplink(kind, pass())), Some((kind, Some(2))));
        }
        assert_eq!(classify("reveille/r1/air/clock"), None);
        assert_eq!(classify("reveille"), None);
        assert_eq!(last_number(&keys.wake(HostId(3), DeviceId(5))), Some(5));
    }
}
