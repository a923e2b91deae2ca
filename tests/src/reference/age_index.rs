//! Choice of sensing devices under `age-index`, from the rule in docs/age-index.md. It computes every place separately
//! and caches nothing between sums.

use std::f64::consts::PI;

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::DetectionKind;

use super::clusters::distance;

/// Relative tolerance: values per price closer than this, or a value this close to its price, can change order with the
/// order of summation.
const CLOSE: f64 = 1e-6;

/// Places of an area with their ages, and the devices that cover them.
#[derive(Clone, Debug)]
pub struct ReferenceAgeIndex {
    /// Probability that a device detects an event at a place, by device and place.
    sees: Vec<Vec<f64>>,
    ages: Vec<f64>,
    positions: Vec<Point>,
    energies: Vec<EnergyModel>,
    d_max: f64,
    /// Price of a TTI in S1, in places of age 1.
    price: f64,
    disc: f64,
}

impl ReferenceAgeIndex {
    /// Creates the index for devices at `positions` with these batteries and costs, at `price`. `None` if rounding
    /// decides whether a place is within a device's range.
    pub fn new(scenario: &Scenario, positions: &[Point], energies: Vec<EnergyModel>, price: f64) -> Option<Self> {
        let (area, sensing) = (scenario.area, &scenario.sensing);
        let along = |length: f64| (7.5 * length / sensing.d_max).ceil().max(1.0);
        let (columns, rows) = (along(area.width), along(area.height));
        let mut places = Vec::new();
        for row in 0..rows as u32 {
            for column in 0..columns as u32 {
                let x = area.width * (f64::from(column) + 0.5) / columns;
                places.push(Point::new(x, area.height * (f64::from(row) + 0.5) / rows));
            }
        }
        let mut sees = Vec::new();
        for position in positions {
            let mut row = Vec::new();
            for place in &places {
                let d = distance(*position, *place);
                if (d - sensing.d_max).abs() < 1e-9 {
                    return None;
                }
                row.push(match sensing.kind {
                    _ if d > sensing.d_max => 0.0,
                    DetectionKind::Range => 1.0,
                    DetectionKind::Probabilistic => libm::exp(-sensing.eta * d),
                });
            }
            sees.push(row);
        }
        let reach = match sensing.kind {
            DetectionKind::Range => PI * sensing.d_max.powi(2),
            DetectionKind::Probabilistic => {
                let x = sensing.eta * sensing.d_max;
                2.0 * PI / sensing.eta.powi(2) * (1.0 - (1.0 + x) * libm::exp(-x))
            }
        };
        let place = area.width * area.height / (columns * rows);
        Some(Self {
            sees,
            ages: vec![1.0; places.len()],
            positions: positions.to_vec(),
            energies,
            d_max: sensing.d_max,
            price: price * reach / place,
            disc: PI * sensing.d_max.powi(2) / place,
        })
    }

    /// Advances the ages by a TTI in which the devices of `looking` sensed.
    pub fn pass(&mut self, looking: &[usize], is_found: bool) {
        for place in 0..self.ages.len() {
            let missed: f64 = looking.iter().map(|&j| 1.0 - self.sees[j][place]).product();
            let old = if is_found { 0.0 } else { self.ages[place] * missed };
            self.ages[place] = (old + 1.0).min(255.0);
        }
    }

    /// Returns the price of each device at these levels, micro-units; infinite for a device that may not sense.
    fn prices(&self, levels: &[u64]) -> Vec<f64> {
        let extra = |energy: &EnergyModel| energy.e_idle.micro().saturating_sub(energy.e_wur.micro()) as f64;
        let all: f64 = self.energies.iter().map(extra).sum();
        let mean = all / self.energies.len() as f64;
        let of = |(energy, &level): (&EnergyModel, &u64)| {
            let e_max = energy.e_max.micro() as f64;
            let reserve = (0.03 * e_max).floor() as u64;
            if level < energy.e_idle.micro() + energy.e_tx.micro() + reserve {
                return f64::INFINITY;
            }
            let cost = if mean > 0.0 { extra(energy) / mean } else { 0.0 };
            let price = self.price * cost * (1.0 + 3.0 * (1.0 - level as f64 / e_max).powi(2));
            price.max(1e-30)
        };
        self.energies.iter().zip(levels).map(of).collect()
    }

    /// Returns the value that sensing by `j` adds to sensing by `others`.
    fn worth(&self, j: usize, others: &[usize]) -> f64 {
        let index = |age: f64| {
            let age = age.min(22.0);
            age * (age + 1.0) / 2.0
        };
        let mut sum = 0.0;
        for (place, &age) in self.ages.iter().enumerate() {
            let below = age.floor();
            let of_age = index(below) + (age - below) * (index(below + 1.0) - index(below));
            let missed: f64 = others.iter().map(|&other| 1.0 - self.sees[other][place]).product();
            sum += of_age * missed * self.sees[j][place];
        }
        sum
    }

    /// Chooses the sensing devices of the next TTI for battery `levels`; `None` if too close to call.
    pub fn choose(&self, levels: &[u64]) -> Option<Vec<usize>> {
        let mut chosen = self.choose_at(&self.prices(levels), &[])?;
        chosen.sort_unstable();
        Some(chosen)
    }

    /// Number of places in a sensing disc: π d_max² divided by the area of a place.
    pub const fn disc(&self) -> f64 {
        self.disc
    }

    /// Chooses sensing devices at these prices in addition to `set`, in order of choice; `None` if too close to call.
    pub fn choose_at(&self, prices: &[f64], set: &[usize]) -> Option<Vec<usize>> {
        let mut chosen = self.one_after_the_other(prices, set)?;
        for turn in 0..2 * chosen.len() {
            let place = turn % chosen.len();
            let Some(j) = chosen[place].take() else { continue };
            let others: Vec<usize> = chosen.iter().flatten().chain(set).copied().collect();
            chosen[place] = self.best_instead(j, &others, prices)?;
        }
        Some(chosen.into_iter().flatten().collect())
    }

    fn one_after_the_other(&self, prices: &[f64], set: &[usize]) -> Option<Vec<Option<usize>>> {
        let mut chosen: Vec<usize> = Vec::new();
        loop {
            let mut ratios = Vec::new();
            for (j, &price) in prices.iter().enumerate() {
                if chosen.contains(&j) || price.is_infinite() {
                    continue;
                }
                let worth = self.worth(j, &[&chosen, set].concat());
                if (worth - price).abs() < CLOSE * price.max(CLOSE) && worth > 0.0 {
                    return None;
                }
                if worth > price {
                    ratios.push((worth / price, j));
                }
            }
            // Largest ratio first; ties go to the lowest number.
            ratios.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let Some(&(most, best)) = ratios.first() else {
                return Some(chosen.into_iter().map(Some).collect());
            };
            if is_close(most, ratios.get(1).map(|second| second.0)) {
                return None;
            }
            chosen.push(best);
        }
    }

    /// Returns the option with the largest net value among `j`, the devices within d_max of it outside `others`, and no
    /// device.
    #[expect(clippy::option_option, reason = "too close to call, or no device")]
    fn best_instead(&self, j: usize, others: &[usize], prices: &[f64]) -> Option<Option<usize>> {
        // On equal net value the first wins: no device, then j, then the lowest number.
        let mut nets = vec![(0.0, 0, None)];
        for (i, price) in prices.iter().enumerate() {
            let is_near = distance(self.positions[i], self.positions[j]) <= self.d_max;
            if others.contains(&i) || !is_near || price.is_infinite() {
                continue;
            }
            let net = self.worth(i, others) - price;
            nets.push((net, if i == j { 1 } else { 2 + i }, Some(i)));
        }
        nets.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let (most, _, best) = nets[0];
        let second = nets.get(1).map(|second| second.0);
        (!is_close(most, second)).then_some(best)
    }
}

/// Whether another order of summation could make `second` larger than `most`. Exactly equal values are not close: they
/// come from sums of whole numbers, which are equal in any order.
fn is_close(most: f64, second: Option<f64>) -> bool {
    second.is_some_and(|second| {
        let gap = most - second;
        gap != 0.0 && gap < CLOSE * most.abs().max(CLOSE)
    })
}
