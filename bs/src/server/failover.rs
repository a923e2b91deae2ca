//! Failover: the lost hosts, until they return, another host takes over their devices, or they are removed.
//!
//! `ServerState::mark_lost` adds lost hosts, `failure_detection` starts their replays, `join` offers their devices to
//! new hosts, and the run loop grants no TTI while a host is listed here. Without I/O: the caller holds the lock and
//! passes the time.

use std::sync::Arc;
use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{DeviceCheckpoint, DeviceRange, DeviceRemoval, HostCheckpoint, OperatorAction};
use reveille_common::totals::Ledger;

use super::admission::Assignment;
use crate::cycle::RunOutcome;
use crate::policy::external::RecordedDecision;

/// Time between two warnings about the same loss.
const WARNING_INTERVAL: Duration = Duration::from_secs(30);

/// A replay of the run, which knows all devices at any TTI: their behaviour follows from the scenario, the seed and the
/// external inputs. Every input before TTI `k` must be recorded before a question about `k`. All methods block; the
/// `record_*` methods also write the input log. `deploy/src/audit.rs` implements it.
pub trait ReplaySource: Send + Sync {
    /// Returns the checkpoints of `count` devices, starting with `first`, before TTI `k`. May take as long as running
    /// the first `k` TTIs in memory.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn device_checkpoints(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<DeviceCheckpoint>, String>;

    /// Returns the outcome of the run before TTI `k`.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn outcome(&self, k: Tti) -> Result<RunOutcome, String>;

    /// Returns the ledgers of `count` devices, starting with `first`, before TTI `k`.
    ///
    /// # Errors
    /// Returns the reason if there is no such state.
    fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, String>;

    /// Stores the removal of devices in the open TTI, for later replays, before it returns.
    ///
    /// # Errors
    /// Returns the reason if it cannot be stored.
    fn record_removal(&self, removal: &DeviceRemoval) -> Result<(), String>;

    /// Stores a decision of a policy process, for later replays, before it returns.
    ///
    /// # Errors
    /// Returns the reason if it cannot be stored.
    fn record_decision(&self, decision: RecordedDecision) -> Result<(), String>;

    /// Stores actions in TTIs that are not granted yet, for later replays, before it returns.
    ///
    /// # Errors
    /// Returns the reason if they cannot be stored.
    fn record_actions(&self, actions: &[OperatorAction]) -> Result<(), String>;
}

/// A lost host whose devices wait for a takeover.
#[derive(Clone, Debug)]
struct PendingTakeover {
    assignment: Assignment,
    /// The name of its process, which can have several hosts.
    process: String,
    /// The time at which the host was lost.
    lost_at: Instant,
    /// The time at which the first of the lost hosts of the process was lost.
    process_lost_at: Instant,
    /// The time of the last warning about the loss.
    warned_at: Option<Instant>,
    /// The TTI for which a replay was requested, if any.
    replay_tti: Option<Tti>,
    /// The result of that replay.
    checkpoint: Option<Arc<HostCheckpoint>>,
    /// The new host that is to take over the devices and is not ready yet.
    reserved_for: Option<HostId>,
}

/// All lost hosts, and the durations of past losses of processes.
#[derive(Clone, Debug, Default)]
pub struct LostHosts {
    pending: Vec<PendingTakeover>,
    loss_durations: Vec<Duration>,
}

impl LostHosts {
    /// Adds a lost host of `process` with this assignment. Returns false if it is known already.
    pub fn add(&mut self, assignment: Assignment, process: &str, now: Instant) -> bool {
        if self.position(assignment.host).is_some() {
            return false;
        }
        self.pending.push(PendingTakeover {
            assignment,
            process: process.to_owned(),
            lost_at: now,
            process_lost_at: self.pending_of(process).map_or(now, |first| first.process_lost_at),
            warned_at: None,
            replay_tti: None,
            checkpoint: None,
            reserved_for: None,
        });
        true
    }

    /// Whether no host is lost.
    pub fn is_empty(&self) -> bool {
        self.pending.is_empty()
    }

    /// The assignments of the lost hosts.
    pub fn assignments(&self) -> impl Iterator<Item = Assignment> + '_ {
        self.pending.iter().map(|takeover| takeover.assignment)
    }

    /// Returns the losses that are due for a warning at `now`. A new loss is due immediately and has no duration, an
    /// older one is due every `WARNING_INTERVAL`.
    pub fn take_due_warnings(&mut self, now: Instant) -> Vec<(Assignment, Option<Duration>)> {
        let is_due = |takeover: &&mut PendingTakeover| {
            let last_warning = takeover.warned_at;
            last_warning.is_none_or(|at| now.saturating_duration_since(at) >= WARNING_INTERVAL)
        };
        let due = self.pending.iter_mut().filter(is_due);
        due.map(|takeover| {
            let earlier_warning = takeover.warned_at.replace(now);
            let duration = earlier_warning.map(|_| now.saturating_duration_since(takeover.lost_at));
            (takeover.assignment, duration)
        })
        .collect()
    }

    /// Returns the assignment of a host that was lost at least `limit` before `now`; `None` without such a host.
    pub fn find_lost_for(&self, limit: Duration, now: Instant) -> Option<Assignment> {
        let is_over = |takeover: &&PendingTakeover| now.saturating_duration_since(takeover.lost_at) >= limit;
        self.pending.iter().find(is_over).map(|takeover| takeover.assignment)
    }

    /// Returns the assignments for which no replay was requested, and records a request for TTI `next`.
    pub fn request_replays(&mut self, next: Tti) -> Vec<Assignment> {
        let without_request = self.pending.iter_mut().filter(|takeover| takeover.replay_tti.is_none());
        without_request
            .map(|takeover| {
                takeover.replay_tti = Some(next);
                takeover.assignment
            })
            .collect()
    }

    /// Sets the checkpoint that a replay found for the devices of `host`. Ignores a result for an earlier loss: its TTI
    /// differs from the last one passed to [`Self::request_replays`].
    pub fn set_checkpoint(&mut self, host: HostId, checkpoint: HostCheckpoint) {
        // A host can return and be lost again in a later TTI; a result for the earlier TTI is stale.
        if let Some(index) = self
            .position(host)
            .filter(|&index| self.pending[index].replay_tti == Some(checkpoint.at.next))
        {
            self.pending[index].checkpoint = Some(Arc::new(checkpoint));
        }
    }

    /// Returns the largest lost assignment of at most `offered_devices` devices that has a checkpoint and is not
    /// reserved.
    pub fn find_takeover(&self, offered_devices: u32) -> Option<(Assignment, Arc<HostCheckpoint>)> {
        // The roster replaces a host as a whole, so devices of one lost host are never shared between newcomers.
        let fitting = self
            .restorable()
            .filter(|(assignment, _)| assignment.count <= offered_devices);
        fitting.max_by_key(|(assignment, _)| assignment.count)
    }

    /// Returns the lost assignment of exactly the devices of `range`, as [`Self::find_takeover`] does.
    pub fn find_takeover_of(&self, range: DeviceRange) -> Option<(Assignment, Arc<HostCheckpoint>)> {
        self.restorable().find(|(assignment, _)| assignment.devices() == range)
    }

    /// The lost assignments that have a checkpoint and are not reserved.
    fn restorable(&self) -> impl Iterator<Item = (Assignment, Arc<HostCheckpoint>)> + '_ {
        let unreserved = self.pending.iter().filter(|takeover| takeover.reserved_for.is_none());
        unreserved.filter_map(|takeover| Some((takeover.assignment, Arc::clone(takeover.checkpoint.as_ref()?))))
    }

    /// Returns the assignment that the new host `host` is to take over, with its checkpoint.
    pub fn reservation_of(&self, host: HostId) -> Option<(Assignment, Arc<HostCheckpoint>)> {
        let takeover = self
            .pending
            .iter()
            .find(|takeover| takeover.reserved_for == Some(host))?;
        Some((takeover.assignment, Arc::clone(takeover.checkpoint.as_ref()?)))
    }

    /// Reserves the devices of `lost`, found by [`Self::find_takeover`], for `newcomer`.
    pub fn reserve(&mut self, lost: HostId, newcomer: HostId) {
        if let Some(index) = self.position(lost) {
            self.pending[index].reserved_for = Some(newcomer);
        }
    }

    /// Cancels the reservations for `newcomer`.
    pub fn cancel_reservation(&mut self, newcomer: HostId) {
        for takeover in self
            .pending
            .iter_mut()
            .filter(|takeover| takeover.reserved_for == Some(newcomer))
        {
            takeover.reserved_for = None;
        }
    }

    /// Drops the lost host `host`, so that no host takes over its devices. [`Self::loss_durations`] leaves it out.
    pub fn drop_host(&mut self, host: HostId) {
        self.pending.retain(|takeover| takeover.assignment.host != host);
    }

    /// Ends the loss of a host that has returned. Returns the new host that was to take over its devices, if any; the
    /// outer `None` if the host is not lost.
    pub fn end_loss(&mut self, host: HostId, now: Instant) -> Option<Option<HostId>> {
        let index = self.position(host)?;
        Some(self.remove_pending(index, now).reserved_for)
    }

    /// Completes the takeover by `newcomer`. Returns the assignment of the lost host, and the time for which its
    /// devices had no host.
    pub fn complete_takeover(&mut self, newcomer: HostId, now: Instant) -> Option<(Assignment, Duration)> {
        let index = self
            .pending
            .iter()
            .position(|takeover| takeover.reserved_for == Some(newcomer))?;
        let takeover = self.remove_pending(index, now);
        Some((takeover.assignment, now.saturating_duration_since(takeover.lost_at)))
    }

    /// Duration of each loss of a process. It ends with the return or the takeover of the last of its hosts.
    pub fn loss_durations(&self) -> &[Duration] {
        &self.loss_durations
    }

    fn remove_pending(&mut self, index: usize, now: Instant) -> PendingTakeover {
        let takeover = self.pending.swap_remove(index);
        if self.pending_of(&takeover.process).is_none() {
            self.loss_durations
                .push(now.saturating_duration_since(takeover.process_lost_at));
        }
        takeover
    }

    fn pending_of(&self, process: &str) -> Option<&PendingTakeover> {
        self.pending.iter().find(|takeover| takeover.process == process)
    }

    fn position(&self, host: HostId) -> Option<usize> {
        self.pending
            .iter()
            .position(|takeover| takeover.assignment.host == host)
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need an instant")]
mod tests {
    use reveille_common::message::ResumePoint;

    use super::*;

    fn assignment(host: u32, first: u32, count: u32) -> Assignment {
        Assignment {
            host: HostId(host),
            first: DeviceId(first),
            count,
        }
    }

    fn checkpoint() -> HostCheckpoint {
        HostCheckpoint {
            at: ResumePoint {
                next: Tti(7),
                plan_from: None,
            },
            devices: Vec::new(),
        }
    }

    #[test]
    fn a_new_host_takes_over_the_largest_assignment_that_fits_once_its_checkpoint_is_known() {
        let mut lost_hosts = LostHosts::default();
        let now = Instant::now();
        assert!(lost_hosts.add(assignment(0, 0, 5), "a", now) && lost_hosts.add(assignment(1, 5, 9), "b", now));
        assert!(!lost_hosts.add(assignment(0, 0, 5), "a", now), "a loss counts once");
        assert_eq!(lost_hosts.request_replays(Tti(7)).len(), 2);
        assert!(lost_hosts.request_replays(Tti(7)).is_empty() && lost_hosts.find_takeover(20).is_none());
        lost_hosts.set_checkpoint(HostId(0), checkpoint());
        lost_hosts.set_checkpoint(HostId(1), checkpoint());
        assert_eq!(lost_hosts.find_takeover(4).map(|(found, _)| found), None);
        assert_eq!(
            lost_hosts.find_takeover(8).map(|(found, _)| found),
            Some(assignment(0, 0, 5))
        );
        assert_eq!(
            lost_hosts.find_takeover(9).map(|(found, _)| found),
            Some(assignment(1, 5, 9))
        );
        let found_range = |lost_hosts: &LostHosts, first, count| {
            let first = DeviceId(first);
            let found = lost_hosts.find_takeover_of(DeviceRange { first, count });
            found.map(|(found, _)| found)
        };
        assert_eq!(found_range(&lost_hosts, 5, 9), Some(assignment(1, 5, 9)));
        assert_eq!(found_range(&lost_hosts, 5, 8), None, "only the whole range");
        lost_hosts.reserve(HostId(1), HostId(2));
        assert_eq!(found_range(&lost_hosts, 5, 9), None, "it is reserved");
        assert_eq!(
            lost_hosts.find_takeover(9).map(|(found, _)| found),
            Some(assignment(0, 0, 5))
        );
        lost_hosts.cancel_reservation(HostId(2));
        assert_eq!(
            lost_hosts.find_takeover(9).map(|(found, _)| found),
            Some(assignment(1, 5, 9))
        );
        lost_hosts.reserve(HostId(1), HostId(3));
        let second = Duration::from_secs(1);
        assert_eq!(
            lost_hosts.complete_takeover(HostId(3), now + second),
            Some((assignment(1, 5, 9), second))
        );
        assert_eq!(lost_hosts.assignments().collect::<Vec<_>>(), [assignment(0, 0, 5)]);
        assert_eq!(lost_hosts.loss_durations(), [second]);
    }

    #[test]
    fn each_loss_is_reported_at_once_and_at_intervals_until_its_limit() {
        let mut lost_hosts = LostHosts::default();
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        lost_hosts.add(assignment(0, 0, 5), "a", start);
        let first = lost_hosts.take_due_warnings(start + second);
        assert_eq!(first, [(assignment(0, 0, 5), None)]);
        lost_hosts.add(assignment(1, 5, 5), "b", start + 2 * second);
        let warned: Vec<_> = lost_hosts.take_due_warnings(start + 2 * second);
        assert_eq!(warned, [(assignment(1, 5, 5), None)]);
        let repeated = lost_hosts.take_due_warnings(start + second + WARNING_INTERVAL);
        assert_eq!(repeated, [(assignment(0, 0, 5), Some(second + WARNING_INTERVAL))]);
        let limit = 10 * second;
        assert_eq!(lost_hosts.find_lost_for(limit, start + 9 * second), None);
        assert_eq!(
            lost_hosts.find_lost_for(limit, start + limit),
            Some(assignment(0, 0, 5))
        );
        lost_hosts.end_loss(HostId(0), start + limit);
        assert_eq!(lost_hosts.find_lost_for(limit, start + limit + second), None);
    }

    #[test]
    fn the_loss_of_a_process_counts_once_until_all_its_hosts_are_replaced() {
        let mut lost_hosts = LostHosts::default();
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        lost_hosts.add(assignment(0, 0, 5), "a", start);
        lost_hosts.add(assignment(1, 5, 5), "b", start + second);
        lost_hosts.add(assignment(2, 10, 5), "a", start + second);
        lost_hosts.end_loss(HostId(0), start + 2 * second);
        assert!(
            lost_hosts.loss_durations().is_empty(),
            "process a has another lost host"
        );
        lost_hosts.request_replays(Tti(7));
        lost_hosts.set_checkpoint(HostId(2), checkpoint());
        lost_hosts.reserve(HostId(2), HostId(3));
        lost_hosts.complete_takeover(HostId(3), start + 3 * second);
        assert_eq!(lost_hosts.loss_durations(), [3 * second]);
        lost_hosts.end_loss(HostId(1), start + 5 * second);
        assert_eq!(lost_hosts.loss_durations(), [3 * second, 4 * second]);
    }

    #[test]
    fn a_host_that_returns_keeps_its_devices() {
        let mut lost_hosts = LostHosts::default();
        let now = Instant::now();
        lost_hosts.add(assignment(0, 0, 5), "a", now);
        lost_hosts.request_replays(Tti(7));
        lost_hosts.set_checkpoint(HostId(0), checkpoint());
        lost_hosts.reserve(HostId(0), HostId(1));
        assert_eq!(lost_hosts.end_loss(HostId(0), now), Some(Some(HostId(1))));
        assert_eq!(lost_hosts.end_loss(HostId(0), now), None);
        assert!(lost_hosts.is_empty() && lost_hosts.complete_takeover(HostId(1), now).is_none());
        lost_hosts.add(assignment(0, 0, 5), "a", now);
        lost_hosts.request_replays(Tti(9));
        lost_hosts.set_checkpoint(HostId(0), checkpoint());
        assert!(
            lost_hosts.find_takeover(9).is_none(),
            "the checkpoint belongs to the first loss"
        );
    }
}
