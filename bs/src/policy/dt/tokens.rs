//! Input of the model per device and TTI: the state 𝒯(k) of the paper (Sec. V-C), as far as a base station knows it.
//!
//! The token of a device holds its battery, the size of the area that it covers and the time since it was last covered.
//! It also holds the ratio of found to expected events, near the device and anywhere, over short and long times. No
//! feature grows with N or the area, so a model trained on one deployment serves another.

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::ages::{self, Ages};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Names of the features of a token, in order.
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

/// Index of the feature that states whether the battery of a device lets it sense, 0 or 1.
pub const CAN_SENSE: usize = 1;

/// Number of features of a token.
pub const COUNT: usize = FEATURES.len();

/// Time constants over which events are counted, TTIs.
const SCALES: [f32; 3] = [8.0, 64.0, 512.0];

/// Found and expected events over each of [`SCALES`].
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    found: [f32; SCALES.len()],
    expected: [f32; SCALES.len()],
}

impl Counts {
    /// Advances by one TTI with this many `found` and `expected` events.
    fn advance(&mut self, found: f32, expected: f32) {
        for (scale, tau) in SCALES.into_iter().enumerate() {
            let kept = 1.0 - 1.0 / tau;
            self.found[scale] = kept * self.found[scale] + found;
            self.expected[scale] = kept * self.expected[scale] + expected;
        }
    }

    /// Returns the logarithm of the ratio of found to expected events, each increased by one prior event.
    fn surprise(&self, scale: usize) -> f32 {
        libm::logf((self.found[scale] + 1.0) / (self.expected[scale] + 1.0))
    }
}

/// Constant properties of a device.
#[derive(Clone, Copy, Debug)]
struct DeviceConstants {
    /// Gain if every place had age 1, in the unit of [`Ages::gain`].
    own: f64,
    /// Events that start within its reach, per TTI.
    expected: f32,
    reach: f32,
    harvest: f32,
    neighbours: f32,
    /// Least level with which it can sense.
    min_level: Energy,
    e_max: f32,
}

/// An event that was found.
#[derive(Clone, Copy, Debug)]
struct FoundEvent {
    at: Point,
    tti: Tti,
}

/// State of the base station from which tokens are built.
#[derive(Clone, Debug)]
pub(crate) struct TokenBuilder {
    ages: Ages,
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    fixed: Vec<DeviceConstants>,
    near: Vec<Counts>,
    all: Counts,
    /// The probability that an event starts in a TTI.
    events: f32,
    density: f32,
    alpha: f32,
    /// By device, the TTI in which it sensed last, counted from 1; 0 for never.
    looked: Vec<u64>,
    /// Position and weight of each reporter of this TTI; the weight falls with its distance to the event.
    reporters: Vec<(Point, f64)>,
    last: Option<FoundEvent>,
    /// Time between the last two found events, on the scale of [`logarithm`].
    delay: f32,
    /// By device, whether the event found in the last TTI, if any, is near it.
    is_near: Vec<bool>,
    worths: Vec<f64>,
    tokens: Vec<f32>,
}

impl TokenBuilder {
    /// Creates the state before the first TTI for the devices in `known`; device j can sense from level `needed(j)` on.
    pub(crate) fn new(known: &Knowledge, needed: impl Fn(usize) -> Energy) -> Self {
        let (positions, d_max, n) = (known.positions(), known.sensing.d_max, known.n());
        let ages = Ages::with_loss(
            known.radio.no_report_probability(),
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
            let (own, mut neighbours) = (ages.gain(j), 0_u32);
            buckets.within(positions[j], d_max, |i, _| neighbours += u32::from(i != j));
            let units = |energy: Energy| energy.units();
            DeviceConstants {
                own,
                expected: (events * own) as f32,
                reach: (own / whole) as f32,
                // E_idle may be 0.
                harvest: (units(device.mean_harvest) / units(device.energy.e_idle).max(1e-6)).min(4.0) as f32,
                neighbours: libm::logf(1.0 + neighbours as f32) / 5.0,
                min_level: needed(j),
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

    /// Begins the TTI of `seen`: processes the events of the last TTI and computes the [`Self::tokens`] of this one.
    pub(crate) fn begin(&mut self, seen: &Observation<'_>) {
        if seen.now > Tti::ZERO {
            self.advance(Tti(seen.now.0 - 1));
        }
        let last = self.last;
        let is_found = last.is_some_and(|found| found.tti.0 + 1 == seen.now.0);
        // Before the first event the time is as long as `logarithm` allows.
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
            self.worths[j] = self.ages.gain(j);
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
                f32::from(u8::from(level >= fixed.min_level)),
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

    /// Ends the TTI `tti` and counts its reports.
    fn advance(&mut self, tti: Tti) {
        let place = centre(&self.reporters);
        self.reporters.clear();
        self.is_near.fill(false);
        if let Some(at) = place {
            let is_near = &mut self.is_near;
            self.buckets.within(at, self.d_max, |j, _| is_near[j] = true);
            // The delay counts from the previous event, so it is taken before `last` changes.
            self.delay = self.last.map_or(0.0, |last| logarithm(tti.0 - last.tti.0));
            self.last = Some(FoundEvent { at, tti });
        }
        for ((near, fixed), &is_near) in self.near.iter_mut().zip(&self.fixed).zip(&self.is_near) {
            near.advance(f32::from(u8::from(is_near)), fixed.expected);
        }
        self.all.advance(f32::from(u8::from(place.is_some())), self.events);
        self.ages.advance(place.is_some());
    }

    /// Adds a received report.
    pub(crate) fn add_report(&mut self, seen: &Observation<'_>, report: &Report) {
        let at = self.positions[report.device.index()];
        // A report without information comes from beyond d_max.
        let distance = seen.known.sensing.distance(report.information).unwrap_or(self.d_max);
        // The offset keeps the weight of a report from distance 0 finite.
        self.reporters.push((at, 1.0 / (0.01 * self.d_max + distance).powi(2)));
    }

    /// Marks the devices that sense in `tti` under `plan`. With `is_added` they are already in [`Self::ages_mut`].
    pub(crate) fn mark_sensing(&mut self, tti: Tti, plan: &Plan, is_added: bool) {
        for j in 0..self.looked.len() {
            if plan.duty_cycle(DeviceId(j as u32)).is_on(tti) {
                self.looked[j] = tti.0 + 1;
                if !is_added {
                    self.ages.add(j);
                }
            }
        }
    }

    /// Tokens of all devices, `[N, `[`COUNT`]`]` in the order of [`FEATURES`].
    pub(crate) fn tokens(&self) -> &[f32] {
        &self.tokens
    }

    /// Whether the battery of device `j` lets it sense.
    pub(crate) fn can_sense(&self, j: usize) -> bool {
        self.tokens[j * COUNT + CAN_SENSE] > 0.5
    }

    /// Returns the events that device `j` would find if it sensed, given only α: those that start within its reach,
    /// times the age of its places.
    pub(crate) fn expected(&self, j: usize) -> f32 {
        let fixed = &self.fixed[j];
        fixed.expected * mean_age(self.worths[j], fixed.own)
    }

    /// Ages of the places.
    pub(crate) const fn ages(&self) -> &Ages {
        &self.ages
    }

    /// Ages of the places, for choosing devices.
    pub(crate) const fn ages_mut(&mut self) -> &mut Ages {
        &mut self.ages
    }
}

/// Features that are the same for all devices.
struct Shared {
    density: f32,
    alpha: f32,
    all: [f32; SCALES.len()],
    found: f32,
    since: f32,
    delay: f32,
}

/// Returns the mean number of devices within reach of a place, on a logarithmic scale.
fn density(area: Area, sensing: &Sensing, n: usize) -> f32 {
    libm::logf((n as f64 * ages::reach(sensing) / area.surface()) as f32) / 5.0
}

/// Returns the age a for which a(a + 1)/2 is the mean index of some places. `worth` is the sum of their indices, `own`
/// the sum if all had age 1.
fn mean_age(worth: f64, own: f64) -> f32 {
    if own > 0.0 {
        (((8.0 * worth / own + 1.0).sqrt() - 1.0) / 2.0).max(1.0) as f32
    } else {
        1.0
    }
}

/// Maps a number of TTIs to a logarithmic scale, 0 for 1 and 1 for about 400.
fn logarithm(ttis: u64) -> f32 {
    libm::logf(ttis.clamp(1, 4096) as f32) / 6.0
}

/// Returns the weighted centre of the reporters.
fn centre(reporters: &[(Point, f64)]) -> Option<Point> {
    let weight: f64 = reporters.iter().map(|(_, weight)| weight).sum();
    let sum = |of: fn(&Point) -> f64| reporters.iter().map(|(at, weight)| weight * of(at)).sum::<f64>();
    (!reporters.is_empty()).then(|| Point::new(sum(|at| at.x) / weight, sum(|at| at.y) / weight))
}
