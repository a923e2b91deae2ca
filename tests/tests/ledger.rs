//! Invariants of devices in every TTI of random scenarios (`Machine`, its states and its ledger) on the emulator. Two
//! tests take clusters or δ from the reference implementation; `reference.rs` compares all results with it. No operator
//! acts here and no device is removed, so the state `Failed` must not occur.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::policy::knn::KnnSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::scenario::EnergyModel;
use reveille_common::state::DeviceState;
use reveille_common::totals::DeviceTotals;
use reveille_device::machine::Machine;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_tests::{compare, reference, scenarios};

proptest! {
    #![proptest_config(Config { cases: 300, failure_persistence: None, ..Config::default() })]

    #[test]
    fn ledgers_balance_in_every_tti(text in scenarios::small_or_q_learning()) {
        let scenario = scenarios::scenario(&text);
        // A device can have at most one false wake-up and one that comes too late in a TTI.
        let can_be_fruitless = [scenario.radio.false_wake_up > 0.0, scenario.radio.wake_latency > 0];
        let max_fruitless_wake_ups = can_be_fruitless.map(u64::from).iter().sum();
        check_each_tti(&scenario, |tti| {
            for device in &tti.devices {
                check_balance(device, max_fruitless_wake_ups)?;
            }
            Ok(())
        })?;
    }

    #[test]
    fn states_follow_delta_and_the_battery(text in scenarios::small_or_q_learning()) {
        let scenario = scenarios::scenario(&text);
        check_each_tti(&scenario, |tti| {
            for device in &tti.devices {
                check_states(device, scenario.radio.wake_latency > 0)?;
            }
            Ok(())
        })?;
    }

    #[test]
    fn under_knn_one_member_of_each_cluster_senses(text in scenarios::small_with_policy("knn")) {
        let scenario = scenarios::scenario(&text);
        let clusters = knn_clusters(&scenario);
        prop_assert_eq!(clusters.iter().map(Vec::len).sum::<usize>(), scenario.run.devices as usize);
        check_each_tti(&scenario, |tti| {
            for cluster in &clusters {
                let is_on = |member: &&DeviceId| tti.devices[member.index()].delta;
                prop_assert_eq!(cluster.iter().filter(is_on).count(), 1, "members with δ = 1 in TTI {}", tti.k);
                let is_idle = |member: &&DeviceId| tti.devices[member.index()].begin_state == DeviceState::Idle;
                prop_assert!(cluster.iter().filter(is_idle).count() <= 1, "several members in S1 in TTI {}", tti.k);
            }
            Ok(())
        })?;
    }

    #[test]
    fn with_ample_energy_no_action_fails(text in scenarios::with_ample_energy()) {
        let scenario = scenarios::scenario(&text);
        let policy = reference::build_policy(&scenario, &Deployment::new(&scenario).positions());
        let mut sensing_ttis = 0;
        check_each_tti(&scenario, |tti| {
            for (j, device) in tti.devices.iter().enumerate() {
                let is_on = policy.senses(j, tti.k.0);
                prop_assert_eq!(device.delta, is_on, "δ of device {} in TTI {}", j, tti.k);
                let expected_state = if is_on { DeviceState::Idle } else { DeviceState::Sleep { powered: true } };
                prop_assert_eq!(device.begin_state, expected_state, "device {} in TTI {}", j, tti.k);
                let has_failed = matches!(device.end_state, DeviceState::Sleep { powered: false });
                prop_assert!(!has_failed, "device {} in TTI {}", j, tti.k);
                sensing_ttis += usize::from(is_on);
            }
            Ok(())
        })?;
        if reaches_sensing_tti(&scenario) {
            prop_assert_eq!(sensing_ttis > 0, scenario.policy.name() != "genie", "{} TTIs in S1", sensing_ttis);
        }
    }

    #[test]
    fn results_depend_neither_on_lookahead_nor_on_windows(
        text in scenarios::small_or_q_learning(),
        window in 1..50u64,
    ) {
        let scenario = scenarios::scenario(&text);
        let (expected_outcome, expected_events) = compare::outcome(&scenario, compare::ONE_TTI_PER_GRANT);
        // With a window per TTI every device advances in every TTI; without windows a sleeping device advances only
        // when needed.
        for (lookahead, window) in [(true, u64::MAX), (true, window), (false, window), (false, 1)] {
            let (outcome, events) = compare::outcome(&scenario, RunOptions { lookahead, window });
            prop_assert_eq!(&outcome.digest, &expected_outcome.digest);
            prop_assert_eq!(&outcome.totals, &expected_outcome.totals);
            prop_assert_eq!(&events, &expected_events);
        }
    }
}

/// Course of one TTI for one device.
struct DeviceTti {
    costs: EnergyModel,
    /// Whether δ = 1 by the plan that the device has.
    delta: bool,
    /// State after harvest and δ, before any event or wake-up.
    begin_state: DeviceState,
    /// Battery at the same time, micro-units.
    begin_level: u64,
    /// State at the end of the TTI.
    end_state: DeviceState,
    /// Totals before the TTI.
    totals_before: DeviceTotals,
    /// Totals after the TTI.
    totals_after: DeviceTotals,
}

/// Course of one TTI.
struct TtiCourse {
    k: Tti,
    /// Courses by device.
    devices: Vec<DeviceTti>,
}

type CheckResult = Result<(), TestCaseError>;

/// Runs `scenario`, with one TTI per grant, and calls `check` for every TTI.
fn check_each_tti(scenario: &Scenario, mut check: impl FnMut(&TtiCourse) -> CheckResult) -> CheckResult {
    let deployment = Deployment::new(scenario);
    let mut run = start(scenario, compare::ONE_TTI_PER_GRANT);
    for k in (0..scenario.run.ttis).map(Tti) {
        let machines_before = run.machines().to_vec();
        run.run_grant(&mut ());
        prop_assert_eq!(run.cycle().next_tti(), k + 1);
        let device_tti = |(mut earlier, later): (Machine, &Machine)| {
            // The device's own δ: it may have missed the current plan.
            let duty = later.duty();
            earlier.advance_to(k);
            let totals_before = earlier.totals();
            earlier.set_duty(k, duty);
            earlier.begin(k);
            // Advances a copy: the run advances its own machines later.
            let mut ended = later.clone();
            ended.begin(k);
            let end_state = ended.state();
            ended.advance_to(k + 1);
            DeviceTti {
                costs: deployment.devices[later.id().index()].energy,
                delta: duty.is_on(k),
                begin_state: earlier.state(),
                begin_level: earlier.battery().micro(),
                end_state,
                totals_before,
                totals_after: ended.totals(),
            }
        };
        let devices = machines_before
            .into_iter()
            .zip(run.machines())
            .map(device_tti)
            .collect();
        check(&TtiCourse { k, devices })?;
    }
    Ok(())
}

/// Checks the energy balance of a device; `max_fruitless_wake_ups` is the maximum number in a TTI of wake-ups without a
/// report, each of which costs E_idle.
fn check_balance(device: &DeviceTti, max_fruitless_wake_ups: u64) -> CheckResult {
    let DeviceTti {
        costs,
        totals_before,
        totals_after,
        ..
    } = device;
    for totals in [totals_before, totals_after] {
        let received = totals.initial.micro() + totals.harvested.micro();
        let given = totals.spent.total().micro() + totals.overflow.micro();
        prop_assert_eq!(received - given, totals.battery.micro());
        prop_assert!(totals.battery <= costs.e_max);
        prop_assert_eq!(totals.initial, costs.initial);
    }
    prop_assert!(totals_before.harvested <= totals_after.harvested);
    prop_assert!(totals_before.overflow <= totals_after.overflow);
    let battery_sum = totals_before.battery_sum + u128::from(totals_after.battery.micro());
    prop_assert_eq!(totals_after.battery_sum, battery_sum);
    let is_low = totals_after.battery < costs.e_tx;
    prop_assert_eq!(totals_after.low_ttis, totals_before.low_ttis + u64::from(is_low));
    let spent = totals_after.spent.total().micro() - totals_before.spent.total().micro();
    let fruitless_cost = costs.e_idle.times(max_fruitless_wake_ups);
    let max_spent = costs.e_tx.micro() + costs.e_idle.max(costs.e_wur + fruitless_cost).micro();
    prop_assert!(spent <= max_spent, "{} of at most {} spent in a TTI", spent, max_spent);
    if totals_after.overflow > totals_before.overflow {
        let level_from_full = costs.e_max.micro() - spent;
        prop_assert_eq!(totals_after.battery.micro(), level_from_full, "overflow with room left");
    }
    Ok(())
}

/// Checks that the states of a device follow from δ, its battery and each other. `can_wake_late` holds if a wake-up can
/// come too late for its event.
fn check_states(device: &DeviceTti, can_wake_late: bool) -> CheckResult {
    let DeviceTti {
        costs,
        delta,
        begin_state,
        begin_level,
        end_state,
        totals_after,
        ..
    } = device;
    let end_level = totals_after.battery.micro();
    match begin_state {
        DeviceState::Idle => prop_assert!(delta, "S1 with δ = 0"),
        DeviceState::Sleep { powered: true } => prop_assert!(!delta, "asleep with δ = 1"),
        DeviceState::Sleep { powered: false } => prop_assert_eq!(*begin_level, 0, "power left"),
        DeviceState::Active | DeviceState::Transmission | DeviceState::Failed => {
            prop_assert!(false, "{:?} before any event", begin_state);
        }
    }
    match end_state {
        DeviceState::Transmission => {
            // Only a sensing device that detected, or a sleeping one with a powered wake-up radio, reports.
            prop_assert!(
                !matches!(begin_state, DeviceState::Sleep { powered: false }),
                "reported without power"
            );
            prop_assert_eq!(end_level + costs.e_tx.micro(), *begin_level);
        }
        DeviceState::Sleep { powered: false } => prop_assert_eq!(end_level, 0, "a failed action leaves nothing"),
        DeviceState::Idle | DeviceState::Sleep { powered: true } => {
            prop_assert_eq!(end_state, begin_state);
            // A device that is woken too late pays for it and sleeps again.
            let is_woken_late = can_wake_late && end_level + costs.e_idle.micro() == *begin_level;
            prop_assert!(
                end_level == *begin_level || is_woken_late,
                "level {}, at the end {}",
                begin_level,
                end_level
            );
        }
        DeviceState::Active | DeviceState::Failed => prop_assert!(false, "{:?} at the end of a TTI", end_state),
    }
    Ok(())
}

/// Returns the `knn` clusters of a scenario, from the reference implementation.
fn knn_clusters(scenario: &Scenario) -> Vec<Vec<DeviceId>> {
    let positions = Deployment::new(scenario).positions();
    let settings = scenario
        .policy
        .settings()
        .downcast_ref::<KnnSettings>()
        .expect("settings of knn");
    let cluster_settings = settings.cluster_settings();
    let stream = Stream::new(scenario.run.seed, Purpose::Clusters, 0);
    let clusters = reference::clusters(
        &positions,
        scenario.area,
        scenario.sensing.d_max,
        cluster_settings,
        stream,
    );
    let to_ids = |cluster: Vec<usize>| cluster.into_iter().map(|j| DeviceId(j as u32)).collect();
    clusters.into_iter().map(to_ids).collect()
}

/// Whether the run is long enough for every duty cycle to reach a TTI in S1. Cycles have at most 9 TTIs in random
/// scenarios, clusters of `knn` at most 12 members (`tests/src/scenarios.rs`).
fn reaches_sensing_tti(scenario: &Scenario) -> bool {
    scenario.run.ttis >= 12
}
