//! Bursts of interference that raise the loss probabilities of [`Air`](super::Air), and their long-run mean for
//! [`RadioLossRates`](super::RadioLossRates). Digests depend on both, and `tests/src/reference/radio.rs` repeats them.
//! The settings are part of the wire format (`WIRE_VERSION`) and of the scenario hash. A test compares words and help
//! texts with `docs/scenario.md`.

use serde::{Deserialize, Serialize};

use crate::declare::{PROBABILITY, Range, choices, number};
use crate::phases::Phases;
use crate::rng::{Purpose, Stream};

/// Range of mean lengths. Neither a burst nor the gap between two is shorter than a TTI.
const MEAN_TTIS_RANGE: Range = Range::closed(1.0, 1e9);

choices! {
    /// Type of additional interference.
    pub enum Interference {
        /// No interference.
        None = "none",
        /// Bursts that affect all devices simultaneously.
        Bursts = "bursts",
    }
}

crate::declare! {
    /// Bursts of interference that affect all devices simultaneously. A burst or a gap between bursts ends after each
    /// of its TTIs with the same probability. A run starts in the steady state.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    pub struct InterferenceBursts in "radio.bursts" only with "radio.interference" = &["bursts"]; {
        /// Mean length of a burst.
        pub burst_ttis: f64 = number(MEAN_TTIS_RANGE, 10.0).unit("TTIs"),
        /// Mean time between two bursts.
        pub quiet_ttis: f64 = number(MEAN_TTIS_RANGE, 90.0).unit("TTIs"),
        /// Probability during a burst that a wake-up, report or plan is lost. If a message's own loss probability is
        /// larger, that probability applies.
        pub loss: f64 = number(PROBABILITY, 1.0),
    }
}

impl InterferenceBursts {
    /// The bursts of a run with `seed`, as busy phases.
    pub(super) fn burst_phases(&self, seed: u64) -> Phases {
        let stream = Stream::new(seed, Purpose::InterferencePhases, 0);
        Phases::new(stream, self.burst_ttis, self.quiet_ttis)
    }

    /// The long-run mean of a loss probability that is `p` between bursts.
    pub(super) fn mean_loss(&self, p: f64) -> f64 {
        let Self {
            burst_ttis,
            quiet_ttis,
            loss,
        } = *self;
        // Mean lengths are the weights: they are the long-run shares of time. `max` as in `Air::losses_at`.
        (burst_ttis * loss.max(p) + quiet_ttis * p) / (burst_ttis + quiet_ttis)
    }

    pub(super) fn is_valid(&self) -> bool {
        let Self {
            burst_ttis,
            quiet_ttis,
            loss,
        } = *self;
        MEAN_TTIS_RANGE.contains(burst_ttis) && MEAN_TTIS_RANGE.contains(quiet_ttis) && PROBABILITY.contains(loss)
    }
}
