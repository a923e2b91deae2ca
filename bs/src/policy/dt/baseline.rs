//! Moving average of each device's ratio of expected events to the expectation by age and α. Where energy is scarce, it
//! discounts the ratio in the price factor of `dt` ([`ExpectationBaseline::update_factors`]). Digests depend on it, and
//! docs/dt.md states its constants. The training does not use it, so a change needs no new model. Without the baseline,
//! a device at a hot spot would always sense, since its price is always low. That is right while its battery is full.
//! For a device that spends all its harvest, sensing now costs sensing later, and only the ratio of current to usual
//! expectation matters.

use pulp::NullaryFnOnce;

use super::vector_math::{exp, log};
use crate::vector_width::VectorWidth;

/// Time over which expectations are averaged, TTIs.
const AVERAGING_TTIS: f32 = 512.0;

/// Battery share below which a device is compared only with its own baseline. Between this share and a full battery the
/// weight of the baseline falls gradually.
const SCARCE_SHARE: f32 = 0.5;

/// Average expectation of each device, as a multiple of the expectation by age and α.
#[derive(Clone, Debug)]
pub(super) struct ExpectationBaseline {
    average_ratios: Vec<f32>,
    vector_width: VectorWidth,
}

impl ExpectationBaseline {
    /// Creates the baseline of `n` devices before the first TTI: the expectation by age and α.
    pub(super) fn new(n: usize) -> Self {
        Self {
            average_ratios: vec![1.0; n],
            vector_width: VectorWidth::fastest(),
        }
    }

    /// Computes the price factor of each device and updates its average; called once per TTI. `log_ratios` are the
    /// logarithms of the ratios of expected events to the expectation by age and α, `levels` the batteries as shares of
    /// E_max. If every logarithm has been 0, the factors are exactly 1, so that an untrained `dt` decides as
    /// `age-index`.
    pub(super) fn update_factors(&mut self, log_ratios: &[f32], levels: &[f32], factors: &mut [f64]) {
        self.vector_width.run(FactorUpdate {
            average_ratios: &mut self.average_ratios,
            log_ratios,
            levels,
            factors,
        });
    }
}

/// A call of [`ExpectationBaseline::update_factors`]: a type, since a closure may not be inlined into
/// [`VectorWidth::run`].
struct FactorUpdate<'a> {
    average_ratios: &'a mut [f32],
    log_ratios: &'a [f32],
    levels: &'a [f32],
    factors: &'a mut [f64],
}

impl NullaryFnOnce for FactorUpdate<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let averages = self.average_ratios.iter_mut().zip(self.log_ratios).zip(self.levels);
        for (((average, &log_ratio), level), factor) in averages.zip(self.factors) {
            *average += (exp(log_ratio) - *average) / AVERAGING_TTIS;
            let weight = ((1.0 - level) / (1.0 - SCARCE_SHARE)).clamp(0.0, 1.0);
            *factor = f64::from(exp(weight * log(*average) - log_ratio));
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};

    use super::*;

    #[test]
    fn the_baseline_applies_in_full_to_a_scarce_battery_and_not_to_a_full_one() {
        let mut baseline = ExpectationBaseline::new(2);
        let mut factors = |log_ratios: [f32; 2], levels: [f32; 2]| {
            let mut factors = [0.0; 2];
            baseline.update_factors(&log_ratios, &levels, &mut factors);
            factors
        };
        assert_eq!(factors([0.0; 2], [0.0, 0.3]).map(f64::to_bits), [1.0_f64.to_bits(); 2]);
        let usual = [4.0, 0.5].map(libm::logf);
        for _ in 0..20_000 {
            factors(usual, [1.0; 2]);
        }
        for (log_ratios, levels, expected) in [
            (usual, [1.0, 1.0], [0.25, 2.0]),
            (usual, [0.75, 0.5], [0.5, 1.0]),
            (usual, [0.2, 0.0], [1.0, 1.0]),
            ([8.0, 0.5].map(libm::logf), [0.0, 1.0], [0.5, 2.0]),
        ] {
            for (factor, expected) in factors(log_ratios, levels).into_iter().zip(expected) {
                assert!(
                    (factor - expected).abs() < 0.01,
                    "price factor {factor}, not {expected}"
                );
            }
        }
    }

    #[test]
    fn factors_have_the_same_bits_for_every_vector_width() {
        const N: usize = 37;
        let mut stream = Stream::new(6, Purpose::Training, 0);
        let mut draw =
            |low: f64, high: f64| -> Vec<f32> { (0..N).map(|_| (low + (high - low) * stream.unit()) as f32).collect() };
        let ttis: Vec<_> = (0..20).map(|_| (draw(-3.0, 3.0), draw(0.0, 1.0))).collect();
        let factors_with = |width: VectorWidth| {
            let (mut baseline, mut factors) = (ExpectationBaseline::new(N), vec![0.0; N]);
            baseline.vector_width = width;
            for (log_ratios, levels) in &ttis {
                baseline.update_factors(log_ratios, levels, &mut factors);
            }
            factors.iter().map(|factor| factor.to_bits()).collect::<Vec<_>>()
        };
        let widths = VectorWidth::supported();
        for width in &widths[1..] {
            assert_eq!(factors_with(*width), factors_with(widths[0]), "{width:?}");
        }
    }
}
