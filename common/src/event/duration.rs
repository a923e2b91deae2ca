//! The durations of events, and the share of events that ends before a device can sense them. Digests depend on the
//! draws: one per event of random duration; `tests/src/reference/events.rs` repeats them. The share only causes a
//! warning in `scenario/validate.rs`. Doc comments of fields and words appear in `docs/scenario.md`.

use crate::declare::{choice, choices, whole};
use crate::ids::{EventId, MAX_TTIS};
use crate::rng::{Geometric, Purpose, Stream};

choices! {
    /// Distribution of event durations.
    pub enum DurationKind {
        /// Every event lasts `duration` TTIs.
        Fixed = "fixed",
        /// An event ends after each of its TTIs with the same probability; `duration` is the mean.
        Geometric = "geometric",
    }
}

crate::declare! {
    /// Durations of events.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct DurationFields in "events" {
        /// Duration of an event unless a report ends it; the mean if `duration_kind` is "geometric".
        pub(super) duration: u64 = whole(1, MAX_TTIS, 4).unit("TTIs").source("by calibration"),
        /// Distribution of event durations.
        pub(super) duration_kind: DurationKind = choice::<DurationKind>("fixed"),
    }
}

impl DurationKind {
    /// Draws the duration of `event` in TTIs, ≥ 1, with the mean `mean`, ≥ 1.
    pub(super) fn draw(self, mean: u64, seed: u64, event: EventId) -> u64 {
        match self {
            Self::Fixed => mean,
            Self::Geometric => {
                let mut stream = Stream::new(seed, Purpose::EventDuration, event.0);
                Geometric::new(1.0 / mean as f64).draw(&mut stream)
            }
        }
    }

    /// The share of events, `[0, 1]`, that end before a device senses them. Every place is sensed once in `interval`
    /// TTIs, ≥ 1; events of mean duration `mean`, ≥ 1 TTI, start uniformly in between.
    pub(super) fn missed_share(self, mean: u64, interval: u64) -> f64 {
        let (mean, interval) = (mean as f64, interval as f64);
        match self {
            Self::Fixed => (1.0 - mean / interval).max(0.0),
            // An event that has to wait W TTIs lasts that long with probability q^W. Each W from 0 to `interval` − 1
            // is equally likely. The mean over W is (1 − q^interval) / (interval · (1 − q)), with 1 − q = 1/`mean`.
            Self::Geometric => {
                let q = 1.0 - 1.0 / mean;
                1.0 - mean * (1.0 - libm::pow(q, interval)) / interval
            }
        }
    }

    /// The longest duration of an event with mean duration `mean`; `None` without a limit.
    pub(super) const fn max_duration(self, mean: u64) -> Option<u64> {
        match self {
            Self::Fixed => Some(mean),
            // A geometric distribution of mean 1 is always 1.
            Self::Geometric => {
                if mean == 1 {
                    Some(1)
                } else {
                    None
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missed_share_equals_the_share_of_drawn_events() {
        for kind in [DurationKind::Fixed, DurationKind::Geometric] {
            for (mean, interval) in [(1, 1), (4, 1), (4, 4), (4, 2), (1, 2), (2, 4), (3, 10), (20, 7)] {
                let events = 200_000;
                // The event has to last through `event % interval` TTIs until a device senses.
                let is_missed = |event: &u64| kind.draw(mean, 5, EventId(*event)) <= event % interval;
                let expected = (0..events).filter(is_missed).count() as f64 / events as f64;
                let share = kind.missed_share(mean, interval);
                assert!(
                    (share - expected).abs() < 0.005,
                    "{kind:?}, mean {mean}, sensed every {interval} TTIs: {share}, not {expected}"
                );
            }
        }
    }
}
