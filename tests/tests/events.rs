//! The durations and epicentres of events (`EventProcess`) under the processes `uniform`, `hot-spots` and
//! `aftershocks`, against closed forms. `bursts` occurs in the last test only; `bursts.rs` tests its start times. The
//! functions of `tests/src/distributions.rs` reject samples that are too small.

use reveille_common::event::{ActiveEvent, EventRecord};
use reveille_common::geometry::{Area, Point};
use reveille_lab::run::RunOptions;
use reveille_tests::compare;
use reveille_tests::distributions::{assert_bin_counts, assert_mean, assert_share, draw_events};
use reveille_tests::scenarios::scenario;

/// Accessor of a coordinate, x or y.
type Coordinate = fn(&Point) -> f64;

/// Returns the area of the scenario `text`, and the epicentres of its first `n` events.
fn draw_epicentres(text: &str, n: usize) -> (Area, Vec<Point>) {
    let scenario = scenario(text);
    let events = draw_events(&scenario, n).into_iter();
    (scenario.area, events.map(|event| event.stimulus.epicentre).collect())
}

#[test]
fn durations_have_the_mean_and_tail_of_their_law() {
    for mean in [1_u32, 4, 25] {
        let text = |kind: &str| format!("seed = 5\n[events]\nduration = {mean}\nduration_kind = \"{kind}\"\n");
        let draw_events_with_duration_kind = |kind: &str| draw_events(&scenario(&text(kind)), 40_000);
        let duration = |event: &ActiveEvent| (event.last - event.start) as f64 + 1.0;
        let (fixed, geometric) = (
            draw_events_with_duration_kind("fixed"),
            draw_events_with_duration_kind("geometric"),
        );
        let mean = f64::from(mean);
        assert!(fixed.iter().all(|event| (duration(event) - mean).abs() < 0.1));
        assert!(geometric.iter().all(|event| event.last >= event.start));
        let stimuli = |events: &[ActiveEvent]| events.iter().map(|event| event.stimulus).collect::<Vec<_>>();
        assert_eq!(
            stimuli(&fixed),
            stimuli(&geometric),
            "the kind of duration changes stimuli"
        );
        if mean < 1.5 {
            assert!(geometric.iter().all(|event| event.last == event.start));
            continue;
        }
        assert_mean("duration", geometric.iter().map(duration), mean);
        for ttis in [1, 2, 5, 20] {
            assert_share(
                &format!("durations of more than {ttis} TTIs"),
                geometric.iter().map(|event| duration(event) > f64::from(ttis) + 0.5),
                (1.0 - 1.0 / mean).powi(ttis),
            );
        }
    }
}

#[test]
fn hot_spots_have_their_share_of_the_events() {
    // Without spread, events of a hot spot have exactly equal coordinates; other events never coincide.
    for (places, share) in [(3, 0.7), (1, 0.25), (8, 0.5)] {
        let fields = format!("[events.hot-spots]\nplaces = {places}\nshare = {share:?}\nsigma = 0.0\n");
        let (_, epicentres) = draw_epicentres(
            &format!("seed = 8\n[events]\nprocess = \"hot-spots\"\n{fields}"),
            20_000,
        );
        let (_, uniform_epicentres) = draw_epicentres("seed = 8\n", 20_000);
        let mut coordinate_bits: Vec<(u64, u64)> = epicentres.iter().map(|p| (p.x.to_bits(), p.y.to_bits())).collect();
        coordinate_bits.sort_unstable();
        let group_sizes: Vec<usize> = coordinate_bits.chunk_by(|a, b| a == b).map(<[_]>::len).collect();
        let hot_spot_sizes: Vec<f64> = group_sizes.iter().filter(|&&n| n > 1).map(|&n| n as f64).collect();
        assert_eq!(hot_spot_sizes.len(), places, "{hot_spot_sizes:?}");
        let pairs = epicentres.iter().zip(&uniform_epicentres);
        let is_hot: Vec<bool> = pairs.map(|(epicentre, uniform)| epicentre != uniform).collect();
        assert_eq!(
            hot_spot_sizes.iter().sum::<f64>() as usize,
            is_hot.iter().filter(|is_hot| **is_hot).count(),
            "events outside hot spots have their uniform epicentres"
        );
        assert_share("events of hot spots", is_hot, share);
        if places > 1 {
            assert_bin_counts(
                "events by hot spot",
                &hot_spot_sizes,
                &vec![1.0 / places as f64; places],
            );
        }
    }
}

#[test]
fn epicentres_around_a_hot_spot_are_normally_distributed() {
    // The area is so large that its edges have no effect.
    let text = |sigma: f64| {
        format!(
            "seed = 4\n[area]\nwidth = 1e6\nheight = 1e6\n[events]\nprocess = \"hot-spots\"\n\
             [events.hot-spots]\nplaces = 1\nshare = 1.0\nsigma = {sigma:?}\n"
        )
    };
    let sigma = 2.5;
    let hot_spot = draw_epicentres(&text(0.0), 1).1[0];
    let (_, epicentres) = draw_epicentres(&text(sigma), 40_000);
    let offsets: Vec<(f64, f64)> = epicentres
        .iter()
        .map(|epicentre| ((epicentre.x - hot_spot.x) / sigma, (epicentre.y - hot_spot.y) / sigma))
        .collect();
    let values = |moment: fn(f64, f64) -> f64| offsets.iter().map(move |&(x, y)| moment(x, y));
    assert_mean("x", values(|x, _| x), 0.0);
    assert_mean("y", values(|_, y| y), 0.0);
    assert_mean("x²", values(|x, _| x * x), 1.0);
    assert_mean("y²", values(|_, y| y * y), 1.0);
    assert_mean("xy", values(|x, y| x * y), 0.0);
    assert_mean("x⁴", values(|x, _| x * x * x * x), 3.0);
    assert_mean("x²y²", values(|x, y| x * x * y * y), 1.0);
    for radius in [0.3, 1.0, 2.0, 3.0] {
        assert_share(
            &format!("epicentres within {radius} σ"),
            values(|x, y| x * x + y * y).map(|square| square < radius * radius),
            1.0 - libm::exp(-radius * radius / 2.0),
        );
    }
}

#[test]
fn epicentres_are_reflected_at_the_edges_of_the_area() {
    let (width, height, sigma) = (10.0, 4.0, 5.0);
    let text = |sigma: f64| {
        format!(
            "seed = 6\n[area]\nwidth = {width:?}\nheight = {height:?}\n[sensing]\nd_max = 1.0\n[events]\n\
             process = \"hot-spots\"\n[events.hot-spots]\nplaces = 1\nshare = 1.0\nsigma = {sigma:?}\n"
        )
    };
    let hot_spot = draw_epicentres(&text(0.0), 1).1[0];
    let (_, epicentres) = draw_epicentres(&text(sigma), 40_000);
    let axes: [(Coordinate, f64); 2] = [(|p| p.x, width), (|p| p.y, height)];
    for (coordinate, side) in axes {
        let normal_cdf = |x: f64| 0.5 * (1.0 + libm::erf((x - coordinate(&hot_spot)) / (sigma * 2.0_f64.sqrt())));
        let bins = 10;
        let edge = |i: usize| side * i as f64 / bins as f64;
        // Sums over the images of a bin: shifted by twice the side, and mirrored at 0. After 30 shifts the probability
        // is negligible.
        let probability = |i: usize| -> f64 {
            let (from, to) = (edge(i), edge(i + 1));
            let shifts = (-30..=30).map(|m| 2.0 * side * f64::from(m));
            shifts
                .map(|shift| {
                    let shifted = normal_cdf(shift + to) - normal_cdf(shift + from);
                    let mirrored = normal_cdf(shift - from) - normal_cdf(shift - to);
                    shifted + mirrored
                })
                .sum()
        };
        let probabilities: Vec<f64> = (0..bins).map(probability).collect();
        let mut counts = vec![0.0; bins];
        for epicentre in &epicentres {
            counts[((coordinate(epicentre) / side * bins as f64) as usize).min(bins - 1)] += 1.0;
        }
        assert_bin_counts("epicentres along an axis", &counts, &probabilities);
    }
}

#[test]
fn aftershocks_are_uniform_within_their_radius() {
    let (radius, probability) = (2000.0, 0.6);
    let (area, epicentres) = draw_epicentres(
        &format!(
            "seed = 11\n[area]\nwidth = 1e6\nheight = 1e6\n[events]\nprocess = \"aftershocks\"\n\
             [events.aftershocks]\nprobability = {probability:?}\nradius = {radius:?}\n"
        ),
        40_000,
    );
    // Only where the whole circle is in the area.
    let is_inner = |p: &Point| {
        let far_edge = area.width - radius;
        (radius..far_edge).contains(&p.x) && (radius..far_edge).contains(&p.y)
    };
    let steps = epicentres.windows(2).filter(|pair| is_inner(&pair[0]));
    let steps: Vec<(f64, f64)> = steps
        .map(|pair| ((pair[1].x - pair[0].x) / radius, (pair[1].y - pair[0].y) / radius))
        .collect();
    // Other events can also lie in the circle.
    let circle_share = std::f64::consts::PI * radius * radius / area.surface();
    let is_within_radius = |(x, y): &(f64, f64)| x * x + y * y <= 1.0;
    assert_share(
        "events near the previous one",
        steps.iter().map(is_within_radius),
        probability + (1.0 - probability) * circle_share,
    );
    let inside: Vec<(f64, f64)> = steps.iter().copied().filter(is_within_radius).collect();
    let mut rings = [0.0; 10];
    let mut sectors = [0.0; 12];
    for (x, y) in &inside {
        rings[(((x * x + y * y) * 10.0) as usize).min(9)] += 1.0;
        let turns = libm::atan2(*y, *x) / std::f64::consts::TAU + 0.5;
        sectors[((turns * 12.0) as usize).min(11)] += 1.0;
    }
    assert_bin_counts("rings of equal area", &rings, &[0.1; 10]);
    assert_bin_counts("sectors", &sectors, &[1.0 / 12.0; 12]);
    // Whether an event is an aftershock does not depend on the previous event.
    let is_aftershock: Vec<bool> = steps.iter().map(is_within_radius).collect();
    let after_aftershocks = is_aftershock.windows(2).filter(|pair| pair[0]).map(|pair| pair[1]);
    assert_share("aftershocks of aftershocks", after_aftershocks, probability);
}

#[test]
fn aftershocks_at_the_edge_are_uniform_in_the_part_of_the_circle_inside_the_area() {
    let radius = 6.0;
    let (area, epicentres) = draw_epicentres(
        &format!(
            "seed = 12\n[area]\nwidth = 12.0\nheight = 7.0\n[events]\nprocess = \"aftershocks\"\n\
             [events.aftershocks]\nprobability = 1.0\nradius = {radius:?}\n"
        ),
        3000,
    );
    let points_per_side = 120;
    let midpoint = |i: u32, side: f64| (f64::from(i) + 0.5) / f64::from(points_per_side) * side;
    let points: Vec<Point> = (0..points_per_side * points_per_side)
        .map(|i| {
            Point::new(
                midpoint(i / points_per_side, area.width),
                midpoint(i % points_per_side, area.height),
            )
        })
        .collect();
    // Deviation of x, y and the squared distance from the previous event, from their mean over all possible points.
    let mut deviations = [const { Vec::new() }; 3];
    for pair in epicentres.windows(2) {
        let (previous, epicentre) = (pair[0], pair[1]);
        assert!(area.contains(epicentre), "{epicentre:?} is outside the area");
        // 1e-12 m is more than the rounding error.
        assert!(
            epicentre.distance(previous) <= radius + 1e-12,
            "{epicentre:?} is far from {previous:?}"
        );
        let (mut n, mut sums) = (0.0, [0.0; 3]);
        for point in points.iter().filter(|point| point.distance(previous) <= radius) {
            n += 1.0;
            for (sum, value) in sums
                .iter_mut()
                .zip([point.x, point.y, point.distance_squared(previous)])
            {
                *sum += value;
            }
        }
        let drawn_values = [epicentre.x, epicentre.y, epicentre.distance_squared(previous)];
        for (index, value) in drawn_values.into_iter().enumerate() {
            deviations[index].push(value - sums[index] / n);
        }
    }
    for (quantity, values) in ["x", "y", "squared distance"].into_iter().zip(deviations) {
        assert_mean(quantity, values, 0.0);
    }
}

#[test]
fn aftershocks_with_a_radius_beyond_the_area_are_independent_of_the_previous_event() {
    let (area, epicentres) = draw_epicentres(
        "seed = 13\n[events]\nprocess = \"aftershocks\"\n[events.aftershocks]\nprobability = 1.0\nradius = 1e6\n",
        20_000,
    );
    let centred = |value: f64, side: f64| value / side - 0.5;
    let xs: Vec<f64> = epicentres.iter().map(|p| centred(p.x, area.width)).collect();
    let ys: Vec<f64> = epicentres.iter().map(|p| centred(p.y, area.height)).collect();
    for values in [xs, ys] {
        assert_mean("coordinate", values.iter().copied(), 0.0);
        assert_mean(
            "squared coordinate",
            values.iter().map(|value| value * value),
            1.0 / 12.0,
        );
        let products = values.windows(2).map(|pair| pair[0] * pair[1]);
        assert_mean("product of consecutive coordinates", products, 0.0);
    }
}

/// A policy affects only the TTIs in which events start and end, and no other property of events.
#[test]
fn genie_and_random_get_the_same_events() {
    for process in ["uniform", "hot-spots", "aftershocks", "bursts"] {
        let events_and_alpha = |policy: &str| {
            let scenario = scenario(&format!(
                "devices = 20\nttis = 1500\n[events]\nprocess = \"{process}\"\nduration_kind = \"geometric\"\n\
                 [policy]\nname = \"{policy}\"\n"
            ));
            let (outcome, events) = compare::outcome(&scenario, RunOptions::default());
            let information = outcome.totals.events.information_pico as f64 * 1e-12;
            // P1 is the information divided by the expected number of events.
            let alpha = information / outcome.totals.ttis as f64 / outcome.metrics.info_p1;
            (events, alpha)
        };
        let ((genie_events, genie_alpha), (random_events, random_alpha)) =
            (events_and_alpha("genie"), events_and_alpha("random"));
        assert!(
            (genie_alpha - random_alpha).abs() < 1e-12,
            "{process}: α {genie_alpha} under genie, {random_alpha} under random"
        );
        let pairs: Vec<(&EventRecord, &EventRecord)> = genie_events.iter().zip(&random_events).collect();
        assert!(
            pairs.len() > 100 && pairs.iter().any(|(genie, random)| genie.start != random.start),
            "{process}"
        );
        for (genie, random) in pairs {
            assert_eq!(
                (genie.event, genie.epicentre),
                (random.event, random.epicentre),
                "{process}"
            );
            // A report ends an event early.
            if genie.tally.reports == 0 && random.tally.reports == 0 {
                let [genie_ttis, random_ttis] = [genie, random].map(|event| event.last - event.start);
                assert_eq!(genie_ttis, random_ttis, "{process} {genie:?}");
            }
        }
    }
}
