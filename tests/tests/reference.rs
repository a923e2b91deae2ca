//! The emulator and the reference implementation agree on random small scenarios, to the last micro-unit.

use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::{Config, TestRunner};
use reveille_common::scenario::Scenario;
use reveille_common::score::Metrics;
use reveille_common::totals::Totals;
use reveille_tests::{compare, reference, scenarios};

proptest! {
    #![proptest_config(Config { cases: 600, failure_persistence: None, ..Config::default() })]

    #[test]
    fn event_records_ledgers_and_totals_are_the_same(
        text in any_scenario(),
        lookahead in any::<bool>(),
        window in prop_oneof![Just(u64::MAX), 1..50u64],
    ) {
        let Some((scenario, expected)) = decided(scenarios::scenario(&text)) else {
            return Err(TestCaseError::reject("too close to call in TTI 0"));
        };
        let (outcome, events) = compare::outcome(&scenario, lookahead, window);
        prop_assert_eq!(events, expected.events.clone(), "events\n{}", text);
        prop_assert_eq!(compare::ledgers(&scenario, lookahead), expected.ledgers.clone(), "ledgers\n{}", text);
        prop_assert_eq!(outcome.totals.energy, expected.measured, "measured energy\n{}", text);
        prop_assert_eq!(outcome.totals.events, expected.totals, "event totals\n{}", text);
        prop_assert_eq!(outcome.totals.devices, u64::from(scenario.devices));
        prop_assert_eq!(outcome.totals.ttis, scenario.ttis - warm_up_end(&scenario));
        let messages = expected.wake_ups + synchronisations(&scenario);
        prop_assert_eq!(outcome.totals.control.messages, messages, "control messages\n{}", text);
        prop_assert!(outcome.complete && outcome.ttis_done == scenario.ttis);
        same_metrics(&scenario, &outcome.totals, &outcome.metrics)?;
    }

    #[test]
    fn states_and_batteries_are_the_same_after_every_tti(text in any_scenario()) {
        let Some((scenario, expected)) = decided(scenarios::scenario(&text)) else {
            return Err(TestCaseError::reject("too close to call in TTI 0"));
        };
        let trace = compare::trace(&scenario);
        for (k, (emulated, expected)) in trace.iter().zip(&expected.trace).enumerate() {
            prop_assert_eq!(emulated, expected, "TTI {}\n{}", k, text);
        }
    }
}

fn any_scenario() -> impl Strategy<Value = String> {
    prop_oneof![2 => scenarios::small(), 1 => scenarios::crowded()]
}

/// The random scenarios are not all alike: everything that can happen does, often enough to be compared.
#[test]
fn random_scenarios_come_to_everything() {
    let mut runner = TestRunner::deterministic();
    let mut seen: BTreeMap<&str, u64> = BTreeMap::new();
    for _ in 0..300 {
        let text = any_scenario().new_tree(&mut runner).expect("a scenario").current();
        let whole = scenarios::scenario(&text);
        let asked = whole.ttis;
        let Some((scenario, run)) = decided(whole) else {
            continue;
        };
        let mut add = |what, n| *seen.entry(what).or_default() += n;
        add("cases", 1);
        add("cut short", u64::from(scenario.ttis < asked));
        add(scenario.policy.name(), 1);
        add("counted events", run.totals.events);
        add("misdetected", run.totals.misdetected);
        // Of energies and of device-TTIs, the runs that have any: a single one may have millions.
        add("runs that waste energy", u64::from(run.totals.wasted.micro() > 0));
        add("runs that overflow", u64::from(run.measured.overflow.micro() > 0));
        add("runs with low batteries", u64::from(run.measured.low_ttis > 0));
        add("runs with batteries to spare", u64::from(run.measured.low_ttis == 0));
        add("unheard", run.unheard);
        add("wake-ups spared", run.spared);
        for event in &run.events {
            let tally = &event.tally;
            add("wake-ups", tally.wake_ups);
            add("wrong activations", tally.wrong_activations);
            add("long events", u64::from(event.last > event.start));
            add("events of the warm-up", u64::from(!event.counted));
            add("several wake-ups", u64::from(tally.wake_ups > 2));
            add(
                "woken and first to report",
                u64::from(tally.wake_ups > 0 && tally.reports == tally.wake_ups),
            );
            add(
                "several reporters before a wake-up",
                u64::from(tally.wake_ups > 0 && tally.reports > tally.wake_ups + 1),
            );
        }
    }
    println!("{seen:#?}");
    let cut = seen.remove("cut short").unwrap_or_default();
    assert!(cut < 60, "{cut} runs cut short");
    for (what, n) in seen {
        assert!(n >= 20, "{what}: {n}");
    }
}

/// `scenario`, cut short before the first decision that is too close to call, and what the reference makes of it.
fn decided(mut scenario: Scenario) -> Option<(Scenario, reference::Run)> {
    loop {
        let run = reference::simulate(&scenario);
        match run.ambiguous {
            None => return Some((scenario, run)),
            Some(0) => return None,
            Some(k) => scenario.ttis = k,
        }
    }
}

fn warm_up_end(scenario: &Scenario) -> u64 {
    (scenario.ttis as f64 * scenario.warm_up).floor() as u64
}

/// Broadcasts of δ in the measured part: one at the start and one every `sync_interval`.
fn synchronisations(scenario: &Scenario) -> u64 {
    let is_due = |k: &u64| k.is_multiple_of(scenario.bs.sync_interval);
    (warm_up_end(scenario)..scenario.ttis).filter(is_due).count() as u64
}

/// The metrics are their definitions' arithmetic on the totals.
fn same_metrics(scenario: &Scenario, totals: &Totals, metrics: &Metrics) -> Result<(), TestCaseError> {
    let (events, energy) = (&totals.events, &totals.energy);
    let (n, ttis) = (f64::from(scenario.devices), totals.ttis as f64);
    let device_ttis = n * ttis;
    let information = events.information_pico as f64 * 1e-12;
    let (spent, harvested) = (
        energy.spent.micro() as f64 * 1e-6,
        energy.harvested.micro() as f64 * 1e-6,
    );
    let expected = [
        ("info_p1", information / (scenario.events.alpha * ttis)),
        ("energy_per_device_tti", spent / device_ttis),
        ("low_energy_pct", energy.low_ttis as f64 * 100.0 / device_ttis),
        ("mean_battery", energy.battery_sum as f64 * 1e-6 / device_ttis),
        ("harvested_per_device_tti", harvested / device_ttis),
        ("net_per_device_tti", (harvested - spent) / device_ttis),
        (
            "overflow_per_device_tti",
            energy.overflow.micro() as f64 * 1e-6 / device_ttis,
        ),
        ("ctl_bytes_per_tti", totals.control.bytes as f64 / ttis),
        ("ctl_msgs_per_tti", totals.control.messages as f64 / ttis),
        ("events", events.events as f64),
        ("info_per_event", information / events.events as f64),
        (
            "misdetection_pct",
            events.misdetected as f64 * 100.0 / events.events as f64,
        ),
        (
            "wrong_activations_per_event",
            events.wrong_activations as f64 / events.events as f64,
        ),
        (
            "wasted_energy_per_event",
            events.wasted.micro() as f64 * 1e-6 / events.events as f64,
        ),
        ("wake_ups_per_event", events.wake_ups as f64 / events.events as f64),
    ];
    let rows = metrics.rows();
    prop_assert_eq!(rows.len(), expected.len());
    for (name, value) in expected {
        let Some((_, shown, _)) = rows.iter().find(|row| row.0 == name) else {
            return Err(TestCaseError::fail(format!("no metric {name}")));
        };
        let same = (shown - value).abs() <= 1e-9 * value.abs().max(1.0) || (shown.is_nan() && value.is_nan());
        prop_assert!(same, "{}: {} and not {}", name, shown, value);
    }
    Ok(())
}
