//! Battery levels as the base station knows or estimates them. [`BaseStation`](crate::base_station::BaseStation) keeps
//! one estimator. Policies decide by the levels, so every rounding here is part of the digest.
//! `tests/src/reference/estimate.rs` repeats whether a device can pay for a report, with `MIN_SILENCE_LIKELIHOOD`;
//! docs/policies.md lists the signs of an empty battery.
//!
//! A level is known in three cases: ground truth, a report, or a missing answer of a device that must answer. In the
//! last case the battery is empty, since a failed action empties it. From then on the estimate adds the mean harvest,
//! which may depend on the time of day, and subtracts the cost of the commanded states.
//!
//! The true harvest can drop below its mean: a trace ends, a panel is shaded, a device fails. The BS sees only the
//! effects. A device that should be charged is found empty, or a whole class is silent for too long. The devices of the
//! class that were due to report then count as empty. A first finding may be chance, so the devices get their usual
//! time to charge. After each further finding without a report in between, charging for one report is assumed to take
//! as long as the time since the first. So devices without harvest are asked ever less often. Devices that charge again
//! are asked again after at most about the length of their outage. A report resets all of this.

use std::f64::consts::TAU;
use std::sync::Arc;

use reveille_common::geometry::{Buckets, Point};
use reveille_common::harvest::DayProfile;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::RadioLossRates;
use reveille_common::scenario::{BatteryKnowledge, EnergyModel};
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use crate::knowledge::{DeviceKnowledge, Knowledge};

/// Expected number of reports during a silence beyond which a device, or a class, counts as empty. One working device
/// in three thousand is silent for this long, exp(−8); slightly more where events last, since no event starts during
/// another.
const MAX_EXPECTED_REPORTS: f64 = 8.0;
/// Probability that the radio alone explains all missing answers of a device; at or below it the device counts as
/// empty.
const MIN_SILENCE_LIKELIHOOD: f64 = 0.02;
/// Circles within d_max for the integral over the sensing range of a device.
const CIRCLES: u32 = 16;
const POINTS_PER_CIRCLE: u32 = 32;
/// Margin that absorbs rounding when a device is sure to be in range of an event, metres per metre of d_max.
const ROUNDING_MARGIN: f64 = 1e-9;

/// Battery level of every device, given as ground truth or estimated.
#[derive(Clone, Debug)]
pub struct BatteryEstimator {
    /// Whether [`Self::set_true_levels`] sets the levels. A report or an unanswered wake-up still sets the level of its
    /// device, until the next call.
    uses_true_levels: bool,
    levels: Vec<Energy>,
    /// Other state by device.
    estimates: Vec<DeviceEstimateState>,
    classes: Vec<ClassHarvest>,
    geometry: SensingGeometry,
    radio: RadioLossRates,
}

/// State of a class of devices, which share a kind of energy source.
#[derive(Clone, Debug)]
struct ClassHarvest {
    /// Expected harvest by time of day, if it varies.
    day_profile: Option<Arc<DayProfile>>,
    /// Expected number of reports of the class since its last report.
    expected_reports: f64,
    doubt: HarvestDoubt,
}

/// Evidence that an energy source has failed.
#[derive(Clone, Copy, Debug, Default)]
struct HarvestDoubt {
    /// TTI of the first finding since the last report.
    since: Option<Tti>,
    /// Time from the first to the last finding, TTIs.
    outage: u64,
}

impl HarvestDoubt {
    /// Records the finding in TTI `k` that the source has not charged the device or class.
    fn record_finding(&mut self, k: Tti) {
        self.outage = k - *self.since.get_or_insert(k);
    }
}

/// Positions of the devices and their sensing model, which tell which devices must have detected the same event.
#[derive(Clone, Debug)]
struct SensingGeometry {
    positions: Vec<Point>,
    buckets: Buckets,
    sensing: Sensing,
}

/// The estimator's state of one device, except the level.
#[derive(Clone, Debug)]
struct DeviceEstimateState {
    class: u16,
    energy: EnergyModel,
    /// Mean harvest per TTI.
    mean_harvest: Energy,
    /// Largest fall of the level in a TTI without a report, micro-units. `None` if E_max leaves too little room for
    /// E_Tx.
    max_fall: Option<u64>,
    /// First TTI that the level does not include.
    next_tti: Tti,
    doubt: HarvestDoubt,
    /// Expected reports per TTI in S1; 0 if they are not counted.
    report_rate: f64,
    /// Expected number of reports since the last one.
    expected_reports: f64,
    /// Probability that the radio alone explains all missing answers since the last report.
    silence_likelihood: f64,
}

impl ClassHarvest {
    /// Returns the expected harvest, micro-units, from `from` to before `end` of a device with the mean harvest `mean`.
    fn expected_harvest(&self, mean: Energy, from: Tti, end: Tti) -> u64 {
        match &self.day_profile {
            Some(profile) => profile.energy_between(from, end).micro(),
            None => mean.micro() * (end - from),
        }
    }

    /// Returns the end of the day or night that contains `from`, at most `end`.
    fn day_or_night_end(&self, from: Tti, end: Tti) -> Tti {
        self.day_profile
            .as_ref()
            .map_or(end, |profile| profile.next_switch_after(from).min(end))
    }
}

impl DeviceEstimateState {
    fn new(device: &DeviceKnowledge, is_steady: bool) -> Self {
        let energy = &device.energy;
        let max_cost = energy.e_idle.max(energy.e_wur);
        // Otherwise the cap at E_max can take more than `max_fall` from the level, so nothing is sure.
        let is_fall_bounded = energy.e_max.saturating_sub(max_cost) >= energy.e_tx;
        // A source that follows the time of day may bring no energy at night, whatever its mean is.
        let min_harvest = if is_steady { device.mean_harvest } else { Energy::ZERO };
        let max_fall = is_fall_bounded.then(|| max_cost.saturating_sub(min_harvest).micro());
        Self {
            class: device.class,
            energy: device.energy,
            mean_harvest: device.mean_harvest,
            max_fall,
            next_tti: Tti::ZERO,
            doubt: HarvestDoubt::default(),
            report_rate: 0.0,
            expected_reports: 0.0,
            silence_likelihood: 1.0,
        }
    }

    /// Returns whether `level` is sure to be E_Tx or more after the TTIs before `end`, whatever was commanded. This is
    /// usually the case, and it saves the exact computation.
    #[inline]
    fn can_surely_report(&self, level: Energy, end: Tti) -> bool {
        // An overflow proves nothing, so the caller then computes the level exactly.
        let fall = self
            .max_fall
            .and_then(|fall| fall.checked_mul(end.0.saturating_sub(self.next_tti.0)));
        fall.is_some_and(|fall| level.micro().saturating_sub(fall) >= self.energy.e_tx.micro())
    }

    /// Returns `level` after the TTIs before `end`, with `device` of `class` under `plan`, and the number of TTIs in
    /// S1.
    fn level_before(
        &self,
        class: &ClassHarvest,
        level: Energy,
        device: DeviceId,
        plan: &Plan,
        end: Tti,
    ) -> (Energy, u64) {
        let cycle = plan.duty_cycle(device);
        let (mut level, mut on_ttis, mut from) = (level, 0, self.next_tti);
        // Each span is cut off at E_max separately: surplus harvest of the day beyond a full battery is lost before
        // the night.
        while from < end {
            let until = class.day_or_night_end(from, end);
            let (level_at_end, span_on_ttis) = self.level_after_span(class, level, cycle, from, until);
            (level, on_ttis, from) = (level_at_end, on_ttis + span_on_ttis, until);
        }
        (level, on_ttis)
    }

    /// Returns `level` after the TTIs from `from` to before `end` under `cycle`, and the number of TTIs in S1. The TTIs
    /// are all day or all night.
    fn level_after_span(
        &self,
        class: &ClassHarvest,
        level: Energy,
        cycle: DutyCycle,
        from: Tti,
        end: Tti,
    ) -> (Energy, u64) {
        let ttis = end - from;
        let EnergyModel {
            e_max,
            e_idle,
            e_wur,
            e_tx,
            ..
        } = self.energy;
        let (on_ttis, _, _) = match ttis {
            1 => (u64::from(cycle.is_on(from)), 0, 0),
            // A run has fewer than 2³⁰ TTIs, so the cast is exact.
            _ => cycle.sum_over_span(cycle.phase(from), ttis as u32),
        };
        let expected_harvest = class.expected_harvest(self.mean_harvest, from, end);
        let cost = e_idle.micro() * on_ttis + e_wur.micro() * (ttis - on_ttis);
        let level = if expected_harvest > cost {
            // While the source is in doubt, charging up to one report takes as long as the outage. Without doubt the
            // outage is 0, and the division yields `None`.
            let outage = class.doubt.outage.max(self.doubt.outage);
            let slow_gain = ((e_tx + e_idle).micro() * ttis).checked_div(outage);
            let gain = slow_gain.map_or(expected_harvest - cost, |slow_gain| {
                slow_gain.min(expected_harvest - cost)
            });
            level.micro().saturating_add(gain)
        } else {
            level.micro().saturating_sub(cost - expected_harvest)
        };
        // A TTI stores its harvest before δ is paid, so even a full battery ends the TTI below E_max by that cost.
        let last_cost = if cycle.is_on(Tti(end.0 - 1)) { e_idle } else { e_wur };
        (Energy::from_micro(level).min(e_max.saturating_sub(last_cost)), on_ttis)
    }

    /// Records that the device is empty at the end of TTI `k`, although its estimate was `level`. The caller sets the
    /// level to 0.
    fn mark_empty(&mut self, level: Energy, k: Tti) {
        // If the estimate already lay below E_Tx, the silence needs no failed source to explain it.
        if level > Energy::ZERO && level >= self.energy.e_tx {
            self.doubt.record_finding(k);
        }
        (self.next_tti, self.expected_reports, self.silence_likelihood) = (k + 1, 0.0, 1.0);
    }
}

impl BatteryEstimator {
    /// Creates the estimator with the known levels at the start of a run. It serves policies that read all levels
    /// before each decision. `bs.battery_knowledge` selects true or estimated levels.
    pub fn new(known: &Knowledge) -> Self {
        let uses_true_levels = known.bs.battery_knowledge == BatteryKnowledge::Oracle;
        let mut estimator = Self {
            uses_true_levels,
            ..Self::new_estimated(known)
        };
        if !uses_true_levels {
            let directions = unit_circle_points();
            for (estimate, device) in estimator.estimates.iter_mut().zip(&known.devices) {
                // A report that the radio loses is also silence, so it must not count as expected.
                let report_probability = 1.0 - known.radio.no_report_probability();
                estimate.report_rate =
                    known.alpha * report_probability * detection_probability(known, device.position, &directions);
            }
        }
        estimator
    }

    /// Creates an estimator that always estimates, for a policy that does not read all levels.
    pub(crate) fn new_estimated(known: &Knowledge) -> Self {
        let positions = known.positions();
        let new_estimate = |device: &DeviceKnowledge| {
            let is_steady = known.day_profiles[usize::from(device.class)].is_none();
            DeviceEstimateState::new(device, is_steady)
        };
        Self {
            uses_true_levels: false,
            levels: known.devices.iter().map(|device| device.energy.initial).collect(),
            classes: known
                .day_profiles
                .iter()
                .map(|day_profile| ClassHarvest {
                    day_profile: day_profile.clone(),
                    expected_reports: 0.0,
                    doubt: HarvestDoubt::default(),
                })
                .collect(),
            estimates: known.devices.iter().map(new_estimate).collect(),
            radio: known.radio,
            geometry: SensingGeometry {
                buckets: Buckets::new(&positions, known.area, known.sensing.d_max),
                positions,
                sensing: known.sensing.clone(),
            },
        }
    }

    /// Levels by device id: the true levels, or the estimates after the TTIs before the `end` of the last
    /// [`Self::advance`].
    pub fn levels(&self) -> &[Energy] {
        &self.levels
    }

    /// Whether the true levels must be given before each decision.
    pub fn needs_true_levels(&self) -> bool {
        self.uses_true_levels
    }

    /// Replaces all levels by the true ones, by device id.
    ///
    /// # Panics
    /// If `levels` has not one level per device.
    pub fn set_true_levels(&mut self, levels: impl IntoIterator<Item = Energy>) {
        self.levels.clear();
        self.levels.extend(levels);
        assert_eq!(self.levels.len(), self.estimates.len(), "a level for each device");
    }

    /// Returns whether `device` can pay for a report in TTI `k` under `plan`, according to its known or expected level.
    /// This is Pr(B ≥ E_Tx) of Sec. IV, rounded to 1 or 0. True levels are those before `k`.
    pub fn can_report(&self, device: DeviceId, k: Tti, plan: &Plan) -> bool {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.estimates[device.index()].energy;
        if !self.uses_true_levels {
            let (estimate, level) = (&self.estimates[device.index()], self.levels[device.index()]);
            return estimate.can_surely_report(level, k + 1) || self.estimate_at(device, plan, k + 1).0 >= e_tx;
        }
        let is_on = plan.is_on(device, k);
        self.levels[device.index()] >= e_tx + if is_on { e_idle } else { e_wur }
    }

    /// Returns the level of `device` after the TTIs before `end`, and the number of TTIs in S1.
    fn estimate_at(&self, device: DeviceId, plan: &Plan, end: Tti) -> (Energy, u64) {
        let estimate = &self.estimates[device.index()];
        let class = &self.classes[usize::from(estimate.class)];
        estimate.level_before(class, self.levels[device.index()], device, plan, end)
    }

    /// Advances all estimates through the TTIs before `end` under `plan`: adds the expected harvest and subtracts the
    /// cost of the commanded states. Call it before the plan changes, and in each TTI if [`Self::levels`] is read.
    /// Reports of a TTI are applied afterwards, since they are sent after δ is paid.
    pub fn advance(&mut self, end: Tti, plan: &Plan) {
        if self.uses_true_levels {
            return;
        }
        for ((level, estimate), j) in self.levels.iter_mut().zip(&mut self.estimates).zip(0..) {
            let class = &mut self.classes[usize::from(estimate.class)];
            let (level_at_end, on_ttis) = estimate.level_before(class, *level, DeviceId(j), plan, end);
            (*level, estimate.next_tti) = (level_at_end, end.max(estimate.next_tti));
            // A device that does not sense, or has too little energy for a report, has a known reason for its silence.
            if on_ttis > 0 && estimate.report_rate > 0.0 && level_at_end >= estimate.energy.e_tx {
                let new_reports = on_ttis as f64 * estimate.report_rate;
                estimate.expected_reports += new_reports;
                class.expected_reports += new_reports;
                if estimate.expected_reports > MAX_EXPECTED_REPORTS {
                    estimate.mark_empty(level_at_end, Tti(end.0 - 1));
                    *level = Energy::ZERO;
                }
            }
        }
        // After all devices, since the silence of a class is the sum over its devices.
        for class in 0..self.classes.len() {
            if self.classes[class].expected_reports > MAX_EXPECTED_REPORTS {
                self.mark_class_empty(class, Tti(end.0 - 1));
            }
        }
    }

    /// Marks a class without any report up to TTI `k` as failing: its devices that were due to report count as empty.
    fn mark_class_empty(&mut self, class: usize, k: Tti) {
        self.classes[class].expected_reports = 0.0;
        self.classes[class].doubt.record_finding(k);
        for (level, estimate) in self.levels.iter_mut().zip(&mut self.estimates) {
            if usize::from(estimate.class) == class && estimate.expected_reports > 0.0 {
                (*level, estimate.expected_reports) = (Energy::ZERO, 0.0);
            }
        }
    }

    /// Applies the `reports` of TTI `k` under `plan`, sorted by device id. With certain detection within d_max it also
    /// applies the silence of devices that must have detected the same event.
    pub fn update_from_reports(&mut self, k: Tti, plan: &Plan, reports: &[Report]) {
        for report in reports {
            self.observe_level(report.device, k, report.battery);
        }
        // With probabilistic detection a device in range may miss the event, so its silence shows nothing about its
        // battery.
        if self.uses_true_levels || self.geometry.sensing.kind != DetectionKind::Range {
            return;
        }
        let mut silent_devices = Vec::new();
        let SensingGeometry {
            positions,
            buckets,
            sensing,
        } = &self.geometry;
        for report in reports {
            let Some(d) = sensing.distance(report.information) else {
                continue;
            };
            // Triangle inequality: a device this near to the reporter is within d_max of the epicentre, wherever on
            // the ring that is.
            let reach = sensing.d_max * (1.0 - ROUNDING_MARGIN) - d;
            if reach < 0.0 {
                continue;
            }
            buckets.within(positions[report.device.index()], reach, |j, _| {
                let device = DeviceId(j as u32);
                let has_reported = || reports.binary_search_by_key(&device, |report| report.device).is_ok();
                if plan.is_on(device, k) && !has_reported() {
                    silent_devices.push(device);
                }
            });
        }
        // A device within reach of several reporters lost one report, not one for each of them.
        silent_devices.sort_unstable();
        silent_devices.dedup();
        for device in silent_devices {
            self.observe_missing_report(device, k, plan, self.radio.no_report_probability());
        }
    }

    /// Records the `level` that `device` reported in TTI `k`.
    pub fn observe_level(&mut self, device: DeviceId, k: Tti, level: Energy) {
        let estimate = &mut self.estimates[device.index()];
        (
            estimate.next_tti,
            estimate.doubt,
            estimate.expected_reports,
            estimate.silence_likelihood,
        ) = (k + 1, HarvestDoubt::default(), 0.0, 1.0);
        // One report shows that the source of the class delivers, so it clears the doubt of the class as well.
        let class = &mut self.classes[usize::from(estimate.class)];
        (class.expected_reports, class.doubt) = (0.0, HarvestDoubt::default());
        self.levels[device.index()] = level.min(estimate.energy.e_max);
    }

    /// Records that `device` was woken in TTI `k` and did not report. Its battery counts as empty, unless the radio may
    /// have lost the wake-up signal or the report.
    pub fn observe_unanswered_wake_up(&mut self, device: DeviceId, k: Tti, plan: &Plan) {
        self.observe_missing_report(device, k, plan, self.radio.no_answer_probability());
    }

    /// Records that `device` sent no report in TTI `k` although it should have. The radio alone causes this with
    /// probability `loss_probability`.
    fn observe_missing_report(&mut self, device: DeviceId, k: Tti, plan: &Plan, loss_probability: f64) {
        // Losses are taken as independent, so the probability that only the radio caused the silence is a product.
        let likelihood = &mut self.estimates[device.index()].silence_likelihood;
        *likelihood *= loss_probability;
        if *likelihood > MIN_SILENCE_LIKELIHOOD {
            return;
        }
        let (level_at_end, _) = self.estimate_at(device, plan, k + 1);
        self.estimates[device.index()].mark_empty(level_at_end, k);
        self.levels[device.index()] = Energy::ZERO;
    }
}

/// Returns points on the unit circle around the origin.
fn unit_circle_points() -> Vec<Point> {
    let point_at = |index: u32| {
        let phi = TAU * f64::from(index) / f64::from(POINTS_PER_CIRCLE);
        // `libm`, since results must not depend on the machine's own trigonometric functions.
        Point::new(libm::cos(phi), libm::sin(phi))
    };
    (0..POINTS_PER_CIRCLE).map(point_at).collect()
}

/// Returns the probability that a device at `position` in S1 detects an event at a uniformly random point of the area.
/// `directions` holds the directions of the points on each circle.
fn detection_probability(known: &Knowledge, position: Point, directions: &[Point]) -> f64 {
    let Sensing { d_max, kind, .. } = known.sensing;
    let mut detected_area = 0.0;
    for circle in 0..CIRCLES {
        // The midpoint rule over rings, each weighted by the part of its circle that lies in the area.
        let d = d_max * (f64::from(circle) + 0.5) / f64::from(CIRCLES);
        let probability_at_d = match kind {
            DetectionKind::Range => 1.0,
            DetectionKind::Probabilistic => known.sensing.p(d),
        };
        let is_inside = |direction: &&Point| {
            let point = Point::new(position.x + d * direction.x, position.y + d * direction.y);
            known.area.contains(point)
        };
        let inside_share = directions.iter().filter(is_inside).count() as f64 / f64::from(POINTS_PER_CIRCLE);
        // The area of the ring around this circle.
        detected_area += probability_at_d * inside_share * TAU * d * d_max / f64::from(CIRCLES);
    }
    detected_area / known.area.surface()
}

#[cfg(test)]
mod tests;
