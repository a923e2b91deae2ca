//! Event records, ledgers, totals, metrics, states and batteries are equal in the emulator and the reference
//! implementation, in random small scenarios. Byte counts are not checked: the reference sends no messages.
//!
//! The scenarios have the policies `random`, `knn`, `adjusted` and `genie`, no actions (see `actions.rs`) and no lost
//! hosts. The rules below (warm-up, broadcasts, metrics) are written a second time on purpose: a change of a rule or a
//! new metric needs the same change here.

use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::{Config, TestRunner};
use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::score::Metrics;
use reveille_common::totals::{DeviceTotals, Ledger, RadioLosses, Totals};
use reveille_lab::run::RunOptions;
use reveille_tests::reference::ReferenceRun;
use reveille_tests::{compare, reference, scenarios};

proptest! {
    #![proptest_config(Config { cases: 600, failure_persistence: None, ..Config::default() })]

    #[test]
    fn event_records_ledgers_and_totals_equal_the_reference(
        text in any_scenario(),
        lookahead in any::<bool>(),
        window in prop_oneof![Just(u64::MAX), 1..50u64],
    ) {
        let Some((scenario, expected)) = run_reference(scenarios::scenario(&text)) else {
            return Err(TestCaseError::reject("too close to call in TTI 0"));
        };
        let (outcome, events) = compare::outcome(&scenario, RunOptions { lookahead, window });
        prop_assert_eq!(events, expected.events.clone(), "events\n{}", text);
        let ledgers = compare::ledgers(&scenario, RunOptions { lookahead, ..RunOptions::default() });
        prop_assert_eq!(ledgers, expected.ledgers.clone(), "ledgers\n{}", text);
        let activity = outcome.devices.iter().map(|device| device.activity);
        prop_assert_eq!(activity.collect::<Vec<_>>(), expected.activity.clone(), "activity of devices\n{}", text);
        prop_assert_eq!(outcome.totals.energy, expected.measured, "measured energy\n{}", text);
        prop_assert_eq!(outcome.totals.losses, expected.losses, "losses\n{}", text);
        prop_assert_eq!(outcome.totals.events, expected.totals, "event totals\n{}", text);
        prop_assert_eq!(outcome.totals.devices, u64::from(scenario.run.devices));
        prop_assert_eq!(outcome.totals.ttis, scenario.run.ttis - warm_up_end(&scenario));
        let messages = expected.wake_ups + count_broadcasts(&scenario);
        prop_assert_eq!(outcome.totals.control.messages, messages, "control messages\n{}", text);
        prop_assert!(outcome.is_complete && outcome.ttis_done == scenario.run.ttis);
        check_metrics(&scenario, &expected, &outcome.totals, &outcome.metrics)?;
    }

    #[test]
    fn states_and_batteries_after_every_tti_equal_the_reference(text in any_scenario()) {
        check_states_and_batteries(&text)?;
    }
}

/// A device that missed its plan stays silent while several others report the event. Its silence is one missing
/// report; counted once per reporter, its battery would count as empty too early, and no wake-up would follow.
#[test]
fn the_silence_of_a_device_counts_once_per_tti() {
    let text = "devices = 9\nttis = 40\nseed = 35\n[area]\nwidth = 6.0\nheight = 6.0\n[events]\nalpha = 1.0\n\
                [radio]\nplan_loss = 0.3\n[policy]\nname = \"adjusted\"\n[policy.adjusted]\nt_on = [1]\nt_drx = [2]\n";
    check_states_and_batteries(text).unwrap_or_else(|error| panic!("{error}"));
}

/// Batteries and arrivals of the largest allowed energy, in the longest run whose sums fit in 64 bits.
#[test]
fn the_largest_energies_neither_overflow_nor_lose_a_micro_unit() {
    let text = |ttis: u64| {
        format!(
            "devices = 5\nttis = {ttis}\n[energy]\ne_max = 1e9\ne_idle = 2.5e8\ne_wur = 0.00003\ne_tx = 9.99999999e8\n\
             [harvest]\nlambda = 1.0\ne_b = 1e9\n[policy]\nname = \"random\"\n"
        )
    };
    let longest = scenarios::scenario(&text(10)).max_ttis();
    assert!((1000..10_000).contains(&longest), "{longest} TTIs");
    let scenario = scenarios::scenario(&text(longest));
    let (expected, events) = compare::outcome(&scenario, compare::ONE_TTI_PER_GRANT);
    assert!(!events.is_empty());
    for (lookahead, window) in [(true, u64::MAX), (true, 7), (false, 100)] {
        let (outcome, _) = compare::outcome(&scenario, RunOptions { lookahead, window });
        assert_eq!(
            outcome.digest, expected.digest,
            "lookahead {lookahead}, windows of {window}"
        );
    }
    let ledgers = compare::ledgers(&scenario, RunOptions::default());
    assert!(ledgers.iter().all(|ledger| ledger.whole.is_balanced()), "{ledgers:?}");
    let harvested = ledgers.iter().map(|ledger| ledger.whole.harvested.micro()).sum::<u64>();
    assert!(harvested > u64::MAX / 10, "only {harvested} micro-units");
    check_states_and_batteries(&text(60)).unwrap_or_else(|error| panic!("{error}"));
}

/// Compares the states and batteries after every TTI of the scenario in TOML `text`.
fn check_states_and_batteries(text: &str) -> Result<(), TestCaseError> {
    let Some((scenario, expected)) = run_reference(scenarios::scenario(text)) else {
        return Err(TestCaseError::reject("too close to call in TTI 0"));
    };
    let trace = compare::trace(&scenario, &[]);
    for (k, (emulated, expected)) in trace.iter().zip(&expected.trace).enumerate() {
        prop_assert_eq!(emulated, expected, "TTI {}\n{}", k, text);
    }
    Ok(())
}

fn any_scenario() -> impl Strategy<Value = String> {
    prop_oneof![2 => scenarios::small(), 1 => scenarios::crowded()]
}

/// The random scenarios cover every kind of outcome often enough for the comparison. The limits below are not measured:
/// a change of the scenarios that violates one makes the comparison weak.
#[test]
fn random_scenarios_cover_every_case() {
    let mut runner = TestRunner::deterministic();
    let mut counts: BTreeMap<&str, u64> = BTreeMap::new();
    for _ in 0..300 {
        let text = any_scenario().new_tree(&mut runner).expect("a scenario").current();
        let drawn_scenario = scenarios::scenario(&text);
        let drawn_ttis = drawn_scenario.run.ttis;
        let Some((scenario, run)) = run_reference(drawn_scenario) else {
            continue;
        };
        let mut add = |case, count: u64| *counts.entry(case).or_default() += count;
        add("scenarios", 1);
        add("cut short", u64::from(scenario.run.ttis < drawn_ttis));
        add(scenario.policy.name(), 1);
        add(scenario.events.process.kind().name(), 1);
        add(scenario.events.duration_kind.name(), 1);
        add("counted events", run.totals.events);
        add("misdetected", run.totals.misdetected);
        // For energies and device-TTIs, counts the runs with any: a single run may have millions.
        add(
            "runs that waste energy",
            u64::from(run.totals.wasted_energy.micro() > 0),
        );
        add("runs that overflow", u64::from(run.measured.overflow.micro() > 0));
        add("runs with low batteries", u64::from(run.measured.low_ttis > 0));
        add("runs without low batteries", u64::from(run.measured.low_ttis == 0));
        add("missed wake-ups", run.missed_wake_ups);
        add("lost reports", run.losses.lost_reports);
        add("missed plans", run.losses.missed_plans);
        add("runs with false wake-ups", u64::from(run.measured.false_wake_ups > 0));
        add("runs with a perfect radio", u64::from(scenario.radio.is_perfect()));
        add(
            "runs with interference bursts",
            u64::from(scenario.radio.bursts.is_some()),
        );
        add("decisions that exclude a device", run.exclusions);
        for event in &run.events {
            let tally = &event.tally;
            add("wake-ups", tally.wake_ups);
            add("wrong activations", tally.wrong_activations);
            add("events of several TTIs", u64::from(event.last > event.start));
            let is_long = scenario.events.duration < event.last - event.start + 1;
            add("events longer than the mean", u64::from(is_long));
            add("events of the warm-up", u64::from(!event.counted));
            add("events with more than 2 wake-ups", u64::from(tally.wake_ups > 2));
            add(
                "events first reported by a woken device",
                u64::from(tally.wake_ups > 0 && tally.reports == tally.wake_ups),
            );
            add(
                "events with several reports before a wake-up",
                u64::from(tally.wake_ups > 0 && tally.reports > tally.wake_ups + 1),
            );
        }
    }
    println!("{counts:#?}");
    let cut_short = counts.remove("cut short").unwrap_or_default();
    assert!(cut_short < 60, "{cut_short} runs cut short");
    for (case, count) in counts {
        assert!(count >= 20, "{case}: {count}");
    }
}

/// Returns `scenario`, cut short before the first decision that is too close to call, and its reference run. `None` if
/// that decision is in TTI 0.
fn run_reference(mut scenario: Scenario) -> Option<(Scenario, reference::ReferenceRun)> {
    loop {
        let run = reference::simulate(&scenario);
        match run.ambiguous {
            None => return Some((scenario, run)),
            Some(0) => return None,
            Some(k) => scenario.run.ttis = k,
        }
    }
}

fn warm_up_end(scenario: &Scenario) -> u64 {
    (scenario.run.ttis as f64 * scenario.run.warm_up).floor() as u64
}

/// Counts the broadcasts of δ in the measured part: one every `sync_interval`, from TTI 0 on.
fn count_broadcasts(scenario: &Scenario) -> u64 {
    let is_due = |k: &u64| k.is_multiple_of(scenario.bs.sync_interval);
    (warm_up_end(scenario)..scenario.run.ttis).filter(is_due).count() as u64
}

/// Returns the share of each cause of missed events in the `counted` events, %.
fn cause_metrics(counted: &[&EventRecord]) -> Vec<Row> {
    let share = |cause: &str| {
        let has_cause = |record: &&&EventRecord| record.miss_cause.is_some_and(|recorded| recorded.name() == cause);
        100.0 * counted.iter().filter(has_cause).count() as f64 / counted.len() as f64
    };
    vec![
        ("missed_out_of_reach_pct", share("out_of_reach")),
        ("missed_removed_pct", share("removed")),
        ("missed_undetected_pct", share("undetected")),
        ("missed_asleep_pct", share("asleep")),
        ("missed_failed_pct", share("failed")),
        ("missed_unpowered_pct", share("unpowered")),
        ("missed_wake_missed_pct", share("wake_missed")),
        ("missed_no_energy_pct", share("no_energy")),
        ("missed_lost_pct", share("lost")),
    ]
}

/// Checks that the metrics equal their definitions applied to the reference run. The bytes in the metrics of traffic
/// are the emulator's.
fn check_metrics(
    scenario: &Scenario,
    run: &ReferenceRun,
    totals: &Totals,
    metrics: &Metrics,
) -> Result<(), TestCaseError> {
    let counted: Vec<_> = run.events.iter().filter(|record| record.counted).collect();
    let reported: Vec<_> = counted.iter().filter(|record| record.tally.reports > 0).collect();
    let (device_count, ttis) = (
        f64::from(scenario.run.devices),
        (scenario.run.ttis - warm_up_end(scenario)) as f64,
    );
    let mut rows = information_metrics(&counted, &reported, run.start_probability * ttis);
    rows.extend(energy_metrics(run, device_count, ttis));
    let information: f64 = counted
        .iter()
        .map(|record| record.tally.information_pico as f64 * 1e-12)
        .sum();
    let spent = |ledger: &Ledger| ledger.measured.spent.total().units();
    let energy: f64 = run.ledgers.iter().map(spent).sum();
    let efficiency = if energy > 0.0 { information / energy } else { f64::NAN };
    rows.push(("info_per_energy", efficiency));
    rows.extend([
        (
            "wake_up_span_ttis",
            run.wake_up_span_ttis as f64 / reported.len() as f64,
        ),
        ("ctl_bytes_per_tti", totals.control.bytes as f64 / ttis),
        ("ctl_msgs_per_tti", totals.control.messages as f64 / ttis),
        ("uplink_bytes_per_tti", totals.uplink.bytes as f64 / ttis),
    ]);
    rows.extend(loss_metrics(run, device_count, ttis));
    rows.extend(cause_metrics(&counted));
    prop_assert_eq!(metrics.rows().len(), rows.len());
    for (name, expected) in rows {
        let Some(value) = metrics.value(name) else {
            return Err(TestCaseError::fail(format!("no metric {name}")));
        };
        let is_near = (value - expected).abs() <= 1e-9 * expected.abs().max(1.0);
        let is_equal = is_near || (value.is_nan() && expected.is_nan());
        prop_assert!(is_equal, "{}: {}, expected {}", name, value, expected);
    }
    Ok(())
}

/// `ttis` is the number of measured TTIs.
fn loss_metrics(run: &ReferenceRun, device_count: f64, ttis: f64) -> Vec<Row> {
    let RadioLosses {
        lost_reports,
        sent_wake_ups,
        missed_wake_ups,
        late_wake_ups,
        sent_plans,
        missed_plans,
    } = run.losses;
    let pct = |part: u64, whole: u64| part as f64 / whole as f64 * 100.0;
    let sleeping_ttis = (device_count * ttis).round() as u64 - run.measured.sensing_ttis;
    vec![
        (
            "lost_reports_pct",
            pct(lost_reports, lost_reports + run.arrived_reports),
        ),
        ("missed_wake_ups_pct", pct(missed_wake_ups, sent_wake_ups)),
        ("late_wake_ups_pct", pct(late_wake_ups, sent_wake_ups)),
        ("missed_plans_pct", pct(missed_plans, sent_plans)),
        ("false_wake_ups_pct", pct(run.measured.false_wake_ups, sleeping_ttis)),
        // A run in memory loses no process.
        ("removed_pct", 0.0),
    ]
}

/// Name and value of a metric.
type Row = (&'static str, f64);

/// `expected_events` is the mean number of events that start in the measured TTIs.
fn information_metrics(counted: &[&EventRecord], reported: &[&&EventRecord], expected_events: f64) -> Vec<Row> {
    let (events, reported_events) = (counted.len() as f64, reported.len() as f64);
    let sum = |value: &dyn Fn(&EventRecord) -> f64| counted.iter().map(|record| value(record)).sum::<f64>();
    let information = sum(&|record| record.tally.information_pico as f64 * 1e-12);
    let mut delays: Vec<u64> = reported.iter().map(|record| record.last.0 - record.start.0).collect();
    delays.sort_unstable();
    // Nearest rank: the smallest delay that at least 95 % of the delays do not exceed.
    let p95 = delays
        .iter()
        .find(|&&delay| delays.iter().filter(|&&other| other <= delay).count() as f64 >= 0.95 * reported_events);
    vec![
        ("events", events),
        ("info_p1", information / expected_events),
        ("info_per_event", information / events),
        (
            "detection_delay_ttis",
            delays.iter().sum::<u64>() as f64 / reported_events,
        ),
        ("detection_delay_p95_ttis", p95.map_or(f64::NAN, |&delay| delay as f64)),
        ("misdetection_pct", (events - reported_events) * 100.0 / events),
        ("reports_per_event", sum(&|record| record.tally.reports as f64) / events),
        (
            "wake_ups_per_event",
            sum(&|record| record.tally.wake_ups as f64) / events,
        ),
        (
            "wrong_activations_per_event",
            sum(&|record| record.tally.wrong_activations as f64) / events,
        ),
        (
            "wasted_energy_per_event",
            sum(&|record| record.tally.wasted_energy.micro() as f64 * 1e-6) / events,
        ),
    ]
}

/// `ttis` is the number of measured TTIs.
fn energy_metrics(run: &ReferenceRun, device_count: f64, ttis: f64) -> Vec<Row> {
    let measured: Vec<DeviceTotals> = run.ledgers.iter().map(|ledger| ledger.measured).collect();
    let sum = |value: fn(&DeviceTotals) -> f64| measured.iter().map(value).sum::<f64>();
    let mean = |value: fn(&DeviceTotals) -> f64| sum(value) / device_count / ttis;
    let mean_units = |micro: fn(&DeviceTotals) -> f64| mean(micro) * 1e-6;
    let spent = |device: &DeviceTotals| {
        (device.spent.sensing.micro() + device.spent.sleep.micro() + device.spent.report.micro()) as f64
    };
    let max_low_ttis = measured.iter().map(|device| device.low_ttis).max().unwrap_or(0);
    vec![
        ("energy_per_device_tti", mean_units(spent)),
        (
            "energy_sensing_per_device_tti",
            mean_units(|device| device.spent.sensing.micro() as f64),
        ),
        (
            "energy_sleep_per_device_tti",
            mean_units(|device| device.spent.sleep.micro() as f64),
        ),
        (
            "energy_report_per_device_tti",
            mean_units(|device| device.spent.report.micro() as f64),
        ),
        (
            "fairness_energy",
            sum(spent).powi(2) / device_count / measured.iter().map(|device| spent(device).powi(2)).sum::<f64>(),
        ),
        (
            "harvested_per_device_tti",
            mean_units(|device| device.harvested.micro() as f64),
        ),
        (
            "net_per_device_tti",
            mean_units(|device| device.harvested.micro() as f64) - mean_units(spent),
        ),
        (
            "overflow_per_device_tti",
            mean_units(|device| device.overflow.micro() as f64),
        ),
        ("mean_battery", mean_units(|device| device.battery_sum as f64)),
        ("low_energy_pct", 100.0 * mean(|device| device.low_ttis as f64)),
        ("worst_low_energy_pct", 100.0 * max_low_ttis as f64 / ttis),
        (
            "failed_actions_pct",
            100.0 * sum(|device| device.failed_ttis as f64) / sum(|device| device.sensing_ttis as f64),
        ),
        ("unpowered_pct", 100.0 * mean(|device| device.unpowered_ttis as f64)),
        (
            "no_power_pct",
            100.0 * mean(|device| (device.failed_ttis + device.unpowered_ttis) as f64),
        ),
    ]
}
