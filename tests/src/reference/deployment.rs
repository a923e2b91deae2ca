//! Positions and classes of the devices of a reference run, taken from the emulator. `tests/tests/classes.rs` checks
//! the classes, unit tests of `common/src/geometry/` the positions.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::Point;
use reveille_common::scenario::assign_classes;

/// Positions and classes of the devices, by number.
#[derive(Clone, Debug)]
pub(super) struct ReferenceDeployment {
    pub(super) positions: Vec<Point>,
    /// Indices in `Scenario::classes`.
    pub(super) classes: Vec<u16>,
    /// Whether devices harvest from their traces and the sun. Otherwise, as in pilot runs, they harvest the energy that
    /// the base station expects (`ReferenceSource::with_known_harvest`).
    pub(super) plays_traces: bool,
}

impl ReferenceDeployment {
    /// Creates the deployment of a run, not of its pilot runs.
    pub(super) fn of(scenario: &Scenario) -> Self {
        Self {
            positions: Deployment::new(scenario).positions(),
            classes: assign_classes(scenario),
            plays_traces: true,
        }
    }
}
