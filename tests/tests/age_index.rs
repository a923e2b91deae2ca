//! Compares the `age-index` policy with the rule in its documentation, computed place by place.

use proptest::prelude::*;
use proptest::test_runner::Config;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::{Scenario, parse};
use reveille_common::ids::{DeviceId, Tti};
use reveille_device::machine::Machine;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::reference::ReferenceAgeIndex;
use reveille_tests::scenarios;

/// Commands and reports of the last granted TTI.
#[derive(Default)]
struct TtiReports {
    is_found: bool,
    woken: Vec<DeviceId>,
}

impl Observer for TtiReports {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::ReportReceived(_) => self.is_found = true,
            Notification::WakeUpSent { device, .. } => self.woken.push(*device),
            Notification::PlanSent { .. }
            | Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::EventEnded(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::TtiClosed(_)
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// One TTI of a run: sensing devices, reports, and the batteries before, micro-units.
struct PlayedTti {
    sensing: Vec<usize>,
    heard: TtiReports,
    levels: Vec<u64>,
}

/// Runs `scenario` TTI by TTI.
fn play(scenario: &Scenario) -> Vec<PlayedTti> {
    let prepared = prepare(scenario);
    let options = RunOptions {
        lookahead: false,
        ..RunOptions::default()
    };
    let mut run = Run::new(&prepared, options);
    let initial = prepared
        .deployment
        .devices
        .iter()
        .map(|device| device.energy.initial.micro());
    let mut levels: Vec<u64> = initial.collect();
    (0..scenario.run.ttis)
        .map(|k| {
            let mut heard = TtiReports::default();
            run.run_grant(&mut heard);
            let plan = run.cycle().plan();
            let is_on = |&j: &usize| plan.duty_cycle(DeviceId(j as u32)).is_on(Tti(k));
            let sensing = (0..levels.len()).filter(is_on).collect();
            let after = run
                .advance_machines()
                .iter()
                .map(|machine: &Machine| machine.battery().micro());
            PlayedTti {
                sensing,
                heard,
                levels: std::mem::replace(&mut levels, after.collect()),
            }
        })
        .collect()
}

/// Returns how many TTIs of `scenario` under `price` were compared, and how many were too close to call.
fn compare(scenario: &Scenario, price: f64) -> Result<[usize; 2], TestCaseError> {
    let deployment = prepare(scenario).deployment;
    let energies = deployment.devices.iter().map(|device| device.energy).collect();
    let Some(mut expected) = ReferenceAgeIndex::new(scenario, &deployment.positions(), energies, price) else {
        return Err(TestCaseError::reject("a place on the rim of a reach"));
    };
    let mut counts = [0; 2];
    for (k, played) in play(scenario).iter().enumerate() {
        let chosen = expected.choose(&played.levels);
        counts[usize::from(chosen.is_none())] += 1;
        if let Some(chosen) = chosen {
            prop_assert_eq!(&played.sensing, &chosen, "TTI {}", k);
        }
        expected.pass(&played.sensing, played.heard.is_found);
    }
    Ok(counts)
}

proptest! {
    #![proptest_config(Config { cases: 150, failure_persistence: None, ..Config::default() })]

    #[test]
    fn plans_are_those_of_the_rule(
        text in scenarios::under("age-index"),
        price in prop_oneof![Just(0.0), 0.01..3.0f64, Just(300.0)],
    ) {
        let text = format!("{text}[policy.age-index]\nprice = {price:?}\n");
        compare(&scenarios::scenario(&text), price)?;
    }
}

/// Uses a denser deployment than random scenarios have, with swaps.
#[test]
fn plans_of_many_devices_follow_the_rule() {
    let mut compared = [0; 2];
    for (kind, price) in [("range", 0.1), ("range", 0.6), ("range", 2.0), ("probabilistic", 0.4)] {
        let text = format!(
            "devices = 60\nttis = 30\n[sensing]\nkind = \"{kind}\"\neta = 0.4\n[policy]\nname = \"age-index\"\n\
             [policy.age-index]\nprice = {price}\n"
        );
        let counts = compare(&scenarios::scenario(&text), price).expect("the same plans");
        (0..2).for_each(|i| compared[i] += counts[i]);
    }
    assert!(compared[0] > 100 && compared[1] < 20, "{compared:?}");
}

/// The price ranges from sensing every coverable place in every TTI to sensing nowhere, which causes a warning.
#[test]
fn the_price_sets_the_covered_area() {
    let under = |price: f64| {
        let text = format!(
            "devices = 60\nttis = 400\n[energy]\ne_max = 10000.0\ninitial = 10000.0\n[policy]\nname = \"age-index\"\n\
             [policy.age-index]\nprice = {price}\n"
        );
        scenarios::loaded(&text)
    };
    let sensing = |price: f64| {
        play(&under(price).scenario)
            .iter()
            .map(|played| played.sensing.len())
            .sum::<usize>()
    };
    let all: Vec<usize> = [0.0, 0.35, 2.0, 20.0, 300.0].map(sensing).to_vec();
    assert!(all.windows(2).all(|two| two[0] > two[1]), "{all:?}");
    assert_eq!(all[4], 0);
    assert!(under(0.35).warnings.is_empty());
    let told = under(300.0).warnings;
    assert!(
        told.len() == 1 && told[0].contains("almost no device senses"),
        "{told:?}"
    );
}

/// Checks the minimum battery level of a sensing device, at any price.
#[test]
fn a_device_that_is_too_low_is_left_alone() {
    let text = "devices = 60\nttis = 600\n[energy]\ninitial = 12.0\n[policy]\nname = \"age-index\"\n\
                [policy.age-index]\nprice = 0.0\n";
    let (mut low, mut sensed) = (0, 0);
    for played in play(&scenarios::scenario(text)) {
        for (j, &level) in played.levels.iter().enumerate() {
            let is_on = played.sensing.contains(&j);
            // E_idle 1, E_Tx 10 and 3 % of E_max 100.
            assert!(!is_on || level >= 14_000_000, "device {j} senses at {level}");
            low += usize::from(level < 14_000_000);
            sensed += usize::from(is_on);
        }
    }
    assert!(low > 1000 && sensed > 1000, "{low} {sensed}");
    // A battery whose capacity is below that level.
    let text = "devices = 5\n[energy]\ne_max = 11.0\ninitial = 11.0\n[policy]\nname = \"age-index\"\n";
    let told = scenarios::loaded(text).warnings;
    assert!(
        told.len() == 1 && told[0].contains("its devices never sense"),
        "{told:?}"
    );
}

/// `bs.ranking` has no effect: wake-ups follow the belief.
#[test]
fn the_ranking_of_the_scenario_is_not_asked() {
    let woken = |ranking: &str| {
        let text =
            format!("devices = 60\nttis = 1500\n[bs]\nranking = \"{ranking}\"\n[policy]\nname = \"age-index\"\n");
        let scenario = parse(&text, "test", std::path::Path::new("."), &[])
            .expect("a scenario")
            .scenario;
        play(&scenario)
            .into_iter()
            .map(|played| played.heard.woken)
            .collect::<Vec<_>>()
    };
    let (p42, posterior) = (woken("p42"), woken("posterior"));
    assert!(p42.iter().flatten().count() > 100);
    assert_eq!(p42, posterior);
}
