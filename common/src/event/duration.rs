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
