//! Lost hosts, until they return or another host takes over their devices.

use std::sync::Arc;
use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceRemoval, HostCheckpoint};
use reveille_common::totals::Ledger;

use super::admission::Assignment;
use crate::cycle::Outcome;
use crate::policy::external::RecordedDecision;

/// A replay of the run, which knows all devices at any TTI: their behaviour follows from the scenario, the seed and the
/// external inputs.
pub trait ReplaySource: Send + Sync {
    /// Returns the checkpoints of `count` devices, starting with `first`, before TTI `k`. May take as long as running
    /// the first `k` TTIs in memory.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn devices(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<DeviceCheckpoint>, String>;

    /// Returns the outcome of the run before TTI `k`.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn outcome(&self, k: Tti) -> Result<Outcome, String>;

    /// Returns the ledgers of `count` devices, starting with `first`, before TTI `k`.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, String>;

    /// Stores the removal of devices in the open TTI, for later replays, before it returns.
    ///
    /// # Errors
    /// Returns the reason if it cannot be stored.
    fn record_removal(&self, outage: &DeviceRemoval) -> Result<(), String>;

    /// Stores a decision of a policy process, for later replays, before it returns.
    ///
    /// # Errors
    /// Returns the reason if it cannot be stored.
    fn decided(&self, decision: RecordedDecision) -> Result<(), String>;
}

/// A lost host whose devices wait for a takeover.
#[derive(Clone, Debug)]
struct PendingTakeover {
    places: Assignment,
    since: Instant,
    /// The TTI for which a replay was requested.
    asked: Option<Tti>,
    resumption: Option<Arc<HostCheckpoint>>,
    /// The new host that is to take over the devices and is not ready yet.
    offered: Option<HostId>,
}

/// All lost hosts, and the durations of past losses.
#[derive(Clone, Debug, Default)]
pub struct LostHosts {
    open: Vec<PendingTakeover>,
    recovered: Vec<Duration>,
}

impl LostHosts {
    /// Adds a lost host with this assignment. Returns false if it is known already.
    pub fn add(&mut self, places: Assignment, now: Instant) -> bool {
        if self.position(places.host).is_some() {
            return false;
        }
        self.open.push(PendingTakeover {
            places,
            since: now,
            asked: None,
            resumption: None,
            offered: None,
        });
        true
    }

    /// Whether no host is lost.
    pub fn is_empty(&self) -> bool {
        self.open.is_empty()
    }

    /// The assignments of the lost hosts.
    pub fn assignments(&self) -> impl Iterator<Item = Assignment> + '_ {
        self.open.iter().map(|vacancy| vacancy.places)
    }

    /// Returns the assignments for which no replay was requested, and records a request for TTI `next`.
    pub fn needing_replay(&mut self, next: Tti) -> Vec<Assignment> {
        let unasked = self.open.iter_mut().filter(|vacancy| vacancy.asked.is_none());
        unasked
            .map(|vacancy| {
                vacancy.asked = Some(next);
                vacancy.places
            })
            .collect()
    }

    /// Sets the checkpoint that a replay found for the devices of `host`. Ignores a result for an earlier loss.
    pub fn set_checkpoint(&mut self, host: HostId, resumption: HostCheckpoint) {
        // A host can return and be lost again in a later TTI; a result for the earlier TTI is outdated.
        if let Some(at) = self
            .position(host)
            .filter(|&at| self.open[at].asked == Some(resumption.at.next))
        {
            self.open[at].resumption = Some(Arc::new(resumption));
        }
    }

    /// Returns the largest lost assignment of at most `count` devices that has a checkpoint and is not reserved.
    pub fn find_takeover(&self, count: u32) -> Option<(Assignment, Arc<HostCheckpoint>)> {
        let free = self
            .open
            .iter()
            // The roster replaces a host as a whole, so devices of one lost host are never shared between newcomers.
            .filter(|v| v.offered.is_none() && v.places.count <= count);
        let ready = free.filter_map(|v| Some((v.places, Arc::clone(v.resumption.as_ref()?))));
        ready.max_by_key(|(places, _)| places.count)
    }

    /// Returns the assignment that the new host `host` is to take over, with its checkpoint.
    pub fn offer_for(&self, host: HostId) -> Option<(Assignment, Arc<HostCheckpoint>)> {
        let vacancy = self.open.iter().find(|vacancy| vacancy.offered == Some(host))?;
        Some((vacancy.places, Arc::clone(vacancy.resumption.as_ref()?)))
    }

    /// Reserves the devices of `lost` for `newcomer`.
    pub fn offer(&mut self, lost: HostId, newcomer: HostId) {
        if let Some(at) = self.position(lost) {
            self.open[at].offered = Some(newcomer);
        }
    }

    /// Cancels the reservations for `newcomer`.
    pub fn decline(&mut self, newcomer: HostId) {
        for vacancy in self.open.iter_mut().filter(|v| v.offered == Some(newcomer)) {
            vacancy.offered = None;
        }
    }

    /// Drops the lost host `host`, so that no host takes over its devices.
    pub fn drop_host(&mut self, host: HostId) {
        self.open.retain(|vacancy| vacancy.places.host != host);
    }

    /// Ends the loss of a host that has returned. Returns the new host that was to take over its devices, if any.
    pub fn restore(&mut self, host: HostId, now: Instant) -> Option<Option<HostId>> {
        let at = self.position(host)?;
        Some(self.close(at, now).offered)
    }

    /// Completes the takeover by `newcomer`. Returns the assignment of the lost host, and the time for which its
    /// devices had no host.
    pub fn complete_takeover(&mut self, newcomer: HostId, now: Instant) -> Option<(Assignment, Duration)> {
        let at = self.open.iter().position(|vacancy| vacancy.offered == Some(newcomer))?;
        let vacancy = self.close(at, now);
        Some((vacancy.places, now.saturating_duration_since(vacancy.since)))
    }

    /// Duration of each loss that is over.
    pub fn recovery_times(&self) -> &[Duration] {
        &self.recovered
    }

    fn close(&mut self, at: usize, now: Instant) -> PendingTakeover {
        let vacancy = self.open.swap_remove(at);
        self.recovered.push(now.saturating_duration_since(vacancy.since));
        vacancy
    }

    fn position(&self, host: HostId) -> Option<usize> {
        self.open.iter().position(|vacancy| vacancy.places.host == host)
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need some moment")]
mod tests {
    use reveille_common::message::ResumePoint;

    use super::*;

    fn places(host: u32, first: u32, count: u32) -> Assignment {
        Assignment {
            host: HostId(host),
            first: DeviceId(first),
            count,
        }
    }

    fn resumption() -> HostCheckpoint {
        HostCheckpoint {
            at: ResumePoint {
                next: Tti(7),
                plan_from: None,
            },
            devices: Vec::new(),
        }
    }

    #[test]
    fn a_newcomer_gets_what_fits_once_it_is_known() {
        let mut losses = LostHosts::default();
        let now = Instant::now();
        assert!(losses.add(places(0, 0, 5), now) && losses.add(places(1, 5, 9), now));
        assert!(!losses.add(places(0, 0, 5), now), "that was known");
        assert_eq!(losses.needing_replay(Tti(7)).len(), 2);
        assert!(losses.needing_replay(Tti(7)).is_empty() && losses.find_takeover(20).is_none());
        losses.set_checkpoint(HostId(0), resumption());
        losses.set_checkpoint(HostId(1), resumption());
        assert_eq!(losses.find_takeover(4).map(|(places, _)| places), None);
        assert_eq!(losses.find_takeover(8).map(|(places, _)| places), Some(places(0, 0, 5)));
        assert_eq!(losses.find_takeover(9).map(|(places, _)| places), Some(places(1, 5, 9)));
        losses.offer(HostId(1), HostId(2));
        assert_eq!(losses.find_takeover(9).map(|(places, _)| places), Some(places(0, 0, 5)));
        losses.decline(HostId(2));
        assert_eq!(losses.find_takeover(9).map(|(places, _)| places), Some(places(1, 5, 9)));
        losses.offer(HostId(1), HostId(3));
        let second = Duration::from_secs(1);
        assert_eq!(
            losses.complete_takeover(HostId(3), now + second),
            Some((places(1, 5, 9), second))
        );
        assert_eq!(losses.assignments().collect::<Vec<_>>(), [places(0, 0, 5)]);
        assert_eq!(losses.recovery_times(), [second]);
    }

    #[test]
    fn a_host_that_is_back_keeps_its_devices() {
        let mut losses = LostHosts::default();
        let now = Instant::now();
        losses.add(places(0, 0, 5), now);
        losses.needing_replay(Tti(7));
        losses.set_checkpoint(HostId(0), resumption());
        losses.offer(HostId(0), HostId(1));
        assert_eq!(losses.restore(HostId(0), now), Some(Some(HostId(1))));
        assert_eq!(losses.restore(HostId(0), now), None);
        assert!(losses.is_empty() && losses.complete_takeover(HostId(1), now).is_none());
        losses.add(places(0, 0, 5), now);
        losses.needing_replay(Tti(9));
        losses.set_checkpoint(HostId(0), resumption());
        assert!(losses.find_takeover(9).is_none(), "that was for the first loss");
    }
}
