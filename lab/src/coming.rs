//! The outages that are to come in a run.

use std::collections::VecDeque;

use reveille_common::ids::Tti;
use reveille_common::message::Outage;

/// Outages that have not come yet, in the order in which they do.
#[derive(Clone, Debug, Default)]
pub struct Coming(VecDeque<Outage>);

impl Coming {
    /// One more, after all that were added before.
    pub fn add(&mut self, outage: Outage) {
        self.0.push_back(outage);
    }

    /// The TTI in which the next comes, [`Tti::NEVER`] after the last.
    pub fn next_tti(&self) -> Tti {
        self.0.front().map_or(Tti::NEVER, |outage| outage.tti)
    }

    /// Whether all have come.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The next, if it comes in TTI `k` before anybody senses, or before the wake-up with this number in it.
    pub fn due(&mut self, k: Tti, wake_up: Option<u32>) -> Option<Outage> {
        let is_due = |next: &&Outage| next.tti == k && next.wake_ups == wake_up;
        self.0.front().filter(is_due)?;
        self.0.pop_front()
    }
}
