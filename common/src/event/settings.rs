//! The settings of the event process, checked and complete.

use super::aftershocks::Aftershocks;
use super::bursts::Bursts;
use super::duration::{Duration, DurationKind};
use super::hot_spots::HotSpots;
use super::process::{Process, Settings};
use super::steady::Rate;
use crate::declare::{Reader, ScenarioError, Section, Sink};
use crate::ids::Tti;

/// The event process (paper Sec. II).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Events {
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`. Where it changes with time this
    /// is its long-run mean, which is what can be known of it beforehand.
    pub alpha: f64,
    /// How long an event lasts unless a report ends it, TTIs, ≥ 1; the mean where that is random.
    pub duration: u64,
    /// Whether all events last equally long.
    pub duration_kind: DurationKind,
    /// When and where events come.
    pub process: Process,
}

impl Events {
    /// The fields of all kinds.
    pub const SECTIONS: [&'static Section; 6] = [
        Settings::SECTION,
        Rate::SECTION,
        Duration::SECTION,
        HotSpots::SECTION,
        Aftershocks::SECTION,
        Bursts::SECTION,
    ];

    /// The settings that `reader` has.
    ///
    /// # Errors
    /// A value is out of its range.
    pub fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        let process = Process::settle(reader)?;
        let alpha = match process.long_run_alpha() {
            Some(alpha) => alpha,
            None => Rate::read(reader)?.alpha,
        };
        let Duration {
            duration,
            duration_kind,
        } = Duration::read(reader)?;
        Ok(Self {
            alpha,
            duration,
            duration_kind,
            process,
        })
    }

    /// Hands every field to `sink`.
    pub fn visit(&self, sink: &mut dyn Sink) {
        let Self {
            alpha,
            duration,
            duration_kind,
            process,
        } = *self;
        Settings {
            process: process.kind(),
        }
        .visit(sink);
        if process.long_run_alpha().is_none() {
            Rate { alpha }.visit(sink);
        }
        Duration {
            duration,
            duration_kind,
        }
        .visit(sink);
        process.visit(sink);
    }

    /// The mean, over the TTIs from `first` to before `end`, of the probability that an event starts in a TTI in which
    /// none is active. It is [`Self::alpha`] but where that changes with time. Then it follows from `seed` alone: it is
    /// the same whatever a policy does. [`Self::alpha`] too for no TTI at all.
    pub fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> f64 {
        let measured = self.process.mean_start_probability(seed, first, end);
        measured.unwrap_or(self.alpha)
    }

    /// The share of events, `[0, 1]`, that are over before they are looked for, where every place is looked at once in
    /// `every` TTIs, ≥ 1.
    pub fn over_before_a_look(&self, every: u64) -> f64 {
        self.duration_kind.over_before_a_look(self.duration, every)
    }

    /// The longest that an event can last, TTIs; `None` where there is no limit.
    pub const fn longest(&self) -> Option<u64> {
        self.duration_kind.longest(self.duration)
    }
}
