//! The sources `eq5` and `exp-minus-lambda`: an arrival of E_B in each TTI with the same probability, independently.
//! Digests depend on the draws, one gap per arrival. [`ArrivalsSetup`] is part of the wire format. Doc comments of
//! fields appear in `docs/scenario.md`.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::shared_tables::{SharedSourceData, expected_energy};
use crate::declare::{NOT_NEGATIVE, energy, number};
use crate::ids::Tti;
use crate::rng::{GapTable, Stream};
use crate::units::Energy;

crate::declare! {
    /// Random energy arrivals (paper Sec. III-A).
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Arrivals in "harvest"
        only with "harvest.kind" = &["eq5", "exp-minus-lambda", "mpp", "diurnal"];
    {
        /// Intensity λ of the arrivals. With `mpp`, the mean on-duration is 1/λ, and λ must be above 0.
        pub lambda: f64 = number(NOT_NEGATIVE, 0.1).unit("per unit of model time").source("Sec. III-A"),
        /// Energy `E_B` of one arrival.
        pub e_b: Energy = energy(5.0).unit("units").source("Sec. III-A"),
    }
}

impl Arrivals {
    /// The setup for Eq. (5): an arrival in a TTI with probability λτ·exp(-λτ).
    pub fn eq5(&self, tau: f64) -> ArrivalsSetup {
        ArrivalsSetup {
            p: eq5_probability(self.lambda, tau),
            e_b: self.e_b,
        }
    }

    /// The setup for the other reading in Sec. III-B: an arrival in a TTI with probability exp(-λ).
    pub(crate) fn exp_minus_lambda(&self) -> ArrivalsSetup {
        ArrivalsSetup {
            p: libm::exp(-self.lambda),
            e_b: self.e_b,
        }
    }
}

/// The probability λτ·exp(-λτ) of Eq. (5), at most 1/e.
pub(crate) fn eq5_probability(lambda: f64, tau: f64) -> f64 {
    lambda * tau * libm::exp(-lambda * tau)
}

/// The setup of independent arrivals on a device.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArrivalsSetup {
    /// Probability of an arrival in a TTI, `[0, 1]`.
    pub p: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
}

impl ArrivalsSetup {
    /// Whether a setup from the wire is valid.
    pub(super) fn is_valid(&self) -> bool {
        (0.0..=1.0).contains(&self.p)
    }

    /// The mean harvest per TTI.
    pub(super) fn mean(&self) -> Energy {
        expected_energy(self.p, self.e_b)
    }

    /// The expected harvest per TTI, micro-units.
    pub(super) fn expected_micro(&self) -> f64 {
        self.p * self.e_b.micro() as f64
    }

    /// Creates the source. Also returns the TTI of its first arrival.
    pub(super) fn source(&self, shared: &SharedSourceData, mut stream: Stream) -> (ArrivalsSource, Tti) {
        let gaps = shared.gap_table(self.p);
        // Arrivals without energy change nothing, so none is ever due.
        let next = if self.e_b == Energy::ZERO {
            Tti::NEVER
        } else {
            // A gap of 1 is TTI 0.
            Tti(gaps.draw(&mut stream)).previous()
        };
        let e_b = self.e_b;
        (ArrivalsSource { gaps, stream, e_b }, next)
    }
}

/// The state of the source on a device.
#[derive(Clone, Debug)]
pub(super) struct ArrivalsSource {
    gaps: Arc<GapTable>,
    stream: Stream,
    e_b: Energy,
}

impl ArrivalsSource {
    /// Returns the arrival in `now`, the TTI of the next arrival from the last call, and the TTI of the one after it.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        (self.e_b, now.saturating_add(self.gaps.draw(&mut self.stream)))
    }
}
