//! Tests of figures of q-learning's tables and learning curves, and of information against energy. Cells are compared
//! with the values that `learned_tables` fills in; limits of files and rows are literals of `learning`.

use reveille_bs::policy::q_learning::learned::{
    AREA_BUCKETS, BATTERY_BUCKETS, CurvePoint, LearnedTables, Lookback, QTrainingConfig, QWeights, Schedule, TableSet,
    TrainingSite,
};
use reveille_common::declare::NoFiles;
use reveille_common::scenario::WakeUpRanking;

use super::super::heat::KnowledgeDegree;
use super::super::{learning, pareto, q_table};
use super::{FigureError, Results, check_properties, fixtures, scenario_with};

/// Returns untrained tables for `n` devices.
fn untrained(n: u32, weights: &QWeights) -> TableSet {
    TableSet::optimistic(
        &scenario_with(&[&format!("devices={n}")]).site(),
        weights,
        Lookback::Window(4),
        1.0,
    )
}

/// Returns tables for each of these N, with some learned cells and a learning curve of `episodes` points.
fn learned_tables(device_counts: &[u32], episodes: u64) -> LearnedTables {
    let weights = QWeights {
        mu1: 14.0,
        mu2: 1.6,
        zeta: 0.95,
    };
    let entry = |&n: &u32| {
        let mut entry = untrained(n, &weights);
        let rates = Schedule::default().rates();
        // Battery bucket 5 is known in all areas; two cells elsewhere have one action that was tried.
        for area in 0..AREA_BUCKETS {
            for delta in [false, true] {
                let cell = entry.duty.at_mut(5, area, delta);
                cell.value = 20.0 + if delta { f64::from(n) * (area as f64 - 7.5) } else { 0.0 };
                cell.visits = 3;
            }
        }
        entry.duty.at_mut(4, 2, true).learn(-1000.0, rates);
        entry.duty.at_mut(1, 15, false).learn(-1000.0, rates);
        *entry.wake_posterior.at_mut([19, 0, 0]) = (f64::from(n), 7).into();
        *entry.wake_posterior.at_mut([3, 1, 3]) = (-0.25, 20).into();
        let point = |episode: u64| CurvePoint {
            ttis: 3000 * (episode + 1),
            reward: 1.0 - 3.0 / f64::from(n) + 0.001 * episode as f64,
            information: 0.002 * f64::from(n),
            energy: 0.3,
        };
        entry.curve = (0..episodes).map(point).collect();
        entry
    };
    LearnedTables {
        made_by: "reveille 0.1.0".to_owned(),
        scenario: "00".to_owned(),
        weights,
        begun_from: None,
        schedule: Schedule::default(),
        training: QTrainingConfig {
            episodes,
            ttis: 3000,
            epsilon: (0.1, 0.03),
            seed: 1,
        },
        site: TrainingSite::from_site(&scenario_with(&[]).site()),
        entries: device_counts.iter().map(entry).collect(),
    }
}

fn named_tables(name: &str, device_counts: &[u32], episodes: u64) -> learning::NamedTables {
    (name.to_owned(), learned_tables(device_counts, episodes))
}

#[test]
fn learning_curves_have_the_n_and_window_of_each_row() {
    let ten = [10, 20, 40, 60, 80, 100, 130, 160, 200, 250];
    for sources in [
        vec![named_tables("one.json", &[50], 1)],
        vec![named_tables("ten.json", &ten, 12)],
        vec![
            named_tables("ten.json", &ten, 12),
            named_tables(&"long/".repeat(99), &[50, 1_000_000], 300),
        ],
    ] {
        let scene = learning::scene(&sources).expect("a picture");
        check_properties("learning", &scene);
        let mut device_counts: Vec<u32> = sources
            .iter()
            .flat_map(|(_, tables)| &tables.entries)
            .map(|entry| entry.devices)
            .collect();
        device_counts.sort_unstable();
        device_counts.dedup();
        let text = super::svg::svg(&scene, "learning");
        assert!(text.contains("μ1 = 14, μ2 = 1.6, ζ = 0.95"), "{}", scene.description);
        for n in device_counts {
            let name = format!("N = {n}");
            assert!(
                scene
                    .items
                    .iter()
                    .any(|item| matches!(item, super::SceneItem::Text(text) if text.text == name)),
                "{name}"
            );
        }
    }
    // Rows with different windows are labelled.
    let mut two_windows = named_tables("two.json", &[50], 2);
    let mut other_window = two_windows.1.entries[0].clone();
    other_window.lookback = Lookback::Window(7);
    two_windows.1.entries.push(other_window);
    let scene = learning::scene(&[two_windows]).expect("a picture");
    assert!(
        scene.description.contains("a window of 4 TTIs, a window of 7 TTIs"),
        "{}",
        scene.description
    );
    for name in ["window 4", "window 7"] {
        let is_named =
            |item: &super::SceneItem| matches!(item, super::SceneItem::Text(text) if text.text.contains(name));
        assert!(scene.items.iter().any(is_named), "{name}");
    }
    let csv = learning::csv(&[named_tables("a,b.json", &[10, 50], 3)]);
    assert_eq!(csv.lines().count(), 7);
    assert!(csv.contains("\"a,b.json\",4,50,400,6000,0.941,0.1,0.3\n"), "{csv}");
}

#[test]
fn missing_curves_and_too_many_files_are_refused() {
    let error_of = |sources: &[learning::NamedTables]| learning::scene(sources).expect_err("no picture").to_string();
    let without_curve = error_of(&[named_tables("a.json", &[10], 2), named_tables("bare.json", &[10], 0)]);
    assert!(
        without_curve.contains("bare.json") && without_curve.contains("no learning curve"),
        "{without_curve}"
    );
    let seven_files: Vec<_> = (0..7).map(|_| named_tables("a.json", &[10], 2)).collect();
    assert!(error_of(&seven_files).contains("7 files"));
    let device_counts: Vec<u32> = (1..=41).collect();
    assert!(error_of(&[named_tables("a.json", &device_counts, 2)]).contains("41 tables of different N"));
}

#[test]
fn tables_with_few_or_no_learned_cells_can_be_drawn() {
    let mut all = vec![learned_tables(&[10, 250], 2), learned_tables(&[1_000_000], 2)];
    let mut untrained_tables = learned_tables(&[50], 0);
    untrained_tables.entries[0] = untrained(50, &untrained_tables.weights);
    untrained_tables.site.numbers.clear();
    all.push(untrained_tables);
    for learned in &all {
        for entry in &learned.entries {
            check_properties("q-table", &q_table::duty_scene(learned, entry));
            for ranking in [WakeUpRanking::P42, WakeUpRanking::Posterior] {
                check_properties("wake", &q_table::wake_scene(learned, entry, ranking));
            }
        }
    }
}

#[test]
fn a_cell_shows_the_advantage_and_is_framed_if_the_policy_senses() {
    let learned = learned_tables(&[10], 1);
    let entry = q_table::find_table_set("a.json", &learned, 10, None).expect("an entry");
    let map = q_table::duty_map(&learned, entry);
    // 10 · (area − 7.5): negative up to area 7.
    let row = &map.cells[5];
    assert!(
        (row[0].value + 75.0).abs() < 1e-9 && (row[15].value - 75.0).abs() < 1e-9,
        "{row:?}"
    );
    let framed: Vec<bool> = row.iter().map(|cell| cell.is_framed).collect();
    assert_eq!(framed, (0..AREA_BUCKETS).map(|area| area > 7).collect::<Vec<_>>());
    assert!(
        !map.cells[1][15].is_framed && map.cells[1][15].value > 0.0,
        "positive, but a device with this battery cannot report"
    );
    assert_eq!(
        (
            map.count(KnowledgeDegree::Known),
            map.count(KnowledgeDegree::PartlyKnown)
        ),
        (AREA_BUCKETS, 2)
    );
    assert_eq!(
        map.count(KnowledgeDegree::Unknown),
        BATTERY_BUCKETS * AREA_BUCKETS - (AREA_BUCKETS + 2)
    );
    let csv = q_table::duty_csv(&learned, entry);
    assert_eq!(csv.lines().count(), 1 + BATTERY_BUCKETS * AREA_BUCKETS);
    let row_5 = csv.lines().find(|line| line.starts_with("5,")).expect("the row");
    assert!(row_5.ends_with(",20,3,-55,3,-75,-75,0"), "{row_5}");
    let wake = q_table::wake_csv(entry, WakeUpRanking::Posterior);
    assert!(wake.contains("\n1,0.7071067811865476,1,0,0.03,10,7,10,1\n"), "{wake}");
    // Pooled with the three cells below, each 1 and never visited: (3 · 1 − 21 · 0.25) / 24.
    let cell = wake
        .lines()
        .find(|line| line.contains(",0.00390625,0.03,0.08,-0.25,20,"));
    let cell: Vec<f64> = cell
        .expect("the cell")
        .split(',')
        .map(|number| number.parse().expect("a number"))
        .collect();
    assert!((cell[7] + 0.09375).abs() < 1e-12 && cell[8].abs() < 0.5, "{cell:?}");
    let text = q_table::duty_scene(&learned, entry).description;
    for part in [
        "μ1 = 14, μ2 = 1.6, ζ = 0.95",
        "with N = 10 on 400 m²",
        "sensing.d_max = 4",
        "the immediate reward",
    ] {
        assert!(text.contains(part), "no {part:?} in {text}");
    }
}

#[test]
fn a_missing_n_or_window_lists_the_available_ones() {
    let missing_n = q_table::find_table_set("a.json", &learned_tables(&[10, 250], 1), 50, Some(Lookback::Window(4)))
        .expect_err("no entry");
    assert!(matches!(missing_n, FigureError::NoEntry { devices: 50, .. }));
    let text = missing_n.to_string();
    assert!(text.contains("N = 50: a.json has tables for 10, 250 devices"), "{text}");
    let missing_window = q_table::find_table_set("a.json", &learned_tables(&[10], 1), 10, Some(Lookback::Window(2)))
        .expect_err("no entry");
    let text = missing_window.to_string();
    assert!(
        text.contains("no devices with a window of 2") && text.contains("for a window of 4"),
        "{text}"
    );
}

#[test]
fn information_against_energy_has_intervals_in_both_directions() {
    let runs: [(&str, u32, &[f64]); 5] = [
        ("knn", 250, &[0.4, 0.5, 0.6]),
        ("knn", 10, &[0.1, 0.1]),
        ("q-learning", 250, &[0.7]),
        ("q-learning", 50, &[f64::NAN]),
        ("dt", 10, &[f64::NAN]),
    ];
    let results = Results::new(&[fixtures::table("paper", "info_p1", &runs)], &NoFiles).expect("runs");
    let condition = &results.conditions[0];
    let chart = pareto::INFORMATION_TRADE_OFF.chart(&[condition]).expect("a picture");
    check_properties("pareto", &chart.scene());
    let names: Vec<&str> = chart.series.iter().map(|series| series.name.as_str()).collect();
    assert_eq!(names, ["knn", "q-learning"], "dt has no information");
    let knn = &chart.series[0].points;
    assert!(
        (knn[0].y - 0.1).abs() < 1e-12 && (knn[1].y - 0.5).abs() < 1e-12,
        "in order of N: {knn:?}"
    );
    // t(2) = 4.302653, and 0.1 / √3.
    assert!(
        (knn[1].y_half_width - 4.302_653 * 0.1 / 3.0_f64.sqrt()).abs() < 1e-5,
        "{knn:?}"
    );
    assert!(knn[1].x_half_width.abs() < 1e-12 && chart.series[1].points[0].x_half_width.is_nan());
    let notes: Vec<&str> = chart.notes.iter().map(|note| note.text.as_str()).collect();
    assert_eq!(notes, ["250", "250", "10"], "the ends of lines");
    // Values that the paper states for both metrics: knn 0.145 and 0.4, q-learning 0.24 and 0.72.
    let marks: Vec<(f64, f64)> = chart
        .marks
        .iter()
        .map(|mark| (mark.x, mark.stated.values()[0]))
        .collect();
    assert_eq!(marks, [(0.145, 0.4), (0.24, 0.72)]);
    assert!(
        chart.caption.contains("Hollow marks are for N = 250;"),
        "{}",
        chart.caption
    );
    let csv = pareto::INFORMATION_TRADE_OFF.csv(&[condition]);
    assert_eq!(csv.lines().count(), 4);
    let undefined = fixtures::table("paper", "info_p1", &[("knn", 10, &[f64::NAN])]);
    assert!(
        pareto::INFORMATION_TRADE_OFF
            .chart(&[&Results::new(&[undefined], &NoFiles).expect("runs").conditions[0]])
            .is_none()
    );
}

#[test]
fn each_setting_has_a_separate_pareto_figure() {
    let (name, table) = fixtures::table("paper", "info_p1", &[("knn", 10, &[0.1, 0.2])]);
    let (literal_name, literal) = fixtures::table("paper-literal", "info_p1", &[("knn", 10, &[0.3, 0.2])]);
    let results = Results::new(&[(name, table), (literal_name, literal)], &NoFiles).expect("runs");
    let captions = results
        .conditions
        .iter()
        .filter_map(|condition| pareto::INFORMATION_TRADE_OFF.chart(&[condition]))
        .map(|chart| chart.caption);
    let captions: Vec<String> = captions.collect();
    assert!(captions[0].starts_with("Preset paper;") && captions[1].starts_with("Preset paper-literal;"));
}

#[test]
fn combined_settings_have_a_line_for_each_policy_and_equal_runs_once() {
    let [preset, mut uniform] = [
        &[("knn", 10, &[0.1, 0.2][..]), ("q-learning", 10, &[0.3, 0.4])],
        &[("knn", 10, &[0.2, 0.2][..]), ("q-learning", 10, &[0.5, 0.4])],
    ]
    .map(|runs| fixtures::table("paper", "info_p1", runs).1);
    uniform.metadata.experiment += "[set]\n\"layout.kind\" = \"uniform\"\n";
    for row in &mut uniform.rows {
        let set = [
            "layout.kind=uniform",
            "devices=10",
            "ttis=2000",
            &format!("seed={}", row.seed),
            &format!("policy.name={}", row.policy),
        ];
        row.scenario_hash = reveille_lab::table::Hash(scenario_with(&set).hash());
        row.digest = if &*row.policy == "knn" {
            row.digest
        } else {
            row.scenario_hash
        };
    }
    let literal = fixtures::table("paper-literal", "info_p1", &[("knn", 10, &[0.3])]);
    let tables = [("a".to_owned(), preset), ("b".to_owned(), uniform), literal];
    let results = Results::new(&tables, &NoFiles).expect("runs");
    let groups = results.by_preset_and_length();
    let labels: Vec<(&str, usize)> = groups
        .iter()
        .map(|(label, conditions)| (label.as_str(), conditions.len()))
        .collect();
    assert_eq!(labels, [("paper", 2), ("paper-literal", 1)]);
    let chart = pareto::INFORMATION_TRADE_OFF.chart(&groups[0].1).expect("a picture");
    check_properties("pareto-together", &chart.scene());
    let names: Vec<&str> = chart.series.iter().map(|series| series.name.as_str()).collect();
    assert_eq!(
        names,
        ["knn", "q-learning", "q-learning, layout.kind uniform"],
        "knn has the same digests twice"
    );
    let [_, preset, uniform] = &chart.series[..] else {
        unreachable!()
    };
    assert!(
        preset.style.paint == uniform.style.paint
            && preset.style.marker != uniform.style.marker
            && preset.style.dashes != uniform.style.dashes
    );
    assert_eq!(pareto::INFORMATION_TRADE_OFF.csv(&groups[0].1).lines().count(), 4);
    assert!(
        chart
            .caption
            .starts_with("Preset paper, with the changes in the legend; 2 runs of 2000 TTIs")
    );
}
