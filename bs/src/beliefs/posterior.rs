//! Where the event may be: a belief over its epicentre.
//!
//! A report tells how far the event is from the reporter, and so puts it on a ring; the ring is held as places, as many
//! as are likely at all. A second report leaves the two points where two rings meet, a third one of them. A device in
//! S1 that is silent was hardly within reach.

use std::cmp::Ordering;
use std::f64::consts::TAU;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
use reveille_common::message::Likely;
use reveille_common::sensing::{DetectionKind, Sensing};

use crate::beliefs::correlation::decay;

/// Places on a ring before it is known which of them are likely, and the most that are kept of the likely and of the
/// others.
const FINE: usize = 512;
const KEPT: usize = 32;
/// The weight of a place within reach of a device that should have detected an event there and did not report: it may
/// have failed to.
const SILENCE: f64 = 0.02;
/// The weight of a place within reach of a device that was woken and found it farther than d_max: none, but for what
/// keeps weights apart if all places are ruled out.
const RULED_OUT: f64 = 1e-12;
/// How far from a ring a place may lie and still be on it, metres per metre of d_max.
const TOLERANCE: f64 = 1e-6;

/// A belief over the epicentre of one event after another, and the devices ranked by what they would add.
#[derive(Clone, Debug)]
pub struct Belief {
    sensing: Sensing,
    /// What a wake-up in vain counts as a loss of, information.
    in_vain: f64,
    /// The weight of a place within reach of a device that should have detected an event there and is silent.
    silence: f64,
    area: Area,
    positions: Vec<Point>,
    buckets: Buckets,
    places: Vec<Place>,
    /// The reports: where from, and the distance to the event.
    rings: Vec<(Point, f64)>,
    /// Devices in S1 that did not report.
    silent: Vec<Point>,
    /// Devices that were woken and are farther than d_max.
    far: Vec<Point>,
    is_given_out: Vec<bool>,
    given_out: Vec<DeviceId>,
    /// cos φ and sin φ of the places on a ring.
    circle: Box<[(f64, f64)]>,
}

#[derive(Clone, Copy, Debug)]
struct Place {
    at: Point,
    likelihood: Likelihood,
    /// Its likelihood in units of [`STEP`] to the power of the least number of steps of any place.
    weight: f64,
}

/// A product of so many factors below 1 that no floating-point number may hold it.
#[derive(Clone, Copy, Debug)]
struct Likelihood {
    /// In units of [`STEP`] to the power of `steps`. [`STEP`] at the least, and not much above 1.
    value: f64,
    steps: u32,
}

/// 2⁻⁵¹²: multiplying by a power of two rounds nothing.
const STEP: f64 = 1.0 / (TWO_TO_256 * TWO_TO_256);
const TWO_TO_256: f64 = TWO_TO_128 * TWO_TO_128;
const TWO_TO_128: f64 = (1_u128 << 127) as f64 * 2.0;

impl Likelihood {
    const CERTAIN: Self = Self { value: 1.0, steps: 0 };

    /// The likelihood times `factor`, which is at least [`STEP`].
    fn times(self, factor: f64) -> Self {
        let Self { value, steps } = self;
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

impl Place {
    const fn new(at: Point, likelihood: Likelihood) -> Self {
        Self {
            at,
            likelihood,
            weight: 1.0,
        }
    }
}

impl Belief {
    /// No event yet, among the devices at `positions`.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        Self {
            sensing: sensing.clone(),
            in_vain: 0.0,
            silence: SILENCE,
            area,
            buckets: Buckets::new(positions, area, sensing.d_max),
            is_given_out: vec![false; positions.len()],
            positions: positions.to_vec(),
            places: Vec::new(),
            rings: Vec::new(),
            silent: Vec::new(),
            far: Vec::new(),
            given_out: Vec::new(),
            circle: (0..FINE).map(direction).collect(),
        }
    }

    /// As before, where waking a device that is farther than d_max from the event counts as a loss of `in_vain`, ≥ 0,
    /// information when devices are compared.
    #[must_use]
    pub fn charging(self, in_vain: f64) -> Self {
        Self { in_vain, ..self }
    }

    /// As before, where the radio keeps a device that should have reported silent with probability `lost`, `[0, 1]`.
    #[must_use]
    pub fn losing(self, lost: f64) -> Self {
        Self {
            silence: SILENCE + (1.0 - SILENCE) * lost,
            ..self
        }
    }

    /// Begins an event.
    pub fn start(&mut self) {
        self.places.clear();
        self.rings.clear();
        self.silent.clear();
        self.far.clear();
        for device in self.given_out.drain(..) {
            self.is_given_out[device.index()] = false;
        }
    }

    /// `device` has reported an event `d` metres away, 0 ..= d_max. `prior` tells how likely an event at a place is
    /// before anything is heard of it, up to a factor; see [`evenly`].
    pub fn add_reporter(&mut self, device: DeviceId, d: f64, prior: impl Fn(Point) -> f64) {
        let at = self.positions[device.index()];
        let slack = TOLERANCE * self.sensing.d_max;
        // Two devices at one place tell the same.
        if self.rings.iter().all(|(centre, _)| centre.distance(at) > slack) {
            match self.rings.len() {
                0 => self.places = self.ring(at, d),
                1 => self.meet(at, d, prior),
                _ => self.keep_nearest(at, d),
            }
            self.rings.push((at, d));
        }
        self.take_out(device);
    }

    /// `device`, woken, has reported that the event is farther than d_max.
    pub fn add_far(&mut self, device: DeviceId) {
        let at = self.positions[device.index()];
        for place in &mut self.places {
            if place.at.distance(at) <= self.sensing.d_max {
                place.likelihood = place.likelihood.times(RULED_OUT);
            }
        }
        self.far.push(at);
        self.weigh();
    }

    /// Weighs the devices in S1, those for which `is_sensing` holds, that could have reported and did not. To be called
    /// once, after the first reports. `prior` as in [`Belief::add_reporter`].
    pub fn hear_silence(&mut self, is_sensing: impl Fn(DeviceId) -> bool, prior: impl Fn(Point) -> f64) {
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
        buckets.within(centre, d + sensing.d_max, |j, _| {
            if !is_given_out[j] && is_sensing(DeviceId(j as u32)) {
                found.push(j);
            }
        });
        found.sort_unstable();
        silent.extend(found.into_iter().map(|j| positions[j]));
        let weigh = |place: &Place| self.likelihood_of(place.at, prior(place.at));
        let likelihoods: Vec<Likelihood> = self.places.iter().map(weigh).collect();
        for (place, likelihood) in self.places.iter_mut().zip(likelihoods) {
            place.likelihood = likelihood;
        }
        self.weigh();
        self.thin();
    }

    /// Weighs the places against each other. One that is 2⁵¹² times less likely than another may well have no weight.
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

    /// Keeps few of the places: of those that are likely, and of those that are not, one in so many, which then stands
    /// for those left out.
    fn thin(&mut self) {
        let most = self.places.iter().map(|place| place.weight).fold(0.0, f64::max);
        let is_likely = |place: &Place| place.weight > 0.5 * most;
        let likely = self.places.iter().filter(|place| is_likely(place)).count();
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

    /// Gives out the device with the largest expected gain, less what it loses in vain, among those for which
    /// `is_candidate` holds and that were not given out, with that gain alone, if any gains at all; `information` is Î.
    /// Ties go to the lower number.
    pub fn next(&mut self, information: f64, is_candidate: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        let &(centre, d) = self.rings.first()?;
        let sum: f64 = self.places.iter().map(|place| place.weight).sum();
        let mut best: Option<(f64, f64, DeviceId)> = None;
        let mut consider = |j: usize| {
            let device = DeviceId(j as u32);
            if self.is_given_out[j] || !is_candidate(device) {
                return;
            }
            let (gain, missed) = self.outlook(self.positions[j], information);
            let (gain, score) = (gain / sum, (gain - self.in_vain * missed) / sum);
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
        if self.places.len() <= 2 {
            for place in &self.places {
                self.buckets.within(place.at, reach, |j, _| consider(j));
            }
        } else {
            self.buckets.within(centre, d + reach, |j, gamma| {
                if gamma >= d - reach {
                    consider(j);
                }
            });
        }
        let (_, gain, device) = best?;
        self.take_out(device);
        Some((device, gain))
    }

    /// The places that the event may be at, with shares whose sum is 1; none before the first report.
    pub fn shares(&self) -> Vec<Likely> {
        let sum: f64 = self.places.iter().map(|place| place.weight).sum();
        let likely = |place: &Place| Likely {
            x: place.at.x as f32,
            y: place.at.y as f32,
            share: (place.weight / sum) as f32,
        };
        self.places.iter().map(likely).collect()
    }

    /// How near to the event a device has to be to add to `information`, metres.
    fn reach(&self, information: f64) -> f64 {
        let Sensing { d_max, .. } = self.sensing;
        let can_add = |d: f64| self.sensing.fuse(information, self.sensing.information(d)) > information;
        match self.sensing.distance(information) {
            // A report from as far as the best so far adds nothing where only the largest counts.
            Some(d) if !can_add(d) => d.min(d_max),
            Some(_) | None => d_max,
        }
    }

    /// The gain from a device at `at`, and the weight of places too far from it, both summed over the places by their
    /// weights.
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
            self.given_out.push(device);
        }
    }

    /// Places on the ring around `centre`, in the area.
    fn ring(&self, centre: Point, d: f64) -> Vec<Place> {
        let place = |(cosine, sine): &(f64, f64)| Point::new(centre.x + d * cosine, centre.y + d * sine);
        let all = self.circle.iter().map(place).filter(|&at| self.area.contains(at));
        let inside: Vec<Place> = all.map(|at| Place::new(at, Likelihood::CERTAIN)).collect();
        if inside.is_empty() {
            // An area so small that the ring passes between its places.
            vec![Place::new(centre, Likelihood::CERTAIN)]
        } else {
            inside
        }
    }

    /// The points where the first ring meets the one around `centre`.
    fn meet(&mut self, centre: Point, d: f64, prior: impl Fn(Point) -> f64) {
        let (first, d_first) = self.rings[0];
        let gamma = first.distance(centre);
        let (east, north) = ((centre.x - first.x) / gamma, (centre.y - first.y) / gamma);
        let along = (gamma * gamma + d_first * d_first - d * d) / (2.0 * gamma);
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
        let places: Vec<Place> = meeting
            .into_iter()
            .filter(|&at| is_near(at))
            .map(|at| Place::new(at, self.likelihood_of(at, prior(at))))
            .collect();
        if !places.is_empty() {
            self.places = places;
            self.weigh();
        }
    }

    /// Keeps the places that are on the ring around `centre`, or else the one nearest to it.
    fn keep_nearest(&mut self, centre: Point, d: f64) {
        let off = |place: &Place| (place.at.distance(centre) - d).abs();
        let least = self.places.iter().map(off).fold(f64::INFINITY, f64::min);
        let limit = least + TOLERANCE * self.sensing.d_max;
        self.places.retain(|place| off(place) <= limit);
        self.weigh();
    }

    /// How likely those who did not report make an event at `at`, up to a factor, if it was as likely as `prior`
    /// before.
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
        let ruled_out = self.far.iter().filter(|device| device.distance(at) <= d_max);
        let factors = self.silent.iter().map(of).chain(ruled_out.map(|_| RULED_OUT));
        factors.fold(Likelihood::CERTAIN.times(prior), Likelihood::times)
    }
}

/// The prior of an event that may be anywhere.
pub fn evenly(_: Point) -> f64 {
    1.0
}

/// cos φ and sin φ of the `i`-th place on a ring.
fn direction(i: usize) -> (f64, f64) {
    let phi = TAU * i as f64 / FINE as f64;
    (libm::cos(phi), libm::sin(phi))
}

#[cfg(test)]
#[path = "posterior_tests.rs"]
mod tests;
