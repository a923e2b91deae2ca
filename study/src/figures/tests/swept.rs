//! Tests of the figures of the paper for sweeps over a field, and over the ranking of wake-ups. Also of
//! [`SweptNumbers`] and of the groups of conditions for trade-offs.

use reveille_common::declare::NoFiles;

use super::super::results::{Results, fixtures};
use super::super::sweep::SweptNumbers;
use super::super::{energy, pareto};
use super::{check_properties, figure_named};
use reveille_lab::table::{Hash, SweptValue};

fn text(value: &str) -> SweptValue {
    SweptValue::Text(value.to_owned())
}

#[test]
fn rankings_are_series_of_one_figure() {
    let figure = figure_named("information");
    let runs: [(&str, u32, SweptValue, &[f64]); 6] = [
        ("knn", 10, text("posterior"), &[0.3, 0.32]),
        ("knn", 50, text("posterior"), &[0.4, 0.42]),
        ("random", 10, text("posterior"), &[0.1, 0.1]),
        ("knn", 10, text("p42"), &[0.2, 0.22]),
        ("knn", 50, text("p42"), &[0.25, 0.27]),
        ("random", 10, text("p42"), &[0.1, 0.1]),
    ];
    let (name, mut table) = fixtures::swept("paper", figure.metric, "bs.ranking", &runs);
    for row in &mut table.rows {
        // The runs of random do not differ by ranking, so both have the digest of their seed.
        if &*row.policy == "random" {
            row.digest = Hash([row.seed as u8; 32]);
        }
    }
    let results = Results::new(&[(name, table)], &NoFiles).expect("runs");
    let [condition] = &results.conditions[..] else {
        panic!("{:?}", results.file_labels())
    };
    assert_eq!(condition.policies(), ["knn", "knn+posterior", "random"]);
    assert_eq!(
        (condition.label().as_str(), condition.is_unchanged_preset()),
        ("paper", true)
    );
    assert_eq!(condition.runs("random", 10).count(), 2);
    assert_eq!(results.by_ranking.len(), 2);
    assert_eq!(condition.ranking_indices, [1, 0], "the paper's ranking first");
    let drawn = figure.draw(condition).expect("a figure");
    check_properties("rankings", &drawn.chart.scene());
    let names: Vec<&str> = drawn.chart.series.iter().map(|series| series.name.as_str()).collect();
    assert_eq!(names, ["knn", "knn+posterior", "random"]);
    let [p42, posterior] = [&drawn.chart.series[0], &drawn.chart.series[1]];
    assert!((p42.points[0].y - 0.21).abs() < 1e-12 && (posterior.points[0].y - 0.31).abs() < 1e-12);
    assert!(p42.style.paint == posterior.style.paint && p42.style.marker != posterior.style.marker);
    assert!(
        figure
            .csv(condition, &drawn)
            .contains("measured,paper,knn+posterior,10,info_p1,0.31")
    );
    let trade_off = pareto::INFORMATION_TRADE_OFF.chart(&[condition]).expect("a picture");
    assert_eq!(trade_off.series.len(), 3);
}

#[test]
fn tables_of_different_rankings_share_a_figure() {
    let runs: [(&str, u32, &[f64]); 1] = [("knn", 10, &[0.2, 0.22])];
    let p42 = fixtures::table("paper", "info_p1", &runs);
    let runs = [("knn", 10, text("posterior"), &[0.3, 0.32][..])];
    let (_, mut posterior) = fixtures::swept("paper", "info_p1", "bs.ranking", &runs);
    posterior.schema.swept.clear();
    posterior.metadata.experiment += "[set]\n\"bs.ranking\" = \"posterior\"\n";
    for row in &mut posterior.rows {
        row.swept = std::sync::Arc::from([]);
        row.digest = Hash([9; 32]);
    }
    let merged = Results::new(&[p42, ("b".to_owned(), posterior.clone())], &NoFiles).expect("runs");
    assert_eq!(merged.conditions.len(), 1);
    assert_eq!(merged.conditions[0].policies(), ["knn", "knn+posterior"]);
    let alone = Results::new(&[("b".to_owned(), posterior)], &NoFiles).expect("runs");
    assert_eq!(alone.conditions[0].policies(), ["knn"], "one ranking needs no label");
    assert_eq!(alone.conditions[0].label(), "paper, bs.ranking = posterior");
}

#[test]
fn changed_settings_have_no_titles_or_marks_of_the_paper() {
    let runs: [(&str, u32, SweptValue, &[f64]); 6] = [
        ("adjusted", 250, SweptValue::Float(0.1), &[0.2, 0.3]),
        ("adjusted", 250, SweptValue::Float(0.2), &[0.2, 0.3]),
        ("adjusted", 100, SweptValue::Float(0.1), &[0.2, 0.3]),
        ("random", 100, SweptValue::Float(0.1), &[0.3, 0.3]),
        ("adjusted", 100, SweptValue::Float(0.2), &[0.2, 0.3]),
        ("random", 100, SweptValue::Float(0.2), &[0.3, 0.3]),
    ];
    let figure = figure_named("low-energy");
    let table = fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let points = energy::measure_harvests("paper").expect("harvests");
    let [preset, changed] = &results.conditions[..] else {
        panic!("{:?}", results.file_labels())
    };
    assert!(
        preset.is_unchanged_preset() && !changed.is_unchanged_preset(),
        "λ = 0.1 is the value of the preset"
    );
    for (condition, is_paper) in [(preset, true), (changed, false)] {
        let charts = [
            figure.draw(condition).expect("a figure").chart,
            energy::harvest_chart(condition, &points),
            energy::net_chart(condition, &points).expect("random and adjusted have runs"),
            pareto::INFORMATION_TRADE_OFF.chart(&[condition]).expect("a picture"),
        ];
        for chart in &charts {
            assert_eq!(chart.title.contains("Fig"), is_paper, "{}", chart.title);
            assert_eq!(
                chart.title.contains("harvest.lambda = 0.2"),
                !is_paper,
                "{}",
                chart.title
            );
            assert!(is_paper || !chart.caption.contains("paper states") && !chart.caption.contains("ollow"));
        }
        assert_eq!(charts.iter().any(|chart| !chart.marks.is_empty()), is_paper);
        assert_eq!(charts.iter().any(|chart| !chart.spans.is_empty()), is_paper);
        check_properties("not-the-paper", &charts[0].scene());
    }
}

#[test]
fn numeric_fields_of_a_sweep_are_found() {
    let field_of = |path: &str, values: &[SweptValue]| {
        let runs: Vec<(&str, u32, SweptValue, &[f64])> = values
            .iter()
            .map(|value| ("random", 10, value.clone(), &[0.3, 0.4][..]))
            .collect();
        let table = fixtures::swept("paper", "energy_per_device_tti", path, &runs);
        SweptNumbers::of_results(&Results::new(&[table], &NoFiles).expect("runs"))
    };
    let float = SweptValue::Float;
    let found = field_of("harvest.lambda", &[float(0.4), float(0.1), float(0.01)]);
    let [lambda] = found.as_slice() else {
        panic!("{found:?}")
    };
    assert_eq!(
        (lambda.field.as_str(), lambda.values.as_slice()),
        ("harvest.lambda", &[0.01, 0.1, 0.4][..])
    );
    assert!(lambda.is_wide(), "a factor of 40");
    assert!(
        !field_of("harvest.lambda", &[float(0.0), float(0.4)])[0].is_wide(),
        "0 has no logarithm"
    );
    assert!(field_of("harvest.lambda", &[float(0.4)]).is_empty(), "one value");
    assert!(
        field_of("layout.kind", &[text("grid"), text("hex")]).is_empty(),
        "no numbers"
    );
}

#[test]
fn conditions_are_grouped_by_preset_and_length() {
    let short = fixtures::table("paper", "info_p1", &[("knn", 10, &[0.3, 0.4])]);
    let mut long = fixtures::table("paper", "info_p1", &[("knn", 10, &[0.3, 0.4])]);
    long.0 = "long".to_owned();
    for row in &mut long.1.rows {
        row.ttis = 90_000;
        row.scenario_hash = Hash([7; 32]);
    }
    let labels = |tables: &[(String, reveille_lab::table::Table)]| {
        let results = Results::new(tables, &NoFiles).expect("runs");
        results
            .by_preset_and_length()
            .into_iter()
            .map(|(label, _)| label)
            .collect::<Vec<_>>()
    };
    assert_eq!(labels(std::slice::from_ref(&short)), ["paper"]);
    assert_eq!(labels(&[short, long]), ["paper-k2000", "paper-k90000"]);
}
