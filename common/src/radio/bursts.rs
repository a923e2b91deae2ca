//! Bursts of interference, in which more is lost.

use serde::{Deserialize, Serialize};

use crate::declare::{PROBABILITY, Range, choices, number};
use crate::phases::Phases;
use crate::rng::{Purpose, Stream};

/// Mean lengths. Neither a burst nor the time between two is shorter than a TTI.
const LENGTH: Range = Range::closed(1.0, 1e9);

choices! {
    /// Whether more is lost at times.
    pub enum Interference {
        /// Never.
        None = "none",
        /// In bursts, for all devices at once.
        Bursts = "bursts",
    }
}

crate::declare! {
    /// Bursts of interference, for all devices at once. A burst, and the time between two, ends after any of its TTIs
    /// with the same probability. A run begins as if they had always been there.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    pub struct Bursts in "radio.bursts" only with "radio.interference" = &["bursts"]; {
        /// Mean length of a burst.
        pub burst_ttis: f64 = number(LENGTH, 10.0).unit("TTIs"),
        /// Mean time between two bursts.
        pub quiet_ttis: f64 = number(LENGTH, 90.0).unit("TTIs"),
        /// Probability, during a burst, that a wake-up is missed, a report lost, a plan missed; of each, its own where
        /// that is larger.
        pub loss: f64 = number(PROBABILITY, 1.0),
    }
}

impl Bursts {
    /// The bursts of a run with `seed`, as busy phases.
    pub(super) fn phases(&self, seed: u64) -> Phases {
        let stream = Stream::new(seed, Purpose::Interference, 0);
        Phases::new(stream, self.burst_ttis, self.quiet_ttis)
    }

    /// The long-run mean of a probability that is `p` between bursts.
    pub(super) fn mean(&self, p: f64) -> f64 {
        let Self {
            burst_ttis,
            quiet_ttis,
            loss,
        } = *self;
        (burst_ttis * loss.max(p) + quiet_ttis * p) / (burst_ttis + quiet_ttis)
    }

    pub(super) fn is_sound(&self) -> bool {
        let Self {
            burst_ttis,
            quiet_ttis,
            loss,
        } = *self;
        LENGTH.contains(burst_ttis) && LENGTH.contains(quiet_ttis) && PROBABILITY.contains(loss)
    }
}
