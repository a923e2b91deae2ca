//! What a device is usually expected to find, which counts for nothing where energy is scarce.
//!
//! A device at a hot spot would always be told to look: its price is always low. While its battery is full it should;
//! but where it spends all that it harvests anyway, looking now is looking less later, and all that tells is whether
//! more is expected now than usual.

use reveille_common::units::Energy;

/// TTIs over which expectations are averaged.
const TTIS: f64 = 512.0;

/// The share of its battery below which a device is compared with itself alone; between that and a full one by and by.
const SCARCE: f64 = 0.5;

/// What each device is usually expected to find, as a multiple of what age and α say.
#[derive(Clone, Debug)]
pub struct Usual {
    means: Vec<f64>,
}

impl Usual {
    /// Of `n` devices, before the first TTI: what age and α say.
    pub fn new(n: usize) -> Self {
        Self { means: vec![1.0; n] }
    }

    /// The factor of device `j`'s price in a TTI in which it is expected to find `expected` times as many events as age
    /// and α say, with a battery of `level` of at most `e_max`.
    pub fn factor(&mut self, j: usize, expected: f64, level: Energy, e_max: Energy) -> f64 {
        let mean = &mut self.means[j];
        *mean += (expected - *mean) / TTIS;
        let missing = 1.0 - level.micro() as f64 / e_max.micro() as f64;
        libm::pow(*mean, (missing / (1.0 - SCARCE)).clamp(0.0, 1.0)) / expected
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_usual_counts_with_a_full_battery_alone() {
        let energy = Energy::from_micro;
        let mut usual = Usual::new(2);
        assert_eq!(
            usual.factor(0, 1.0, energy(0), energy(100)).to_bits(),
            1.0_f64.to_bits()
        );
        for _ in 0..20_000 {
            usual.factor(0, 4.0, energy(100), energy(100));
            usual.factor(1, 0.5, energy(100), energy(100));
        }
        let close = |factor: f64, expected: f64| assert!((factor - expected).abs() < 0.01, "{factor}, not {expected}");
        close(usual.factor(0, 4.0, energy(100), energy(100)), 0.25);
        close(usual.factor(0, 4.0, energy(75), energy(100)), 0.5);
        close(usual.factor(0, 4.0, energy(20), energy(100)), 1.0);
        close(usual.factor(0, 8.0, energy(0), energy(100)), 0.5);
        close(usual.factor(1, 0.5, energy(100), energy(100)), 2.0);
        close(usual.factor(1, 0.5, energy(50), energy(100)), 1.0);
    }
}
