//! How long events last.

use crate::declare::{choice, choices, whole};
use crate::ids::{EventId, MAX_TTIS};
use crate::rng::{Geometric, Purpose, Stream};

choices! {
    /// Whether all events last equally long.
    pub enum DurationKind {
        /// Each lasts as long as `duration` says.
        Fixed = "fixed",
        /// Each ends after any of its TTIs with the same probability; `duration` is the mean.
        Geometric = "geometric",
    }
}

crate::declare! {
    /// How long events last.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Duration in "events" {
        /// How long an event lasts unless a report ends it; the mean where `duration_kind` is "geometric".
        pub(super) duration: u64 = whole(1, MAX_TTIS, 4).unit("TTIs").source("by calibration"),
        /// Whether all events last equally long.
        pub(super) duration_kind: DurationKind = choice::<DurationKind>("fixed"),
    }
}

impl DurationKind {
    /// The TTIs that `event` lasts, ≥ 1, where they have the mean `mean`, ≥ 1.
    pub(super) fn draw(self, mean: u64, seed: u64, event: EventId) -> u64 {
        match self {
            Self::Fixed => mean,
            Self::Geometric => {
                let mut stream = Stream::new(seed, Purpose::EventDuration, event.0);
                Geometric::new(1.0 / mean as f64).draw(&mut stream)
            }
        }
    }

    /// The share of events, `[0, 1]`, that are over before they are looked for, where every place is looked at once in
    /// `every` TTIs, ≥ 1, and events of the mean duration `mean` start at any time in between.
    pub(super) fn over_before_a_look(self, mean: u64, every: u64) -> f64 {
        let (mean, every) = (mean as f64, every as f64);
        match self {
            Self::Fixed => (1.0 - mean / every).max(0.0),
            // An event that has to wait for W TTIs is still there with probability q^W; W is 0 to `every` − 1, each
            // equally likely.
            Self::Geometric => {
                let q = 1.0 - 1.0 / mean;
                1.0 - mean * (1.0 - libm::pow(q, every)) / every
            }
        }
    }

    /// The longest that an event of the mean duration `mean` can last.
    pub(super) const fn longest(self, mean: u64) -> Option<u64> {
        match self {
            Self::Fixed => Some(mean),
            // The law of mean 1 has no other value.
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
    fn events_that_are_over_before_a_look_are_counted() {
        for kind in [DurationKind::Fixed, DurationKind::Geometric] {
            for (mean, every) in [(1, 1), (4, 1), (4, 4), (4, 2), (1, 2), (2, 4), (3, 10), (20, 7)] {
                let events = 200_000;
                let is_over = |event: &u64| kind.draw(mean, 5, EventId(*event)) <= event % every;
                let counted = (0..events).filter(is_over).count() as f64 / events as f64;
                let found = kind.over_before_a_look(mean, every);
                assert!(
                    (found - counted).abs() < 0.005,
                    "{kind:?} {mean} {every}: {found}, counted {counted}"
                );
            }
        }
    }
}
