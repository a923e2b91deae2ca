//! Events that start with the same probability in every TTI.

use crate::declare::{ABOVE_ZERO, number};
use crate::ids::{EventId, Tti};
use crate::rng::{Geometric, Purpose, Stream};

crate::declare! {
    /// How often events start.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Rate in "events" only with "events.process" = &["uniform", "hot-spots", "aftershocks"]; {
        /// Probability α that an event starts in a TTI in which none is active.
        pub(super) alpha: f64 = number(ABOVE_ZERO, 0.2)
            .unit("per TTI")
            .source("Sec. II; 0.1 there, 0.2 by calibration"),
    }
}

/// When events start, with probability α in every TTI without one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Steady {
    seed: u64,
    gap: Geometric,
}

impl Steady {
    pub(super) fn new(seed: u64, alpha: f64) -> Self {
        Self {
            seed,
            gap: Geometric::new(alpha),
        }
    }

    /// The TTI in which `event` starts, which cannot start before `earliest`.
    pub(super) fn next(&self, event: EventId, earliest: Tti) -> Tti {
        let gap = self.gap.draw(&mut Stream::new(self.seed, Purpose::EventGap, event.0));
        earliest.saturating_add(gap - 1)
    }
}
