//! A belief over the epicentre of an event, with the devices ranked by the information that they are expected to add.
//! [`WakeUpCandidates`](super::candidates::WakeUpCandidates) uses it; observers of a run receive its points. Digests
//! and frames depend on every bit, so the order of points and factors is fixed. docs/q-learning.md states the numbers
//! of points and the factor for silence. The tests next to this file are the only second computation.
//!
//! A report puts the epicentre on a ring around the reporter, held as points. A second report leaves the two points
//! where the rings meet, a third leaves one of them. A silent device in S1 makes the points in its range unlikely.

use std::cmp::Ordering;
use std::f64::consts::TAU;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::message::WeightedPoint;
use reveille_common::sensing::{DetectionKind, Sensing};

use super::correlation::exp_negative;

/// Points on a ring before the silence of other devices is applied.
const POINTS_PER_RING: usize = 512;
/// Largest number of likely points, and of unlikely points, that are kept after that.
const MAX_POINTS_PER_GROUP: usize = 32;
/// Factor on the likelihood of a point in range of a device that should have detected an event there but did not
/// report. The device may have failed.
const SILENCE_FACTOR: f64 = 0.02;
/// Factor on the likelihood of a point in range of a woken device whose report placed the event beyond d_max. The
/// factor is not 0, so that points still differ if all are ruled out.
const RULED_OUT_FACTOR: f64 = 1e-12;
/// Largest distance from a ring at which a point counts as on it, metres per metre of d_max.
const RING_TOLERANCE: f64 = 1e-6;

/// A belief over the epicentre of one event at a time, with the devices ranked by their expected gain.
///
/// [`Self::start_event`] begins an event. The first reports follow, then [`Self::observe_silence`] once. After that,
/// candidates are taken and further reports added, in any order. All calls of one event need the same prior.
#[derive(Clone, Debug)]
pub struct EpicentreBelief {
    sensing: Sensing,
    /// Cost of a failed wake-up, in units of information.
    miss_cost: f64,
    /// Factor for a point in range of a silent device: [`SILENCE_FACTOR`], or more if the radio loses reports.
    silence_factor: f64,
    area: Area,
    positions: Vec<Point>,
    buckets: Buckets,
    /// Candidate epicentres.
    points: Vec<RingPoint>,
    /// Positions of the reporters and their distances from the event.
    rings: Vec<(Point, f64)>,
    /// Positions of the devices in S1 that did not report, in the order of ids.
    silent_devices: Vec<Point>,
    /// Positions of the woken devices that are farther than d_max from the event.
    far_devices: Vec<Point>,
    /// By device: whether it has reported or was returned as a candidate for this event.
    is_excluded: Vec<bool>,
    excluded: Vec<DeviceId>,
    /// cos φ and sin φ of the points on a ring.
    directions: Box<[(f64, f64)]>,
}

#[derive(Clone, Copy, Debug)]
struct RingPoint {
    position: Point,
    likelihood: ScaledLikelihood,
    /// The likelihood in units of [`SCALE_STEP`] to the power of the least number of steps of any point.
    weight: f64,
}

/// A product of factors, most of them below 1, that may be too small for a floating-point number.
#[derive(Clone, Copy, Debug)]
struct ScaledLikelihood {
    /// Value in units of [`SCALE_STEP`] to the power of `steps`. It is at least [`SCALE_STEP`]; a prior or
    /// the thinning of points can raise it above 1.
    value: f64,
    steps: u32,
}

/// 2⁻⁵¹²; multiplication by a power of two is exact.
const SCALE_STEP: f64 = 1.0 / (TWO_TO_256 * TWO_TO_256);
const TWO_TO_256: f64 = TWO_TO_128 * TWO_TO_128;
const TWO_TO_128: f64 = (1_u128 << 127) as f64 * 2.0;

impl ScaledLikelihood {
    const CERTAIN: Self = Self { value: 1.0, steps: 0 };

    /// Multiplies the likelihood by `factor`, which is at least [`SCALE_STEP`].
    fn times(self, factor: f64) -> Self {
        let Self { value, steps } = self;
        // One step is enough, since neither the value nor the factor is below `SCALE_STEP`.
        let value = value * factor;
        if value < SCALE_STEP {
            Self {
                value: value / SCALE_STEP,
                steps: steps + 1,
            }
        } else {
            Self { value, steps }
        }
    }
}

impl RingPoint {
    const fn new(position: Point, likelihood: ScaledLikelihood) -> Self {
        Self {
            position,
            likelihood,
            weight: 1.0,
        }
    }
}

impl EpicentreBelief {
    /// Creates a belief without an event, for the devices at `positions`.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        Self {
            sensing: sensing.clone(),
            miss_cost: 0.0,
            silence_factor: SILENCE_FACTOR,
            area,
            buckets: Buckets::new(positions, area, sensing.d_max),
            is_excluded: vec![false; positions.len()],
            positions: positions.to_vec(),
            points: Vec::new(),
            rings: Vec::new(),
            silent_devices: Vec::new(),
            far_devices: Vec::new(),
            excluded: Vec::new(),
            directions: (0..POINTS_PER_RING).map(direction).collect(),
        }
    }

    /// Sets the cost of waking a device farther than d_max from the event: `miss_cost`, ≥ 0, in units of information.
    /// It affects only the comparison of devices.
    #[must_use]
    pub(crate) fn with_miss_cost(self, miss_cost: f64) -> Self {
        Self { miss_cost, ..self }
    }

    /// Sets the probability that the radio silences a device that should have reported: `loss_probability`,
    /// `[0, 1]`.
    #[must_use]
    pub(crate) fn with_loss(self, loss_probability: f64) -> Self {
        Self {
            // The device failed, or it worked and the radio lost its report.
            silence_factor: SILENCE_FACTOR + (1.0 - SILENCE_FACTOR) * loss_probability,
            ..self
        }
    }

    /// Begins an event: forgets the last one.
    pub fn start_event(&mut self) {
        self.points.clear();
        self.rings.clear();
        self.silent_devices.clear();
        self.far_devices.clear();
        for device in self.excluded.drain(..) {
            self.is_excluded[device.index()] = false;
        }
    }

    /// Adds the report of `device` at distance `d` from the event, 0 ..= d_max. `prior` is the relative density of the
    /// epicentre before any report, at least [`SCALE_STEP`]; see [`uniform_prior`].
    pub(crate) fn add_reporter(&mut self, device: DeviceId, d: f64, prior: impl Fn(Point) -> f64) {
        let position = self.positions[device.index()];
        let slack = RING_TOLERANCE * self.sensing.d_max;
        // A second device at the same position adds no ring, and `intersect_rings` cannot divide by a distance of 0.
        if self.rings.iter().all(|(centre, _)| centre.distance(position) > slack) {
            match self.rings.len() {
                0 => self.points = self.ring_points(position, d),
                1 => self.intersect_rings(position, d, prior),
                _ => self.keep_points_on_ring(position, d),
            }
            self.rings.push((position, d));
        }
        self.exclude(device);
    }

    /// Records that the woken `device` reported a distance above d_max.
    pub(crate) fn add_far_reporter(&mut self, device: DeviceId) {
        let position = self.positions[device.index()];
        for point in &mut self.points {
            if point.position.distance(position) <= self.sensing.d_max {
                point.likelihood = point.likelihood.times(RULED_OUT_FACTOR);
            }
        }
        // Kept, since a later report creates new points, which must be ruled out as well.
        self.far_devices.push(position);
        self.update_weights();
    }

    /// Applies the silence of the devices for which `could_report` holds: in S1, with energy for a report. Call it
    /// once, after the first reports. `prior` as in `EpicentreBelief::add_reporter`.
    pub fn observe_silence(&mut self, could_report: impl Fn(DeviceId) -> bool, prior: impl Fn(Point) -> f64) {
        let Some(&(centre, d)) = self.rings.first() else { return };
        let Self {
            buckets,
            positions,
            silent_devices,
            is_excluded,
            sensing,
            ..
        } = self;
        let mut silent_indices = Vec::new();
        // A device farther away reaches no point on the ring.
        buckets.within(centre, d + sensing.d_max, |j, _| {
            if !is_excluded[j] && could_report(DeviceId(j as u32)) {
                silent_indices.push(j);
            }
        });
        // The likelihood is a rounded product, so its factors need one order.
        silent_indices.sort_unstable();
        silent_devices.extend(silent_indices.into_iter().map(|j| positions[j]));
        let likelihood_at = |point: &RingPoint| self.likelihood_of(point.position, prior(point.position));
        let likelihoods: Vec<ScaledLikelihood> = self.points.iter().map(likelihood_at).collect();
        for (point, likelihood) in self.points.iter_mut().zip(likelihoods) {
            point.likelihood = likelihood;
        }
        self.update_weights();
        self.thin_points();
    }

    /// Computes the relative weights of the points. A point 2⁵¹² times less likely than another may get weight 0.
    fn update_weights(&mut self) {
        let min_steps = self
            .points
            .iter()
            .map(|point| point.likelihood.steps)
            .min()
            .unwrap_or(0);
        for point in &mut self.points {
            let ScaledLikelihood { value, steps } = point.likelihood;
            point.weight = match steps - min_steps {
                0 => value,
                1 => value * SCALE_STEP,
                _ => 0.0,
            };
        }
    }

    /// Reduces the number of points. Among the likely points, and among the others, it keeps every n-th point, which
    /// then stands for the points dropped.
    fn thin_points(&mut self) {
        let max_weight = self.points.iter().map(|point| point.weight).fold(0.0, f64::max);
        let is_likely = |point: &RingPoint| point.weight > 0.5 * max_weight;
        let likely_count = self.points.iter().filter(|point| is_likely(point)).count();
        // A group without points gets a stride of 1, since the stride divides below.
        let strides =
            [self.points.len() - likely_count, likely_count].map(|count| count.div_ceil(MAX_POINTS_PER_GROUP).max(1));
        let mut counts = [0; 2];
        self.points.retain_mut(|point| {
            let group = usize::from(is_likely(point));
            let index = counts[group];
            counts[group] += 1;
            point.likelihood.value *= strides[group] as f64;
            index % strides[group] == strides[group] / 2
        });
        self.update_weights();
    }

    /// Returns the device with the largest expected gain less the cost of a failed wake-up, and its gain alone. Only
    /// devices for which `is_candidate` holds count, if they have neither reported nor been returned for this event.
    /// `information` is Î. Ties go to the lower number. `None` before the first report, or if no device has a gain.
    pub fn next_candidate(
        &mut self,
        information: f64,
        is_candidate: impl Fn(DeviceId) -> bool,
    ) -> Option<(DeviceId, f64)> {
        let &(centre, d) = self.rings.first()?;
        // Never 0: a point with the fewest steps has its value as weight, which is at least `SCALE_STEP`.
        let weight_sum: f64 = self.points.iter().map(|point| point.weight).sum();
        // Score, gain and device.
        let mut best: Option<(f64, f64, DeviceId)> = None;
        let mut consider = |j: usize| {
            let device = DeviceId(j as u32);
            if self.is_excluded[j] || !is_candidate(device) {
                return;
            }
            let (gain, missed_weight) = self.gain_and_missed_weight(self.positions[j], information);
            let score = (gain - self.miss_cost * missed_weight) / weight_sum;
            let gain = gain / weight_sum;
            let is_better = best.is_none_or(|(best_score, _, best_device)| match score.total_cmp(&best_score) {
                Ordering::Greater => true,
                Ordering::Equal => device < best_device,
                Ordering::Less => false,
            });
            if gain > 0.0 && is_better {
                best = Some((score, gain, device));
            }
        };
        let reach = self.max_useful_distance(information);
        // With two points left, far fewer devices are near them than near the ring. A device found twice changes
        // nothing.
        if self.points.len() <= 2 {
            for point in &self.points {
                self.buckets.within(point.position, reach, |j, _| consider(j));
            }
        } else {
            self.buckets.within(centre, d + reach, |j, gamma| {
                // A device deeper inside the ring is too far from every point of it.
                if gamma >= d - reach {
                    consider(j);
                }
            });
        }
        let (_, gain, device) = best?;
        self.exclude(device);
        Some((device, gain))
    }

    /// Returns the possible epicentres with weights that sum to 1; empty before the first report.
    pub fn weighted_points(&self) -> Vec<WeightedPoint> {
        let weight_sum: f64 = self.points.iter().map(|point| point.weight).sum();
        let with_share = |point: &RingPoint| WeightedPoint {
            x: point.position.x as f32,
            y: point.position.y as f32,
            share: (point.weight / weight_sum) as f32,
        };
        self.points.iter().map(with_share).collect()
    }

    /// Returns the largest distance from the event at which a report can still add to `information`, metres.
    fn max_useful_distance(&self, information: f64) -> f64 {
        let Sensing { d_max, .. } = self.sensing;
        let can_add = |d: f64| self.sensing.fuse(information, self.sensing.information(d)) > information;
        match self.sensing.distance(information) {
            // With g = max, a report from the distance of the best report so far adds nothing.
            Some(d) if !can_add(d) => d.min(d_max),
            Some(_) | None => d_max,
        }
    }

    /// Returns the gain from a device at `position`, and the weight of points too far from it, both as weighted sums
    /// over the points.
    fn gain_and_missed_weight(&self, position: Point, information: f64) -> (f64, f64) {
        let Sensing { d_max, eta, psi, .. } = self.sensing;
        let (mut gain, mut missed_weight) = (0.0, 0.0);
        for point in &self.points {
            let d = point.position.distance(position);
            if d > d_max {
                missed_weight += point.weight;
            } else {
                let report_information = psi * exp_negative(eta * d);
                gain += point.weight * (self.sensing.fuse(information, report_information) - information);
            }
        }
        (gain, missed_weight)
    }

    fn exclude(&mut self, device: DeviceId) {
        if !self.is_excluded[device.index()] {
            self.is_excluded[device.index()] = true;
            self.excluded.push(device);
        }
    }

    fn ring_points(&self, centre: Point, d: f64) -> Vec<RingPoint> {
        let point_at = |(cosine, sine): &(f64, f64)| Point::new(centre.x + d * cosine, centre.y + d * sine);
        let positions_inside = self
            .directions
            .iter()
            .map(point_at)
            .filter(|&position| self.area.contains(position));
        let inside: Vec<RingPoint> = positions_inside
            .map(|position| RingPoint::new(position, ScaledLikelihood::CERTAIN))
            .collect();
        if inside.is_empty() {
            // In a very small area the ring can pass between its points.
            vec![RingPoint::new(centre, ScaledLikelihood::CERTAIN)]
        } else {
            inside
        }
    }

    /// Keeps the points where the first ring meets the ring around `centre`.
    fn intersect_rings(&mut self, centre: Point, d: f64, prior: impl Fn(Point) -> f64) {
        let (first_centre, first_d) = self.rings[0];
        let gamma = first_centre.distance(centre);
        let (east, north) = ((centre.x - first_centre.x) / gamma, (centre.y - first_centre.y) / gamma);
        let along = (gamma * gamma + first_d * first_d - d * d) / (2.0 * gamma);
        // Where the rings only touch, rounding can make the square negative.
        let across = (first_d * first_d - along * along).max(0.0).sqrt();
        let slack = RING_TOLERANCE * self.sensing.d_max;
        let intersections = [across, -across].map(|across| {
            Point::new(
                first_centre.x + along * east - across * north,
                first_centre.y + along * north + across * east,
            )
        });
        let is_in_area = |p: Point| {
            (-slack..=self.area.width + slack).contains(&p.x) && (-slack..=self.area.height + slack).contains(&p.y)
        };
        let points: Vec<RingPoint> = intersections
            .into_iter()
            .filter(|&position| is_in_area(position))
            .map(|position| RingPoint::new(position, self.likelihood_of(position, prior(position))))
            .collect();
        // If both points lie outside the area, the reports contradict each other, and the first ring remains.
        if !points.is_empty() {
            self.points = points;
            self.update_weights();
        }
    }

    /// Keeps the points on the ring around `centre`, or else the nearest one.
    fn keep_points_on_ring(&mut self, centre: Point, d: f64) {
        let ring_error = |point: &RingPoint| (point.position.distance(centre) - d).abs();
        let min_error = self.points.iter().map(ring_error).fold(f64::INFINITY, f64::min);
        let limit = min_error + RING_TOLERANCE * self.sensing.d_max;
        self.points.retain(|point| ring_error(point) <= limit);
        self.update_weights();
    }

    /// Returns the relative likelihood of an event at `position`, given the devices without a report and the relative
    /// density `prior`.
    fn likelihood_of(&self, position: Point, prior: f64) -> ScaledLikelihood {
        let Sensing { d_max, .. } = self.sensing;
        let factor_of = |device: &Point| {
            let d = device.distance(position);
            if d > d_max {
                return 1.0;
            }
            match self.sensing.kind {
                DetectionKind::Range => self.silence_factor,
                DetectionKind::Probabilistic => 1.0 - (1.0 - self.silence_factor) * self.sensing.p(d),
            }
        };
        let ruled_out = self
            .far_devices
            .iter()
            .filter(|device| device.distance(position) <= d_max);
        let factors = self
            .silent_devices
            .iter()
            .map(factor_of)
            .chain(ruled_out.map(|_| RULED_OUT_FACTOR));
        factors.fold(ScaledLikelihood::CERTAIN.times(prior), ScaledLikelihood::times)
    }
}

/// Returns the relative prior density of the epicentre at a point: the same everywhere.
pub fn uniform_prior(_point: Point) -> f64 {
    1.0
}

/// Returns cos φ and sin φ of the `i`-th point on a ring.
fn direction(i: usize) -> (f64, f64) {
    let phi = TAU * i as f64 / POINTS_PER_RING as f64;
    (libm::cos(phi), libm::sin(phi))
}

#[cfg(test)]
mod tests;
