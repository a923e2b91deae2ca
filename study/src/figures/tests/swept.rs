//! Tests of sweeps over a field, and over the ranking of wake-ups.

use reveille_common::declare::NoFiles;

use super::super::results::{Results, fixtures};
use super::super::{energy, pareto, study};
use super::check;
use reveille_lab::table::{Hash, SweptValue};

fn text(value: &str) -> SweptValue {
    SweptValue::Text(value.to_owned())
}

#[test]
fn rankings_are_series_of_one_picture() {
    let figure = study::FIGURES[0];
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
        // Runs of random do not differ by ranking.
        if &*row.policy != "random" {
            row.digest = row.scenario_hash;
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
    let drawing = figure.draw(condition).expect("a figure");
    check("rankings", &drawing.chart.scene());
    let names: Vec<&str> = drawing.chart.series.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["knn", "knn+posterior", "random"]);
    let [plain, ranked] = [&drawing.chart.series[0], &drawing.chart.series[1]];
    assert!((plain.points[0].y - 0.21).abs() < 1e-12 && (ranked.points[0].y - 0.31).abs() < 1e-12);
    assert!(plain.style.paint == ranked.style.paint && plain.style.marker != ranked.style.marker);
    assert!(
        figure
            .csv(condition, &drawing)
            .contains("measured,paper,knn+posterior,10,info_p1,0.31")
    );
    let pareto = pareto::INFORMATION_TRADE_OFF.chart(&[condition]).expect("a picture");
    assert_eq!(pareto.series.len(), 3);
}

#[test]
fn tables_of_different_rankings_share_a_picture() {
    let runs: [(&str, u32, &[f64]); 1] = [("knn", 10, &[0.2, 0.22])];
    let plain = fixtures::table("paper", "info_p1", &runs);
    let ranked = [("knn", 10, text("posterior"), &[0.3, 0.32][..])];
    let (_, mut ranked) = fixtures::swept("paper", "info_p1", "bs.ranking", &ranked);
    ranked.schema.swept.clear();
    ranked.metadata.experiment += "[set]\n\"bs.ranking\" = \"posterior\"\n";
    for row in &mut ranked.rows {
        row.swept = std::sync::Arc::from([]);
        row.digest = Hash([9; 32]);
    }
    let both = Results::new(&[plain, ("b".to_owned(), ranked.clone())], &NoFiles).expect("runs");
    assert_eq!(both.conditions.len(), 1);
    assert_eq!(both.conditions[0].policies(), ["knn", "knn+posterior"]);
    let alone = Results::new(&[("b".to_owned(), ranked)], &NoFiles).expect("runs");
    assert_eq!(alone.conditions[0].policies(), ["knn"], "there is no other policy");
    assert_eq!(alone.conditions[0].label(), "paper, bs.ranking = posterior");
}

#[test]
fn settings_that_are_not_the_papers_have_neither_its_titles_nor_its_marks() {
    let runs: [(&str, u32, SweptValue, &[f64]); 6] = [
        ("adjusted", 250, SweptValue::Float(0.1), &[0.2, 0.3]),
        ("adjusted", 250, SweptValue::Float(0.2), &[0.2, 0.3]),
        ("adjusted", 100, SweptValue::Float(0.1), &[0.2, 0.3]),
        ("random", 100, SweptValue::Float(0.1), &[0.3, 0.3]),
        ("adjusted", 100, SweptValue::Float(0.2), &[0.2, 0.3]),
        ("random", 100, SweptValue::Float(0.2), &[0.3, 0.3]),
    ];
    let figure = study::FIGURES[4];
    let table = fixtures::swept("paper", "energy_per_device_tti", "harvest.lambda", &runs);
    let results = Results::new(&[table], &NoFiles).expect("runs");
    let points = energy::measure_harvests("paper").expect("harvests");
    let [own, other] = &results.conditions[..] else {
        panic!("{:?}", results.file_labels())
    };
    assert!(
        own.is_unchanged_preset() && !other.is_unchanged_preset(),
        "λ = 0.1 is the preset's"
    );
    for (condition, marked) in [(own, true), (other, false)] {
        let charts = [
            figure.draw(condition).expect("a figure").chart,
            energy::harvest_chart(condition, &points),
            energy::net_chart(condition, &points).expect("both were run"),
            pareto::INFORMATION_TRADE_OFF.chart(&[condition]).expect("a picture"),
        ];
        for chart in &charts {
            assert_eq!(chart.title.contains("Fig"), marked, "{}", chart.title);
            assert_eq!(chart.title.contains("harvest.lambda = 0.2"), !marked, "{}", chart.title);
            assert!(marked || !chart.caption.contains("paper states") && !chart.caption.contains("ollow"));
        }
        assert_eq!(charts.iter().any(|chart| !chart.marks.is_empty()), marked);
        assert_eq!(charts.iter().any(|chart| !chart.spans.is_empty()), marked);
        check("not-the-paper", &charts[0].scene());
    }
}
