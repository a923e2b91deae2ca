//! Duty cycling: sequential choice of sensing devices by a table, and learning of the table.

use super::area_state;
use super::area_state::{AreaState, Gain};
use super::learned::{ABLE, DutyTable, Lookback, NODES, QWeights, Rates, Schedule, battery_bucket};
use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

/// Parameters of the duty-cycle learner.
#[derive(Clone, Copy, Debug)]
pub struct DutyTerms {
    /// Weights; μ1 and ζ are used.
    pub weights: QWeights,
    /// Learning schedule.
    pub schedule: Schedule,
    /// Probability α that an event starts in a TTI.
    pub alpha: f64,
    /// Duration for which a covered place counts as covered.
    pub lookback: Lookback,
    /// Probability that no report arrives from a device in S1 that has detected an event.
    pub lost: f64,
}

/// The duty cycling of a deployment.
pub struct Duty {
    table: DutyTable,
    /// V of the table, made monotone.
    values: [f64; NODES],
    terms: DutyTerms,
    rates: Rates,
    /// Contribution to N r(k) of a device that alone covers the whole area, until the area must be covered again.
    worth: f64,
    energies: Vec<EnergyModel>,
    /// The battery bucket of each device.
    batteries: Vec<u8>,
    ground: Box<dyn AreaState>,
    /// Last decision, kept until it is learned from.
    last: Option<Decision>,
}

/// All shares of one decision.
#[derive(Clone, Debug, Default)]
struct Decision {
    /// State, action and gain of each device.
    shares: Vec<Share>,
    /// By device, the coverage credited to it, in the unit of `all`.
    credits: Vec<f64>,
    /// U(k), the uncovered part.
    unused: f64,
    /// Total that can be covered: the area, or with ages its worth.
    all: f64,
}

/// State in which a device decided, and its action.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    battery: u8,
    area: u8,
    on: bool,
    /// Newly covered part, actual or hypothetical, in the unit of [`Decision::all`].
    gain: f64,
    level: Energy,
}

impl Duty {
    /// Creates a learner with `table` for devices at `positions` of `area`.
    pub fn new(
        table: DutyTable,
        terms: DutyTerms,
        positions: &[Point],
        energies: Vec<EnergyModel>,
        area: Area,
        sensing: &Sensing,
    ) -> Self {
        let DutyTerms {
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
            ground: area_state::new(lookback, lost, positions, area, sensing),
            energies,
            last: None,
        };
        duty.refresh();
        duty
    }

    /// Current table.
    pub const fn table(&self) -> &DutyTable {
        &self.table
    }

    /// Chooses the devices that sense in the next TTI, one by one, from the battery levels. Returns them in the order
    /// of ids.
    pub fn choose(&mut self, levels: &[Energy]) -> Vec<DeviceId> {
        self.begin(levels);
        let chosen = self.ground.choose(&|_| true);
        self.remember(chosen)
    }

    /// Chooses as [`Self::choose`], but at random with probability `epsilon` per device, for [`Self::learn`].
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
        // Random decisions come first, so that the choice among the others accounts for what these devices cover.
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
        // A chosen device decided given the devices chosen before it; the others decided given all chosen devices.
        let gains = self.ground.gains(&chosen);
        for (device, &gain) in chosen.iter().zip(&gains) {
            shares[device.index()].decide(true, gain);
        }
        for (j, share) in shares.iter_mut().enumerate().filter(|(_, share)| !share.on) {
            share.decide(false, self.ground.gain(j));
        }
        self.last = Some(Decision {
            shares,
            unused: self.ground.left(),
            all: self.ground.all(),
            credits: self.ground.credits(&chosen, &gains),
        });
        self.remember(chosen)
    }

    /// Learns from the last exploration; `levels` are the batteries after it.
    pub fn learn(&mut self, levels: &[Energy]) {
        let Some(Decision { shares, .. }) = self.last.take() else {
            return;
        };
        let zeta = self.terms.weights.zeta;
        for ((share, &after), energy) in shares.iter().zip(levels).zip(&self.energies) {
            let Share { battery, area, on, .. } = *share;
            // N r_j of the module documentation, without the part that is the same for both actions.
            let reward = if on { self.worth * share.gain } else { 1.0 };
            let [before, after] = [share.level, after].map(|level| value_at(&self.values, level, energy));
            let (battery, area) = (usize::from(battery), usize::from(area));
            let outcome = reward + zeta * after;
            let value = self.table.outcome_mut(battery, area, on);
            value.learn(outcome, self.rates);
            let worth = value.value;
            // ζV(before) is the same for both actions and would hide their difference while V is still being learned.
            self.table
                .at_mut(battery, area, on)
                .learn(outcome - zeta * before, self.rates);
            // V is the mean over all actions taken, including exploration as in SARSA, so it learns from the whole
            // value.
            let (node, part) = node_of(share.level, energy);
            self.table.value[node].learn_a_share(worth, 1.0 - part, self.rates);
            self.table.value[node + 1].learn_a_share(worth, part, self.rates);
        }
        self.refresh();
    }

    /// Recomputes the values that are derived from the table.
    fn refresh(&mut self) {
        self.ground.set_advantages(&self.table.advantages());
        self.values = self.table.values();
    }

    /// Returns r(k) of the last exploration and the devices' shares of it, which add up to it.
    pub fn rewards(&self) -> Option<(f64, impl Iterator<Item = f64> + '_)> {
        let Decision {
            shares,
            credits,
            unused: left,
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

    /// Records that an event was reported in the TTI of the last decision.
    pub fn found(&mut self) {
        self.ground.found();
    }

    /// Returns the relative likelihood that a reported event is at a place.
    pub(crate) fn prior(&self, at: Point) -> f64 {
        self.ground.prior(at)
    }

    fn remember(&mut self, mut chosen: Vec<DeviceId>) -> Vec<DeviceId> {
        self.ground.remember(&chosen);
        // The area state credits places in the order of choice; the plan needs ascending ids.
        chosen.sort_unstable();
        chosen
    }
}

impl Share {
    /// Records the decision of the device and the part that it would newly cover.
    fn decide(&mut self, on: bool, gain: Gain) {
        (self.on, self.gain, self.area) = (on, gain.share, gain.bucket);
    }
}

/// Returns the node below `level` and the relative distance to it, `[0, 1]`.
fn node_of(level: Energy, energy: &EnergyModel) -> (usize, f64) {
    let at = level.micro() as f64 / energy.e_max.micro() as f64 * (NODES - 1) as f64;
    // A full battery is the end of the last interval.
    let node = (at as usize).min(NODES - 2);
    (node, (at - node as f64).min(1.0))
}

fn value_at(values: &[f64; NODES], level: Energy, energy: &EnergyModel) -> f64 {
    let (node, part) = node_of(level, energy);
    values[node] + part * (values[node + 1] - values[node])
}

#[cfg(test)]
mod tests;
