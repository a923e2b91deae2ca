//! Where the event may be: a belief over its epicentre.
//!
//! A report tells how far the event is from the reporter, and so puts it on a ring; the ring is held as places, as many
//! as are likely at all. A second report leaves the two points where two rings meet, a third one of them. A device in
//! S1 that is silent was hardly within reach.

use std::cmp::Ordering;
use std::f64::consts::TAU;

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;
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

    /// Gives out the device with the largest expected gain, among those for which `is_candidate` holds and that were
    /// not given out, with that gain, if any gains at all; `information` is Î. Ties go to the lower number.
    pub fn next(&mut self, information: f64, is_candidate: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        let &(centre, d) = self.rings.first()?;
        let sum: f64 = self.places.iter().map(|place| place.weight).sum();
        let mut best: Option<(f64, DeviceId)> = None;
        let mut consider = |j: usize| {
            let device = DeviceId(j as u32);
            if self.is_given_out[j] || !is_candidate(device) {
                return;
            }
            let gain = self.gain(self.positions[j], information) / sum;
            let is_better = best.is_none_or(|(most, first)| match gain.total_cmp(&most) {
                Ordering::Greater => true,
                Ordering::Equal => device < first,
                Ordering::Less => false,
            });
            if gain > 0.0 && is_better {
                best = Some((gain, device));
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
        let (gain, device) = best?;
        self.take_out(device);
        Some((device, gain))
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

    /// The gain from a device at `at`, summed over the places by their weights.
    fn gain(&self, at: Point, information: f64) -> f64 {
        let Sensing { d_max, eta, psi, .. } = self.sensing;
        let of = |place: &Place| {
            let d = place.at.distance(at);
            if d > d_max {
                return 0.0;
            }
            let report = psi * decay(eta * d);
            place.weight * (self.sensing.fuse(information, report) - information)
        };
        self.places.iter().map(of).sum()
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
                DetectionKind::Range => SILENCE,
                DetectionKind::Probabilistic => 1.0 - (1.0 - SILENCE) * self.sensing.p(d),
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
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    const AREA: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    fn sensing(g: Fusion) -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g,
        }
    }

    #[test]
    fn three_reports_find_the_event_and_then_the_closest_device() {
        let mut stream = Stream::new(3, Purpose::Epicentre, 0);
        for seed in 0..200 {
            let points = place(&Layout::Uniform, AREA, 60, seed);
            let event = Point::new(20.0 * stream.unit(), 20.0 * stream.unit());
            let mut near: Vec<usize> = (0..60).filter(|&j| points[j].distance(event) <= 4.0).collect();
            if near.len() < 5 {
                continue;
            }
            let closest = *near
                .iter()
                .min_by(|&&a, &&b| points[a].distance(event).total_cmp(&points[b].distance(event)))
                .expect("somebody");
            near.retain(|&j| j != closest);
            let sensing = sensing(Fusion::Max);
            let mut belief = Belief::new(&points, AREA, &sensing);
            belief.start();
            let mut information: f64 = 0.0;
            for &j in near.iter().rev().take(3) {
                let d = points[j].distance(event);
                belief.add_reporter(DeviceId(j as u32), d, evenly);
                information = information.max(sensing.p(d));
            }
            assert!(
                belief.places.iter().any(|p| p.at.distance(event) < 1e-5),
                "{seed}: {:?}",
                belief.places
            );
            let (next, gain) = belief.next(information, |_| true).expect("somebody adds");
            assert_eq!(next.index(), closest, "{seed}");
            let expected = sensing.p(points[closest].distance(event)) - information;
            assert!(
                belief.places.len() > 1 || (gain - expected).abs() < 1e-5,
                "{gain} {expected}"
            );
        }
    }

    #[test]
    fn the_best_candidate_is_that_of_a_plain_sum_over_the_ring() {
        for (case, g) in [
            (1, Fusion::Max),
            (2, Fusion::SumSaturation),
            (3, Fusion::Max),
            (4, Fusion::SumSaturation),
        ] {
            let points = place(&Layout::JitteredGrid, AREA, 120, case);
            let sensing = sensing(g);
            let mut belief = Belief::new(&points, AREA, &sensing);
            for (h, d) in [(5, 3.0), (60, 1.2), (119, 4.0), (33, 0.0)] {
                let is_on = |j: DeviceId| j.0.is_multiple_of(7);
                belief.start();
                belief.add_reporter(DeviceId(h), d, evenly);
                belief.hear_silence(is_on, evenly);
                let information = sensing.p(d);
                // More places, and all of them; the weights by the definition.
                let centre = points[h as usize];
                let mut gains = vec![0.0; 120];
                for j in (0..120).filter(|&j| j != h && !is_on(DeviceId(j))) {
                    let (mut gain, mut sum) = (0.0, 0.0);
                    for i in 0..2000 {
                        let phi = TAU * f64::from(i) / 2000.0;
                        let at = Point::new(centre.x + d * libm::cos(phi), centre.y + d * libm::sin(phi));
                        if !AREA.contains(at) {
                            continue;
                        }
                        let silent = (0..120)
                            .filter(|&k| k != h && is_on(DeviceId(k)))
                            .filter(|&k| points[k as usize].distance(at) <= 4.0)
                            .count();
                        let weight = libm::pow(SILENCE, silent as f64);
                        let report = sensing.information(points[j as usize].distance(at));
                        gain += weight * (sensing.fuse(information, report) - information);
                        sum += weight;
                    }
                    gains[j as usize] = gain / sum;
                }
                let most = gains.iter().copied().fold(0.0, f64::max);
                let found = belief.next(information, |j| !is_on(j));
                if most < 1e-9 {
                    assert!(found.is_none_or(|(_, gain)| gain < 1e-6));
                    continue;
                }
                // Where few places are likely, one more or less at their edge is a tenth of them.
                let (next, gain) = found.expect("somebody");
                let own = gains[next.index()];
                assert!(
                    (gain - most).abs() < 0.15 * most && own > 0.95 * most,
                    "{case} {h}: {gain} against {most}, but {next} has {own}"
                );
            }
        }
    }

    #[test]
    fn devices_at_one_place_tell_the_same_and_a_third_report_finds_the_event() {
        let mut points = place(&Layout::Uniform, AREA, 40, 9);
        let event = Point::new(9.0, 9.0);
        points[0] = Point::new(7.0, 9.5);
        points[1] = points[0];
        points[2] = Point::new(10.0, 7.0);
        points[3] = Point::new(10.5, 11.0);
        let mut belief = Belief::new(&points, AREA, &sensing(Fusion::Max));
        belief.start();
        for (j, places) in [(0, 512), (1, 512), (2, 2), (3, 1)] {
            belief.add_reporter(DeviceId(j), points[j as usize].distance(event), evenly);
            assert_eq!(belief.places.len(), places, "after {j}");
        }
        assert!(belief.places[0].at.distance(event) < 1e-5);
    }

    #[test]
    fn a_device_that_was_woken_in_vain_rules_its_reach_out() {
        let points = [Point::new(10.0, 10.0), Point::new(12.5, 10.0), Point::new(10.0, 13.0)];
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            let sensing = Sensing {
                kind,
                ..sensing(Fusion::Max)
            };
            let mut belief = Belief::new(&points, AREA, &sensing);
            belief.start();
            belief.add_reporter(DeviceId(0), 3.0, evenly);
            belief.add_far(DeviceId(1));
            let weights = |belief: &Belief| -> [f64; 2] {
                let of = |near: bool| {
                    let own = belief
                        .places
                        .iter()
                        .filter(|p| (p.at.distance(points[1]) <= 4.0) == near);
                    own.map(|place| place.weight).sum()
                };
                [of(true), of(false)]
            };
            let [near, far] = weights(&belief);
            assert!(near < 1e-9 * far && far > 0.0, "{kind:?}: {near} {far}");
            // A second ring, of two points: one within that reach, one without.
            let left = Point::new(10.0 - 3.0 * 0.8, 10.0 + 3.0 * 0.6);
            belief.add_reporter(DeviceId(2), points[2].distance(left), evenly);
            let [near, far] = weights(&belief);
            assert!(belief.places.len() == 2 && near < 1e-9 * far, "{kind:?}: {near} {far}");
        }
    }

    /// One of thousands reports, and its neighbours do not: the weights of all places are as small as they are many.
    #[test]
    fn silence_of_hundreds_does_not_end_the_wake_ups() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            let sensing = Sensing {
                kind,
                ..sensing(Fusion::Max)
            };
            let points = place(&Layout::Uniform, AREA, 12_000, 5);
            let mut belief = Belief::new(&points, AREA, &sensing);
            let (reporter, d) = (DeviceId(7), 2.5);
            let is_on = |j: DeviceId| j.0.is_multiple_of(2);
            belief.start();
            belief.add_reporter(reporter, d, evenly);
            belief.hear_silence(is_on, evenly);
            let (next, gain) = belief.next(sensing.p(d), |j| !is_on(j)).expect("somebody adds");
            // The definition, with logarithms.
            let centre = points[reporter.index()];
            let places: Vec<Point> = (0..FINE)
                .map(direction)
                .map(|(x, y)| Point::new(centre.x + d * x, centre.y + d * y))
                .filter(|&at| AREA.contains(at))
                .collect();
            let log_weight = |at: &Point| -> f64 {
                let silent = (0..12_000).map(DeviceId).filter(|&j| j != reporter && is_on(j));
                let near = silent
                    .map(|j| points[j.index()].distance(*at))
                    .filter(|&gap| gap <= 4.0);
                let heard = |gap: f64| match kind {
                    DetectionKind::Range => 1.0,
                    DetectionKind::Probabilistic => sensing.p(gap),
                };
                near.map(|gap| libm::log(1.0 - 0.98 * heard(gap))).sum()
            };
            let logs: Vec<f64> = places.iter().map(log_weight).collect();
            let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let weights: Vec<f64> = logs.iter().map(|log| libm::exp(log - most)).collect();
            let own = points[next.index()];
            let mean = |of: &dyn Fn(&Point) -> f64| {
                let sum: f64 = weights.iter().zip(&places).map(|(weight, at)| weight * of(at)).sum();
                sum / weights.iter().sum::<f64>()
            };
            let expected = mean(&|at| (sensing.information(at.distance(own)) - sensing.p(d)).max(0.0));
            // Few places stand for all where weights are so different, and by chance they are all different.
            let off = match kind {
                DetectionKind::Range => 0.02,
                DetectionKind::Probabilistic => 0.5,
            };
            assert!(
                expected > 0.0 && (gain / expected - 1.0).abs() < off,
                "{kind:?}: {gain}, not {expected}"
            );
            // A second report leaves two points, of which neither may be lost.
            let second = DeviceId(9);
            let event = places[weights.iter().position(|&weight| weight >= 1.0).expect("a largest")];
            let apart = |at: &&Point| at.distance(event);
            let other = *places
                .iter()
                .max_by(|a, b| apart(a).total_cmp(&apart(b)))
                .expect("a place");
            for at in [event, other] {
                belief.start();
                belief.add_reporter(reporter, d, evenly);
                belief.hear_silence(is_on, evenly);
                belief.add_reporter(second, points[9].distance(at), evenly);
                belief.add_reporter(DeviceId(11), points[11].distance(at), evenly);
                let found = belief.next(sensing.p(d), |j| !is_on(j)).expect("somebody adds");
                assert!(points[found.0.index()].distance(at) < 0.5, "{kind:?}: {found:?}");
            }
        }
    }

    #[test]
    fn nobody_is_given_out_twice_in_an_event() {
        let points = place(&Layout::Grid, AREA, 100, 1);
        let mut belief = Belief::new(&points, AREA, &sensing(Fusion::SumSaturation));
        for _ in 0..2 {
            belief.start();
            assert!(belief.next(0.0, |_| true).is_none(), "nothing is known");
            belief.add_reporter(DeviceId(44), 2.0, evenly);
            let mut given: Vec<u32> = std::iter::from_fn(|| belief.next(0.0, |_| true))
                .map(|(j, _)| j.0)
                .collect();
            let count = given.len();
            given.sort_unstable();
            given.dedup();
            assert!(given.len() == count && count > 20 && !given.contains(&44), "{given:?}");
        }
    }
}
