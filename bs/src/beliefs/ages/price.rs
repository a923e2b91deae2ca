//! Prices of TTIs in S1, and the battery level that sensing requires. Prices are in the unit of
//! [`Ages::gain`](super::Ages::gain): a device senses if its gain exceeds its price. Digests of `age-index` and `dt`
//! depend on both; docs/age-index.md states the formula, and `tests/src/reference/age_index.rs` repeats it. Trained
//! models of `dt` rely on [`min_sensing_level`], which decides the feature `can_sense`.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use super::MIN_PRICE;
use crate::knowledge::Knowledge;

/// Relative extra price of a device with an empty battery. The price grows with the square of the missing charge. So
/// nearly full devices, which lose harvest, all cost about the same, and low devices are kept for reports that only
/// they can give.
const EMPTY_BATTERY_SURCHARGE: f64 = 3.0;

/// Reserve after a TTI in S1 and a report, as a share of E_max: wake-ups need further reports, and estimates may be
/// wrong.
const RESERVE_SHARE: f64 = 0.03;

/// Returns the lowest battery level at which a plan may let a device sense.
pub fn min_sensing_level(energy: &EnergyModel) -> Energy {
    let reserve = RESERVE_SHARE * energy.e_max.micro() as f64;
    energy.e_idle + energy.e_tx + Energy::from_micro(reserve as u64)
}

/// The price of a TTI in S1 for each device.
#[derive(Clone, Debug)]
pub(crate) struct Prices {
    /// Price with a full battery, by device.
    at_full_battery: Vec<f64>,
    /// Level below which a device may not sense, by device.
    min_levels: Vec<Energy>,
    e_max: Vec<Energy>,
    /// Price in this TTI, by device; infinite if the device may not sense.
    current: Vec<f64>,
}

impl Prices {
    /// Creates prices for the devices in `known`. `mean_price` is the mean price of a TTI in S1 over all devices with
    /// full batteries, in the unit of [`Ages::gain`](super::Ages::gain): θ times a reach. The price of a class is
    /// proportional to its extra energy in S1 over S4.
    pub(crate) fn new(known: &Knowledge, mean_price: f64) -> Self {
        let extra_energy = |energy: &EnergyModel| energy.e_idle.saturating_sub(energy.e_wur).micro() as f64;
        let energies = || known.devices.iter().map(|device| &device.energy);
        let mean_extra = energies().map(extra_energy).sum::<f64>() / known.n() as f64;
        // If S1 costs no more than S4 in any class, sensing costs nothing.
        let relative_cost = |energy: &EnergyModel| {
            if mean_extra > 0.0 {
                extra_energy(energy) / mean_extra
            } else {
                0.0
            }
        };
        Self {
            at_full_battery: energies().map(|energy| mean_price * relative_cost(energy)).collect(),
            min_levels: energies().map(min_sensing_level).collect(),
            e_max: energies().map(|energy| energy.e_max).collect(),
            current: vec![f64::INFINITY; known.n()],
        }
    }

    /// Returns the price by device for the battery `levels`, by device id.
    pub(crate) fn for_levels(&mut self, levels: &[Energy]) -> &[f64] {
        self.scaled_for_levels(levels, |_| 1.0)
    }

    /// Returns the prices, where the extra price of low batteries follows the `expected` levels, at most E_max.
    pub(crate) fn for_expected_levels(&mut self, levels: &[Energy], expected: &[Energy]) -> &[f64] {
        self.update_prices(levels, expected, |_| 1.0)
    }

    /// Returns the prices for the battery `levels`, each multiplied by its `factor`, > 0.
    pub(crate) fn scaled_for_levels(&mut self, levels: &[Energy], factor: impl Fn(usize) -> f64) -> &[f64] {
        self.update_prices(levels, levels, factor)
    }

    /// Computes the prices. `levels` decide which devices may sense, and `surcharge_levels` the extra price.
    fn update_prices(
        &mut self,
        levels: &[Energy],
        surcharge_levels: &[Energy],
        factor: impl Fn(usize) -> f64,
    ) -> &[f64] {
        for (j, (price, &level)) in self.current.iter_mut().zip(levels).enumerate() {
            *price = if level < self.min_levels[j] {
                f64::INFINITY
            } else {
                let missing = 1.0 - surcharge_levels[j].micro() as f64 / self.e_max[j].micro() as f64;
                (self.at_full_battery[j] * (1.0 + EMPTY_BATTERY_SURCHARGE * missing * missing) * factor(j))
                    .max(MIN_PRICE)
            };
        }
        &self.current
    }
}
