//! Tests of [`Misses`] on events of runs, with counts by brute force, and of the advice. [`misses_of_run`] fills
//! [`Misses`] like `deploy/src/run_reader.rs`, except for `energy` and `in_warm_up`. Numbers without a comment are
//! chosen freely.

use reveille_bs::scenario::{Override, Scenario, declaration, load};
use reveille_common::energy_balance::EnergyBalance;
use reveille_common::event::EventRecord;
use reveille_common::message::{Change, DeviceRange};

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

/// Returns a main cause at a place that lies out of reach.
fn main_cause(cause: MissCause) -> MainCause {
    MainCause {
        cause,
        count: 3,
        missed: 7,
        hot_spot: Some(HotSpot {
            count: 2,
            place: Point::new(1.0, 2.0),
        }),
        farthest_m: 6.123,
    }
}

/// Returns the texts of the suggestions.
fn texts(advice: &Advice) -> Vec<&str> {
    advice
        .suggestions
        .iter()
        .map(|suggestion| suggestion.text.as_str())
        .collect()
}

#[test]
fn the_advice_names_fields_of_the_scenario_and_the_place() {
    let known = declaration();
    for policy in ["knn", "adjusted", "q-learning", "random", "age-index", "dt", "genie"] {
        let scenario = quick(&[&format!("policy.name={policy}"), "radio.wake_miss=0.1"]);
        for cause in MissCause::ALL {
            let advice = advice::advise(&scenario, &main_cause(cause), None);
            let is_one = |change: &str| !change.contains(" or ") && !change.contains(';');
            assert!(
                !advice.suggestions.is_empty() && texts(&advice).into_iter().all(is_one),
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
fn only_a_cell_with_clearly_more_events_of_the_main_cause_is_named() {
    let mut misses = Misses::new(quick(&[]));
    let event = |x: f64, y: f64, cause| MissedEvent {
        event: 0,
        start: Tti(200),
        epicentre: Point::new(x, y),
        cause: Some(cause),
        nearest: DeviceId(0),
        distance_m: 1.0,
    };
    let north_east =
        |count: u32| (0..count).map(move |nth| event(17.0 + 0.1 * f64::from(nth), 19.0, MissCause::OutOfReach));
    misses.missed = [event(1.0, 1.0, MissCause::Asleep); 4]
        .into_iter()
        .chain(north_east(5))
        .collect();
    let advice = misses.advice().expect("missed events");
    let (count, place) = ("5 of 9 missed events were ", ", 5 of them near x = 17.2 m, y = 19.0 m.");
    assert!(
        advice.finding.starts_with(count) && advice.finding.ends_with(place),
        "{advice}"
    );
    assert_eq!(texts(&advice)[0], "place a device there with layout.file");
    // Four events in a cell can be chance.
    misses.missed = north_east(4).collect();
    let advice = misses.advice().expect("missed events");
    assert!(!advice.finding.contains("near x"), "{advice}");
    assert_eq!(texts(&advice)[0], "place devices near them with layout.file");
    // 100 cells have 7 events each, and one of them has more: at least 3 times the mean is named.
    for (more, is_named) in [(0, false), (13, false), (15, true)] {
        let cells = (0..700).map(|nth| {
            event(
                f64::from(nth % 10) * 2.0 + 1.0,
                f64::from(nth / 70) * 2.0 + 1.0,
                MissCause::OutOfReach,
            )
        });
        misses.missed = cells
            .chain((0..more).map(|_| event(9.0, 9.0, MissCause::OutOfReach)))
            .collect();
        let finding = misses.advice().expect("missed events").finding;
        assert_eq!(
            finding.contains("near x = 9.0 m, y = 9.0 m"),
            is_named,
            "{more}: {finding}"
        );
    }
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
        advice::advise(&scenario, &main_cause(MissCause::Asleep), energy)
    };
    // The limit of low energy is 5 %.
    for energy_metrics in [None, Some((4.9, 0.5))] {
        assert_eq!(
            texts(&advice_with(energy_metrics)),
            [
                "change policy.age-index.price = 0.35: try 0.175, 0.0875, 0.7, 1.4 (a lower price senses more \
                 unless it empties batteries, a higher one saves energy)"
            ]
        );
    }
    let empty = advice_with(Some((38.8, 0.0)));
    assert!(empty.finding.contains("39 % of device-TTIs"), "{empty}");
    let fields = texts(&empty).into_iter().map(|text| text.split(" = ").next());
    assert!(
        fields.eq([
            Some("raise harvest.e_b"),
            Some("raise harvest.lambda"),
            Some("change policy.age-index.price")
        ]),
        "{empty}"
    );
    assert!(empty.to_string().contains(". Raise harvest.e_b = 5: "), "{empty}");
    // A larger battery keeps what overflowed.
    assert_eq!(
        texts(&advice_with(Some((38.8, 0.1))))[2],
        "raise energy.e_max = 100: try 200"
    );
    // A battery of 12 units pays for one report of 10 units, and loses more harvest.
    let scenario = quick(&["policy.name=knn", "energy.e_max=12"]);
    let energy = RunEnergy {
        low_energy_pct: 60.0,
        overflow_per_device_tti: 0.3 * EnergyBalance::new(&scenario).classes[0].harvest.mean,
    };
    let small = advice::advise(&scenario, &main_cause(MissCause::NoEnergy), Some(energy));
    assert_eq!(
        texts(&small)[0],
        "raise energy.e_max = 12 (preset quick: 100): try 24, 48, 96"
    );
    let sentences = "A full battery pays for 1 report. Of the harvest, 30 % did not fit into full batteries.";
    assert!(small.finding.contains(sentences), "{small}");
}

#[test]
fn values_in_the_advice_pay_for_sensing_and_help() {
    let missed_pct = |set: &[&str]| {
        let all: Vec<&str> = [&["policy.name=age-index", "ttis=4000"], set].concat();
        misses_of_run(&quick(&all)).0.missed_pct()
    };
    let values_of = |suggestion: &Suggestion| -> Vec<f64> {
        let values = suggestion.trials.iter().map(|changes| changes[0].value.parse());
        values.map(|value| value.expect("a number")).collect()
    };
    // Eq. (5): λτ·exp(-λτ)·E_B units per TTI; a TTI in S1 costs 1, in S4 0.0714. With E_B = 0.3, at most
    // 0.3·exp(-1) = 0.11 pay for sensing under no λ, so only E_B is left.
    for (e_b, fields) in [
        ("0.3", &["harvest.e_b"][..]),
        ("3.5", &["harvest.e_b", "harvest.lambda"]),
    ] {
        let present = format!("harvest.e_b={e_b}");
        let starved = quick(&["policy.name=age-index", &present]);
        let advice = advice::advise(&starved, &main_cause(MissCause::Unpowered), None);
        let can_sleep = e_b != "0.3";
        assert_eq!(
            advice.finding.contains("does not pay for sleeping"),
            !can_sleep,
            "{advice}"
        );
        let has_policy_change = texts(&advice).into_iter().any(|text| text.contains("policy"));
        assert_eq!(has_policy_change, can_sleep, "{advice}");
        let changes = advice.suggestions.iter().take(fields.len());
        for (field, change) in fields.iter().zip(changes) {
            assert!(change.text.starts_with(&format!("raise {field} = ")), "{advice}");
            let harvest_with = |value: f64| {
                let (lambda, e_b) = match *field {
                    "harvest.lambda" => (value, e_b.parse().expect("a number")),
                    _ => (0.1, value),
                };
                lambda * libm::exp(-lambda) * e_b
            };
            // A harvest of 0.3167 lies above twice the cost of sleep, 0.143. The middle is a geometric mean. With the
            // preset's E_B = 5 the harvest is 0.452.
            let expected = match (can_sleep, *field) {
                (true, "harvest.e_b") => vec![0.452, 0.563, 1.0],
                (true, _) => vec![0.563, 1.0],
                (false, _) => vec![0.143, 0.378, 0.452, 1.0],
            };
            let values = values_of(change);
            assert_eq!(values.len(), expected.len(), "{advice}");
            for (value, harvest) in values.iter().zip(expected) {
                assert!((harvest_with(*value) - harvest).abs() < 0.01 * harvest, "{advice}");
            }
            assert!(change.text.contains("on average"), "{advice}");
            let names_preset = change.text.contains(&format!("{field} = {e_b} (preset quick: 5)"));
            assert_eq!(names_preset, *field == "harvest.e_b", "{advice}");
            let value = values[values.len() - 1];
            let (before, after) = (
                missed_pct(&[&present]),
                missed_pct(&[&present, &format!("{field}={value}")]),
            );
            // The limit only separates the two runs clearly.
            assert!(after < before / 4.0, "{field}: {before} % before, {after} % after");
        }
    }
}

#[test]
fn a_summary_has_one_suggestion_and_the_number_of_the_others() {
    let suggestions = ["raise a", "lower b", "drop c"].map(Suggestion::without_trials);
    let summary = |count: usize| {
        let advice = Advice {
            finding: "Cause.".to_owned(),
            suggestions: suggestions[..count].to_vec(),
        };
        advice.summary()
    };
    assert_eq!(summary(0), "Cause.");
    assert_eq!(summary(1), "Cause. Raise a.");
    assert_eq!(summary(3), "Cause. Raise a. 2 more: reveille inspect misses.");
}

#[test]
fn values_to_try_are_in_the_text_and_make_a_scenario() {
    for policy in ["knn", "adjusted", "q-learning", "random", "age-index", "dt", "genie"] {
        let name = format!("policy.name={policy}");
        let set = [
            &name,
            "radio.wake_miss=0.1",
            "radio.uplink_loss=0.2",
            "sensing.kind=probabilistic",
        ];
        let scenario = quick(&set);
        let energy = Some(RunEnergy {
            low_energy_pct: 1.0,
            overflow_per_device_tti: 0.1,
        });
        for cause in MissCause::ALL {
            for Suggestion { text, trials } in advice::advise(&scenario, &main_cause(cause), energy).suggestions {
                for changes in &trials {
                    let all: Vec<String> = set
                        .iter()
                        .map(|text| (*text).to_owned())
                        .chain(changes.iter().map(FieldChange::to_string))
                        .collect();
                    // A later override replaces an earlier one.
                    let changed = quick(&all.iter().map(String::as_str).collect::<Vec<_>>());
                    assert_ne!(changed.hash(), scenario.hash(), "{text}: {changes:?}");
                    for FieldChange { field, value } in changes {
                        let has_field = text.contains(field.as_str()) || field == "policy.name";
                        assert!(has_field && text.contains(value.as_str()), "{text}: {field}={value}");
                    }
                }
            }
        }
    }
}

#[test]
fn the_suggested_range_reaches_every_event_that_was_out_of_reach() {
    let scenario = quick(&["devices=6", "ttis=3000"]);
    let (misses, _) = misses_of_run(&scenario);
    assert_eq!(misses.causes()[0].0, Some(MissCause::OutOfReach));
    let advice = misses.advice().expect("missed events");
    let range = advice
        .suggestions
        .iter()
        .flat_map(|suggestion| suggestion.trials.concat());
    let range = range.filter(|change| change.field == "sensing.d_max");
    let values: Vec<String> = range.map(|change| change.to_string()).collect();
    assert_eq!(values.len(), 1, "{advice:?}");
    let changed = quick(&["devices=6", "ttis=3000", &values[0]]);
    let (after, _) = misses_of_run(&changed);
    assert!(
        after
            .causes()
            .iter()
            .all(|(cause, _)| *cause != Some(MissCause::OutOfReach)),
        "{values:?}: {:?}",
        after.causes()
    );
}

#[test]
fn fields_of_a_trace_and_of_a_class_have_their_own_paths() {
    let text = "\n[[class]]\nname = \"a\"\nshare = 0.5\n[[class]]\nname = \"b\"\nshare = 0.5\nharvest.e_b = 0.5\n";
    let folder = std::path::Path::new(".");
    let scenario = reveille_bs::scenario::parse(&format!("preset = \"quick\"{text}"), "test", folder, &[]);
    let scenario = scenario.expect("a scenario").scenario;
    let advice = advice::advise(&scenario, &main_cause(MissCause::NoEnergy), None);
    // Class b harvests less.
    let fields: Vec<&String> = advice
        .suggestions
        .iter()
        .flat_map(|suggestion| &suggestion.trials)
        .flatten()
        .map(|change| &change.field)
        .collect();
    assert!(fields.iter().any(|field| *field == "class.b.harvest.e_b"), "{fields:?}");
    assert!(!fields.iter().any(|field| field.starts_with("harvest.")), "{fields:?}");
}

/// Returns an action on devices from `first` on.
fn action(tti: u64, change: fn(DeviceRange) -> Change, first: u32, count: u32) -> OperatorAction {
    let first = DeviceId(first);
    OperatorAction {
        tti: Tti(tti),
        change: change(DeviceRange { first, count }),
    }
}

#[test]
fn phases_and_failures_follow_the_actions() {
    // 1000 TTIs, of which 100 are the warm-up.
    let (mut misses, _) = misses_of_run(&quick(&["policy.name=random", "ttis=1000"]));
    assert!(misses.phases().is_empty() && misses.action_failures().is_empty());
    misses.actions = vec![
        action(600, Change::Revive, 1, 1),
        action(50, Change::Fail, 0, 1),
        action(300, Change::Fail, 0, 3),
        action(600, Change::Fail, 3, 1),
    ];
    let failures = misses.action_failures();
    let spans: Vec<(u32, u64, u64, bool)> = failures
        .iter()
        .map(|(device, failure)| (device.0, failure.first.0, failure.ttis, failure.is_failed_at_end))
        .collect();
    assert_eq!(
        spans,
        [
            (0, 100, 900, true),
            (1, 300, 300, false),
            (2, 300, 700, true),
            (3, 600, 400, true)
        ]
    );
    let phases = misses.phases();
    let bounds: Vec<(u64, u64, u64)> = phases
        .iter()
        .map(|phase| (phase.first.0, phase.end.0, phase.failed_devices))
        .collect();
    assert_eq!(bounds, [(100, 300, 1), (300, 600, 3), (600, 1000, 3)]);
    let missed_sum: u64 = phases.iter().map(|phase| phase.missed).sum();
    assert_eq!(missed_sum as usize, misses.missed.len());
    let event_sum: u64 = phases.iter().map(|phase| phase.events).sum();
    assert_eq!(event_sum as usize, misses.counted_starts.len());
    assert!(misses.map().failed_counts.iter().flatten().sum::<u64>() == 4);
    // Many actions have one phase from the first to the last.
    misses.actions = (0..8)
        .map(|nth| {
            action(
                200 + 100 * nth,
                if nth % 2 == 0 { Change::Fail } else { Change::Revive },
                0,
                5,
            )
        })
        .collect();
    let bounds: Vec<(u64, u64)> = misses
        .phases()
        .iter()
        .map(|phase| (phase.first.0, phase.end.0))
        .collect();
    assert_eq!(bounds, [(100, 200), (200, 900), (900, 1000)]);
}

#[test]
fn failures_by_actions_are_one_cause_whose_advice_changes_no_policy() {
    let event = |start: u64, nearest: u32, cause: MissCause| MissedEvent {
        event: 0,
        start: Tti(start),
        epicentre: Point::new(1.0, 1.0),
        cause: Some(cause),
        nearest: DeviceId(nearest),
        distance_m: 1.0,
    };
    let mut misses = Misses::new(quick(&["policy.name=age-index"]));
    misses.missed = vec![
        event(200, 7, MissCause::Asleep),
        event(210, 7, MissCause::Asleep),
        event(220, 7, MissCause::Asleep),
        event(300, 2, MissCause::Failed),
        event(305, 2, MissCause::Failed),
        event(310, 2, MissCause::Removed),
        event(320, 2, MissCause::Removed),
    ];
    // Without an action, the process of device 2 was removed.
    let advice = misses.advice().expect("missed events");
    assert!(
        advice.finding.starts_with("3 of 7 missed events were within"),
        "{advice}"
    );
    misses.actions = vec![action(300, Change::Fail, 2, 1), action(320, Change::Revive, 2, 1)];
    let advice = misses.advice().expect("missed events");
    // Device 2 worked again in TTI 320, so its process was removed.
    assert!(
        advice.finding.starts_with("3 of 7 missed events were within"),
        "{advice}"
    );
    misses.actions.pop();
    let advice = misses.advice().expect("missed events");
    assert_eq!(
        advice.finding,
        "4 of 7 missed events were near devices that actions had failed."
    );
    let text = advice.to_string();
    assert!(text.contains("Revive failed devices earlier"), "{advice}");
    for other in ["policy", "price", "energy", "harvest", "--on-loss"] {
        assert!(!text.contains(other), "{other}: {advice}");
    }
}
