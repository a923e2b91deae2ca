//! The policy `adjusted` (Sec. V-A, first approach): its search for a duty cycle against the search of the reference
//! implementation, the length of its pilot runs, and the coverage of its plans. Its wake-ups are not checked here.
//! Counts and percentages in the assertions ensure that a case occurs or an effect is clear; they are no requirements.

use std::any::Any;
use std::collections::BTreeMap;

use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use reveille_bs::cycle::RunOutcome;
use reveille_bs::policy::adjusted::search::DutyCycleChoice;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_lab::preparation::{prepare, run};
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::process::TestFolder;
use reveille_tests::{reference, scenarios};

fn adjusted_scenario(fields: &[&str]) -> Scenario {
    scenarios::paper(&[&["policy.name=adjusted"], fields].concat())
}

/// Returns the facts of the policy, by name; `bs/src/policy/adjusted/` defines the names.
fn facts_by_name(outcome: &RunOutcome) -> BTreeMap<&'static str, f64> {
    outcome.facts.iter().copied().collect()
}

/// Returns the duty cycle that the pilot runs of `scenario` choose.
fn search_duty_cycle(scenario: &Scenario) -> DutyCycleChoice {
    let choice = prepare(scenario).pilot_choice.expect("a search");
    let choice: &dyn Any = &*choice;
    *choice.downcast_ref().expect("a duty cycle")
}

/// Offsets in the order of ids would put a column of a 16 × 16 grid in S1 and leave all else uncovered for a TTI.
#[test]
fn sensing_devices_of_a_grid_cover_the_area_in_every_tti() {
    for layout in ["grid", "hex", "jittered-grid"] {
        let layout = format!("layout.kind={layout}");
        let outcome = run(&adjusted_scenario(&[
            "devices=256",
            "ttis=6000",
            layout.as_str(),
            "policy.adjusted.t_on=[1]",
            "policy.adjusted.t_drx=[16]",
        ]));
        let misdetection_pct = outcome.metrics.misdetection_pct;
        assert!(misdetection_pct < 3.0, "{layout}: misdetection {misdetection_pct} %");
    }
}

#[test]
fn the_duty_cycle_sets_the_number_of_sensing_devices() {
    for (devices, t_on, t_drx) in [(250, 1, 16), (100, 2, 8), (7, 1, 16)] {
        let fields = [
            format!("devices={devices}"),
            format!("policy.adjusted.t_on=[{t_on}]"),
            format!("policy.adjusted.t_drx=[{t_drx}]"),
            "policy.adjusted.pilot_ttis=40".to_owned(),
        ];
        let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
        let sensing_devices_by_tti = |seed: &str| {
            let scenario = adjusted_scenario(&[&fields[..], &[seed]].concat());
            let mut run = Run::new(&prepare(&scenario), RunOptions::default());
            run.run_grant(&mut ());
            let plan = run.cycle().plan().clone();
            let sensing_devices = |k| {
                (0..devices)
                    .filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k)))
                    .collect()
            };
            (0..t_drx).map(sensing_devices).collect::<Vec<Vec<u32>>>()
        };
        let first_cycle = sensing_devices_by_tti("seed=1");
        // Each offset of the cycle has N/t_DRX devices, rounded down or up.
        let devices_per_offset = u64::from(devices) / t_drx;
        for sensing_devices in &first_cycle {
            let n = sensing_devices.len() as u64;
            assert!(
                (t_on * devices_per_offset..=t_on * (devices_per_offset + 1)).contains(&n),
                "{n} of {devices} devices sense"
            );
        }
        for j in 0..devices {
            let sensing_ttis = first_cycle.iter().filter(|sensing| sensing.contains(&j)).count() as u64;
            assert_eq!(sensing_ttis, t_on, "TTIs in S1 of device {j}");
        }
        assert_eq!(first_cycle, sensing_devices_by_tti("seed=1"));
        assert_ne!(
            first_cycle,
            sensing_devices_by_tti("seed=2"),
            "the order of devices is drawn from the seed"
        );
    }
}

#[test]
fn pilot_runs_are_extended_until_they_have_enough_events() {
    // The defaults of `pilot_events`, `pilot_ttis` and `pilot_limit`: at least 30 events, from 2000 to 200 000 TTIs.
    let outcome = run(&adjusted_scenario(&["devices=100", "ttis=400", "events.alpha=0.002"]));
    let facts = facts_by_name(&outcome);
    assert!(facts["pilot_events"] >= 30.0, "{facts:?}");
    assert!(
        facts["pilot_ttis"] > 2000.0 && facts["pilot_ttis"] <= 200_000.0,
        "{facts:?}"
    );
    assert!(facts["reaches_i_min"] > 0.0, "{facts:?}");
    // With many events the pilot runs are not extended.
    let facts = facts_by_name(&run(&adjusted_scenario(&["devices=100", "ttis=400"])));
    assert!(facts["pilot_events"] >= 30.0, "{facts:?}");
    assert!((facts["pilot_ttis"] - 2000.0).abs() < 0.5, "{facts:?}");
}

#[test]
fn a_search_without_events_warns() {
    let rare_events = adjusted_scenario(&[
        "devices=50",
        "ttis=400",
        "events.alpha=0.0000001",
        "policy.adjusted.pilot_limit=3000",
    ]);
    let prepared = prepare(&rare_events);
    let [warning] = &prepared.warnings[..] else {
        panic!("{:?}", prepared.warnings)
    };
    for part in ["adjusted", "30 events", "policy.adjusted.pilot_limit", "3000"] {
        assert!(warning.contains(part), "{warning}");
    }
    let outcome = Run::new(&prepared, RunOptions::default()).finish(&mut ());
    let facts = facts_by_name(&outcome);
    assert!((facts["pilot_ttis"] - 3000.0).abs() < 0.5, "{facts:?}");
    // Without events the search compares only the energy that the pairs spend. (1, 32) is the cheapest of the default
    // lists.
    assert!(facts["pilot_events"] < 0.5, "{facts:?}");
    assert_eq!((facts["t_on"] as u32, facts["t_drx"] as u32), (1, 32), "{facts:?}");
    assert!(
        prepare(&adjusted_scenario(&["devices=50", "ttis=400"]))
            .warnings
            .is_empty()
    );
}

/// The traces have equal energy at different times, so that a search that knows only the mean finds the same pair.
#[test]
fn pilot_runs_know_only_the_mean_of_a_trace() {
    let folder = TestFolder::new();
    let rows = |energy_in_row: fn(u32) -> f64| -> String {
        let rows = (0..2000).map(|row| format!("{}\n", energy_in_row(row)));
        rows.collect::<Vec<_>>().concat()
    };
    folder.write(
        "early.csv",
        &format!("e\n{}", rows(|row| if row < 200 { 4.0 } else { 0.0 })),
    );
    folder.write(
        "late.csv",
        &format!("e\n{}", rows(|row| if row < 1800 { 0.0 } else { 4.0 })),
    );
    let search_with_trace = |file: &str| {
        let file = format!("harvest.trace.file={}", folder.join(file).display());
        search_duty_cycle(&adjusted_scenario(&[
            "devices=60",
            "harvest.kind=trace",
            "harvest.trace.column=e",
            file.as_str(),
        ]))
    };
    let (early, late) = (search_with_trace("early.csv"), search_with_trace("late.csv"));
    assert_eq!(early, late, "traces with the same mean");
    // In each TTI an arrival of the trace's mean, 4 · 200/2000 units.
    let constant = search_duty_cycle(&adjusted_scenario(&[
        "devices=60",
        "harvest.kind=exp-minus-lambda",
        "harvest.lambda=0",
        "harvest.e_b=0.4",
    ]));
    assert_eq!(early, constant, "a constant harvest of this mean");
}

#[test]
fn the_search_chooses_the_pair_of_the_reference() {
    let mut runner = TestRunner::deterministic();
    let (mut compared, mut with_several_pairs, mut reaching_i_min) = (0, 0, 0);
    for _ in 0..80 {
        let text = scenarios::small_with_policy("adjusted")
            .new_tree(&mut runner)
            .expect("a scenario")
            .current();
        let scenario = scenarios::scenario(&text);
        let positions = Deployment::new(&scenario).positions();
        let Some(expected_pair) = reference::reference_search(&scenario, &positions) else {
            continue;
        };
        let choice = search_duty_cycle(&scenario);
        assert_eq!(
            (u64::from(choice.t_on), u64::from(choice.t_drx)),
            expected_pair,
            "{text}"
        );
        compared += 1;
        with_several_pairs += u64::from(choice.searched_pairs > 1);
        reaching_i_min += u64::from(choice.reaches_i_min);
    }
    assert!(
        compared >= 30 && with_several_pairs >= 20 && reaching_i_min >= 10,
        "{compared} compared, {with_several_pairs} with several pairs, {reaching_i_min} reach I_min"
    );
}
