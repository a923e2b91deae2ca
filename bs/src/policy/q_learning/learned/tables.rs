//! Tables of learned values over buckets of the state in which a decision is made, and the buckets themselves.
//!
//! The edges of the buckets, the order of the values and all types that derive `Serialize` belong to the file of
//! learned tables: raise its [`VERSION`](super::VERSION) if they change. `tests/src/reference/q_learning.rs` repeats
//! the buckets.

use std::f64::consts::FRAC_1_SQRT_2;

use serde::{Deserialize, Serialize};

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use crate::beliefs::ages;

/// Number of battery buckets: too low to sense, too low to report, and six equal parts of the rest.
pub const BATTERY_BUCKETS: usize = 8;
/// First battery bucket in which a device can sense and report.
pub const FIRST_ABLE_BUCKET: u8 = 2;
/// Number of buckets of the newly covered area.
pub const AREA_BUCKETS: usize = 16;
/// Number of nodes of the value as a function of the battery, evenly spaced over `0 ..= E_max`.
pub const VALUE_NODES: usize = 9;
/// Number of buckets of a wake-up candidate's score.
pub const SCORE_BUCKETS: usize = 20;
/// Number of buckets of the gathered information.
pub const INFORMATION_BUCKETS: usize = 8;
/// Number of buckets of the reports so far: 1, 2, 3, more.
pub const REPORT_BUCKETS: usize = 4;

/// Smallest area that counts, as a share of the sensing disc π·d_max².
const MIN_AREA: f64 = 0.0002;
/// End of the first bucket of areas that count, and ratio between successive ends after it.
const FIRST_AREA_END: f64 = 0.005;
const AREA_RATIO: f64 = 1.45;
/// Bucket that ends at the whole disc, or with ages at the whole disc of the greatest worth.
const LAST_BUCKET: usize = AREA_BUCKETS - 1;

/// One learned value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "(f64, u32)", into = "(f64, u32)")]
pub struct QValue {
    /// Value of the action.
    pub value: f64,
    /// Number of updates.
    pub visits: u32,
}

impl From<(f64, u32)> for QValue {
    fn from((value, visits): (f64, u32)) -> Self {
        Self { value, visits }
    }
}

impl From<QValue> for (f64, u32) {
    fn from(cell: QValue) -> Self {
        (cell.value, cell.visits)
    }
}

impl QValue {
    const fn new(value: f64) -> Self {
        Self { value, visits: 0 }
    }

    /// Moves the value towards `target`, by less with each visit.
    pub fn learn(&mut self, target: f64, rates: LearningRates) {
        self.learn_weighted(target, 1.0, rates);
    }

    /// Moves the value towards `target`, with the learning rate scaled by `weight`, `[0, 1]`.
    pub(crate) fn learn_weighted(&mut self, target: f64, weight: f64, rates: LearningRates) {
        self.visits = self.visits.saturating_add(1);
        self.value += weight * rates.at(self.visits) * (target - self.value);
    }

    fn round(&mut self) {
        self.value = (self.value * 1e4).round() / 1e4;
    }
}

/// Number of visits for which the initial value counts. The text of `policy.q-learning.rate_decay` repeats it.
const PRIOR_VISITS: f64 = 4.0;

/// Learning schedule.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Exponent ω of the learning rate, `(0, 1]`. The rate is max((n + 4)^−ω, floor) at the n-th visit of a value, so
    /// that the initial value persists over the first visits.
    pub rate_decay: f64,
    /// Least learning rate, `(0, 1]`.
    pub rate_floor: f64,
    /// Initial values, ≥ 0, as a multiple of the largest immediate reward of an action.
    pub optimism: f64,
}

impl Default for Schedule {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Schedule {
    /// Default schedule.
    pub const DEFAULT: Self = Self {
        rate_decay: 0.7,
        rate_floor: 0.002,
        optimism: 1.0,
    };

    /// Returns the learning rates.
    pub fn rates(&self) -> LearningRates {
        // The visits n at which (n + 4)^−ω falls to the floor.
        let floor_visits = libm::pow(self.rate_floor, -1.0 / self.rate_decay) - PRIOR_VISITS;
        LearningRates {
            decay: self.rate_decay,
            floor: self.rate_floor,
            // The cast saturates; no run makes as many visits.
            floor_visits: floor_visits.ceil() as u32,
        }
    }
}

/// Learning rates by visits.
#[derive(Clone, Copy, Debug)]
pub struct LearningRates {
    decay: f64,
    floor: f64,
    /// Number of visits from which the rate is at its floor.
    floor_visits: u32,
}

impl LearningRates {
    fn at(self, visits: u32) -> f64 {
        if visits < self.floor_visits {
            libm::pow(f64::from(visits) + PRIOR_VISITS, -self.decay).max(self.floor)
        } else {
            self.floor
        }
    }
}

/// Table of the duty cycling: Q of δ = 0 and δ = 1 by battery and newly covered area, and V by battery. Q is stored
/// twice. The choice uses Q less ζV(battery), which is the same for both actions. V is learned from the whole Q.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DutyTable {
    /// Q(battery, area, δ) − ζV(battery), [`BATTERY_BUCKETS`] × [`AREA_BUCKETS`] × 2, in this order.
    pub q: Vec<QValue>,
    /// Q(battery, area, δ), in the same order.
    pub outcomes: Vec<QValue>,
    /// V at the [`VALUE_NODES`] battery levels, as learned. [`Self::values`] makes it monotone.
    pub value: Vec<QValue>,
}

impl DutyTable {
    /// Creates the start, with V = `value` = 1/(1 − ζ), the value of sleeping forever. The reward of δ = 0 is 1. The
    /// reward of δ = 1 is `max_reward(bucket)` by area bucket, with no charge for the energy.
    pub fn optimistic(value: f64, max_reward: impl Fn(usize) -> f64) -> Self {
        // By area bucket and δ, in the order of `duty_index`.
        let rewards: [[f64; 2]; AREA_BUCKETS] = std::array::from_fn(|area| [1.0, max_reward(area)]);
        let rewards_plus = |later_value: f64| -> Vec<QValue> {
            let by_area = rewards
                .as_flattened()
                .iter()
                .map(|reward| QValue::new(reward + later_value));
            by_area.collect::<Vec<_>>().repeat(BATTERY_BUCKETS)
        };
        Self {
            q: rewards_plus(0.0),
            outcomes: rewards_plus(value - 1.0),
            value: vec![QValue::new(value); VALUE_NODES],
        }
    }

    /// Returns Q − ζV of the action δ in a state.
    pub fn at(&self, battery: usize, area: usize, delta: bool) -> &QValue {
        &self.q[duty_index(battery, area, delta)]
    }

    /// Returns a mutable reference to Q − ζV of the action δ in a state.
    pub fn at_mut(&mut self, battery: usize, area: usize, delta: bool) -> &mut QValue {
        &mut self.q[duty_index(battery, area, delta)]
    }

    /// Returns a mutable reference to the whole Q of the action δ in a state.
    pub(crate) fn outcome_mut(&mut self, battery: usize, area: usize, delta: bool) -> &mut QValue {
        &mut self.outcomes[duty_index(battery, area, delta)]
    }

    /// Returns Q(s, 1) − Q(s, 0) by battery and area, made monotone in the area. The learned values are noisy, and a
    /// device that newly covers more is never worth less.
    pub fn advantages(&self) -> [[f64; AREA_BUCKETS]; BATTERY_BUCKETS] {
        std::array::from_fn(|battery| {
            let mut advantages: [f64; AREA_BUCKETS] =
                std::array::from_fn(|area| self.at(battery, area, true).value - self.at(battery, area, false).value);
            let weights: [f64; AREA_BUCKETS] = std::array::from_fn(|area| {
                let [on, off] = [true, false].map(|delta| f64::from(self.at(battery, area, delta).visits));
                // A difference is only as certain as its rarer action.
                1.0 + on.min(off)
            });
            make_monotone(&mut advantages, &weights);
            advantages
        })
    }

    /// Returns V at the nodes, made monotone in the battery.
    pub fn values(&self) -> [f64; VALUE_NODES] {
        let mut values: [f64; VALUE_NODES] = std::array::from_fn(|node| self.value[node].value);
        let weights: [f64; VALUE_NODES] = std::array::from_fn(|node| 1.0 + f64::from(self.value[node].visits));
        make_monotone(&mut values, &weights);
        values
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = &QValue> {
        self.q.iter().chain(&self.outcomes).chain(&self.value)
    }

    pub(super) fn has_valid_size(&self) -> bool {
        let cell_count = BATTERY_BUCKETS * AREA_BUCKETS * 2;
        self.q.len() == cell_count && self.outcomes.len() == cell_count && self.value.len() == VALUE_NODES
    }

    pub(super) fn round(&mut self) {
        let cells = self.q.iter_mut().chain(&mut self.outcomes);
        cells.chain(&mut self.value).for_each(QValue::round);
    }
}

/// Returns the index of a value of the duty table: by battery bucket, area bucket and δ.
fn duty_index(battery: usize, area: usize, delta: bool) -> usize {
    (battery * AREA_BUCKETS + area) * 2 + usize::from(delta)
}

/// Replaces the values by the non-decreasing least-squares fit with these weights (pool adjacent violators).
fn make_monotone(values: &mut [f64], weights: &[f64]) {
    // Blocks of equal value: (mean, weight, length).
    let mut blocks: Vec<(f64, f64, usize)> = Vec::with_capacity(values.len());
    for (&value, &weight) in values.iter().zip(weights) {
        let mut block = (value, weight, 1);
        while let Some(&(mean, weight, length)) = blocks.last().filter(|last| last.0 > block.0) {
            blocks.pop();
            let sum = weight + block.1;
            block = ((mean * weight + block.0 * block.1) / sum, sum, length + block.2);
        }
        blocks.push(block);
    }
    let mut remaining = values;
    for (mean, _, length) in blocks {
        let (block, after) = remaining.split_at_mut(length);
        block.fill(mean);
        remaining = after;
    }
}

/// Table of the wake-ups: the value of waking the best candidate, where stopping is worth 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WakeTable {
    /// Q(score, information, reports), [`SCORE_BUCKETS`] × [`INFORMATION_BUCKETS`] × [`REPORT_BUCKETS`], in this order.
    pub q: Vec<QValue>,
}

impl WakeTable {
    /// Creates a table in which every value is `value`.
    pub fn optimistic(value: f64) -> Self {
        Self {
            q: vec![QValue::new(value); SCORE_BUCKETS * INFORMATION_BUCKETS * REPORT_BUCKETS],
        }
    }

    /// Returns Q of waking in a state.
    pub fn at(&self, [score, information, reports]: [usize; 3]) -> &QValue {
        &self.q[(score * INFORMATION_BUCKETS + information) * REPORT_BUCKETS + reports]
    }

    /// Returns a mutable reference to Q of waking in a state.
    pub fn at_mut(&mut self, [score, information, reports]: [usize; 3]) -> &mut QValue {
        &mut self.q[(score * INFORMATION_BUCKETS + information) * REPORT_BUCKETS + reports]
    }

    /// Returns Q by score for these buckets of Î and reports, made monotone in the score. Rarely visited values are
    /// noise, and a better candidate is never worth less.
    pub fn monotone_q(&self, information: usize, reports: usize) -> [f64; SCORE_BUCKETS] {
        let cells: [&QValue; SCORE_BUCKETS] = std::array::from_fn(|score| self.at([score, information, reports]));
        let mut worths = cells.map(|cell| cell.value);
        make_monotone(&mut worths, &cells.map(|cell| 1.0 + f64::from(cell.visits)));
        worths
    }

    pub(super) fn has_valid_size(&self) -> bool {
        self.q.len() == SCORE_BUCKETS * INFORMATION_BUCKETS * REPORT_BUCKETS
    }

    pub(super) fn round(&mut self) {
        self.q.iter_mut().for_each(QValue::round);
    }
}

/// Returns the bucket of a battery level, `0 .. BATTERY_BUCKETS`: 0 cannot pay E_idle, 1 can sense but not report.
pub fn battery_bucket(level: Energy, energy: &EnergyModel) -> usize {
    let needed = energy.e_idle + energy.e_tx;
    if level < energy.e_idle {
        0
    } else if level < needed {
        1
    } else {
        // E_max can be exactly the energy that is needed.
        let span = energy.e_max.saturating_sub(needed).micro().max(1);
        let parts = BATTERY_BUCKETS as u64 - u64::from(FIRST_ABLE_BUCKET);
        let part = (level.saturating_sub(needed).micro() * parts / span).min(parts - 1);
        usize::from(FIRST_ABLE_BUCKET) + part as usize
    }
}

/// Least battery levels of the buckets of [`battery_bucket`] after the first, for devices of one energy model. They
/// spare a division per device and TTI.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BucketLevels([Energy; BATTERY_BUCKETS - 1]);

impl BucketLevels {
    /// Creates the levels of devices with this `energy`.
    pub(crate) fn new(energy: &EnergyModel) -> Self {
        let needed = energy.e_idle + energy.e_tx;
        let span = energy.e_max.saturating_sub(needed).micro().max(1);
        let parts = BATTERY_BUCKETS as u64 - u64::from(FIRST_ABLE_BUCKET);
        // The least whole number of micro-units above `needed` that belongs to a part.
        let start_of_part = |part: u64| (u128::from(part) * u128::from(span)).div_ceil(u128::from(parts)) as u64;
        Self(std::array::from_fn(|index| match index {
            0 => energy.e_idle,
            1 => needed,
            _ => needed + Energy::from_micro(start_of_part(index as u64 + 1 - u64::from(FIRST_ABLE_BUCKET))),
        }))
    }

    /// Returns [`battery_bucket`] of `level`.
    pub(crate) fn bucket(&self, level: Energy) -> u8 {
        self.0.iter().map(|&start| u8::from(level >= start)).sum()
    }
}

/// Returns the bucket of a newly covered area, a share of the sensing disc, `0 .. AREA_BUCKETS`; 0 is negligible.
pub(crate) fn area_bucket(share: f64) -> usize {
    (0..AREA_BUCKETS - 1)
        .take_while(|&bucket| share >= area_end(bucket))
        .count()
}

/// Returns the end of the `bucket`-th bucket of areas, a share of the sensing disc.
pub(crate) fn area_end(bucket: usize) -> f64 {
    match bucket {
        0 => MIN_AREA,
        LAST_BUCKET.. => 1.0,
        _ => FIRST_AREA_END * (1..bucket).fold(1.0, |edge, _| edge * AREA_RATIO),
    }
}

/// End of the first bucket of worth that is not negligible, and ratio between successive ends after it, for places with
/// ages. The last bucket ends where all places have the greatest age that counts.
const FIRST_WORTH_END: f64 = 0.2;
const WORTH_RATIO: f64 = 1.6;

/// Returns the end of the `bucket`-th bucket of worth with ages: the sum of the worths of places, as a share of a
/// sensing disc of places of age 1.
pub(super) fn worth_end(bucket: usize) -> f64 {
    match bucket {
        0 => MIN_AREA,
        LAST_BUCKET.. => ages::MAX_WORTH,
        _ => FIRST_WORTH_END * (1..bucket).fold(1.0, |edge, _| edge * WORTH_RATIO),
    }
}

/// Returns the bucket of a candidate's score, a share of Ψ, `0 .. SCORE_BUCKETS`.
pub fn score_bucket(share: f64) -> usize {
    (1..SCORE_BUCKETS)
        .take_while(|&bucket| share >= score_edge(bucket))
        .count()
}

/// Returns the start, not the end, of the `bucket`-th bucket of scores, a share of Ψ. The first starts at 0, each other
/// at 1/√2 of the start of the next; the last ends at 1.
pub fn score_edge(bucket: usize) -> f64 {
    if bucket == 0 {
        return 0.0;
    }
    let roots = SCORE_BUCKETS - bucket;
    let halved = 1.0 / f64::from(1_u32 << (roots / 2));
    if roots.is_multiple_of(2) {
        halved
    } else {
        halved * FRAC_1_SQRT_2
    }
}

/// Returns the bucket of Î, a share of Ψ, `0 .. INFORMATION_BUCKETS`.
pub fn information_bucket(share: f64) -> usize {
    const EDGES: [f64; INFORMATION_BUCKETS - 1] = [0.03, 0.08, 0.15, 0.25, 0.4, 0.55, 0.75];
    EDGES.iter().filter(|&&edge| share >= edge).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_cover_their_ranges_in_order() {
        let units = |x: f64| Energy::from_units(x).expect("an energy");
        let energy = EnergyModel {
            e_max: units(100.0),
            e_idle: units(1.0),
            e_wur: units(0.1),
            e_tx: units(10.0),
            initial: units(50.0),
        };
        let bucket_of = |x: f64| battery_bucket(units(x), &energy);
        assert_eq!(
            [0.0, 0.99, 1.0, 10.99, 11.0, 25.8, 25.9, 99.9, 100.0].map(bucket_of),
            [0, 0, 1, 1, 2, 2, 3, 7, 7]
        );
        assert_eq!(
            [0.0, 0.0001, 0.0003, 0.0051, 1.0].map(area_bucket),
            [0, 0, 1, 2, AREA_BUCKETS - 1]
        );
        assert!((0..AREA_BUCKETS - 2).all(|b| area_end(b) < area_end(b + 1)) && area_end(AREA_BUCKETS - 2) < 0.8);
        assert_eq!(
            [1.0, 0.71, 0.7, 0.5, 0.49, 0.24, 1e-9, 0.0].map(score_bucket),
            [19, 19, 18, 18, 17, 15, 0, 0]
        );
        assert_eq!([0.0, 0.03, 0.39, 0.76, 1.0].map(information_bucket), [0, 1, 4, 7, 7]);
    }

    #[test]
    fn bucket_levels_give_the_buckets_of_all_levels() {
        let micro = Energy::from_micro;
        for (e_idle, e_tx, e_max) in [(3, 10, 60), (0, 0, 1), (5, 7, 12), (2, 9, 4), (1, 1, 1000)] {
            let energy = EnergyModel {
                e_max: micro(e_max),
                e_idle: micro(e_idle),
                e_wur: micro(0),
                e_tx: micro(e_tx),
                initial: micro(0),
            };
            let levels = BucketLevels::new(&energy);
            for level in (0..2 * e_max + 20).map(micro) {
                let bucket = usize::from(levels.bucket(level));
                assert_eq!(bucket, battery_bucket(level, &energy), "{level:?} of {energy:?}");
            }
        }
    }

    #[test]
    fn the_learning_rate_falls_to_its_floor() {
        let schedule = Schedule::default();
        let rates = schedule.rates();
        let mut cell = QValue::new(20.0);
        cell.learn(0.0, rates);
        assert!(
            (cell.value - 20.0 * (1.0 - libm::pow(5.0, -0.7))).abs() < 1e-12,
            "{}",
            cell.value
        );
        assert!((rates.at(6) - 0.199_526).abs() < 1e-6);
        // 0.002^(−1/0.7) − 4 = 7168.6.
        assert!(rates.at(7168) > 0.002 && rates.at(7168) < 0.002_001, "{rates:?}");
        assert!([7169, u32::MAX].map(|n| rates.at(n).to_bits()) == [0.002_f64.to_bits(); 2]);
        let slow = Schedule {
            rate_floor: 1e-300,
            ..schedule
        };
        assert!(slow.rates().at(u32::MAX) > 0.0);
    }

    #[test]
    fn advantages_are_pooled_until_they_do_not_fall() {
        let mut table = DutyTable::optimistic(20.0, |_| 1.0);
        for area in 0..AREA_BUCKETS {
            table.at_mut(3, area, true).value = 1.0 + if area == 5 { 9.0 } else { area as f64 };
        }
        let row = table.advantages()[3];
        assert!(row.windows(2).all(|pair| pair[0] <= pair[1]), "{row:?}");
        assert!((row.iter().sum::<f64>() - 124.0).abs() < 1e-9, "{row:?}");
        assert!(
            (row[5] - 22.0 / 3.0).abs() < 1e-9 && (row[4] - 4.0).abs() < 1e-9,
            "9, 6 and 7 pool: {row:?}"
        );
    }
}
