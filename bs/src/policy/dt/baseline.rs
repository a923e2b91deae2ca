//! Moving average of each device's ratio of expected events to the expectation by age and α. Where energy is scarce, it
//! discounts the ratio in the price factor of `dt` ([`ExpectationBaseline::price_factor`]). Digests depend on it, and
//! docs/dt.md states its constants. The training does not use it, so a change needs no new model. Without the baseline,
//! a device at a hot spot would always sense, since its price is always low. That is right while its battery is full.
//! For a device that spends all its harvest, sensing now costs sensing later, and only the ratio of current to usual
//! expectation matters.

use reveille_common::units::Energy;

/// Time over which expectations are averaged, TTIs.
const AVERAGING_TTIS: f64 = 512.0;

/// Battery share below which a device is compared only with its own baseline. Between this share and a full battery the
/// weight of the baseline falls gradually.
const SCARCE_SHARE: f64 = 0.5;

/// Average expectation of each device, as a multiple of the expectation by age and α.
#[derive(Clone, Debug)]
pub(super) struct ExpectationBaseline {
    average_ratios: Vec<f64>,
}

impl ExpectationBaseline {
    /// Creates the baseline of `n` devices before the first TTI: the expectation by age and α.
    pub(super) fn new(n: usize) -> Self {
        Self {
            average_ratios: vec![1.0; n],
        }
    }

    /// Returns the price factor of device `j` and updates its average; called once per device and TTI. `ratio`, > 0, is
    /// the ratio of expected events to the expectation by age and α; the battery holds `level` of at most `e_max`. If
    /// every ratio has been 1, the factor is exactly 1, so that an untrained `dt` decides as `age-index`.
    pub(super) fn price_factor(&mut self, j: usize, ratio: f64, level: Energy, e_max: Energy) -> f64 {
        let average_ratio = &mut self.average_ratios[j];
        *average_ratio += (ratio - *average_ratio) / AVERAGING_TTIS;
        let missing_share = 1.0 - level.micro() as f64 / e_max.micro() as f64;
        libm::pow(*average_ratio, (missing_share / (1.0 - SCARCE_SHARE)).clamp(0.0, 1.0)) / ratio
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_baseline_applies_in_full_to_a_scarce_battery_and_not_to_a_full_one() {
        let energy = Energy::from_micro;
        let mut baseline = ExpectationBaseline::new(2);
        assert_eq!(
            baseline.price_factor(0, 1.0, energy(0), energy(100)).to_bits(),
            1.0_f64.to_bits()
        );
        for _ in 0..20_000 {
            baseline.price_factor(0, 4.0, energy(100), energy(100));
            baseline.price_factor(1, 0.5, energy(100), energy(100));
        }
        let assert_close = |factor: f64, expected: f64| {
            assert!(
                (factor - expected).abs() < 0.01,
                "price factor {factor}, not {expected}"
            );
        };
        assert_close(baseline.price_factor(0, 4.0, energy(100), energy(100)), 0.25);
        assert_close(baseline.price_factor(0, 4.0, energy(75), energy(100)), 0.5);
        assert_close(baseline.price_factor(0, 4.0, energy(20), energy(100)), 1.0);
        assert_close(baseline.price_factor(0, 8.0, energy(0), energy(100)), 0.5);
        assert_close(baseline.price_factor(1, 0.5, energy(100), energy(100)), 2.0);
        assert_close(baseline.price_factor(1, 0.5, energy(50), energy(100)), 1.0);
    }
}
