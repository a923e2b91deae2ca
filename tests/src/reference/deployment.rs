//! Positions and classes of the devices of a reference run, taken from the emulator. `tests/tests/classes.rs` checks
//! the classes, unit tests of `common/src/geometry/` the positions. Only this file takes rules from the emulator;
//! [`super`] lists what else it shares.

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
    /// Whether devices harvest as the base station expects, in pilot runs: a trace is replaced by its mean, and sun at
    /// an unknown time of day by arrivals. Other sources stay (`ReferenceSource::with_known_harvest`).
    pub(super) has_known_harvest: bool,
}

impl ReferenceDeployment {
    /// Creates the deployment of a run. `search` creates the one of its pilot runs.
    pub(super) fn of(scenario: &Scenario) -> Self {
        Self {
            positions: Deployment::new(scenario).positions(),
            classes: assign_classes(scenario),
            has_known_harvest: false,
        }
    }
}
