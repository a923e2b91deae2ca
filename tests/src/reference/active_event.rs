//! An event of the reference while it lasts: what its end records.

use reveille_common::geometry::Point;
use reveille_common::score::EventActivity;
use reveille_common::totals::EventTally;

use super::detection::Obstacle;
use super::policy::Reporter;

/// An event that lasts, and its sums so far.
#[derive(Clone, Debug)]
pub(super) struct ActiveEvent {
    pub(super) epicentre: Point,
    pub(super) start: u64,
    pub(super) duration: u64,
    pub(super) tally: EventTally,
    pub(super) information: f64,
    /// TTIs from the first report to the last.
    pub(super) wake_up_span: u64,
    /// The obstacle met that is closest to a report.
    pub(super) furthest_obstacle: Option<Obstacle>,
    /// Contributions of devices to [`super::ReferenceRun::activity`], if the event counts.
    pub(super) activity: Vec<(usize, EventActivity)>,
    /// Devices whose reports had information. All are of this TTI: the event ends in the TTI of its first report.
    pub(super) reporters: Vec<Reporter>,
}

impl ActiveEvent {
    /// Records an obstacle to a report.
    pub(super) fn meet(&mut self, obstacle: Obstacle) {
        self.furthest_obstacle = self.furthest_obstacle.max(Some(obstacle));
    }
}
