//! Uniform epicentres and a constant start probability: the process `uniform`, and the base of the other processes.
//! Digests depend on the draws: x, then y; one gap per event. `tests/src/reference/events.rs` repeats them. Doc
//! comments of fields appear in `docs/scenario.md`.

use crate::declare::{SHARE_ABOVE_ZERO, number};
use crate::geometry::{Area, Point};
use crate::ids::{EventId, Tti};
use crate::rng::{Geometric, Purpose, Stream};

/// Epicentres uniform on the area.
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

    /// Draws a uniform point of the area, with two draws from `stream`: x, then y.
    pub(super) fn draw_point(&self, stream: &mut Stream) -> Point {
        Point::new(stream.unit() * self.area.width, stream.unit() * self.area.height)
    }
}

crate::declare! {
    /// Rate at which events start.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct RateFields in "events" only with "events.process" = &["uniform", "hot-spots", "aftershocks"]; {
        /// Probability α that an event starts in a TTI without an active event.
        pub(super) alpha: f64 = number(SHARE_ABOVE_ZERO, 0.2)
            .unit("per TTI")
            .source("Sec. II; 0.1 there, 0.2 by calibration"),
    }
}

/// The starts of events, with probability α in every TTI without an active event.
#[derive(Clone, Debug)]
pub(super) struct SteadyStarts {
    seed: u64,
    /// The distribution of the gap under the current α.
    gap_distribution: Geometric,
    /// −ln(1 − α) per TTI, `(0, ∞]`, each from a TTI on. The first is from TTI 0 on, the others are changes of α.
    hazards: Vec<(Tti, f64)>,
}

impl SteadyStarts {
    pub(super) fn new(seed: u64, alpha: f64) -> Self {
        Self {
            seed,
            gap_distribution: Geometric::new(alpha),
            hazards: vec![(Tti::ZERO, -libm::log1p(-alpha))],
        }
    }

    /// Changes α, `(0, 1]`, from TTI `from` on, which must not precede the last change.
    pub(super) fn set_alpha(&mut self, from: Tti, alpha: f64) {
        self.gap_distribution = Geometric::new(alpha);
        self.hazards.push((from, -libm::log1p(-alpha)));
    }

    /// The TTI in which `event` starts, not before `earliest`.
    pub(super) fn draw_start(&self, event: EventId, earliest: Tti) -> Tti {
        let mut stream = Stream::new(self.seed, Purpose::EventGap, event.0);
        if self
            .hazards
            .last()
            .is_some_and(|&(last_change, _)| earliest < last_change)
        {
            return self.draw_across_changes(&mut stream, earliest);
        }
        let gap = self.gap_distribution.draw(&mut stream);
        // Gaps are at least 1, and a gap of 1 means `earliest` itself.
        earliest.saturating_add(gap - 1)
    }

    /// The start of an event with a gap that begins before the last change of α. As in
    /// [`BurstStarts`](super::bursts::BurstStarts), the hazards of the TTIs add up to more than one draw.
    fn draw_across_changes(&self, stream: &mut Stream, earliest: Tti) -> Tti {
        let mut remaining_hazard = -libm::log1p(-stream.unit());
        let mut k = earliest;
        let ends = self.hazards.iter().skip(1).map(|&(from, _)| from).chain([Tti::NEVER]);
        for (&(_, hazard), end) in self.hazards.iter().zip(ends) {
            // A change can precede `earliest`, and two changes can come in one TTI.
            if end <= k {
                continue;
            }
            let ttis_without_start = (remaining_hazard / hazard).floor();
            if ttis_without_start < (end - k) as f64 {
                return k.saturating_add(ttis_without_start as u64);
            }
            // The draw outlasts this part, so only rounding can make the difference negative.
            remaining_hazard = (remaining_hazard - hazard * (end - k) as f64).max(0.0);
            k = end;
        }
        Tti::NEVER
    }
}
