//! Busy and quiet phases that follow each other: of events, of interference.

use crate::ids::Tti;
use crate::rng::{Geometric, Stream};

/// The phase under way.
#[derive(Clone, Copy, Debug)]
pub struct Phase {
    /// Whether it is a busy one.
    pub is_busy: bool,
    /// The first TTI after it.
    pub end: Tti,
}

/// The phases of a run, one after the other. They depend on nothing but the stream: a phase ends after any of its TTIs
/// with the same probability, and a run begins as if the phases had always been there.
#[derive(Clone, Debug)]
pub struct Phases {
    stream: Stream,
    busy: Geometric,
    quiet: Geometric,
    phase: Phase,
}

impl Phases {
    /// Phases with mean lengths of `busy` and `quiet` TTIs, ≥ 1, drawn from `stream`.
    pub fn new(mut stream: Stream, busy: f64, quiet: f64) -> Self {
        // What is left of a phase under way has the law of a whole one.
        let is_busy = stream.unit() < busy / (busy + quiet);
        let mut phases = Self {
            stream,
            busy: Geometric::new(1.0 / busy),
            quiet: Geometric::new(1.0 / quiet),
            phase: Phase {
                is_busy,
                end: Tti::ZERO,
            },
        };
        phases.lengthen();
        phases
    }

    /// Draws the length of the phase that begins where the last one ended.
    fn lengthen(&mut self) {
        let law = if self.phase.is_busy { self.busy } else { self.quiet };
        self.phase.end = self.phase.end.saturating_add(law.draw(&mut self.stream));
    }

    /// The phase of TTI `k`, a TTI of a run and none before that of the last call.
    pub fn at(&mut self, k: Tti) -> Phase {
        while self.phase.end <= k {
            self.phase.is_busy = !self.phase.is_busy;
            self.lengthen();
        }
        self.phase
    }
}
