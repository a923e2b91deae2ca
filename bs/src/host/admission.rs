//! Before the run: who joins, and gets which devices to carry.

use reveille_common::ids::{DeviceId, HostId};

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

#[derive(Clone, Copy, Debug)]
struct Entry {
    nonce: u64,
    places: Places,
    is_ready: bool,
    /// Looks that have passed since it joined without its being ready.
    waited: u32,
    is_lost: bool,
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

    /// Gives up to `count` places to the host process that drew `nonce`, the same ones if it asks again; `None` when
    /// all devices are taken.
    pub fn join(&mut self, nonce: u64, count: u32) -> Option<Places> {
        if let Some(entry) = self.hosts.iter().find(|e| e.nonce == nonce && !e.is_lost) {
            return Some(entry.places);
        }
        let (first, available) = self.free.pop()?;
        let count = count.clamp(1, available);
        if count < available {
            self.free.push((first + count, available - count));
        }
        let places = Places {
            host: HostId(self.hosts.len() as u32),
            first: DeviceId(first),
            count,
        };
        self.hosts.push(Entry {
            nonce,
            places,
            is_ready: false,
            waited: 0,
            is_lost: false,
        });
        Some(places)
    }

    /// `host` has subscribed to everything. Whether there is such a host and its places are still its own.
    pub fn ready(&mut self, host: HostId) -> bool {
        let entry = self.entry(host).filter(|entry| !entry.is_lost);
        entry.map(|entry| entry.is_ready = true).is_some()
    }

    /// The BS has looked once more: a host that has not become ready within `patience` looks has died on the way, and
    /// its places are free again. Gives those hosts.
    pub fn look(&mut self, patience: u32) -> Vec<HostId> {
        for entry in self.hosts.iter_mut().filter(|entry| !entry.is_ready && !entry.is_lost) {
            entry.waited += 1;
        }
        let late = self
            .hosts
            .iter()
            .filter(|entry| !entry.is_ready && !entry.is_lost && entry.waited > patience);
        let late: Vec<HostId> = late.map(|entry| entry.places.host).collect();
        for host in &late {
            self.leave(*host);
        }
        late
    }

    /// `host` has gone before the run began: its places are free again.
    pub fn leave(&mut self, host: HostId) -> Option<Places> {
        let entry = self.entry(host).filter(|entry| !entry.is_lost)?;
        entry.is_lost = true;
        let places = entry.places;
        self.free.push((places.first.0, places.count));
        Some(places)
    }

    /// The places of `host`, if they are still its own.
    pub fn places(&self, host: HostId) -> Option<Places> {
        let entry = self.hosts.get(host.index()).filter(|entry| !entry.is_lost);
        entry.map(|entry| entry.places)
    }

    /// Devices that have a place with a living host.
    pub fn taken(&self) -> u32 {
        self.devices - self.free.iter().map(|(_, count)| count).sum::<u32>()
    }

    /// The hosts of the run, once every device has one and all are ready.
    pub fn complete(&self) -> Option<Vec<Places>> {
        let living = || self.hosts.iter().filter(|entry| !entry.is_lost);
        (self.taken() == self.devices && living().all(|entry| entry.is_ready))
            .then(|| living().map(|entry| entry.places).collect())
    }

    fn entry(&mut self, host: HostId) -> Option<&mut Entry> {
        self.hosts.get_mut(host.index())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_given_once_and_again_to_the_same_asker() {
        let mut admission = Admission::new(10);
        let a = admission.join(1, 4).expect("free");
        let b = admission.join(2, 100).expect("free");
        assert_eq!((a.first, a.count, b.first, b.count), (DeviceId(0), 4, DeviceId(4), 6));
        assert_eq!(admission.join(1, 4), Some(a));
        assert_eq!(admission.join(3, 1), None);
        assert_eq!(admission.complete(), None);
        assert!(admission.ready(a.host) && admission.ready(b.host));
        assert!(!admission.ready(HostId(9)));
        assert_eq!(admission.complete(), Some(vec![a, b]));
    }

    #[test]
    fn a_host_that_never_becomes_ready_loses_its_places() {
        let mut admission = Admission::new(10);
        let (a, b) = (admission.join(1, 5).expect("free"), admission.join(2, 5).expect("free"));
        admission.ready(a.host);
        assert_eq!(admission.look(1), []);
        assert_eq!(admission.look(1), [b.host]);
        assert_eq!((admission.look(1), admission.taken()), (vec![], 5));
    }

    #[test]
    fn a_host_that_leaves_early_frees_its_places() {
        let mut admission = Admission::new(10);
        let a = admission.join(1, 6).expect("free");
        admission.join(2, 4);
        assert_eq!(admission.leave(a.host), Some(a));
        assert_eq!(admission.leave(a.host), None);
        assert!(!admission.ready(a.host));
        assert_eq!(admission.taken(), 4);
        let again = admission.join(3, 6).expect("free");
        assert_eq!((again.first, again.count, again.host), (a.first, 6, HostId(2)));
    }
}
