//! Removed hosts, whose devices are no longer part of the run (`--on-loss continue`). A replay supplies the ledgers of
//! these devices, so that totals, final ledgers and thus the digest still cover all devices.

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::DeviceRemoval;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::admission::Assignment;
use super::error::BsError;
use super::failover::ReplaySource;

struct RemovedHost {
    assignment: Assignment,
    /// The TTI in which the host was lost. Its devices left the run then, or before the run was resumed.
    lost_in: Tti,
    /// The totals of its devices, computed once their ledgers are closed.
    totals: Option<DeviceTotals>,
}

/// All removed hosts. A replay supplies the ledgers of their devices; without one every method with a result fails.
pub(super) struct RemovedHosts {
    replay: Option<Arc<dyn ReplaySource>>,
    hosts: Vec<RemovedHost>,
}

impl RemovedHosts {
    /// Creates an empty list.
    pub(super) const fn new(replay: Option<Arc<dyn ReplaySource>>) -> Self {
        let hosts = Vec::new();
        Self { replay, hosts }
    }

    fn replay(&self) -> Result<&dyn ReplaySource, BsError> {
        let no_replay = || BsError::CannotContinue("no replay is available for the ledgers of lost devices".to_owned());
        self.replay.as_deref().ok_or_else(no_replay)
    }

    /// Adds a host with this assignment, lost in the open TTI `lost_in`. From now on this list accounts for all its
    /// devices, including those removed before the run was resumed.
    pub(super) fn add(&mut self, assignment: Assignment, lost_in: Tti) {
        let totals = None;
        self.hosts.push(RemovedHost {
            assignment,
            lost_in,
            totals,
        });
    }

    /// Writes the removal of devices to the input log and adds it to the replay, before the session removes them.
    pub(super) fn log_removal(&self, removal: &DeviceRemoval) -> Result<(), BsError> {
        self.replay()?.record_removal(removal).map_err(BsError::CannotContinue)
    }

    /// Returns the totals before TTI `k` over all devices of removed hosts.
    pub(super) fn totals_before(&mut self, k: Tti) -> Result<DeviceTotals, BsError> {
        let mut sum = DeviceTotals::default();
        for index in 0..self.hosts.len() {
            let RemovedHost {
                assignment,
                lost_in,
                totals,
            } = &self.hosts[index];
            sum += if let Some(totals) = totals {
                *totals
            } else {
                // Once the TTI of the loss is closed the ledgers never change, so one replay serves all later windows.
                let is_closed = *lost_in < k;
                let ledgers = self.ledgers_before(k, assignment.first, assignment.count)?;
                let totals = ledgers.iter().map(|ledger| ledger.whole).sum();
                self.hosts[index].totals = is_closed.then_some(totals);
                totals
            };
        }
        Ok(sum)
    }

    /// Returns the ledgers before TTI `k` of all devices of removed hosts.
    pub(super) fn all_ledgers_before(&self, k: Tti) -> Result<Vec<(DeviceId, Ledger)>, BsError> {
        let mut all_ledgers = Vec::new();
        for RemovedHost { assignment, .. } in &self.hosts {
            let ledgers = self.ledgers_before(k, assignment.first, assignment.count)?;
            all_ledgers.extend((assignment.first.0..).map(DeviceId).zip(ledgers));
        }
        Ok(all_ledgers)
    }

    /// Returns the ledgers before TTI `k` of `count` devices, starting with `first`.
    pub(super) fn ledgers_before(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, BsError> {
        let replay = self.replay()?;
        // A replay can take long; tokio moves the other tasks of this thread to another one.
        tokio::task::block_in_place(|| replay.ledgers(k, first, count)).map_err(BsError::CannotContinue)
    }
}
