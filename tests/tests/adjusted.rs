//! Adjusted duty cycling (Sec. V-A, first approach): what its search may know, how it judges, and whom it leaves blind.

use std::collections::BTreeMap;

use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use reveille_bs::outcome::Outcome;
use reveille_bs::policy::adjusted::search::DutyChoice;
use reveille_bs::policy::contract::Opaque;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_lab::preparation::{prepare, run};
use reveille_lab::run::{Options, Run};
use reveille_tests::process::Folder;
use reveille_tests::{reference, scenarios};

fn scenario(set: &[&str]) -> Scenario {
    let set = ["policy.name=adjusted"].iter().chain(set);
    let overrides: Vec<Override> = set.map(|set| Override::parse(set).expect("an override")).collect();
    load("paper", &overrides).expect("a scenario")
}

fn facts(outcome: &Outcome) -> BTreeMap<&'static str, f64> {
    outcome.facts.iter().copied().collect()
}

fn found(scenario: &Scenario) -> DutyChoice {
    let findings = prepare(scenario).findings;
    *findings.as_ref().and_then(Opaque::get).expect("a search")
}

/// Every sixteenth device of a 16 × 16 grid is a column of it: offsets by number leave all others blind for a TTI.
#[test]
fn on_a_grid_nobody_is_blind_for_a_stripe_of_sensing_devices() {
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
fn as_many_devices_sense_in_each_tti_as_the_duty_cycle_says() {
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
            let mut run = Run::new(&prepare(&scenario), Options::default());
            run.grant(&mut ());
            let plan = run.cycle().plan().clone();
            let sensing = |k| {
                (0..devices)
                    .filter(|&j| plan.duty_cycle(DeviceId(j)).is_on(Tti(k)))
                    .collect()
            };
            (0..t_drx).map(sensing).collect::<Vec<Vec<u32>>>()
        };
        let sensing = of("seed=1");
        // Each phase of the cycle is that of N/t_DRX devices, one more or less.
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
    // Where events are many, nothing is added.
    let often = self::facts(&run(&scenario(&["devices=100", "ttis=400"])));
    assert!(often["pilot_events"] >= 30.0, "{often:?}");
    assert!((often["pilot_ttis"] - 2000.0).abs() < 0.5, "{often:?}");
}

#[test]
fn a_search_without_events_to_judge_by_says_so() {
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
    let outcome = Run::new(&prepared, Options::default()).finish(&mut ());
    let facts = facts(&outcome);
    assert!(facts["pilot_events"] < 30.0, "{facts:?}");
    assert!((facts["pilot_ttis"] - 3000.0).abs() < 0.5, "{facts:?}");
    // Without any event nothing is known but what the pairs spend.
    assert!(facts["pilot_events"] < 0.5, "{facts:?}");
    assert_eq!((facts["t_on"] as u32, facts["t_drx"] as u32), (1, 32), "{facts:?}");
    assert!(prepare(&scenario(&["devices=50", "ttis=400"])).warnings.is_empty());
}

/// The same energy at other times: a search that knows the mean alone finds the same.
#[test]
fn pilots_know_the_mean_of_a_trace_and_not_its_future() {
    let folder = Folder::new();
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
    // An arrival in each TTI of what a trace brings on average.
    let constant = found(&scenario(&[
        "devices=60",
        "harvest.kind=exp-minus-lambda",
        "harvest.lambda=0",
        "harvest.e_b=0.4",
    ]));
    assert_eq!(early, constant);
}

/// The search of the emulator against one in the second implementation's own runs.
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
        of_many += u64::from(choice.pairs > 1);
        reaching += u64::from(choice.reaches_i_min);
    }
    assert!(
        same >= 30 && of_many >= 20 && reaching >= 10,
        "{same} decided, {of_many} of several, {reaching} reach"
    );
}
