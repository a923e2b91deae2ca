//! A belief over the epicentre of an event.
//!
//! A report determines the distance to the event, so the epicentre lies on a ring around the reporter. The ring is held
//! as a set of points. A second report leaves the two points where the rings meet, and a third report leaves one of
//! them. A silent device in S1 makes the points in its range unlikely.

use std::cmp::Ordering;
use std::f64::consts::TAU;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::message::WeightedPoint;
use reveille_common::sensing::{DetectionKind, Sensing};

use super::correlation::decay;

/// Points on a ring before weighting (`FINE`). `KEPT` limits the likely points, and separately the unlikely points,
/// kept after it.
const FINE: usize = 512;
const KEPT: usize = 32;
/// Weight of a point in range of a device that should have detected an event there but did not report. The device may
/// have failed.
const SILENCE: f64 = 0.02;
/// Weight of a point in range of a woken device that found the event beyond d_max. It is not 0, so that points still
/// differ if all are ruled out.
const RULED_OUT: f64 = 1e-12;
/// Largest distance from a ring at which a point counts as on it, metres per metre of d_max.
const TOLERANCE: f64 = 1e-6;

/// A belief over the epicentre of one event at a time, with the devices ranked by their expected gain.
#[derive(Clone, Debug)]
pub struct EpicentreBelief {
    sensing: Sensing,
    /// Cost of a failed wake-up, in units of information.
    miss_cost: f64,
    /// Weight of a point in range of a silent device that should have detected an event there.
    silence: f64,
    area: Area,
    positions: Vec<Point>,
    buckets: Buckets,
    places: Vec<RingPoint>,
    /// Positions of the reporters and their distances from the event.
    rings: Vec<(Point, f64)>,
    /// Devices in S1 that did not report.
    silent: Vec<Point>,
    /// Woken devices that are farther than d_max from the event.
    out_of_range: Vec<Point>,
    is_given_out: Vec<bool>,
    proposed: Vec<DeviceId>,
    /// cos φ and sin φ of the points on a ring.
    circle: Box<[(f64, f64)]>,
}

#[derive(Clone, Copy, Debug)]
struct RingPoint {
    at: Point,
    likelihood: Likelihood,
    /// The likelihood in units of [`STEP`] to the power of the least number of steps of any point.
    weight: f64,
}

/// A product of factors below 1 that may be too small for a floating-point number.
#[derive(Clone, Copy, Debug)]
struct Likelihood {
    /// Value in units of [`STEP`] to the power of `steps`. It is at least [`STEP`] and not much above 1.
    value: f64,
    steps: u32,
}

/// 2⁻⁵¹²; multiplication by a power of two is exact.
const STEP: f64 = 1.0 / (TWO_TO_256 * TWO_TO_256);
const TWO_TO_256: f64 = TWO_TO_128 * TWO_TO_128;
const TWO_TO_128: f64 = (1_u128 << 127) as f64 * 2.0;

impl Likelihood {
    const CERTAIN: Self = Self { value: 1.0, steps: 0 };

    /// Multiplies the likelihood by `factor`, which is at least [`STEP`].
    fn times(self, factor: f64) -> Self {
        let Self { value, steps } = self;
        // One step is enough, since neither the value nor the factor is below `STEP`.
        let value = value * factor;
        if value < STEP {
            Self {
                value: value / STEP,
                steps: steps + 1,
            }
        } else {
            Self { value, steps }
        }
    }
}

impl RingPoint {
    const fn new(at: Point, likelihood: Likelihood) -> Self {
        Self {
            at,
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
            silence: SILENCE,
            area,
            buckets: Buckets::new(positions, area, sensing.d_max),
            is_given_out: vec![false; positions.len()],
            positions: positions.to_vec(),
            places: Vec::new(),
            rings: Vec::new(),
            silent: Vec::new(),
            out_of_range: Vec::new(),
            proposed: Vec::new(),
            circle: (0..FINE).map(direction).collect(),
        }
    }

    /// Sets the cost of waking a device farther than d_max from the event: `miss_cost`, ≥ 0, in units of information.
    /// It affects only the comparison of devices.
    #[must_use]
    pub(crate) fn with_miss_cost(self, miss_cost: f64) -> Self {
        Self { miss_cost, ..self }
    }

    /// Sets the probability that the radio silences a device that should have reported: `lost`, `[0, 1]`.
    #[must_use]
    pub(crate) fn with_loss(self, lost: f64) -> Self {
        Self {
            // The device failed, or it worked and the radio lost its report.
            silence: SILENCE + (1.0 - SILENCE) * lost,
            ..self
        }
    }

    /// Begins an event.
    pub fn start(&mut self) {
        self.places.clear();
        self.rings.clear();
        self.silent.clear();
        self.out_of_range.clear();
        for device in self.proposed.drain(..) {
            self.is_given_out[device.index()] = false;
        }
    }

    /// Adds the report of `device` at distance `d` from the event, 0 ..= d_max. `prior` is the relative density of the
    /// epicentre before any report; see [`uniform_prior`].
    pub(crate) fn add_reporter(&mut self, device: DeviceId, d: f64, prior: impl Fn(Point) -> f64) {
        let at = self.positions[device.index()];
        let slack = TOLERANCE * self.sensing.d_max;
        // A second device at the same position adds no ring, and `meet` cannot divide by a distance of 0.
        if self.rings.iter().all(|(centre, _)| centre.distance(at) > slack) {
            match self.rings.len() {
                0 => self.places = self.ring_points(at, d),
                1 => self.meet(at, d, prior),
                _ => self.keep_nearest(at, d),
            }
            self.rings.push((at, d));
        }
        self.take_out(device);
    }

    /// Records that the woken `device` reported a distance above d_max.
    pub(crate) fn add_far(&mut self, device: DeviceId) {
        let at = self.positions[device.index()];
        for place in &mut self.places {
            if place.at.distance(at) <= self.sensing.d_max {
                place.likelihood = place.likelihood.times(RULED_OUT);
            }
        }
        // Kept, since a later report creates new points, which must be ruled out as well.
        self.out_of_range.push(at);
        self.weigh();
    }

    /// Applies the silence of devices in S1 (`is_sensing`) that could have reported. Call it once, after the first
    /// reports. `prior` as in `EpicentreBelief::add_reporter`.
    pub fn observe_silence(&mut self, is_sensing: impl Fn(DeviceId) -> bool, prior: impl Fn(Point) -> f64) {
        let Some(&(centre, d)) = self.rings.first() else { return };
        let Self {
            buckets,
            positions,
            silent,
            is_given_out,
            sensing,
            ..
        } = self;
        let mut found = Vec::new();
        // A device farther away reaches no point on the ring.
        buckets.within(centre, d + sensing.d_max, |j, _| {
            if !is_given_out[j] && is_sensing(DeviceId(j as u32)) {
                found.push(j);
            }
        });
        // The likelihood is a rounded product, so its factors need one order.
        found.sort_unstable();
        silent.extend(found.into_iter().map(|j| positions[j]));
        let weigh = |place: &RingPoint| self.likelihood_of(place.at, prior(place.at));
        let likelihoods: Vec<Likelihood> = self.places.iter().map(weigh).collect();
        for (place, likelihood) in self.places.iter_mut().zip(likelihoods) {
            place.likelihood = likelihood;
        }
        self.weigh();
        self.thin();
    }

    /// Computes the relative weights of the points. A point 2⁵¹² times less likely than another may get weight 0.
    fn weigh(&mut self) {
        let least = self
            .places
            .iter()
            .map(|place| place.likelihood.steps)
            .min()
            .unwrap_or(0);
        for place in &mut self.places {
            let Likelihood { value, steps } = place.likelihood;
            place.weight = match steps - least {
                0 => value,
                1 => value * STEP,
                _ => 0.0,
            };
        }
    }

    /// Reduces the number of points. Among the likely points, and among the others, it keeps every n-th point, which
    /// then stands for the points dropped.
    fn thin(&mut self) {
        let most = self.places.iter().map(|place| place.weight).fold(0.0, f64::max);
        let is_likely = |place: &RingPoint| place.weight > 0.5 * most;
        let likely = self.places.iter().filter(|place| is_likely(place)).count();
        // A class without points gets a stride of 1, since the stride divides below.
        let strides = [self.places.len() - likely, likely].map(|count| count.div_ceil(KEPT).max(1));
        let mut seen = [0; 2];
        self.places.retain_mut(|place| {
            let class = usize::from(is_likely(place));
            let turn = seen[class];
            seen[class] += 1;
            place.likelihood.value *= strides[class] as f64;
            turn % strides[class] == strides[class] / 2
        });
        self.weigh();
    }

    /// Returns the device with the largest expected gain less the cost of a failed wake-up, and its gain alone. Only
    /// devices for which `is_candidate` holds and that were not returned for this event count. `information` is Î. Ties
    /// go to the lower number. `None` if no device has a gain.
    pub fn next(&mut self, information: f64, is_candidate: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        let &(centre, d) = self.rings.first()?;
        // Never 0: a point with the fewest steps has its value as weight, which is at least `STEP`.
        let sum: f64 = self.places.iter().map(|place| place.weight).sum();
        let mut best: Option<(f64, f64, DeviceId)> = None;
        let mut consider = |j: usize| {
            let device = DeviceId(j as u32);
            if self.is_given_out[j] || !is_candidate(device) {
                return;
            }
            let (gain, missed) = self.outlook(self.positions[j], information);
            let (gain, score) = (gain / sum, (gain - self.miss_cost * missed) / sum);
            let is_better = best.is_none_or(|(most, _, first)| match score.total_cmp(&most) {
                Ordering::Greater => true,
                Ordering::Equal => device < first,
                Ordering::Less => false,
            });
            if gain > 0.0 && is_better {
                best = Some((score, gain, device));
            }
        };
        let reach = self.reach(information);
        // With two points left, far fewer devices are near them than near the ring. A device found twice changes
        // nothing.
        if self.places.len() <= 2 {
            for place in &self.places {
                self.buckets.within(place.at, reach, |j, _| consider(j));
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
        self.take_out(device);
        Some((device, gain))
    }

    /// Returns the possible epicentres with weights that sum to 1; empty before the first report.
    pub fn shares(&self) -> Vec<WeightedPoint> {
        let sum: f64 = self.places.iter().map(|place| place.weight).sum();
        let likely = |place: &RingPoint| WeightedPoint {
            x: place.at.x as f32,
            y: place.at.y as f32,
            share: (place.weight / sum) as f32,
        };
        self.places.iter().map(likely).collect()
    }

    /// Returns the largest distance from the event at which a device can add to `information`, metres.
    fn reach(&self, information: f64) -> f64 {
        let Sensing { d_max, .. } = self.sensing;
        let can_add = |d: f64| self.sensing.fuse(information, self.sensing.information(d)) > information;
        match self.sensing.distance(information) {
            // With g = max, a report from the distance of the best report so far adds nothing.
            Some(d) if !can_add(d) => d.min(d_max),
            Some(_) | None => d_max,
        }
    }

    /// Returns the gain from a device at `at`, and the weight of points too far from it, both as weighted sums over the
    /// points.
    fn outlook(&self, at: Point, information: f64) -> (f64, f64) {
        let Sensing { d_max, eta, psi, .. } = self.sensing;
        let (mut gain, mut missed) = (0.0, 0.0);
        for place in &self.places {
            let d = place.at.distance(at);
            if d > d_max {
                missed += place.weight;
            } else {
                let report = psi * decay(eta * d);
                gain += place.weight * (self.sensing.fuse(information, report) - information);
            }
        }
        (gain, missed)
    }

    fn take_out(&mut self, device: DeviceId) {
        if !self.is_given_out[device.index()] {
            self.is_given_out[device.index()] = true;
            self.proposed.push(device);
        }
    }

    /// Returns the points on the ring around `centre` that lie in the area.
    fn ring_points(&self, centre: Point, d: f64) -> Vec<RingPoint> {
        let place = |(cosine, sine): &(f64, f64)| Point::new(centre.x + d * cosine, centre.y + d * sine);
        let all = self.circle.iter().map(place).filter(|&at| self.area.contains(at));
        let inside: Vec<RingPoint> = all.map(|at| RingPoint::new(at, Likelihood::CERTAIN)).collect();
        if inside.is_empty() {
            // In a very small area the ring can pass between its points.
            vec![RingPoint::new(centre, Likelihood::CERTAIN)]
        } else {
            inside
        }
    }

    /// Keeps the points where the first ring meets the ring around `centre`.
    fn meet(&mut self, centre: Point, d: f64, prior: impl Fn(Point) -> f64) {
        let (first, d_first) = self.rings[0];
        let gamma = first.distance(centre);
        let (east, north) = ((centre.x - first.x) / gamma, (centre.y - first.y) / gamma);
        let along = (gamma * gamma + d_first * d_first - d * d) / (2.0 * gamma);
        // Where the rings only touch, rounding can make the square negative.
        let across = (d_first * d_first - along * along).max(0.0).sqrt();
        let slack = TOLERANCE * self.sensing.d_max;
        let meeting = [across, -across].map(|across| {
            Point::new(
                first.x + along * east - across * north,
                first.y + along * north + across * east,
            )
        });
        let is_near = |p: Point| {
            (-slack..=self.area.width + slack).contains(&p.x) && (-slack..=self.area.height + slack).contains(&p.y)
        };
        let places: Vec<RingPoint> = meeting
            .into_iter()
            .filter(|&at| is_near(at))
            .map(|at| RingPoint::new(at, self.likelihood_of(at, prior(at))))
            .collect();
        // If both points lie outside the area, the reports contradict each other, and the first ring remains.
        if !places.is_empty() {
            self.places = places;
            self.weigh();
        }
    }

    /// Keeps the points on the ring around `centre`, or else the nearest one.
    fn keep_nearest(&mut self, centre: Point, d: f64) {
        let off = |place: &RingPoint| (place.at.distance(centre) - d).abs();
        let least = self.places.iter().map(off).fold(f64::INFINITY, f64::min);
        let limit = least + TOLERANCE * self.sensing.d_max;
        self.places.retain(|place| off(place) <= limit);
        self.weigh();
    }

    /// Returns the relative likelihood of an event at `at`, given the devices without a report and the relative density
    /// `prior`.
    fn likelihood_of(&self, at: Point, prior: f64) -> Likelihood {
        let Sensing { d_max, .. } = self.sensing;
        let of = |device: &Point| {
            let d = device.distance(at);
            if d > d_max {
                return 1.0;
            }
            match self.sensing.kind {
                DetectionKind::Range => self.silence,
                DetectionKind::Probabilistic => 1.0 - (1.0 - self.silence) * self.sensing.p(d),
            }
        };
        let ruled_out = self.out_of_range.iter().filter(|device| device.distance(at) <= d_max);
        let factors = self.silent.iter().map(of).chain(ruled_out.map(|_| RULED_OUT));
        factors.fold(Likelihood::CERTAIN.times(prior), Likelihood::times)
    }
}

/// Returns the prior of an event that is equally likely everywhere.
pub fn uniform_prior(_: Point) -> f64 {
    1.0
}

/// Returns cos φ and sin φ of the `i`-th point on a ring.
fn direction(i: usize) -> (f64, f64) {
    let phi = TAU * i as f64 / FINE as f64;
    (libm::cos(phi), libm::sin(phi))
}

#[cfg(test)]
mod tests;
