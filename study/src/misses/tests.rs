//! Tests of [`Misses`] on events of runs, with counts by brute force, and of the advice. [`misses_of_run`] fills
//! [`Misses`] like `deploy/src/run_reader.rs`, except for `energy` and `in_warm_up`. Numbers without a comment are
//! chosen freely.

use reveille_bs::scenario::{Override, Scenario, declaration, load};
use reveille_common::event::EventRecord;

use super::*;
use crate::figures::run_walk::collect_events;

/// Returns the scenario `quick` with these overrides.
fn quick(set: &[&str]) -> Scenario {
    let overrides = set.iter().map(|text| Override::parse(text).expect("FIELD=VALUE"));
    load("quick", &overrides.collect::<Vec<_>>())
        .expect("a scenario")
        .scenario
}

/// Returns the missed events of a run of `scenario`, and all its events.
fn misses_of_run(scenario: &Scenario) -> (Misses, Vec<EventRecord>) {
    let all_events = collect_events(scenario);
    let mut misses = Misses::new(scenario.clone());
    for event in &all_events {
        match (event.counted, event.tally.reports) {
            (true, 0) => misses.missed.push(MissedEvent {
                event: event.event.0,
                start: event.start,
                epicentre: event.epicentre,
                cause: event.miss_cause,
                nearest: DeviceId(0),
                distance_m: 0.0,
            }),
            (false, 0) => misses.in_warm_up += 1,
            _ => {}
        }
        if event.counted {
            misses.counted_starts.push(event.start);
        }
    }
    let nearest = misses.nearest_devices(misses.missed.iter().map(|event| event.epicentre));
    for (event, (device, distance_m)) in misses.missed.iter_mut().zip(nearest) {
        (event.nearest, event.distance_m) = (device, distance_m);
    }
    misses.end = Tti(scenario.run.ttis);
    (misses, all_events)
}

#[test]
fn events_are_counted_once_by_cause_place_device_and_time() {
    let scenario = quick(&[
        "policy.name=random",
        "radio.uplink_loss=0.3",
        "area.height=13",
        "ttis=1003",
    ]);
    let (misses, all_events) = misses_of_run(&scenario);
    let missed = || {
        all_events
            .iter()
            .filter(|event| event.counted && event.tally.reports == 0)
    };
    assert!(missed().count() > 20, "{} missed events", missed().count());
    assert_eq!(misses.missed.len(), missed().count());
    for (cause, count) in misses.causes() {
        assert_eq!(
            count as usize,
            missed().filter(|event| event.miss_cause == cause).count(),
            "{cause:?}"
        );
    }
    assert!(misses.causes().is_sorted_by(|a, b| a.1 >= b.1));

    // 20 m × 13 m in at most 16 × 16 cells.
    let map = misses.map();
    assert_eq!((map.cell_m, map.columns, map.missed_counts.len()), (2.0, 10, 7));
    for (row, cells) in map.missed_counts.iter().enumerate() {
        for (column, count) in cells.iter().enumerate() {
            let (west, south) = (2.0 * column as f64, 2.0 * row as f64);
            let is_here = |p: Point| (west..west + 2.0).contains(&p.x) && (south..south + 2.0).contains(&p.y);
            assert_eq!(
                *count as usize,
                missed().filter(|event| is_here(event.epicentre)).count()
            );
            let devices = misses.positions.iter().filter(|p| is_here(**p)).count();
            assert_eq!(map.device_counts[row][column] as usize, devices);
        }
    }

    // 903 measured TTIs in bins of 91, the last one shorter.
    let bins = misses.bins(10);
    assert_eq!((bins.len(), bins[0].first, bins[9].end), (10, Tti(100), Tti(1003)));
    for bin in &bins {
        let is_here = |event: &&EventRecord| event.start >= bin.first && event.start < bin.end;
        let counted = all_events.iter().filter(|event| event.counted);
        assert_eq!(bin.events as usize, counted.filter(is_here).count());
        assert_eq!(
            bin.missed_by_cause.iter().sum::<u64>() as usize,
            missed().filter(is_here).count()
        );
    }

    let devices = misses.involved_devices();
    assert_eq!(
        devices.iter().map(|device| device.missed_count).sum::<u64>() as usize,
        missed().count()
    );
    let distance = |device: usize, event: &EventRecord| misses.positions[device].distance(event.epicentre);
    let is_nearest = |device: usize, event: &EventRecord| {
        (0..misses.positions.len()).all(|other| distance(device, event) <= distance(other, event))
    };
    for device in &devices {
        let id = device.device.index();
        let near: Vec<&EventRecord> = missed().filter(|event| is_nearest(id, event)).collect();
        assert_eq!(device.missed_count as usize, near.len());
        let mean = near.iter().map(|event| distance(id, event)).sum::<f64>() / near.len() as f64;
        assert!((device.mean_distance_m - mean).abs() < 1e-9, "{device:?}: {mean}");
    }
}

#[test]
fn the_advice_names_fields_of_the_scenario_and_the_place() {
    let known = declaration();
    for policy in ["knn", "adjusted", "q-learning", "random", "age-index", "dt", "genie"] {
        let scenario = quick(&[&format!("policy.name={policy}"), "radio.wake_miss=0.1"]);
        for cause in MissCause::ALL {
            let advice = advice::advise(&scenario, cause, (3, 7), (2, Point::new(1.0, 2.0)), None);
            let is_one = |change: &String| !change.contains(" or ") && !change.contains(';');
            assert!(
                !advice.suggestions.is_empty() && advice.suggestions.iter().all(is_one),
                "{advice:?}"
            );
            let text = advice.to_string().to_lowercase();
            let is_near = text.contains(", 2 of them near x = 1.0 m, y = 2.0 m.");
            assert!(text.starts_with("3 of 7 missed events were ") && is_near);
            let words = text.split([' ', ',', ':']).map(|word| word.trim_end_matches('.'));
            for field in words.filter(|word| word.contains(|c: char| c.is_alphabetic()) && word.contains('.')) {
                let is_declared = known.field_by_path(field).is_some();
                assert!(is_declared, "{policy}, {cause:?}: no field {field}: {text}");
            }
        }
    }
}

#[test]
fn the_hot_spot_is_in_the_cell_with_most_events_of_the_main_cause() {
    let mut misses = Misses::new(quick(&[]));
    let event = |x: f64, y: f64, cause| MissedEvent {
        event: 0,
        start: Tti(200),
        epicentre: Point::new(x, y),
        cause: Some(cause),
        nearest: DeviceId(0),
        distance_m: 1.0,
    };
    misses.missed = vec![
        event(1.0, 1.0, MissCause::Asleep),
        event(1.1, 1.1, MissCause::Asleep),
        event(5.0, 1.0, MissCause::OutOfReach),
        event(17.0, 19.0, MissCause::OutOfReach),
        event(17.5, 19.5, MissCause::OutOfReach),
    ];
    let text = misses.advice().expect("missed events").finding;
    assert!(
        text.contains("3 of 5 missed events") && text.contains("x = 17.2 m, y = 19.2 m"),
        "{text}"
    );
    misses.missed.clear();
    assert_eq!((misses.advice(), misses.causes().len()), (None, 0));
}

#[test]
fn sleeping_devices_without_energy_need_energy_and_not_more_sensing() {
    let scenario = quick(&["policy.name=age-index"]);
    let advice_with = |energy_metrics: Option<(f64, f64)>| {
        let energy = energy_metrics.map(|(low_energy_pct, overflow_per_device_tti)| RunEnergy {
            low_energy_pct,
            overflow_per_device_tti,
        });
        advice::advise(&scenario, MissCause::Asleep, (3, 7), (2, Point::new(1.0, 2.0)), energy)
    };
    // The limit of low energy is 5 %.
    for energy_metrics in [None, Some((4.9, 0.5))] {
        assert_eq!(
            advice_with(energy_metrics).suggestions,
            ["lower policy.age-index.price"]
        );
    }
    let empty = advice_with(Some((38.8, 0.0)));
    assert!(empty.finding.contains("39 % of device-TTIs"), "{empty}");
    let fields = empty.suggestions.iter().map(|text| text.split(" = ").next());
    assert!(
        fields.eq([Some("raise harvest.lambda"), Some("raise harvest.e_b")]),
        "{empty}"
    );
    assert!(empty.to_string().contains(". Raise harvest.lambda = 0.1: "), "{empty}");
    // A larger battery keeps what overflowed.
    assert_eq!(advice_with(Some((38.8, 0.1))).suggestions[2], "raise energy.e_max");
}

#[test]
fn values_in_the_advice_pay_for_sensing_and_help() {
    let missed_pct = |set: &[&str]| {
        let all: Vec<&str> = [&["policy.name=age-index", "ttis=4000"], set].concat();
        misses_of_run(&quick(&all)).0.missed_pct()
    };
    let value_of = |suggestion: &str| -> f64 {
        let (_, rest) = suggestion.split_once(": ").expect("a value");
        rest.split(' ').next().expect("a number").parse().expect("a number")
    };
    // Eq. (5): λτ·exp(-λτ)·E_B units per TTI; a TTI in S1 costs 1, in S4 0.0714. With E_B = 0.3, at most
    // 0.3·exp(-1) = 0.11 pay for sensing under no λ, so only E_B is left.
    for (e_b, fields) in [
        ("0.3", &["harvest.e_b"][..]),
        ("3.5", &["harvest.lambda", "harvest.e_b"]),
    ] {
        let present = format!("harvest.e_b={e_b}");
        let starved = quick(&["policy.name=age-index", &present]);
        let advice = advice::advise(&starved, MissCause::Unpowered, (3, 7), (2, Point::new(1.0, 2.0)), None);
        let can_sleep = e_b != "0.3";
        assert_eq!(
            advice.finding.contains("does not pay for sleeping"),
            !can_sleep,
            "{advice}"
        );
        let has_policy = advice.suggestions.iter().any(|text| text.contains("policy"));
        assert_eq!(has_policy, can_sleep, "without sleep no policy helps: {advice}");
        let changes = advice.suggestions.iter().take(fields.len());
        for (field, change) in fields.iter().zip(changes) {
            assert!(change.starts_with(&format!("raise {field} = ")), "{advice}");
            let value = value_of(change);
            let (lambda, e_b) = match *field {
                "harvest.lambda" => (value, e_b.parse().expect("a number")),
                _ => (0.1, value),
            };
            assert!((lambda * libm::exp(-lambda) * e_b - 1.0).abs() < 0.01, "{advice}");
            let (before, after) = (
                missed_pct(&[&present]),
                missed_pct(&[&present, &format!("{field}={value}")]),
            );
            // The limit only separates the two runs clearly.
            assert!(after < before / 4.0, "{field}: {before} % before, {after} % after");
        }
    }
}
