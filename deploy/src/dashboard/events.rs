//! The ended events of a run, for the timeline, the search for misses and the heat layers of the map. `feed` adds them.
//! Events of the warm-up are included. `page/*.js` uses the JSON keys.

use std::collections::VecDeque;

use reveille_common::event::EventRecord;
use reveille_common::geometry::Point;
use reveille_common::ids::Tti;
use serde_json::{Value, json};

/// Most events in one answer.
const MAX_EVENTS: usize = 2_000;

/// The ended events of the available TTIs, and the numbers of ended events nearest to each device since TTI 0.
pub(super) struct EventLog {
    records: VecDeque<EventRecord>,
    positions: Vec<Point>,
    /// Number of events whose nearest device this is, by device.
    near_counts: Vec<u32>,
    /// Number of misdetections among them, by device.
    near_miss_counts: Vec<u32>,
}

impl EventLog {
    /// Creates the log of a run with devices at `positions`.
    pub(super) fn new(positions: Vec<Point>) -> Self {
        Self {
            records: VecDeque::new(),
            near_counts: vec![0; positions.len()],
            near_miss_counts: vec![0; positions.len()],
            positions,
        }
    }

    /// Adds an event that has ended; call it in the order of the ends. Drops events that ended before `first`.
    pub(super) fn push(&mut self, record: EventRecord, first: Tti) {
        while self.records.front().is_some_and(|oldest| oldest.last < first) {
            self.records.pop_front();
        }
        let distance = |device: &usize| self.positions[*device].distance(record.epicentre);
        let nearest = (0..self.positions.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(device) = nearest {
            self.near_counts[device] += 1;
            self.near_miss_counts[device] += u32::from(record.delay().is_none());
        }
        self.records.push_back(record);
    }

    /// The events that overlap the TTIs from `from` up to but excluding `end`; the latest ones if there are too many.
    pub(super) fn overlapping(&self, from: Tti, end: Tti) -> Value {
        // At most one event is active at a time, so the starts of `records` are in order, and their ends too.
        let first_index = self.records.partition_point(|record| record.last < from);
        let end_index = self
            .records
            .partition_point(|record| record.start < end)
            .max(first_index);
        let first_index = first_index.max(end_index.saturating_sub(MAX_EVENTS));
        json!(
            self.records
                .range(first_index..end_index)
                .map(event_json)
                .collect::<Vec<_>>()
        )
    }

    /// The first misdetection that starts after TTI `tti`.
    pub(super) fn miss_after(&self, tti: Tti) -> Option<Value> {
        let first_index = self.records.partition_point(|record| record.start <= tti);
        let mut later = self.records.range(first_index..);
        later.find(|record| record.delay().is_none()).map(event_json)
    }

    /// The last misdetection that starts before TTI `tti`.
    pub(super) fn miss_before(&self, tti: Tti) -> Option<Value> {
        let end_index = self.records.partition_point(|record| record.start < tti);
        let mut earlier = self.records.range(..end_index).rev();
        earlier.find(|record| record.delay().is_none()).map(event_json)
    }

    /// By device: the number of ended events since TTI 0 to which it is the nearest device, and how many of these were
    /// missed.
    pub(super) fn counts(&self) -> (&[u32], &[u32]) {
        (&self.near_counts, &self.near_miss_counts)
    }
}

fn event_json(record: &EventRecord) -> Value {
    json!({
        "event": record.event,
        "start": record.start,
        "last": record.last,
        "epicentre": record.epicentre,
        "counted": record.counted,
        "delay": record.delay(),
        "reports": record.tally.reports,
        "wake_ups": record.tally.wake_ups,
        "information": record.tally.information(),
    })
}

#[cfg(test)]
mod tests {
    use reveille_common::ids::EventId;
    use reveille_common::totals::EventTally;

    use super::*;

    fn record(start: u64, last: u64, x: f64, reports: u64) -> EventRecord {
        EventRecord {
            event: EventId(start),
            epicentre: Point::new(x, 0.0),
            start: Tti(start),
            last: Tti(last),
            counted: true,
            tally: EventTally {
                reports,
                ..EventTally::default()
            },
            miss_cause: None,
        }
    }

    #[test]
    fn misses_are_found_in_both_directions() {
        let mut log = EventLog::new(vec![Point::new(0.0, 0.0), Point::new(10.0, 0.0)]);
        for (start, x, reports) in [(5, 1.0, 0), (10, 9.0, 2), (20, 9.0, 0), (30, 8.0, 0)] {
            log.push(record(start, start + 3, x, reports), Tti(0));
        }
        let start = |event: Option<Value>| event.map(|event| event["start"].clone());
        assert_eq!(start(log.miss_after(Tti(5))), Some(20.into()));
        assert_eq!(start(log.miss_before(Tti(20))), Some(5.into()));
        assert_eq!(start(log.miss_after(Tti(30))), None);
        assert_eq!(start(log.miss_before(Tti(5))), None);
        assert_eq!(log.counts(), (&[1, 3][..], &[1, 2][..]));
        let overlapping = log.overlapping(Tti(13), Tti(20));
        assert_eq!(overlapping.as_array().map(Vec::len), Some(1), "{overlapping}");
        log.push(record(40, 41, 0.0, 1), Tti(15));
        assert_eq!(start(log.miss_before(Tti(40))), Some(30.into()));
        assert_eq!(
            start(log.miss_after(Tti(0))),
            Some(20.into()),
            "the first two are dropped"
        );
    }
}
