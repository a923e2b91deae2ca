//! Events that come in bursts.

use crate::declare::{ABOVE_ZERO, PROBABILITY, Range, number};
use crate::ids::{EventId, Tti};
use crate::phases::{Phase, Phases};
use crate::rng::{Purpose, Stream};

/// Mean lengths of phases. None is shorter than a TTI.
const LENGTH: Range = Range::closed(1.0, 1e9);

crate::declare! {
    /// Events in bursts: busy and quiet phases follow each other, whatever is reported. A phase ends after any of its
    /// TTIs with the same probability. A run begins as if the phases had always been there. What a base station knows
    /// of α is the mean of both probabilities, weighted by the mean lengths.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Bursts in "events.bursts" only with "events.process" = &["bursts"]; {
        /// Probability that an event starts in a TTI of a busy phase in which none is active.
        pub busy_alpha: f64 = number(ABOVE_ZERO, 0.8).unit("per TTI"),
        /// Probability that an event starts in a TTI of a quiet phase in which none is active.
        pub quiet_alpha: f64 = number(PROBABILITY, 0.02).unit("per TTI"),
        /// Mean length of a busy phase.
        pub busy_ttis: f64 = number(LENGTH, 40.0).unit("TTIs"),
        /// Mean length of a quiet phase.
        pub quiet_ttis: f64 = number(LENGTH, 160.0).unit("TTIs"),
    }
}

impl Bursts {
    /// The long-run mean of the probability that an event starts in a TTI in which none is active.
    pub(super) fn alpha(&self) -> f64 {
        mean_alpha(self, self.busy_ttis, self.quiet_ttis)
    }

    /// The mean of the same over the TTIs from `first` to before `end` of a run with `seed`; the long-run mean for no
    /// TTI at all.
    pub(super) fn mean_start_probability(&self, seed: u64, first: Tti, end: Tti) -> f64 {
        if first >= end {
            return self.alpha();
        }
        let mut phases = self.phases(seed);
        let (mut k, mut busy) = (first, 0);
        while k < end {
            let phase = phases.at(k);
            let next = phase.end.min(end);
            if phase.is_busy {
                busy += next - k;
            }
            k = next;
        }
        mean_alpha(self, busy as f64, (end - first - busy) as f64)
    }

    fn phases(&self, seed: u64) -> Phases {
        Phases::new(Stream::new(seed, Purpose::Phases, 0), self.busy_ttis, self.quiet_ttis)
    }
}

/// The mean of both probabilities over `busy` and `quiet` TTIs.
fn mean_alpha(settings: &Bursts, busy: f64, quiet: f64) -> f64 {
    (settings.busy_alpha * busy + settings.quiet_alpha * quiet) / (busy + quiet)
}

/// When events start, in busy and quiet phases.
#[derive(Clone, Debug)]
pub(super) struct Bursting {
    seed: u64,
    phases: Phases,
    /// −ln(1 − α) of a TTI of a busy phase, `(0, ∞]`.
    busy_hazard: f64,
    /// The same of a quiet phase, `[0, ∞]`.
    quiet_hazard: f64,
    /// The first TTI that is not of the run.
    end: Tti,
}

impl Bursting {
    pub(super) fn new(settings: &Bursts, seed: u64, end: Tti) -> Self {
        Self {
            seed,
            phases: settings.phases(seed),
            busy_hazard: -libm::log1p(-settings.busy_alpha),
            quiet_hazard: -libm::log1p(-settings.quiet_alpha),
            end,
        }
    }

    /// The TTI in which `event` starts, which cannot start before `earliest`; [`Tti::NEVER`] if that is not within the
    /// run.
    ///
    /// One draw u an event: it starts in the first TTI k in which ∏ (1 − α(i)), i from `earliest` to k, falls below
    /// 1 − u. In logarithms, the hazards add up to more than −ln(1 − u). Within a phase all are the same, so that it is
    /// taken in one step.
    pub(super) fn next(&mut self, event: EventId, earliest: Tti) -> Tti {
        let mut left = -libm::log1p(-Stream::new(self.seed, Purpose::EventGap, event.0).unit());
        let mut k = earliest;
        while k < self.end {
            let phase = self.phases.at(k);
            let (hazard, ttis) = (self.hazard(phase), phase.end - k);
            // No number where both are 0: nothing starts in this phase then, nor is anything used up.
            let failures = (left / hazard).floor();
            if failures < ttis as f64 {
                return k.saturating_add(failures as u64);
            }
            left = (left - hazard * ttis as f64).max(0.0);
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
