//! Adjusted duty cycling (Sec. V-A, first approach): the knowledge of its search, its choice, and coverage gaps.

use std::any::Any;
use std::collections::BTreeMap;

use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use reveille_bs::cycle::RunOutcome;
use reveille_bs::policy::adjusted::search::DutyCycleChoice;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_lab::preparation::{prepare, run};
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::process::TestFolder;
use reveille_tests::{reference, scenarios};

fn scenario(set: &[&str]) -> Scenario {
    let set = ["policy.name=adjusted"].iter().chain(set);
    let overrides: Vec<Override> = set.map(|set| Override::parse(set).expect("an override")).collect();
    load("paper", &overrides).expect("a scenario").scenario
}

fn facts(outcome: &RunOutcome) -> BTreeMap<&'static str, f64> {
    outcome.facts.iter().copied().collect()
}

fn found(scenario: &Scenario) -> DutyCycleChoice {
    let found = prepare(scenario).pilot_choice.expect("a search");
    let found: &dyn Any = &*found;
    *found.downcast_ref().expect("a duty cycle")
}

/// Offsets by number would put a column of a 16 × 16 grid in S1 and leave all else uncovered for a TTI.
#[test]
fn on_a_grid_a_stripe_of_sensing_devices_leaves_no_gap() {
    for layout in ["grid", "hex", "jittered-grid"] {
        let layout = format!("layout.kind={layout}");
        let outcome = run(&scenario(&[
            "devices=256",
            "ttis=6000",
            layout.as_str(),
            "policy.adjusted.t_on=[1]",
            "policy.adjusted.t_drx=[16]",
        ]));
        let missed = outcome.metrics.misdetection_pct;
        assert!(missed < 3.0, "{layout}: {missed} % missed");
    }
}

#[test]
fn the_duty_cycle_sets_the_number_of_sensing_devices() {
    for (devices, t_on, t_drx) in [(250, 1, 16), (100, 2, 8), (7, 1, 16)] {
        let set = [
            format!("devices={devices}"),
            format!("policy.adjusted.t_on=[{t_on}]"),
            format!("policy.adjusted.t_drx=[{t_drx}]"),
            "policy.adjusted.pilot_ttis=40".to_owned(),
        ];
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        let of = |seed: &str| {
            let scenario = scenario(&[&set[..], &[seed]].concat());
            let mut run = Run::new(&prepare(&scenario), RunOptions::default());
            run.run_grant(&mut ());
            let plan = run.cycle().plan().clone();
            let sensing = |k| {
                (0..devices)
                    .filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k)))
                    .collect()
            };
            (0..t_drx).map(sensing).collect::<Vec<Vec<u32>>>()
        };
        let sensing = of("seed=1");
        // Each phase of the cycle has N/t_DRX devices, plus or minus one.
        let share = u64::from(devices) / t_drx;
        for now in &sensing {
            let n = now.len() as u64;
            assert!(
                (t_on * share..=t_on * (share + 1)).contains(&n),
                "{n} of {devices} sense"
            );
        }
        for j in 0..devices {
            let times = sensing.iter().filter(|now| now.contains(&j)).count() as u64;
            assert_eq!(times, t_on, "device {j}");
        }
        assert_eq!(sensing, of("seed=1"));
        assert_ne!(sensing, of("seed=2"), "the order is drawn");
    }
}

#[test]
fn pilots_run_until_they_hold_events_to_judge_by() {
    let outcome = run(&scenario(&["devices=100", "ttis=400", "events.alpha=0.002"]));
    let facts = facts(&outcome);
    assert!(facts["pilot_events"] >= 30.0, "{facts:?}");
    assert!(
        facts["pilot_ttis"] > 2000.0 && facts["pilot_ttis"] <= 200_000.0,
        "{facts:?}"
    );
    assert!(facts["reaches_i_min"] > 0.0, "{facts:?}");
    // With many events the pilot runs are not extended.
    let often = self::facts(&run(&scenario(&["devices=100", "ttis=400"])));
    assert!(often["pilot_events"] >= 30.0, "{often:?}");
    assert!((often["pilot_ttis"] - 2000.0).abs() < 0.5, "{often:?}");
}

#[test]
fn a_search_without_events_warns() {
    let rare = scenario(&[
        "devices=50",
        "ttis=400",
        "events.alpha=0.0000001",
        "policy.adjusted.pilot_limit=3000",
    ]);
    let prepared = prepare(&rare);
    let [warning] = &prepared.warnings[..] else {
        panic!("{:?}", prepared.warnings)
    };
    for part in ["adjusted", "30 events", "policy.adjusted.pilot_limit", "3000"] {
        assert!(warning.contains(part), "{warning}");
    }
    let outcome = Run::new(&prepared, RunOptions::default()).finish(&mut ());
    let facts = facts(&outcome);
    assert!(facts["pilot_events"] < 30.0, "{facts:?}");
    assert!((facts["pilot_ttis"] - 3000.0).abs() < 0.5, "{facts:?}");
    // Without events the search knows only the energy that the pairs spend.
    assert!(facts["pilot_events"] < 0.5, "{facts:?}");
    assert_eq!((facts["t_on"] as u32, facts["t_drx"] as u32), (1, 32), "{facts:?}");
    assert!(prepare(&scenario(&["devices=50", "ttis=400"])).warnings.is_empty());
}

/// Equal energy at other times: a search that knows only the mean finds the same pair.
#[test]
fn pilots_know_the_mean_of_a_trace_and_not_its_future() {
    let folder = TestFolder::new();
    let rows = |of: fn(u32) -> f64| {
        (0..2000)
            .map(|row| format!("{}\n", of(row)))
            .collect::<Vec<_>>()
            .concat()
    };
    folder.write(
        "early.csv",
        &format!("e\n{}", rows(|row| if row < 200 { 4.0 } else { 0.0 })),
    );
    folder.write(
        "late.csv",
        &format!("e\n{}", rows(|row| if row < 1800 { 0.0 } else { 4.0 })),
    );
    let of = |file: &str| {
        let file = format!("harvest.trace.file={}", folder.join(file).display());
        found(&scenario(&[
            "devices=60",
            "harvest.kind=trace",
            "harvest.trace.column=e",
            file.as_str(),
        ]))
    };
    let (early, late) = (of("early.csv"), of("late.csv"));
    assert_eq!(early, late, "the same mean");
    // In each TTI an arrival of the trace's mean.
    let constant = found(&scenario(&[
        "devices=60",
        "harvest.kind=exp-minus-lambda",
        "harvest.lambda=0",
        "harvest.e_b=0.4",
    ]));
    assert_eq!(early, constant);
}

/// Compares the emulator's search with a search in runs of the second implementation.
#[test]
fn the_search_takes_the_pair_that_the_second_implementation_takes() {
    let mut runner = TestRunner::deterministic();
    let (mut same, mut of_many, mut reaching) = (0, 0, 0);
    for _ in 0..80 {
        let text = scenarios::under("adjusted")
            .new_tree(&mut runner)
            .expect("a scenario")
            .current();
        let scenario = scenarios::scenario(&text);
        let positions = Deployment::new(&scenario).positions();
        let Some(expected) = reference::own_search(&scenario, &positions) else {
            continue;
        };
        let choice = found(&scenario);
        assert_eq!((u64::from(choice.t_on), u64::from(choice.t_drx)), expected, "{text}");
        same += 1;
        of_many += u64::from(choice.searched_pairs > 1);
        reaching += u64::from(choice.reaches_i_min);
    }
    assert!(
        same >= 30 && of_many >= 20 && reaching >= 10,
        "{same} decided, {of_many} of several, {reaching} reach"
    );
}
