//! Whole runs against closed forms. Seeds are fixed: each result either is within three standard errors or is not.

use reveille_bs::beliefs::ranking::i_min;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Area, Point};
use reveille_lab::preparation::run;
use reveille_tests::scenarios::scenario;

/// Settings with which every battery is full at every event.
const RICH: &str = "[energy]\ne_max = 1000.0\ninitial = 1000.0\n[harvest]\nkind = \"exp-minus-lambda\"\nlambda = 0.0\n\
                    e_b = 1000.0\n";

/// Cells along each side in integrals over the area.
const CELLS: u32 = 600;

#[test]
fn the_genies_information_is_that_of_the_closest_device() {
    for (layout, devices, seed) in [("uniform", 12, 3), ("jittered-grid", 40, 4), ("poisson-disk", 25, 5)] {
        let scenario = scenario(&format!(
            "devices = {devices}\nttis = 60000\nseed = {seed}\nlayout.kind = \"{layout}\"\npolicy.name = \"genie\"\n\
             events.alpha = 0.7\nevents.duration = 2\narea.width = 18.0\narea.height = 15.0\nsensing.d_max = 2.5\n\
             sensing.eta = 0.8\nsensing.psi = 1.5\n{RICH}"
        ));
        let (mean, variance, out_of_range) = closest_over_area(&scenario);
        let outcome = run(&scenario);
        let n = outcome.metrics.events as f64;
        assert!(n > 20_000.0, "{n} events");
        near(layout, outcome.metrics.info_per_event, mean, (variance / n).sqrt());
        let error = (out_of_range * (1.0 - out_of_range) / n).sqrt();
        near(layout, outcome.metrics.misdetection_pct / 100.0, out_of_range, error);
        near(layout, outcome.metrics.wake_ups_per_event, 1.0 - out_of_range, error);
        assert_eq!(outcome.totals.events.wrong_activations, 0, "{layout}");
    }
}

/// Returns mean and variance of the closest device's information over the area, and the share of the area without
/// information.
fn closest_over_area(scenario: &Scenario) -> (f64, f64, f64) {
    let positions = Deployment::new(scenario).positions();
    let (mut sum, mut squares, mut outside) = (0.0, 0.0, 0.0);
    for point in midpoints(scenario.area) {
        let d = closest(&positions, point);
        if d <= scenario.sensing.d_max {
            let information = scenario.sensing.psi * libm::exp(-scenario.sensing.eta * d);
            sum += information;
            squares += information * information;
        } else {
            outside += 1.0;
        }
    }
    let cells = f64::from(CELLS * CELLS);
    let mean = sum / cells;
    (mean, squares / cells - mean * mean, outside / cells)
}

fn midpoints(area: Area) -> impl Iterator<Item = Point> {
    let middle = |i: u32| (f64::from(i) + 0.5) / f64::from(CELLS);
    (0..CELLS * CELLS).map(move |i| Point {
        x: middle(i / CELLS) * area.width,
        y: middle(i % CELLS) * area.height,
    })
}

fn closest(positions: &[Point], from: Point) -> f64 {
    let mut least = f64::INFINITY;
    for p in positions {
        least = least.min((p.x - from.x) * (p.x - from.x) + (p.y - from.y) * (p.y - from.y));
    }
    least.sqrt()
}

#[test]
fn arrivals_have_the_mean_of_their_law() {
    let (devices, ttis, e_b) = (60.0, 20_000.0, 2.5);
    for (kind, lambda, tau, off_mean) in [
        ("eq5", 0.1, 1.0, None),
        ("eq5", 1.3, 0.5, None),
        ("exp-minus-lambda", 0.7, 1.0, None),
        ("exp-minus-lambda", 2.0, 3.0, None),
        ("mpp", 0.1, 1.0, None),
        ("mpp", 0.5, 2.0, None),
        ("mpp", 2.0, 1.0, Some(0.4)),
        ("mpp", 0.02, 1.0, Some(3.0)),
    ] {
        let off = off_mean.map_or(String::new(), |mean: f64| format!("harvest.off_mean = {mean:?}\n"));
        let scenario = scenario(&format!(
            "devices = {devices}\nttis = {ttis}\nseed = 7\nwarm_up = 0.0\ntau = {tau:?}\npolicy.name = \"genie\"\n\
             harvest.kind = \"{kind}\"\nharvest.lambda = {lambda:?}\nharvest.e_b = {e_b:?}\n{off}"
        ));
        let rate: f64 = lambda * tau;
        // Share of TTIs with an arrival, and correlation of consecutive TTIs.
        let (share, memory) = match (kind, off_mean) {
            ("exp-minus-lambda", _) => (libm::exp(-lambda), 0.0),
            ("mpp", Some(mean)) => {
                let back = 1.0 / mean;
                (back / (back + lambda), libm::exp(-(back + lambda) * tau))
            }
            ("mpp", None) => {
                // By default the on share is the share of Eq. (5), which fixes the ratio of on and off rates.
                let share = rate * libm::exp(-rate);
                (share, libm::exp(-rate / (1.0 - share)))
            }
            _ => (rate * libm::exp(-rate), 0.0),
        };
        let variance = share * (1.0 - share) * (1.0 + memory) / (1.0 - memory);
        let error = e_b * (variance / (devices * ttis)).sqrt();
        let harvested = run(&scenario).metrics.harvested_per_device_tti;
        near(&format!("{kind} λ {lambda}"), harvested, e_b * share, error);
    }
}

#[test]
fn recorded_energy_arrives_to_the_last_micro_unit() {
    // Two devices. The columns of the test file are halved, and half a micro-unit rounds up. `rain` is 0, 0.000001, 40,
    // 0, 0 units, `wind` 1.5, 0, 0.333334, 2, 0, `sun` 0, 3.25, 12.5, 0, 0.7. A row lasts 4 TTIs, the file 20.
    let (rain, wind) = (4 * (1 + 20_000_000), 4 * (750_000 + 166_667 + 1_000_000));
    let sun = 4 * (1_625_000 + 6_250_000 + 350_000);
    for (end, ttis, columns, expected) in [
        ("stop", 40, "column = \"sun\"", 2 * sun),
        ("cycle", 40, "column = \"rain\"", 2 * 2 * rain),
        ("stop", 40, "column = \"rain\"", 2 * rain),
        ("stop", 9, "column = \"rain\"", 2 * (4 + 20_000_000)),
        ("stop", 40, "columns = [\"rain\", \"wind\"]", rain + wind),
    ] {
        let scenario = scenario(&format!(
            "devices = 2\nttis = {ttis}\nwarm_up = 0.0\nharvest.kind = \"trace\"\n[harvest.trace]\n{columns}\n\
             file = \"energy.csv\"\nttis_per_row = 4\nscale = 0.5\nend = \"{end}\"\n"
        ));
        let harvested = run(&scenario).totals.energy.harvested.micro();
        assert_eq!(harvested, expected, "{end}, {ttis} TTIs, {columns}");
    }
}

#[test]
fn the_least_information_of_a_grid_is_that_at_the_corner_of_a_cell() {
    for (side, per_row, eta, psi) in [
        (20.0f64, 1u32, 0.3, 1.0),
        (20.0, 5, 1.0, 0.1),
        (7.5, 9, 1.7, 3.0),
        (100.0, 16, 0.2, 1.0),
    ] {
        let n = per_row * per_row;
        let scenario = scenario(&format!(
            "devices = {n}\nlayout.kind = \"grid\"\narea.width = {side:?}\narea.height = {side:?}\n\
             sensing.eta = {eta:?}\nsensing.psi = {psi:?}\n"
        ));
        let found = i_min(
            &Deployment::new(&scenario).positions(),
            scenario.area,
            &scenario.sensing,
        );
        let expected = psi * libm::exp(-eta * (side * side / (2.0 * f64::from(n))).sqrt());
        assert!(
            (found / expected - 1.0).abs() < 1e-12,
            "{n} devices: {found}, not {expected}"
        );
    }
}

#[test]
fn the_least_information_is_that_of_the_point_farthest_from_all_devices() {
    for layout in ["uniform", "jittered-grid", "poisson-disk", "hex"] {
        for devices in [1, 2, 3, 10, 60] {
            let scenario = scenario(&format!(
                "devices = {devices}\nseed = 9\nlayout.kind = \"{layout}\"\narea.width = 16.0\narea.height = 11.0\n"
            ));
            let positions = Deployment::new(&scenario).positions();
            let farthest = midpoints(scenario.area)
                .map(|point| closest(&positions, point))
                .fold(0.0, f64::max);
            let cell = scenario.area.diagonal() / f64::from(CELLS);
            let d = -libm::log(i_min(&positions, scenario.area, &scenario.sensing)) / scenario.sensing.eta;
            // Moving changes a distance by at most the way, and midpoints are within half a cell diagonal.
            assert!(
                (farthest - 1e-9..=farthest + cell / 2.0 + 1e-9).contains(&d),
                "{layout} {devices}: {d}, {farthest}"
            );
        }
    }
}

/// Checks that `found` is within three standard errors of `expected`.
fn near(what: &str, found: f64, expected: f64, error: f64) {
    let errors = (found - expected).abs() / error;
    assert!(
        errors <= 3.0,
        "{what}: {found}, {errors:.1} standard errors from {expected}"
    );
}
