//! Who joins, and gets which devices to carry.
//!
//! ```text
//!            join                        ready, and its token is there
//!   nobody ───────► joined ──────────────────────────────────────────► carries
//!                     │ too late, or its token is gone                   │ its token is gone
//!                     ▼                                                  ▼
//!                    gone ◄──────────────────────────────────────────  lost (see `losses`)
//! ```

use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId};
use reveille_common::secret::{HostPass, Secret};

/// The places that a host got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Places {
    /// The host.
    pub host: HostId,
    /// Its first device.
    pub first: DeviceId,
    /// How many devices the host carries, numbered one after another.
    pub count: u32,
}

impl Places {
    /// Its last device.
    pub const fn last(&self) -> DeviceId {
        DeviceId(self.first.0 + self.count - 1)
    }
}

/// A host process that asks for places.
#[derive(Clone, Debug)]
pub struct Newcomer {
    /// The number that it drew: who asks again gets the same places.
    pub nonce: u64,
    /// The token that it is given.
    pub token: Secret,
    /// What it calls itself.
    pub name: String,
    /// How many devices it would carry.
    pub count: u32,
    /// When it asked.
    pub asked: Instant,
}

#[derive(Clone, Debug)]
struct Entry {
    newcomer: Newcomer,
    places: Places,
    /// It has subscribed to everything.
    is_ready: bool,
    /// Its liveliness token is there.
    is_alive: bool,
    is_gone: bool,
}

impl Entry {
    const fn carries(&self) -> bool {
        self.is_ready && self.is_alive && !self.is_gone
    }
}

/// The hosts that have joined, and the devices that each is to carry.
#[derive(Clone, Debug)]
pub struct Admission {
    devices: u32,
    /// Free ranges (first, count).
    free: Vec<(u32, u32)>,
    hosts: Vec<Entry>,
}

impl Admission {
    /// A run of `devices` devices that nobody carries yet.
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

    /// The places and the token that the process which drew `nonce` has, if it has asked before.
    pub fn known(&self, nonce: u64) -> Option<(Places, Secret)> {
        let entry = self.hosts.iter().find(|e| e.newcomer.nonce == nonce && !e.is_gone)?;
        Some((entry.places, entry.newcomer.token))
    }

    /// Gives a newcomer free places, as many as it would carry if there are so many; `None` when all are taken.
    pub fn join(&mut self, newcomer: Newcomer) -> Option<Places> {
        let (first, available) = self.free.pop()?;
        let count = newcomer.count.clamp(1, available);
        if count < available {
            self.free.push((first + count, available - count));
        }
        Some(self.enter(newcomer, DeviceId(first), count))
    }

    /// Gives a newcomer the places of a host that is lost.
    pub fn take_over(&mut self, newcomer: Newcomer, lost: Places) -> Places {
        self.enter(newcomer, lost.first, lost.count)
    }

    fn enter(&mut self, newcomer: Newcomer, first: DeviceId, count: u32) -> Places {
        let host = HostId(self.hosts.len() as u32);
        let places = Places { host, first, count };
        self.hosts.push(Entry {
            newcomer,
            places,
            is_ready: false,
            is_alive: false,
            is_gone: false,
        });
        places
    }

    /// Whether this is the pass of a host whose places are its own.
    pub fn is_valid(&self, pass: HostPass) -> bool {
        let entry = self.hosts.get(pass.host.index());
        entry.is_some_and(|entry| entry.newcomer.token == pass.token && !entry.is_gone)
    }

    /// The host has subscribed to everything. Whether its places are still its own.
    pub fn ready(&mut self, pass: HostPass) -> bool {
        let is_valid = self.is_valid(pass);
        if is_valid {
            self.hosts[pass.host.index()].is_ready = true;
        }
        is_valid
    }

    /// The token of a host with a valid pass has come or is gone.
    pub fn set_alive(&mut self, host: HostId, is_alive: bool) {
        self.hosts[host.index()].is_alive = is_alive;
    }

    /// Whether the host carries its devices: it is ready, and its token is there.
    pub fn carries(&self, host: HostId) -> bool {
        self.hosts.get(host.index()).is_some_and(Entry::carries)
    }

    /// The hosts that have asked for places more than `patience` before `now` and do not carry them yet.
    pub fn late(&self, now: Instant, patience: Duration) -> Vec<HostId> {
        let is_late = |entry: &&Entry| {
            let is_open = !entry.is_ready && !entry.is_gone;
            is_open && now.saturating_duration_since(entry.newcomer.asked) > patience
        };
        self.hosts
            .iter()
            .filter(is_late)
            .map(|entry| entry.places.host)
            .collect()
    }

    /// The host has gone before the run began: its places are free again.
    pub fn leave(&mut self, host: HostId) -> Option<Places> {
        let places = self.retire(host)?;
        self.free.push((places.first.0, places.count));
        Some(places)
    }

    /// The places of the host are no longer its own.
    pub fn retire(&mut self, host: HostId) -> Option<Places> {
        let entry = self.hosts.get_mut(host.index()).filter(|entry| !entry.is_gone)?;
        entry.is_gone = true;
        Some(entry.places)
    }

    /// The places of `host`, if they are still its own.
    pub fn places(&self, host: HostId) -> Option<Places> {
        let entry = self.hosts.get(host.index()).filter(|entry| !entry.is_gone);
        entry.map(|entry| entry.places)
    }

    /// What `host` calls itself.
    pub fn name(&self, host: HostId) -> &str {
        self.hosts.get(host.index()).map_or("", |entry| &entry.newcomer.name)
    }

    /// Devices that have a place with a living host.
    pub fn taken(&self) -> u32 {
        self.devices - self.free.iter().map(|(_, count)| count).sum::<u32>()
    }

    /// Hosts that carry their devices.
    pub fn carrying(&self) -> usize {
        self.hosts.iter().filter(|entry| entry.carries()).count()
    }

    /// Hosts that have places.
    pub fn placed(&self) -> usize {
        self.hosts.iter().filter(|entry| !entry.is_gone).count()
    }

    /// The hosts of the run, once every device has one and all of them carry theirs.
    pub fn complete(&self) -> Option<Vec<Places>> {
        let living = || self.hosts.iter().filter(|entry| !entry.is_gone);
        (self.taken() == self.devices && living().all(Entry::carries))
            .then(|| living().map(|entry| entry.places).collect())
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need some moment")]
mod tests {
    use super::*;

    fn newcomer(nonce: u64, count: u32) -> Newcomer {
        Newcomer {
            nonce,
            token: Secret::new([nonce as u8; 16]),
            name: format!("host {nonce}"),
            count,
            asked: Instant::now(),
        }
    }

    fn pass(places: Places, nonce: u64) -> HostPass {
        HostPass {
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
        assert_eq!(admission.known(1), Some((a, Secret::new([1; 16]))));
        assert_eq!((admission.known(3), admission.join(newcomer(3, 1))), (None, None));
        for (places, nonce) in [(a, 1), (b, 2)] {
            assert!(admission.ready(pass(places, nonce)));
            assert_eq!(admission.complete(), None, "a token is missing");
            let before = admission.carrying();
            admission.set_alive(places.host, true);
            assert_eq!((admission.carrying(), admission.placed()), (before + 1, 2));
        }
        assert_eq!(admission.complete(), Some(vec![a, b]));
    }

    #[test]
    fn nobody_speaks_for_another_host() {
        let mut admission = Admission::new(10);
        let (a, b) = (
            admission.join(newcomer(1, 5)).expect("free"),
            admission.join(newcomer(2, 5)).expect("free"),
        );
        assert!(!admission.ready(pass(a, 2)) && !admission.is_valid(pass(b, 1)));
        let nobody = Places { host: HostId(9), ..a };
        assert!(!admission.ready(pass(nobody, 1)));
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
        assert_eq!(admission.late(now, patience), []);
        assert_eq!(admission.late(now + patience + patience, patience), [b.host]);
    }

    #[test]
    fn a_host_that_leaves_early_frees_its_places() {
        let mut admission = Admission::new(10);
        let a = admission.join(newcomer(1, 6)).expect("free");
        admission.join(newcomer(2, 4));
        assert_eq!(admission.leave(a.host), Some(a));
        assert_eq!(admission.leave(a.host), None);
        assert!(!admission.ready(pass(a, 1)));
        assert_eq!(admission.taken(), 4);
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
        admission.retire(a.host);
        assert!(!admission.is_valid(pass(a, 1)) && admission.is_valid(pass(b, 2)));
        assert_eq!(admission.name(b.host), "host 2");
    }
}
