//! Devices whose host was lost, in a run that goes on without them.

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Outage;
use reveille_common::totals::{DeviceTotals, Ledger};

use super::error::BsError;
use super::losses::Replay;

/// Devices that are gone, and what their books came to.
struct Gone {
    outage: Outage,
    /// Their sums, once they are closed and somebody has asked.
    sums: Option<DeviceTotals>,
}

/// All devices that are gone. What they did before follows from a replay.
pub(super) struct Outages {
    replay: Option<Arc<dyn Replay>>,
    gone: Vec<Gone>,
}

impl Outages {
    /// None so far.
    pub(super) const fn new(replay: Option<Arc<dyn Replay>>) -> Self {
        let gone = Vec::new();
        Self { replay, gone }
    }

    fn replay(&self) -> Result<&dyn Replay, BsError> {
        let none = || BsError::CannotGoOn("there is no replay that knows what lost devices did".to_owned());
        self.replay.as_deref().ok_or_else(none)
    }

    /// One more, in the TTI that is open.
    pub(super) fn begin(&mut self, outage: Outage) -> Result<(), BsError> {
        self.replay()?.lose(&outage).map_err(BsError::CannotGoOn)?;
        self.gone.push(Gone { outage, sums: None });
        Ok(())
    }

    /// The sums before TTI `k` over all devices that are gone.
    pub(super) fn sums(&mut self, k: Tti) -> Result<DeviceTotals, BsError> {
        let mut all = DeviceTotals::default();
        for at in 0..self.gone.len() {
            let Gone { outage, sums } = &self.gone[at];
            all += if let Some(sums) = sums {
                *sums
            } else {
                let (is_closed, ledgers) = (outage.tti < k, self.ledgers(k, outage.first, outage.count)?);
                let sums = ledgers.iter().map(|ledger| ledger.whole).sum();
                self.gone[at].sums = is_closed.then_some(sums);
                sums
            };
        }
        Ok(all)
    }

    /// The ledgers before TTI `k` of all devices that are gone.
    pub(super) fn all_ledgers(&self, k: Tti) -> Result<Vec<(DeviceId, Ledger)>, BsError> {
        let mut all = Vec::new();
        for Gone { outage, .. } in &self.gone {
            let ledgers = self.ledgers(k, outage.first, outage.count)?;
            all.extend((outage.first.0..).map(DeviceId).zip(ledgers));
        }
        Ok(all)
    }

    /// The ledgers before TTI `k` of the devices from `first` on, `count` of them.
    pub(super) fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, BsError> {
        let replay = self.replay()?;
        tokio::task::block_in_place(|| replay.ledgers(k, first, count)).map_err(BsError::CannotGoOn)
    }
}
