//! Tests of the trade-offs of information and delay against energy: along N, and along the values of a policy's field.

use reveille_common::declare::NoFiles;
use reveille_lab::table::{Hash, SweptValue};

use super::super::results::RunCondition;
use super::super::{front, pareto};
use super::{Results, check_properties, fixtures};

#[test]
fn delay_has_a_separate_figure_without_marks() {
    let runs: [(&str, u32, &[f64]); 3] = [
        ("knn", 250, &[0.1, 0.2]),
        ("knn", 10, &[2.0, 2.5]),
        ("genie", 10, &[0.0, 0.0]),
    ];
    let results = Results::new(&[fixtures::table("paper", "detection_delay_ttis", &runs)], &NoFiles).expect("runs");
    let condition = &results.conditions[0];
    let chart = pareto::DELAY_TRADE_OFF.chart(&[condition]).expect("a picture");
    check_properties("delay", &chart.scene());
    let knn: Vec<f64> = chart.series[0].points.iter().map(|sample| sample.y).collect();
    assert!(
        (knn[0] - 2.25).abs() < 1e-12 && (knn[1] - 0.15).abs() < 1e-12,
        "{knn:?}"
    );
    assert!(
        chart.marks.is_empty() && chart.title == "Delay of detection against energy",
        "{}",
        chart.title
    );
    assert!(chart.caption.contains("Down and to the left"), "{}", chart.caption);
    let csv = pareto::DELAY_TRADE_OFF.csv(&[condition]);
    assert!(
        csv.contains(",detection_delay_ttis,delay_half_width_95,") && csv.lines().count() == 4,
        "{csv}"
    );
}

#[test]
fn the_energy_floor_has_the_information_of_the_genie() {
    let runs: [(&str, u32, &[f64]); 5] = [
        ("knn", 250, &[0.4, 0.5]),
        ("knn", 10, &[0.1, 0.1]),
        ("genie", 250, &[0.6, 0.62]),
        ("genie", 100, &[0.4, 0.42]),
        ("genie", 10, &[0.1, 0.12]),
    ];
    let results = Results::new(&[fixtures::table("paper", "info_p1", &runs)], &NoFiles).expect("runs");
    let chart = pareto::INFORMATION_TRADE_OFF
        .chart(&[&results.conditions[0]])
        .expect("a picture");
    let floor = chart
        .series
        .iter()
        .find(|line| line.name == "energy floor")
        .expect("a floor");
    let ys: Vec<f64> = floor.points.iter().map(|sample| sample.y).collect();
    // Ten devices cannot harvest enough for the floor.
    assert!(
        ys.len() == 2 && (ys[0] - 0.41).abs() < 1e-12 && (ys[1] - 0.61).abs() < 1e-12,
        "{ys:?}"
    );
    // The least covers of study/data/cover.csv: 16 of 100 devices sense, and about 14 of 250. The others pay E_WuR =
    // 1/14 in each TTI, and the reports of all cost 2 units.
    let expected = (16.0 + 84.0 / 14.0 + 2.0) / 100.0;
    assert!((floor.points[0].x - expected).abs() < 1e-5, "{floor:?}");
    assert!((0.12..0.14).contains(&floor.points[1].x), "{floor:?}");
    let notes: Vec<&str> = chart.notes.iter().map(|note| note.text.as_str()).collect();
    let hundreds = notes.iter().filter(|text| **text == "100").count();
    assert_eq!(hundreds, 2, "one note at the genie and one at the floor: {notes:?}");
    assert!(chart.caption.contains("Energy floor"), "{}", chart.caption);
    check_properties("pareto-floor", &chart.scene());
}

#[test]
fn the_values_of_a_field_form_a_line_for_each_n() {
    let text = |value: &str| SweptValue::Text(value.to_owned());
    let runs: [(&str, u32, SweptValue, &[f64]); 6] = [
        ("random", 50, text("[8, 16]"), &[0.2, 0.22]),
        ("genie", 50, text("[8, 16]"), &[0.6, 0.62]),
        ("random", 50, text("[2, 4]"), &[0.4, 0.42]),
        ("genie", 50, text("[2, 4]"), &[0.6, 0.62]),
        ("random", 10, text("[2, 4]"), &[0.1, 0.12]),
        ("genie", 10, text("[2, 4]"), &[0.3, 0.32]),
    ];
    let (name, mut table) = fixtures::swept("paper", "info_p1", "policy.random.t_drx", &runs);
    // Equal digests mean that the field of `random` does not affect the genie.
    for row in &mut table.rows {
        if &*row.policy == "genie" {
            row.digest = Hash([row.seed as u8; 32]);
        }
    }
    let results = Results::new(&[(name, table)], &NoFiles).expect("runs");
    let conditions: Vec<&RunCondition> = results.conditions.iter().collect();
    let fronts = front::draw_fronts(&conditions);
    let [front] = &fronts[..] else {
        panic!("{:?}", fronts.iter().map(|front| front.n).collect::<Vec<_>>())
    };
    assert_eq!(
        (front.n, front.other_changes.len()),
        (50, 0),
        "N = 10 has one value, which is not a line"
    );
    let names: Vec<&str> = front.chart.series.iter().map(|line| line.name.as_str()).collect();
    assert_eq!(names, ["random", "genie", "relaxed bound", "energy floor"]);
    let ys: Vec<f64> = front.chart.series[0].points.iter().map(|sample| sample.y).collect();
    assert_eq!(ys.len(), 2);
    assert_eq!(
        front.chart.series[1].points.len(),
        1,
        "the field of random does not affect the genie"
    );
    let notes: Vec<&str> = front.chart.notes.iter().map(|note| note.text.as_str()).collect();
    assert_eq!(notes, ["[8, 16]", "[2, 4]"]);
    assert_eq!(front.csv.lines().count(), 4);
    check_properties("front", &front.chart.scene());
}
