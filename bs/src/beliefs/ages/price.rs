//! What looking is worth, and what it costs.

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use crate::beliefs::ages::FREE;
use crate::knowledge::Knowledge;

/// How much dearer a device is with an empty battery than with a full one. Its price rises with the square of what is
/// missing, so that devices which are nearly full, of which harvest is lost, cost the same, and low ones are spared for
/// the reports that only they can give.
const DEARNESS: f64 = 3.0;

/// What is to be left in a battery after a TTI in S1 and a report, as a share of E_max: wake-ups ask for more than one
/// report, and estimated levels may be wrong.
const RESERVE: f64 = 0.03;

/// The level from which on a device may be told to sense.
pub fn needed(energy: &EnergyModel) -> Energy {
    let reserve = RESERVE * energy.e_max.micro() as f64;
    energy.e_idle + energy.e_tx + Energy::from_micro(reserve as u64)
}

/// What a TTI in S1 costs each device.
#[derive(Clone, Debug)]
pub struct Prices {
    /// By device, with a full battery.
    full: Vec<f64>,
    needed: Vec<Energy>,
    e_max: Vec<Energy>,
    /// By device, in this TTI; infinite for one that may not sense.
    now: Vec<f64>,
}

impl Prices {
    /// For the devices in `known`, `price` a TTI in S1 on average over them. A device of a class that spends more in
    /// S1, beyond what it spends asleep, is dearer in proportion.
    pub fn new(known: &Knowledge, price: f64) -> Self {
        let extra = |energy: &EnergyModel| energy.e_idle.saturating_sub(energy.e_wur).micro() as f64;
        let energies = || known.devices.iter().map(|device| &device.energy);
        let mean = energies().map(extra).sum::<f64>() / known.n() as f64;
        let share = |energy: &EnergyModel| if mean > 0.0 { extra(energy) / mean } else { 0.0 };
        Self {
            full: energies().map(|energy| price * share(energy)).collect(),
            needed: energies().map(needed).collect(),
            e_max: energies().map(|energy| energy.e_max).collect(),
            now: vec![f64::INFINITY; known.n()],
        }
    }

    /// The prices of devices with these battery `levels`.
    pub fn at(&mut self, levels: &[Energy]) -> &[f64] {
        self.scaled(levels, |_| 1.0)
    }

    /// The same, but that dearness goes by the levels that batteries are expected to come to, `expected`, E_max at the
    /// most.
    pub fn ahead(&mut self, levels: &[Energy], expected: &[Energy]) -> &[f64] {
        self.dear(levels, expected, |_| 1.0)
    }

    /// The prices of devices with these battery `levels`, that of each times its `factor`, > 0.
    pub fn scaled(&mut self, levels: &[Energy], factor: impl Fn(usize) -> f64) -> &[f64] {
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
