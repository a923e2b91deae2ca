//! Input of the model per device and TTI: the state 𝒯(k) of the paper (Sec. V-C), as far as a base station knows it.
//!
//! The token of a device holds its battery, the size of the area that it covers and the time since it was last covered.
//! It also holds the ratio of reported to expected events, near the device and anywhere, over short and long times. No
//! feature grows with N or the area, so a model trained on one deployment serves another.
//!
//! `dt` decides on them, and [`super::record`] records them for the training. The names, meaning, scale and order of
//! [`FEATURES`] are part of the weights file ([`super::model::weights::FORMAT_VERSION`]) and columns of trajectory
//! files (`VERSION` in `lab/src/trajectories/parquet.rs`); docs/dt.md describes them.

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::ages::{self, Ages};
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Names of the features of a token, in order; `TokenBuilder::begin_tti` computes them in this order. In these names
/// `found` means reported in the last TTI, `idle` and `since_found` are times since sensing and since a report, and
/// `delay` is the time between two reported events.
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

/// Index of `can_sense` in [`FEATURES`], which states whether the battery of a device lets it sense, 0 or 1.
pub const CAN_SENSE: usize = 1;

/// Number of features of a token.
pub const FEATURE_COUNT: usize = FEATURES.len();

/// Time constants over which events are counted, TTIs: short, middle and long in [`FEATURES`].
const TIME_CONSTANTS: [f32; 3] = [8.0, 64.0, 512.0];

/// Numbers of reported and of expected events, which decay exponentially with each of [`TIME_CONSTANTS`].
#[derive(Clone, Copy, Debug, Default)]
struct DecayingEventCounts {
    reported: [f32; TIME_CONSTANTS.len()],
    expected: [f32; TIME_CONSTANTS.len()],
}

impl DecayingEventCounts {
    /// Advances by one TTI with this many `reported` and `expected` events.
    fn advance(&mut self, reported: f32, expected: f32) {
        for (scale, tau) in TIME_CONSTANTS.into_iter().enumerate() {
            let decay = 1.0 - 1.0 / tau;
            self.reported[scale] = decay * self.reported[scale] + reported;
            self.expected[scale] = decay * self.expected[scale] + expected;
        }
    }

    /// Returns the logarithm of the ratio of reported to expected events, each increased by one prior event.
    fn surprise(&self, scale: usize) -> f32 {
        libm::logf((self.reported[scale] + 1.0) / (self.expected[scale] + 1.0))
    }
}

#[derive(Clone, Copy, Debug)]
struct DeviceConstants {
    /// Gain if every place had age 1, in the unit of [`Ages::gain`].
    unit_gain: f64,
    /// Events that start within its reach, per TTI.
    expected_per_tti: f32,
    /// `unit_gain` relative to a whole sensing disc.
    reach: f32,
    /// Mean harvest relative to E_idle, at most 4.
    harvest: f32,
    /// ln(1 + n) / 5, with n the other devices within d_max.
    neighbours: f32,
    min_level: Energy,
    e_max: f32,
}

#[derive(Clone, Copy, Debug)]
struct ReportedEvent {
    /// Estimate of the epicentre.
    position: Point,
    tti: Tti,
}

/// State of the base station from which tokens are built. Calls in each TTI: `begin_tti`, then `mark_sensing`, then
/// `add_report` for each report. The observations must hold batteries. `tokens`, `can_sense` and `expected_events`
/// refer to the TTI of the last `begin_tti`.
#[derive(Clone, Debug)]
pub(crate) struct TokenBuilder {
    ages: Ages,
    positions: Vec<Point>,
    buckets: Buckets,
    d_max: f64,
    constants: Vec<DeviceConstants>,
    /// By device, events near it.
    near_counts: Vec<DecayingEventCounts>,
    /// Events anywhere.
    all_counts: DecayingEventCounts,
    /// α.
    event_probability: f32,
    /// See [`log_density`].
    log_density: f32,
    /// ln(α) / 5.
    log_alpha: f32,
    /// By device, the TTI in which it sensed last, counted from 1; 0 for never.
    last_sensed: Vec<u64>,
    /// Position and weight of each reporter of this TTI; the weight falls with its distance to the event.
    reporters: Vec<(Point, f64)>,
    last_event: Option<ReportedEvent>,
    /// Time between the last two reported events, on the scale of [`log_scale`].
    event_interval: f32,
    /// By device, whether the event reported in the last TTI, if any, is near it.
    is_near: Vec<bool>,
    /// By device, the gain of sensing in this TTI, in the unit of [`Ages::gain`].
    gains: Vec<f64>,
    tokens: Vec<f32>,
}

impl TokenBuilder {
    /// Creates the state before the first TTI for the devices in `known`; device j can sense from level `min_level(j)`
    /// on.
    pub(crate) fn new(known: &Knowledge, min_level: impl Fn(usize) -> Energy) -> Self {
        let (positions, d_max, n) = (known.positions(), known.sensing.d_max, known.n());
        let ages = Ages::with_loss(
            known.radio.no_report_probability(),
            &positions,
            known.area,
            &known.sensing,
        );
        let buckets = Buckets::new(&positions, known.area, d_max);
        let events_per_cell = known.alpha * ages.cell_surface() / known.area.surface();
        let disc_gain = ages::effective_area(&known.sensing) / ages.cell_surface();
        let constants = |j: usize| {
            let device = &known.devices[j];
            let (unit_gain, mut neighbours) = (ages.gain(j), 0_u32);
            buckets.within(positions[j], d_max, |i, _| neighbours += u32::from(i != j));
            let units = |energy: Energy| energy.units();
            DeviceConstants {
                unit_gain,
                expected_per_tti: (events_per_cell * unit_gain) as f32,
                reach: (unit_gain / disc_gain) as f32,
                // E_idle may be 0.
                harvest: (units(device.mean_harvest) / units(device.energy.e_idle).max(1e-6)).min(4.0) as f32,
                neighbours: libm::logf(1.0 + neighbours as f32) / 5.0,
                min_level: min_level(j),
                e_max: units(device.energy.e_max) as f32,
            }
        };
        Self {
            constants: (0..n).map(constants).collect(),
            near_counts: vec![DecayingEventCounts::default(); n],
            all_counts: DecayingEventCounts::default(),
            event_probability: known.alpha as f32,
            log_density: log_density(known.area, &known.sensing, n),
            log_alpha: libm::logf(known.alpha as f32) / 5.0,
            last_sensed: vec![0; n],
            reporters: Vec::new(),
            last_event: None,
            event_interval: 0.0,
            is_near: vec![false; n],
            gains: vec![0.0; n],
            tokens: vec![0.0; n * FEATURE_COUNT],
            ages,
            positions,
            buckets,
            d_max,
        }
    }

    /// Begins the TTI of `seen`: processes the events of the last TTI and computes the [`Self::tokens`] of this one.
    pub(crate) fn begin_tti(&mut self, seen: &Observation<'_>) {
        if seen.now > Tti::ZERO {
            self.advance(Tti(seen.now.0 - 1));
        }
        let last_event = self.last_event;
        let is_reported = last_event.is_some_and(|event| event.tti.0 + 1 == seen.now.0);
        // Before the first event the time is as long as `log_scale` allows.
        let ttis_since_event = last_event.map_or(u64::MAX, |event| seen.now.0 - event.tti.0);
        let global_features = GlobalFeatures {
            log_density: self.log_density,
            log_alpha: self.log_alpha,
            all_surprises: [0, 1, 2].map(|scale| self.all_counts.surprise(scale)),
            is_reported: f32::from(u8::from(is_reported)),
            since_event: log_scale(ttis_since_event),
            event_interval: self.event_interval,
        };
        let (tokens, _) = self.tokens.as_chunks_mut::<FEATURE_COUNT>();
        for (j, token) in tokens.iter_mut().enumerate() {
            self.gains[j] = self.ages.gain(j);
            let (constants, near_counts) = (&self.constants[j], &self.near_counts[j]);
            let idle_ttis = match self.last_sensed[j] {
                0 => seen.now.0 + 1,
                last_sensed => seen.now.0 + 1 - last_sensed,
            };
            let nearness = last_event.map_or(0.0, |event| {
                libm::expf(-(event.position.distance(self.positions[j]) / self.d_max) as f32)
            });
            let level = seen.batteries[j];
            // In the order of `FEATURES`.
            *token = [
                level.units() as f32 / constants.e_max,
                f32::from(u8::from(level >= constants.min_level)),
                libm::logf(mean_age(self.gains[j], constants.unit_gain)),
                log_scale(idle_ttis),
                constants.reach,
                global_features.log_density,
                global_features.log_alpha,
                constants.harvest,
                near_counts.surprise(0),
                near_counts.surprise(1),
                near_counts.surprise(2),
                global_features.all_surprises[0],
                global_features.all_surprises[1],
                global_features.all_surprises[2],
                global_features.is_reported,
                f32::from(u8::from(self.is_near[j])),
                global_features.since_event,
                nearness,
                constants.neighbours,
                global_features.event_interval,
            ];
        }
    }

    /// Ends TTI `tti`: counts its event, if one was reported, and lets the ages of places grow.
    fn advance(&mut self, tti: Tti) {
        let epicentre = weighted_centre(&self.reporters);
        self.reporters.clear();
        self.is_near.fill(false);
        if let Some(position) = epicentre {
            let is_near = &mut self.is_near;
            self.buckets.within(position, self.d_max, |j, _| is_near[j] = true);
            // The interval counts from the previous event, so it is taken before `last_event` changes.
            self.event_interval = self.last_event.map_or(0.0, |last| log_scale(tti.0 - last.tti.0));
            self.last_event = Some(ReportedEvent { position, tti });
        }
        let devices = self.near_counts.iter_mut().zip(&self.constants).zip(&self.is_near);
        for ((near_counts, constants), &is_near) in devices {
            near_counts.advance(f32::from(u8::from(is_near)), constants.expected_per_tti);
        }
        self.all_counts
            .advance(f32::from(u8::from(epicentre.is_some())), self.event_probability);
        self.ages.advance(epicentre.is_some());
    }

    /// Notes a reporter of this TTI; the place of the event follows from all of them when the TTI ends.
    pub(crate) fn add_report(&mut self, seen: &Observation<'_>, report: &Report) {
        let position = self.positions[report.device.index()];
        // A report without information comes from beyond d_max.
        let distance = seen.known.sensing.distance(report.information).unwrap_or(self.d_max);
        // The offset keeps the weight of a report from distance 0 finite.
        self.reporters
            .push((position, 1.0 / (0.01 * self.d_max + distance).powi(2)));
    }

    /// Marks the devices that sense in `tti` under `plan`. With `are_in_ages` they are already in [`Self::ages_mut`].
    pub(crate) fn mark_sensing(&mut self, tti: Tti, plan: &Plan, are_in_ages: bool) {
        for j in 0..self.last_sensed.len() {
            if plan.duty_cycle(DeviceId(j as u32)).is_on(tti) {
                self.last_sensed[j] = tti.0 + 1;
                if !are_in_ages {
                    self.ages.add(j);
                }
            }
        }
    }

    /// Tokens of all devices, `[N, `[`FEATURE_COUNT`]`]` in the order of [`FEATURES`].
    pub(crate) fn tokens(&self) -> &[f32] {
        &self.tokens
    }

    /// Returns the feature `can_sense` of device `j`.
    pub(crate) fn can_sense(&self, j: usize) -> bool {
        self.tokens[j * FEATURE_COUNT + CAN_SENSE] > 0.5
    }

    /// Returns the events that device `j` would detect if it sensed, given only α: the events that start within its
    /// reach per TTI, times the age of its places.
    pub(crate) fn expected_events(&self, j: usize) -> f32 {
        let constants = &self.constants[j];
        constants.expected_per_tti * mean_age(self.gains[j], constants.unit_gain)
    }

    pub(crate) const fn ages(&self) -> &Ages {
        &self.ages
    }

    /// Ages of the places, for choosing devices.
    pub(crate) const fn ages_mut(&mut self) -> &mut Ages {
        &mut self.ages
    }
}

/// Features that are the same for all devices.
struct GlobalFeatures {
    log_density: f32,
    log_alpha: f32,
    /// [`DecayingEventCounts::surprise`] of the events anywhere.
    all_surprises: [f32; TIME_CONSTANTS.len()],
    /// 1 if an event was reported in the last TTI, 0 otherwise.
    is_reported: f32,
    /// Time since the last reported event, on the scale of [`log_scale`].
    since_event: f32,
    event_interval: f32,
}

/// Returns the logarithm of the mean number of devices within reach of a place, divided by 5. The divisors of
/// logarithms in this file bring features to the order of 1.
fn log_density(area: Area, sensing: &Sensing, n: usize) -> f32 {
    libm::logf((n as f64 * ages::effective_area(sensing) / area.surface()) as f32) / 5.0
}

/// Returns the age a for which a(a + 1)/2 is the mean index of some places. `gain` is the sum of their indices,
/// `unit_gain` the sum if all had age 1.
fn mean_age(gain: f64, unit_gain: f64) -> f32 {
    if unit_gain > 0.0 {
        (((8.0 * gain / unit_gain + 1.0).sqrt() - 1.0) / 2.0).max(1.0) as f32
    } else {
        1.0
    }
}

/// Maps a number of TTIs to a logarithmic scale, 0 for 1 and 1 for about 400.
fn log_scale(ttis: u64) -> f32 {
    libm::logf(ttis.clamp(1, 4096) as f32) / 6.0
}

/// Returns the mean of the positions by weight; `None` without a reporter.
fn weighted_centre(reporters: &[(Point, f64)]) -> Option<Point> {
    let weight: f64 = reporters.iter().map(|(_, weight)| weight).sum();
    let sum = |coordinate: fn(&Point) -> f64| {
        let terms = reporters.iter().map(|(position, weight)| weight * coordinate(position));
        terms.sum::<f64>()
    };
    (!reporters.is_empty()).then(|| Point::new(sum(|p| p.x) / weight, sum(|p| p.y) / weight))
}
