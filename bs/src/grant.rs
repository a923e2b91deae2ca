//! What the clock grants.

use reveille_common::event::Stimulus;
use reveille_common::ids::Tti;

/// The TTIs that the devices may go through next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grant {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI; only in this one can a device have anything to report.
    pub last: Tti,
    /// What the world shows in `last`, if any device might react to it.
    pub stimulus: Option<Stimulus>,
    /// The last TTI in which it would show that.
    pub until: Tti,
}
