//! Invariants of every TTI of every run, checked on the emulator alone, one grant at a time.

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

/// Options for one TTI per grant.
const STEPPED: RunOptions = RunOptions {
    lookahead: false,
    window: u64::MAX,
};

proptest! {
    #![proptest_config(Config { cases: 300, failure_persistence: None, ..Config::default() })]

    #[test]
    fn the_books_balance_in_every_tti(text in scenarios::any_policy()) {
        let scenario = scenarios::scenario(&text);
        // A false wake-up, and a wake-up that comes too late.
        let for_nothing = [scenario.radio.false_wake_up > 0.0, scenario.radio.wake_latency > 0];
        let for_nothing = for_nothing.map(u64::from).iter().sum();
        each_tti(&scenario, |step| {
            for device in &step.devices {
                balanced(device, for_nothing)?;
            }
            Ok(())
        })?;
    }

    #[test]
    fn states_follow_delta_and_the_battery(text in scenarios::any_policy()) {
        let scenario = scenarios::scenario(&text);
        each_tti(&scenario, |step| {
            for device in &step.devices {
                consistent(device, scenario.radio.wake_latency > 0)?;
            }
            Ok(())
        })?;
    }

    #[test]
    fn under_knn_one_member_of_each_cluster_senses(text in scenarios::under("knn")) {
        let scenario = scenarios::scenario(&text);
        let clusters = clusters(&scenario);
        prop_assert_eq!(clusters.iter().map(Vec::len).sum::<usize>(), scenario.run.devices as usize);
        each_tti(&scenario, |step| {
            for cluster in &clusters {
                let sensing = |member: &&DeviceId| step.devices[member.index()].delta;
                prop_assert_eq!(cluster.iter().filter(sensing).count(), 1, "δ in {}", step.k);
                let idle = |member: &&DeviceId| step.devices[member.index()].before == DeviceState::Idle;
                prop_assert!(cluster.iter().filter(idle).count() <= 1, "S1 in {}", step.k);
            }
            Ok(())
        })?;
    }

    #[test]
    fn with_energy_to_spare_no_action_fails(text in scenarios::rich()) {
        let scenario = scenarios::scenario(&text);
        let delta = reference::policy_of(&scenario, &Deployment::new(&scenario).positions());
        let mut sensing = 0;
        each_tti(&scenario, |step| {
            for device in &step.devices {
                let expected = if device.delta { DeviceState::Idle } else { DeviceState::Sleep { powered: true } };
                prop_assert_eq!(device.before, expected, "{}", step.k);
                let unwell = matches!(device.after, DeviceState::Sleep { powered: false });
                prop_assert!(!unwell, "a failure with a full battery in {}", step.k);
            }
            for (j, device) in step.devices.iter().enumerate() {
                let is_idle = device.before == DeviceState::Idle;
                prop_assert_eq!(is_idle, delta.senses(j, step.k.0), "device {} in {}", j, step.k);
                sensing += usize::from(is_idle);
            }
            Ok(())
        })?;
        if can_sense(&scenario) {
            prop_assert_eq!(sensing > 0, scenario.policy.name() != "genie", "{} TTIs in S1", sensing);
        }
    }

    #[test]
    fn a_device_that_is_left_alone_ends_as_one_that_is_stepped(text in scenarios::any_policy()) {
        let scenario = scenarios::scenario(&text);
        // With a window per TTI every device advances in every TTI; without windows a sleeping device advances only
        // when needed.
        let (lazy, events) = compare::outcome(&scenario, true, u64::MAX);
        let (stepped, same) = compare::outcome(&scenario, false, 1);
        prop_assert_eq!(&lazy.digest, &stepped.digest);
        prop_assert_eq!(&lazy.totals, &stepped.totals);
        prop_assert_eq!(events, same);
    }

    #[test]
    fn how_ttis_are_granted_changes_nothing(text in scenarios::any_policy(), window in 1..50u64) {
        let scenario = scenarios::scenario(&text);
        let (plain, events) = compare::outcome(&scenario, false, u64::MAX);
        for (lookahead, window) in [(true, u64::MAX), (true, window), (false, window)] {
            let (outcome, same) = compare::outcome(&scenario, lookahead, window);
            prop_assert_eq!(&outcome.digest, &plain.digest);
            prop_assert_eq!(&outcome.totals, &plain.totals);
            prop_assert_eq!(&same, &events);
        }
    }
}

/// Effect of one TTI on one device.
struct DeviceTtiDelta {
    costs: EnergyModel,
    /// δ.
    delta: bool,
    /// State and battery after steps 1 and 2.
    before: DeviceState,
    level: u64,
    /// State at the end of the TTI.
    after: DeviceState,
    /// Ledgers before and after the TTI.
    opened: DeviceTotals,
    closed: DeviceTotals,
}

/// Effects of one TTI.
struct TtiDelta {
    k: Tti,
    devices: Vec<DeviceTtiDelta>,
}

type Checked = Result<(), TestCaseError>;

/// Runs `scenario` and calls `check` for every TTI.
fn each_tti(scenario: &Scenario, mut check: impl FnMut(&TtiDelta) -> Checked) -> Checked {
    let deployment = Deployment::new(scenario);
    let mut run = start(scenario, STEPPED);
    for k in (0..scenario.run.ttis).map(Tti) {
        let unstepped = run.machines().to_vec();
        run.run_grant(&mut ());
        prop_assert_eq!(run.cycle().next_tti(), k + 1);
        let passed = |(mut before, after): (Machine, &Machine)| {
            // The device's own δ: it may have missed the current plan.
            let duty = after.duty();
            before.advance_to(k);
            let opened = before.totals();
            before.set_duty(k, duty);
            before.begin(k);
            let mut ended = after.clone();
            ended.begin(k);
            let state = ended.state();
            ended.advance_to(k + 1);
            DeviceTtiDelta {
                costs: deployment.devices[after.id().index()].energy,
                delta: duty.is_on(k),
                before: before.state(),
                level: before.battery().micro(),
                after: state,
                opened,
                closed: ended.totals(),
            }
        };
        let devices = unstepped.into_iter().zip(run.machines()).map(passed).collect();
        check(&TtiDelta { k, devices })?;
    }
    Ok(())
}

/// Checks the energy balance of a device; `for_nothing` is the maximum number of fruitless wake-ups in a TTI.
fn balanced(device: &DeviceTtiDelta, for_nothing: u64) -> Checked {
    let DeviceTtiDelta {
        costs, opened, closed, ..
    } = device;
    for totals in [opened, closed] {
        let into = totals.initial.micro() + totals.harvested.micro();
        let out = totals.spent.total().micro() + totals.overflow.micro();
        prop_assert_eq!(into - out, totals.battery.micro());
        prop_assert!(totals.battery <= costs.e_max);
        prop_assert_eq!(totals.initial, costs.initial);
    }
    prop_assert!(opened.harvested <= closed.harvested && opened.overflow <= closed.overflow);
    let sum = opened.battery_sum + u128::from(closed.battery.micro());
    prop_assert_eq!(closed.battery_sum, sum);
    let low = u64::from(closed.battery < costs.e_tx);
    prop_assert_eq!(closed.low_ttis, opened.low_ttis + low);
    let spent = closed.spent.total().micro() - opened.spent.total().micro();
    let for_nothing = costs.e_idle.times(for_nothing);
    let most = costs.e_tx.micro() + costs.e_idle.max(costs.e_wur + for_nothing).micro();
    prop_assert!(spent <= most, "{} spent in a TTI", spent);
    if closed.overflow > opened.overflow {
        let full = costs.e_max.micro() - spent;
        prop_assert_eq!(closed.battery.micro(), full, "overflow with room left");
    }
    Ok(())
}

fn consistent(device: &DeviceTtiDelta, wakes_late: bool) -> Checked {
    let DeviceTtiDelta {
        costs,
        delta,
        before,
        level,
        after,
        closed,
        ..
    } = device;
    let end = closed.battery.micro();
    match before {
        DeviceState::Idle => prop_assert!(delta, "S1 with δ = 0"),
        DeviceState::Sleep { powered: true } => prop_assert!(!delta, "asleep with δ = 1"),
        DeviceState::Sleep { powered: false } => prop_assert_eq!(*level, 0, "power left"),
        DeviceState::Active | DeviceState::Transmission => prop_assert!(false, "{:?} before any event", before),
    }
    match after {
        DeviceState::Transmission => {
            // Only a sensing device that detected, or a sleeping one with a powered wake-up radio, reports.
            prop_assert!(
                !matches!(before, DeviceState::Sleep { powered: false }),
                "reported without power"
            );
            prop_assert_eq!(end + costs.e_tx.micro(), *level);
        }
        DeviceState::Sleep { powered: false } => prop_assert_eq!(end, 0, "a failed action leaves nothing"),
        DeviceState::Idle | DeviceState::Sleep { powered: true } => {
            prop_assert_eq!(after, before);
            // A device that is woken too late pays for it and sleeps again.
            let is_late = wakes_late && end + costs.e_idle.micro() == *level;
            prop_assert!(end == *level || is_late, "{} of {} left", end, level);
        }
        DeviceState::Active => prop_assert!(false, "S2 is left within the TTI"),
    }
    Ok(())
}

/// Returns the `knn` clusters of a scenario, from the second implementation.
fn clusters(scenario: &Scenario) -> Vec<Vec<DeviceId>> {
    let positions = Deployment::new(scenario).positions();
    let settings = scenario
        .policy
        .settings()
        .downcast_ref::<KnnSettings>()
        .expect("settings of knn");
    let how = (settings.neighbours as usize, settings.limit_radius);
    let start = Stream::new(scenario.run.seed, Purpose::Clusters, 0);
    let clusters = reference::clusters(&positions, scenario.area, scenario.sensing.d_max, how, start);
    let devices = |cluster: Vec<usize>| cluster.into_iter().map(|j| DeviceId(j as u32)).collect();
    clusters.into_iter().map(devices).collect()
}

/// Whether the run is long enough for every duty cycle to reach a TTI in S1.
fn can_sense(scenario: &Scenario) -> bool {
    scenario.run.ttis >= 12
}
