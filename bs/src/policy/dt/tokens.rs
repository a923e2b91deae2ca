//! Input of the model per device and TTI: the state 𝒯(k) of the paper (Sec. V-C), as far as a base station knows it.
//!
//! The token of a device holds its battery, the size of the area that it covers and the time since it was last covered.
//! It also holds the ratio of reported to expected events, near the device and anywhere, over short and long times. No
//! feature grows with N or the area, so a model trained on one deployment serves another.
//!
//! `dt` decides on them, and [`super::record`] records them for the training. The names, meaning, scale and order of
//! [`FEATURES`] are part of the weights file ([`super::model::weights::FORMAT_VERSION`]) and columns of trajectory
//! files (`VERSION` in `lab/src/trajectories/parquet.rs`); docs/dt.md describes them.

use pulp::NullaryFnOnce;
use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use super::vector_math::log;
use crate::beliefs::ages::{self, Ages};
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::vector_width::VectorWidth;

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

/// Index of `battery` in [`FEATURES`], the battery level as a share of E_max.
pub(crate) const BATTERY: usize = 0;
/// Index of `can_sense` in [`FEATURES`], which states whether the battery of a device lets it sense, 0 or 1.
pub const CAN_SENSE: usize = 1;

/// Number of features of a token.
pub const FEATURE_COUNT: usize = FEATURES.len();

/// Time constants over which events are counted, TTIs: short, middle and long in [`FEATURES`].
const TIME_CONSTANTS: [f32; 3] = [8.0, 64.0, 512.0];

/// Numbers of reported and of expected events in several places, which decay exponentially with one of
/// [`TIME_CONSTANTS`].
#[derive(Clone, Debug)]
struct DecayingEventCounts {
    decay: f32,
    reported: Vec<f32>,
    expected: Vec<f32>,
    /// By place, the logarithm of the ratio of reported to expected events, each increased by one prior event.
    surprises: Vec<f32>,
}

impl DecayingEventCounts {
    /// Creates the counts of `places` places before the first TTI, by time constant.
    fn new(places: usize) -> [Self; TIME_CONSTANTS.len()] {
        TIME_CONSTANTS.map(|tau| Self {
            decay: 1.0 - 1.0 / tau,
            reported: vec![0.0; places],
            expected: vec![0.0; places],
            surprises: vec![0.0; places],
        })
    }

    /// Advances by one TTI with this many `reported` and `expected` events, by place.
    #[inline(always)]
    fn advance(&mut self, reported: &[f32], expected: &[f32]) {
        for (sum, reported) in self.reported.iter_mut().zip(reported) {
            *sum = self.decay * *sum + reported;
        }
        for (sum, expected) in self.expected.iter_mut().zip(expected) {
            *sum = self.decay * *sum + expected;
        }
        let sums = self.reported.iter().zip(&self.expected);
        for (surprise, (reported, expected)) in self.surprises.iter_mut().zip(sums) {
            *surprise = log((reported + 1.0) / (expected + 1.0));
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct DeviceConstants {
    /// Gain at age 1 relative to a whole sensing disc.
    reach: f32,
    /// Mean harvest relative to E_idle, at most 4.
    harvest: f32,
    /// ln(1 + n) / 5, with n the other devices within d_max.
    neighbours: f32,
    min_level: Energy,
    e_max: f32,
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
    /// By device, the gain if every place had age 1, in the unit of [`Ages::gain`].
    unit_gains: Vec<f64>,
    /// By device, the events that start within its reach, per TTI.
    expected_per_tti: Vec<f32>,
    /// Events near each device, by time constant.
    near_counts: [DecayingEventCounts; TIME_CONSTANTS.len()],
    /// Events anywhere, by time constant.
    all_counts: [DecayingEventCounts; TIME_CONSTANTS.len()],
    /// α.
    event_probability: f32,
    /// See [`log_density`].
    log_density: f32,
    /// ln(α) / 5.
    log_alpha: f32,
    /// By device, the TTI in which it sensed last, counted from 1; 0 for never.
    last_sensed: Vec<u64>,
    /// [`log_scale`] by number of TTIs.
    log_scales: Box<[f32]>,
    /// Position and weight of each reporter of this TTI; the weight falls with its distance to the event.
    reporters: Vec<(Point, f64)>,
    /// TTI of the last reported event.
    last_event: Option<Tti>,
    /// Time between the last two reported events, on the scale of [`log_scale`].
    event_interval: f32,
    /// By device, 1 if the event reported in the last TTI, if any, is near it, and 0 otherwise.
    is_near: Vec<f32>,
    /// By device, how near the last reported event was, from 0 to 1.
    nearness: Vec<f32>,
    /// By device, the gain of sensing in this TTI, in the unit of [`Ages::gain`].
    gains: Vec<f64>,
    /// By device, the logarithm of [`mean_age`] in this TTI.
    log_ages: Vec<f32>,
    tokens: Vec<f32>,
    vector_width: VectorWidth,
}

/// The part of [`TokenBuilder::begin_tti`] that is computed side by side for all devices.
struct DeviceFeatures<'a> {
    builder: &'a mut TokenBuilder,
    /// Whether the counts of events advance.
    advances: bool,
}

impl NullaryFnOnce for DeviceFeatures<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let builder = self.builder;
        if self.advances {
            for counts in &mut builder.near_counts {
                counts.advance(&builder.is_near, &builder.expected_per_tti);
            }
        }
        builder.ages.fill_gains(&mut builder.gains);
        let gains = builder.gains.iter().zip(&builder.unit_gains);
        for (log_age, (gain, unit_gain)) in builder.log_ages.iter_mut().zip(gains) {
            *log_age = log(mean_age(*gain, *unit_gain));
        }
    }
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
        let unit_gains: Vec<f64> = (0..n).map(|j| ages.gain(j)).collect();
        let constants = |j: usize| {
            let (device, mut neighbours) = (&known.devices[j], 0_u32);
            buckets.within(positions[j], d_max, |i, _| neighbours += u32::from(i != j));
            let units = |energy: Energy| energy.units();
            DeviceConstants {
                reach: (unit_gains[j] / disc_gain) as f32,
                // E_idle may be 0.
                harvest: (units(device.mean_harvest) / units(device.energy.e_idle).max(1e-6)).min(4.0) as f32,
                neighbours: libm::logf(1.0 + neighbours as f32) / 5.0,
                min_level: min_level(j),
                e_max: units(device.energy.e_max) as f32,
            }
        };
        Self {
            constants: (0..n).map(constants).collect(),
            log_density: log_density(known.area, &known.sensing, n),
            log_alpha: libm::logf(known.alpha as f32) / 5.0,
            tokens: vec![0.0; n * FEATURE_COUNT],
            expected_per_tti: unit_gains.iter().map(|gain| (events_per_cell * gain) as f32).collect(),
            unit_gains,
            near_counts: DecayingEventCounts::new(n),
            all_counts: DecayingEventCounts::new(1),
            event_probability: known.alpha as f32,
            last_sensed: vec![0; n],
            log_scales: (0..=MAX_SCALED_TTIS).map(log_scale).collect(),
            reporters: Vec::new(),
            last_event: None,
            event_interval: 0.0,
            is_near: vec![0.0; n],
            nearness: vec![0.0; n],
            gains: vec![0.0; n],
            log_ages: vec![0.0; n],
            vector_width: VectorWidth::fastest(),
            ages,
            positions,
            buckets,
            d_max,
        }
    }

    /// Begins the TTI of `seen`: processes the events of the last TTI and computes the [`Self::tokens`] of this one.
    pub(crate) fn begin_tti(&mut self, seen: &Observation<'_>) {
        let advances = seen.now > Tti::ZERO;
        if advances {
            self.end_tti(Tti(seen.now.0 - 1));
        }
        self.vector_width.run(DeviceFeatures {
            builder: self,
            advances,
        });
        let last_event = self.last_event;
        let is_reported = last_event.is_some_and(|event| event.0 + 1 == seen.now.0);
        // Before the first event the time is as long as `log_scale` allows.
        let ttis_since_event = last_event.map_or(u64::MAX, |event| seen.now.0 - event.0);
        let since_event = log_scale(ttis_since_event);
        let [near_short, near_middle, near_long] = &self.near_counts;
        let [all_short, all_middle, all_long] = [0, 1, 2].map(|scale| self.all_counts[scale].surprises[0]);
        let (tokens, _) = self.tokens.as_chunks_mut::<FEATURE_COUNT>();
        for (j, token) in tokens.iter_mut().enumerate() {
            let (constants, level) = (&self.constants[j], seen.batteries[j]);
            // A device that has never sensed counts as having sensed just before TTI 0.
            let idle_ttis = seen.now.0 + 1 - self.last_sensed[j];
            // In the order of `FEATURES`.
            *token = [
                level.units() as f32 / constants.e_max,
                f32::from(u8::from(level >= constants.min_level)),
                self.log_ages[j],
                self.log_scales[idle_ttis.min(MAX_SCALED_TTIS) as usize],
                constants.reach,
                self.log_density,
                self.log_alpha,
                constants.harvest,
                near_short.surprises[j],
                near_middle.surprises[j],
                near_long.surprises[j],
                all_short,
                all_middle,
                all_long,
                f32::from(u8::from(is_reported)),
                self.is_near[j],
                since_event,
                self.nearness[j],
                constants.neighbours,
                self.event_interval,
            ];
        }
    }

    /// Ends TTI `tti`: places its event, if one was reported, and lets the ages of places grow.
    fn end_tti(&mut self, tti: Tti) {
        let epicentre = weighted_centre(&self.reporters);
        self.reporters.clear();
        self.is_near.fill(0.0);
        if let Some(position) = epicentre {
            let is_near = &mut self.is_near;
            self.buckets.within(position, self.d_max, |j, _| is_near[j] = 1.0);
            for (nearness, place) in self.nearness.iter_mut().zip(&self.positions) {
                *nearness = libm::expf(-(position.distance(*place) / self.d_max) as f32);
            }
            // The interval counts from the previous event, so it is taken before `last_event` changes.
            self.event_interval = self.last_event.map_or(0.0, |last| log_scale(tti.0 - last.0));
            self.last_event = Some(tti);
        }
        let reported = f32::from(u8::from(epicentre.is_some()));
        for counts in &mut self.all_counts {
            counts.advance(&[reported], &[self.event_probability]);
        }
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

    /// Marks the devices that sense in `tti` under `plan`. With `are_in_ages` they are already in [`Self::ages`].
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
        self.expected_per_tti[j] * mean_age(self.gains[j], self.unit_gains[j])
    }

    pub(crate) const fn ages(&self) -> &Ages {
        &self.ages
    }

    /// Ages of the places, for choosing devices, and the gain of each device in them until a device is added.
    pub(crate) fn ages_and_gains(&mut self) -> (&mut Ages, &[f64]) {
        (&mut self.ages, &self.gains)
    }
}

/// Returns the logarithm of the mean number of devices within reach of a place, divided by 5. The divisors of
/// logarithms in this file bring features to the order of 1.
fn log_density(area: Area, sensing: &Sensing, n: usize) -> f32 {
    libm::logf((n as f64 * ages::effective_area(sensing) / area.surface()) as f32) / 5.0
}

/// Returns the age a for which a(a + 1)/2 is the mean index of some places. `gain` is the sum of their indices,
/// `unit_gain` the sum if all had age 1. Without places the age is 1.
#[inline(always)]
fn mean_age(gain: f64, unit_gain: f64) -> f32 {
    // 0 / 0 is NaN, which `max` replaces.
    (((8.0 * gain / unit_gain + 1.0).sqrt() - 1.0) / 2.0).max(1.0) as f32
}

/// Largest number of TTIs that [`log_scale`] distinguishes.
const MAX_SCALED_TTIS: u64 = 4096;

/// Maps a number of TTIs to a logarithmic scale, 0 for 1 and 1 for about 400.
fn log_scale(ttis: u64) -> f32 {
    libm::logf(ttis.clamp(1, MAX_SCALED_TTIS) as f32) / 6.0
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

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};

    use super::*;

    /// A call of [`DecayingEventCounts::advance`] for each TTI of `reported`.
    struct Advances<'a> {
        counts: &'a mut DecayingEventCounts,
        reported: &'a [Vec<f32>],
        expected: &'a [f32],
    }

    impl NullaryFnOnce for Advances<'_> {
        type Output = ();

        #[inline(always)]
        fn call(self) {
            for reported in self.reported {
                self.counts.advance(reported, self.expected);
            }
        }
    }

    #[test]
    fn surprises_equal_double_precision_and_have_the_same_bits_for_every_vector_width() {
        const PLACES: usize = 37;
        let mut stream = Stream::new(5, Purpose::Training, 0);
        let expected: Vec<f32> = (0..PLACES).map(|_| (0.05 * stream.unit()) as f32).collect();
        // Events at changing places.
        let is_reported = |j: usize, k: usize| f32::from(u8::from((3 * j + k).is_multiple_of(11)));
        let reported: Vec<Vec<f32>> = (0..90)
            .map(|k| (0..PLACES).map(|j| is_reported(j, k)).collect())
            .collect();
        for (index, tau) in TIME_CONSTANTS.into_iter().enumerate() {
            let surprises_with = |width: VectorWidth| {
                let mut counts = DecayingEventCounts::new(PLACES)[index].clone();
                width.run(Advances {
                    counts: &mut counts,
                    reported: &reported,
                    expected: &expected,
                });
                counts.surprises
            };
            let widths = VectorWidth::supported();
            let surprises = surprises_with(widths[0]);
            for width in &widths[1..] {
                let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(&surprises_with(*width)), bits(&surprises), "{width:?}");
            }
            for (j, surprise) in surprises.iter().enumerate() {
                let decay = 1.0 - 1.0 / f64::from(tau);
                let sums = reported.iter().fold((0.0, 0.0), |(found, awaited), row| {
                    (
                        decay * found + f64::from(row[j]),
                        decay * awaited + f64::from(expected[j]),
                    )
                });
                let exact = libm::log((sums.0 + 1.0) / (sums.1 + 1.0));
                assert!((f64::from(*surprise) - exact).abs() < 1e-4, "{surprise}, not {exact}");
            }
        }
    }

    #[test]
    fn the_mean_age_is_1_without_places_and_solves_the_worth_otherwise() {
        assert_eq!(mean_age(0.0, 0.0).to_bits(), 1.0_f32.to_bits());
        for age in [1.0, 2.0, 7.5] {
            let worth = 12.0 * age * (age + 1.0) / 2.0;
            assert!((f64::from(mean_age(worth, 12.0)) - age).abs() < 1e-6, "age {age}");
        }
    }

    #[test]
    fn indices_name_their_features() {
        assert_eq!((FEATURES[BATTERY], FEATURES[CAN_SENSE]), ("battery", "can_sense"));
    }
}
