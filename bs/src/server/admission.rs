//! Admission of hosts, and the assignment of devices to them.
//!
//! ```text
//!              joins                ready, and its token exists
//!   no entry ───────► joined ──────────────────────────────────────► active
//!                       │ late, or its token disappears                │ its token disappears
//!                       ▼                                              ▼
//!                    revoked ◄──────────────────────────────────────  lost (see `failover`)
//! ```

use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::secret::{HostCredential, Secret};

/// The range of devices that a host runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// The host.
    pub host: HostId,
    /// Its first device.
    pub first: DeviceId,
    /// Number of devices, with consecutive ids.
    pub count: u32,
}

impl Assignment {
    /// Its last device.
    pub const fn last(&self) -> DeviceId {
        DeviceId(self.first.0 + self.count - 1)
    }
}

/// A host process that requests to join.
#[derive(Clone, Debug)]
pub struct JoiningHost {
    /// Its random number. A repeated request with the same number gets the same assignment.
    pub nonce: u64,
    /// The token that it receives.
    pub token: Secret,
    /// Its name, for logs.
    pub name: String,
    /// Number of devices that it offers to run.
    pub count: u32,
    /// Time of its request.
    pub asked: Instant,
}

#[derive(Clone, Debug)]
struct HostEntry {
    newcomer: JoiningHost,
    places: Assignment,
    /// Whether it has made all its subscriptions.
    is_ready: bool,
    /// Whether its liveliness token exists.
    is_alive: bool,
    is_gone: bool,
}

impl HostEntry {
    const fn is_active(&self) -> bool {
        self.is_ready && self.is_alive && !self.is_gone
    }
}

/// The hosts that have joined, and their assignments.
#[derive(Clone, Debug)]
pub struct Admission {
    devices: u32,
    /// Free ranges (first, count).
    free: Vec<(u32, u32)>,
    hosts: Vec<HostEntry>,
}

impl Admission {
    /// Creates the admission for a run of `devices` devices, none of which has a host.
    pub fn new(devices: u32) -> Self {
        Self {
            devices,
            free: vec![(0, devices)],
            hosts: Vec::new(),
        }
    }

    /// Number of devices N of the run.
    pub const fn devices(&self) -> u32 {
        self.devices
    }

    /// The assignment and token of the host that drew `nonce`, if it has joined before.
    pub fn find_by_nonce(&self, nonce: u64) -> Option<(Assignment, Secret)> {
        let entry = self.hosts.iter().find(|e| e.newcomer.nonce == nonce && !e.is_gone)?;
        Some((entry.places, entry.newcomer.token))
    }

    /// Assigns free devices to `newcomer`, at most as many as it offers to run; `None` if no device is free.
    pub fn join(&mut self, newcomer: JoiningHost) -> Option<Assignment> {
        let (first, available) = self.free.pop()?;
        // The count comes from another process and may be 0. A host has at least one device, as `Assignment::last`
        // requires.
        let count = newcomer.count.clamp(1, available);
        if count < available {
            self.free.push((first + count, available - count));
        }
        Some(self.enter(newcomer, DeviceId(first), count))
    }

    /// Assigns the devices of a lost host to `newcomer`.
    pub fn take_over(&mut self, newcomer: JoiningHost, lost: Assignment) -> Assignment {
        self.enter(newcomer, lost.first, lost.count)
    }

    fn enter(&mut self, newcomer: JoiningHost, first: DeviceId, count: u32) -> Assignment {
        // Entries are never removed, so a number means one process for the whole run and its late messages are
        // recognised.
        let host = HostId(self.hosts.len() as u32);
        let places = Assignment { host, first, count };
        self.hosts.push(HostEntry {
            newcomer,
            places,
            is_ready: false,
            is_alive: false,
            is_gone: false,
        });
        places
    }

    /// Whether `pass` belongs to a host whose assignment is valid.
    pub fn is_valid(&self, pass: HostCredential) -> bool {
        let entry = self.hosts.get(pass.host.index());
        // The token proves that the message is from this host; its number alone could be guessed.
        entry.is_some_and(|entry| entry.newcomer.token == pass.token && !entry.is_gone)
    }

    /// Marks the host as ready. Returns whether its assignment is still valid.
    pub fn ready(&mut self, pass: HostCredential) -> bool {
        let is_valid = self.is_valid(pass);
        if is_valid {
            self.hosts[pass.host.index()].is_ready = true;
        }
        is_valid
    }

    /// Records whether the liveliness token of a host exists.
    pub fn set_alive(&mut self, host: HostId, is_alive: bool) {
        self.hosts[host.index()].is_alive = is_alive;
    }

    /// Whether the host runs its devices: it is ready, and its token exists.
    pub fn is_active(&self, host: HostId) -> bool {
        self.hosts.get(host.index()).is_some_and(HostEntry::is_active)
    }

    /// The hosts that requested to join more than `patience` before `now` and are not ready yet.
    pub fn overdue(&self, now: Instant, patience: Duration) -> Vec<HostId> {
        let is_late = |entry: &&HostEntry| {
            let is_open = !entry.is_ready && !entry.is_gone;
            is_open && now.saturating_duration_since(entry.newcomer.asked) > patience
        };
        self.hosts
            .iter()
            .filter(is_late)
            .map(|entry| entry.places.host)
            .collect()
    }

    /// Removes a host before the run begins, and frees its devices.
    pub fn leave(&mut self, host: HostId) -> Option<Assignment> {
        let places = self.revoke(host)?;
        self.free.push((places.first.0, places.count));
        Some(places)
    }

    /// Revokes the assignment of the host, and returns it.
    pub fn revoke(&mut self, host: HostId) -> Option<Assignment> {
        let entry = self.hosts.get_mut(host.index()).filter(|entry| !entry.is_gone)?;
        entry.is_gone = true;
        Some(entry.places)
    }

    /// The assignment of `host`, unless it was revoked.
    pub fn assignment(&self, host: HostId) -> Option<Assignment> {
        let entry = self.hosts.get(host.index()).filter(|entry| !entry.is_gone);
        entry.map(|entry| entry.places)
    }

    /// The name of `host`.
    pub fn name(&self, host: HostId) -> &str {
        self.hosts.get(host.index()).map_or("", |entry| &entry.newcomer.name)
    }

    /// Number of devices that are assigned to a host.
    pub fn assigned_devices(&self) -> u32 {
        self.devices - self.free.iter().map(|(_, count)| count).sum::<u32>()
    }

    /// Number of hosts that run their devices.
    pub fn active_hosts(&self) -> usize {
        self.hosts.iter().filter(|entry| entry.is_active()).count()
    }

    /// Number of hosts with an assignment.
    pub fn assigned_hosts(&self) -> usize {
        self.hosts.iter().filter(|entry| !entry.is_gone).count()
    }

    /// The assignments of all hosts, once every device has a host and every host runs its devices.
    pub fn all_ready(&self) -> Option<Vec<Assignment>> {
        let living = || self.hosts.iter().filter(|entry| !entry.is_gone);
        (self.assigned_devices() == self.devices && living().all(HostEntry::is_active))
            .then(|| living().map(|entry| entry.places).collect())
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need some moment")]
mod tests {
    use super::*;

    fn newcomer(nonce: u64, count: u32) -> JoiningHost {
        JoiningHost {
            nonce,
            token: Secret::new([nonce as u8; 16]),
            name: format!("host {nonce}"),
            count,
            asked: Instant::now(),
        }
    }

    fn pass(places: Assignment, nonce: u64) -> HostCredential {
        HostCredential {
            host: places.host,
            token: Secret::new([nonce as u8; 16]),
        }
    }

    #[test]
    fn places_are_given_once_and_again_to_the_same_asker() {
        let mut admission = Admission::new(10);
        let a = admission.join(newcomer(1, 4)).expect("free");
        let b = admission.join(newcomer(2, 100)).expect("free");
        assert_eq!((a.first, a.count, b.first, b.count), (DeviceId(0), 4, DeviceId(4), 6));
        assert_eq!(admission.find_by_nonce(1), Some((a, Secret::new([1; 16]))));
        assert_eq!(
            (admission.find_by_nonce(3), admission.join(newcomer(3, 1))),
            (None, None)
        );
        for (places, nonce) in [(a, 1), (b, 2)] {
            assert!(admission.ready(pass(places, nonce)));
            assert_eq!(admission.all_ready(), None, "a token is missing");
            let before = admission.active_hosts();
            admission.set_alive(places.host, true);
            assert_eq!((admission.active_hosts(), admission.assigned_hosts()), (before + 1, 2));
        }
        assert_eq!(admission.all_ready(), Some(vec![a, b]));
    }

    #[test]
    fn nobody_speaks_for_another_host() {
        let mut admission = Admission::new(10);
        let (a, b) = (
            admission.join(newcomer(1, 5)).expect("free"),
            admission.join(newcomer(2, 5)).expect("free"),
        );
        assert!(!admission.ready(pass(a, 2)) && !admission.is_valid(pass(b, 1)));
        let unknown = Assignment { host: HostId(9), ..a };
        assert!(!admission.ready(pass(unknown, 1)));
        assert!(admission.is_valid(pass(a, 1)));
    }

    #[test]
    fn a_host_that_never_becomes_ready_is_late() {
        let mut admission = Admission::new(10);
        let a = admission.join(newcomer(1, 5)).expect("free");
        let b = admission.join(newcomer(2, 5)).expect("free");
        admission.ready(pass(a, 1));
        let patience = Duration::from_secs(20);
        let now = Instant::now();
        assert_eq!(admission.overdue(now, patience), []);
        assert_eq!(admission.overdue(now + patience + patience, patience), [b.host]);
    }

    #[test]
    fn a_host_that_leaves_early_frees_its_places() {
        let mut admission = Admission::new(10);
        let a = admission.join(newcomer(1, 6)).expect("free");
        admission.join(newcomer(2, 4));
        assert_eq!(admission.leave(a.host), Some(a));
        assert_eq!(admission.leave(a.host), None);
        assert!(!admission.ready(pass(a, 1)));
        assert_eq!(admission.assigned_devices(), 4);
        let again = admission.join(newcomer(3, 6)).expect("free");
        assert_eq!((again.first, again.count, again.host), (a.first, 6, HostId(2)));
    }

    #[test]
    fn who_takes_over_is_another_host_with_the_same_devices() {
        let mut admission = Admission::new(10);
        let a = admission.join(newcomer(1, 10)).expect("free");
        assert!(admission.ready(pass(a, 1)));
        let b = admission.take_over(newcomer(2, 40), a);
        assert_eq!((b.first, b.count, b.host), (a.first, a.count, HostId(1)));
        admission.revoke(a.host);
        assert!(!admission.is_valid(pass(a, 1)) && admission.is_valid(pass(b, 2)));
        assert_eq!(admission.name(b.host), "host 2");
    }
}
