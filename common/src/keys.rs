//! The key expressions of a run. Only Python clients repeat some of them: the policy client
//! (`python/reveille/policy_client.py`, `docs/policy-port.md`), `tests/untrusted_clients/` and `tests/chaos/`.
//! [`classify`], [`last_number`], [`HostCredential::from_key_expr`] and `bus/liveliness.rs` parse keys by the positions
//! of their parts. No kind of message may be called `alive` or `bs` on the emulation plane.
//!
//! | key | use |
//! |---|---|
//! | `reveille/{run}/{plane}/{kind}` | queries that any client may send |
//! | `reveille/{run}/@{secret}/{plane}/{kind}` | a host's query |
//! | `…/{plane}/{kind}/*` | messages of the BS to all hosts; each host listens on its own number |
//! | `…/air/wake/{host}/{device}` | a wake-up, to the host that runs the device |
//! | `…/{plane}/{kind}/{host}/{token}` | messages of a host: reports and answers |
//! | `…/emu/alive/{host}/{token}` | liveliness tokens of hosts |
//! | `reveille/{run}/emu/bs` | the liveliness token of the BS |
//! | `reveille/{run}/policy/v1` | decision requests, BS → policy process |
//! | `reveille/{run}/tap` | [`FrameBatch`](crate::message::FrameBatch), BS → observers |
//!
//! Each host, a member of the run like the BS, receives the run's secret with its assignment, and its own token. This
//! `{token}` is a secret too; a liveliness token is zenoh's sign that a peer is alive.
//!
//! No wildcard of zenoh matches a part of a key that begins with `@`. Without the secret, a peer can neither name nor
//! receive those keys; even with it, a host cannot send for another host. Each host has its own key for messages to all
//! hosts: with a shared key, zenoh checks all pairs of hosts at each join. Kinds of the truth plane have no traffic:
//! observers receive them from the tap.

use std::fmt;
use std::str::FromStr;

use crate::ids::{DeviceId, HostId};
use crate::message::{Access, MessageKind};
use crate::secret::{HostCredential, Secret};

/// The name of a run on the bus: 1 to 64 letters, digits, `-` and `_`. Like an option's value it cannot start with
/// `-`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunName(String);

/// A text that is not a valid run name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("run name {0:?}: must be 1 to 64 letters, digits, '-' or '_', and must not begin with '-'")]
pub struct RunNameError(String);

impl FromStr for RunName {
    type Err = RunNameError;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        let is_valid = !s.starts_with('-')
            && (1..=64).contains(&s.len())
            && s.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if is_valid {
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

/// The key expressions of one run.
#[derive(Clone, Debug)]
pub struct KeyExprs {
    run: RunName,
    /// The secret part of the keys that only members may use. Without it, as for observers, those keys match no real
    /// key.
    member_secret: Option<Secret>,
}

impl KeyExprs {
    /// Returns the keys of `run` for a client that is not a member.
    pub const fn new(run: RunName) -> Self {
        Self {
            run,
            member_secret: None,
        }
    }

    /// Returns the keys of `run` for its members.
    pub const fn for_members(run: RunName, secret: Secret) -> Self {
        Self {
            run,
            member_secret: Some(secret),
        }
    }

    /// The name of the run.
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// The run's secret, if these keys are a member's.
    pub const fn member_secret(&self) -> Option<Secret> {
        self.member_secret
    }

    /// Returns the key of a kind that has only one, or the prefix of a kind with several keys.
    pub fn base_key(&self, kind: MessageKind) -> String {
        let prefix = match kind.access() {
            Access::Anyone => format!("reveille/{}", self.run),
            Access::Members => self.member_prefix(),
        };
        format!("{prefix}/{}/{}", kind.plane().name(), kind.name())
    }

    /// Returns the key on which the BS sends messages of `kind` to all hosts.
    pub fn to_all_hosts(&self, kind: MessageKind) -> String {
        format!("{}/*", self.base_key(kind))
    }

    /// Returns the key on which `host` receives messages to all hosts.
    pub fn to_all_hosts_at(&self, kind: MessageKind, host: HostId) -> String {
        format!("{}/{host}", self.base_key(kind))
    }

    /// Returns the key of wake-ups for `device`, which `host` runs.
    pub fn wake(&self, host: HostId, device: DeviceId) -> String {
        format!("{}/{host}/{device}", self.base_key(MessageKind::Wake))
    }

    /// Returns the key expression of wake-ups for all devices of `host`.
    pub fn wake_ups_of(&self, host: HostId) -> String {
        format!("{}/{host}/*", self.base_key(MessageKind::Wake))
    }

    /// Returns the key on which the host with this credential sends messages of `kind`.
    pub fn uplink(&self, kind: MessageKind, credential: HostCredential) -> String {
        format!("{}/{credential}", self.base_key(kind))
    }

    /// Returns the key expression for messages of `kind` from all hosts.
    pub fn uplinks(&self, kind: MessageKind) -> String {
        format!("{}/*/*", self.base_key(kind))
    }

    /// Returns the key of the liveliness token of the host with this credential.
    pub fn host_liveliness(&self, credential: HostCredential) -> String {
        format!("{}/emu/alive/{credential}", self.member_prefix())
    }

    /// Returns the key expression of the liveliness tokens of all hosts.
    pub fn all_host_liveliness(&self) -> String {
        format!("{}/emu/alive/*/*", self.member_prefix())
    }

    /// Returns the key of the liveliness token of the BS.
    pub fn bs_liveliness(&self) -> String {
        format!("reveille/{}/emu/bs", self.run)
    }

    /// Returns the key expression of the liveliness tokens of the BSs of all runs.
    pub fn all_bs_liveliness() -> &'static str {
        "reveille/*/emu/bs"
    }

    /// Returns the key of the policy port. It ends with the protocol's version, which separates later versions.
    pub fn policy_port(&self) -> String {
        format!("reveille/{}/policy/v1", self.run)
    }

    /// Returns the key of the copies of all traffic for observers.
    pub fn tap(&self) -> String {
        format!("reveille/{}/tap", self.run)
    }

    fn member_prefix(&self) -> String {
        match self.member_secret {
            Some(secret) => format!("reveille/{}/@{secret}", self.run),
            // A member's key has the secret behind the `@`, so this one matches none.
            None => format!("reveille/{}/@", self.run),
        }
    }
}

/// Returns the number at the end of a key, such as a device's.
pub fn last_number(key: &str) -> Option<u32> {
    key.rsplit('/').next()?.parse().ok()
}

/// Returns the kind of message on `key`, and the number after it, if the key has one: the host's, also for wake-ups and
/// reports.
pub fn classify(key: &str) -> Option<(MessageKind, Option<u32>)> {
    // Keys of members have the secret as an additional part.
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

    fn credential() -> HostCredential {
        HostCredential {
            host: HostId(2),
            token: Secret::new([0x01; 16]),
        }
    }

    #[test]
    fn run_names_contain_no_syntax_of_keys() {
        for name in ["", "a/b", "*", "a b", "é", &"x".repeat(65), "a$", "-x", "@x"] {
            assert!(name.parse::<RunName>().is_err(), "{name:?}");
        }
        assert!("Run-7_b".parse::<RunName>().is_ok());
    }

    #[test]
    fn member_keys_contain_the_secret_as_a_verbatim_chunk() {
        let keys = KeyExprs::for_members("r1".parse().expect("valid"), SECRET);
        let secret = "ab".repeat(16);
        let token = "01".repeat(16);
        assert_eq!(
            keys.base_key(MessageKind::Clock),
            format!("reveille/r1/@{secret}/emu/clock")
        );
        assert_eq!(
            [
                keys.to_all_hosts(MessageKind::Clock),
                keys.to_all_hosts_at(MessageKind::Clock, HostId(3))
            ],
            ["*", "3"].map(|host| format!("reveille/r1/@{secret}/emu/clock/{host}"))
        );
        assert_eq!(
            keys.wake(HostId(2), DeviceId(17)),
            format!("reveille/r1/@{secret}/air/wake/2/17")
        );
        assert_eq!(
            keys.uplink(MessageKind::Report, credential()),
            format!("reveille/r1/@{secret}/air/report/2/{token}")
        );
        assert_eq!(keys.base_key(MessageKind::Join), "reveille/r1/emu/join");
        let outsider = KeyExprs::new("r1".parse().expect("valid"));
        assert_eq!(outsider.base_key(MessageKind::Join), keys.base_key(MessageKind::Join));
        assert_eq!(outsider.base_key(MessageKind::Clock), "reveille/r1/@/emu/clock");
    }

    #[test]
    fn a_credential_is_read_from_the_keys_that_contain_it() {
        let keys = KeyExprs::for_members("r1".parse().expect("valid"), SECRET);
        for key in [
            keys.uplink(MessageKind::Answer, credential()),
            keys.host_liveliness(credential()),
        ] {
            assert_eq!(HostCredential::from_key_expr(&key), Some(credential()), "{key}");
        }
        for other in ["", "2", "x/2/3", "reveille/r1/emu/answer/2/0101", "-2/01", "*/*"] {
            assert_eq!(HostCredential::from_key_expr(other), None, "{other}");
        }
    }

    #[test]
    fn keys_are_classified_by_kind_and_host() {
        let keys = KeyExprs::for_members("r1".parse().expect("valid"), SECRET);
        for &kind in MessageKind::ALL {
            assert_eq!(classify(&keys.base_key(kind)), Some((kind, None)), "{kind:?}");
            assert_eq!(classify(&keys.to_all_hosts(kind)), Some((kind, None)), "{kind:?}");
            assert_eq!(
                classify(&keys.uplink(kind, credential())),
                Some((kind, Some(2))),
                "{kind:?}"
            );
        }
        assert_eq!(classify("reveille/r1/air/clock"), None);
        assert_eq!(classify("reveille"), None);
        assert_eq!(last_number(&keys.wake(HostId(3), DeviceId(5))), Some(5));
    }
}
