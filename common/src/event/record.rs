//! The record of an ended event, for observers, the per-event table and the reference of the tests.
//!
//! [`EventUpdate`](crate::message::EventUpdate) carries it in the wire format, which encodes fields by position: a
//! change of the fields or of their order raises [`WIRE_VERSION`](crate::codec::WIRE_VERSION). The table
//! (`deploy/src/run_tables.rs`) and the dashboard have their own names for its values.

use serde::{Deserialize, Serialize};

use crate::geometry::Point;
use crate::ids::{EventId, Tti};
use crate::totals::{EventTally, MissCause};

/// One ended event, for the per-event table.
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
    /// Whether the metrics count it: false if it starts in the warm-up.
    pub counted: bool,
    /// The activity for it: reports, wake-ups, information and wrong activations.
    pub tally: EventTally,
    /// Why no report arrived; `None` if one did.
    pub miss_cause: Option<MissCause>,
}

impl EventRecord {
    /// TTIs from its start to its first report, which ends it; 0 for the same TTI, `None` if it was missed. A record
    /// from another source may end before it starts, which counts as 0.
    pub fn delay(&self) -> Option<u64> {
        (self.tally.reports > 0).then(|| self.last.0.saturating_sub(self.start.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_delay_counts_ttis_from_the_start_to_the_first_report() {
        let delay = |start, last, reports| {
            let record = EventRecord {
                event: EventId(0),
                epicentre: Point::new(1.0, 2.0),
                start: Tti(start),
                last: Tti(last),
                counted: true,
                tally: EventTally {
                    reports,
                    ..EventTally::default()
                },
                miss_cause: None,
            };
            record.delay()
        };
        assert_eq!(
            (delay(5, 5, 1), delay(5, 8, 3), delay(5, 8, 0)),
            (Some(0), Some(3), None)
        );
        assert_eq!(delay(8, 5, 1), Some(0), "an impossible record does not overflow");
    }
}
