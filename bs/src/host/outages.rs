//! Devices whose host was lost, in a run that goes on without them.

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Outage;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::admission::Places;
use super::error::BsError;
use super::losses::Replay;

/// A host that is lost for good, and what the books of its devices came to.
struct Lost {
    places: Places,
    /// The TTI in which they went, if not before.
    tti: Tti,
    /// Their sums, once they are closed and somebody has asked.
    sums: Option<DeviceTotals>,
}

/// All hosts that the run goes on without. What their devices did before follows from a replay.
pub(super) struct Outages {
    replay: Option<Arc<dyn Replay>>,
    lost: Vec<Lost>,
}

impl Outages {
    /// None so far.
    pub(super) const fn new(replay: Option<Arc<dyn Replay>>) -> Self {
        let lost = Vec::new();
        Self { replay, lost }
    }

    fn replay(&self) -> Result<&dyn Replay, BsError> {
        let none = || BsError::CannotGoOn("there is no replay that knows what lost devices did".to_owned());
        self.replay.as_deref().ok_or_else(none)
    }

    /// A host that carried these places is lost, in the TTI that is open. Nobody else answers for its devices from here
    /// on, those that were gone before the run was taken up among them.
    pub(super) fn lose(&mut self, places: Places, tti: Tti) {
        let sums = None;
        self.lost.push(Lost { places, tti, sums });
    }

    /// Devices of such a host go.
    pub(super) fn begin(&self, outage: &Outage) -> Result<(), BsError> {
        self.replay()?.lose(outage).map_err(BsError::CannotGoOn)
    }

    /// The sums before TTI `k` over all devices of those hosts.
    pub(super) fn sums(&mut self, k: Tti) -> Result<DeviceTotals, BsError> {
        let mut all = DeviceTotals::default();
        for at in 0..self.lost.len() {
            let Lost { places, tti, sums } = &self.lost[at];
            all += if let Some(sums) = sums {
                *sums
            } else {
                let (is_closed, ledgers) = (*tti < k, self.ledgers(k, places.first, places.count)?);
                let sums = ledgers.iter().map(|ledger| ledger.whole).sum();
                self.lost[at].sums = is_closed.then_some(sums);
                sums
            };
        }
        Ok(all)
    }

    /// The ledgers before TTI `k` of all devices of those hosts.
    pub(super) fn all_ledgers(&self, k: Tti) -> Result<Vec<(DeviceId, Ledger)>, BsError> {
        let mut all = Vec::new();
        for Lost { places, .. } in &self.lost {
            let ledgers = self.ledgers(k, places.first, places.count)?;
            all.extend((places.first.0..).map(DeviceId).zip(ledgers));
        }
        Ok(all)
    }

    /// The ledgers before TTI `k` of the devices from `first` on, `count` of them.
    pub(super) fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, BsError> {
        let replay = self.replay()?;
        tokio::task::block_in_place(|| replay.ledgers(k, first, count)).map_err(BsError::CannotGoOn)
    }
}
