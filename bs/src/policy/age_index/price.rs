//! What looking is worth, and what it costs.

use std::f64::consts::PI;

use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use crate::beliefs::ages::{OLDEST, Worths};
use crate::knowledge::Knowledge;

/// The age from which on a place is worth no more, TTIs. It is the last whose worth a byte holds; few events are still
/// on after that long, and a place that no device reaches counts for nobody anyhow.
const LEVEL: usize = 22;

/// The worth of a reach whose places are all of age `LEVEL` or more: what a look can be worth.
pub const MOST: f64 = (LEVEL * (LEVEL + 1) / 2) as f64;

/// How much dearer a device is with an empty battery than with a full one. Its price rises with the square of what is
/// missing, so that devices which are nearly full, of which harvest is lost, cost the same, and low ones are spared for
/// the reports that only they can give.
const DEARNESS: f64 = 3.0;

/// What is to be left in a battery after a TTI in S1 and a report, as a share of E_max: wake-ups ask for more than one
/// report, and estimated levels may be wrong.
const RESERVE: f64 = 0.03;

/// A price that stands for none, so that ratios to it are numbers.
const FREE: f64 = 1e-30;

/// The worth of each age a: a(a + 1)/2, Whittle's index of a place if an event costs the same in each TTI in which it
/// is not found.
pub fn worths() -> Worths {
    let of = |age: usize| age.min(LEVEL) * (age.min(LEVEL) + 1) / 2;
    let worths: [usize; OLDEST + 1] = std::array::from_fn(of);
    worths.map(|worth| worth as u8)
}

/// The level from which on a device may be told to sense.
pub fn needed(energy: &EnergyModel) -> Energy {
    let reserve = RESERVE * energy.e_max.micro() as f64;
    energy.e_idle + energy.e_tx + Energy::from_micro(reserve as u64)
}

/// The area that one device looks at, m²: the integral of the probability that it detects an event over the places
/// around it.
pub fn reach(sensing: &Sensing) -> f64 {
    let Sensing { d_max, eta, kind, .. } = *sensing;
    match kind {
        DetectionKind::Range => PI * d_max * d_max,
        DetectionKind::Probabilistic => {
            let x = eta * d_max;
            2.0 * PI * (1.0 - libm::exp(-x) * (1.0 + x)) / (eta * eta)
        }
    }
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
        for (j, (now, &level)) in self.now.iter_mut().zip(levels).enumerate() {
            *now = if level < self.needed[j] {
                f64::INFINITY
            } else {
                let missing = 1.0 - level.micro() as f64 / self.e_max[j].micro() as f64;
                (self.full[j] * (1.0 + DEARNESS * missing * missing)).max(FREE)
            };
        }
        &self.now
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::sensing::Fusion;

    use super::*;

    #[test]
    fn ages_are_worth_the_triangular_numbers_up_to_a_byte() {
        let worths = worths();
        assert_eq!(worths[..5], [0, 1, 3, 6, 10]);
        assert_eq!(
            (worths[21], worths[22], worths[23], worths[OLDEST]),
            (231, 253, 253, 253)
        );
    }

    #[test]
    fn the_reach_is_what_a_device_sees_of_the_places_around_it() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            let sensing = Sensing {
                kind,
                d_max: 3.0,
                eta: 0.7,
                psi: 1.0,
                g: Fusion::Max,
            };
            // Rings of a thousandth of a metre.
            let ring = |i: u32| {
                let d = (f64::from(i) + 0.5) * 1e-3;
                let p = if kind == DetectionKind::Range {
                    1.0
                } else {
                    libm::exp(-0.7 * d)
                };
                p * 2.0 * PI * d * 1e-3
            };
            let sum: f64 = (0..3000).map(ring).sum();
            assert!(
                (reach(&sensing) - sum).abs() < 1e-4,
                "{kind:?}: {}, not {sum}",
                reach(&sensing)
            );
        }
    }
}
