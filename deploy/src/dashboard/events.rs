//! The ended events of a run, for the timeline, the search for misses and the heat layers of the map. `feed` adds them.
//! Events of the warm-up are included. `page/*.js` uses the JSON keys.

use std::collections::VecDeque;

use reveille_common::event::EventRecord;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::EventUpdate;
use reveille_common::totals::MissCause;
use serde_json::{Value, json};

/// Most events in one answer.
const MAX_EVENTS: usize = 2_000;
/// Most events in the list of the last events.
const MAX_LAST_EVENTS: usize = 6;

/// An event that has ended.
struct EndedEvent {
    record: EventRecord,
    /// The nearest device.
    nearest: DeviceId,
    /// Outcomes of the devices, in the order of their messages.
    outcomes: Vec<String>,
}

/// The ended events of the available TTIs, and the numbers of ended events nearest to each device since TTI 0.
pub(super) struct EventLog {
    events: VecDeque<EndedEvent>,
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
            events: VecDeque::new(),
            near_counts: vec![0; positions.len()],
            near_miss_counts: vec![0; positions.len()],
            positions,
        }
    }

    /// Adds an event that has ended, with the outcomes of its devices; call it in the order of the ends. Drops events
    /// that ended before `first`.
    pub(super) fn push(&mut self, record: EventRecord, outcomes: Vec<String>, first: Tti) {
        while self.events.front().is_some_and(|oldest| oldest.record.last < first) {
            self.events.pop_front();
        }
        let distance = |id: &DeviceId| self.positions[id.index()].distance(record.epicentre);
        let ids = (0..).map(DeviceId).take(self.positions.len());
        let nearest = ids.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let nearest = nearest.expect("a run has devices");
        self.near_counts[nearest.index()] += 1;
        self.near_miss_counts[nearest.index()] += u32::from(record.delay().is_none());
        self.events.push_back(EndedEvent {
            record,
            nearest,
            outcomes,
        });
    }

    /// The last events that ended up to TTI `tti`, the latest first.
    pub(super) fn last_events(&self, tti: Tti) -> Value {
        let end_index = self.events.partition_point(|event| event.record.last <= tti);
        let latest = self.events.range(..end_index).rev().take(MAX_LAST_EVENTS);
        json!(
            latest
                .map(|EndedEvent { record, outcomes, .. }| json!({
                    "tti": record.last,
                    "text": EventUpdate::Ended(*record).to_string(),
                    "missed": record.delay().is_none(),
                    "who": outcomes,
                }))
                .collect::<Vec<_>>()
        )
    }

    /// The numbers of counted events and of misdetections among the events that ended up to TTI `tti`.
    pub(super) fn counted_until(&self, tti: Tti) -> (usize, usize) {
        let is_counted = |event: &&EndedEvent| event.record.counted && event.record.last <= tti;
        let counted = self.events.iter().filter(is_counted);
        let missed = counted.clone().filter(|event| event.record.delay().is_none());
        (counted.count(), missed.count())
    }

    /// The events that overlap the TTIs from `from` up to but excluding `end`; the latest ones if there are too many.
    pub(super) fn overlapping(&self, from: Tti, end: Tti) -> Value {
        // At most one event is active at a time, so the starts of `events` are in order, and their ends too.
        let first_index = self.events.partition_point(|event| event.record.last < from);
        let end_index = self
            .events
            .partition_point(|event| event.record.start < end)
            .max(first_index);
        let first_index = first_index.max(end_index.saturating_sub(MAX_EVENTS));
        json!(
            self.events
                .range(first_index..end_index)
                .map(|event| event_json(&event.record))
                .collect::<Vec<_>>()
        )
    }

    /// The first misdetection that starts after TTI `tti`.
    pub(super) fn miss_after(&self, tti: Tti) -> Option<Value> {
        let first_index = self.events.partition_point(|event| event.record.start <= tti);
        let mut later = self.events.range(first_index..).map(|event| &event.record);
        later.find(|record| record.delay().is_none()).map(event_json)
    }

    /// The last misdetection that starts before TTI `tti`.
    pub(super) fn miss_before(&self, tti: Tti) -> Option<Value> {
        let end_index = self.events.partition_point(|event| event.record.start < tti);
        let mut earlier = self.events.range(..end_index).rev().map(|event| &event.record);
        earlier.find(|record| record.delay().is_none()).map(event_json)
    }

    /// By device: the number of events that ended from TTI 0 to TTI `tti`, an available one, and to which it is the
    /// nearest device; and how many of these were missed.
    pub(super) fn counts_until(&self, tti: Tti) -> (Vec<u32>, Vec<u32>) {
        let (mut near_counts, mut near_miss_counts) = (self.near_counts.clone(), self.near_miss_counts.clone());
        let later_index = self.events.partition_point(|event| event.record.last <= tti);
        for EndedEvent { record, nearest, .. } in self.events.range(later_index..) {
            near_counts[nearest.index()] -= 1;
            near_miss_counts[nearest.index()] -= u32::from(record.delay().is_none());
        }
        (near_counts, near_miss_counts)
    }
}

/// Explanation of the cause of a misdetection; `None` for a reported event.
pub(super) fn cause_text(record: &EventRecord) -> Option<&'static str> {
    record.miss_cause.map(MissCause::explanation)
}

fn event_json(record: &EventRecord) -> Value {
    json!({
        "event": record.event,
        "start": record.start,
        "last": record.last,
        "epicentre": record.epicentre,
        "counted": record.counted,
        "delay": record.delay(),
        "cause": cause_text(record),
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
            miss_cause: (reports == 0).then_some(MissCause::Asleep),
        }
    }

    #[test]
    fn misses_are_found_in_both_directions() {
        let mut log = EventLog::new(vec![Point::new(0.0, 0.0), Point::new(10.0, 0.0)]);
        for (start, x, reports) in [(5, 1.0, 0), (10, 9.0, 2), (20, 9.0, 0), (30, 8.0, 0)] {
            log.push(record(start, start + 3, x, reports), Vec::new(), Tti(0));
        }
        let start = |event: Option<Value>| event.map(|event| event["start"].clone());
        assert_eq!(start(log.miss_after(Tti(5))), Some(20.into()));
        assert_eq!(start(log.miss_before(Tti(20))), Some(5.into()));
        assert_eq!(start(log.miss_after(Tti(30))), None);
        assert_eq!(start(log.miss_before(Tti(5))), None);
        let counts = [32, 33, 23, 22].map(|tti| log.counts_until(Tti(tti)));
        let expected = [([1, 2], [1, 1]), ([1, 3], [1, 2]), ([1, 2], [1, 1]), ([1, 1], [1, 0])];
        assert_eq!(counts, expected.map(|(near, missed)| (near.to_vec(), missed.to_vec())));
        let overlapping = log.overlapping(Tti(13), Tti(20));
        assert_eq!(overlapping.as_array().map(Vec::len), Some(1), "{overlapping}");
        log.push(record(40, 41, 0.0, 1), Vec::new(), Tti(15));
        assert_eq!(start(log.miss_before(Tti(40))), Some(30.into()));
        assert_eq!(
            start(log.miss_after(Tti(0))),
            Some(20.into()),
            "the first two are dropped"
        );
    }

    #[test]
    fn last_events_end_at_the_shown_tti() {
        let mut log = EventLog::new(vec![Point::new(0.0, 0.0)]);
        for (start, reports) in [(5, 0), (10, 1), (20, 0)] {
            log.push(
                record(start, start + 3, 1.0, reports),
                vec!["4 lost".to_owned()],
                Tti(0),
            );
        }
        let ttis = |until| -> Vec<Value> {
            let last = log.last_events(Tti(until));
            last.as_array()
                .expect("a list")
                .iter()
                .map(|event| event["tti"].clone())
                .collect()
        };
        assert_eq!(ttis(7), Vec::<Value>::new());
        assert_eq!(ttis(13), [13, 8]);
        assert_eq!(ttis(99), [23, 13, 8]);
        let text = log.last_events(Tti(8))[0]["text"].to_string();
        assert!(text.contains("missed (devices within d_max slept by plan)"), "{text}");
        assert_eq!(log.last_events(Tti(8))[0]["who"][0], "4 lost");
        assert_eq!(
            [log.counted_until(Tti(22)), log.counted_until(Tti(23))],
            [(2, 1), (3, 2)]
        );
    }
}
