//! What the model is told of each device in a TTI: the state 𝒯(k) of the paper, Sec. V-C, as a BS can know it.
//!
//! A device's token holds its battery, how much of the area it looks at and for how long nobody has looked there, and
//! how many events were found near it and anywhere, lately and for long, against how many were to be expected. Nothing
//! in it grows with N or with the size of the area, so that what was learned on one deployment serves another.

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::ages::{self, Ages};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The names of a token's features, in their order.
pub const FEATURES: [&str; 20] = [
    "battery",
    "can_sense",
    "age",
    "idle",
    "reach",
    "density",
    "alpha",
    "harvest",
    "near_short",
    "near_middle",
    "near_long",
    "all_short",
    "all_middle",
    "all_long",
    "found",
    "found_near",
    "since_found",
    "nearness",
    "neighbours",
    "delay",
];

/// Where among them it stands whether a device's battery lets it sense, 0 or 1.
pub const CAN_SENSE: usize = 1;

/// Features of a token.
pub const COUNT: usize = FEATURES.len();

/// Time constants over which events are counted, TTIs.
const SCALES: [f32; 3] = [8.0, 64.0, 512.0];

/// Events found, and events to be expected, over each of [`SCALES`].
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    found: [f32; SCALES.len()],
    expected: [f32; SCALES.len()],
}

impl Counts {
    /// A TTI passes, in which so many events were found where `expected` were to be.
    fn pass(&mut self, found: f32, expected: f32) {
        for (scale, tau) in SCALES.into_iter().enumerate() {
            let kept = 1.0 - 1.0 / tau;
            self.found[scale] = kept * self.found[scale] + found;
            self.expected[scale] = kept * self.expected[scale] + expected;
        }
    }

    /// The logarithm of how many times as many were found as were expected, one event of prior knowledge apart.
    fn surprise(&self, scale: usize) -> f32 {
        libm::logf((self.found[scale] + 1.0) / (self.expected[scale] + 1.0))
    }
}

/// What never changes about a device.
#[derive(Clone, Copy, Debug)]
struct Fixed {
    /// What it would look at if every place was of age 1, in the unit of [`Ages::worth`].
    own: f64,
    /// Events that start within its reach, per TTI.
    expected: f32,
    reach: f32,
    harvest: f32,
    neighbours: f32,
    /// The level from which on it may sense.
    needed: Energy,
    e_max: f32,
}

/// An event that was found.
#[derive(Clone, Copy, Debug)]
struct Found {
    at: Point,
    tti: Tti,
}

/// What a BS has noticed so far, device by device.
#[derive(Clone, Debug)]
pub struct Senses {
    ages: Ages,
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    fixed: Vec<Fixed>,
    near: Vec<Counts>,
    all: Counts,
    /// The probability that an event starts in a TTI.
    events: f32,
    density: f32,
    alpha: f32,
    /// The TTI in which each device looked last, counted from 1; 0 for never.
    looked: Vec<u64>,
    /// The reporters of this TTI: where, and how much each says about the place.
    reporters: Vec<(Point, f64)>,
    last: Option<Found>,
    /// TTIs between the last two events that were found.
    delay: f32,
    /// Whether the event that was found in the last TTI, if one was, is near each device.
    is_near: Vec<bool>,
    worths: Vec<f64>,
    tokens: Vec<f32>,
}

impl Senses {
    /// Before the first TTI, of the devices in `known`, which may sense from a level of `needed` on.
    pub fn new(known: &Knowledge, needed: impl Fn(usize) -> Energy) -> Self {
        let (positions, d_max, n) = (known.positions(), known.sensing.d_max, known.n());
        let ages = Ages::losing(
            known.radio.silence(),
            &positions,
            known.area,
            &known.sensing,
            ages::worths(),
        );
        let buckets = Buckets::new(&positions, known.area, d_max);
        let events = known.alpha * ages.cell_surface() / known.area.surface();
        let whole = ages::reach(&known.sensing) / ages.cell_surface();
        let fixed = |j: usize| {
            let device = &known.devices[j];
            let (own, mut neighbours) = (ages.worth(j), 0_u32);
            buckets.within(positions[j], d_max, |i, _| neighbours += u32::from(i != j));
            let units = |energy: Energy| energy.units();
            Fixed {
                own,
                expected: (events * own) as f32,
                reach: (own / whole) as f32,
                harvest: (units(device.mean_harvest) / units(device.energy.e_idle).max(1e-6)).min(4.0) as f32,
                neighbours: libm::logf(1.0 + neighbours as f32) / 5.0,
                needed: needed(j),
                e_max: units(device.energy.e_max) as f32,
            }
        };
        Self {
            fixed: (0..n).map(fixed).collect(),
            near: vec![Counts::default(); n],
            all: Counts::default(),
            events: known.alpha as f32,
            density: density(known.area, &known.sensing, n),
            alpha: libm::logf(known.alpha as f32) / 5.0,
            looked: vec![0; n],
            reporters: Vec::new(),
            last: None,
            delay: 0.0,
            is_near: vec![false; n],
            worths: vec![0.0; n],
            tokens: vec![0.0; n * COUNT],
            ages,
            positions,
            buckets,
            d_max,
        }
    }

    /// Begins the TTI of `seen`: what the last has brought is taken in, and [`Self::tokens`] are those of this one.
    pub fn begin(&mut self, seen: &Observation<'_>) {
        if seen.now > Tti::ZERO {
            self.pass(Tti(seen.now.0 - 1));
        }
        let last = self.last;
        let is_found = last.is_some_and(|found| found.tti.0 + 1 == seen.now.0);
        let since = last.map_or(u64::MAX, |found| seen.now.0 - found.tti.0);
        let shared = Shared {
            density: self.density,
            alpha: self.alpha,
            all: [0, 1, 2].map(|scale| self.all.surprise(scale)),
            found: f32::from(u8::from(is_found)),
            since: logarithm(since),
            delay: self.delay,
        };
        let (tokens, _) = self.tokens.as_chunks_mut::<COUNT>();
        for (j, token) in tokens.iter_mut().enumerate() {
            self.worths[j] = self.ages.worth(j);
            let (fixed, near) = (&self.fixed[j], &self.near[j]);
            let idle = match self.looked[j] {
                0 => seen.now.0 + 1,
                looked => seen.now.0 + 1 - looked,
            };
            let nearness = last.map_or(0.0, |found| {
                libm::expf(-(found.at.distance(self.positions[j]) / self.d_max) as f32)
            });
            let level = seen.batteries[j];
            *token = [
                level.units() as f32 / fixed.e_max,
                f32::from(u8::from(level >= fixed.needed)),
                libm::logf(mean_age(self.worths[j], fixed.own)),
                logarithm(idle),
                fixed.reach,
                shared.density,
                shared.alpha,
                fixed.harvest,
                near.surprise(0),
                near.surprise(1),
                near.surprise(2),
                shared.all[0],
                shared.all[1],
                shared.all[2],
                shared.found,
                f32::from(u8::from(self.is_near[j])),
                shared.since,
                nearness,
                fixed.neighbours,
                shared.delay,
            ];
        }
    }

    /// The TTI `tti` has passed: what was reported in it is counted.
    fn pass(&mut self, tti: Tti) {
        let place = centre(&self.reporters);
        self.reporters.clear();
        self.is_near.fill(false);
        if let Some(at) = place {
            let is_near = &mut self.is_near;
            self.buckets.within(at, self.d_max, |j, _| is_near[j] = true);
            self.delay = self.last.map_or(0.0, |last| logarithm(tti.0 - last.tti.0));
            self.last = Some(Found { at, tti });
        }
        for ((near, fixed), &is_near) in self.near.iter_mut().zip(&self.fixed).zip(&self.is_near) {
            near.pass(f32::from(u8::from(is_near)), fixed.expected);
        }
        self.all.pass(f32::from(u8::from(place.is_some())), self.events);
        self.ages.pass(place.is_some());
    }

    /// `report` has come.
    pub fn hear(&mut self, seen: &Observation<'_>, report: &Report) {
        let at = self.positions[report.device.index()];
        let distance = seen.known.sensing.distance(report.information).unwrap_or(self.d_max);
        self.reporters.push((at, 1.0 / (0.01 * self.d_max + distance).powi(2)));
    }

    /// The devices that `plan` has sense in `tti` look, beside those that were added to [`Self::ages_mut`].
    pub fn look(&mut self, tti: Tti, plan: &Plan, is_added: bool) {
        for j in 0..self.looked.len() {
            if plan.duty_cycle(DeviceId(j as u32)).is_on(tti) {
                self.looked[j] = tti.0 + 1;
                if !is_added {
                    self.ages.add(j);
                }
            }
        }
    }

    /// What each device senses, `[N, `[`COUNT`]`]` in the order of [`FEATURES`].
    pub fn tokens(&self) -> &[f32] {
        &self.tokens
    }

    /// Whether the battery of device `j` lets it sense.
    pub fn can_sense(&self, j: usize) -> bool {
        self.tokens[j * COUNT + CAN_SENSE] > 0.5
    }

    /// Events that each device would find if it looked and nothing but α was known of them: those that start within its
    /// reach, times the age of its places.
    pub fn expected(&self, j: usize) -> f32 {
        let fixed = &self.fixed[j];
        fixed.expected * mean_age(self.worths[j], fixed.own)
    }

    /// The ages of places.
    pub const fn ages(&self) -> &Ages {
        &self.ages
    }

    /// The ages of places, for those who choose.
    pub const fn ages_mut(&mut self) -> &mut Ages {
        &mut self.ages
    }
}

/// What is the same for all devices.
struct Shared {
    density: f32,
    alpha: f32,
    all: [f32; SCALES.len()],
    found: f32,
    since: f32,
    delay: f32,
}

/// Devices within reach of a place, on a logarithmic scale.
fn density(area: Area, sensing: &Sensing, n: usize) -> f32 {
    libm::logf((n as f64 * ages::reach(sensing) / area.surface()) as f32) / 5.0
}

/// Of places that together are worth `worth`, `own` if all were of age 1: the age a at which a(a + 1)/2 is the mean.
fn mean_age(worth: f64, own: f64) -> f32 {
    if own > 0.0 {
        (((8.0 * worth / own + 1.0).sqrt() - 1.0) / 2.0).max(1.0) as f32
    } else {
        1.0
    }
}

/// A number of TTIs on a logarithmic scale, 0 for 1 and 1 for about 400.
fn logarithm(ttis: u64) -> f32 {
    libm::logf(ttis.clamp(1, 4096) as f32) / 6.0
}

/// The middle of what was reported.
fn centre(reporters: &[(Point, f64)]) -> Option<Point> {
    let weight: f64 = reporters.iter().map(|(_, weight)| weight).sum();
    let sum = |of: fn(&Point) -> f64| reporters.iter().map(|(at, weight)| weight * of(at)).sum::<f64>();
    (!reporters.is_empty()).then(|| Point::new(sum(|at| at.x) / weight, sum(|at| at.y) / weight))
}
