//! A belief over the epicentre of an event, with the devices ranked by the information that they are expected to add.
//! [`WakeUpCandidates`](super::candidates::WakeUpCandidates) uses it; observers of a run receive its points. Digests
//! and frames depend on every bit, so the order of points and factors is fixed. docs/q-learning.md states the numbers
//! of points and the factor for silence. The tests next to this file are the only second computation.
//!
//! A report puts the epicentre on a ring around the reporter, held as points. A second report leaves the two points
//! where the rings meet, a third leaves one of them. A silent device in S1 makes the points in its range unlikely.

mod gains;
mod points;
mod prior;

use std::cmp::Ordering;

use pulp::NullaryFnOnce;
use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::message::WeightedPoint;
use reveille_common::sensing::{DetectionKind, Sensing};

use self::gains::GainSums;
use self::points::{Directions, RingPoints, ScaledLikelihood};
pub use self::prior::{PlacePrior, uniform_prior};

/// Points on a ring before the silence of other devices is applied.
const POINTS_PER_RING: usize = 512;
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
    points: RingPoints,
    gain_sums: GainSums,
    /// Scratch space of [`Self::next_candidate`]: devices that may be the next.
    candidates: Vec<u32>,
    /// Scratch space of [`Self::observe_silence`].
    silent_indices: Vec<u32>,
    /// Positions of the reporters and their distances from the event.
    rings: Vec<(Point, f64)>,
    /// Positions of the devices in S1 that did not report, in the order of ids.
    silent_devices: Vec<Point>,
    /// Positions of the woken devices that are farther than d_max from the event.
    far_devices: Vec<Point>,
    /// By device: whether it has reported or was returned as a candidate for this event.
    is_excluded: Vec<bool>,
    excluded: Vec<DeviceId>,
    directions: Directions,
}

/// A ring of points, by [`RingPoints::set_ring`]. This and the next types are calls, since a closure may not be inlined
/// into `VectorWidth::run`.
struct NewRing<'a> {
    points: &'a mut RingPoints,
    centre: Point,
    d: f64,
    directions: &'a Directions,
    area: Area,
}

impl NullaryFnOnce for NewRing<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.points.set_ring(self.centre, self.d, self.directions, self.area);
    }
}

/// The likelihoods of a ring of points after the silence of devices, by [`RingPoints::apply_silence`].
struct SilentRing<'a, P> {
    points: &'a mut RingPoints,
    silent_devices: &'a [Point],
    max_squared: f64,
    silence_factor: f64,
    prior: &'a P,
}

impl<P: PlacePrior> NullaryFnOnce for SilentRing<'_, P> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.points
            .apply_silence(self.silent_devices, self.max_squared, self.silence_factor, self.prior);
        self.points.update_weights();
        self.points.thin();
    }
}

/// The search for the best candidate. Candidates that occur twice change nothing.
struct BestCandidate<'a> {
    candidates: &'a [u32],
    positions: &'a [Point],
    gain_sums: &'a GainSums,
    /// Sum of the weights of all points.
    weight_sum: f64,
    miss_cost: f64,
}

impl NullaryFnOnce for BestCandidate<'_> {
    type Output = Option<(DeviceId, f64)>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        // Score, gain and device.
        let mut best: Option<(f64, f64, DeviceId)> = None;
        for &j in self.candidates {
            let device = DeviceId(j);
            let (gain, missed_weight) = self.gain_sums.gain_and_missed_weight(self.positions[j as usize]);
            let score = (gain - self.miss_cost * missed_weight) / self.weight_sum;
            let gain = gain / self.weight_sum;
            let is_better = best.is_none_or(|(best_score, _, best_device)| match score.total_cmp(&best_score) {
                Ordering::Greater => true,
                Ordering::Equal => device < best_device,
                Ordering::Less => false,
            });
            if gain > 0.0 && is_better {
                best = Some((score, gain, device));
            }
        }
        best.map(|(_, gain, device)| (device, gain))
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
            points: RingPoints::default(),
            gain_sums: GainSums::new(sensing),
            candidates: Vec::new(),
            silent_indices: Vec::new(),
            rings: Vec::new(),
            silent_devices: Vec::new(),
            far_devices: Vec::new(),
            excluded: Vec::new(),
            directions: Directions::new(POINTS_PER_RING),
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
    /// epicentre before any report, at least 2⁻⁵¹²; see [`uniform_prior`].
    pub(crate) fn add_reporter(&mut self, device: DeviceId, d: f64, prior: &impl PlacePrior) {
        let position = self.positions[device.index()];
        let slack = RING_TOLERANCE * self.sensing.d_max;
        // A second device at the same position adds no ring, and `intersect_rings` cannot divide by a distance of 0.
        if self.rings.iter().all(|(centre, _)| centre.distance(position) > slack) {
            match self.rings.len() {
                0 => self.set_ring(position, d),
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
        let d_max = self.sensing.d_max;
        self.points
            .multiply_where(|point| point.distance(position) <= d_max, RULED_OUT_FACTOR);
        // Kept, since a later report creates new points, which must be ruled out as well.
        self.far_devices.push(position);
    }

    /// Applies the silence of the devices for which `could_report` holds: in S1, with energy for a report. Call it
    /// once, after the first reports. `prior` as in `EpicentreBelief::add_reporter`.
    pub fn observe_silence(&mut self, could_report: impl Fn(DeviceId) -> bool, prior: &impl PlacePrior) {
        let Some(&(centre, d)) = self.rings.first() else { return };
        let Self {
            buckets,
            positions,
            silent_devices,
            silent_indices,
            is_excluded,
            sensing,
            ..
        } = self;
        silent_indices.clear();
        // A device farther away reaches no point on the ring.
        buckets.within(centre, d + sensing.d_max, |j, _| {
            if !is_excluded[j] && could_report(DeviceId(j as u32)) {
                silent_indices.push(j as u32);
            }
        });
        // The likelihood is a rounded product, so its factors need one order.
        silent_indices.sort_unstable();
        silent_devices.extend(silent_indices.iter().map(|j| positions[*j as usize]));
        if sensing.kind == DetectionKind::Range && self.far_devices.is_empty() {
            // All factors are equal, so their number is enough.
            self.gain_sums.vector_width().run(SilentRing {
                points: &mut self.points,
                silent_devices: &self.silent_devices,
                max_squared: self.gain_sums.max_squared(),
                silence_factor: self.silence_factor,
                prior,
            });
        } else {
            let mut points = std::mem::take(&mut self.points);
            points.set_likelihoods(|point| self.likelihood_of(point, prior.density_at(point)));
            points.thin();
            self.points = points;
        }
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
        let reach = self.max_useful_distance(information);
        let Self {
            points,
            buckets,
            candidates,
            is_excluded,
            gain_sums,
            positions,
            miss_cost,
            ..
        } = self;
        candidates.clear();
        let mut consider = |j: usize| {
            if !is_excluded[j] && is_candidate(DeviceId(j as u32)) {
                candidates.push(j as u32);
            }
        };
        // With two points left, far fewer devices are near them than near the ring. A device may be found twice.
        if points.len() <= 2 {
            for point in points.positions() {
                buckets.within(point, reach, |j, _| consider(j));
            }
        } else {
            buckets.within(centre, d + reach, |j, gamma| {
                // A device deeper inside the ring is too far from every point of it.
                if gamma >= d - reach {
                    consider(j);
                }
            });
        }
        gain_sums.prepare(points, information, reach, *miss_cost > 0.0);
        let (device, gain) = gain_sums.vector_width().run(BestCandidate {
            candidates,
            positions,
            gain_sums,
            // Never 0: a point with the fewest steps has its value as weight, which is at least 2⁻⁵¹².
            weight_sum: points.weights().iter().sum(),
            miss_cost: *miss_cost,
        })?;
        self.exclude(device);
        Some((device, gain))
    }

    /// Returns the possible epicentres with weights that sum to 1; empty before the first report.
    pub fn weighted_points(&self) -> Vec<WeightedPoint> {
        let weight_sum: f64 = self.points.weights().iter().sum();
        let with_share = |(position, weight): (Point, &f64)| WeightedPoint {
            x: position.x as f32,
            y: position.y as f32,
            share: (weight / weight_sum) as f32,
        };
        self.points
            .positions()
            .zip(self.points.weights())
            .map(with_share)
            .collect()
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

    fn exclude(&mut self, device: DeviceId) {
        if !self.is_excluded[device.index()] {
            self.is_excluded[device.index()] = true;
            self.excluded.push(device);
        }
    }

    /// Takes the points on the ring around `centre`.
    fn set_ring(&mut self, centre: Point, d: f64) {
        self.gain_sums.vector_width().run(NewRing {
            points: &mut self.points,
            centre,
            d,
            directions: &self.directions,
            area: self.area,
        });
        if self.points.len() == 0 {
            // In a very small area the ring can pass between its points.
            self.points.push(centre, ScaledLikelihood::CERTAIN);
        }
    }

    /// Keeps the points where the first ring meets the ring around `centre`.
    fn intersect_rings(&mut self, centre: Point, d: f64, prior: &impl PlacePrior) {
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
        // If both points lie outside the area, the reports contradict each other, and the first ring remains.
        if !intersections.iter().copied().any(is_in_area) {
            return;
        }
        self.points.clear();
        for position in intersections.into_iter().filter(|&position| is_in_area(position)) {
            let likelihood = self.likelihood_of(position, prior.density_at(position));
            self.points.push(position, likelihood);
        }
        self.points.update_weights();
    }

    /// Keeps the points on the ring around `centre`, or else the nearest one.
    fn keep_points_on_ring(&mut self, centre: Point, d: f64) {
        let ring_error = |point: Point| (point.distance(centre) - d).abs();
        let min_error = self.points.positions().map(ring_error).fold(f64::INFINITY, f64::min);
        let limit = min_error + RING_TOLERANCE * self.sensing.d_max;
        self.points.retain(|point| ring_error(point) <= limit);
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

#[cfg(test)]
mod tests;
