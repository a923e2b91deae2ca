//! Who senses: sequential choice by a table, and learning it.

use std::collections::binary_heap::PeekMut;
use std::collections::{BinaryHeap, VecDeque};

use super::learned::{AREAS, BATTERIES, DutyTable, NODES, Rates, Schedule, Weights, area_bucket, battery_bucket};
use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::coverage::Coverage;

/// What the learner is asked to weigh.
#[derive(Clone, Copy, Debug)]
pub struct Terms {
    /// μ1 and ζ.
    pub weights: Weights,
    /// How values are learned.
    pub schedule: Schedule,
    /// Probability α that an event starts in a TTI.
    pub alpha: f64,
    /// TTIs within which the area is to be covered once, ≥ 1.
    pub window: u32,
}

/// The duty cycling of a deployment.
#[derive(Clone, Debug)]
pub struct Duty {
    table: DutyTable,
    /// V of the table, made monotone.
    values: [f64; NODES],
    terms: Terms,
    rates: Rates,
    /// What a device that alone covers the whole area adds to N r(k) until it has to be covered again.
    worth: f64,
    /// Sensing discs that make up the area.
    discs: f64,
    energies: Vec<EnergyModel>,
    coverage: Coverage,
    /// Who sensed in each of the last `window` − 1 TTIs, the latest at the end.
    recent: VecDeque<Vec<DeviceId>>,
    /// Candidates by [`Duty::key`].
    heap: BinaryHeap<u64>,
    /// By battery and area bucket: the place of the advantage among all advantages, 0 for one that is no advantage.
    places: [[u8; AREAS]; BATTERIES],
    /// The area bucket of newly covered parts of the area.
    areas: Vec<u8>,
    /// The battery bucket of each device in this TTI.
    batteries: Vec<u8>,
    /// What was decided last, while it is to be learned from.
    last: Option<Decision>,
}

/// All shares of one decision.
#[derive(Clone, Debug, Default)]
struct Decision {
    /// The share of each device.
    shares: Vec<Share>,
    /// By device, the share of the area that counts as covered by it.
    credits: Vec<f64>,
    /// U(k), the share that nobody covers.
    uncovered: f64,
}

/// What a device decided in, and did.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    battery: u8,
    area: u8,
    on: bool,
    /// The share of the area that it newly covered, or would have.
    gain: f64,
    level: Energy,
}

impl Duty {
    /// A learner with `table` for devices at `positions` of `area`.
    pub fn new(
        table: DutyTable,
        terms: Terms,
        positions: &[Point],
        energies: Vec<EnergyModel>,
        area: Area,
        sensing: &Sensing,
    ) -> Self {
        let Terms {
            weights,
            schedule,
            alpha,
            window,
        } = terms;
        let coverage = Coverage::new(positions, area, sensing);
        let (most, area_parts) = coverage.most_parts();
        let discs = area.surface() / (std::f64::consts::PI * sensing.d_max * sensing.d_max);
        let mut duty = Self {
            values: [0.0; NODES],
            table,
            worth: weights.covering(positions.len() as u32, alpha, window),
            rates: schedule.rates(),
            terms,
            discs,
            batteries: vec![0; energies.len()],
            energies,
            coverage,
            recent: VecDeque::from(vec![Vec::new(); window as usize - 1]),
            heap: BinaryHeap::new(),
            places: [[0; AREAS]; BATTERIES],
            areas: (0..=most)
                .map(|parts| area_bucket(f64::from(parts) / area_parts * discs) as u8)
                .collect(),
            last: None,
        };
        duty.refresh();
        duty
    }

    /// The table as it is now.
    pub const fn table(&self) -> &DutyTable {
        &self.table
    }

    /// Chooses who senses in the next TTI, given the batteries: devices one after the other, each time the one whose
    /// table gives sensing the largest advantage, while one has any. Gives them by rising number.
    ///
    /// Gains never rise while others are added, and advantages never fall with the gain, so a candidate whose gain is
    /// still what it was is the best of all, and few have to be looked at twice.
    pub fn choose(&mut self, levels: &[Energy]) -> Vec<DeviceId> {
        self.begin(levels);
        let mut chosen = Vec::new();
        if self.coverage.uncovered() > 0.0 {
            self.greedily(|_| true, &mut chosen);
        }
        self.remember(chosen)
    }

    /// Adds the best of the devices for which `is_free` holds, one after the other, to those `chosen`.
    fn greedily(&mut self, is_free: impl Fn(usize) -> bool, chosen: &mut Vec<DeviceId>) {
        let mut keys = std::mem::take(&mut self.heap).into_vec();
        keys.clear();
        let free = (0..self.energies.len()).filter(|&j| is_free(j));
        keys.extend(free.filter_map(|j| self.key(j)));
        self.heap = BinaryHeap::from(keys);
        while let Some(mut best) = self.heap.peek_mut() {
            let j = NUMBERS - (*best & u64::from(NUMBERS)) as u32;
            let key = key_of(&self.coverage, &self.places, &self.areas, &self.batteries, j as usize);
            match key {
                Some(now) if now == *best => {
                    PeekMut::pop(best);
                    self.coverage.add(j as usize);
                    chosen.push(DeviceId(j));
                }
                Some(now) => *best = now,
                None => {
                    PeekMut::pop(best);
                }
            }
        }
    }

    /// The same, and at random with probability `epsilon` for each device; what comes of it is learned from by
    /// [`Self::learn`].
    pub fn explore(&mut self, levels: &[Energy], epsilon: f64, stream: &mut Stream) -> Vec<DeviceId> {
        self.begin(levels);
        let of = |(&battery, &level): (&u8, &Energy)| Share {
            battery,
            level,
            ..Share::default()
        };
        let mut shares: Vec<Share> = self.batteries.iter().zip(levels).map(of).collect();
        let mut is_free: Vec<bool> = self.batteries.iter().map(|&battery| battery >= 2).collect();
        let mut chosen = Vec::new();
        // Devices that decide at random come first, so that what they cover counts for the others.
        for (j, is_free) in is_free.iter_mut().enumerate() {
            if stream.unit() < epsilon && *is_free {
                *is_free = false;
                if stream.unit() < 0.5 {
                    shares[j].decide(true, &self.coverage, j, self.discs);
                    self.coverage.add(j);
                    chosen.push(DeviceId(j as u32));
                }
            }
        }
        let by_chance = chosen.len();
        self.greedily(|j| is_free[j], &mut chosen);
        self.gains_of(&chosen, by_chance, &mut shares);
        for (j, share) in shares.iter_mut().enumerate().filter(|(_, share)| !share.on) {
            share.decide(false, &self.coverage, j, self.discs);
        }
        let uncovered = self.coverage.uncovered();
        let credits = self.credits(&chosen);
        self.last = Some(Decision {
            shares,
            credits,
            uncovered,
        });
        self.remember(chosen)
    }

    /// Fills in what those `chosen` from the `first`-th on have newly covered, each at its turn.
    fn gains_of(&mut self, chosen: &[DeviceId], first: usize, shares: &mut [Share]) {
        self.cover_recent();
        for (turn, device) in chosen.iter().enumerate() {
            let j = device.index();
            if turn >= first {
                shares[j].decide(true, &self.coverage, j, self.discs);
            }
            self.coverage.add(j);
        }
    }

    /// The share of the area that counts as covered by each device: each place is its who covered it first in the
    /// window, with `chosen`, in this order, in the last TTI of it.
    fn credits(&mut self, chosen: &[DeviceId]) -> Vec<f64> {
        let mut credits = vec![0.0; self.energies.len()];
        self.coverage.clear();
        for device in self.recent.iter().flatten().chain(chosen) {
            let j = device.index();
            credits[j] += self.coverage.gain(j);
            self.coverage.add(j);
        }
        credits
    }

    /// Learns from the last exploration, after which the batteries are at `levels`.
    pub fn learn(&mut self, levels: &[Energy]) {
        let Some(Decision { shares, .. }) = self.last.take() else {
            return;
        };
        let zeta = self.terms.weights.zeta;
        for ((share, &after), energy) in shares.iter().zip(levels).zip(&self.energies) {
            let Share { battery, area, on, .. } = *share;
            let reward = if on { self.worth * share.gain } else { 1.0 };
            let [before, after] = [share.level, after].map(|level| value_at(&self.values, level, energy));
            let (battery, area) = (usize::from(battery), usize::from(area));
            let outcome = reward + zeta * after;
            let value = self.table.outcome_mut(battery, area, on);
            value.learn(outcome, self.rates);
            let worth = value.value;
            // Only what the action does to the value tells the two actions apart. What is the same for both would drown
            // the difference for as long as it is itself being learned.
            self.table
                .at_mut(battery, area, on)
                .learn(outcome - zeta * before, self.rates);
            let (node, part) = node_of(share.level, energy);
            self.table.value[node].learn_a_share(worth, 1.0 - part, self.rates);
            self.table.value[node + 1].learn_a_share(worth, part, self.rates);
        }
        self.refresh();
    }

    /// Makes what is looked up anew from the table.
    fn refresh(&mut self) {
        let advantages = self.table.advantages();
        self.values = self.table.values();
        let mut sorted: Vec<f64> = advantages.iter().flatten().copied().filter(|a| *a > 0.0).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        sorted.dedup();
        let place = |advantage: f64| sorted.partition_point(|a| *a <= advantage) as u8;
        self.places = advantages.map(|row| row.map(|a| if a > 0.0 { place(a) } else { 0 }));
    }

    /// r(k) of the last exploration, and the devices' shares of it, which add up to it.
    pub fn rewards(&self) -> Option<(f64, impl Iterator<Item = f64> + '_)> {
        let Decision {
            shares,
            credits,
            uncovered,
        } = self.last.as_ref()?;
        let n = shares.len() as f64;
        let on = shares.iter().filter(|share| share.on).count() as f64;
        let weight = self.terms.alpha * self.terms.weights.mu1;
        let of = move |(share, credit): (&Share, &f64)| {
            let asleep = if share.on { 0.0 } else { 1.0 / n };
            asleep + weight * (credit - 1.0 / n)
        };
        Some((1.0 - on / n - weight * uncovered, shares.iter().zip(credits).map(of)))
    }

    fn begin(&mut self, levels: &[Energy]) {
        for ((battery, &level), energy) in self.batteries.iter_mut().zip(levels).zip(&self.energies) {
            *battery = battery_bucket(level, energy) as u8;
        }
        self.cover_recent();
    }

    /// Covers what was covered in the last TTIs, and nothing else.
    fn cover_recent(&mut self) {
        self.coverage.clear();
        for device in self.recent.iter().flatten() {
            self.coverage.add(device.index());
        }
    }

    /// The rank of the `j`-th device among the candidates, if it can report and sensing is worth more than sleep.
    fn key(&self, j: usize) -> Option<u64> {
        key_of(&self.coverage, &self.places, &self.areas, &self.batteries, j)
    }

    fn remember(&mut self, mut chosen: Vec<DeviceId>) -> Vec<DeviceId> {
        if self.terms.window > 1 {
            self.recent.pop_front();
            self.recent.push_back(chosen.clone());
        }
        chosen.sort_unstable();
        chosen
    }
}

/// The largest number of a device within a key.
const NUMBERS: u32 = (1 << 24) - 1;

/// The advantage's place, what is newly covered, and the number counted down, one below the other: the largest key has
/// the largest advantage, among those the largest area, and among those the lowest number. A gain never rises while
/// others are added, so neither does the key.
#[inline]
fn key_of(
    coverage: &Coverage,
    places: &[[u8; AREAS]; BATTERIES],
    areas: &[u8],
    batteries: &[u8],
    j: usize,
) -> Option<u64> {
    let battery = usize::from(batteries[j]);
    if battery < 2 {
        return None;
    }
    let parts = coverage.parts(j);
    let place = places[battery][usize::from(areas[parts as usize])];
    let number = NUMBERS - j as u32;
    (place > 0 && parts > 0).then(|| u64::from(place) << 56 | u64::from(parts) << 24 | u64::from(number))
}

impl Share {
    /// The `j`-th device decides, with `coverage` as it is before.
    fn decide(&mut self, on: bool, coverage: &Coverage, j: usize, discs: f64) {
        let gain = coverage.gain(j);
        (self.on, self.gain) = (on, gain);
        self.area = area_bucket(gain * discs) as u8;
    }
}

/// The node below `level`, and how far it is to the next, `[0, 1]`.
fn node_of(level: Energy, energy: &EnergyModel) -> (usize, f64) {
    let at = level.micro() as f64 / energy.e_max.micro() as f64 * (NODES - 1) as f64;
    let node = (at as usize).min(NODES - 2);
    (node, (at - node as f64).min(1.0))
}

fn value_at(values: &[f64; NODES], level: Energy, energy: &EnergyModel) -> f64 {
    let (node, part) = node_of(level, energy);
    values[node] + part * (values[node + 1] - values[node])
}

#[cfg(test)]
#[path = "duty_tests.rs"]
mod tests;
