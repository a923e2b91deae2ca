//! Removed hosts, whose devices are no longer part of the run (`--on-loss continue`).

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::DeviceRemoval;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::admission::Assignment;
use super::error::BsError;
use super::failover::ReplaySource;

/// A removed host, with the energy totals of its devices.
struct RemovedHost {
    places: Assignment,
    /// The TTI in which its devices were removed, unless they were removed before.
    tti: Tti,
    /// The totals of its devices, computed once their ledgers are closed.
    sums: Option<DeviceTotals>,
}

/// All removed hosts. A replay supplies the ledgers of their devices.
pub(super) struct RemovedHosts {
    replay: Option<Arc<dyn ReplaySource>>,
    lost: Vec<RemovedHost>,
}

impl RemovedHosts {
    /// Creates an empty list.
    pub(super) const fn new(replay: Option<Arc<dyn ReplaySource>>) -> Self {
        let lost = Vec::new();
        Self { replay, lost }
    }

    fn replay(&self) -> Result<&dyn ReplaySource, BsError> {
        let none = || BsError::CannotContinue("no replay is available for the ledgers of lost devices".to_owned());
        self.replay.as_deref().ok_or_else(none)
    }

    /// Adds a host with this assignment, lost in the open TTI. From now on this list accounts for all its devices,
    /// including those removed before the run was resumed.
    pub(super) fn add(&mut self, places: Assignment, tti: Tti) {
        let sums = None;
        self.lost.push(RemovedHost { places, tti, sums });
    }

    /// Stores the removal of devices of a removed host.
    pub(super) fn begin(&self, outage: &DeviceRemoval) -> Result<(), BsError> {
        self.replay()?.record_removal(outage).map_err(BsError::CannotContinue)
    }

    /// Returns the totals before TTI `k` over all devices of removed hosts.
    pub(super) fn sums(&mut self, k: Tti) -> Result<DeviceTotals, BsError> {
        let mut all = DeviceTotals::default();
        for at in 0..self.lost.len() {
            let RemovedHost { places, tti, sums } = &self.lost[at];
            all += if let Some(sums) = sums {
                *sums
            } else {
                // Once the TTI of the loss is closed the ledgers never change, so one replay serves all later windows.
                let (is_closed, ledgers) = (*tti < k, self.ledgers(k, places.first, places.count)?);
                let sums = ledgers.iter().map(|ledger| ledger.whole).sum();
                self.lost[at].sums = is_closed.then_some(sums);
                sums
            };
        }
        Ok(all)
    }

    /// Returns the ledgers before TTI `k` of all devices of removed hosts.
    pub(super) fn all_ledgers(&self, k: Tti) -> Result<Vec<(DeviceId, Ledger)>, BsError> {
        let mut all = Vec::new();
        for RemovedHost { places, .. } in &self.lost {
            let ledgers = self.ledgers(k, places.first, places.count)?;
            all.extend((places.first.0..).map(DeviceId).zip(ledgers));
        }
        Ok(all)
    }

    /// Returns the ledgers before TTI `k` of `count` devices, starting with `first`.
    pub(super) fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, BsError> {
        let replay = self.replay()?;
        // A replay can take long; tokio moves the other tasks of this thread to another one.
        tokio::task::block_in_place(|| replay.ledgers(k, first, count)).map_err(BsError::CannotContinue)
    }
}
