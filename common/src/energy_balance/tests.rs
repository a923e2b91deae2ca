//! The balance compared with the actual harvest of the devices and with closed forms, and the limits of its warnings.
//! Expected numbers follow from the settings; random harvests may deviate by 3.5 standard errors.

use super::*;
use crate::harvest::Harvest;
use crate::harvest::testing::{arrival_ttis, draw_mean_harvests, trace_fields};
use crate::ids::Tti;
use crate::scenario::testing::scenario_with;

fn balance_with(set: &[&str]) -> EnergyBalance {
    EnergyBalance::new(&scenario_with(set))
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
        let drawn = draw_mean_harvests(&scenario);
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

#[test]
fn recorded_harvest_is_exact_and_ranges_over_the_columns() {
    for end in ["cycle", "stop"] {
        for ttis in [1_u64, 4, 7, 12, 13, 29] {
            let mut fields = trace_fields(end, end);
            fields.push(format!("ttis={ttis}"));
            let scenario = scenario_with(&fields);
            let drawn = draw_mean_harvests(&scenario);
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

/// The longest run of TTIs before `ttis` for which `is_dark` holds, the first of equal ones: its length and its first
/// TTI, negated so that the first one is the greatest.
fn longest_run(ttis: u64, is_dark: impl Fn(u64) -> bool) -> (u64, i64) {
    let is_start = |tti: &u64| *tti == 0 || !is_dark(tti - 1);
    let length = |start: u64| (start..ttis).take_while(|tti| is_dark(*tti)).count() as u64;
    let runs = (0..ttis)
        .filter(is_start)
        .map(|start| (length(start), -start.cast_signed()));
    runs.max().unwrap_or_default()
}

/// The longest gap of the first class, as [`longest_run`] returns it.
fn longest_gap(balance: &EnergyBalance) -> Option<(u64, i64)> {
    let gap = balance.classes[0].longest_gap?;
    Some((gap.ttis, -gap.first.0.cast_signed()))
}

#[test]
fn the_longest_gap_of_a_trace_is_the_longest_without_an_arrival() {
    let path = std::env::temp_dir().join(format!("reveille-gaps-{}.csv", std::process::id()));
    // The gap of `a` crosses the end of the trace if it cycles from row 0.
    std::fs::write(&path, "a,b,never\n0,5,0\n1,0,0\n0,0,0\n3,1,0\n0,2,0\n0,3,0\n").expect("a file");
    let mut seen = std::collections::BTreeSet::new();
    for columns in ["[\"a\"]", "[\"b\", \"a\"]", "[\"b\"]", "[\"never\"]"] {
        for (end, start) in [("cycle", 0), ("stop", 0), ("cycle", 1), ("cycle", 4), ("stop", 2)] {
            for ttis in (1..60).chain([1000]) {
                let scenario = scenario_with(&[
                    "harvest.kind=trace",
                    &format!("harvest.trace.file={}", path.display()),
                    &format!("harvest.trace.columns={columns}"),
                    "harvest.trace.ttis_per_row=4",
                    &format!("harvest.trace.end={end}"),
                    &format!("harvest.trace.start={start}"),
                    &format!("ttis={ttis}"),
                    "devices=3",
                ]);
                let gaps = arrival_ttis(&scenario)
                    .into_iter()
                    .map(|arrivals| longest_run(ttis, |tti| !arrivals.contains(&Tti(tti))));
                let (gap, expected) = (longest_gap(&EnergyBalance::new(&scenario)), gaps.max());
                assert_eq!(gap, expected, "{columns}, {end}, start {start}, {ttis} TTIs");
                seen.extend(gap.map(|(ttis, _)| ttis));
            }
        }
    }
    std::fs::remove_file(path).expect("there");
    assert!(seen.contains(&12), "three rows across the end: {seen:?}");
}

#[test]
fn the_longest_gap_under_the_sun_is_the_longest_night() {
    for latitude in [-70.0, 0.0, 36.1, 60.0, 80.0] {
        for (ttis, start_hour) in [
            (1_u64, 0.0),
            (100, 0.0),
            (288, 13.0),
            (400, 22.5),
            (700, 12.0),
            (5000, 7.25),
        ] {
            let fields = [
                format!("harvest.diurnal.latitude={latitude}"),
                format!("harvest.diurnal.start_hour={start_hour}"),
                format!("ttis={ttis}"),
                "harvest.kind=diurnal".to_owned(),
                "harvest.diurnal.day_of_year=330".to_owned(),
                "harvest.diurnal.reference=zenith".to_owned(),
            ];
            let scenario = scenario_with(&fields);
            let Harvest::Diurnal(diurnal) = &scenario.classes[0].harvest else {
                panic!("diurnal");
            };
            // The hour angle in the middle of a TTI of 5 minutes, 0 at noon.
            let is_night = |tti: u64| {
                let hour = start_hour + (tti as f64 + 0.5) / 12.0;
                diurnal.sun.elevation_sine((hour - 12.0) * std::f64::consts::PI / 12.0) <= 0.0
            };
            let balance = EnergyBalance::new(&scenario);
            let (gap, class) = (longest_run(ttis, is_night), &balance.classes[0]);
            assert_eq!(longest_gap(&balance), Some(gap), "{fields:?}");
            // The capacity of a battery is 100 units.
            let batteries = gap.0 as f64 * class.sleeping_cost / 100.0;
            assert!((class.batteries_of_longest_gap().expect("a gap") - batteries).abs() < 1e-12);
        }
    }
    for kind in ["eq5", "exp-minus-lambda", "mpp"] {
        let balance = balance_with(&[&format!("harvest.kind={kind}"), "harvest.lambda=1"]);
        assert_eq!(
            balance.classes[0].longest_gap, None,
            "{kind}: energy can arrive in any TTI"
        );
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
    // E_WuR = 1/14, rounded to micro-units, and E_idle in 1 % of the TTIs.
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
fn the_duration_of_a_tti_and_the_share_out_of_reach_follow_from_the_scenario() {
    assert_eq!(balance_with(&["harvest.kind=diurnal"]).tti_seconds, [300.0]);
    assert!(balance_with(&[]).share_out_of_reach <= 0.0);
    // A disc of radius d_max = 4 m covers at most 13 % of the area of 20 m by 20 m.
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
    // The mean harvest is 0.0905 E_B, and the warning starts at 10 times E_idle = 1.
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

/// The mean change of a battery per TTI with the share `sensing` of TTIs in S1 and `reports` reports per TTI.
fn drift(class: &ClassBalance, sensing: f64, reports: f64) -> f64 {
    let spent = sensing * class.sensing_cost + (1.0 - sensing) * class.sleeping_cost + reports * class.report_cost;
    class.harvest.mean - spent
}

#[test]
fn affordable_sensing_spends_the_harvest_exactly() {
    for set in [
        &["harvest.lambda=0.03"][..],
        &["harvest.lambda=0.05", "devices=80", "events.alpha=0.4"],
        &["harvest.lambda=0.05", "energy.e_tx=2", "energy.e_wur=0.01"],
    ] {
        let scenario = scenario_with(set);
        let balance = balance_with(set);
        let class = &balance.classes[0];
        let reports = scenario.events.alpha / f64::from(scenario.run.devices);
        assert!((balance.reports_per_device_tti - reports).abs() < 1e-12, "{set:?}");
        for reports in [0.0, reports] {
            let share = class.affordable_sensing(reports);
            assert!((0.0..1.0).contains(&share), "{set:?}: {share}");
            assert!(drift(class, share, reports).abs() < 1e-12, "{set:?}: {share}");
            assert!(drift(class, share + 0.01, reports) < 0.0, "{set:?}: {share}");
        }
    }
    let costless = balance_with(&["energy.e_wur=1", "energy.e_idle=1", "harvest.lambda=0.3"]);
    assert!(costless.classes[0].affordable_sensing(0.0) > 1.0);
}

#[test]
fn a_rate_above_the_maximum_of_eq5_has_a_warning() {
    let warns = |set: &[&str]| {
        let warnings = balance_with(set).warnings();
        warnings.iter().any(|warning| warning.contains("Eq. (5) falls"))
    };
    assert!(warns(&["harvest.lambda=1.5"]) && warns(&["harvest.lambda=0.6", "tau=2"]));
    assert!(!warns(&["harvest.lambda=1"]) && !warns(&["harvest.lambda=0.6"]));
    assert!(!warns(&["harvest.lambda=1.5", "harvest.kind=exp-minus-lambda"]));
}

#[test]
fn a_harvest_that_hardly_pays_for_sensing_has_a_warning() {
    let warns = |set: &[&str]| {
        let warnings = balance_with(set).warnings();
        warnings.iter().any(|warning| warning.contains("one report per event"))
    };
    // One report per event costs 10 · 0.2 / N units per device and TTI.
    assert!(warns(&["harvest.lambda=0.02", "harvest.e_b=4", "devices=30"]));
    assert!(warns(&["harvest.lambda=0.03"]));
    assert!(!warns(&["harvest.lambda=0.05"]) && !warns(&[]));
}
