//! Alternating busy and quiet phases: of events in `event/bursts.rs`, of interference in `radio/air.rs`. Digests depend
//! on the order of draws: whether the run starts busy, then the length of each phase. `radio.rs` and `events.rs` in
//! `tests/src/reference/` repeat it.

use crate::ids::Tti;
use crate::rng::{Geometric, Stream};

/// A phase of a run.
#[derive(Clone, Copy, Debug)]
pub struct Phase {
    /// Whether the phase is busy.
    pub is_busy: bool,
    /// The first TTI after the phase.
    pub end: Tti,
}

/// The phases of a run, in order. They depend only on the stream: a phase ends after each of its TTIs with the same
/// probability. A run starts in the stationary state, in the middle of a phase.
#[derive(Clone, Debug)]
pub struct Phases {
    stream: Stream,
    /// The distribution of the lengths of busy phases, TTIs.
    busy_length: Geometric,
    /// The distribution of the lengths of quiet phases, TTIs.
    quiet_length: Geometric,
    phase: Phase,
}

impl Phases {
    /// Draws phases with mean lengths of `mean_busy` and `mean_quiet` TTIs from `stream`.
    ///
    /// # Panics
    /// If a mean is below 1, which the ranges of the settings exclude.
    pub fn new(mut stream: Stream, mean_busy: f64, mean_quiet: f64) -> Self {
        // A geometric distribution has no memory: the rest of a started phase has the distribution of a whole one.
        let is_busy = stream.unit() < mean_busy / (mean_busy + mean_quiet);
        let mut phases = Self {
            stream,
            busy_length: Geometric::new(1.0 / mean_busy),
            quiet_length: Geometric::new(1.0 / mean_quiet),
            phase: Phase {
                is_busy,
                end: Tti::ZERO,
            },
        };
        phases.draw_phase_end();
        phases
    }

    /// Draws the length of the phase that starts at the end of the last one.
    fn draw_phase_end(&mut self) {
        let distribution = if self.phase.is_busy {
            self.busy_length
        } else {
            self.quiet_length
        };
        self.phase.end = self.phase.end.saturating_add(distribution.draw(&mut self.stream));
    }

    /// Returns the phase of TTI `k`, which must not precede the TTI of the last call: the phases cannot go back.
    pub fn phase_at(&mut self, k: Tti) -> Phase {
        while self.phase.end <= k {
            self.phase.is_busy = !self.phase.is_busy;
            self.draw_phase_end();
        }
        self.phase
    }
}
