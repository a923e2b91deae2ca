//! Choice of sensing devices under `age-index`, from the rule in docs/age-index.md, which states the constants. It
//! computes every place separately and caches nothing between sums. `policy.age-index.foresight` and wake-ups are not
//! implemented; the caller passes the battery levels that set the prices.
//! It takes no rule from the emulator, and must give equal results with the same draws; [`super`] lists what it shares.

use std::f64::consts::PI;

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::DetectionKind;

use super::clusters::distance;

/// Relative tolerance: values per price closer than this, or a value this close to its price, can change order with the
/// order of summation. Below a value of `TOLERANCE`, it is relative to `TOLERANCE`.
const TOLERANCE: f64 = 1e-6;

/// Largest age, in TTIs.
const MAX_AGE: f64 = 255.0;
/// Age from which a place is not worth more, in TTIs.
const MAX_VALUED_AGE: f64 = 22.0;

/// Places along a length of d_max.
const PLACES_PER_D_MAX: f64 = 7.5;
/// Battery reserve of a device that senses, as a share of `E_max`.
const RESERVE_SHARE: f64 = 0.03;
/// Relative extra price of a device with an empty battery.
const EMPTY_BATTERY_SURCHARGE: f64 = 3.0;
/// Stands for a price of 0, so that values per price are finite. `q_learning.rs` repeats it.
const MIN_PRICE: f64 = 1e-30;
/// Rounds in which each chosen device may be replaced.
const SWAP_ROUNDS: usize = 2;

/// Rounding error of a distance, metres.
const DISTANCE_ROUNDING: f64 = 1e-9;

/// Places of an area with their ages, and the devices that cover them. Call [`Self::advance`] once for each TTI, in
/// order.
#[derive(Clone, Debug)]
pub struct ReferenceAgeIndex {
    /// Probability that a device detects an event at a place, by device and place.
    detection_probabilities: Vec<Vec<f64>>,
    /// Ages of the places in the coming TTI, row by row; 1 before the first TTI.
    ages: Vec<f64>,
    positions: Vec<Point>,
    energies: Vec<EnergyModel>,
    d_max: f64,
    /// Price of a TTI in S1 of a device with mean cost and a full battery, in places of age 1.
    price_in_places: f64,
    /// π d_max² divided by the area of a place.
    places_per_disc: f64,
}

impl ReferenceAgeIndex {
    /// Creates the index for devices at `positions` with these batteries and costs, by device, at `price`
    /// (`policy.age-index.price`). `None` if rounding decides whether a place is within a device's range.
    pub fn new(scenario: &Scenario, positions: &[Point], energies: Vec<EnergyModel>, price: f64) -> Option<Self> {
        let (area, sensing) = (scenario.area, &scenario.sensing);
        let place_count = |length: f64| (PLACES_PER_D_MAX * length / sensing.d_max).ceil().max(1.0);
        let (columns, rows) = (place_count(area.width), place_count(area.height));
        let mut places = Vec::new();
        for row in 0..rows as u32 {
            for column in 0..columns as u32 {
                let x = area.width * (f64::from(column) + 0.5) / columns;
                places.push(Point::new(x, area.height * (f64::from(row) + 0.5) / rows));
            }
        }
        let mut detection_probabilities = Vec::new();
        for position in positions {
            let mut by_place = Vec::new();
            for place in &places {
                let d = distance(*position, *place);
                if (d - sensing.d_max).abs() < DISTANCE_ROUNDING {
                    return None;
                }
                by_place.push(match sensing.kind {
                    _ if d > sensing.d_max => 0.0,
                    DetectionKind::Range => 1.0,
                    DetectionKind::Probabilistic => libm::exp(-sensing.eta * d),
                });
            }
            detection_probabilities.push(by_place);
        }
        // Integral of the detection probability over a sensing disc.
        let covered_area = match sensing.kind {
            DetectionKind::Range => PI * sensing.d_max.powi(2),
            DetectionKind::Probabilistic => {
                let x = sensing.eta * sensing.d_max;
                2.0 * PI / sensing.eta.powi(2) * (1.0 - (1.0 + x) * libm::exp(-x))
            }
        };
        let place_area = area.width * area.height / (columns * rows);
        Some(Self {
            detection_probabilities,
            ages: vec![1.0; places.len()],
            positions: positions.to_vec(),
            energies,
            d_max: sensing.d_max,
            price_in_places: price * covered_area / place_area,
            places_per_disc: PI * sensing.d_max.powi(2) / place_area,
        })
    }

    /// Advances the ages by a TTI in which `sensing_devices` sensed; a reported event resets all ages.
    pub fn advance(&mut self, sensing_devices: &[usize], is_event_reported: bool) {
        for place in 0..self.ages.len() {
            let missed: f64 = sensing_devices
                .iter()
                .map(|&j| 1.0 - self.detection_probabilities[j][place])
                .product();
            let unseen_age = if is_event_reported {
                0.0
            } else {
                self.ages[place] * missed
            };
            self.ages[place] = (unseen_age + 1.0).min(MAX_AGE);
        }
    }

    /// Returns the price of each device at these levels, micro-units; infinite for a device that may not sense.
    fn prices(&self, levels: &[u64]) -> Vec<f64> {
        let sensing_cost = |energy: &EnergyModel| energy.e_idle.micro().saturating_sub(energy.e_wur.micro()) as f64;
        let total_cost: f64 = self.energies.iter().map(sensing_cost).sum();
        let mean_cost = total_cost / self.energies.len() as f64;
        let price_of = |(energy, &level): (&EnergyModel, &u64)| {
            let e_max = energy.e_max.micro() as f64;
            let reserve = (RESERVE_SHARE * e_max).floor() as u64;
            if level < energy.e_idle.micro() + energy.e_tx.micro() + reserve {
                return f64::INFINITY;
            }
            let relative_cost = if mean_cost > 0.0 {
                sensing_cost(energy) / mean_cost
            } else {
                0.0
            };
            let missing_share = 1.0 - level as f64 / e_max;
            let price = self.price_in_places * relative_cost * (1.0 + EMPTY_BATTERY_SURCHARGE * missing_share.powi(2));
            price.max(MIN_PRICE)
        };
        self.energies.iter().zip(levels).map(price_of).collect()
    }

    /// Returns the value that sensing by `j` adds to sensing by `others`.
    fn added_value(&self, j: usize, others: &[usize]) -> f64 {
        let value_of_age = |age: f64| {
            let age = age.min(MAX_VALUED_AGE);
            age * (age + 1.0) / 2.0
        };
        let mut sum = 0.0;
        for (place, &age) in self.ages.iter().enumerate() {
            // Between whole ages, the value is interpolated.
            let below = age.floor();
            let value = value_of_age(below) + (age - below) * (value_of_age(below + 1.0) - value_of_age(below));
            let missed: f64 = others
                .iter()
                .map(|&other| 1.0 - self.detection_probabilities[other][place])
                .product();
            sum += value * missed * self.detection_probabilities[j][place];
        }
        sum
    }

    /// Chooses the sensing devices of the next TTI, by number, for battery `levels`, micro-units by device; `None` if
    /// too close to call.
    pub fn choose(&self, levels: &[u64]) -> Option<Vec<usize>> {
        let mut chosen = self.choose_at_prices(&self.prices(levels), &[])?;
        chosen.sort_unstable();
        Some(chosen)
    }

    /// Number of places in a sensing disc: π d_max² divided by the area of a place.
    pub const fn places_per_disc(&self) -> f64 {
        self.places_per_disc
    }

    /// Chooses sensing devices at `prices`, by device and in places of age 1, infinite for a device that may not sense.
    /// Returns the devices chosen in addition to `already_chosen`, in order of choice; `None` if too close to call.
    pub fn choose_at_prices(&self, prices: &[f64], already_chosen: &[usize]) -> Option<Vec<usize>> {
        let mut chosen = self.choose_greedily(prices, already_chosen)?;
        for step in 0..SWAP_ROUNDS * chosen.len() {
            let rank = step % chosen.len();
            let Some(j) = chosen[rank].take() else { continue };
            let others: Vec<usize> = chosen.iter().flatten().chain(already_chosen).copied().collect();
            chosen[rank] = self.best_replacement(j, &others, prices)?;
        }
        Some(chosen.into_iter().flatten().collect())
    }

    /// Chooses one device after another, each with the largest value per price among the devices worth their price;
    /// `None` if too close to call. The inner options are `Some`: a later swap can empty a rank.
    fn choose_greedily(&self, prices: &[f64], already_chosen: &[usize]) -> Option<Vec<Option<usize>>> {
        let mut chosen: Vec<usize> = Vec::new();
        loop {
            let mut values_per_price = Vec::new();
            for (j, &price) in prices.iter().enumerate() {
                if chosen.contains(&j) || price.is_infinite() {
                    continue;
                }
                let value = self.added_value(j, &[&chosen, already_chosen].concat());
                if (value - price).abs() < TOLERANCE * price.max(TOLERANCE) && value > 0.0 {
                    return None;
                }
                if value > price {
                    values_per_price.push((value / price, j));
                }
            }
            // Largest ratio first; ties go to the lowest number.
            values_per_price.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let Some(&(largest, best_device)) = values_per_price.first() else {
                return Some(chosen.into_iter().map(Some).collect());
            };
            if is_close(largest, values_per_price.get(1).map(|second| second.0)) {
                return None;
            }
            chosen.push(best_device);
        }
    }

    /// Returns the option with the largest net value among `j`, the devices within d_max of it outside `others`, and no
    /// device (`Some(None)`); `None` if too close to call.
    #[expect(clippy::option_option, reason = "too close to call, or no device")]
    fn best_replacement(&self, j: usize, others: &[usize], prices: &[f64]) -> Option<Option<usize>> {
        // On equal net value the first wins: no device, then j, then the lowest number.
        // Net value, rank among equals, and the device if any.
        let mut options = vec![(0.0, 0, None)];
        for (i, price) in prices.iter().enumerate() {
            let is_within_d_max = distance(self.positions[i], self.positions[j]) <= self.d_max;
            if others.contains(&i) || !is_within_d_max || price.is_infinite() {
                continue;
            }
            let net = self.added_value(i, others) - price;
            options.push((net, if i == j { 1 } else { 2 + i }, Some(i)));
        }
        options.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let (largest, _, best_device) = options[0];
        let second = options.get(1).map(|second| second.0);
        (!is_close(largest, second)).then_some(best_device)
    }
}

/// Whether another order of summation could make `second` larger than `largest`. Exactly equal values are not close:
/// they come from sums of whole numbers, which are equal in any order.
fn is_close(largest: f64, second: Option<f64>) -> bool {
    second.is_some_and(|second| {
        let gap = largest - second;
        gap != 0.0 && gap < TOLERANCE * largest.abs().max(TOLERANCE)
    })
}
