//! The plans of the policy `age-index` against the reference implementation of its rule, which computes every place
//! separately; the effect of its price, of low batteries and of `bs.ranking`. Not compared: wake-ups, foresight, and
//! estimated battery levels. Counts in the assertions ensure that a case occurs often enough.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::ids::{DeviceId, Tti};
use reveille_device::machine::Machine;
use reveille_lab::preparation::prepare;
use reveille_lab::run::Run;
use reveille_tests::compare::ONE_TTI_PER_GRANT;
use reveille_tests::reference::ReferenceAgeIndex;
use reveille_tests::scenarios;

/// Reports and wake-ups of one TTI.
#[derive(Default)]
struct TtiObserver {
    /// Whether a device in S1 reported.
    has_report: bool,
    woken: Vec<DeviceId>,
}

impl Observer for TtiObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::ReportReceived(_) => self.has_report = true,
            Notification::WakeUpSent { device, .. } => self.woken.push(*device),
            Notification::PlanSent { .. }
            | Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::EventEnded(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::TtiClosed(_)
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// One TTI of a run.
struct PlayedTti {
    /// Devices with δ = 1, by number.
    sensing_devices: Vec<usize>,
    observed: TtiObserver,
    /// Battery levels before the TTI, from which the plan is chosen, micro-units.
    levels: Vec<u64>,
}

/// Runs `scenario` TTI by TTI.
fn play(scenario: &Scenario) -> Vec<PlayedTti> {
    let prepared = prepare(scenario);
    let mut run = Run::new(&prepared, ONE_TTI_PER_GRANT);
    let initial_levels = prepared
        .deployment
        .devices
        .iter()
        .map(|device| device.energy.initial.micro());
    let mut levels: Vec<u64> = initial_levels.collect();
    (0..scenario.run.ttis)
        .map(|k| {
            let mut observed = TtiObserver::default();
            run.run_grant(&mut observed);
            let plan = run.cycle().plan();
            let is_on = |&j: &usize| plan.duty_cycle(DeviceId(j as u32)).is_on(Tti(k));
            let sensing_devices = (0..levels.len()).filter(is_on).collect();
            let levels_after = run
                .advance_machines()
                .iter()
                .map(|machine: &Machine| machine.battery().micro());
            PlayedTti {
                sensing_devices,
                observed,
                levels: std::mem::replace(&mut levels, levels_after.collect()),
            }
        })
        .collect()
}

/// Numbers of TTIs in a comparison.
#[derive(Default)]
struct ComparedTtis {
    compared: usize,
    /// Left out, as too close to call.
    undecided: usize,
}

/// Compares the plans of `scenario`, whose policy is `age-index` at `price`.
fn compare_plans(scenario: &Scenario, price: f64) -> Result<ComparedTtis, TestCaseError> {
    let deployment = prepare(scenario).deployment;
    let energies = deployment.devices.iter().map(|device| device.energy).collect();
    let Some(mut reference) = ReferenceAgeIndex::new(scenario, &deployment.positions(), energies, price) else {
        return Err(TestCaseError::reject("a place exactly d_max from a device"));
    };
    let mut ttis = ComparedTtis::default();
    for (k, played) in play(scenario).iter().enumerate() {
        match reference.choose(&played.levels) {
            Some(expected_devices) => {
                prop_assert_eq!(&played.sensing_devices, &expected_devices, "TTI {}", k);
                ttis.compared += 1;
            }
            None => ttis.undecided += 1,
        }
        reference.advance(&played.sensing_devices, played.observed.has_report);
    }
    Ok(ttis)
}

proptest! {
    #![proptest_config(Config { cases: 150, failure_persistence: None, ..Config::default() })]

    #[test]
    fn plans_equal_the_plans_of_the_reference(
        text in scenarios::small_with_policy("age-index"),
        price in prop_oneof![Just(0.0), 0.01..3.0f64, Just(300.0)],
    ) {
        let text = format!("{text}[policy.age-index]\nprice = {price:?}\n");
        compare_plans(&scenarios::scenario(&text), price)?;
    }
}

/// Uses a denser deployment than random scenarios have, in which chosen devices are replaced.
#[test]
fn plans_of_many_devices_equal_the_plans_of_the_reference() {
    let [mut compared, mut undecided] = [0; 2];
    for (kind, price) in [("range", 0.1), ("range", 0.6), ("range", 2.0), ("probabilistic", 0.4)] {
        let text = format!(
            "devices = 60\nttis = 30\n[sensing]\nkind = \"{kind}\"\neta = 0.4\n[policy]\nname = \"age-index\"\n\
             [policy.age-index]\nprice = {price}\n"
        );
        let ttis = compare_plans(&scenarios::scenario(&text), price).expect("the same plans");
        compared += ttis.compared;
        undecided += ttis.undecided;
    }
    assert!(
        compared > 100 && undecided < 20,
        "{compared} TTIs compared, {undecided} too close to call"
    );
}

/// The price ranges from sensing every coverable place in every TTI to sensing nowhere, which causes a warning. 0.35 is
/// the default, and from 253 on, the worth of the oldest place that counts, almost no device senses.
#[test]
fn the_price_sets_the_covered_area() {
    let scenario_with_price = |price: f64| {
        let text = format!(
            "devices = 60\nttis = 400\n[energy]\ne_max = 10000.0\ninitial = 10000.0\n[policy]\nname = \"age-index\"\n\
             [policy.age-index]\nprice = {price}\n"
        );
        scenarios::scenario_with_warnings(&text)
    };
    let sensing_ttis = |price: f64| {
        play(&scenario_with_price(price).scenario)
            .iter()
            .map(|played| played.sensing_devices.len())
            .sum::<usize>()
    };
    let sensing_ttis_by_price = [0.0, 0.35, 2.0, 20.0, 300.0].map(sensing_ttis);
    assert!(
        sensing_ttis_by_price.windows(2).all(|pair| pair[0] > pair[1]),
        "{sensing_ttis_by_price:?}"
    );
    assert_eq!(sensing_ttis_by_price[4], 0);
    assert!(scenario_with_price(0.35).warnings.is_empty());
    let warnings = scenario_with_price(300.0).warnings;
    assert!(
        warnings.len() == 1 && warnings[0].contains("almost no device senses"),
        "{warnings:?}"
    );
}

/// The minimum battery level of a sensing device does not depend on the price.
#[test]
fn a_device_with_a_low_battery_does_not_sense() {
    // E_idle + E_Tx + 3 % of E_max, 1 + 10 + 3 units, in micro-units (`RESERVE_SHARE` in
    // `bs/src/beliefs/ages/price.rs`).
    let min_level = 14_000_000;
    let text = "devices = 60\nttis = 600\n[energy]\ninitial = 12.0\n[policy]\nname = \"age-index\"\n\
                [policy.age-index]\nprice = 0.0\n";
    let (mut low_ttis, mut sensing_ttis) = (0, 0);
    for played in play(&scenarios::scenario(text)) {
        for (j, &level) in played.levels.iter().enumerate() {
            let is_on = played.sensing_devices.contains(&j);
            assert!(!is_on || level >= min_level, "device {j} senses at {level}");
            low_ttis += usize::from(level < min_level);
            sensing_ttis += usize::from(is_on);
        }
    }
    assert!(
        low_ttis > 1000 && sensing_ttis > 1000,
        "device-TTIs: {low_ttis} with a low battery, {sensing_ttis} in S1"
    );
    // A battery whose capacity is below that level.
    let text = "devices = 5\n[energy]\ne_max = 11.0\ninitial = 11.0\n[policy]\nname = \"age-index\"\n";
    let warnings = scenarios::scenario_with_warnings(text).warnings;
    assert!(
        warnings.len() == 1 && warnings[0].contains("its devices never sense"),
        "{warnings:?}"
    );
}

/// Wake-ups follow the belief, whatever `bs.ranking` is.
#[test]
fn the_ranking_of_the_scenario_changes_no_wake_up() {
    let woken_by_tti = |ranking: &str| {
        let text =
            format!("devices = 60\nttis = 1500\n[bs]\nranking = \"{ranking}\"\n[policy]\nname = \"age-index\"\n");
        play(&scenarios::scenario(&text))
            .into_iter()
            .map(|played| played.observed.woken)
            .collect::<Vec<_>>()
    };
    let (p42, posterior) = (woken_by_tti("p42"), woken_by_tti("posterior"));
    assert!(p42.iter().flatten().count() > 100);
    assert_eq!(p42, posterior);
}
