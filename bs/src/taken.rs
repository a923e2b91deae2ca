//! A run that is taken up in its middle.

use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Checkpoint, Resumption};
use reveille_common::score::Accounts;
use reveille_common::state::DeviceView;

use crate::cycle::Cycle;

/// Where a run is taken up that is not at its beginning.
pub struct Start {
    /// The TTI to be granted next.
    pub next: Tti,
    /// The TTI from which the plan in force holds.
    pub plan: Option<Tti>,
    /// All devices, in the order of ids.
    pub devices: Vec<Checkpoint>,
}

impl Start {
    /// The devices from `first` on, `count` of them.
    pub fn resumption(&self, first: DeviceId, count: u32) -> Resumption {
        Resumption {
            next: self.next,
            plan: self.plan,
            devices: self.devices[first.index()..][..count as usize].to_vec(),
        }
    }
}

/// A run that was brought to some TTI without the bus.
pub struct Taken {
    /// Its world, base station and score.
    pub cycle: Cycle,
    /// The sums up to the last boundary.
    pub accounts: Accounts,
    /// Where hosts take up its devices.
    pub start: Arc<Start>,
    /// The devices at the end of the last TTI, in the order of ids.
    pub views: Vec<DeviceView>,
}
