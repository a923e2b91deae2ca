//! The fields of a scenario's `events` section, checked and complete. Their order in [`EventSettings::visit`] is part
//! of the scenario hash. A field of a new struct needs an entry in `SECTIONS`, `from_fields` and `visit`.

use super::aftershocks::Aftershocks;
use super::bursts::EventBursts;
use super::duration::{DurationFields, DurationKind};
use super::hot_spots::HotSpots;
use super::process::{ProcessFields, ProcessSettings};
use super::uniform::RateFields;
use crate::declare::{FieldReader, FieldSink, ScenarioError, Section, Visit};
use crate::ids::Tti;

/// The event process (paper Sec. II).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EventSettings {
    /// Probability α that an event starts in a TTI in which none is active, `(0, 1]`. If it changes with time, this is
    /// its long-run mean, which is all that is known in advance.
    pub alpha: f64,
    /// Duration of an event in TTIs unless a report ends it, ≥ 1; the mean if it is random.
    pub duration: u64,
    /// Whether all events have the same duration.
    pub duration_kind: DurationKind,
    /// The times and places of events.
    pub process: ProcessSettings,
}

impl EventSettings {
    /// The fields of all kinds.
    pub(crate) const SECTIONS: [&'static Section; 6] = [
        ProcessFields::SECTION,
        RateFields::SECTION,
        DurationFields::SECTION,
        HotSpots::SECTION,
        Aftershocks::SECTION,
        EventBursts::SECTION,
    ];

    /// Builds the settings in `reader`.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        let process = ProcessSettings::from_fields(reader)?;
        let alpha = match process.long_run_alpha() {
            Some(alpha) => alpha,
            None => RateFields::read(reader)?.alpha,
        };
        let DurationFields {
            duration,
            duration_kind,
        } = DurationFields::read(reader)?;
        Ok(Self {
            alpha,
            duration,
            duration_kind,
            process,
        })
    }

    /// Passes every active field to `sink`.
    pub fn visit(&self, sink: &mut dyn FieldSink) {
        let Self {
            alpha,
            duration,
            duration_kind,
            process,
        } = *self;
        ProcessFields {
            process: process.kind(),
        }
        .visit(sink);
        if process.long_run_alpha().is_none() {
            RateFields { alpha }.visit(sink);
        }
        DurationFields {
            duration,
            duration_kind,
        }
        .visit(sink);
        process.visit(sink);
    }

    /// The mean probability, from TTI `first` to before `end`, that an event starts in a TTI in which none is active.
    /// It is [`Self::alpha`] if it is constant or the range is empty. Otherwise it follows from the settings and
    /// `seed`, not from the policy. Changes of α by an operator are not included: the score accounts for them.
    pub fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> f64 {
        let varying_mean = self.process.mean_start_probability(seed, first, end);
        varying_mean.unwrap_or(self.alpha)
    }

    /// Whether events start with the same probability α in all TTIs, so that [`Self::alpha`] can be changed in a run.
    pub fn has_constant_rate(&self) -> bool {
        self.process.long_run_alpha().is_none()
    }

    /// The share of events, `[0, 1]`, that end before a device senses them, if every place is sensed once in
    /// `interval` TTIs, ≥ 1.
    pub(crate) fn missed_share(&self, interval: u64) -> f64 {
        self.duration_kind.missed_share(self.duration, interval)
    }

    /// The longest duration of an event, TTIs; `None` without a limit.
    pub const fn max_duration(&self) -> Option<u64> {
        self.duration_kind.max_duration(self.duration)
    }
}
