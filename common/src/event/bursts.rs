//! The event process `bursts`: events are frequent in busy phases and rare in quiet phases. Digests depend on the
//! draws: one per event, and the draws of [`crate::phases`]. `tests/src/reference/events.rs` finds the same starts, and
//! `tests/tests/bursts.rs` tests this file. Doc comments of fields appear in `docs/scenario.md`.

use crate::declare::{PROBABILITY, Range, SHARE_ABOVE_ZERO, number};
use crate::ids::{EventId, Tti};
use crate::phases::{Phase, Phases};
use crate::rng::{Purpose, Stream};

/// Range of the mean lengths of phases. No phase is shorter than a TTI. `radio/bursts.rs` has an equal one.
const MEAN_TTIS_RANGE: Range = Range::closed(1.0, 1e9);

crate::declare! {
    /// Events in alternating busy and quiet phases, independent of reports. A phase ends after each of its TTIs with
    /// the same probability, and a run starts in the steady state. The base station's α is the mean of both
    /// probabilities, weighted by the mean lengths.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct EventBursts in "events.bursts" only with "events.process" = &["bursts"]; {
        /// Probability that an event starts in a busy-phase TTI without an active event.
        pub busy_alpha: f64 = number(SHARE_ABOVE_ZERO, 0.8).unit("per TTI"),
        /// Probability that an event starts in a quiet-phase TTI without an active event.
        pub quiet_alpha: f64 = number(PROBABILITY, 0.02).unit("per TTI"),
        /// Mean length of a busy phase.
        pub busy_ttis: f64 = number(MEAN_TTIS_RANGE, 40.0).unit("TTIs"),
        /// Mean length of a quiet phase.
        pub quiet_ttis: f64 = number(MEAN_TTIS_RANGE, 160.0).unit("TTIs"),
    }
}

impl EventBursts {
    /// The long-run mean of the probability that an event starts in a TTI in which none is active.
    pub(super) fn long_run_alpha(&self) -> f64 {
        mean_alpha(self, self.busy_ttis, self.quiet_ttis)
    }

    /// The mean of the probability that an event starts, over the TTIs from `first` to before `end` of a run with
    /// `seed`; the long-run mean for an empty range.
    pub(super) fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> f64 {
        if first >= end {
            return self.long_run_alpha();
        }
        let mut phases = self.phases(seed);
        let (mut k, mut busy_count) = (first, 0);
        while k < end {
            let phase = phases.phase_at(k);
            let next = phase.end.min(end);
            if phase.is_busy {
                busy_count += next - k;
            }
            k = next;
        }
        mean_alpha(self, busy_count as f64, (end - first - busy_count) as f64)
    }

    fn phases(&self, seed: u64) -> Phases {
        let stream = Stream::new(seed, Purpose::EventPhases, 0);
        Phases::new(stream, self.busy_ttis, self.quiet_ttis)
    }
}

/// The mean of both probabilities over the given numbers of busy and quiet TTIs, whose sum must be above 0.
fn mean_alpha(settings: &EventBursts, busy_ttis: f64, quiet_ttis: f64) -> f64 {
    (settings.busy_alpha * busy_ttis + settings.quiet_alpha * quiet_ttis) / (busy_ttis + quiet_ttis)
}

/// The starts of events in busy and quiet phases.
#[derive(Clone, Debug)]
pub(super) struct BurstStarts {
    seed: u64,
    phases: Phases,
    /// −ln(1 − α) per TTI of a busy phase, `(0, ∞]`.
    busy_hazard: f64,
    /// −ln(1 − α) per TTI of a quiet phase, `[0, ∞]`.
    quiet_hazard: f64,
    /// The first TTI after the run.
    end: Tti,
}

impl BurstStarts {
    pub(super) fn new(settings: &EventBursts, seed: u64, end: Tti) -> Self {
        Self {
            seed,
            phases: settings.phases(seed),
            busy_hazard: -libm::log1p(-settings.busy_alpha),
            quiet_hazard: -libm::log1p(-settings.quiet_alpha),
            end,
        }
    }

    /// The TTI in which `event` starts, not before `earliest`, which must not decrease between calls; [`Tti::NEVER`] if
    /// that is not within the run.
    ///
    /// One draw u per event: it starts in the first TTI k in which ∏ (1 − α(i)), i from `earliest` to k, falls below 1
    /// − u. In logarithms, the hazards add up to more than −ln(1 − u). They are constant within a phase, so that each
    /// phase takes one step.
    pub(super) fn draw_start(&mut self, event: EventId, earliest: Tti) -> Tti {
        let u = Stream::new(self.seed, Purpose::EventGap, event.0).unit();
        let mut remaining_hazard = -libm::log1p(-u);
        let mut k = earliest;
        while k < self.end {
            let phase = self.phases.phase_at(k);
            let (hazard, ttis) = (self.hazard(phase), phase.end - k);
            // 0/0 is not a number, which fails the comparison: nothing starts in this phase, and nothing is subtracted.
            let ttis_without_start = (remaining_hazard / hazard).floor();
            if ttis_without_start < ttis as f64 {
                return k.saturating_add(ttis_without_start as u64);
            }
            // The draw outlasts this phase, so only rounding can make the difference negative.
            remaining_hazard = (remaining_hazard - hazard * ttis as f64).max(0.0);
            k = phase.end;
        }
        Tti::NEVER
    }

    const fn hazard(&self, phase: Phase) -> f64 {
        if phase.is_busy {
            self.busy_hazard
        } else {
            self.quiet_hazard
        }
    }
}
