//! Durations and epicentres of events, against closed forms.

use reveille_common::event::{ActiveEvent, EventRecord};
use reveille_common::geometry::{Area, Point};
use reveille_tests::compare;
use reveille_tests::distributions::{cells_are, drawn, mean_is, share_is};
use reveille_tests::scenarios::scenario;

/// Accessor of a coordinate.
type Axis = fn(&Point) -> f64;

fn epicentres(text: &str, n: usize) -> (Area, Vec<Point>) {
    let scenario = scenario(text);
    let events = drawn(&scenario, n).into_iter();
    (scenario.area, events.map(|event| event.stimulus.epicentre).collect())
}

#[test]
fn durations_have_the_mean_and_the_tail_of_their_law() {
    for mean in [1_u32, 4, 25] {
        let text = |kind: &str| format!("seed = 5\n[events]\nduration = {mean}\nduration_kind = \"{kind}\"\n");
        let of = |kind: &str| drawn(&scenario(&text(kind)), 40_000);
        let ttis = |event: &ActiveEvent| (event.last - event.start) as f64 + 1.0;
        let (fixed, geometric) = (of("fixed"), of("geometric"));
        let mean = f64::from(mean);
        assert!(fixed.iter().all(|event| (ttis(event) - mean).abs() < 0.1));
        assert!(geometric.iter().all(|event| event.last >= event.start));
        let places = |events: &[ActiveEvent]| events.iter().map(|event| event.stimulus).collect::<Vec<_>>();
        assert_eq!(places(&fixed), places(&geometric), "the rest is drawn as before");
        if mean < 1.5 {
            assert!(geometric.iter().all(|event| event.last == event.start));
            continue;
        }
        mean_is("duration", geometric.iter().map(ttis), mean);
        for least in [1, 2, 5, 20] {
            let longer = (1.0 - 1.0 / mean).powi(least);
            share_is(
                &format!("longer than {least}"),
                geometric.iter().map(|event| ttis(event) > f64::from(least) + 0.5),
                longer,
            );
        }
    }
}

#[test]
fn hot_spots_have_their_share_of_the_events() {
    // Without spread, events of a hot spot have equal coordinates, to the last bit; other events never coincide.
    for (places, share) in [(3, 0.7), (1, 0.25), (8, 0.5)] {
        let spots = format!("[events.hot-spots]\nplaces = {places}\nshare = {share:?}\nsigma = 0.0\n");
        let (_, events) = epicentres(&format!("seed = 8\n[events]\nprocess = \"hot-spots\"\n{spots}"), 20_000);
        let (_, uniform) = epicentres("seed = 8\n", 20_000);
        let mut sorted: Vec<(u64, u64)> = events.iter().map(|at| (at.x.to_bits(), at.y.to_bits())).collect();
        sorted.sort_unstable();
        let groups: Vec<usize> = sorted.chunk_by(|a, b| a == b).map(<[_]>::len).collect();
        let spots: Vec<f64> = groups.iter().filter(|&&n| n > 1).map(|&n| n as f64).collect();
        assert_eq!(spots.len(), places, "{spots:?}");
        let is_hot = events.iter().zip(&uniform).map(|(at, elsewhere)| at != elsewhere);
        share_is("share of hot spots", is_hot, share);
        assert!(
            (spots.iter().sum::<f64>() as usize) == events.iter().zip(&uniform).filter(|(a, b)| a != b).count(),
            "the others are where they are without hot spots"
        );
        if places > 1 {
            cells_are("events by place", &spots, &vec![1.0 / places as f64; places]);
        }
    }
}

#[test]
fn events_spread_normally_around_a_hot_spot() {
    // The area is so large that its edges have no effect.
    let text = |sigma: f64| {
        format!(
            "seed = 4\n[area]\nwidth = 1e6\nheight = 1e6\n[events]\nprocess = \"hot-spots\"\n\
             [events.hot-spots]\nplaces = 1\nshare = 1.0\nsigma = {sigma:?}\n"
        )
    };
    let sigma = 2.5;
    let place = epicentres(&text(0.0), 1).1[0];
    let (_, events) = epicentres(&text(sigma), 40_000);
    let offsets: Vec<(f64, f64)> = events
        .iter()
        .map(|at| ((at.x - place.x) / sigma, (at.y - place.y) / sigma))
        .collect();
    let over = |of: fn(f64, f64) -> f64| offsets.iter().map(move |&(x, y)| of(x, y));
    mean_is("x", over(|x, _| x), 0.0);
    mean_is("y", over(|_, y| y), 0.0);
    mean_is("x²", over(|x, _| x * x), 1.0);
    mean_is("y²", over(|_, y| y * y), 1.0);
    mean_is("xy", over(|x, y| x * y), 0.0);
    mean_is("x⁴", over(|x, _| x * x * x * x), 3.0);
    mean_is("x²y²", over(|x, y| x * x * y * y), 1.0);
    for radius in [0.3, 1.0, 2.0, 3.0] {
        share_is(
            "within a circle",
            over(|x, y| x * x + y * y).map(|square| square < radius * radius),
            1.0 - libm::exp(-radius * radius / 2.0),
        );
    }
}

#[test]
fn the_edges_of_the_area_are_mirrors() {
    let (width, height, sigma) = (10.0, 4.0, 5.0);
    let text = |sigma: f64| {
        format!(
            "seed = 6\n[area]\nwidth = {width:?}\nheight = {height:?}\n[sensing]\nd_max = 1.0\n[events]\n\
             process = \"hot-spots\"\n[events.hot-spots]\nplaces = 1\nshare = 1.0\nsigma = {sigma:?}\n"
        )
    };
    let place = epicentres(&text(0.0), 1).1[0];
    let (_, events) = epicentres(&text(sigma), 40_000);
    let axes: [(Axis, f64); 2] = [(|at| at.x, width), (|at| at.y, height)];
    for (along, side) in axes {
        let below = |x: f64| 0.5 * (1.0 + libm::erf((x - along(&place)) / (sigma * 2.0_f64.sqrt())));
        let cells = 10;
        let edge = |i: usize| side * i as f64 / cells as f64;
        // Sums over every image of a cell: shifted by twice the side, and mirrored at 0.
        let probability = |i: usize| -> f64 {
            let (from, to) = (edge(i), edge(i + 1));
            let shifts = (-30..=30).map(|m| 2.0 * side * f64::from(m));
            shifts
                .map(|by| below(by + to) - below(by + from) + below(by - from) - below(by - to))
                .sum()
        };
        let probabilities: Vec<f64> = (0..cells).map(probability).collect();
        let mut counts = vec![0.0; cells];
        for at in &events {
            counts[((along(at) / side * cells as f64) as usize).min(cells - 1)] += 1.0;
        }
        cells_are("cells along an axis", &counts, &probabilities);
    }
}

#[test]
fn aftershocks_are_anywhere_within_their_radius() {
    let (radius, probability) = (2000.0, 0.6);
    let (area, events) = epicentres(
        &format!(
            "seed = 11\n[area]\nwidth = 1e6\nheight = 1e6\n[events]\nprocess = \"aftershocks\"\n\
             [events.aftershocks]\nprobability = {probability:?}\nradius = {radius:?}\n"
        ),
        40_000,
    );
    // Only where the whole circle is in the area.
    let is_inner = |at: &Point| {
        let most = area.width - radius;
        (radius..most).contains(&at.x) && (radius..most).contains(&at.y)
    };
    let steps = events.windows(2).filter(|pair| is_inner(&pair[0]));
    let steps: Vec<(f64, f64)> = steps
        .map(|pair| ((pair[1].x - pair[0].x) / radius, (pair[1].y - pair[0].y) / radius))
        .collect();
    let by_chance = std::f64::consts::PI * radius * radius / area.surface();
    let is_near = |(x, y): &(f64, f64)| x * x + y * y <= 1.0;
    share_is(
        "aftershocks",
        steps.iter().map(is_near),
        probability + (1.0 - probability) * by_chance,
    );
    let near: Vec<(f64, f64)> = steps.iter().copied().filter(is_near).collect();
    let mut rings = [0.0; 10];
    let mut sectors = [0.0; 12];
    for (x, y) in &near {
        rings[((x * x + y * y) * 10.0) as usize] += 1.0;
        let turn = libm::atan2(*y, *x) / std::f64::consts::TAU + 0.5;
        sectors[((turn * 12.0) as usize).min(11)] += 1.0;
    }
    cells_are("rings of the same surface", &rings, &[0.1; 10]);
    cells_are("sectors", &sectors, &[1.0 / 12.0; 12]);
    // Whether an event is an aftershock does not depend on the previous event.
    let is_after: Vec<bool> = steps.iter().map(is_near).collect();
    let again = is_after.windows(2).filter(|pair| pair[0]).map(|pair| pair[1]);
    share_is("aftershocks of aftershocks", again, probability);
}

#[test]
fn aftershocks_at_the_edge_are_uniform_on_what_is_left_of_their_circle() {
    let radius = 6.0;
    let (area, events) = epicentres(
        &format!(
            "seed = 12\n[area]\nwidth = 12.0\nheight = 7.0\n[events]\nprocess = \"aftershocks\"\n\
             [events.aftershocks]\nprobability = 1.0\nradius = {radius:?}\n"
        ),
        3000,
    );
    let side = 120;
    let middle = |i: u32, whole: f64| (f64::from(i) + 0.5) / f64::from(side) * whole;
    let cells: Vec<Point> = (0..side * side)
        .map(|i| Point::new(middle(i / side, area.width), middle(i % side, area.height)))
        .collect();
    // Deviation of x, y and the squared distance from the previous event, from their mean over all possible points.
    let mut surplus = [const { Vec::new() }; 3];
    for pair in events.windows(2) {
        let (before, at) = (pair[0], pair[1]);
        assert!(area.contains(at), "{at:?}");
        assert!(at.distance(before) <= radius + 1e-12, "{at:?} from {before:?}");
        let (mut n, mut sums) = (0.0, [0.0; 3]);
        for cell in cells.iter().filter(|cell| cell.distance(before) <= radius) {
            n += 1.0;
            for (sum, value) in sums.iter_mut().zip([cell.x, cell.y, cell.distance_squared(before)]) {
                *sum += value;
            }
        }
        for (index, value) in [at.x, at.y, at.distance_squared(before)].into_iter().enumerate() {
            surplus[index].push(value - sums[index] / n);
        }
    }
    for (what, values) in ["x", "y", "squared distance"].into_iter().zip(surplus) {
        mean_is(what, values, 0.0);
    }
}

#[test]
fn a_radius_beyond_the_area_leaves_no_trace_of_the_event_before() {
    let (area, events) = epicentres(
        "seed = 13\n[events]\nprocess = \"aftershocks\"\n[events.aftershocks]\nprobability = 1.0\nradius = 1e6\n",
        20_000,
    );
    let middle = |value: f64, side: f64| value / side - 0.5;
    let xs: Vec<f64> = events.iter().map(|at| middle(at.x, area.width)).collect();
    let ys: Vec<f64> = events.iter().map(|at| middle(at.y, area.height)).collect();
    for values in [xs, ys] {
        mean_is("place", values.iter().copied(), 0.0);
        mean_is("squared", values.iter().map(|value| value * value), 1.0 / 12.0);
        mean_is("product", values.windows(2).map(|pair| pair[0] * pair[1]), 0.0);
    }
}

/// A policy affects only the TTIs in which events start and end, and no other property of events.
#[test]
fn every_policy_meets_the_same_events() {
    for process in ["uniform", "hot-spots", "aftershocks", "bursts"] {
        let run = |policy: &str| {
            let scenario = scenario(&format!(
                "devices = 20\nttis = 1500\n[events]\nprocess = \"{process}\"\nduration_kind = \"geometric\"\n\
                 [policy]\nname = \"{policy}\"\n"
            ));
            let (outcome, events) = compare::outcome(&scenario, true, u64::MAX);
            let information = outcome.totals.events.information_pico as f64 * 1e-12;
            let alpha = information / outcome.totals.ttis as f64 / outcome.metrics.info_p1;
            (events, alpha)
        };
        let ((genie, of_genie), (random, of_random)) = (run("genie"), run("random"));
        assert!(
            (of_genie - of_random).abs() < 1e-12,
            "{process}: {of_genie}, {of_random}"
        );
        let both: Vec<(&EventRecord, &EventRecord)> = genie.iter().zip(&random).collect();
        assert!(
            both.len() > 100 && both.iter().any(|(a, b)| a.start != b.start),
            "{process}"
        );
        for (one, other) in both {
            assert_eq!((one.event, one.epicentre), (other.event, other.epicentre), "{process}");
            if one.tally.reports == 0 && other.tally.reports == 0 {
                assert_eq!(one.last - one.start, other.last - other.start, "{process} {one:?}");
            }
        }
    }
}
