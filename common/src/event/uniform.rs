//! Uniform epicentres and a constant start probability: the process `uniform`, and the base of the other processes.
//! Digests depend on the draws: x, then y; one gap per event.

use crate::declare::{ABOVE_ZERO, number};
use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};
use crate::rng::{Geometric, Purpose, Stream};

#[derive(Clone, Copy, Debug)]
pub(super) struct UniformEpicentres {
    pub(super) seed: u64,
    pub(super) area: Area,
}

impl UniformEpicentres {
    pub(super) fn draw(&self, event: EventId) -> Point {
        let mut stream = Stream::new(self.seed, Purpose::Epicentre, event.0);
        self.draw_point(&mut stream)
    }

    /// Draws any point of the area, with two draws from `stream`.
    pub(super) fn draw_point(&self, stream: &mut Stream) -> Point {
        Point::new(stream.unit() * self.area.width, stream.unit() * self.area.height)
    }
}

crate::declare! {
    /// Rate at which events start.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Rate in "events" only with "events.process" = &["uniform", "hot-spots", "aftershocks"]; {
        /// Probability α that an event starts in a TTI without an active event.
        pub(super) alpha: f64 = number(ABOVE_ZERO, 0.2)
            .unit("per TTI")
            .source("Sec. II; 0.1 there, 0.2 by calibration"),
    }
}

/// The starts of events, with probability α in every TTI without an active event.
#[derive(Clone, Copy, Debug)]
pub(super) struct SteadyStarts {
    seed: u64,
    gap: Geometric,
}

impl SteadyStarts {
    pub(super) fn new(seed: u64, alpha: f64) -> Self {
        Self {
            seed,
            gap: Geometric::new(alpha),
        }
    }

    /// The TTI in which `event` starts, not before `earliest`.
    pub(super) fn draw_start(&self, event: EventId, earliest: Tti) -> Tti {
        let gap = self.gap.draw(&mut Stream::new(self.seed, Purpose::EventGap, event.0));
        // Gaps are at least 1, and a gap of 1 means `earliest` itself.
        earliest.saturating_add(gap - 1)
    }
}
