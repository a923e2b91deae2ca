//! Actions of operators: a run with actions equals the reference implementation, a run with one TTI per grant, its
//! reconstruction and its replays. Random scripts set no price, since no random scenario has the policy `age-index`; a
//! separate test does. Actions over the bus are tested in `tests/program/`. Counts and factors in the assertions only
//! ensure that a case occurs or an effect is clear; they are no requirements.

use std::cell::RefCell;
use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::{Config, TestRunner};
use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRange, Frame, OperatorAction, Setting};
use reveille_common::totals::{Ledger, MissCause};
use reveille_common::units::Energy;
use reveille_lab::external_inputs::{ExternalInput, ExternalInputs, first_line, input_line, parse};
use reveille_lab::preparation::{prepare, start};
use reveille_lab::replay::Replay;
use reveille_lab::run::RunOptions;
use reveille_tests::compare::{self, EventCollector};
use reveille_tests::reference::{ReferenceRun, simulate_with_actions};
use reveille_tests::scenarios;
use reveille_view::reconstruction::Reconstruction;

/// Results of a run in memory.
struct PlayedRun {
    outcome: RunOutcome,
    /// Ended events, in order.
    events: Vec<EventRecord>,
    frames: Vec<Frame>,
}

/// Runs `scenario` with `actions`, in the order of TTIs.
fn play(scenario: &Scenario, actions: &[OperatorAction], options: RunOptions) -> PlayedRun {
    let frames = RefCell::new(Vec::new());
    let mut observers = (
        EventCollector::default(),
        FrameObserver::new(0, |frame| frames.borrow_mut().push(frame)),
    );
    let mut run = start(scenario, options);
    run.schedule_inputs(&ExternalInputs::from_actions(actions));
    let outcome = run.finish(&mut observers);
    let events = observers.0.events;
    PlayedRun {
        outcome,
        events,
        frames: frames.into_inner(),
    }
}

/// Returns the scenario of `text`, cut short before the first decision that is too close to call, with the actions
/// drawn from `seed` up to there, and the reference run. `None` if that decision is in TTI 0.
fn run_reference(text: &str, seed: u64) -> Option<(Scenario, Vec<OperatorAction>, ReferenceRun)> {
    let mut scenario = scenarios::scenario(text);
    let mut actions = scenarios::draw_actions(&scenario, seed);
    loop {
        let reference_run = simulate_with_actions(&scenario, &actions);
        match reference_run.ambiguous {
            None => return Some((scenario, actions, reference_run)),
            Some(0) => return None,
            Some(k) => {
                scenario.run.ttis = k;
                actions.retain(|action| action.tti < Tti(k));
            }
        }
    }
}

proptest! {
    #![proptest_config(Config { cases: 400, failure_persistence: None, ..Config::default() })]

    #[test]
    fn a_run_with_actions_equals_the_reference(
        text in prop_oneof![2 => scenarios::small(), 1 => scenarios::crowded()],
        seed in any::<u64>(),
        lookahead in any::<bool>(),
        window in prop_oneof![Just(u64::MAX), 1..50u64],
    ) {
        let Some((scenario, actions, expected)) = run_reference(&text, seed) else {
            return Err(TestCaseError::reject("too close to call in TTI 0"));
        };
        let PlayedRun { outcome, events, .. } = play(&scenario, &actions, RunOptions { lookahead, window });
        prop_assert_eq!(events, expected.events.clone(), "events\n{:?}\n{}", actions, text);
        let ledgers: Vec<Ledger> = outcome.devices.iter().map(|device| device.ledger).collect();
        prop_assert_eq!(ledgers, expected.ledgers.clone(), "ledgers\n{:?}\n{}", actions, text);
        prop_assert_eq!(outcome.totals.energy, expected.measured, "energy\n{:?}\n{}", actions, text);
        prop_assert_eq!(outcome.totals.events, expected.totals, "event totals\n{:?}\n{}", actions, text);
        let measured_ttis = outcome.totals.ttis as f64;
        let information = expected.totals.information_pico as f64 * 1e-12;
        let info_p1 = information / (expected.start_probability * measured_ttis);
        let is_near = (outcome.metrics.info_p1 - info_p1).abs() <= 1e-9 * info_p1.max(1.0);
        let are_undefined = info_p1.is_nan() && outcome.metrics.info_p1.is_nan();
        prop_assert!(is_near || are_undefined, "info_p1 {} {}\n{:?}", outcome.metrics.info_p1, info_p1, actions);
        let trace = compare::trace(&scenario, &actions);
        prop_assert_eq!(trace.len(), expected.trace.len());
        for (k, (emulated, expected)) in trace.iter().zip(&expected.trace).enumerate() {
            prop_assert_eq!(emulated, expected, "TTI {}\n{:?}\n{}", k, actions, text);
        }
    }

    #[test]
    fn a_run_with_actions_equals_its_reconstruction_and_its_replays(
        text in scenarios::small_or_q_learning(),
        seed in any::<u64>(),
        replayed_until in any::<prop::sample::Index>(),
    ) {
        let scenario = scenarios::scenario(&text);
        let actions = scenarios::draw_actions(&scenario, seed);
        let inputs = ExternalInputs::from_actions(&actions);
        let log = first_line(&scenario) + &inputs.iter().map(|input| input_line(&input)).collect::<String>();
        let parsed = parse(&log, &scenario).map_err(|error| TestCaseError::fail(format!("{error}\n{log}")))?;
        prop_assert_eq!(parsed, inputs, "log\n{}", log);
        let PlayedRun { outcome, frames, .. } = play(&scenario, &actions, RunOptions::default());
        let one_tti_per_grant = play(&scenario, &actions, compare::ONE_TTI_PER_GRANT);
        prop_assert_eq!(&one_tti_per_grant.outcome, &outcome, "one TTI per grant\n{:?}\n{}", actions, text);
        let without_actions = play(&scenario, &[], RunOptions::default()).outcome;
        prop_assert_ne!(without_actions.digest, outcome.digest, "the digest covers actions\n{:?}\n{}", actions, text);
        for frames in [frames, one_tti_per_grant.frames] {
            let mut reconstruction = Reconstruction::new(&scenario);
            for frame in &frames {
                reconstruction.apply(frame).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
            }
            let reconstructed = reconstruction.finish();
            prop_assert_eq!(reconstructed.digest, outcome.digest, "reconstruction\n{:?}\n{}", actions, text);
            prop_assert_eq!(reconstructed.metrics.info_p1.to_bits(), outcome.metrics.info_p1.to_bits());
        }
        // A replay that has passed an action when it is added, as after a takeover.
        let prepared = prepare(&scenario);
        let mut replay = Replay::new(&prepared, &ExternalInputs::default(), Tti::ZERO);
        replay.checkpoints(Tti(replayed_until.index(scenario.run.ttis as usize) as u64), DeviceId(0), 1);
        for action in &actions {
            replay.add_input(ExternalInput::Action(*action));
        }
        prop_assert_eq!(replay.outcome(Tti(scenario.run.ttis)), outcome, "replay\n{:?}\n{}", actions, text);
    }
}

/// The comparison with the reference covers every cause that failures and missing energy lead to.
#[test]
fn random_actions_cover_the_causes_of_missed_events() {
    let mut runner = TestRunner::deterministic();
    let mut counts: BTreeMap<&str, u64> = BTreeMap::new();
    for seed in 0..300 {
        let text = scenarios::small().new_tree(&mut runner).expect("a scenario").current();
        if let Some((_, _, expected)) = run_reference(&text, seed) {
            for cause in expected.events.iter().filter_map(|event| event.miss_cause) {
                *counts.entry(cause.name()).or_default() += 1;
            }
        }
    }
    println!("{counts:#?}");
    for cause in [
        MissCause::Removed,
        MissCause::Asleep,
        MissCause::Failed,
        MissCause::Unpowered,
    ] {
        assert!(counts[cause.name()] >= 100, "{cause:?}: {counts:?}");
    }
}

/// Returns the range of the devices 0 to `count` − 1.
const fn first_devices(count: u32) -> DeviceRange {
    DeviceRange {
        first: DeviceId(0),
        count,
    }
}

fn action(tti: u64, change: Change) -> OperatorAction {
    OperatorAction { tti: Tti(tti), change }
}

#[test]
fn failed_devices_report_nothing_and_charge() {
    let scenario = scenarios::paper(&["devices=40", "ttis=2000", "policy.name=age-index", "warm_up=0"]);
    let actions = [
        action(500, Change::Fail(first_devices(40))),
        action(1500, Change::Revive(first_devices(40))),
    ];
    let PlayedRun { outcome, events, .. } = play(&scenario, &actions, RunOptions::default());
    let count_reported_in = |from: u64, to: u64| {
        let is_reported = |event: &&EventRecord| event.tally.reports > 0 && (from..to).contains(&event.last.0);
        events.iter().filter(is_reported).count()
    };
    assert!(count_reported_in(0, 500) > 20 && count_reported_in(1500, 2000) > 20);
    assert_eq!(count_reported_in(500, 1500), 0);
    let causes_while_failed: Vec<_> = events
        .iter()
        .filter(|event| event.start.0 >= 500 && event.last.0 < 1500)
        .map(|event| event.miss_cause)
        .collect();
    let count_cause = |cause| {
        let causes = causes_while_failed.iter();
        causes.filter(|known| **known == Some(cause)).count()
    };
    // The policy still plans with the failed devices, so some of them have δ = 1 near an event.
    let (failed, removed) = (count_cause(MissCause::Failed), count_cause(MissCause::Removed));
    assert!(
        failed > 50 && failed + removed == causes_while_failed.len(),
        "{failed} failed, {removed} removed: {causes_while_failed:?}"
    );
    assert_eq!(outcome.totals.missed.failed, failed as u64);
    for device in &outcome.devices {
        let whole = device.ledger.whole;
        assert!(whole.is_balanced());
        // Nothing is spent in half of the TTIs, so that the harvest overflows.
        assert!(whole.overflow > Energy::ZERO, "{whole:?}");
    }
    let second_fail = [actions[0], action(900, Change::Fail(first_devices(3))), actions[1]];
    let failed_twice = play(&scenario, &second_fail, RunOptions::default());
    assert_eq!(
        failed_twice.outcome.devices, outcome.devices,
        "a failed device that fails again stays as it is"
    );
}

#[test]
fn energy_counts_as_harvest_and_settings_change_the_run() {
    let scenario = scenarios::paper(&[
        "devices=40",
        "ttis=4000",
        "policy.name=age-index",
        "warm_up=0",
        "harvest.e_b=0",
        "energy.initial=0",
    ]);
    let five_units = Energy::from_micro(5_000_000);
    // E_max of the preset.
    let e_max = Energy::from_micro(100_000_000);
    let actions = [
        action(10, Change::AddEnergy(first_devices(1), five_units)),
        action(20, Change::AddEnergy(first_devices(1), e_max)),
        action(30, Change::Set(Setting::EventRate, 0.5)),
    ];
    let PlayedRun { outcome, events, .. } = play(&scenario, &actions, RunOptions::default());
    let whole = outcome.devices[0].ledger.whole;
    assert_eq!(whole.harvested, five_units + e_max);
    // Less than the five units overflows: the device has spent some of them by TTI 20.
    assert!(
        whole.overflow > Energy::ZERO && whole.overflow < five_units,
        "{whole:?}"
    );
    assert_eq!(outcome.devices[1].ledger.whole.harvested, Energy::ZERO);
    let events_at_first_rate = play(&scenario, &actions[..2], RunOptions::default()).events;
    assert!(
        events.len() > events_at_first_rate.len() * 5 / 4,
        "{} and {} events",
        events.len(),
        events_at_first_rate.len()
    );
    // The price is high from TTI 1000 on, where the measured part begins: devices sense less.
    let with_usual_harvest = scenarios::paper(&["devices=40", "ttis=2000", "policy.name=age-index", "warm_up=0.5"]);
    let sensing_energy = |actions: &[OperatorAction]| {
        let played = play(&with_usual_harvest, actions, RunOptions::default());
        played.outcome.metrics.energy_sensing_per_device_tti
    };
    let with_high_price = sensing_energy(&[action(1000, Change::Set(Setting::Price, 5.0))]);
    assert!(with_high_price < 0.8 * sensing_energy(&[]));
    let high_price_scenario = scenarios::paper(&[
        "devices=40",
        "ttis=2000",
        "policy.name=age-index",
        "policy.age-index.price=5",
    ]);
    let set_in_first_tti = play(
        &scenarios::paper(&["devices=40", "ttis=2000", "policy.name=age-index"]),
        &[action(0, Change::Set(Setting::Price, 5.0))],
        RunOptions::default(),
    );
    // The digest covers the action, so it differs.
    let expected = play(&high_price_scenario, &[], RunOptions::default());
    assert_eq!(
        (set_in_first_tti.events, set_in_first_tti.outcome.metrics),
        (expected.events, expected.outcome.metrics)
    );
}
