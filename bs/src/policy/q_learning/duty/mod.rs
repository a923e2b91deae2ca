//! Duty cycling of `q-learning`: sequential choice of the sensing devices by a table, and learning of the table.
//!
//! The policy decides with [`DutyLearner::choose`]; a run that learns calls [`DutyLearner::explore`] and, one TTI
//! later, [`DutyLearner::learn`]. The shares of the reward follow the documentation of the parent module and must add
//! up to r(k). Exploration draws device by device, in the order of ids; learned tables depend on this order, digests on
//! the choice. All levels are of all devices, in the order of ids.

use super::area_state;
use super::area_state::{AreaState, Gain};
use super::learned::{
    BucketLevels, DutyTable, FIRST_ABLE_BUCKET, LearningRates, Lookback, QWeights, Schedule, VALUE_NODES,
};
use reveille_common::geometry::{Area, Point};
use reveille_common::ids::DeviceId;
use reveille_common::rng::Stream;
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

/// Parameters of the duty-cycle learner.
#[derive(Clone, Copy, Debug)]
pub struct DutyParameters {
    /// Weights; μ1 and ζ are used.
    pub weights: QWeights,
    /// Learning schedule.
    pub schedule: Schedule,
    /// Probability α that an event starts in a TTI.
    pub alpha: f64,
    /// Duration for which a covered place counts as covered.
    pub lookback: Lookback,
    /// Probability that no report arrives from a device in S1 that has detected an event.
    pub loss_probability: f64,
}

/// The duty cycling of a deployment.
pub struct DutyLearner {
    table: DutyTable,
    /// V of the table, made monotone: [`DutyTable::values`].
    monotone_values: [f64; VALUE_NODES],
    parameters: DutyParameters,
    rates: LearningRates,
    /// Contribution to N r(k) of a device that alone covers the whole area, until the area must be covered again.
    coverage_worth: f64,
    energies: Vec<EnergyModel>,
    /// By device.
    bucket_levels: Vec<BucketLevels>,
    battery_buckets: Vec<u8>,
    area_state: Box<dyn AreaState>,
    last_decision: Option<DutyDecision>,
}

#[derive(Clone, Debug, Default)]
struct DutyDecision {
    /// State, action and gain of each device, in the order of ids.
    by_device: Vec<DeviceDecision>,
    /// By device, the coverage credited to it, in the unit of `coverable`.
    credits: Vec<f64>,
    /// U(k), the uncovered part.
    uncovered: f64,
    /// Total that can be covered: the area, or with ages its worth.
    coverable: f64,
}

/// State in which a device decided, and its action.
#[derive(Clone, Copy, Debug, Default)]
struct DeviceDecision {
    battery_bucket: u8,
    /// Bucket of the newly covered area.
    area_bucket: u8,
    is_sensing: bool,
    /// Newly covered part, actual or hypothetical, in the unit of [`DutyDecision::coverable`].
    gain: f64,
    level: Energy,
}

impl DutyLearner {
    /// Creates a learner with `table` for devices at `positions` of `area`.
    pub fn new(
        table: DutyTable,
        parameters: DutyParameters,
        positions: &[Point],
        energies: Vec<EnergyModel>,
        area: Area,
        sensing: &Sensing,
    ) -> Self {
        let DutyParameters {
            weights,
            schedule,
            alpha,
            lookback,
            loss_probability,
        } = parameters;
        let mut duty = Self {
            monotone_values: [0.0; VALUE_NODES],
            table,
            coverage_worth: weights.covering_worth(positions.len() as u32, alpha, lookback.window()),
            rates: schedule.rates(),
            parameters,
            battery_buckets: vec![0; positions.len()],
            area_state: area_state::new(lookback, loss_probability, positions, area, sensing),
            bucket_levels: energies.iter().map(BucketLevels::new).collect(),
            energies,
            last_decision: None,
        };
        duty.update_derived();
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
        let chosen = self.area_state.choose_devices(&|_| true);
        self.end_tti(chosen)
    }

    /// Chooses as [`Self::choose`], but at random with probability `epsilon` per device, for [`Self::learn`].
    pub fn explore(&mut self, levels: &[Energy], epsilon: f64, stream: &mut Stream) -> Vec<DeviceId> {
        self.begin(levels);
        let undecided = |(&level, &battery_bucket): (&Energy, &u8)| DeviceDecision {
            battery_bucket,
            level,
            ..DeviceDecision::default()
        };
        let mut by_device: Vec<DeviceDecision> = levels.iter().zip(&self.battery_buckets).map(undecided).collect();
        let is_able = |&bucket: &u8| bucket >= FIRST_ABLE_BUCKET;
        let mut is_free: Vec<bool> = self.battery_buckets.iter().map(is_able).collect();
        let mut chosen = Vec::new();
        // Random decisions come first, so that the choice among the others accounts for the coverage by these devices.
        for (j, is_free) in is_free.iter_mut().enumerate() {
            if stream.unit() < epsilon && *is_free {
                *is_free = false;
                if stream.unit() < 0.5 {
                    self.area_state.add(j);
                    chosen.push(DeviceId(j as u32));
                }
            }
        }
        let others = self.area_state.choose_devices(&|j| is_free[j]);
        chosen.extend(others);
        // A chosen device decided given the devices chosen before it; the others decided given all chosen devices.
        let gains = self.area_state.gains(&chosen);
        for (device, &gain) in chosen.iter().zip(&gains) {
            by_device[device.index()].record(true, gain);
        }
        for (j, decision) in by_device
            .iter_mut()
            .enumerate()
            .filter(|(_, decision)| !decision.is_sensing)
        {
            decision.record(false, self.area_state.gain(j));
        }
        self.last_decision = Some(DutyDecision {
            by_device,
            uncovered: self.area_state.uncovered_gain(),
            coverable: self.area_state.coverable_gain(),
            credits: self.area_state.credits(&chosen, &gains),
        });
        self.end_tti(chosen)
    }

    /// Learns from the last exploration, once; `levels` are the batteries after it. Call it before the next
    /// exploration.
    pub fn learn(&mut self, levels: &[Energy]) {
        let Some(DutyDecision { by_device, .. }) = self.last_decision.take() else {
            return;
        };
        let zeta = self.parameters.weights.zeta;
        for ((decision, &level_after), energy) in by_device.iter().zip(levels).zip(&self.energies) {
            let DeviceDecision {
                battery_bucket,
                area_bucket,
                is_sensing,
                ..
            } = *decision;
            // N r_j of the module documentation, without the part that is the same for both actions.
            let reward = if is_sensing {
                self.coverage_worth * decision.gain
            } else {
                1.0
            };
            let [value_before, value_after] =
                [decision.level, level_after].map(|level| value_at(&self.monotone_values, level, energy));
            let (battery, area) = (usize::from(battery_bucket), usize::from(area_bucket));
            let outcome = reward + zeta * value_after;
            let outcome_cell = self.table.outcome_mut(battery, area, is_sensing);
            outcome_cell.learn(outcome, self.rates);
            let whole_q = outcome_cell.value;
            // The subtracted value is the same for both actions and would hide their difference while V is still being
            // learned.
            self.table
                .at_mut(battery, area, is_sensing)
                .learn(outcome - zeta * value_before, self.rates);
            // V is the mean over all actions taken, including exploration as in SARSA, so it learns from the whole
            // Q.
            let (node, part) = locate_node(decision.level, energy);
            self.table.value[node].learn_weighted(whole_q, 1.0 - part, self.rates);
            self.table.value[node + 1].learn_weighted(whole_q, part, self.rates);
        }
        self.update_derived();
    }

    /// Updates the state that depends on the table: the advantages and the monotone values.
    fn update_derived(&mut self) {
        self.area_state.set_advantages(&self.table.advantages());
        self.monotone_values = self.table.values();
    }

    /// Returns r(k) of the last exploration and the devices' shares of it, which add up to it; `None` after
    /// [`Self::learn`].
    pub fn rewards(&self) -> Option<(f64, impl Iterator<Item = f64> + '_)> {
        let DutyDecision {
            by_device,
            credits,
            uncovered,
            coverable,
        } = self.last_decision.as_ref()?;
        let n = by_device.len() as f64;
        let sensing = by_device.iter().filter(|decision| decision.is_sensing).count() as f64;
        let weight = self.parameters.alpha * self.parameters.weights.mu1;
        let share_of_reward = move |(decision, credit): (&DeviceDecision, &f64)| {
            let sleep_share = if decision.is_sensing { 0.0 } else { 1.0 / n };
            sleep_share + weight * (credit - coverable / n)
        };
        Some((
            1.0 - sensing / n - weight * uncovered,
            by_device.iter().zip(credits).map(share_of_reward),
        ))
    }

    fn begin(&mut self, levels: &[Energy]) {
        for ((bucket, &level), starts) in self.battery_buckets.iter_mut().zip(levels).zip(&self.bucket_levels) {
            *bucket = starts.bucket(level);
        }
        self.area_state.begin_tti(&self.battery_buckets);
    }

    /// Records that an event was reported in the TTI of the last decision.
    pub fn record_event(&mut self) {
        self.area_state.record_event();
    }

    /// Returns the relative likelihood that a reported event is at a place.
    pub(crate) fn prior(&self, place: Point) -> f64 {
        self.area_state.prior(place)
    }

    fn end_tti(&mut self, mut chosen: Vec<DeviceId>) -> Vec<DeviceId> {
        self.area_state.end_tti(&chosen);
        // The area state credits places in the order of choice; the plan needs ascending ids.
        chosen.sort_unstable();
        chosen
    }
}

impl DeviceDecision {
    /// Records the decision of the device and the part that it would newly cover.
    fn record(&mut self, is_sensing: bool, gain: Gain) {
        (self.is_sensing, self.gain, self.area_bucket) = (is_sensing, gain.share, gain.bucket);
    }
}

/// Returns the node of V below `level` and the relative distance to it, `[0, 1]`.
fn locate_node(level: Energy, energy: &EnergyModel) -> (usize, f64) {
    let nodes = level.micro() as f64 / energy.e_max.micro() as f64 * (VALUE_NODES - 1) as f64;
    // A full battery is the end of the last interval.
    let node = (nodes as usize).min(VALUE_NODES - 2);
    (node, (nodes - node as f64).min(1.0))
}

/// Returns V at `level`, interpolated between nodes.
fn value_at(values: &[f64; VALUE_NODES], level: Energy, energy: &EnergyModel) -> f64 {
    let (node, part) = locate_node(level, energy);
    values[node] + part * (values[node + 1] - values[node])
}

#[cfg(test)]
mod tests;
