//! Lattice with a common quantum for all energies of a device, so that its battery has finitely many levels: the states
//! of the chain ([`super::steady_state`]), and the bins of measured levels. Only `reveille analyse battery` uses it.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::{Energy, MICRO_PER_UNIT};

use crate::analysis::AnalysisError;

/// Resolution of the finest lattice tried, quanta a unit; [`Lattice::new`] repeats it and the next constant.
const MAX_QUANTA_PER_UNIT: u64 = 1000;
/// Maximum distance of an energy from whole quanta, quanta. E_WuR, 71 429 micro-units, is 6·10⁻⁶ off one fourteenth.
const MAX_ROUNDING_QUANTA: f64 = 1e-5;
/// Maximum number of battery levels of a chain.
const MAX_LEVELS: u64 = 200_000;

/// The energies of a device in whole quanta.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lattice {
    /// Quanta in a unit: 14 with the costs of Table II.
    pub quanta_per_unit: u64,
    /// `E_max`, quanta.
    pub e_max: usize,
    /// `E_idle`, quanta.
    pub e_idle: usize,
    /// `E_WuR`, quanta.
    pub e_wur: usize,
    /// `E_Tx`, quanta.
    pub e_tx: usize,
    /// `E_B`, quanta.
    pub e_b: usize,
}

impl Lattice {
    /// Finds the coarsest lattice that represents all energies of `model` and `e_b` to within 10⁻⁵ of a quantum.
    ///
    /// # Errors
    /// If that needs more than 1000 quanta a unit, or the battery would have too many levels.
    pub fn new(model: &EnergyModel, e_b: Energy) -> Result<Self, AnalysisError> {
        let energies = [model.e_max, model.e_idle, model.e_wur, model.e_tx, e_b];
        let fits = |per_unit: &u64| {
            energies
                .iter()
                .all(|&e| rounding_error(e, *per_unit) <= MAX_ROUNDING_QUANTA)
        };
        // Tries the coarsest first, since the work of the chain grows with the number of levels.
        let Some(per_unit) = (1..=MAX_QUANTA_PER_UNIT).find(fits) else {
            let value = energies.map(|e| e.units().to_string()).join(", ");
            let requirement = format!(
                "E_max, E_idle, E_WuR, E_Tx and E_B must be multiples of a common quantum of 1/n unit, n up to \
                 {MAX_QUANTA_PER_UNIT}, for the battery to have few enough levels; round them, for example to \
                 hundredths of a unit"
            );
            return Err(AnalysisError::invalid("energies (units)", &value, requirement));
        };
        let [e_max, e_idle, e_wur, e_tx, e_b] = energies.map(|e| to_quanta(e, per_unit));
        if e_max >= MAX_LEVELS {
            let requirement = format!(
                "with {per_unit} quanta per unit the battery has {} levels, but the chain takes at most {MAX_LEVELS}; \
                 use a smaller battery or coarser costs",
                e_max + 1
            );
            return Err(AnalysisError::invalid(
                "energy.e_max",
                &model.e_max.units(),
                requirement,
            ));
        }
        Ok(Self {
            quanta_per_unit: per_unit,
            e_max: e_max as usize,
            e_idle: e_idle as usize,
            e_wur: e_wur as usize,
            e_tx: e_tx as usize,
            e_b: e_b as usize,
        })
    }

    /// Number of battery levels, the empty one included.
    pub const fn level_count(&self) -> usize {
        self.e_max + 1
    }

    /// Level nearest to `energy`, at most the full battery.
    pub fn nearest_level(&self, energy: Energy) -> usize {
        (to_quanta(energy, self.quanta_per_unit) as usize).min(self.e_max)
    }
}

/// Converts `energy` to quanta, rounded to the nearest.
fn to_quanta(energy: Energy, per_unit: u64) -> u64 {
    let quanta = (u128::from(energy.micro()) * u128::from(per_unit) + u128::from(MICRO_PER_UNIT) / 2)
        / u128::from(MICRO_PER_UNIT);
    u64::try_from(quanta).unwrap_or(u64::MAX)
}

/// Distance of `energy` from a whole number of quanta, in quanta.
fn rounding_error(energy: Energy, per_unit: u64) -> f64 {
    let whole = u128::from(to_quanta(energy, per_unit)) * u128::from(MICRO_PER_UNIT);
    (u128::from(energy.micro()) * u128::from(per_unit)).abs_diff(whole) as f64 / MICRO_PER_UNIT as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn energy_model(units: [f64; 4]) -> EnergyModel {
        let [e_max, e_idle, e_wur, e_tx] = units.map(|value| Energy::from_units(value).expect("in range"));
        EnergyModel {
            e_max,
            e_idle,
            e_wur,
            e_tx,
            initial: Energy::ZERO,
        }
    }

    #[test]
    fn the_quantum_of_table_ii_is_a_fourteenth() {
        let table_ii = energy_model([100.0, 1.0, 1.0 / 14.0, 10.0]);
        let lattice = Lattice::new(&table_ii, Energy::from_micro(5_000_000)).expect("a lattice");
        let expected = Lattice {
            quanta_per_unit: 14,
            e_max: 1400,
            e_idle: 14,
            e_wur: 1,
            e_tx: 140,
            e_b: 70,
        };
        assert_eq!(lattice, expected);
        assert_eq!(lattice.nearest_level(Energy::from_micro(999_976)), 14);
        assert_eq!(lattice.nearest_level(Energy::from_micro(100_000_000)), 1400);
        let half_arrival = Lattice::new(&table_ii, Energy::from_micro(2_500_000)).expect("a lattice");
        assert_eq!((half_arrival.quanta_per_unit, half_arrival.e_b), (14, 35));
    }

    #[test]
    fn values_without_a_lattice_are_refused() {
        let irregular = Lattice::new(&energy_model([100.0, 1.0, 0.071_234, 10.0]), Energy::from_micro(1));
        assert!(
            irregular
                .expect_err("no lattice")
                .to_string()
                .contains("common quantum")
        );
        let large = Lattice::new(
            &energy_model([10_000.0, 1.0, 0.01, 10.0]),
            Energy::from_micro(1_000_000),
        );
        assert!(large.expect_err("too large").to_string().contains("1000001 levels"));
    }
}
