//! Battery level under a fixed duty cycle (Sec. III-B): the steady state of the Markov chain, Eq. (8) in its forms, and
//! device machines.
//!
//! The chain uses a lattice of whole quanta, one fourteenth of a unit with the costs of Table II. The machines count in
//! micro-units, where E_WuR is 6/14 of a micro-unit more than a quantum. Levels of both are rounded to the nearest
//! quantum and put into bins of [`BatteryStudy::bin_width`] units, so that no bin border splits levels that are equal
//! in the chain. Only `reveille analyse battery` and docs/analysis.md show the results. Names in errors, such as `e-b`
//! and `bin`, are options of that command.

mod chain;
mod eq8;
mod lattice;
mod measured;

pub(crate) use chain::steady_state;
pub use chain::{ChainInput, SteadyState};
pub use eq8::{Eq8, Eq8Input, highest_state};
pub use lattice::Lattice;
pub use measured::SampleConfig;

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use super::AnalysisError;
use super::harvest::LambdaReading;
use reveille_lab::stats::Estimate;

/// Minimum number of measured devices; intervals are taken between devices.
const MIN_DEVICES: u32 = 2;
/// Maximum number of simulated device-TTIs, the warm-up included.
const MAX_DEVICE_TTIS: u64 = 100_000_000_000;

/// One battery under one duty cycle.
#[derive(Clone, Copy, Debug)]
pub struct BatteryStudy {
    /// Battery and costs.
    pub model: EnergyModel,
    /// Reading of λ.
    pub reading: LambdaReading,
    /// Rate λ of arrivals, as the reading defines it.
    pub lambda: f64,
    /// Duration τ of a TTI.
    pub tau: f64,
    /// E_B, > 0.
    pub e_b: Energy,
    /// t_on, TTIs, `0 ..= t_drx`.
    pub t_on: u32,
    /// t_DRX, TTIs, ≥ 1.
    pub t_drx: u32,
    /// Probability that the device becomes active in a TTI: P_1,2 + P_4,2.
    pub activation: f64,
    /// Sample to measure; at least 2 devices and one TTI.
    pub sample: SampleConfig,
    /// Width of a bin of the distributions, units, at least a quantum.
    pub bin_width: f64,
}

/// Pr(B ≥ E) by the chain, the machines and Eq. (8). Levels are taken at the end of a TTI.
#[derive(Clone, Copy, Debug)]
pub struct Availability {
    /// E, units.
    pub threshold: f64,
    /// Probability by the chain.
    pub chain: f64,
    /// Share measured on device machines; the interval is between devices.
    pub measured: Estimate,
    /// Values of Eq. (8).
    pub eq8: Eq8,
}

/// A bin of battery levels, [`BatteryStudy::bin_width`] wide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LevelBin {
    /// Lower edge, units.
    pub from: f64,
    /// Probability by the chain.
    pub chain: f64,
    /// Share of the measured TTIs.
    pub measured: f64,
}

/// Results of a study.
#[derive(Clone, Debug)]
pub struct BatteryComparison {
    /// Lattice of the chain.
    pub lattice: Lattice,
    /// Probability of an arrival in a TTI.
    pub arrival: f64,
    /// Steady state of the chain.
    pub steady: SteadyState,
    /// Distributions by the chain and by the machines, from the empty battery up.
    pub bins: Vec<LevelBin>,
    /// Total variation distance between both distributions over these bins, `[0, 1]`.
    pub total_variation: f64,
    /// Mean battery by the chain, units.
    pub chain_mean: f64,
    /// Mean battery measured, units; the interval is between devices.
    pub measured_mean: Estimate,
    /// Pr(B ≥ E_Tx) and Pr(B ≥ E_idle).
    pub availability: [Availability; 2],
}

/// Solves the chain, runs the devices and compares both.
///
/// # Errors
/// If a value is out of its range, the energies have no common quantum, or the chain mixes too slowly.
pub fn compare(study: &BatteryStudy) -> Result<BatteryComparison, AnalysisError> {
    study.check()?;
    let lattice = Lattice::new(&study.model, study.e_b)?;
    let chain_input = study.chain_input();
    let steady = steady_state(&lattice, &chain_input)?;
    let level_bins = LevelBins::new(&lattice, study.bin_width)?;
    let counts_by_device = measured::count_levels(&study.model, study.e_b, &lattice, &chain_input, &study.sample);
    let shares: Vec<Vec<f64>> = counts_by_device.iter().map(|counts| shares_of_counts(counts)).collect();
    let pooled_shares: Vec<f64> = (0..lattice.level_count())
        .map(|level| shares.iter().map(|device_shares| device_shares[level]).sum::<f64>() / shares.len() as f64)
        .collect();
    let by_chain = level_bins.sum_levels(&steady.level_probabilities);
    let by_devices = level_bins.sum_levels(&pooled_shares);
    let bin = |(index, (chain, measured)): (usize, (f64, f64))| LevelBin {
        from: index as f64 * study.bin_width,
        chain,
        measured,
    };
    let bins: Vec<LevelBin> = by_chain.into_iter().zip(by_devices).enumerate().map(bin).collect();
    let distance: f64 = bins.iter().map(|bin| (bin.chain - bin.measured).abs()).sum();
    let availability = |threshold: Energy| study.availability(&lattice, threshold, &steady, &shares);
    let mean_battery = |probabilities: &[f64]| mean_level(probabilities) / lattice.quanta_per_unit as f64;
    Ok(BatteryComparison {
        lattice,
        arrival: chain_input.arrival,
        total_variation: distance / 2.0,
        bins,
        chain_mean: mean_battery(&steady.level_probabilities),
        measured_mean: Estimate::from_values_or_nan(shares.iter().map(|device_shares| mean_battery(device_shares))),
        availability: [study.model.e_tx, study.model.e_idle].map(availability),
        steady,
    })
}

impl BatteryStudy {
    /// Input of the chain for this study.
    pub fn chain_input(&self) -> ChainInput {
        ChainInput {
            t_on: self.t_on,
            t_drx: self.t_drx,
            arrival: self.reading.probability(self.lambda, self.tau),
            activation: self.activation,
        }
    }

    fn check(&self) -> Result<(), AnalysisError> {
        self.chain_input().check()?;
        if self.e_b == Energy::ZERO {
            return Err(AnalysisError::invalid("e-b", &0, "must be above 0 units"));
        }
        let SampleConfig {
            devices, ttis, warm_up, ..
        } = self.sample;
        if devices < MIN_DEVICES {
            let requirement = format!("must be at least {MIN_DEVICES}, because intervals are computed between devices");
            return Err(AnalysisError::invalid("devices", &devices, requirement));
        }
        let device_ttis = ttis.saturating_add(warm_up).saturating_mul(u64::from(devices));
        if ttis == 0 || device_ttis > MAX_DEVICE_TTIS {
            let requirement = format!(
                "must be at least 1, and with the warm-up and all devices at most {MAX_DEVICE_TTIS} device-TTIs"
            );
            return Err(AnalysisError::invalid("ttis", &ttis, requirement));
        }
        Ok(())
    }

    fn availability(
        &self,
        lattice: &Lattice,
        threshold: Energy,
        steady: &SteadyState,
        shares: &[Vec<f64>],
    ) -> Availability {
        let level = lattice.nearest_level(threshold);
        let m = highest_state(self.model.e_max.units(), self.e_b.units(), self.lambda);
        Availability {
            threshold: threshold.units(),
            chain: steady.probability_at_least(level),
            measured: Estimate::from_values_or_nan(
                shares
                    .iter()
                    .map(|device_shares| device_shares.iter().skip(level).sum()),
            ),
            eq8: Eq8::new(Eq8Input {
                e: threshold.units(),
                e_max: self.model.e_max.units(),
                m,
                activation: self.activation,
            }),
        }
    }
}

/// Assignment of levels to bins.
struct LevelBins {
    /// Bin of each level.
    bin_of_level: Vec<usize>,
}

impl LevelBins {
    fn new(lattice: &Lattice, width: f64) -> Result<Self, AnalysisError> {
        let quantum = 1.0 / lattice.quanta_per_unit as f64;
        let capacity = lattice.e_max as f64 * quantum;
        if !(width >= quantum && width <= capacity) {
            let requirement =
                format!("must be at least a quantum, {quantum:.6} units, and at most E_max, {capacity} units");
            return Err(AnalysisError::invalid("bin", &width, requirement));
        }
        // Up to rounding, a level that is a multiple of the width begins a bin.
        let bin_of = |level: usize| (level as f64 * quantum / width + 1e-9).floor() as usize;
        Ok(Self {
            bin_of_level: (0..lattice.level_count()).map(bin_of).collect(),
        })
    }

    fn sum_levels(&self, probabilities: &[f64]) -> Vec<f64> {
        // Bins rise with levels, so the last level has the last bin.
        let last = self.bin_of_level.last().copied().unwrap_or_default();
        let mut sums = vec![0.0; last + 1];
        for (bin, probability) in self.bin_of_level.iter().zip(probabilities) {
            sums[*bin] += probability;
        }
        sums
    }
}

fn shares_of_counts(counts: &[u64]) -> Vec<f64> {
    let all: u64 = counts.iter().sum();
    counts.iter().map(|&count| count as f64 / all as f64).collect()
}

/// Σ level · probability, quanta.
fn mean_level(probabilities: &[f64]) -> f64 {
    probabilities
        .iter()
        .enumerate()
        .map(|(level, p)| level as f64 * p)
        .sum()
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::load;

    use super::*;

    fn study_of(e_b: f64, t_on: u32, t_drx: u32, activation: f64) -> BatteryStudy {
        let scenario = load("paper", &[]).expect("the preset");
        BatteryStudy {
            model: scenario.scenario.classes[0].energy,
            reading: LambdaReading::Eq5,
            lambda: 0.1,
            tau: 1.0,
            e_b: Energy::from_units(e_b).expect("in range"),
            t_on,
            t_drx,
            activation,
            sample: SampleConfig {
                seed: 3,
                devices: 8,
                ttis: 150_000,
                warm_up: 20_000,
            },
            bin_width: 0.5,
        }
    }

    #[test]
    fn the_chain_agrees_with_simulated_devices() {
        for e_b in [1.0, 5.0, 10.0] {
            for (t_on, t_drx, activation) in [(1, 2, 0.0), (1, 5, 0.0), (2, 16, 0.0), (0, 1, 0.0), (1, 8, 0.02)] {
                let study = study_of(e_b, t_on, t_drx, activation);
                let comparison = compare(&study).expect("a comparison");
                assert!(
                    comparison.total_variation <= 0.02,
                    "E_B {e_b}, duty cycle {t_on}/{t_drx}: total variation {}",
                    comparison.total_variation
                );
                assert!((comparison.bins.iter().map(|bin| bin.chain).sum::<f64>() - 1.0).abs() < 1e-9);
                assert!((comparison.bins.iter().map(|bin| bin.measured).sum::<f64>() - 1.0).abs() < 1e-9);
                for availability in comparison.availability {
                    assert!(
                        (availability.chain - availability.measured.mean).abs() <= 0.02,
                        "{study:?}: {availability:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn levels_are_in_the_bins_of_their_energies() {
        let lattice = Lattice::new(&study_of(5.0, 1, 2, 0.0).model, Energy::from_micro(5_000_000)).expect("a lattice");
        let bins = LevelBins::new(&lattice, 0.5).expect("bins");
        assert_eq!(
            [0, 6, 7, 13, 14, 1399, 1400].map(|level| bins.bin_of_level[level]),
            [0, 0, 1, 1, 2, 199, 200]
        );
        assert!(LevelBins::new(&lattice, 0.01).is_err() && LevelBins::new(&lattice, f64::NAN).is_err());
    }

    #[test]
    fn invalid_studies_are_refused_with_the_field() {
        let valid = study_of(5.0, 1, 2, 0.0);
        let error_with = |change: &dyn Fn(&mut BatteryStudy)| {
            let mut invalid = valid;
            change(&mut invalid);
            compare(&invalid).expect_err("refused").to_string()
        };
        assert!(error_with(&|study| study.sample.devices = 1).contains("devices = 1"));
        assert!(error_with(&|study| study.sample.ttis = 0).contains("ttis = 0"));
        assert!(error_with(&|study| study.bin_width = 1000.0).contains("bin = 1000"));
        assert!(error_with(&|study| study.e_b = Energy::ZERO).contains("e-b = 0"));
        assert!(error_with(&|study| study.t_on = 3).contains("t_on = 3"));
        assert!(error_with(&|study| study.lambda = 0.0).contains("Pr(arrival) = 0"));
    }
}
