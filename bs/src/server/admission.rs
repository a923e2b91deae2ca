//! Admission of hosts, and the assignment of devices to them. `join` and `subscriptions` drive it. Entries are never
//! deleted, so a [`HostId`] belongs to one process for the whole run.
//!
//! ```text
//!              joins            ready and alive               alive again
//!   no entry ───────► joined ─────────────────────► active ◄────────────────────┐
//!                       │ late, not alive any         │  │ not alive any more    │
//!                       │ more, or the lost host      │  │ in the run, or        │
//!                       │ that it replaces returns    │  ▼ unresponsive          │
//!                       │                             │ lost (in `failover`) ────┘
//!                       │ not alive any more          │  │ taken over
//!                       ▼ before the run begins       ▼  ▼ or removed
//!                    revoked ◄────────────────────────┴──┘
//! ```
//!
//! A host is alive while its liveliness token exists on the bus. A host that is lost because it was unresponsive stays
//! active here. `tests/fuzz/fuzz_targets/hosts.rs` checks the order of these calls.

use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::DeviceRange;
use reveille_common::secret::{HostCredential, Secret};

/// The range of devices that a host runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// The host.
    pub host: HostId,
    /// Its first device.
    pub first: DeviceId,
    /// Number of devices, with consecutive ids, ≥ 1.
    pub count: u32,
}

impl Assignment {
    /// Its last device.
    pub const fn last(&self) -> DeviceId {
        DeviceId(self.first.0 + self.count - 1)
    }

    /// Its devices.
    pub const fn devices(&self) -> DeviceRange {
        DeviceRange {
            first: self.first,
            count: self.count,
        }
    }
}

/// A host process that requests to join.
#[derive(Clone, Debug)]
pub struct JoiningHost {
    /// Its random number. A repeated request with the same number gets the same assignment.
    pub nonce: u64,
    /// The secret token that it receives. It proves later messages, and has nothing to do with its liveliness token.
    pub token: Secret,
    /// Its name, for logs.
    pub name: String,
    /// Number of devices that it offers to run; any number, since the host sends it.
    pub offered_devices: u32,
    /// Time of its request.
    pub requested_at: Instant,
}

#[derive(Clone, Debug)]
struct HostEntry {
    request: JoiningHost,
    assignment: Assignment,
    /// Whether it has made all its subscriptions.
    is_ready: bool,
    /// Whether its liveliness token exists.
    is_alive: bool,
    is_revoked: bool,
}

impl HostEntry {
    const fn is_active(&self) -> bool {
        self.is_ready && self.is_alive && !self.is_revoked
    }
}

/// The hosts that have joined, and their assignments.
#[derive(Clone, Debug)]
pub struct Admission {
    devices: u32,
    /// Devices without a host: the first device and the number of devices of each range.
    free_ranges: Vec<(u32, u32)>,
    hosts: Vec<HostEntry>,
}

impl Admission {
    /// Creates the admission for a run of `devices` devices, none of which has a host.
    pub fn new(devices: u32) -> Self {
        Self {
            devices,
            free_ranges: vec![(0, devices)],
            hosts: Vec::new(),
        }
    }

    /// Number of devices N of the run.
    pub const fn devices(&self) -> u32 {
        self.devices
    }

    /// The assignment and secret token of the host that drew `nonce`, if it has joined and is not revoked.
    pub fn find_by_nonce(&self, nonce: u64) -> Option<(Assignment, Secret)> {
        let entry = self.hosts.iter().find(|e| e.request.nonce == nonce && !e.is_revoked)?;
        Some((entry.assignment, entry.request.token))
    }

    /// Assigns free devices to `request`, at most as many as it offers to run; `None` if no device is free. The caller
    /// has checked with [`Self::find_by_nonce`] that the host has no assignment yet.
    pub fn admit(&mut self, request: JoiningHost) -> Option<Assignment> {
        let (first, available) = self.free_ranges.pop()?;
        // The count comes from another process and may be 0. A host has at least one device, as `Assignment::last`
        // requires.
        let count = request.offered_devices.clamp(1, available);
        if count < available {
            self.free_ranges.push((first + count, available - count));
        }
        Some(self.add_host(request, DeviceId(first), count))
    }

    /// Assigns exactly the devices of `range` to `request`; `None` unless all of them are free.
    pub fn admit_exactly(&mut self, request: JoiningHost, range: DeviceRange) -> Option<Assignment> {
        let DeviceRange { first, count } = range;
        let offset_in = |free: &(u32, u32)| first.0.checked_sub(free.0).filter(|offset| *offset < free.1);
        let index = self.free_ranges.iter().position(|free| offset_in(free).is_some())?;
        let (free_first, available) = self.free_ranges[index];
        let before = first.0 - free_first;
        let after = (available - before).checked_sub(count)?;
        // The order of `free_host`: the first devices come last.
        let rest = [(first.0 + count, after), (free_first, before)];
        let rest = rest.into_iter().filter(|(_, count)| *count > 0);
        self.free_ranges.splice(index..=index, rest);
        Some(self.add_host(request, first, count))
    }

    /// Assigns the devices of a lost host to `request`. The lost host keeps its assignment until [`Self::revoke`], in
    /// case it returns first.
    pub fn take_over(&mut self, request: JoiningHost, lost: Assignment) -> Assignment {
        self.add_host(request, lost.first, lost.count)
    }

    fn add_host(&mut self, request: JoiningHost, first: DeviceId, count: u32) -> Assignment {
        // Entries are never removed, so a number means one process for the whole run and its late messages are
        // recognised.
        let host = HostId(self.hosts.len() as u32);
        let assignment = Assignment { host, first, count };
        self.hosts.push(HostEntry {
            request,
            assignment,
            is_ready: false,
            is_alive: false,
            is_revoked: false,
        });
        assignment
    }

    /// Whether `credential` belongs to a host whose assignment is valid.
    pub fn is_valid(&self, credential: HostCredential) -> bool {
        let entry = self.hosts.get(credential.host.index());
        // The token proves that the message is from this host; its number alone could be guessed.
        entry.is_some_and(|entry| entry.request.token == credential.token && !entry.is_revoked)
    }

    /// Marks the host of `credential` as ready. Returns whether the credential is valid.
    pub fn mark_ready(&mut self, credential: HostCredential) -> bool {
        let is_valid = self.is_valid(credential);
        if is_valid {
            self.hosts[credential.host.index()].is_ready = true;
        }
        is_valid
    }

    /// Records whether the liveliness token of a host exists.
    pub fn set_alive(&mut self, host: HostId, is_alive: bool) {
        if let Some(entry) = self.hosts.get_mut(host.index()) {
            entry.is_alive = is_alive;
        }
    }

    /// Whether the host runs its devices: it is ready and alive, and not revoked.
    pub fn is_active(&self, host: HostId) -> bool {
        self.hosts.get(host.index()).is_some_and(HostEntry::is_active)
    }

    /// The hosts that requested to join more than `patience` before `now` and are not ready yet.
    pub fn overdue_hosts(&self, now: Instant, patience: Duration) -> Vec<HostId> {
        let is_late = |entry: &&HostEntry| {
            let is_open = !entry.is_ready && !entry.is_revoked;
            is_open && now.saturating_duration_since(entry.request.requested_at) > patience
        };
        self.hosts
            .iter()
            .filter(is_late)
            .map(|entry| entry.assignment.host)
            .collect()
    }

    /// Revokes a host before the run begins, and frees its devices. In a run only [`Self::revoke`] may be used, because
    /// the devices have states.
    pub fn free_host(&mut self, host: HostId) -> Option<Assignment> {
        let assignment = self.revoke(host)?;
        self.free_ranges.push((assignment.first.0, assignment.count));
        // Adjacent ranges become one, so that another host can get as many devices. The first range is assigned first.
        self.free_ranges.sort_unstable_by(|a, b| b.cmp(a));
        self.free_ranges.dedup_by(|(first, count), (next_first, next_count)| {
            let is_adjacent = *first + *count == *next_first;
            if is_adjacent {
                (*next_first, *next_count) = (*first, *count + *next_count);
            }
            is_adjacent
        });
        Some(assignment)
    }

    /// Revokes the assignment of the host, and returns it.
    pub fn revoke(&mut self, host: HostId) -> Option<Assignment> {
        let entry = self.hosts.get_mut(host.index()).filter(|entry| !entry.is_revoked)?;
        entry.is_revoked = true;
        Some(entry.assignment)
    }

    /// The assignment of `host`, unless it was revoked.
    pub fn assignment(&self, host: HostId) -> Option<Assignment> {
        let entry = self.hosts.get(host.index()).filter(|entry| !entry.is_revoked);
        entry.map(|entry| entry.assignment)
    }

    /// The name of `host`.
    pub fn host_name(&self, host: HostId) -> &str {
        self.hosts.get(host.index()).map_or("", |entry| &entry.request.name)
    }

    /// The assignments of all hosts.
    pub fn assignments(&self) -> impl Iterator<Item = Assignment> + '_ {
        let entries = self.hosts.iter().filter(|entry| !entry.is_revoked);
        entries.map(|entry| entry.assignment)
    }

    /// Number of devices without a host.
    pub fn free_device_count(&self) -> u32 {
        self.free_ranges.iter().map(|(_, count)| count).sum()
    }

    /// Number of devices that are assigned to a host.
    pub fn assigned_device_count(&self) -> u32 {
        self.devices - self.free_device_count()
    }

    /// Number of hosts that run their devices.
    pub fn active_host_count(&self) -> usize {
        self.hosts.iter().filter(|entry| entry.is_active()).count()
    }

    /// Number of hosts with an assignment.
    pub fn assigned_host_count(&self) -> usize {
        self.assignments().count()
    }

    /// The assignments of all hosts, once every device has a host and every host runs its devices.
    pub fn assignments_if_all_active(&self) -> Option<Vec<Assignment>> {
        let assigned_hosts = || self.hosts.iter().filter(|entry| !entry.is_revoked);
        (self.assigned_device_count() == self.devices && assigned_hosts().all(HostEntry::is_active))
            .then(|| assigned_hosts().map(|entry| entry.assignment).collect())
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need an instant")]
mod tests {
    use super::*;

    fn joining_host(nonce: u64, offered_devices: u32) -> JoiningHost {
        JoiningHost {
            nonce,
            token: Secret::new([nonce as u8; 16]),
            name: format!("host {nonce}"),
            offered_devices,
            requested_at: Instant::now(),
        }
    }

    fn credential(assignment: Assignment, nonce: u64) -> HostCredential {
        HostCredential {
            host: assignment.host,
            token: Secret::new([nonce as u8; 16]),
        }
    }

    #[test]
    fn devices_are_assigned_once_and_a_repeated_request_gets_the_same_assignment() {
        let mut admission = Admission::new(10);
        let a = admission.admit(joining_host(1, 4)).expect("free");
        let b = admission.admit(joining_host(2, 100)).expect("free");
        assert_eq!((a.first, a.count, b.first, b.count), (DeviceId(0), 4, DeviceId(4), 6));
        assert_eq!(admission.find_by_nonce(1), Some((a, Secret::new([1; 16]))));
        assert_eq!(
            (admission.find_by_nonce(3), admission.admit(joining_host(3, 1))),
            (None, None)
        );
        for (assignment, nonce) in [(a, 1), (b, 2)] {
            assert!(admission.mark_ready(credential(assignment, nonce)));
            assert_eq!(
                admission.assignments_if_all_active(),
                None,
                "no host or only one is active"
            );
            let active_before = admission.active_host_count();
            admission.set_alive(assignment.host, true);
            assert_eq!(
                (admission.active_host_count(), admission.assigned_host_count()),
                (active_before + 1, 2)
            );
        }
        assert_eq!(admission.assignments_if_all_active(), Some(vec![a, b]));
    }

    fn range(first: u32, count: u32) -> DeviceRange {
        let first = DeviceId(first);
        DeviceRange { first, count }
    }

    #[test]
    fn an_exact_range_is_assigned_only_if_all_of_it_is_free() {
        let mut admission = Admission::new(20);
        let mut admit = |nonce, first, count| {
            let assignment = admission.admit_exactly(joining_host(nonce, count), range(first, count));
            assignment.map(|assignment| assignment.devices())
        };
        assert_eq!(admit(1, 5, 5), Some(range(5, 5)));
        for (first, count) in [
            (4, 2),
            (9, 1),
            (0, 20),
            (5, 5),
            (20, 1),
            (15, 6),
            (u32::MAX, 2),
            (3, u32::MAX),
        ] {
            assert_eq!(admit(2, first, count), None, "{count} from {first}");
        }
        assert_eq!(admit(2, 15, 5), Some(range(15, 5)));
        assert_eq!(admit(3, 0, 2), Some(range(0, 2)));
        assert_eq!(admission.free_ranges, [(10, 5), (2, 3)]);
        // A host without a range gets the first free devices, and a freed range can be assigned again.
        let first_free = admission.admit(joining_host(4, 100)).expect("free");
        assert_eq!(first_free.devices(), range(2, 3));
        admission.free_host(HostId(0));
        assert_eq!(admission.free_ranges, [(5, 10)]);
        let again = admission.admit_exactly(joining_host(5, 5), range(5, 5)).expect("free");
        assert_eq!((again.devices(), again.host), (range(5, 5), HostId(4)));
        assert_eq!(admission.free_device_count(), 5);
    }

    #[test]
    fn a_credential_is_valid_only_for_its_own_host() {
        let mut admission = Admission::new(10);
        let (a, b) = (
            admission.admit(joining_host(1, 5)).expect("free"),
            admission.admit(joining_host(2, 5)).expect("free"),
        );
        assert!(!admission.mark_ready(credential(a, 2)) && !admission.is_valid(credential(b, 1)));
        let unknown = Assignment { host: HostId(9), ..a };
        assert!(!admission.mark_ready(credential(unknown, 1)));
        assert!(admission.is_valid(credential(a, 1)));
    }

    #[test]
    fn a_host_that_never_becomes_ready_is_overdue() {
        let mut admission = Admission::new(10);
        let a = admission.admit(joining_host(1, 5)).expect("free");
        let b = admission.admit(joining_host(2, 5)).expect("free");
        admission.mark_ready(credential(a, 1));
        let timeout = Duration::from_secs(20);
        let now = Instant::now();
        assert_eq!(admission.overdue_hosts(now, timeout), []);
        assert_eq!(admission.overdue_hosts(now + timeout + timeout, timeout), [b.host]);
    }

    #[test]
    fn a_host_that_leaves_before_it_is_ready_frees_its_devices() {
        let mut admission = Admission::new(10);
        let a = admission.admit(joining_host(1, 6)).expect("free");
        admission.admit(joining_host(2, 4));
        assert_eq!(admission.free_host(a.host), Some(a));
        assert_eq!(admission.free_host(a.host), None);
        assert!(!admission.mark_ready(credential(a, 1)));
        assert_eq!(admission.assigned_device_count(), 4);
        assert_eq!(admission.free_ranges, [(0, 6)]);
        let reassigned = admission.admit(joining_host(3, 6)).expect("free");
        assert_eq!(
            (reassigned.first, reassigned.count, reassigned.host),
            (a.first, 6, HostId(2))
        );
    }

    #[test]
    fn a_takeover_assigns_the_same_devices_to_a_new_host() {
        let mut admission = Admission::new(10);
        let a = admission.admit(joining_host(1, 10)).expect("free");
        assert!(admission.mark_ready(credential(a, 1)));
        let b = admission.take_over(joining_host(2, 40), a);
        assert_eq!((b.first, b.count, b.host), (a.first, a.count, HostId(1)));
        admission.revoke(a.host);
        assert!(!admission.is_valid(credential(a, 1)) && admission.is_valid(credential(b, 2)));
        assert_eq!(admission.host_name(b.host), "host 2");
    }
}
