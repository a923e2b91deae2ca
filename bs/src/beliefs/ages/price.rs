//! Prices of TTIs in S1, and the battery level that sensing requires.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use super::FREE;
use crate::knowledge::Knowledge;

/// Relative extra price of a device with an empty battery. The price grows with the square of the missing charge. So
/// nearly full devices, which lose harvest, all cost about the same, and low devices are kept for reports that only
/// they can give.
const DEARNESS: f64 = 3.0;

/// Reserve after a TTI in S1 and a report, as a share of E_max: wake-ups need further reports, and estimates may be
/// wrong.
const RESERVE: f64 = 0.03;

/// Returns the lowest battery level at which a plan may let a device sense.
pub fn min_level(energy: &EnergyModel) -> Energy {
    let reserve = RESERVE * energy.e_max.micro() as f64;
    energy.e_idle + energy.e_tx + Energy::from_micro(reserve as u64)
}

/// The price of a TTI in S1 for each device.
#[derive(Clone, Debug)]
pub(crate) struct Prices {
    /// Price with a full battery, by device.
    full: Vec<f64>,
    needed: Vec<Energy>,
    e_max: Vec<Energy>,
    /// Price in this TTI, by device; infinite if the device may not sense.
    now: Vec<f64>,
}

impl Prices {
    /// Creates prices with the mean `price` per TTI in S1 over the devices in `known`. The price of a class is
    /// proportional to its extra energy in S1 over S4.
    pub(crate) fn new(known: &Knowledge, price: f64) -> Self {
        let extra = |energy: &EnergyModel| energy.e_idle.saturating_sub(energy.e_wur).micro() as f64;
        let energies = || known.devices.iter().map(|device| &device.energy);
        let mean = energies().map(extra).sum::<f64>() / known.n() as f64;
        // If S1 costs no more than S4 in any class, sensing costs nothing.
        let share = |energy: &EnergyModel| if mean > 0.0 { extra(energy) / mean } else { 0.0 };
        Self {
            full: energies().map(|energy| price * share(energy)).collect(),
            needed: energies().map(min_level).collect(),
            e_max: energies().map(|energy| energy.e_max).collect(),
            now: vec![f64::INFINITY; known.n()],
        }
    }

    /// Returns the prices for the battery `levels`.
    pub(crate) fn at(&mut self, levels: &[Energy]) -> &[f64] {
        self.scaled(levels, |_| 1.0)
    }

    /// Returns the prices, where the extra price of low batteries follows the `expected` levels, at most E_max.
    pub(crate) fn with_foresight(&mut self, levels: &[Energy], expected: &[Energy]) -> &[f64] {
        self.dear(levels, expected, |_| 1.0)
    }

    /// Returns the prices for the battery `levels`, each multiplied by its `factor`, > 0.
    pub(crate) fn scaled(&mut self, levels: &[Energy], factor: impl Fn(usize) -> f64) -> &[f64] {
        self.dear(levels, levels, factor)
    }

    fn dear(&mut self, levels: &[Energy], dear_by: &[Energy], factor: impl Fn(usize) -> f64) -> &[f64] {
        for (j, (now, &level)) in self.now.iter_mut().zip(levels).enumerate() {
            *now = if level < self.needed[j] {
                f64::INFINITY
            } else {
                let missing = 1.0 - dear_by[j].micro() as f64 / self.e_max[j].micro() as f64;
                (self.full[j] * (1.0 + DEARNESS * missing * missing) * factor(j)).max(FREE)
            };
        }
        &self.now
    }
}
