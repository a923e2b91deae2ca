//! The balance compared with the actual harvest of the devices and with closed forms. Also harvest traces in whole
//! scenarios: their start, end and row limit; `harvest/trace.rs` tests the reading of traces.

use std::fmt::Write as _;

use super::*;
use crate::declare::Override;
use crate::harvest::{HarvestSource, SharedSourceData};
use crate::ids::Tti;
use crate::scenario::PolicyChoice;
use crate::scenario::testing::{StubPolicy, load};

type TestScenario = Scenario<PolicyChoice<StubPolicy>>;

fn scenario_with(set: &[&str]) -> TestScenario {
    let overrides: Vec<Override> = set
        .iter()
        .map(|text| Override::parse(text).expect("FIELD=VALUE"))
        .collect();
    load("paper", &overrides).expect("a scenario")
}

fn balance_with(set: &[&str]) -> EnergyBalance {
    EnergyBalance::new(&scenario_with(set))
}

/// Draws the harvest of every device of the run, units per TTI.
fn draw_harvests(scenario: &TestScenario) -> Vec<f64> {
    let deployment = Deployment::new(scenario);
    let shared = SharedSourceData::new(deployment.devices.iter().map(|d| &d.harvest), deployment.traces);
    let drawn = deployment.devices.iter().map(|device| {
        let mut source = HarvestSource::new(&device.harvest, &shared, scenario.run.seed, device.id);
        let mut sum = 0.0;
        while source.next_arrival() < Tti(scenario.run.ttis) {
            sum += source.take_arrival().units();
        }
        sum / scenario.run.ttis as f64
    });
    drawn.collect()
}

#[test]
fn the_expected_harvest_equals_the_mean_of_the_drawn_harvests() {
    for set in [
        &["harvest.kind=eq5"][..],
        &["harvest.kind=exp-minus-lambda", "harvest.lambda=1.5"],
        &["harvest.kind=mpp", "harvest.off_mean=7"],
        &["harvest.kind=diurnal"],
        // From 22:00 on, 2.1 days: not a multiple of a day, and more night than day.
        &["harvest.kind=diurnal", "harvest.diurnal.start_hour=22", "ttis=605"],
    ] {
        let scenario = scenario_with(&[set, &["devices=2000"]].concat());
        let drawn = draw_harvests(&scenario);
        let n = drawn.len() as f64;
        let mean = drawn.iter().sum::<f64>() / n;
        let deviation = (drawn.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        let expected = EnergyBalance::new(&scenario).harvest();
        assert!(
            (mean - expected.mean).abs() < 3.5 * deviation / n.sqrt(),
            "{set:?}: {mean} drawn, {expected:?} expected"
        );
        assert_eq!((expected.min, expected.max), (expected.mean, expected.mean), "{set:?}");
    }
}

/// Writes a trace of three columns, and returns the fields that read it.
fn trace_fields(name: &str, end: &str) -> Vec<String> {
    let path = std::env::temp_dir().join(format!("reveille-balance-{name}-{}.csv", std::process::id()));
    std::fs::write(&path, "a,b,c\n1,0,7\n2,0,0\n0,0,3\n").expect("a file");
    [
        "harvest.kind=trace".to_owned(),
        format!("harvest.trace.file={}", path.display()),
        "harvest.trace.columns=[\"a\", \"b\", \"c\"]".to_owned(),
        "harvest.trace.ttis_per_row=4".to_owned(),
        format!("harvest.trace.end={end}"),
        "devices=7".to_owned(),
    ]
    .to_vec()
}

#[test]
fn recorded_harvest_is_exact_and_ranges_over_the_columns() {
    for end in ["cycle", "stop"] {
        for ttis in [1_u64, 4, 7, 12, 13, 29] {
            let mut fields = trace_fields(end, end);
            fields.push(format!("ttis={ttis}"));
            let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
            let scenario = scenario_with(&fields);
            let drawn = draw_harvests(&scenario);
            let balance = EnergyBalance::new(&scenario);
            let harvest = balance.harvest();
            let drawn_range = HarvestRange {
                mean: drawn.iter().sum::<f64>() / drawn.len() as f64,
                min: drawn.iter().copied().fold(f64::INFINITY, f64::min),
                max: drawn.iter().copied().fold(0.0, f64::max),
            };
            for (found, expected) in [
                (harvest.mean, drawn_range.mean),
                (harvest.min, drawn_range.min),
                (harvest.max, drawn_range.max),
            ] {
                assert!(
                    (found - expected).abs() < 1e-12,
                    "{end}, {ttis} TTIs: {harvest:?}, not {drawn_range:?}"
                );
            }
        }
    }
}

#[test]
fn costs_and_counts_have_their_closed_forms() {
    let balance = balance_with(&["harvest.lambda=0.1", "harvest.e_b=5", "radio.false_wake_up=0.01"]);
    let [class] = balance.classes.as_slice() else {
        panic!("one class: {balance:?}");
    };
    let harvest = 5.0 * 0.1 * libm::exp(-0.1);
    assert!((class.harvest.mean - harvest).abs() < 1e-12, "{class:?}");
    assert!((class.sleeping_cost - 0.081_429).abs() < 1e-12, "{class:?}");
    assert_eq!(class.sensing_ratio(), Some(class.harvest.mean));
    assert_eq!(class.actions_per_battery(class.sensing_cost), Some(100));
    assert_eq!(class.actions_per_battery(class.sleeping_cost), Some(1228));
    assert_eq!(class.actions_per_battery(class.report_cost), Some(10));
    assert_eq!(class.actions_per_battery(0.0), None);
    assert_eq!((class.devices, balance.ttis), (50, 10_000));
    assert!(balance.tti_seconds.is_empty());
    // 0.3 / 0.1 is 2.9999999999999996 in doubles.
    let small = balance_with(&[
        "energy.e_max=0.3",
        "energy.e_idle=0.1",
        "energy.e_tx=0.3",
        "energy.e_wur=0",
    ]);
    let class = &small.classes[0];
    assert_eq!(class.actions_per_battery(class.sensing_cost), Some(3));
    assert_eq!(class.sleeping_ratio(), None);
}

#[test]
fn the_duration_of_a_tti_follows_from_the_sources() {
    assert_eq!(balance_with(&["harvest.kind=diurnal"]).tti_seconds, [300.0]);
    assert!(balance_with(&[]).share_out_of_reach <= 0.0);
    assert!(balance_with(&["devices=1"]).share_out_of_reach > 0.8);
}

#[test]
fn implausible_harvests_cause_a_warning() {
    let warnings = |set: &[&str]| balance_with(set).warnings();
    assert_eq!(warnings(&[]), [""; 0]);
    for without_harvest in [
        &["harvest.e_b=0"][..],
        &["harvest.lambda=0"],
        // The first hour of a day is dark.
        &["harvest.kind=diurnal", "ttis=12"],
    ] {
        let text = warnings(without_harvest).join("\n");
        assert!(
            text.starts_with("no energy is harvested in the "),
            "{without_harvest:?}: {text}"
        );
    }
    // The mean harvest is 0.0905 E_B.
    assert_eq!(warnings(&["harvest.e_b=110"]), [""; 0]);
    let ample = warnings(&["harvest.e_b=111"]).join("\n");
    assert!(
        ample.starts_with("the harvest is 10 times the consumption of a device that is always sensing"),
        "{ample}"
    );
    let asleep = warnings(&["harvest.e_b=111", "energy.e_idle=0.01"]).join("\n");
    assert!(
        asleep.contains("141 times the consumption of a device that is always sleeping"),
        "{asleep}"
    );
    let free = warnings(&["energy.e_idle=0", "energy.e_wur=0"]).join("\n");
    assert!(free.contains("above 0 and the consumption 0"), "{free}");
}

/// The second calculation reads the rows of the file TTI by TTI.
#[test]
fn a_trace_starts_at_the_given_row_and_then_repeats_or_stops() {
    let columns = [[1.0, 2.0, 0.0], [0.0, 0.0, 0.0], [7.0, 0.0, 3.0]];
    let unshifted_hash = |end: &str| {
        let fields = trace_fields("hash", end);
        let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
        scenario_with(&fields).hash_hex()
    };
    for end in ["cycle", "stop"] {
        for start in 0..3_usize {
            let mut fields = trace_fields(&format!("start-{end}"), end);
            fields.extend(["ttis=31".to_owned(), format!("harvest.trace.start={start}")]);
            let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
            let scenario = scenario_with(&fields);
            let drawn = draw_harvests(&scenario);
            for (device, drawn) in drawn.iter().enumerate() {
                let harvest_in = |tti: usize| {
                    let row = start + tti / 4;
                    match end {
                        "stop" if row > 2 => 0.0,
                        _ => columns[device % 3][row % 3],
                    }
                };
                let expected = (0..31).map(harvest_in).sum::<f64>() / 31.0;
                assert!(
                    (drawn - expected).abs() < 1e-12,
                    "{end} from row {start}, device {device}: {drawn}"
                );
                let class = &scenario.classes[0].harvest;
                if device == 0 {
                    // The base station knows the mean of the rows that are used, not that a trace stops.
                    let rows = if end == "stop" { 3 - start } else { 3 };
                    let sum: f64 = columns[0][3 - rows..].iter().sum();
                    let known = sum / rows as f64;
                    let mean = class.mean(1.0).units();
                    assert!(
                        (mean - known).abs() < 1e-6,
                        "{end} from row {start}: mean {mean}, not {known}"
                    );
                }
            }
            let page = scenario.to_toml();
            assert_eq!(page.contains("\nstart = "), start > 0, "{page}");
            let file = std::env::temp_dir().join(format!("reveille-start-{end}-{}.toml", std::process::id()));
            std::fs::write(&file, page).expect("a file");
            let reloaded = load(&file.to_string_lossy(), &[]).expect("a scenario");
            assert_eq!(reloaded, scenario, "{end} from row {start}");
        }
        let mut zero = trace_fields("hash", end);
        zero.push("harvest.trace.start=0".to_owned());
        let zero: Vec<&str> = zero.iter().map(String::as_str).collect();
        assert_eq!(scenario_with(&zero).hash_hex(), unshifted_hash(end));
    }
}

#[test]
fn a_start_after_the_last_row_is_refused() {
    let mut fields = trace_fields("late", "cycle");
    fields.push("harvest.trace.start=3".to_owned());
    let overrides: Vec<Override> = fields
        .iter()
        .map(|text| Override::parse(text).expect("FIELD=VALUE"))
        .collect();
    let error = load("paper", &overrides).expect_err("too late").to_string();
    assert!(
        error.contains("harvest.trace.start = 3: must be below 3, the number of rows of "),
        "{error}"
    );
}

/// The file has 10 020 rows, and the list names its column 1000 times: more than the 10⁷ values that are kept.
#[test]
fn a_trace_with_too_many_rows_is_read_in_part() {
    let path = std::env::temp_dir().join(format!("reveille-long-{}.csv", std::process::id()));
    let rows = 10_020;
    let mut text = String::from("w\n");
    for row in 0..rows {
        // Row 9990 holds 0, the next one 1, and so on; the rows before them hold 5.
        let value = if row < 9_990 { 5 } else { row - 9_990 };
        writeln!(text, "{value}").expect("a String can be written");
    }
    std::fs::write(&path, text).expect("a file");
    let file = format!("harvest.trace.file={}", path.display());
    let load_from = |start: u64, ttis: u64, end: &str| {
        let fields = [
            "harvest.kind=trace".to_owned(),
            file.clone(),
            format!("harvest.trace.columns=[{}]", vec!["\"w\""; 1000].join(",")),
            format!("harvest.trace.start={start}"),
            format!("ttis={ttis}"),
            format!("harvest.trace.end={end}"),
            "devices=1".to_owned(),
        ];
        let overrides: Vec<Override> = fields
            .iter()
            .map(|text| Override::parse(text).expect("FIELD=VALUE"))
            .collect();
        load("paper", &overrides)
    };
    let middle = load_from(9_995, 10, "cycle").expect("a scenario");
    let read = middle.classes[0].harvest.trace_columns()[0]
        .iter()
        .map(|energy| energy.units());
    assert_eq!(read.collect::<Vec<f64>>(), (5..15).map(f64::from).collect::<Vec<f64>>());
    assert_eq!(draw_harvests(&middle), [9.5]);
    let end = load_from(10_015, 10, "stop").expect("a scenario");
    assert_eq!(draw_harvests(&end), [(25.0 + 26.0 + 27.0 + 28.0 + 29.0) / 10.0]);
    let error = load_from(10_015, 10, "cycle")
        .expect_err("too late to repeat")
        .to_string();
    assert!(
        error.contains("the run needs 10 rows from row 10015 on, and 5 follow"),
        "{error}"
    );
    let error = load_from(0, 10_001, "stop").expect_err("too many rows").to_string();
    assert!(
        error.contains("has more than 10000000 values in 1000 columns"),
        "{error}"
    );
    std::fs::remove_file(&path).expect("removed");
}
