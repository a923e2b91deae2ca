//! Who senses: sequential choice by a table, and learning it.

use std::collections::VecDeque;

use super::choice::Choice;
use super::learned::{DutyTable, NODES, Rates, Schedule, Weights, battery_bucket};
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
    energies: Vec<EnergyModel>,
    choice: Choice,
    /// Who sensed in each of the last `window` − 1 TTIs, the latest at the end.
    recent: VecDeque<Vec<DeviceId>>,
    /// TTIs over which the choice is still to be spread.
    spread: usize,
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
        let discs = area.surface() / (std::f64::consts::PI * sensing.d_max * sensing.d_max);
        let mut duty = Self {
            values: [0.0; NODES],
            table,
            worth: weights.covering(positions.len() as u32, alpha, window),
            rates: schedule.rates(),
            terms,
            choice: Choice::new(coverage, discs, positions.len()),
            energies,
            recent: VecDeque::from(vec![Vec::new(); window as usize - 1]),
            spread: window as usize,
            last: None,
        };
        duty.refresh();
        duty
    }

    /// The table as it is now.
    pub const fn table(&self) -> &DutyTable {
        &self.table
    }

    /// Chooses who senses in the next TTI, given the batteries: devices one after the other. Gives them by rising
    /// number.
    pub fn choose(&mut self, levels: &[Energy]) -> Vec<DeviceId> {
        self.begin(levels);
        let chosen = self.among(|_| true, &[]);
        self.remember(chosen)
    }

    /// Those for whom `is_free` holds that are chosen beside those of `set`, who are added.
    fn among(&mut self, is_free: impl Fn(usize) -> bool, set: &[DeviceId]) -> Vec<DeviceId> {
        let mut chosen = self.choice.choose(is_free);
        let covering = || self.recent.iter().flatten().chain(set).copied();
        self.choice.spare(&mut chosen, covering);
        // What is looked at now comes due all at once a window later. So that this is not everything in one TTI and
        // nothing in the next, the first window begins with a part of the choice: those that are far apart.
        if self.spread > 1 {
            chosen = chosen.into_iter().step_by(self.spread).collect();
        }
        chosen
    }

    /// The same, and at random with probability `epsilon` for each device; what comes of it is learned from by
    /// [`Self::learn`].
    pub fn explore(&mut self, levels: &[Energy], epsilon: f64, stream: &mut Stream) -> Vec<DeviceId> {
        self.begin(levels);
        let of = |(j, &level): (usize, &Energy)| Share {
            battery: self.choice.battery(j),
            level,
            ..Share::default()
        };
        let mut shares: Vec<Share> = levels.iter().enumerate().map(of).collect();
        let mut is_free: Vec<bool> = (0..levels.len()).map(|j| self.choice.is_able(j)).collect();
        let mut chosen = Vec::new();
        // Devices that decide at random come first, so that what they cover counts for the others.
        for (j, is_free) in is_free.iter_mut().enumerate() {
            if stream.unit() < epsilon && *is_free {
                *is_free = false;
                if stream.unit() < 0.5 {
                    self.choice.add(j);
                    chosen.push(DeviceId(j as u32));
                }
            }
        }
        let others = self.among(|j| is_free[j], &chosen);
        chosen.extend(others);
        self.gains_of(&chosen, &mut shares);
        for (j, share) in shares.iter_mut().enumerate().filter(|(_, share)| !share.on) {
            share.decide(false, self.choice.gain(j));
        }
        let uncovered = self.choice.uncovered();
        let credits = self.credits(&chosen);
        self.last = Some(Decision {
            shares,
            credits,
            uncovered,
        });
        self.remember(chosen)
    }

    /// Fills in what those `chosen` have newly covered, each at its turn.
    fn gains_of(&mut self, chosen: &[DeviceId], shares: &mut [Share]) {
        self.choice.cover(self.recent.iter().flatten().copied());
        for device in chosen {
            let j = device.index();
            shares[j].decide(true, self.choice.gain(j));
            self.choice.add(j);
        }
    }

    /// The share of the area that counts as covered by each device: each place is its who covered it first in the
    /// window, with `chosen`, in this order, in the last TTI of it.
    fn credits(&mut self, chosen: &[DeviceId]) -> Vec<f64> {
        let mut credits = vec![0.0; self.energies.len()];
        self.choice.cover(std::iter::empty());
        for device in self.recent.iter().flatten().chain(chosen) {
            let j = device.index();
            credits[j] += self.choice.gain(j).0;
            self.choice.add(j);
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
        self.choice.set_advantages(&self.table.advantages());
        self.values = self.table.values();
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
        let buckets = levels.iter().zip(&self.energies);
        let buckets = buckets.map(|(&level, energy)| battery_bucket(level, energy));
        self.choice.begin(buckets, self.recent.iter().flatten().copied());
    }

    fn remember(&mut self, mut chosen: Vec<DeviceId>) -> Vec<DeviceId> {
        if self.terms.window > 1 {
            self.recent.pop_front();
            self.recent.push_back(chosen.clone());
        }
        self.spread = self.spread.saturating_sub(1);
        chosen.sort_unstable();
        chosen
    }
}

impl Share {
    /// The device decides where it would newly cover `gain` of the area, in this bucket.
    fn decide(&mut self, on: bool, (gain, area): (f64, u8)) {
        (self.on, self.gain, self.area) = (on, gain, area);
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
