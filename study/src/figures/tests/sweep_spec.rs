//! Tests of [`SweepFigureSpec`]: figures of any metric against any field of a sweep. Values are compared with the
//! formula that fills the table.

use reveille_common::declare::NoFiles;
use reveille_lab::table::{SweptValue, Table};

use super::super::FigureError;
use super::super::results::{Results, fixtures};
use super::super::sweep::{SweepFigure, SweepFigureSpec};
use super::check_properties;

/// Creates a table with three λ for knn and random at two N. The energy is 10 λ + N / 10, and 0.5 more for random.
fn lambda_sweep() -> (String, Table) {
    let energy = |lambda: f64, n: u32| 10.0 * lambda + f64::from(n) / 10.0;
    let mut runs: Vec<(&str, u32, SweptValue, Vec<f64>)> = Vec::new();
    // Out of order, as in a merged sweep.
    for lambda in [0.4, 0.05, 0.1] {
        for policy in ["knn", "random"] {
            for n in [10, 100] {
                let mean = energy(lambda, n) + if policy == "random" { 0.5 } else { 0.0 };
                runs.push((policy, n, SweptValue::Float(lambda), vec![mean - 0.1, mean + 0.1]));
            }
        }
    }
    let runs: Vec<(&str, u32, SweptValue, &[f64])> = runs
        .iter()
        .map(|(policy, n, lambda, values)| (*policy, *n, lambda.clone(), values.as_slice()))
        .collect();
    fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs)
}

/// Returns the specification of figures of the energy against `x`, with a line for each value of `by`.
fn spec(x: &str, by: &str, filter: &[(&str, &str)]) -> SweepFigureSpec {
    let owned = |(field, value): &(&str, &str)| ((*field).to_owned(), (*value).to_owned());
    SweepFigureSpec {
        x_field: x.to_owned(),
        metric: "energy_per_device_tti".to_owned(),
        line_field: by.to_owned(),
        filter: filter.iter().map(owned).collect(),
        is_log_x: false,
        is_log_y: false,
    }
}

/// Draws `spec` for [`lambda_sweep`].
fn draw(spec: &SweepFigureSpec) -> Result<Vec<SweepFigure>, FigureError> {
    spec.draw(&Results::new(&[lambda_sweep()], &NoFiles).expect("runs"))
}

#[test]
fn a_figure_has_means_and_intervals_against_a_field() {
    let figures = draw(&spec("harvest.lambda", "policy", &[("devices", "100")])).expect("a figure");
    let [figure] = &figures[..] else { panic!("{figures:?}") };
    assert!(figure.facet.is_empty());
    let chart = &figure.chart;
    let names: Vec<&str> = chart.series.iter().map(|line| line.name.as_str()).collect();
    assert_eq!(names, ["knn", "random"]);
    for (line, offset) in chart.series.iter().zip([0.0, 0.5]) {
        let xs: Vec<f64> = line.points.iter().map(|sample| sample.x).collect();
        assert_eq!(xs, [0.05, 0.1, 0.4], "in ascending order");
        for sample in &line.points {
            assert!((sample.y - (10.0 * sample.x + 10.0 + offset)).abs() < 1e-12);
            // Two values 0.2 apart: t(1) · 0.1414 / √2.
            assert!((sample.y_half_width - 12.706_205 * 0.1).abs() < 1e-5, "{sample:?}");
        }
    }
    assert_eq!(
        chart.title,
        "Energy, units per device and TTI (energy_per_device_tti) against intensity λ of the arrivals (harvest.lambda)"
    );
    assert_eq!(chart.x_label, "intensity λ of the arrivals, per unit of model time");
    assert_eq!(chart.y_label, "energy, units per device and TTI");
    assert!(chart.marks.is_empty() && chart.spans.is_empty());
    assert!(
        !chart.title.contains("Fig") && !chart.caption.contains("aper states"),
        "{chart:?}"
    );
    assert!(
        chart.caption.contains("devices = 100") && chart.caption.contains("2 runs"),
        "{}",
        chart.caption
    );
    assert!(
        figure
            .csv
            .starts_with("policy,harvest.lambda,metric,mean,half_width_95,runs\nknn,0.05,")
    );
    assert_eq!(figure.csv.lines().count(), 7);
    check_properties("own-sweep", &chart.scene());
}

#[test]
fn each_value_of_another_field_has_a_figure() {
    let figures = draw(&spec("harvest.lambda", "policy", &[])).expect("figures");
    let facets: Vec<_> = figures.iter().map(|figure| figure.facet.clone()).collect();
    let devices = |n: &str| vec![("devices".to_owned(), n.to_owned())];
    assert_eq!(facets, [devices("10"), devices("100")]);
    assert!((figures[0].chart.series[0].points[0].y - 1.5).abs() < 1e-12);
    assert!((figures[1].chart.series[0].points[0].y - 10.5).abs() < 1e-12);
    assert!(
        figures[1].csv.contains("\n100,knn,0.05,energy_per_device_tti,10.5,"),
        "{}",
        figures[1].csv
    );
}

#[test]
fn any_field_can_define_the_lines() {
    let spec = SweepFigureSpec {
        is_log_x: true,
        is_log_y: true,
        ..spec("devices", "harvest.lambda", &[("policy", "knn")])
    };
    let figures = draw(&spec).expect("a figure");
    let [figure] = &figures[..] else { panic!("{figures:?}") };
    let names: Vec<&str> = figure.chart.series.iter().map(|line| line.name.as_str()).collect();
    assert_eq!(
        names,
        ["harvest.lambda 0.4", "harvest.lambda 0.05", "harvest.lambda 0.1"]
    );
    let ys: Vec<f64> = figure.chart.series[1].points.iter().map(|sample| sample.y).collect();
    assert!((ys[0] - 1.5).abs() < 1e-12 && (ys[1] - 10.5).abs() < 1e-12);
    let (from, to) = figure.chart.x.ends();
    assert!(
        (8.0..10.0).contains(&from) && (100.0..125.0).contains(&to),
        "{from} to {to}"
    );
    assert!(figure.chart.caption.contains("policy = knn"));
    check_properties("own-sweep-log", &figure.chart.scene());
}

#[test]
fn errors_of_invalid_requests_list_the_options() {
    let assert_refused = |spec: SweepFigureSpec, parts: &[&str]| {
        let error = draw(&spec).expect_err("nothing to draw").to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    };
    let fields = "preset, policy, devices, ttis, harvest.lambda";
    assert_refused(spec("harvest.lamda", "policy", &[]), &["`harvest.lamda`", fields]);
    assert_refused(spec("devices", "colour", &[]), &["`colour`", fields]);
    assert_refused(spec("devices", "policy", &[("colour", "red")]), &["`colour`", fields]);
    assert_refused(spec("policy", "devices", &[]), &["knn is not a number", "--by policy"]);
    assert_refused(spec("devices", "devices", &[]), &["--x devices --by devices"]);
    assert_refused(
        spec("devices", "policy", &[("harvest.lambda", "0.2")]),
        &["harvest.lambda = 0.2", "0.4, 0.05, 0.1"],
    );
    let speed = SweepFigureSpec {
        metric: "speed".to_owned(),
        ..spec("devices", "policy", &[])
    };
    assert_refused(speed, &["`speed`", "info_p1, info_per_event"]);
}

#[test]
fn a_filter_compares_numbers_by_value() {
    let figures = draw(&spec("devices", "policy", &[("harvest.lambda", "0.40")])).expect("a figure");
    assert!((figures[0].chart.series[0].points[0].y - 5.0).abs() < 1e-12);
}

#[test]
fn too_many_lines_or_figures_are_refused() {
    let runs: Vec<(&str, u32, SweptValue, &[f64])> = (1..=30)
        .map(|i| {
            (
                "knn",
                10 + i % 2,
                SweptValue::Float(f64::from(i) / 100.0),
                &[1.0, 2.0][..],
            )
        })
        .collect();
    let table = fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let error_of = |spec: SweepFigureSpec| spec.draw(&results).expect_err("too many").to_string();
    let lines = error_of(spec("devices", "harvest.lambda", &[]));
    assert!(lines.contains("30 lines") && lines.contains("--where"), "{lines}");
    let figures = error_of(spec("devices", "policy", &[]));
    assert!(
        figures.contains("differ in harvest.lambda") && figures.contains("24 figures"),
        "{figures}"
    );
}

#[test]
fn rankings_are_separate_lines_or_values_of_a_field() {
    let text = |value: &str| SweptValue::Text(value.to_owned());
    let runs: [(&str, u32, SweptValue, &[f64]); 4] = [
        ("knn", 10, text("p42"), &[0.2, 0.22]),
        ("knn", 50, text("p42"), &[0.25, 0.27]),
        ("knn", 10, text("posterior"), &[0.3, 0.32]),
        ("knn", 50, text("posterior"), &[0.4, 0.42]),
    ];
    let table = fixtures::swept("paper", "energy_per_device_tti", "bs.ranking", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let names = |by: &str| -> Vec<String> {
        let figures = spec("devices", by, &[]).draw(&results).expect("a figure");
        assert_eq!(figures.len(), 1);
        figures[0].chart.series.iter().map(|line| line.name.clone()).collect()
    };
    assert_eq!(names("policy"), ["knn", "knn+posterior"]);
    assert_eq!(names("bs.ranking"), ["bs.ranking p42", "bs.ranking posterior"]);
}
