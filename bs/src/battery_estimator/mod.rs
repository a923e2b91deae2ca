//! Battery levels as the base station knows or estimates them.
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
use reveille_common::scenario::{BatteryKnowledge, EnergyModel};
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use reveille_common::radio::Link;

use crate::knowledge::{DeviceKnowledge, Knowledge};

/// Expected number of reports during a silence beyond which a device, or a class, counts as empty. One working device
/// in three thousand is silent for this long, exp(−8); slightly more where events last, since no event starts during
/// another.
const SILENCE: f64 = 8.0;
/// Probability that the radio alone explains all missing answers of a device; at or below it the device counts as
/// empty.
const UNLUCKY: f64 = 0.02;
/// Circles within d_max, and points on each circle, for the integral over the sensing range of a device.
const CIRCLES: u32 = 16;
const PLACES: u32 = 32;
/// Margin that absorbs rounding when a device is sure to be in range of an event, metres per metre of d_max.
const ROUNDING: f64 = 1e-9;

/// Battery level of every device, given as ground truth or estimated.
#[derive(Clone, Debug)]
pub struct BatteryEstimator {
    /// Whether the policy receives the true levels before each decision.
    is_told: bool,
    of: Vec<Energy>,
    devices: Vec<BatteryEstimate>,
    classes: Vec<Class>,
    surroundings: SensingGeometry,
    radio: Link,
}

/// State of a class of devices, which share a kind of energy source.
#[derive(Clone, Debug)]
struct Class {
    /// Expected harvest by time of day, if it varies.
    course: Option<Arc<DayProfile>>,
    /// Expected number of reports of the class since its last report.
    silence: f64,
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
    /// Records that the source failed to charge the device or class by TTI `k`.
    fn grow(&mut self, k: Tti) {
        self.outage = k - *self.since.get_or_insert(k);
    }
}

/// Positions of the devices and their sensing model.
#[derive(Clone, Debug)]
struct SensingGeometry {
    positions: Vec<Point>,
    buckets: Buckets,
    sensing: Sensing,
}

/// State of one device, except its level.
#[derive(Clone, Debug)]
struct BatteryEstimate {
    class: u16,
    energy: EnergyModel,
    /// Mean harvest per TTI.
    harvest: Energy,
    /// Largest fall of the level in a TTI without a report, micro-units. `None` if E_max leaves too little room for
    /// E_Tx.
    fall: Option<u64>,
    /// First TTI that the level does not include.
    next: Tti,
    doubt: HarvestDoubt,
    /// Expected reports per TTI in S1; 0 if they are not counted.
    rate: f64,
    /// Expected number of reports since the last one.
    silence: f64,
    /// Probability that the radio alone explains all missing answers since the last report.
    silence_likelihood: f64,
}

impl Class {
    /// Returns the expected harvest from `from` to before `end` of a device with the mean harvest `mean`.
    fn income(&self, mean: Energy, from: Tti, end: Tti) -> u64 {
        match &self.course {
            Some(course) => course.between(from, end).micro(),
            None => mean.micro() * (end - from),
        }
    }

    /// Returns the end of the day or night that contains `from`, at most `end`.
    fn end_of_span(&self, from: Tti, end: Tti) -> Tti {
        self.course
            .as_ref()
            .map_or(end, |course| course.turn_after(from).min(end))
    }
}

impl BatteryEstimate {
    fn new(device: &DeviceKnowledge, is_steady: bool) -> Self {
        let energy = &device.energy;
        let dearest = energy.e_idle.max(energy.e_wur);
        // Without this room the cap at E_max can take more than `fall` from the level, so nothing is sure.
        let has_room = energy.e_max.saturating_sub(dearest) >= energy.e_tx;
        // A source that follows the time of day may bring no energy at night, whatever its mean is.
        let least = if is_steady { device.mean_harvest } else { Energy::ZERO };
        let fall = has_room.then(|| dearest.saturating_sub(least).micro());
        Self {
            class: device.class,
            energy: device.energy,
            harvest: device.mean_harvest,
            fall,
            next: Tti::ZERO,
            doubt: HarvestDoubt::default(),
            rate: 0.0,
            silence: 0.0,
            silence_likelihood: 1.0,
        }
    }

    /// Returns whether `level` is sure to be E_Tx or more after the TTIs before `end`, whatever was commanded. This is
    /// usually the case, and it saves the exact computation.
    #[inline]
    fn is_usable(&self, level: Energy, end: Tti) -> bool {
        // An overflow proves nothing, so the caller then computes the level exactly.
        let fall = self
            .fall
            .and_then(|fall| fall.checked_mul(end.0.saturating_sub(self.next.0)));
        fall.is_some_and(|fall| level.micro().saturating_sub(fall) >= self.energy.e_tx.micro())
    }

    /// Returns `level` after the TTIs before `end`, with `device` of `class` under `plan`, and the number of TTIs in
    /// S1.
    fn estimate_at(&self, class: &Class, level: Energy, device: DeviceId, plan: &Plan, end: Tti) -> (Energy, u64) {
        let cycle = plan.duty_cycle(device);
        let (mut level, mut all_on, mut from) = (level, 0, self.next);
        // Each span is cut off at E_max separately: surplus harvest of the day beyond a full battery is lost before
        // the night.
        while from < end {
            let until = class.end_of_span(from, end);
            let (carried, on) = self.over_a_span(class, level, cycle, from, until);
            (level, all_on, from) = (carried, all_on + on, until);
        }
        (level, all_on)
    }

    /// Returns `level` after the TTIs from `from` to before `end` under `cycle`, and the number of TTIs in S1. The TTIs
    /// are all day or all night.
    fn over_a_span(&self, class: &Class, level: Energy, cycle: DutyCycle, from: Tti, end: Tti) -> (Energy, u64) {
        let ttis = end - from;
        let EnergyModel {
            e_max,
            e_idle,
            e_wur,
            e_tx,
            ..
        } = self.energy;
        let (on, _, _) = match ttis {
            1 => (u64::from(cycle.is_on(from)), 0, 0),
            // A run has fewer than 2³⁰ TTIs, so the cast is exact.
            _ => cycle.span(cycle.phase(from), ttis as u32),
        };
        let income = class.income(self.harvest, from, end);
        let cost = e_idle.micro() * on + e_wur.micro() * (ttis - on);
        let level = if income > cost {
            // While the source is in doubt, charging up to one report takes as long as the outage. Without doubt the
            // outage is 0, and the division yields `None`.
            let outage = class.doubt.outage.max(self.doubt.outage);
            let slowly = ((e_tx + e_idle).micro() * ttis).checked_div(outage);
            let gain = slowly.map_or(income - cost, |slowly| slowly.min(income - cost));
            level.micro().saturating_add(gain)
        } else {
            level.micro().saturating_sub(cost - income)
        };
        // A TTI stores its harvest before δ is paid, so even a full battery ends the TTI below E_max by that cost.
        let last = if cycle.is_on(Tti(end.0 - 1)) { e_idle } else { e_wur };
        (Energy::from_micro(level).min(e_max.saturating_sub(last)), on)
    }

    /// Records that the device is empty at the end of TTI `k`, although its estimate was `level`.
    fn found_empty(&mut self, level: Energy, k: Tti) {
        // If the estimate already lay below E_Tx, the silence needs no failed source to explain it.
        if level > Energy::ZERO && level >= self.energy.e_tx {
            self.doubt.grow(k);
        }
        (self.next, self.silence, self.silence_likelihood) = (k + 1, 0.0, 1.0);
    }
}

impl BatteryEstimator {
    /// Creates the estimator with the known levels at the start of a run. It serves policies that read all levels
    /// before each decision. `bs.battery_knowledge` selects true or estimated levels.
    pub fn new(known: &Knowledge) -> Self {
        let is_told = known.bs.battery_knowledge == BatteryKnowledge::Oracle;
        let mut levels = Self {
            is_told,
            ..Self::estimated(known)
        };
        if !is_told {
            let around = around();
            for (account, device) in levels.devices.iter_mut().zip(&known.devices) {
                // A report that the radio loses is also silence, so it must not count as expected.
                let heard = 1.0 - known.radio.no_report_probability();
                account.rate = known.alpha * heard * share_in_reach(known, device.position, &around);
            }
        }
        levels
    }

    /// Creates an estimator that always estimates, for a policy that does not read all levels.
    pub(crate) fn estimated(known: &Knowledge) -> Self {
        let positions = known.positions();
        let account = |device: &DeviceKnowledge| {
            let is_steady = known.courses[usize::from(device.class)].is_none();
            BatteryEstimate::new(device, is_steady)
        };
        Self {
            is_told: false,
            of: known.devices.iter().map(|device| device.energy.initial).collect(),
            classes: known
                .courses
                .iter()
                .map(|course| Class {
                    course: course.clone(),
                    silence: 0.0,
                    doubt: HarvestDoubt::default(),
                })
                .collect(),
            devices: known.devices.iter().map(account).collect(),
            radio: known.radio,
            surroundings: SensingGeometry {
                buckets: Buckets::new(&positions, known.area, known.sensing.d_max),
                positions,
                sensing: known.sensing.clone(),
            },
        }
    }

    /// Levels by device id: the true levels, or the estimates at the end of the last TTI passed to [`Self::advance`].
    pub fn all(&self) -> &[Energy] {
        &self.of
    }

    /// Whether the true levels must be given before each decision.
    pub fn needs_true_levels(&self) -> bool {
        self.is_told
    }

    /// Replaces all levels by the true ones.
    pub fn set_true_levels(&mut self, levels: impl IntoIterator<Item = Energy>) {
        self.of.clear();
        self.of.extend(levels);
        assert_eq!(self.of.len(), self.devices.len(), "a level for each device");
    }

    /// Returns whether `device` can pay for a report in TTI `k` under `plan`, according to its known or expected level.
    /// This is Pr(B ≥ E_Tx) of Sec. IV, rounded to 1 or 0. True levels are those before `k`.
    pub fn can_report(&self, device: DeviceId, k: Tti, plan: &Plan) -> bool {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.devices[device.index()].energy;
        if !self.is_told {
            let (account, level) = (&self.devices[device.index()], self.of[device.index()]);
            return account.is_usable(level, k + 1) || self.estimate_at(device, plan, k + 1).0 >= e_tx;
        }
        let is_on = plan.is_on(device, k);
        self.of[device.index()] >= e_tx + if is_on { e_idle } else { e_wur }
    }

    /// Returns the level of `device` after the TTIs before `end`, and the number of TTIs in S1.
    fn estimate_at(&self, device: DeviceId, plan: &Plan, end: Tti) -> (Energy, u64) {
        let account = &self.devices[device.index()];
        let class = &self.classes[usize::from(account.class)];
        account.estimate_at(class, self.of[device.index()], device, plan, end)
    }

    /// Advances all estimates through the TTIs before `end` under `plan`: adds the expected harvest and subtracts the
    /// cost of the commanded states. Call it before the plan changes, and in each TTI if [`Self::all`] is read. Reports
    /// of a TTI are applied afterwards, since they are sent after δ is paid.
    pub fn advance(&mut self, end: Tti, plan: &Plan) {
        if self.is_told {
            return;
        }
        for ((level, account), j) in self.of.iter_mut().zip(&mut self.devices).zip(0..) {
            let class = &mut self.classes[usize::from(account.class)];
            let (carried, on) = account.estimate_at(class, *level, DeviceId(j), plan, end);
            (*level, account.next) = (carried, end.max(account.next));
            // A device that does not sense, or has too little energy for a report, has a known reason for its silence.
            if on > 0 && account.rate > 0.0 && carried >= account.energy.e_tx {
                let expected = on as f64 * account.rate;
                account.silence += expected;
                class.silence += expected;
                if account.silence > SILENCE {
                    account.found_empty(carried, Tti(end.0 - 1));
                    *level = Energy::ZERO;
                }
            }
        }
        // After all devices, since the silence of a class is the sum over its devices.
        for class in 0..self.classes.len() {
            if self.classes[class].silence > SILENCE {
                self.is_dark(class, Tti(end.0 - 1));
            }
        }
    }

    /// Marks a class without any report up to TTI `k` as failing: its devices that were due to report count as empty.
    fn is_dark(&mut self, class: usize, k: Tti) {
        self.classes[class].silence = 0.0;
        self.classes[class].doubt.grow(k);
        for (level, account) in self.of.iter_mut().zip(&mut self.devices) {
            if usize::from(account.class) == class && account.silence > 0.0 {
                (*level, account.silence) = (Energy::ZERO, 0.0);
            }
        }
    }

    /// Applies the `reports` of TTI `k` under `plan`, sorted by device id. With certain detection within d_max it also
    /// applies the silence of devices that must have detected the same event.
    pub fn observe_reports(&mut self, k: Tti, plan: &Plan, reports: &[Report]) {
        for report in reports {
            self.observe_level(report.device, k, report.battery);
        }
        // With probabilistic detection a device in range may miss the event, so its silence shows nothing about its
        // battery.
        if self.is_told || self.surroundings.sensing.kind != DetectionKind::Range {
            return;
        }
        let mut empty = Vec::new();
        let SensingGeometry {
            positions,
            buckets,
            sensing,
        } = &self.surroundings;
        for report in reports {
            let Some(d) = sensing.distance(report.information) else {
                continue;
            };
            // Triangle inequality: a device this near to the reporter is within d_max of the epicentre, wherever on
            // the ring that is.
            let reach = sensing.d_max * (1.0 - ROUNDING) - d;
            if reach < 0.0 {
                continue;
            }
            buckets.within(positions[report.device.index()], reach, |j, _| {
                let device = DeviceId(j as u32);
                let has_reported = || reports.binary_search_by_key(&device, |report| report.device).is_ok();
                if plan.is_on(device, k) && !has_reported() {
                    empty.push(device);
                }
            });
        }
        for device in empty {
            self.observe_no_report(device, k, plan, self.radio.no_report_probability());
        }
    }

    /// Records the `level` that `device` reported in TTI `k`.
    pub fn observe_level(&mut self, device: DeviceId, k: Tti, level: Energy) {
        let account = &mut self.devices[device.index()];
        (account.next, account.doubt, account.silence, account.silence_likelihood) =
            (k + 1, HarvestDoubt::default(), 0.0, 1.0);
        // One report shows that the source of the class delivers, so it clears the doubt of the class as well.
        let class = &mut self.classes[usize::from(account.class)];
        (class.silence, class.doubt) = (0.0, HarvestDoubt::default());
        self.of[device.index()] = level.min(account.energy.e_max);
    }

    /// Records that `device` was woken in TTI `k` and did not report. Its battery counts as empty, unless the radio may
    /// have lost the wake-up signal or the report.
    pub fn observe_no_answer(&mut self, device: DeviceId, k: Tti, plan: &Plan) {
        self.observe_no_report(device, k, plan, self.radio.no_answer_probability());
    }

    /// Records that `device` sent no report in TTI `k` although it should have. The radio alone causes this with
    /// probability `lost`.
    fn observe_no_report(&mut self, device: DeviceId, k: Tti, plan: &Plan, lost: f64) {
        // Losses are taken as independent, so the probability that only the radio caused the silence is a product.
        let luck = &mut self.devices[device.index()].silence_likelihood;
        *luck *= lost;
        if *luck > UNLUCKY {
            return;
        }
        let (carried, _) = self.estimate_at(device, plan, k + 1);
        self.devices[device.index()].found_empty(carried, k);
        self.of[device.index()] = Energy::ZERO;
    }
}

/// Returns points on the unit circle around the origin.
fn around() -> Vec<Point> {
    let place = |place: u32| {
        let phi = TAU * f64::from(place) / f64::from(PLACES);
        // `libm`, since results must not depend on the machine's own trigonometric functions.
        Point::new(libm::cos(phi), libm::sin(phi))
    };
    (0..PLACES).map(place).collect()
}

/// Returns the probability that a device at `position` in S1 detects an event at a uniformly random point of the area.
/// `around` holds the directions of the points on each circle.
fn share_in_reach(known: &Knowledge, position: Point, around: &[Point]) -> f64 {
    let Sensing { d_max, kind, .. } = known.sensing;
    let mut sum = 0.0;
    for circle in 0..CIRCLES {
        // The midpoint rule over rings, each weighted by the part of its circle that lies in the area.
        let d = d_max * (f64::from(circle) + 0.5) / f64::from(CIRCLES);
        let detected = match kind {
            DetectionKind::Range => 1.0,
            DetectionKind::Probabilistic => known.sensing.p(d),
        };
        let is_inside = |direction: &&Point| {
            let at = Point::new(position.x + d * direction.x, position.y + d * direction.y);
            known.area.contains(at)
        };
        let inside = around.iter().filter(is_inside).count() as f64 / f64::from(PLACES);
        // The area of the ring around this circle.
        sum += detected * inside * TAU * d * d_max / f64::from(CIRCLES);
    }
    sum / known.area.surface()
}

#[cfg(test)]
mod tests;
