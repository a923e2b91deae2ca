//! Battery estimates against closed forms, and against levels carried forward one TTI at a time.

use std::f64::consts::PI;

use reveille_common::deployment::Deployment;

use crate::scenario::{Override, load};

use super::*;

fn known(set: &[&str]) -> Knowledge {
    let set = ["bs.battery_knowledge=reported"].iter().chain(set);
    let overrides: Vec<Override> = set.map(|set| Override::parse(set).expect("an override")).collect();
    let scenario = load("paper", &overrides).expect("a preset").scenario;
    Knowledge::from_scenario(&scenario, &Deployment::new(&scenario), Arc::default())
}

fn report(device: u32, information: f64, units: u64) -> Report {
    Report {
        device: DeviceId(device),
        tti: Tti(0),
        information,
        battery: Energy::from_micro(1_000_000 * units),
    }
}

#[test]
fn estimates_follow_what_was_commanded_and_heard() {
    let mut levels = BatteryEstimator::new(&known(&[]));
    let plan = Plan::from_bits((0..50).map(|j| j == 3));
    for k in 0..10 {
        levels.advance(Tti(k + 1), &plan);
    }
    // eq5: λτ·exp(−λτ)·E_B = 0.1·e^-0.1·5.
    let harvest = 0.5 * libm::exp(-0.1);
    let expected = |cost: f64| 50.0 + 10.0 * (harvest - cost);
    assert!((levels.levels()[3].units() - expected(1.0)).abs() < 1e-4);
    assert!((levels.levels()[4].units() - expected(1.0 / 14.0)).abs() < 1e-4);
    levels.observe_level(DeviceId(4), Tti(9), Energy::from_micro(7));
    levels.observe_no_answer(DeviceId(5), Tti(9), &plan);
    assert_eq!(levels.levels()[4..6], [Energy::from_micro(7), Energy::ZERO]);
    assert!(!levels.needs_true_levels());
}

/// One estimate over many TTIs equals estimates TTI by TTI, until the level reaches 0 or E_max.
#[test]
fn an_estimate_over_many_ttis_is_the_sum_of_them() {
    let known = known(&["energy.e_max=10000", "energy.initial=5000"]);
    let cycle = |j: u32| DutyCycle {
        t_on: 1 + j % 3,
        t_drx: 3 + j % 7,
        offset: j % 3,
    };
    let plan = Plan::Periodic((0..50).map(cycle).collect());
    let (mut stepped, mut at_once) = (
        BatteryEstimator::new_estimated(&known),
        BatteryEstimator::new_estimated(&known),
    );
    for k in 0..1000 {
        stepped.advance(Tti(k + 1), &plan);
    }
    at_once.advance(Tti(1000), &plan);
    assert_eq!(stepped.levels(), at_once.levels());
    let by_hand = |j: u32| {
        let on = (0..1000).filter(|k| (k + j % 3) % (3 + j % 7) < 1 + j % 3).count() as u64;
        5_000_000_000 + 1000 * 452_419 - on * 1_000_000 - (1000 - on) * 71_429
    };
    for (level, j) in at_once.levels().iter().zip(0..) {
        assert_eq!(level.micro(), by_hand(j), "device {j}");
    }
}

/// Day and night of 24 TTIs, light from TTI 6 to 17.
const DAY: [&str; 4] = [
    "harvest.kind=diurnal",
    "harvest.diurnal.ttis_per_day=24",
    "harvest.diurnal.latitude=40",
    "harvest.diurnal.day_of_year=82",
];

/// The estimate follows the expected sunlight of each TTI: the level of a sleeping device falls at night and rises by
/// day.
#[test]
fn estimates_follow_the_time_of_the_day_where_it_is_known() {
    let asleep = Plan::from_bits([false; 50]);
    let by_tti = |set: &[&str]| {
        let mut levels = BatteryEstimator::new(&known(&[&DAY, set].concat()));
        let each = (0..48).map(|k| {
            levels.advance(Tti(k + 1), &asleep);
            levels.levels()[7].units()
        });
        each.collect::<Vec<f64>>()
    };
    let (known, mean_only) = (by_tti(&[]), by_tti(&["harvest.diurnal.known=mean"]));
    // The sine of the elevation at an equinox, scaled by the mean of its positive half, 1/π.
    let p = 0.1 * libm::exp(-0.1);
    let mut expected = 50.0;
    for (k, (&level, &flat)) in known.iter().zip(&mean_only).enumerate() {
        let sine = -libm::cos(TAU * ((k % 24) as f64 + 0.5) / 24.0);
        expected += 5.0 * p * PI * sine.max(0.0) - 1.0 / 14.0;
        assert!((level - expected).abs() < 0.15, "TTI {k}: {level}, not {expected}");
        let steady = 50.0 + (k + 1) as f64 * (5.0 * p - 1.0 / 14.0);
        assert!((flat - steady).abs() < 1e-3, "TTI {k}: {flat}, not {steady}");
    }
    assert!(
        known[5] < 50.0 && mean_only[5] > 52.0,
        "{} and {}",
        known[5],
        mean_only[5]
    );
    assert!((known[47] - mean_only[47]).abs() < 1e-3, "whole days");
}

/// One estimate over several days equals estimates TTI by TTI, with a full battery every day.
#[test]
fn days_and_nights_are_carried_one_by_one() {
    let set = [
        &DAY[..],
        &["harvest.e_b=25", "energy.e_idle=1.5", "bs.battery_knowledge=reported"],
    ]
    .concat();
    let known = known(&set);
    let cycle = |j: u32| DutyCycle {
        t_on: u32::from(j.is_multiple_of(2)),
        t_drx: 1,
        offset: 0,
    };
    let plan = Plan::Periodic((0..50).map(cycle).collect());
    let (mut stepped, mut at_once) = (
        BatteryEstimator::new_estimated(&known),
        BatteryEstimator::new_estimated(&known),
    );
    for k in 0..24 * 9 + 3 {
        stepped.advance(Tti(k + 1), &plan);
    }
    at_once.advance(Tti(24 * 9 + 3), &plan);
    // Full at dusk, then nine TTIs of night: 13.5 units for devices in S1.
    for (j, (once, step)) in at_once.levels().iter().zip(stepped.levels()).enumerate() {
        let spent = if j % 2 == 0 { 13.5 } else { 9.0 / 14.0 };
        assert!((once.units() - (100.0 - spent)).abs() < 4.0, "device {j}: {once}");
        assert!(
            (once.units() - step.units()).abs() < 4.0,
            "device {j}: {once} and {step}"
        );
    }
}

#[test]
fn a_battery_that_is_full_or_empty_stays_within_its_ends() {
    let known = known(&["harvest.lambda=1", "harvest.e_b=5"]);
    let mut levels = BatteryEstimator::new(&known);
    let asleep = Plan::from_bits([false; 50]);
    for k in 0..200 {
        levels.advance(Tti(k + 1), &asleep);
    }
    // A full battery ends each TTI below E_max by the cost of that TTI.
    assert_eq!(levels.levels()[0].micro(), 100_000_000 - 71_429);
    let poor = super::tests::known(&["harvest.lambda=0"]);
    let (mut levels, on) = (BatteryEstimator::new(&poor), Plan::from_bits([true; 50]));
    for k in 0..200 {
        levels.advance(Tti(k + 1), &on);
    }
    assert_eq!(levels.levels()[0], Energy::ZERO);
}

#[test]
fn who_must_have_seen_the_event_and_is_silent_is_empty() {
    let plan = Plan::from_bits((0..50).map(|j| j % 2 == 0));
    let known = known(&["devices=50", "area.width=9", "area.height=9"]);
    // The event is 1.2 m from device 0, so it is within 4 m of every device within 2.8 m of device 0.
    let first = report(0, libm::exp(-1.2), 33);
    let second = |j: u32| report(j, libm::exp(-3.9), 21);
    let near: Vec<u32> = (1..50)
        .filter(|&j| known.devices[j as usize].position.distance(known.devices[0].position) <= 2.8)
        .collect();
    let on: Vec<u32> = near.iter().copied().filter(|j| j % 2 == 0).collect();
    assert!(
        on.len() > 1 && on.len() < near.len(),
        "{on:?} of {near:?}: choose another device"
    );
    let mut levels = BatteryEstimator::new(&known);
    levels.advance(Tti(1), &plan);
    let before = levels.levels().to_vec();
    levels.observe_reports(Tti(0), &plan, &[first, second(on[0])]);
    for j in 0..50 {
        let expected = match j {
            0 => Energy::from_micro(33_000_000),
            j if j == on[0] => Energy::from_micro(21_000_000),
            j if on.contains(&j) => Energy::ZERO,
            j => before[j as usize],
        };
        assert_eq!(levels.levels()[j as usize], expected, "device {j}");
    }
    // With probabilistic detection, one silent device shows little.
    let mut chance = known.clone();
    chance.sensing.kind = DetectionKind::Probabilistic;
    let mut levels = BatteryEstimator::new(&chance);
    levels.advance(Tti(1), &plan);
    levels.observe_reports(Tti(0), &plan, &[first]);
    assert_eq!(levels.levels()[on[0] as usize], before[on[0] as usize]);
}

/// With losses, one silence is one missing report, however many devices reported the event. It takes several to show an
/// empty battery.
#[test]
fn a_silent_device_counts_once_per_tti_and_not_per_reporter() {
    let plan = Plan::from_bits([true; 50]);
    let known = known(&["area.width=3", "area.height=3", "radio.uplink_loss=0.3"]);
    let mut levels = BatteryEstimator::new_estimated(&known);
    let reports: Vec<Report> = (0..49).map(|j| report(j, libm::exp(-1.0), 33)).collect();
    for k in 0..4 {
        // 0.3³ is above 1 in 50, 0.3⁴ below.
        assert_eq!(levels.levels()[49], known.devices[49].energy.initial, "TTI {k}");
        levels.observe_reports(Tti(k), &plan, &reports);
    }
    assert_eq!(levels.levels()[49], Energy::ZERO);
}

/// A device that never answers is asked whenever its estimate allows a report; the gaps between the requests grow.
#[test]
fn a_device_that_is_found_empty_again_and_again_is_asked_ever_later() {
    let known = known(&[]);
    let (mut levels, asleep) = (BatteryEstimator::new_estimated(&known), Plan::from_bits([false; 50]));
    let device = DeviceId(7);
    let mut asked = Vec::new();
    for k in 0..5000 {
        if levels.can_report(device, Tti(k), &asleep) {
            levels.observe_no_answer(device, Tti(k), &asleep);
            asked.push(k);
        }
    }
    let gaps: Vec<u64> = asked.windows(2).map(|pair| pair[1] - pair[0]).collect();
    // 10 units at 0.4524 − 0.0714 per TTI take 27 TTIs. From the second finding on, 11 units take the time since the
    // first.
    assert_eq!(gaps[..2], [27, 27], "{gaps:?}");
    for (gap, found) in gaps.iter().zip(&asked).skip(2) {
        let passed = (found - asked[0]) as f64;
        assert!((*gap as f64 - 10.0 / 11.0 * passed).abs() <= 1.0, "{gaps:?}");
    }
    assert!(asked.len() < 12, "{asked:?}");
    // A report resets the doubt.
    levels.observe_level(device, Tti(4999), Energy::ZERO);
    let next = (5000..6000).find(|&k| levels.can_report(device, Tti(k), &asleep));
    assert_eq!(next, Some(4999 + 27));
}

/// A level that passes the check without the plan also passes the exact computation with the plan.
#[test]
fn a_device_can_report_if_what_is_carried_pays_for_it() {
    let (mut sure, mut others) = (0, [0; 2]);
    for set in [
        ["harvest.lambda=0.1", "energy.e_idle=1", "energy.e_max=100"],
        ["harvest.lambda=1", "energy.e_idle=0.01", "energy.e_max=100"],
        ["harvest.lambda=0", "energy.e_idle=1.5", "energy.e_max=30"],
        ["harvest.lambda=1", "energy.e_idle=5", "energy.e_max=13"],
    ] {
        let known = known(&set);
        let cycle = |j: u32| DutyCycle {
            t_on: 1 + j % 3,
            t_drx: 3 + j % 7,
            offset: j % 3,
        };
        let plan = Plan::Periodic((0..50).map(cycle).collect());
        let mut levels = BatteryEstimator::new_estimated(&known);
        for k in 0..300 {
            for j in 0..50 {
                let (device, level) = (DeviceId(j), levels.levels[j as usize]);
                let pays = levels.estimate_at(device, &plan, Tti(k + 1)).0 >= known.devices[j as usize].energy.e_tx;
                assert_eq!(
                    levels.can_report(device, Tti(k), &plan),
                    pays,
                    "{set:?}, TTI {k}, device {j}"
                );
                let is_well = levels.estimates[j as usize].can_surely_report(level, Tti(k + 1));
                sure += usize::from(is_well);
                others[usize::from(pays)] += usize::from(!is_well);
                match (k + u64::from(j)) % 37 {
                    0 => levels.observe_no_answer(device, Tti(k), &plan),
                    1 => levels.observe_level(device, Tti(k), Energy::from_micro(u64::from(j) * 2_000_000)),
                    _ => {}
                }
            }
        }
    }
    assert!(
        sure > 5000 && others[0] > 5000 && others[1] > 1000,
        "{sure}, {others:?}"
    );
}

/// Returns the number of TTIs after which `device`, the only one in S1, counts as empty.
fn silent_for(known: &Knowledge, device: u32) -> f64 {
    let mut levels = BatteryEstimator::new(known);
    let plan = Plan::from_bits((0..50).map(|j| j == device));
    for k in 0..10_000 {
        levels.advance(Tti(k + 1), &plan);
        if levels.levels()[device as usize] == Energy::ZERO {
            assert!(levels.levels()[2] > Energy::ZERO, "a sleeping device is not asked");
            return (k + 1) as f64;
        }
    }
    panic!("it is never found out");
}

#[test]
fn a_device_that_senses_for_long_without_a_report_is_taken_to_be_empty() {
    // An event in every second TTI. In the middle of the area, the full sensing area of π 4² of the 400 m² counts.
    let mut known = known(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    known.devices[0].position = Point::new(10.0, 10.0);
    known.devices[1].position = Point::new(0.0, 0.0);
    for (kind, share) in [
        (DetectionKind::Range, std::f64::consts::PI * 16.0 / 400.0),
        // 2π ∫ r exp(−r) dr from 0 to 4.
        (
            DetectionKind::Probabilistic,
            TAU * (1.0 - 5.0 * libm::exp(-4.0)) / 400.0,
        ),
    ] {
        known.sensing.kind = kind;
        let expected = 8.0 / (0.5 * share);
        let [middle, corner] = [0, 1].map(|device| silent_for(&known, device));
        assert!(
            (middle / expected - 1.0).abs() < 0.02,
            "{kind:?}: {middle}, not {expected}"
        );
        // In the corner, a quarter of the sensing area is inside the area.
        assert!((corner / (4.0 * expected) - 1.0).abs() < 0.15, "{kind:?}: {corner}");
    }
}

#[test]
fn a_device_among_others_that_report_is_found_out_by_itself() {
    let mut known = known(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    known.devices[0].position = Point::new(10.0, 10.0);
    let mut levels = BatteryEstimator::new(&known);
    let plan = Plan::from_bits((0..50).map(|j| j < 2));
    let expected = 8.0 / (0.5 * std::f64::consts::PI * 16.0 / 400.0);
    let mut found = None;
    for k in 0..1000 {
        levels.advance(Tti(k + 1), &plan);
        if k % 50 == 0 {
            levels.observe_level(DeviceId(1), Tti(k), Energy::from_micro(60_000_000));
        }
        assert!(levels.levels()[1] > Energy::ZERO);
        if found.is_none() && levels.levels()[0] == Energy::ZERO {
            found = Some((k + 1) as f64);
        }
    }
    let found = found.expect("it is found out");
    assert!((found / expected - 1.0).abs() < 0.02, "{found}, not {expected}");
}

#[test]
fn a_class_of_which_nobody_is_heard_is_taken_to_charge_ever_slower() {
    let known = known(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    let mut levels = BatteryEstimator::new(&known);
    let need = Energy::from_micro(11_000_000);
    // Imitates a policy: the first four charged devices sense.
    let (mut asked, mut last) = (Vec::new(), 0);
    for k in 0..40_000 {
        let able = (0..50).filter(|&j: &u32| levels.levels()[j as usize] >= need).take(4);
        let chosen: Vec<DeviceId> = able.map(DeviceId).collect();
        asked.push(chosen.len());
        last = if chosen.is_empty() { last } else { k };
        levels.advance(Tti(k + 1), &Plan::from_devices(50, &chosen));
    }
    let in_window = |from: usize, to: usize| asked[from..to].iter().sum::<usize>() as f64 / (to - from) as f64;
    assert!(in_window(0, 300) > 3.9, "{}", in_window(0, 300));
    assert!(in_window(20_000, 40_000) < 0.2, "{}", in_window(20_000, 40_000));
    // One report of the class restores normal charging estimates for all its devices.
    let asleep = Plan::from_bits([false; 50]);
    levels.observe_level(DeviceId(3), Tti(40_000), Energy::from_micro(20_000_000));
    for k in 40_001..40_020 {
        levels.advance(Tti(k + 1), &asleep);
    }
    // 5 e⁻¹ − 1/14 units in each of 19 TTIs.
    assert!(
        levels.levels().iter().all(|level| *level >= need),
        "{:?}",
        levels.levels()
    );
    assert!(last > 20_000, "{last}: they are never asked again");
}

#[test]
fn levels_that_are_told_are_not_estimated() {
    let mut known = known(&[]);
    known.bs.battery_knowledge = BatteryKnowledge::Oracle;
    let mut levels = BatteryEstimator::new(&known);
    let plan = Plan::from_bits((0..50).map(|j| j == 1));
    levels.set_true_levels((0..50).map(|j| Energy::from_micro(10_000_000 + 50_000 * j)));
    let before = levels.levels().to_vec();
    levels.advance(Tti(1), &plan);
    assert_eq!(levels.levels(), before);
    // These are levels before the TTI is paid, so a report needs E_Tx plus E_WuR or E_idle.
    let able: Vec<u32> = (0..50)
        .filter(|&j| levels.can_report(DeviceId(j), Tti(1), &plan))
        .collect();
    assert_eq!(able, (2..50).collect::<Vec<u32>>());
    levels.set_true_levels((0..50).map(|_| Energy::from_micro(11_000_000)));
    assert!(levels.can_report(DeviceId(1), Tti(1), &plan));
}
