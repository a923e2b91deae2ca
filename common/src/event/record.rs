//! What came of an event.

use serde::{Deserialize, Serialize};

use crate::geometry::Point;
use crate::ids::{EventId, Tti};
use crate::totals::EventTally;

/// One ended event, for the per-event series.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EventRecord {
    /// Its number.
    pub event: EventId,
    /// Its place.
    pub epicentre: Point,
    /// Its first TTI.
    pub start: Tti,
    /// Its last TTI.
    pub last: Tti,
    /// Whether it counts in the metrics.
    pub counted: bool,
    /// What it came to.
    pub tally: EventTally,
}

impl EventRecord {
    /// TTIs from its start to its first report, 0 for the same TTI; `None` if it was missed. It ends with its first
    /// report.
    pub fn delay(&self) -> Option<u64> {
        (self.tally.reports > 0).then(|| self.last - self.start)
    }
}
