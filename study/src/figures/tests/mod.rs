//! Tests of whole figures. `check_properties` covers their common properties: content within the canvas, legible text,
//! valid and reproducible files. The tests compare values and captions with the tables; appearance is not checked.
//! Expected marks, hatched ranges and their numbers follow from `study/src/claims`. `robustness.rs` and several files
//! of shared parts have tests too. Only `tests/program/figures.rs` draws `attention`.
//!
//! | file | figures |
//! |---|---|
//! | this one | of the paper; merged tables |
//! | `run_figures` | deployments, timelines, missed events |
//! | `learned` | learning curves, q-learning tables, `pareto` |
//! | `sweep_spec` | any metric against any field |
//! | `swept` | of the paper for sweeps and rankings |
//! | `traded` | `delay`, energy floor, `front` |
//! | `tuned` | tuning |

use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::declare::NoFiles;

use super::results::{Results, fixtures};
use super::scene::{Scene, SceneItem};
use super::{FigureError, energy, png, study, svg};
use reveille_lab::table::{Hash, Table};

mod learned;
mod run_figures;
mod sweep_spec;
mod swept;
mod traded;
mod tuned;

/// Values of a metric for some policies and N. One of the genie's and both of `adjusted` are undefined.
const RUNS: [(&str, u32, &[f64]); 8] = [
    ("knn", 10, &[33.0, 35.0, 31.0]),
    ("knn", 250, &[0.0, 0.0, 0.0]),
    ("random", 10, &[77.0, 70.0, 79.0]),
    ("random", 250, &[7.0, 0.5, 1.0]),
    ("genie", 10, &[2.0, f64::NAN, 2.5]),
    ("genie", 250, &[0.003, 0.002, 0.004]),
    ("genie", 50, &[4.0]),
    ("adjusted", 100, &[f64::NAN, f64::NAN]),
];

fn scenario_with(overrides: &[&str]) -> Scenario {
    let parse = |text: &&str| Override::parse(text).expect("an override");
    let overrides: Vec<Override> = overrides.iter().map(parse).collect();
    load("paper", &overrides).expect("a scenario").scenario
}

/// Returns results with [`RUNS`] as values of `metric`.
fn results_for_metric(metric: &str) -> Results {
    Results::new(&[fixtures::table("paper", metric, &RUNS)], &NoFiles).expect("runs")
}

/// Returns the figure of the paper called `name`.
fn figure_named(name: &str) -> study::PaperFigure {
    let mut figures = study::PAPER_FIGURES.into_iter();
    figures.find(|figure| figure.name == name).expect("a figure")
}

/// Returns the texts of a figure.
fn texts_of(scene: &Scene) -> Vec<&str> {
    let items = scene.items.iter();
    items
        .filter_map(|item| match item {
            SceneItem::Text(text) => Some(text.text.as_str()),
            SceneItem::Shape(_) => None,
        })
        .collect()
}

/// Checks the properties that every figure must have. `name` is for messages and identifiers; nothing is compared with
/// a stored picture.
fn check_properties(name: &str, scene: &Scene) {
    assert!(
        scene.items_outside().is_empty(),
        "{name} reaches beyond the canvas: {:?}",
        scene.items_outside()
    );
    assert!(
        scene.overlapping_texts().is_empty(),
        "{name}: {:?}",
        scene.overlapping_texts()
    );
    for item in &scene.items {
        if let SceneItem::Text(text) = item {
            assert!(text.size >= 8.0, "{name}: {text:?} is too small");
            assert!(
                super::font::has_all_glyphs(&text.text, text.weight),
                "{name}: {text:?} has letters without an outline"
            );
        }
    }
    let svg_text = svg::svg(scene, name);
    assert_eq!(svg_text, svg::svg(scene, name), "{name}: other bytes");
    let tree = roxmltree::Document::parse(&svg_text).unwrap_or_else(|error| panic!("{name}: {error}"));
    let root = tree.root_element();
    assert_eq!(root.tag_name().name(), "svg");
    let ids: Vec<&str> = tree.descendants().filter_map(|node| node.attribute("id")).collect();
    let links = tree
        .descendants()
        .filter_map(|node| node.attribute(("http://www.w3.org/1999/xlink", "href")));
    for link in links {
        assert!(
            ids.contains(&link.trim_start_matches('#')),
            "{name}: {link} has no target"
        );
    }
    let pixels = png::png(scene);
    let decoder = ::png::Decoder::new(std::io::Cursor::new(&pixels));
    let mut reader = decoder.read_info().expect("a PNG");
    // 300 dpi; a scene has 72 units per inch.
    let expected = (
        (scene.width * 300.0 / 72.0).ceil() as u32,
        (scene.height * 300.0 / 72.0).ceil() as u32,
    );
    assert_eq!(reader.info().size(), expected);
    let mut image = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut image).expect("an image");
    assert!(
        image.iter().any(|byte| *byte < 60) && image.contains(&255),
        "{name} is blank"
    );
}

#[test]
fn figures_of_the_paper_have_the_means_of_their_tables() {
    for figure in study::PAPER_FIGURES {
        let results = results_for_metric(figure.metric);
        let condition = &results.conditions[0];
        let drawing = figure.draw(condition).expect("a figure");
        let scene = drawing.chart.scene();
        check_properties(figure.name, &scene);
        assert_eq!(png::png(&scene), png::png(&scene), "{}", figure.name);
        assert_eq!(drawing.policies_without_value, ["adjusted"], "{}", figure.name);
        let names: Vec<&str> = drawing.chart.series.iter().map(|series| series.name.as_str()).collect();
        assert_eq!(names, ["knn", "random", "genie"]);
        let genie = &drawing.chart.series[2].points[0];
        let mean = if figure.is_per_device { 0.225 } else { 2.25 };
        assert!(
            (genie.y - mean).abs() < 1e-12,
            "the mean of the defined values: {genie:?}"
        );
        let csv = figure.csv(condition, &drawing);
        if figure.is_per_device {
            let knn = format!("measured,paper,knn,10,{}/n,3.3,0.4968", figure.metric);
            assert!(csv.contains(&knn), "{csv}");
        } else {
            let knn = format!("measured,paper,knn,10,{},33,4.968", figure.metric);
            assert!(csv.contains(&knn), "{csv}");
        }
    }
}

#[test]
fn a_metric_without_values_gives_no_figure() {
    let table = fixtures::table("paper", "info_p1", &[("knn", 10, &[f64::NAN; 2])]);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    assert!(figure_named("information").draw(&results.conditions[0]).is_none());
    assert!(
        figure_named("information-per-event")
            .draw(&results.conditions[0])
            .is_some()
    );
}

#[test]
fn stated_values_are_marked_for_policies_with_runs() {
    let energy = figure_named("energy");
    let results = results_for_metric(energy.metric);
    let chart = energy.draw(&results.conditions[0]).expect("a figure").chart;
    // knn 0.45–0.83 and 0.145; random 0.34 and > 0.18; genie 0.055.
    assert_eq!(chart.marks.len(), 5, "{:?}", chart.marks);
    let values: Vec<f64> = chart.marks.iter().map(|mark| mark.stated.values()[0]).collect();
    for expected in [0.45, 0.145, 0.34, 0.18, 0.055] {
        assert!(
            values.iter().any(|v| (v - expected).abs() < 1e-12),
            "{expected} in {values:?}"
        );
    }
    let offsets: Vec<f64> = chart
        .marks
        .iter()
        .filter(|mark| mark.x > 200.0)
        .map(|mark| mark.x_offset)
        .collect();
    assert!(
        offsets.len() > 1 && offsets.windows(2).all(|pair| pair[1] - pair[0] > 2.0),
        "marks at one N are side by side: {offsets:?}"
    );
    assert!(
        chart.marks.iter().all(|mark| mark.x_offset.abs() <= 4.0),
        "marks are near their N: {:?}",
        chart.marks
    );
}

#[test]
fn values_stated_for_several_n_are_hatched() {
    let runs: [(&str, u32, &[f64]); 3] = [
        ("adjusted", 10, &[3.0, 3.5]),
        ("adjusted", 250, &[1.0, 1.5]),
        ("dt", 100, &[1.0, 1.2]),
    ];
    for (name, expected) in [
        ("misdetection", vec![(10.0, 199.0, [2.0, 2.0])]),
        ("low-energy", vec![(10.0, 250.0, [30.0, 45.0])]),
        (
            "battery",
            vec![(10.0, 250.0, [31.0, 54.0]), (10.0, 250.0, [40.0, 40.0])],
        ),
        ("wasted", vec![(10.0, 250.0, [1.5, 1.5])]),
        ("energy", vec![]),
    ] {
        let figure = figure_named(name);
        let results = Results::new(&[fixtures::table("paper", figure.metric, &runs)], &NoFiles).expect("runs");
        let chart = figure.draw(&results.conditions[0]).expect("a figure").chart;
        let spans: Vec<_> = chart
            .spans
            .iter()
            .map(|span| (span.from, span.to, span.stated.values()))
            .collect();
        assert_eq!(spans, expected, "{name}");
        assert_eq!(chart.caption.contains("Hatched"), !expected.is_empty());
        check_properties(name, &chart.scene());
    }
}

#[test]
fn a_stated_ratio_is_marked_at_its_multiple_of_the_stated_value() {
    let figure = figure_named("energy");
    let runs: [(&str, u32, &[f64]); 1] = [("dt", 250, &[0.13, 0.14])];
    let results = Results::new(&[fixtures::table("paper", figure.metric, &runs)], &NoFiles).expect("runs");
    let chart = figure.draw(&results.conditions[0]).expect("a figure").chart;
    let values: Vec<f64> = chart.marks.iter().map(|mark| mark.stated.values()[0]).collect();
    // Between 0.45 and 0.83; 40 % below 0.24; 10 % below 0.145.
    let expected = [0.45, 0.144, 0.1305];
    assert_eq!(values.len(), 3, "{values:?}");
    assert!(
        values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12),
        "{values:?}"
    );
}

#[test]
fn harvest_and_net_charts_have_measured_points_and_marks() {
    let mut runs = RUNS.to_vec();
    runs.extend([
        ("random", 100, &[0.2, 0.21][..]),
        ("adjusted", 100, &[0.3, 0.31]),
        ("adjusted", 10, &[0.2]),
    ]);
    let results = Results::new(&[fixtures::table("paper", "energy_per_device_tti", &runs)], &NoFiles).expect("runs");
    let condition = &results.conditions[0];
    let points = energy::measure_harvests("paper").expect("harvests");
    assert_eq!(points.len(), 27, "9 λ for each of 3 E_B");
    let harvest = energy::harvest_chart(condition, &points);
    check_properties("harvest", &harvest.scene());
    assert_eq!(harvest.marks.len(), 8, "four for N = 10, four for N = 250");
    assert!(
        harvest.caption.contains(
            "Points: 8 runs with N = 20 and 2000 TTIs, made for this figure under preset paper (not from the \
                table)"
        ),
        "{}",
        harvest.caption
    );
    let net = energy::net_chart(condition, &points).expect("random and adjusted were run");
    check_properties("net", &net.scene());
    assert_eq!(net.marks.len(), 6);
    // Two runs of adjusted: t(1) = 12.706, and half of |0.31 - 0.30|.
    let half_width = net.series[0].points[0].y_half_width;
    assert!((half_width - 12.706 * 0.005).abs() < 1e-5, "half-width {half_width}");
    let is_near = |a: f64, b: f64| (a - b).abs() < 1e-9;
    // Measured points lie on their line: the harvest of its E_B less 0.305, with the variances added.
    let measured = points
        .iter()
        .find(|point| is_near(point.e_b, 5.0) && is_near(point.lambda, 0.1))
        .expect("a measured point");
    // The series after the line has its measured points.
    let points_series = net
        .series
        .iter()
        .skip_while(|series| series.name != "adjusted, E_B = 5")
        .nth(1);
    let drawn = points_series
        .and_then(|series| series.points.iter().find(|point| is_near(point.x, 0.1)))
        .expect("a point at λ = 0.1");
    assert!((drawn.y - (measured.harvested.mean - 0.305)).abs() < 1e-12);
    assert!((drawn.y_half_width.powi(2) - half_width.powi(2) - measured.harvested.half_width.powi(2)).abs() < 1e-12);
    assert!(energy::harvest_csv(&points).lines().count() == 28 && energy::net_csv(&net).lines().count() > 100);
    // A consumption from one run has no interval, so the net energy has none either.
    let one_run = energy_results(&[("random", 100, &[0.2, 0.21]), ("adjusted", 100, &[0.3])]);
    let one_run_net = energy::net_chart(&one_run.conditions[0], &points).expect("random and adjusted were run");
    // Only the first of a policy's series has its name.
    let mut policy = "";
    for series in &one_run_net.series {
        policy = series
            .name
            .split(',')
            .next()
            .filter(|name| !name.is_empty())
            .unwrap_or(policy);
        let has_interval = policy == "random";
        assert!(
            series
                .points
                .iter()
                .all(|point| point.y_half_width.is_finite() == has_interval),
            "{policy}"
        );
    }
    let without_adjusted = energy_results(&[("random", 100, &[0.2])]);
    assert!(energy::net_chart(&without_adjusted.conditions[0], &points).is_none());
}

/// Returns results with these energies per device and TTI.
fn energy_results(runs: &[(&str, u32, &[f64])]) -> Results {
    Results::new(&[fixtures::table("paper", "energy_per_device_tti", runs)], &NoFiles).expect("runs")
}

#[test]
fn tables_are_combined_by_their_runs() {
    let (name, table) = fixtures::table("paper", "mean_battery", &RUNS[..2]);
    let (_, other) = fixtures::table("paper", "mean_battery", &RUNS[2..4]);
    let combined = Results::new(
        &[
            (name.clone(), table.clone()),
            (name.clone(), other),
            (name.clone(), table.clone()),
        ],
        &NoFiles,
    );
    let combined = combined.expect("runs");
    assert_eq!(combined.conditions.len(), 1);
    assert_eq!(combined.conditions[0].policies(), ["knn", "random"]);
    assert_eq!(
        combined.conditions[0].runs("knn", 10).count(),
        3,
        "a run in two tables counts once"
    );
    assert_eq!(combined.conditions[0].label(), "paper");

    let mut changed = table.clone();
    changed
        .rows
        .iter_mut()
        .for_each(|row| row.scenario_hash = Hash([9; 32]));
    let separate = Results::new(
        &[(name.clone(), table.clone()), ("mine.parquet".to_owned(), changed)],
        &NoFiles,
    )
    .expect("runs");
    assert_eq!(
        separate.conditions.len(),
        2,
        "another scenario under the same preset is another condition"
    );
    assert_eq!(separate.conditions[1].label(), "paper, changed as in mine.parquet");
    assert_eq!(separate.file_labels(), ["paper", "paper-mine"]);

    let mut contradicting = table.clone();
    contradicting.rows[0].digest = Hash([7; 32]);
    let refused = Results::new(
        &[(name.clone(), table.clone()), (name.clone(), contradicting)],
        &NoFiles,
    );
    assert!(matches!(refused, Err(FigureError::Contradiction { .. })), "{refused:?}");

    let empty = Table {
        rows: Vec::new(),
        ..table
    };
    let refused = Results::new(&[(name, empty)], &NoFiles).expect_err("nothing to draw");
    assert!(
        refused.to_string().contains("paper.parquet: the table has no runs"),
        "{refused}"
    );
}

#[test]
fn tables_with_equal_names_get_distinct_labels() {
    let (_, table) = fixtures::table("paper", "mean_battery", &RUNS[..2]);
    let table_with = |hash: u8| {
        let mut changed = table.clone();
        let rows = changed.rows.iter_mut();
        rows.for_each(|row| row.scenario_hash = Hash([hash; 32]));
        changed
    };
    let names = ["a/results.parquet", "b/results.parquet", "c/b/results.parquet"];
    let tables: Vec<(String, Table)> = (1..)
        .zip(names)
        .map(|(hash, name)| (name.to_owned(), table_with(hash)))
        .collect();
    let labels = Results::new(&tables, &NoFiles).expect("runs").file_labels();
    assert_eq!(labels, ["paper-a-results", "paper-b-results", "paper-b-results-2"]);
}

#[test]
fn a_field_set_by_the_experiment_is_in_the_label() {
    let changed = scenario_with(&[
        "events.alpha=0.3",
        "devices=10",
        "ttis=2000",
        "seed=1",
        "policy.name=knn",
    ]);
    let (name, mut table) = fixtures::table("paper", "mean_battery", &[("knn", 10, &[1.0])]);
    table.rows[0].scenario_hash = Hash(changed.hash());
    table.metadata.experiment = "scenario = \"paper\"\n\n[set]\n\"events.alpha\" = 0.3\n".to_owned();
    let results = Results::new(&[(name, table)], &NoFiles).expect("runs");
    let condition = &results.conditions[0];
    assert_eq!(condition.label(), "paper, events.alpha = 0.3");
    assert!(!condition.is_unchanged_preset() && condition.scenario.as_ref() == Some(&changed));
    assert_eq!(results.file_labels(), ["paper-events.alpha-0.3"]);
}

#[test]
fn runs_with_actions_are_another_condition() {
    let plain = fixtures::table("paper", "info_p1", &[("knn", 10, &[0.1, 0.2])]);
    let (mut name, mut acted) = fixtures::table("paper", "info_p1", &[("knn", 10, &[0.3, 0.5])]);
    name.insert_str(0, "acted-");
    acted.metadata.experiment += "action_script = \"5 fail 3\"\n";
    for row in &mut acted.rows {
        row.digest.0[0] ^= 1;
    }
    // Their scenarios are equal, but not their outcomes.
    let results = Results::new(&[plain, (name, acted)], &NoFiles).expect("runs");
    let means = results.conditions.iter().map(|condition| {
        let estimate = condition.estimate("knn", 10, "info_p1").expect("runs");
        (condition.is_unchanged_preset(), format!("{:.2}", estimate.mean))
    });
    assert_eq!(
        means.collect::<Vec<_>>(),
        [(true, "0.15".to_owned()), (false, "0.40".to_owned())]
    );
    assert_eq!(
        results.conditions[1].label(),
        "paper, with the actions of acted-paper.parquet"
    );
    assert_eq!(results.file_labels(), ["paper", "paper-acted-paper"]);
}

#[test]
fn figures_are_selected_by_name() {
    let select = |wanted: &[&str]| {
        let wanted: Vec<String> = wanted.iter().map(|name| (*name).to_owned()).collect();
        study::select_figures(&wanted, &energy::NAMES)
            .map(|figures| figures.iter().map(|figure| figure.name).collect::<Vec<_>>())
    };
    assert_eq!(select(&["energy", "information"]), Ok(vec!["information", "energy"]));
    assert_eq!(select(&[]).map(|names| names.len()), Ok(8));
    assert_eq!(select(&["net"]), Ok(vec![]));
    let refused = select(&["energie"]).expect_err("no such figure").to_string();
    assert!(
        refused.contains("`energie`") && refused.contains("wasted, harvest, net"),
        "{refused}"
    );
}

#[test]
fn policies_that_miss_no_event_have_no_band() {
    let runs: [(&str, u32, &[f64]); 5] = [
        ("knn", 10, &[33.0, 35.0, 31.0]),
        ("knn", 50, &[20.0, 21.0, 22.0]),
        ("knn", 250, &[0.0, 0.0, 0.0]),
        ("genie", 10, &[0.0, 0.0, 0.0]),
        ("genie", 250, &[0.0, 0.0, 0.0]),
    ];
    let band_count = |name: &str, metric: &str| {
        let results = Results::new(&[fixtures::table("paper", metric, &runs)], &NoFiles).expect("runs");
        let drawing = figure_named(name).draw(&results.conditions[0]).expect("runs");
        let is_band = |item: &SceneItem| match item {
            SceneItem::Shape(shape) => shape.fill.is_some_and(|(_, opacity)| (0.2..0.3).contains(&opacity)),
            SceneItem::Text(_) => false,
        };
        drawing.chart.scene().items.iter().filter(|item| is_band(item)).count()
    };
    // On the logarithmic axis, only the two values of knn above 0 have one.
    assert_eq!(band_count("misdetection", "misdetection_pct"), 1);
    assert_eq!(band_count("low-energy", "low_energy_pct"), 2);
}
