//! The devices of a run of the reference, as the emulator deploys them.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::Point;
use reveille_common::scenario::assign_classes;

/// Positions and classes of the devices.
#[derive(Clone, Debug)]
pub(super) struct ReferenceDeployment {
    pub(super) positions: Vec<Point>,
    pub(super) classes: Vec<u16>,
    /// Whether harvest traces are played. Otherwise, as in pilot runs, devices harvest what the base station expects
    /// (`ReferenceSource::with_known_harvest`).
    pub(super) plays_traces: bool,
}

impl ReferenceDeployment {
    pub(super) fn of(scenario: &Scenario) -> Self {
        Self {
            positions: Deployment::new(scenario).positions(),
            classes: assign_classes(scenario),
            plays_traces: true,
        }
    }
}
