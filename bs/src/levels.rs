//! What the base station knows of batteries.
//!
//! A level is known where it is told, where a report carries it, and where a device is silent that must have answered:
//! its battery is empty then, since an action that fails empties it. From there on the level is carried forward by what
//! was commanded and by the mean harvest, which may differ with the time of the day.
//!
//! The mean harvest may not be what comes any more: a record ends, a panel is shaded, a device is lost. A BS cannot see
//! that; it can see that a device which it takes to be charged is found empty, and that nobody of a class is heard of
//! for far too long: those that were asked are empty then. The first time may be chance, and they are given time to
//! charge again. From the second time on without a report between, they are taken to need as long to charge as has
//! passed since the first. So devices that have nothing to charge from are asked ever less often, and those that charge
//! again are asked again after at most about the time in which they did not. A report takes all of that back.

use std::f64::consts::TAU;
use std::sync::Arc;

use reveille_common::geometry::{Buckets, Point};
use reveille_common::harvest::Course;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::{BatteryKnowledge, EnergyModel};
use reveille_common::sensing::{DetectionKind, Sensing};
use reveille_common::units::Energy;

use reveille_common::radio::Link;

use crate::knowledge::{DeviceKnowledge, Knowledge};

/// Reports that were to be expected of a device, or of a class, while it was silent, from which on it is taken to be
/// empty: of those that are well, one in three thousand is silent for so long, exp(−8). It is a few more where events
/// last, since none starts during another.
const SILENCE: f64 = 8.0;
/// How unlikely it has to be that the radio alone kept a device silent, each time that it was asked, until it is taken
/// to be empty.
const UNLUCKY: f64 = 0.02;
/// Circles within d_max, and places on each, over which the reach of a device is summed.
const CIRCLES: u32 = 16;
const PLACES: u32 = 32;
/// By how much a reach has to hold an event for that to be sure in spite of rounding, metres per metre of d_max.
const ROUNDING: f64 = 1e-9;

/// The battery level of every device: told, or estimated.
#[derive(Clone, Debug)]
pub struct Levels {
    /// Whether the true levels are told before each decision.
    is_told: bool,
    of: Vec<Energy>,
    devices: Vec<Account>,
    classes: Vec<Class>,
    surroundings: Surroundings,
    radio: Link,
}

/// What is known of a class of devices, which have their kind of energy source in common.
#[derive(Clone, Debug)]
struct Class {
    /// What it is expected to harvest at which time of the day, where that differs.
    course: Option<Arc<Course>>,
    /// Reports that were to be expected of it since one of it was last heard of.
    silence: f64,
    doubt: Doubt,
}

/// Whether there is anything to charge from.
#[derive(Clone, Copy, Debug, Default)]
struct Doubt {
    /// When it was first found that nothing is left, without a report since.
    since: Option<Tti>,
    /// How much later that was found last, TTIs.
    outage: u64,
}

impl Doubt {
    /// It was found in TTI `k`.
    fn grow(&mut self, k: Tti) {
        self.outage = k - *self.since.get_or_insert(k);
    }
}

/// Who stands where, and what each senses.
#[derive(Clone, Debug)]
struct Surroundings {
    positions: Vec<Point>,
    buckets: Buckets,
    sensing: Sensing,
}

/// What is known of one device beside its level.
#[derive(Clone, Debug)]
struct Account {
    class: u16,
    energy: EnergyModel,
    /// Its mean harvest in a TTI.
    harvest: Energy,
    /// The most by which its level falls in a TTI without a report, micro-units; nothing where E_max may keep it from
    /// holding E_Tx.
    fall: Option<u64>,
    /// The first TTI that is not in its level.
    next: Tti,
    doubt: Doubt,
    /// Reports that are to be expected of it in a TTI in S1; 0 where nobody counts them.
    rate: f64,
    /// The sum of them since it was last heard of.
    silence: f64,
    /// The probability that the radio alone has kept it silent, as often as it must have answered since.
    luck: f64,
}

impl Class {
    /// What a device of the class with the mean harvest `mean` is expected to harvest from `from` to before `end`.
    fn income(&self, mean: Energy, from: Tti, end: Tti) -> u64 {
        match &self.course {
            Some(course) => course.between(from, end).micro(),
            None => mean.micro() * (end - from),
        }
    }

    /// The end of the span from `from` on within which its harvest is of a kind, day or night, `end` at the latest.
    fn end_of_span(&self, from: Tti, end: Tti) -> Tti {
        self.course
            .as_ref()
            .map_or(end, |course| course.turn_after(from).min(end))
    }
}

impl Account {
    fn new(device: &DeviceKnowledge, is_steady: bool) -> Self {
        let energy = &device.energy;
        let dearest = energy.e_idle.max(energy.e_wur);
        let has_room = energy.e_max.saturating_sub(dearest) >= energy.e_tx;
        // At night nothing comes.
        let least = if is_steady { device.mean_harvest } else { Energy::ZERO };
        let fall = has_room.then(|| dearest.saturating_sub(least).micro());
        Self {
            class: device.class,
            energy: device.energy,
            harvest: device.mean_harvest,
            fall,
            next: Tti::ZERO,
            doubt: Doubt::default(),
            rate: 0.0,
            silence: 0.0,
            luck: 1.0,
        }
    }

    /// Whether `level` is sure to be E_Tx or more after the TTIs up to and not including `end`, whatever was commanded.
    /// Mostly it is, and then nothing has to be carried.
    #[inline]
    fn is_well(&self, level: Energy, end: Tti) -> bool {
        let fall = self
            .fall
            .and_then(|fall| fall.checked_mul(end.0.saturating_sub(self.next.0)));
        fall.is_some_and(|fall| level.micro().saturating_sub(fall) >= self.energy.e_tx.micro())
    }

    /// `level` after the TTIs up to and not including `end`, in which `device` of `class` did as `plan` says, and how
    /// many of them it was in S1.
    fn carried(&self, class: &Class, level: Energy, device: DeviceId, plan: &Plan, end: Tti) -> (Energy, u64) {
        let cycle = plan.duty_cycle(device);
        let (mut level, mut all_on, mut from) = (level, 0, self.next);
        // What comes by day is stored as far as there is room, and the night lives on that.
        while from < end {
            let until = class.end_of_span(from, end);
            let (carried, on) = self.over_a_span(class, level, cycle, from, until);
            (level, all_on, from) = (carried, all_on + on, until);
        }
        (level, all_on)
    }

    /// `level` after the TTIs from `from` to before `end`, all of them day or all of them night, under `cycle`, and how
    /// many of them it was in S1.
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
            // A run has fewer than 2³⁰ TTIs.
            _ => cycle.span(cycle.phase(from), ttis as u32),
        };
        let income = class.income(self.harvest, from, end);
        let cost = e_idle.micro() * on + e_wur.micro() * (ttis - on);
        let level = if income > cost {
            let outage = class.doubt.outage.max(self.doubt.outage);
            let slowly = ((e_tx + e_idle).micro() * ttis).checked_div(outage);
            let gain = slowly.map_or(income - cost, |slowly| slowly.min(income - cost));
            level.micro().saturating_add(gain)
        } else {
            level.micro().saturating_sub(cost - income)
        };
        // What comes is stored first, and then the last TTI is paid for.
        let last = if cycle.is_on(Tti(end.0 - 1)) { e_idle } else { e_wur };
        (Energy::from_micro(level).min(e_max.saturating_sub(last)), on)
    }

    /// It is known to be empty at the end of TTI `k`, where it was taken to hold `level`.
    fn found_empty(&mut self, level: Energy, k: Tti) {
        if level > Energy::ZERO && level >= self.energy.e_tx {
            self.doubt.grow(k);
        }
        (self.next, self.silence, self.luck) = (k + 1, 0.0, 1.0);
    }
}

impl Levels {
    /// The levels at the start of a run, which are known, for a policy that looks at all of them before each decision:
    /// told or estimated as `bs.battery_knowledge` says.
    pub fn new(known: &Knowledge) -> Self {
        let is_told = known.bs.battery_knowledge == BatteryKnowledge::Oracle;
        let mut levels = Self {
            is_told,
            ..Self::reckoned(known)
        };
        if !is_told {
            let around = around();
            for (account, device) in levels.devices.iter_mut().zip(&known.devices) {
                let heard = 1.0 - known.radio.silence();
                account.rate = known.alpha * heard * share_in_reach(known, device.position, &around);
            }
        }
        levels
    }

    /// The same, estimated, for a policy that does not look at them.
    pub fn reckoned(known: &Knowledge) -> Self {
        let positions = known.positions();
        let account = |device: &DeviceKnowledge| {
            let is_steady = known.courses[usize::from(device.class)].is_none();
            Account::new(device, is_steady)
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
                    doubt: Doubt::default(),
                })
                .collect(),
            devices: known.devices.iter().map(account).collect(),
            radio: known.radio,
            surroundings: Surroundings {
                buckets: Buckets::new(&positions, known.area, known.sensing.d_max),
                positions,
                sensing: known.sensing.clone(),
            },
        }
    }

    /// The levels, in the order of ids, as they were told or at the end of the last TTI that has passed.
    pub fn all(&self) -> &[Energy] {
        &self.of
    }

    /// Whether the true levels have to be told before each decision.
    pub fn are_told(&self) -> bool {
        self.is_told
    }

    /// Takes in the true levels.
    pub fn tell(&mut self, levels: impl IntoIterator<Item = Energy>) {
        self.of.clear();
        self.of.extend(levels);
        assert_eq!(self.of.len(), self.devices.len(), "a level for each device");
    }

    /// Whether `device`, which does what `plan` says in TTI `k`, can pay for a report in it, as far as is known: the
    /// Pr(B ≥ E_Tx) of Sec. IV, 1 or 0 by the level that is to be expected. Levels that are told are those before `k`.
    pub fn can_report(&self, device: DeviceId, k: Tti, plan: &Plan) -> bool {
        let EnergyModel {
            e_idle, e_wur, e_tx, ..
        } = self.devices[device.index()].energy;
        if !self.is_told {
            let (account, level) = (&self.devices[device.index()], self.of[device.index()]);
            return account.is_well(level, k + 1) || self.carried(device, plan, k + 1).0 >= e_tx;
        }
        let is_on = plan.is_on(device, k);
        self.of[device.index()] >= e_tx + if is_on { e_idle } else { e_wur }
    }

    /// The level of `device` after the TTIs up to and not including `end`, and how many of them it was in S1.
    fn carried(&self, device: DeviceId, plan: &Plan, end: Tti) -> (Energy, u64) {
        let account = &self.devices[device.index()];
        let class = &self.classes[usize::from(account.class)];
        account.carried(class, self.of[device.index()], device, plan, end)
    }

    /// The TTIs before `end` have passed under `plan`: where levels are estimated, everyone has harvested as much as is
    /// to be expected and paid for what it was told to do. To be called before another plan is in force, and for each
    /// TTI if [`Self::all`] is looked at. Reports of a TTI come after this, as they come after δ has been paid for.
    pub fn pass(&mut self, end: Tti, plan: &Plan) {
        if self.is_told {
            return;
        }
        for ((level, account), j) in self.of.iter_mut().zip(&mut self.devices).zip(0..) {
            let class = &mut self.classes[usize::from(account.class)];
            let (carried, on) = account.carried(class, *level, DeviceId(j), plan, end);
            (*level, account.next) = (carried, end.max(account.next));
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
        for class in 0..self.classes.len() {
            if self.classes[class].silence > SILENCE {
                self.is_dark(class, Tti(end.0 - 1));
            }
        }
    }

    /// Nobody of `class` is heard of up to TTI `k`: those that were asked are empty.
    fn is_dark(&mut self, class: usize, k: Tti) {
        self.classes[class].silence = 0.0;
        self.classes[class].doubt.grow(k);
        for (level, account) in self.of.iter_mut().zip(&mut self.devices) {
            if usize::from(account.class) == class && account.silence > 0.0 {
                (*level, account.silence) = (Energy::ZERO, 0.0);
            }
        }
    }

    /// What TTI `k` under `plan` has brought: `reports`, in the order of ids, and the silence of those that must have
    /// detected the event too, if detection is sure within d_max.
    pub fn gathered(&mut self, k: Tti, plan: &Plan, reports: &[Report]) {
        for report in reports {
            self.heard(report.device, k, report.battery);
        }
        if self.is_told || self.surroundings.sensing.kind != DetectionKind::Range {
            return;
        }
        let mut empty = Vec::new();
        let Surroundings {
            positions,
            buckets,
            sensing,
        } = &self.surroundings;
        for report in reports {
            let Some(d) = sensing.distance(report.information) else {
                continue;
            };
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
            self.unheard(device, k, plan, self.radio.silence());
        }
    }

    /// `device` has reported `level` in TTI `k`.
    pub fn heard(&mut self, device: DeviceId, k: Tti, level: Energy) {
        let account = &mut self.devices[device.index()];
        (account.next, account.doubt, account.silence, account.luck) = (k + 1, Doubt::default(), 0.0, 1.0);
        let class = &mut self.classes[usize::from(account.class)];
        (class.silence, class.doubt) = (0.0, Doubt::default());
        self.of[device.index()] = level.min(account.energy.e_max);
    }

    /// `device` has not reported in TTI `k`, in which it was woken: its battery is empty now, if it is not that the
    /// radio has lost the wake-up or the report.
    pub fn silent(&mut self, device: DeviceId, k: Tti, plan: &Plan) {
        self.unheard(device, k, plan, self.radio.no_answer());
    }

    /// `device` has not reported in TTI `k`, in which it must have, if it could and the radio, which keeps it silent
    /// with probability `lost`, let it.
    fn unheard(&mut self, device: DeviceId, k: Tti, plan: &Plan, lost: f64) {
        let luck = &mut self.devices[device.index()].luck;
        *luck *= lost;
        if *luck > UNLUCKY {
            return;
        }
        let (carried, _) = self.carried(device, plan, k + 1);
        self.devices[device.index()].found_empty(carried, k);
        self.of[device.index()] = Energy::ZERO;
    }
}

/// The places on a circle of radius 1 around the origin.
fn around() -> Vec<Point> {
    let place = |place: u32| {
        let phi = TAU * f64::from(place) / f64::from(PLACES);
        Point::new(libm::cos(phi), libm::sin(phi))
    };
    (0..PLACES).map(place).collect()
}

/// The probability that an event at a place that is drawn at random from the area is detected by a device at
/// `position` in S1. The places on each circle are in the directions `around`.
fn share_in_reach(known: &Knowledge, position: Point, around: &[Point]) -> f64 {
    let Sensing { d_max, kind, .. } = known.sensing;
    let mut sum = 0.0;
    for circle in 0..CIRCLES {
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
        // The area between this circle and the next.
        sum += detected * inside * TAU * d * d_max / f64::from(CIRCLES);
    }
    sum / known.area.surface()
}

#[cfg(test)]
mod tests;
