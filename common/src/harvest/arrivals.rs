//! Independent arrivals of energy.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::sources::{Sources, expected};
use crate::declare::{NOT_NEGATIVE, energy, number};
use crate::ids::Tti;
use crate::rng::{GapTable, Stream};
use crate::units::Energy;

crate::declare! {
    /// Arrivals of energy at random (paper Sec. III-A).
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Arrivals in "harvest"
        only with "harvest.kind" = &["eq5", "exp-minus-lambda", "mpp", "diurnal"];
    {
        /// The intensity λ. Of `mpp`, on-durations have the mean 1/λ, and it has to be above 0.
        pub lambda: f64 = number(NOT_NEGATIVE, 0.1).unit("per unit of model time").source("Sec. III-A"),
        /// Energy `E_B` of one arrival.
        pub e_b: Energy = energy(5.0).unit("units").source("Sec. III-A"),
    }
}

impl Arrivals {
    /// Eq. (5): an arrival in a TTI with probability λτ·exp(-λτ).
    pub fn eq5(&self, tau: f64) -> ArrivalsSetup {
        ArrivalsSetup {
            p: eq5_probability(self.lambda, tau),
            e_b: self.e_b,
        }
    }

    /// The other reading in Sec. III-B: with probability exp(-λ).
    pub fn exp_minus_lambda(&self) -> ArrivalsSetup {
        ArrivalsSetup {
            p: libm::exp(-self.lambda),
            e_b: self.e_b,
        }
    }
}

/// The probability λτ·exp(-λτ) of Eq. (5), at most 1/e.
pub fn eq5_probability(lambda: f64, tau: f64) -> f64 {
    lambda * tau * libm::exp(-lambda * tau)
}

/// Independent arrivals, as a device needs them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArrivalsSetup {
    /// Probability of an arrival in a TTI, `[0, 1]`.
    pub p: f64,
    /// Energy E_B of an arrival.
    pub e_b: Energy,
}

impl ArrivalsSetup {
    /// Whether a device can be given it.
    pub(super) fn is_sound(&self) -> bool {
        (0.0..=1.0).contains(&self.p)
    }

    /// The mean harvest in a TTI.
    pub(super) fn mean(&self) -> Energy {
        expected(self.p, self.e_b)
    }

    /// The source, and the TTI of its first arrival.
    pub(super) fn source(&self, shared: &Sources, mut stream: Stream) -> (ArrivalsSource, Tti) {
        let gaps = shared.gaps(self.p);
        let next = if self.e_b == Energy::ZERO {
            Tti::NEVER
        } else {
            Tti(gaps.draw(&mut stream)).saturating_sub_one()
        };
        let e_b = self.e_b;
        (ArrivalsSource { gaps, stream, e_b }, next)
    }
}

/// Independent arrivals at one device.
#[derive(Clone, Debug)]
pub(super) struct ArrivalsSource {
    gaps: Arc<GapTable>,
    stream: Stream,
    e_b: Energy,
}

impl ArrivalsSource {
    /// The arrival in `now`, and the TTI of the next.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        (self.e_b, now.saturating_add(self.gaps.draw(&mut self.stream)))
    }
}
