//! Worths of ages, in which gains and prices of sensing are measured. Learned tables and the weights of models were
//! made with these worths, so a change needs new ones. docs/age-index.md states the numbers below, and
//! `tests/src/reference/age_index.rs` repeats them.

use std::f64::consts::PI;

use reveille_common::sensing::{DetectionKind, Sensing};

/// Largest age that is distinguished, TTIs.
pub(crate) const MAX_AGE: u8 = u8::MAX;

/// Age in TTIs from which on the worth no longer grows: the last whose worth, 22 · 23/2 = 253, fits a byte. Few events
/// last longer, and places that no device covers affect no choice.
pub(super) const SATURATION_AGE: u8 = 22;

/// Largest worth of a look, where all places have age `SATURATION_AGE` or more, in reaches: the unit of the price θ. A
/// reach is the worth of one device's places at age 1.
pub const MAX_WORTH: f64 = worth_at_age(SATURATION_AGE) as f64;

/// Stands for a price of 0, so that ratios to it are finite.
pub const MIN_PRICE: f64 = 1e-30;

/// Returns the worth of the age a: a(a + 1)/2, up to `SATURATION_AGE`. This is Whittle's index of a place if an
/// undetected event costs the same in each TTI.
#[inline]
pub(super) const fn worth_at_age(age: u8) -> u8 {
    let age = if age < SATURATION_AGE { age } else { SATURATION_AGE } as u16;
    (age * (age + 1) / 2) as u8
}

/// Returns the effective sensing area of a device, m²: the integral of its detection probability over the places
/// around it.
pub fn effective_area(sensing: &Sensing) -> f64 {
    let Sensing { d_max, eta, kind, .. } = *sensing;
    match kind {
        DetectionKind::Range => PI * d_max * d_max,
        DetectionKind::Probabilistic => {
            let x = eta * d_max;
            2.0 * PI * (1.0 - libm::exp(-x) * (1.0 + x)) / (eta * eta)
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::sensing::Fusion;

    use super::*;

    #[test]
    fn worths_are_triangular_numbers_up_to_the_largest_that_fits_a_byte() {
        assert_eq!([0, 1, 2, 3, 4].map(worth_at_age), [0, 1, 3, 6, 10]);
        assert_eq!([21, 22, 23, MAX_AGE].map(worth_at_age), [231, 253, 253, 253]);
    }

    #[test]
    fn the_effective_area_is_the_integral_of_the_detection_probability() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            let sensing = Sensing {
                kind,
                d_max: 3.0,
                eta: 0.7,
                psi: 1.0,
                g: Fusion::Max,
            };
            // Midpoint rule over rings one millimetre wide.
            let ring_area = |i: u32| {
                let d = (f64::from(i) + 0.5) * 1e-3;
                let detection_probability = if kind == DetectionKind::Range {
                    1.0
                } else {
                    libm::exp(-0.7 * d)
                };
                detection_probability * 2.0 * PI * d * 1e-3
            };
            let expected: f64 = (0..3000).map(ring_area).sum();
            assert!(
                (effective_area(&sensing) - expected).abs() < 1e-4,
                "{kind:?}: {} m², not {expected}",
                effective_area(&sensing)
            );
        }
    }
}
