//! Who senses: sequential choice by a table, and learning it.

use super::ground;
use super::ground::{Gain, Ground};
use super::learned::{ABLE, DutyTable, Lookback, NODES, Rates, Schedule, Weights, battery_bucket};
use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

/// What the learner is asked to weigh.
#[derive(Clone, Copy, Debug)]
pub struct Terms {
    /// μ1 and ζ.
    pub weights: Weights,
    /// How values are learned.
    pub schedule: Schedule,
    /// Probability α that an event starts in a TTI.
    pub alpha: f64,
    /// What a look at a place counts for later.
    pub lookback: Lookback,
    /// Probability that nothing is heard of a device in S1 that has detected an event.
    pub lost: f64,
}

/// The duty cycling of a deployment.
pub struct Duty {
    table: DutyTable,
    /// V of the table, made monotone.
    values: [f64; NODES],
    terms: Terms,
    rates: Rates,
    /// What a device that alone covers the whole area adds to N r(k) until it has to be covered again.
    worth: f64,
    energies: Vec<EnergyModel>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    ground: Box<dyn Ground>,
    /// What was decided last, while it is to be learned from.
    last: Option<Decision>,
}

/// All shares of one decision.
#[derive(Clone, Debug, Default)]
struct Decision {
    /// The share of each device.
    shares: Vec<Share>,
    /// By device, what is looked at thanks to it, a share of `all`'s unit.
    credits: Vec<f64>,
    /// U(k), what nobody looks at.
    left: f64,
    /// What there is to look at: the area, or with ages what it is worth.
    all: f64,
}

/// What a device decided in, and did.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    battery: u8,
    area: u8,
    on: bool,
    /// What it newly looked at, or would have, in that unit.
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
            lookback,
            lost,
        } = terms;
        let mut duty = Self {
            values: [0.0; NODES],
            table,
            worth: weights.covering(positions.len() as u32, alpha, lookback.window()),
            rates: schedule.rates(),
            terms,
            batteries: vec![0; positions.len()],
            ground: ground::new(lookback, lost, positions, area, sensing),
            energies,
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
        let chosen = self.ground.choose(&|_| true);
        self.remember(chosen)
    }

    /// The same, and at random with probability `epsilon` for each device; what comes of it is learned from by
    /// [`Self::learn`].
    pub fn explore(&mut self, levels: &[Energy], epsilon: f64, stream: &mut Stream) -> Vec<DeviceId> {
        self.begin(levels);
        let of = |(&level, &battery): (&Energy, &u8)| Share {
            battery,
            level,
            ..Share::default()
        };
        let mut shares: Vec<Share> = levels.iter().zip(&self.batteries).map(of).collect();
        let mut is_free: Vec<bool> = self.batteries.iter().map(|&battery| battery >= ABLE).collect();
        let mut chosen = Vec::new();
        // Devices that decide at random come first, so that what they look at counts for the others.
        for (j, is_free) in is_free.iter_mut().enumerate() {
            if stream.unit() < epsilon && *is_free {
                *is_free = false;
                if stream.unit() < 0.5 {
                    self.ground.add(j);
                    chosen.push(DeviceId(j as u32));
                }
            }
        }
        let others = self.ground.choose(&|j| is_free[j]);
        chosen.extend(others);
        // Each at its turn, and then those who were not chosen.
        let gains = self.ground.gains(&chosen);
        for (device, &gain) in chosen.iter().zip(&gains) {
            shares[device.index()].decide(true, gain);
        }
        for (j, share) in shares.iter_mut().enumerate().filter(|(_, share)| !share.on) {
            share.decide(false, self.ground.gain(j));
        }
        self.last = Some(Decision {
            shares,
            left: self.ground.left(),
            all: self.ground.all(),
            credits: self.ground.credits(&chosen, &gains),
        });
        self.remember(chosen)
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
        self.ground.set_advantages(&self.table.advantages());
        self.values = self.table.values();
    }

    /// r(k) of the last exploration, and the devices' shares of it, which add up to it.
    pub fn rewards(&self) -> Option<(f64, impl Iterator<Item = f64> + '_)> {
        let Decision {
            shares,
            credits,
            left,
            all,
        } = self.last.as_ref()?;
        let n = shares.len() as f64;
        let on = shares.iter().filter(|share| share.on).count() as f64;
        let weight = self.terms.alpha * self.terms.weights.mu1;
        let of = move |(share, credit): (&Share, &f64)| {
            let asleep = if share.on { 0.0 } else { 1.0 / n };
            asleep + weight * (credit - all / n)
        };
        Some((1.0 - on / n - weight * left, shares.iter().zip(credits).map(of)))
    }

    fn begin(&mut self, levels: &[Energy]) {
        for ((bucket, &level), energy) in self.batteries.iter_mut().zip(levels).zip(&self.energies) {
            *bucket = battery_bucket(level, energy) as u8;
        }
        self.ground.begin(&self.batteries);
    }

    /// An event was reported in the TTI that was decided on last.
    pub fn found(&mut self) {
        self.ground.found();
    }

    /// How likely an event that was reported is to be at a place, up to a factor.
    pub fn prior(&self, at: Point) -> f64 {
        self.ground.prior(at)
    }

    fn remember(&mut self, mut chosen: Vec<DeviceId>) -> Vec<DeviceId> {
        self.ground.remember(&chosen);
        chosen.sort_unstable();
        chosen
    }
}

impl Share {
    /// The device decides where it would newly look at `gain`.
    fn decide(&mut self, on: bool, gain: Gain) {
        (self.on, self.gain, self.area) = (on, gain.share, gain.bucket);
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
