//! Tables over a few buckets of what a decision depends on.

use std::f64::consts::FRAC_1_SQRT_2;

use serde::{Deserialize, Serialize};

use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use crate::beliefs::ages;

/// Buckets of the battery: too low to sense, too low to report, and six equal parts of the rest.
pub const BATTERIES: usize = 8;
/// The first bucket of the battery with which a device can sense and report.
pub const ABLE: u8 = 2;
/// Buckets of the area that a device would newly cover.
pub const AREAS: usize = 16;
/// Nodes of the value as a function of the battery, evenly over `0 ..= E_max`.
pub const NODES: usize = 9;
/// Buckets of a wake-up candidate's score.
pub const SCORES: usize = 20;
/// Buckets of the information gathered.
pub const INFORMATIONS: usize = 8;
/// Buckets of the reports so far: 1, 2, 3, more.
pub const REPORTS: usize = 4;

/// The smallest area that counts, as a share of the sensing disc π·d_max².
const LEAST_AREA: f64 = 0.0002;
/// The end of the first bucket of areas that count, and the ratio of the ends after it.
const FIRST_AREA: f64 = 0.005;
const AREA_RATIO: f64 = 1.45;
/// The bucket up to the whole disc.
const LAST_AREA: usize = AREAS - 1;

/// One learned value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "(f64, u32)", into = "(f64, u32)")]
pub struct Cell {
    /// The action's value.
    pub value: f64,
    /// How often it was learned from.
    pub visits: u32,
}

impl From<(f64, u32)> for Cell {
    fn from((value, visits): (f64, u32)) -> Self {
        Self { value, visits }
    }
}

impl From<Cell> for (f64, u32) {
    fn from(cell: Cell) -> Self {
        (cell.value, cell.visits)
    }
}

impl Cell {
    const fn new(value: f64) -> Self {
        Self { value, visits: 0 }
    }

    /// Moves the value towards `target`; the more often that has happened, the less.
    pub fn learn(&mut self, target: f64, rates: Rates) {
        self.learn_a_share(target, 1.0, rates);
    }

    /// The same, with a share `weight` of the visit, `[0, 1]`.
    pub fn learn_a_share(&mut self, target: f64, weight: f64, rates: Rates) {
        self.visits = self.visits.saturating_add(1);
        self.value += weight * rates.at(self.visits) * (target - self.value);
    }

    fn round(&mut self) {
        self.value = (self.value * 1e4).round() / 1e4;
    }
}

/// Visits that the start counts for.
const PRIOR: f64 = 4.0;

/// How values are learned.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Exponent ω of the learning rate, `(0, 1]`: it is max((n + 4)^−ω, floor) at a value's n-th visit, so that the
    /// start outlives the first few.
    pub rate_decay: f64,
    /// The least learning rate, `(0, 1]`.
    pub rate_floor: f64,
    /// How optimistic the start is, ≥ 0: 1 for what an action brings at the most.
    pub optimism: f64,
}

impl Default for Schedule {
    fn default() -> Self {
        Self::USUAL
    }
}

impl Schedule {
    /// The schedule where nobody asks for another.
    pub const USUAL: Self = Self {
        rate_decay: 0.7,
        rate_floor: 0.002,
        optimism: 1.0,
    };

    /// The learning rates.
    pub fn rates(&self) -> Rates {
        let flat = libm::pow(self.rate_floor, -1.0 / self.rate_decay) - PRIOR;
        Rates {
            decay: self.rate_decay,
            floor: self.rate_floor,
            // What does not fit is never reached.
            flat: flat.ceil() as u32,
        }
    }
}

/// Learning rates by visits.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    decay: f64,
    floor: f64,
    /// From so many visits on the rate is at its floor.
    flat: u32,
}

impl Rates {
    fn at(self, visits: u32) -> f64 {
        if visits < self.flat {
            libm::pow(f64::from(visits) + PRIOR, -self.decay).max(self.floor)
        } else {
            self.floor
        }
    }
}

/// The table of the duty cycling: Q of δ = 0 and δ = 1 by battery and newly covered area, and V by battery. Q is kept
/// less ζV(battery), which is the same for both actions, for the choice; and whole, for V to be learned from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DutyTable {
    /// Q(battery, area, δ) − ζV(battery), [`BATTERIES`] × [`AREAS`] × 2, in this order.
    pub q: Vec<Cell>,
    /// Q(battery, area, δ), in the same order.
    pub outcomes: Vec<Cell>,
    /// V at the [`NODES`] battery levels.
    pub value: Vec<Cell>,
}

impl DutyTable {
    /// The start at `value` = 1/(1 − ζ), that of being asleep for ever: δ = 0 brings its 1, and δ = 1 what `most` says
    /// for a bucket of areas, with nothing charged for the energy that it takes.
    pub fn optimistic(value: f64, most: impl Fn(usize) -> f64) -> Self {
        let rewards: [[f64; 2]; AREAS] = std::array::from_fn(|area| [1.0, most(area)]);
        let of = |later: f64| -> Vec<Cell> {
            let by_area = rewards.as_flattened().iter().map(|reward| Cell::new(reward + later));
            by_area.collect::<Vec<_>>().repeat(BATTERIES)
        };
        Self {
            q: of(0.0),
            outcomes: of(value - 1.0),
            value: vec![Cell::new(value); NODES],
        }
    }

    /// Q − ζV of the action δ in a state.
    pub fn at(&self, battery: usize, area: usize, delta: bool) -> &Cell {
        &self.q[(battery * AREAS + area) * 2 + usize::from(delta)]
    }

    /// As [`Self::at`], for writing.
    pub fn at_mut(&mut self, battery: usize, area: usize, delta: bool) -> &mut Cell {
        &mut self.q[(battery * AREAS + area) * 2 + usize::from(delta)]
    }

    /// Q of the action δ in a state, whole.
    pub fn outcome_mut(&mut self, battery: usize, area: usize, delta: bool) -> &mut Cell {
        &mut self.outcomes[(battery * AREAS + area) * 2 + usize::from(delta)]
    }

    /// Q(s, 1) − Q(s, 0) by battery and area, made never to fall with the area: what is learned there is noisy, and a
    /// device that newly covers more is never worth less.
    pub fn advantages(&self) -> [[f64; AREAS]; BATTERIES] {
        std::array::from_fn(|battery| {
            let mut advantages: [f64; AREAS] =
                std::array::from_fn(|area| self.at(battery, area, true).value - self.at(battery, area, false).value);
            let weights: [f64; AREAS] = std::array::from_fn(|area| {
                let [on, off] = [true, false].map(|delta| f64::from(self.at(battery, area, delta).visits));
                1.0 + on.min(off)
            });
            rise(&mut advantages, &weights);
            advantages
        })
    }

    /// V at the nodes, made never to fall with the battery.
    pub fn values(&self) -> [f64; NODES] {
        let mut values: [f64; NODES] = std::array::from_fn(|node| self.value[node].value);
        let weights: [f64; NODES] = std::array::from_fn(|node| 1.0 + f64::from(self.value[node].visits));
        rise(&mut values, &weights);
        values
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = &Cell> {
        self.q.iter().chain(&self.outcomes).chain(&self.value)
    }

    pub(super) fn has_its_size(&self) -> bool {
        let cells = BATTERIES * AREAS * 2;
        self.q.len() == cells && self.outcomes.len() == cells && self.value.len() == NODES
    }

    pub(super) fn round(&mut self) {
        let cells = self.q.iter_mut().chain(&mut self.outcomes);
        cells.chain(&mut self.value).for_each(Cell::round);
    }
}

/// The nearest never-falling sequence in the sense of weighted least squares (pool adjacent violators).
fn rise(values: &mut [f64], weights: &[f64]) {
    // Blocks of equal value: (mean, weight, length).
    let mut blocks: Vec<(f64, f64, usize)> = Vec::with_capacity(values.len());
    for (&value, &weight) in values.iter().zip(weights) {
        let mut block = (value, weight, 1);
        while let Some(&(mean, below, length)) = blocks.last().filter(|last| last.0 > block.0) {
            blocks.pop();
            let sum = below + block.1;
            block = ((mean * below + block.0 * block.1) / sum, sum, length + block.2);
        }
        blocks.push(block);
    }
    let mut rest = values;
    for (mean, _, length) in blocks {
        let (own, after) = rest.split_at_mut(length);
        own.fill(mean);
        rest = after;
    }
}

/// The table of the wake-ups: the worth of waking the best candidate, where stopping is worth 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WakeTable {
    /// Q(score, information, reports), [`SCORES`] × [`INFORMATIONS`] × [`REPORTS`], in this order.
    pub q: Vec<Cell>,
}

impl WakeTable {
    /// A table in which every value is `value`.
    pub fn optimistic(value: f64) -> Self {
        Self {
            q: vec![Cell::new(value); SCORES * INFORMATIONS * REPORTS],
        }
    }

    /// Q of waking in a state.
    pub fn at(&self, [score, information, reports]: [usize; 3]) -> &Cell {
        &self.q[(score * INFORMATIONS + information) * REPORTS + reports]
    }

    /// As [`Self::at`], for writing.
    pub fn at_mut(&mut self, [score, information, reports]: [usize; 3]) -> &mut Cell {
        &mut self.q[(score * INFORMATIONS + information) * REPORTS + reports]
    }

    /// Q by score with Î and reports in these buckets, made never to fall with the score: cells that are hardly ever
    /// visited are noise, and waking a better candidate is never worth less.
    pub fn worths(&self, information: usize, reports: usize) -> [f64; SCORES] {
        let cells: [&Cell; SCORES] = std::array::from_fn(|score| self.at([score, information, reports]));
        let mut worths = cells.map(|cell| cell.value);
        rise(&mut worths, &cells.map(|cell| 1.0 + f64::from(cell.visits)));
        worths
    }

    pub(super) fn has_its_size(&self) -> bool {
        self.q.len() == SCORES * INFORMATIONS * REPORTS
    }

    pub(super) fn round(&mut self) {
        self.q.iter_mut().for_each(Cell::round);
    }
}

/// The bucket of a battery level, `0 .. BATTERIES`: 0 cannot pay E_idle, 1 could sense and not report.
pub fn battery_bucket(level: Energy, energy: &EnergyModel) -> usize {
    let needed = energy.e_idle + energy.e_tx;
    if level < energy.e_idle {
        0
    } else if level < needed {
        1
    } else {
        let span = energy.e_max.saturating_sub(needed).micro().max(1);
        let parts = BATTERIES as u64 - 2;
        let part = (level.saturating_sub(needed).micro() * parts / span).min(parts - 1);
        2 + part as usize
    }
}

/// The bucket of a newly covered area, as a share of the sensing disc, `0 .. AREAS`; 0 is as good as nothing.
pub fn area_bucket(share: f64) -> usize {
    (0..AREAS - 1).take_while(|&bucket| share >= area_edge(bucket)).count()
}

/// The end of the `bucket`-th bucket of areas, a share of the sensing disc.
pub fn area_edge(bucket: usize) -> f64 {
    match bucket {
        0 => LEAST_AREA,
        LAST_AREA.. => 1.0,
        _ => FIRST_AREA * (1..bucket).fold(1.0, |edge, _| edge * AREA_RATIO),
    }
}

/// Where places have ages, the end of the first bucket that is more than as good as nothing, and the ratio of the ends
/// after it; the last goes up to all places being as old as counts.
const FIRST_WORTH: f64 = 0.2;
const WORTH_RATIO: f64 = 1.6;

/// The end of the `bucket`-th bucket of what a device would look at where places have ages: the sum of their worths, as
/// a share of a sensing disc of places of age 1.
pub fn worth_edge(bucket: usize) -> f64 {
    match bucket {
        0 => LEAST_AREA,
        LAST_AREA.. => ages::MOST,
        _ => FIRST_WORTH * (1..bucket).fold(1.0, |edge, _| edge * WORTH_RATIO),
    }
}

/// The bucket of a candidate's score, a share of Ψ, `0 .. SCORES`.
pub fn score_bucket(share: f64) -> usize {
    (1..SCORES).take_while(|&bucket| share >= score_edge(bucket)).count()
}

/// Where the `bucket`-th bucket of scores begins, a share of Ψ: the first at 0, each of the others at 1/√2 of where the
/// next begins; the last ends at 1.
pub fn score_edge(bucket: usize) -> f64 {
    if bucket == 0 {
        return 0.0;
    }
    let roots = SCORES - bucket;
    let halved = 1.0 / f64::from(1_u32 << (roots / 2));
    if roots.is_multiple_of(2) {
        halved
    } else {
        halved * FRAC_1_SQRT_2
    }
}

/// The bucket of Î, a share of Ψ, `0 .. INFORMATIONS`.
pub fn information_bucket(share: f64) -> usize {
    const EDGES: [f64; INFORMATIONS - 1] = [0.03, 0.08, 0.15, 0.25, 0.4, 0.55, 0.75];
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
        let of = |x: f64| battery_bucket(units(x), &energy);
        assert_eq!(
            [0.0, 0.99, 1.0, 10.99, 11.0, 25.8, 25.9, 99.9, 100.0].map(of),
            [0, 0, 1, 1, 2, 2, 3, 7, 7]
        );
        assert_eq!(
            [0.0, 0.0001, 0.0003, 0.0051, 1.0].map(area_bucket),
            [0, 0, 1, 2, AREAS - 1]
        );
        assert!((0..AREAS - 2).all(|b| area_edge(b) < area_edge(b + 1)) && area_edge(AREAS - 2) < 0.8);
        assert_eq!(
            [1.0, 0.71, 0.7, 0.5, 0.49, 0.24, 1e-9, 0.0].map(score_bucket),
            [19, 19, 18, 18, 17, 15, 0, 0]
        );
        assert_eq!([0.0, 0.03, 0.39, 0.76, 1.0].map(information_bucket), [0, 1, 4, 7, 7]);
    }

    #[test]
    fn the_learning_rate_falls_to_its_floor() {
        let schedule = Schedule::default();
        let rates = schedule.rates();
        let mut cell = Cell::new(20.0);
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
    fn advantages_and_values_never_fall() {
        let mut table = DutyTable::optimistic(20.0, |_| 1.0);
        for area in 0..AREAS {
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
