//! The belief over the epicentre against sums over the points of the plane.

use reveille_common::geometry::{Layout, place_devices};
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
        let points = place_devices(&Layout::Uniform, AREA, 60, seed);
        let event = Point::new(20.0 * stream.unit(), 20.0 * stream.unit());
        let mut near: Vec<usize> = (0..60).filter(|&j| points[j].distance(event) <= 4.0).collect();
        if near.len() < 5 {
            continue;
        }
        let closest = *near
            .iter()
            .min_by(|&&a, &&b| points[a].distance(event).total_cmp(&points[b].distance(event)))
            .expect("a device");
        near.retain(|&j| j != closest);
        let sensing = sensing(Fusion::Max);
        let mut belief = EpicentreBelief::new(&points, AREA, &sensing);
        belief.start_event();
        let mut information: f64 = 0.0;
        for &j in near.iter().rev().take(3) {
            let d = points[j].distance(event);
            belief.add_reporter(DeviceId(j as u32), d, uniform_prior);
            information = information.max(sensing.p(d));
        }
        assert!(
            belief.points.iter().any(|p| p.position.distance(event) < 1e-5),
            "{seed}: {:?}",
            belief.points
        );
        let (next, gain) = belief.next_candidate(information, |_| true).expect("a device adds");
        assert_eq!(next.index(), closest, "{seed}");
        let expected = sensing.p(points[closest].distance(event)) - information;
        assert!(
            belief.points.len() > 1 || (gain - expected).abs() < 1e-5,
            "{gain} {expected}"
        );
    }
}

/// The belief after a first report by plain sums, as docs/q-learning.md defines it. Each point on the reporter's ring
/// is weighted by the silence of the other devices in S1.
struct BeliefDefinition<'a> {
    points: &'a [Point],
    sensing: &'a Sensing,
    reporter: usize,
    d: f64,
    silent: Vec<usize>,
    /// Relative density of the epicentre before any report.
    prior: fn(Point) -> f64,
}

impl<'a> BeliefDefinition<'a> {
    /// Creates the case in which only the reporter senses.
    fn alone(points: &'a [Point], sensing: &'a Sensing, reporter: u32, d: f64) -> Self {
        Self {
            points,
            sensing,
            reporter: reporter as usize,
            d,
            silent: Vec::new(),
            prior: uniform_prior,
        }
    }

    /// Returns the points in the area, out of `count` in all directions, with their weights.
    fn places(&self, count: u32) -> Vec<(Point, f64)> {
        let centre = self.points[self.reporter];
        let on_ring = |i: u32| {
            let phi = TAU * f64::from(i) / f64::from(count);
            Point::new(centre.x + self.d * libm::cos(phi), centre.y + self.d * libm::sin(phi))
        };
        let places = (0..count).map(on_ring).filter(|&at| AREA.contains(at));
        places.map(|at| (at, self.weight(at))).collect()
    }

    /// Returns the weight of a point: one in fifty devices that should report an event at `at` fails to do so.
    fn weight(&self, at: Point) -> f64 {
        let of = |&k: &usize| {
            let gap = self.points[k].distance(at);
            let detects = match self.sensing.kind {
                _ if gap > self.sensing.d_max => 0.0,
                DetectionKind::Range => 1.0,
                DetectionKind::Probabilistic => libm::exp(-self.sensing.eta * gap),
            };
            1.0 - 0.98 * detects
        };
        (self.prior)(at) * self.silent.iter().map(of).product::<f64>()
    }

    /// Returns the probability that device `j` is farther than d_max from the event.
    fn missed(&self, places: &[(Point, f64)], j: usize) -> f64 {
        let sum_of = |is_in: &dyn Fn(Point) -> bool| {
            let weights = places.iter().filter(|(at, _)| is_in(*at)).map(|(_, weight)| weight);
            weights.sum::<f64>()
        };
        let (position, d_max) = (self.points[j], self.sensing.d_max);
        sum_of(&|at| position.distance(at) > d_max) / sum_of(&|_| true)
    }

    /// Returns the expected gain of a report of device `j` above `information`.
    fn gain(&self, places: &[(Point, f64)], j: usize, information: f64) -> f64 {
        let (mut gain, mut sum) = (0.0, 0.0);
        for &(at, weight) in places {
            let gap = self.points[j].distance(at);
            let report = if gap > self.sensing.d_max {
                0.0
            } else {
                self.sensing.psi * libm::exp(-self.sensing.eta * gap)
            };
            let fused = match self.sensing.g {
                Fusion::Max => report.max(information),
                Fusion::SumSaturation => (information + report).min(self.sensing.psi),
            };
            gain += weight * (fused - information);
            sum += weight;
        }
        gain / sum
    }
}

/// Deployments with a first report: every kind of detection and of g, reporters in the middle and at the edge.
fn first_reports() -> impl Iterator<Item = (u64, Sensing, u32, f64)> {
    let kinds = [DetectionKind::Range, DetectionKind::Probabilistic];
    let reports = [(5, 3.0), (60, 1.2), (119, 4.0), (33, 0.5)];
    (0..4_u64).flat_map(move |case| {
        let g = [Fusion::Max, Fusion::SumSaturation][case as usize % 2];
        let kind = kinds[case as usize / 2];
        reports.map(|(h, d)| (case + 1, Sensing { kind, ..sensing(g) }, h, d))
    })
}

/// Without silent devices all points of the ring are equally likely, and each counts.
#[test]
fn without_silence_gains_are_plain_sums_over_the_ring() {
    for (case, sensing, h, d) in first_reports() {
        let points = place_devices(&Layout::JitteredGrid, AREA, 120, case);
        let mut belief = EpicentreBelief::new(&points, AREA, &sensing);
        belief.start_event();
        belief.add_reporter(DeviceId(h), d, uniform_prior);
        let definition = BeliefDefinition::alone(&points, &sensing, h, d);
        let (places, information) = (definition.places(512), sensing.p(d));
        let mut left: Vec<usize> = (0..120).filter(|&j| j != h as usize).collect();
        // Devices come in descending order of gain, until no device adds anything.
        while let Some((next, gain)) = belief.next_candidate(information, |_| true) {
            let gains = left.iter().map(|&j| definition.gain(&places, j, information));
            let most = gains.fold(0.0, f64::max);
            let own = definition.gain(&places, next.index(), information);
            assert!((gain - own).abs() < 1e-12, "{case} {h}: {next} has {own}, not {gain}");
            assert!(own > most - 1e-12, "{case} {h}: {next} has {own}, another {most}");
            left.retain(|&j| j != next.index());
        }
        for &j in &left {
            let gain = definition.gain(&places, j, information);
            assert!(gain < 1e-12, "{case} {h}: {j} would add {gain}, and is left");
        }
    }
}

/// A cost of failed wake-ups orders devices by gain less cost; the gains themselves do not change.
#[test]
fn a_loss_in_vain_changes_the_order_and_no_gain() {
    let (loss, mut is_changed) = (0.3, false);
    for (case, sensing, h, d) in first_reports() {
        let points = place_devices(&Layout::JitteredGrid, AREA, 120, case);
        let mut belief = EpicentreBelief::new(&points, AREA, &sensing).with_miss_cost(loss);
        belief.start_event();
        belief.add_reporter(DeviceId(h), d, uniform_prior);
        let definition = BeliefDefinition::alone(&points, &sensing, h, d);
        let (places, information) = (definition.places(512), sensing.p(d));
        let gain = |j: usize| definition.gain(&places, j, information);
        let score = |j: usize| gain(j) - loss * definition.missed(&places, j);
        let others = || (0..120).filter(|&j| j != h as usize && gain(j) > 1e-9);
        let Some((next, told)) = belief.next_candidate(information, |_| true) else {
            assert_eq!(others().next(), None, "{case} {h}: no device");
            continue;
        };
        let best = others().map(score).fold(f64::NEG_INFINITY, f64::max);
        assert!(score(next.index()) > best - 1e-12, "{case} {h}: {next}");
        assert!((told - gain(next.index())).abs() < 1e-12, "{case} {h}: {told}");
        is_changed |= others().map(gain).fold(0.0, f64::max) > told + 1e-9;
    }
    assert!(is_changed, "nowhere is another the surest");
}

/// The weights match the definition. The few points kept give an unbiased gain with a small error.
#[test]
fn silence_weighs_the_places_of_the_ring() {
    let (mut errors, mut squares, mut count) = (0.0, 0.0, 0.0);
    for (case, sensing, h, d) in first_reports() {
        for seed in 0..15 {
            let points = place_devices(&Layout::JitteredGrid, AREA, 120, 100 * case + seed);
            let is_on = |j: DeviceId| j.0.is_multiple_of(7);
            let silent = (0..120).filter(|&k| k != h as usize && is_on(DeviceId(k as u32)));
            let definition = BeliefDefinition {
                points: &points,
                sensing: &sensing,
                reporter: h as usize,
                d,
                silent: silent.collect(),
                prior: if seed % 2 == 0 { uniform_prior } else { |at| 0.1 + at.x },
            };
            let mut belief = EpicentreBelief::new(&points, AREA, &sensing);
            belief.start_event();
            belief.add_reporter(DeviceId(h), d, definition.prior);
            for place in &belief.points {
                assert!(place.weight.to_bits() == 1f64.to_bits(), "before the silence is heard");
            }
            belief.observe_silence(is_on, definition.prior);
            // A kept point stands for its neighbours, so its weight is a multiple of the weight in the definition.
            assert!(belief.points.len() <= 2 * MAX_POINTS_PER_CLASS);
            for place in &belief.points {
                let share = place.weight / definition.weight(place.position);
                assert!(
                    (share - share.round()).abs() < 1e-9 && (1.0..17.0).contains(&share.round()),
                    "{case} {h} {seed}: {place:?} weighs {share} times its due weight"
                );
            }
            let information = sensing.p(d);
            let (fine, all) = (definition.places(5_000), 0..120_usize);
            let free = all.filter(|&j| j != h as usize && !is_on(DeviceId(j as u32)));
            let most = free.map(|j| definition.gain(&fine, j, information)).fold(0.0, f64::max);
            let Some((next, gain)) = belief.next_candidate(information, |j| !is_on(j)) else {
                assert!(most < 1e-3, "{case} {h} {seed}: none selected, and one adds {most}");
                continue;
            };
            let own = definition.gain(&fine, next.index(), information);
            assert!(own > 0.9 * most, "{case} {h} {seed}: {next} has {own}, another {most}");
            if most > 1e-3 {
                errors += gain / own - 1.0;
                squares += (gain / own - 1.0) * (gain / own - 1.0);
                count += 1.0;
            }
        }
    }
    let (mean, spread) = (errors / count, (squares / count).sqrt());

    assert!(
        count > 200.0 && mean.abs() < 0.005 && spread < 0.03,
        "{mean} ± {spread} of {count}"
    );
}

#[test]
fn devices_at_one_place_tell_the_same_and_a_third_report_finds_the_event() {
    let mut points = place_devices(&Layout::Uniform, AREA, 40, 9);
    let event = Point::new(9.0, 9.0);
    points[0] = Point::new(7.0, 9.5);
    points[1] = points[0];
    points[2] = Point::new(10.0, 7.0);
    points[3] = Point::new(10.5, 11.0);
    let mut belief = EpicentreBelief::new(&points, AREA, &sensing(Fusion::Max));
    belief.start_event();
    for (j, places) in [(0, 512), (1, 512), (2, 2), (3, 1)] {
        belief.add_reporter(DeviceId(j), points[j as usize].distance(event), uniform_prior);
        assert_eq!(belief.points.len(), places, "after {j}");
    }
    assert!(belief.points[0].position.distance(event) < 1e-5);
}

#[test]
fn a_device_that_was_woken_in_vain_rules_its_reach_out() {
    let points = [Point::new(10.0, 10.0), Point::new(12.5, 10.0), Point::new(10.0, 13.0)];
    for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
        let sensing = Sensing {
            kind,
            ..sensing(Fusion::Max)
        };
        let mut belief = EpicentreBelief::new(&points, AREA, &sensing);
        belief.start_event();
        belief.add_reporter(DeviceId(0), 3.0, uniform_prior);
        belief.add_far_reporter(DeviceId(1));
        let weights = |belief: &EpicentreBelief| -> [f64; 2] {
            let of = |near: bool| {
                let own = belief
                    .points
                    .iter()
                    .filter(|p| (p.position.distance(points[1]) <= 4.0) == near);
                own.map(|place| place.weight).sum()
            };
            [of(true), of(false)]
        };
        let [near, far] = weights(&belief);
        assert!(near < 1e-9 * far && far > 0.0, "{kind:?}: {near} {far}");
        // A second ring that leaves two points: one within that range, one outside.
        let left = Point::new(10.0 - 3.0 * 0.8, 10.0 + 3.0 * 0.6);
        belief.add_reporter(DeviceId(2), points[2].distance(left), uniform_prior);
        let [near, far] = weights(&belief);
        assert!(belief.points.len() == 2 && near < 1e-9 * far, "{kind:?}: {near} {far}");
    }
}

/// One device in thousands reports and its neighbours do not, so the weights of all points are tiny.
#[test]
fn silence_of_hundreds_does_not_end_the_wake_ups() {
    for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
        let sensing = Sensing {
            kind,
            ..sensing(Fusion::Max)
        };
        let points = place_devices(&Layout::Uniform, AREA, 12_000, 5);
        let mut belief = EpicentreBelief::new(&points, AREA, &sensing);
        let (reporter, d) = (DeviceId(7), 2.5);
        let is_on = |j: DeviceId| j.0.is_multiple_of(2);
        belief.start_event();
        belief.add_reporter(reporter, d, uniform_prior);
        belief.observe_silence(is_on, uniform_prior);
        let (next, gain) = belief
            .next_candidate(sensing.p(d), |j| !is_on(j))
            .expect("a device adds");
        // The definition, with logarithms.
        let centre = points[reporter.index()];
        let places: Vec<Point> = (0..POINTS_PER_RING)
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
        // Few points stand for all; with probabilistic detection all weights differ widely, so the error is larger.
        let off = match kind {
            DetectionKind::Range => 0.02,
            DetectionKind::Probabilistic => 0.5,
        };
        assert!(
            expected > 0.0 && (gain / expected - 1.0).abs() < off,
            "{kind:?}: {gain}, not {expected}"
        );
        // A second report leaves two points, and both must be kept.
        let second = DeviceId(9);
        let event = places[weights.iter().position(|&weight| weight >= 1.0).expect("a largest")];
        let apart = |at: &&Point| at.distance(event);
        let other = *places
            .iter()
            .max_by(|a, b| apart(a).total_cmp(&apart(b)))
            .expect("a place");
        for at in [event, other] {
            belief.start_event();
            belief.add_reporter(reporter, d, uniform_prior);
            belief.observe_silence(is_on, uniform_prior);
            belief.add_reporter(second, points[9].distance(at), uniform_prior);
            belief.add_reporter(DeviceId(11), points[11].distance(at), uniform_prior);
            let found = belief
                .next_candidate(sensing.p(d), |j| !is_on(j))
                .expect("a device adds");
            assert!(points[found.0.index()].distance(at) < 0.5, "{kind:?}: {found:?}");
        }
    }
}

#[test]
fn nobody_is_given_out_twice_in_an_event() {
    let points = place_devices(&Layout::Grid, AREA, 100, 1);
    let mut belief = EpicentreBelief::new(&points, AREA, &sensing(Fusion::SumSaturation));
    for _ in 0..2 {
        belief.start_event();
        assert!(belief.next_candidate(0.0, |_| true).is_none(), "nothing is known");
        belief.add_reporter(DeviceId(44), 2.0, uniform_prior);
        let mut given: Vec<u32> = std::iter::from_fn(|| belief.next_candidate(0.0, |_| true))
            .map(|(j, _)| j.0)
            .collect();
        let count = given.len();
        given.sort_unstable();
        given.dedup();
        assert!(given.len() == count && count > 20 && !given.contains(&44), "{given:?}");
    }
}
