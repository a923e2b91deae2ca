//! Information under `genie`, harvested energy and I_min, against closed forms and numerical integrals. Seeds are
//! fixed, so the tests are deterministic. After an intended change of random draws, a deviation just above the limit of
//! [`assert_near`] can be chance: a correct sample exceeds it in one of 370 comparisons. Diurnal harvest is not tested
//! here.

use reveille_bs::beliefs::ranking::i_min;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Area, Point};
use reveille_lab::preparation::run;
use reveille_tests::scenarios::scenario;

/// Settings with which every battery is full at every event.
const FULL_BATTERIES: &str = "[energy]\ne_max = 1000.0\ninitial = 1000.0\n[harvest]\n\
                              kind = \"exp-minus-lambda\"\nlambda = 0.0\ne_b = 1000.0\n";

/// Rounding error of a distance, m.
const ROUNDING: f64 = 1e-9;

/// Squares along each side in integrals over the area.
const CELLS_PER_SIDE: u32 = 600;

#[test]
fn the_genie_receives_the_information_of_the_closest_device() {
    for (layout, devices, seed) in [("uniform", 12, 3), ("jittered-grid", 40, 4), ("poisson-disk", 25, 5)] {
        let scenario = scenario(&format!(
            "devices = {devices}\nttis = 60000\nseed = {seed}\nlayout.kind = \"{layout}\"\npolicy.name = \"genie\"\n\
             events.alpha = 0.7\nevents.duration = 2\narea.width = 18.0\narea.height = 15.0\nsensing.d_max = 2.5\n\
             sensing.eta = 0.8\nsensing.psi = 1.5\n{FULL_BATTERIES}"
        ));
        let expected = integrate_closest_information(&scenario);
        let outcome = run(&scenario);
        let n = outcome.metrics.events as f64;
        assert!(n > 20_000.0, "{n} events");
        let metrics = &outcome.metrics;
        assert_near(
            layout,
            metrics.info_per_event,
            expected.mean,
            (expected.variance / n).sqrt(),
        );
        let out_of_range = expected.out_of_range;
        let standard_error = (out_of_range * (1.0 - out_of_range) / n).sqrt();
        assert_near(layout, metrics.misdetection_pct / 100.0, out_of_range, standard_error);
        assert_near(layout, metrics.wake_ups_per_event, 1.0 - out_of_range, standard_error);
        assert_eq!(outcome.totals.events.wrong_activations, 0, "{layout}");
    }
}

/// Information of the closest device, over the area.
struct ClosestInformation {
    mean: f64,
    variance: f64,
    /// Share of the area without a device within d_max, where the information is 0.
    out_of_range: f64,
}

/// Integrates the closest device's information over the area.
fn integrate_closest_information(scenario: &Scenario) -> ClosestInformation {
    let positions = Deployment::new(scenario).positions();
    let (mut sum, mut sum_of_squares, mut points_out_of_range) = (0.0, 0.0, 0.0);
    for point in midpoints(scenario.area) {
        let d = distance_to_closest(&positions, point);
        if d <= scenario.sensing.d_max {
            let information = scenario.sensing.psi * libm::exp(-scenario.sensing.eta * d);
            sum += information;
            sum_of_squares += information * information;
        } else {
            points_out_of_range += 1.0;
        }
    }
    let points = f64::from(CELLS_PER_SIDE * CELLS_PER_SIDE);
    let mean = sum / points;
    ClosestInformation {
        mean,
        variance: sum_of_squares / points - mean * mean,
        out_of_range: points_out_of_range / points,
    }
}

/// Returns the midpoints of the squares of the area.
fn midpoints(area: Area) -> impl Iterator<Item = Point> {
    let middle = |i: u32| (f64::from(i) + 0.5) / f64::from(CELLS_PER_SIDE);
    (0..CELLS_PER_SIDE * CELLS_PER_SIDE).map(move |i| Point {
        x: middle(i / CELLS_PER_SIDE) * area.width,
        y: middle(i % CELLS_PER_SIDE) * area.height,
    })
}

fn distance_to_closest(positions: &[Point], from: Point) -> f64 {
    let mut least_square = f64::INFINITY;
    for p in positions {
        least_square = least_square.min((p.x - from.x) * (p.x - from.x) + (p.y - from.y) * (p.y - from.y));
    }
    least_square.sqrt()
}

#[test]
fn harvested_energy_has_the_mean_of_its_law() {
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
        let off_mean_line = off_mean.map_or(String::new(), |mean: f64| format!("harvest.off_mean = {mean:?}\n"));
        let scenario = scenario(&format!(
            "devices = {devices}\nttis = {ttis}\nseed = 7\nwarm_up = 0.0\ntau = {tau:?}\npolicy.name = \"genie\"\n\
             harvest.kind = \"{kind}\"\nharvest.lambda = {lambda:?}\nharvest.e_b = {e_b:?}\n{off_mean_line}"
        ));
        let rate: f64 = lambda * tau;
        // Share of TTIs with an arrival, and correlation of consecutive TTIs.
        let (share, correlation) = match (kind, off_mean) {
            ("exp-minus-lambda", _) => (libm::exp(-lambda), 0.0),
            ("mpp", Some(mean)) => {
                let on_rate = 1.0 / mean;
                (on_rate / (on_rate + lambda), libm::exp(-(on_rate + lambda) * tau))
            }
            ("mpp", None) => {
                // By default the on share is the share of Eq. (5), which fixes the ratio of on and off rates.
                let share = rate * libm::exp(-rate);
                (share, libm::exp(-rate / (1.0 - share)))
            }
            _ => (rate * libm::exp(-rate), 0.0),
        };
        let variance = share * (1.0 - share) * (1.0 + correlation) / (1.0 - correlation);
        let standard_error = e_b * (variance / (devices * ttis)).sqrt();
        let harvested = run(&scenario).metrics.harvested_per_device_tti;
        assert_near(&format!("{kind} λ {lambda}"), harvested, e_b * share, standard_error);
    }
}

#[test]
fn recorded_energy_arrives_exactly() {
    // Two devices. The columns of `tests/data/energy.csv` are halved, and half a micro-unit rounds up. `rain` is 0,
    // 0.000001, 40, 0, 0 units, `wind` 1.5, 0, 0.333334, 2, 0, `sun` 0, 3.25, 12.5, 0, 0.7. A row lasts 4 TTIs, the
    // file 20.
    let (rain, wind) = (4 * (1 + 20_000_000), 4 * (750_000 + 166_667 + 1_000_000));
    let sun = 4 * (1_625_000 + 6_250_000 + 350_000);
    for (end, ttis, columns, expected_micro) in [
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
        assert_eq!(harvested, expected_micro, "{end}, {ttis} TTIs, {columns}");
    }
}

#[test]
fn i_min_of_a_grid_is_the_information_from_the_corner_of_a_square() {
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
        let least_information = i_min(
            &Deployment::new(&scenario).positions(),
            scenario.area,
            &scenario.sensing,
        );
        let expected = psi * libm::exp(-eta * (side * side / (2.0 * f64::from(n))).sqrt());
        assert!(
            (least_information / expected - 1.0).abs() < 1e-12,
            "{n} devices: I_min {least_information}, expected {expected}"
        );
    }
}

#[test]
fn i_min_is_the_information_from_the_point_farthest_from_all_devices() {
    for layout in ["uniform", "jittered-grid", "poisson-disk", "hex"] {
        for devices in [1, 2, 3, 10, 60] {
            let scenario = scenario(&format!(
                "devices = {devices}\nseed = 9\nlayout.kind = \"{layout}\"\narea.width = 16.0\narea.height = 11.0\n"
            ));
            let positions = Deployment::new(&scenario).positions();
            let farthest = midpoints(scenario.area)
                .map(|point| distance_to_closest(&positions, point))
                .fold(0.0, f64::max);
            let cell_diagonal = scenario.area.diagonal() / f64::from(CELLS_PER_SIDE);
            // With Ψ = 1, I_min = exp(−ηd).
            let d = -libm::log(i_min(&positions, scenario.area, &scenario.sensing)) / scenario.sensing.eta;
            // Every point is at most half a diagonal from a midpoint, so the distances differ by at most that.
            assert!(
                (farthest - ROUNDING..=farthest + cell_diagonal / 2.0 + ROUNDING).contains(&d),
                "{layout} {devices}: distance {d} from I_min, {farthest} of the farthest midpoint"
            );
        }
    }
}

/// Checks that `measured` is within three standard errors of `expected`.
fn assert_near(quantity: &str, measured: f64, expected: f64, standard_error: f64) {
    let deviation = (measured - expected).abs() / standard_error;
    assert!(
        deviation <= 3.0,
        "{quantity}: measured {measured}, expected {expected}, {deviation:.1} standard errors off"
    );
}
