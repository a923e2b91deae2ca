//! Tests of [`BatteryEstimator`]: harvest and costs against closed forms, one step over many TTIs against single steps,
//! the signs of an empty battery, the assumed outage after them, and true levels. Numbers come from the preset `paper`:
//! 50 devices, 1 unit for a TTI in S1, 1/14 for one in S4, 10 for a report, and events within 4 m of a device.
//! Tolerances and minimum counts of cases are limits chosen for these tests, not requirements.

use std::f64::consts::PI;

use reveille_common::deployment::Deployment;

use super::*;
use crate::scenario::tests::load_paper;

/// Returns the knowledge of a base station in the preset `paper` (50 devices), where batteries are only reported.
fn load_knowledge(fields: &[&str]) -> Knowledge {
    let scenario = load_paper(&[&["bs.battery_knowledge=reported"], fields].concat());
    Knowledge::from_scenario(&scenario, &Deployment::new(&scenario), Arc::default())
}

fn report(device: u32, information: f64, battery_units: u64) -> Report {
    Report {
        device: DeviceId(device),
        tti: Tti(0),
        information,
        battery: Energy::from_micro(1_000_000 * battery_units),
    }
}

#[test]
fn estimates_follow_plans_reports_and_missing_answers() {
    let mut estimator = BatteryEstimator::new(&load_knowledge(&[]));
    let plan = Plan::from_bits((0..50).map(|j| j == 3));
    for k in 0..10 {
        estimator.advance(Tti(k + 1), &plan);
    }
    // Mean harvest per TTI, eq. 5: λτ·exp(−λτ)·E_B = 0.1·e^-0.1·5.
    let mean_harvest = 0.5 * libm::exp(-0.1);
    let expected_level = |cost: f64| 50.0 + 10.0 * (mean_harvest - cost);
    assert!((estimator.levels()[3].units() - expected_level(1.0)).abs() < 1e-4);
    assert!((estimator.levels()[4].units() - expected_level(1.0 / 14.0)).abs() < 1e-4);
    estimator.observe_level(DeviceId(4), Tti(9), Energy::from_micro(7));
    estimator.observe_unanswered_wake_up(DeviceId(5), Tti(9), &plan);
    assert_eq!(estimator.levels()[4..6], [Energy::from_micro(7), Energy::ZERO]);
    assert!(!estimator.needs_true_levels());
}

/// The large battery never reaches 0 or E_max, where the two would differ.
#[test]
fn one_step_over_many_ttis_equals_single_steps() {
    let known = load_knowledge(&["energy.e_max=10000", "energy.initial=5000"]);
    let cycle = |j: u32| DutyCycle {
        t_on: 1 + j % 3,
        t_drx: 3 + j % 7,
        offset: j % 3,
    };
    let plan = Plan::Periodic((0..50).map(cycle).collect());
    let (mut stepped, mut jumped) = (
        BatteryEstimator::new_estimated(&known),
        BatteryEstimator::new_estimated(&known),
    );
    for k in 0..1000 {
        stepped.advance(Tti(k + 1), &plan);
    }
    jumped.advance(Tti(1000), &plan);
    assert_eq!(stepped.levels(), jumped.levels());
    // 0.1·e^-0.1·5 units of harvest in each TTI, 1 unit for a TTI in S1 and 1/14 for one in S4.
    let expected_micro = |j: u32| {
        let on_ttis = (0..1000).filter(|k| (k + j % 3) % (3 + j % 7) < 1 + j % 3).count() as u64;
        5_000_000_000 + 1000 * 452_419 - on_ttis * 1_000_000 - (1000 - on_ttis) * 71_429
    };
    for (level, j) in jumped.levels().iter().zip(0..) {
        assert_eq!(level.micro(), expected_micro(j), "device {j}");
    }
}

/// Days of 24 TTIs at an equinox, light from TTI 6 to 17.
const EQUINOX_DAYS: [&str; 4] = [
    "harvest.kind=diurnal",
    "harvest.diurnal.ttis_per_day=24",
    "harvest.diurnal.latitude=40",
    "harvest.diurnal.day_of_year=82",
];

/// If only the mean harvest is known, the level of a sleeping device rises steadily instead.
#[test]
fn diurnal_estimates_follow_the_sun_if_its_course_is_known() {
    let asleep = Plan::from_bits([false; 50]);
    let levels_by_tti = |fields: &[&str]| {
        let mut estimator = BatteryEstimator::new(&load_knowledge(&[&EQUINOX_DAYS, fields].concat()));
        let levels = (0..48).map(|k| {
            estimator.advance(Tti(k + 1), &asleep);
            estimator.levels()[7].units()
        });
        levels.collect::<Vec<f64>>()
    };
    let (known_course, mean_only) = (levels_by_tti(&[]), levels_by_tti(&["harvest.diurnal.known=mean"]));
    // The sine of the elevation at an equinox, scaled by the mean of its positive half, 1/π.
    let arrival_probability = 0.1 * libm::exp(-0.1);
    let mut expected_level = 50.0;
    for (k, (&level, &level_by_mean)) in known_course.iter().zip(&mean_only).enumerate() {
        let sine = -libm::cos(TAU * ((k % 24) as f64 + 0.5) / 24.0);
        expected_level += 5.0 * arrival_probability * PI * sine.max(0.0) - 1.0 / 14.0;
        // The closed form takes the middle of each TTI of an exact equinox, so it is approximate.
        assert!(
            (level - expected_level).abs() < 0.15,
            "TTI {k}: {level}, not {expected_level}"
        );
        let expected_by_mean = 50.0 + (k + 1) as f64 * (5.0 * arrival_probability - 1.0 / 14.0);
        assert!(
            (level_by_mean - expected_by_mean).abs() < 1e-3,
            "TTI {k}: {level_by_mean}, not {expected_by_mean}"
        );
    }
    assert!(
        known_course[5] < 50.0 && mean_only[5] > 52.0,
        "at dawn: {} units with the course known, {} with the mean only",
        known_course[5],
        mean_only[5]
    );
    assert!(
        (known_course[47] - mean_only[47]).abs() < 1e-3,
        "both agree after whole days"
    );
}

/// The battery is full every evening, so one sum of harvest and cost over all days would be wrong.
#[test]
fn one_step_over_several_days_equals_single_steps() {
    let fields = [&EQUINOX_DAYS[..], &["harvest.e_b=25", "energy.e_idle=1.5"]].concat();
    let known = load_knowledge(&fields);
    let cycle = |j: u32| DutyCycle {
        t_on: u32::from(j.is_multiple_of(2)),
        t_drx: 1,
        offset: 0,
    };
    let plan = Plan::Periodic((0..50).map(cycle).collect());
    let (mut stepped, mut jumped) = (
        BatteryEstimator::new_estimated(&known),
        BatteryEstimator::new_estimated(&known),
    );
    for k in 0..24 * 9 + 3 {
        stepped.advance(Tti(k + 1), &plan);
    }
    jumped.advance(Tti(24 * 9 + 3), &plan);
    // Full at dusk, then nine TTIs of night: 13.5 units for devices in S1.
    for (j, (jumped_level, stepped_level)) in jumped.levels().iter().zip(stepped.levels()).enumerate() {
        let night_cost = if j % 2 == 0 { 13.5 } else { 9.0 / 14.0 };
        assert!(
            (jumped_level.units() - (100.0 - night_cost)).abs() < 4.0,
            "device {j}: {jumped_level}, night cost {night_cost} units"
        );
        assert!(
            (jumped_level.units() - stepped_level.units()).abs() < 4.0,
            "device {j}: {jumped_level} in one step, {stepped_level} in single steps"
        );
    }
}

#[test]
fn estimates_stay_between_zero_and_e_max() {
    let ample_harvest = load_knowledge(&["harvest.lambda=1", "harvest.e_b=5"]);
    let mut estimator = BatteryEstimator::new(&ample_harvest);
    let asleep = Plan::from_bits([false; 50]);
    for k in 0..200 {
        estimator.advance(Tti(k + 1), &asleep);
    }
    // A full battery ends each TTI below E_max by the cost of that TTI.
    assert_eq!(estimator.levels()[0].micro(), 100_000_000 - 71_429);
    let no_harvest = load_knowledge(&["harvest.lambda=0"]);
    let (mut estimator, all_sensing) = (BatteryEstimator::new(&no_harvest), Plan::from_bits([true; 50]));
    for k in 0..200 {
        estimator.advance(Tti(k + 1), &all_sensing);
    }
    assert_eq!(estimator.levels()[0], Energy::ZERO);
}

#[test]
fn a_device_surely_in_range_without_a_report_is_empty() {
    let plan = Plan::from_bits((0..50).map(|j| j % 2 == 0));
    let known = load_knowledge(&["area.width=9", "area.height=9"]);
    // The event is 1.2 m from device 0, so it is within 4 m of every device within 2.8 m of device 0.
    let first_report = report(0, libm::exp(-1.2), 33);
    let second_report = |j: u32| report(j, libm::exp(-3.9), 21);
    let surely_in_range: Vec<u32> = (1..50)
        .filter(|&j| known.devices[j as usize].position.distance(known.devices[0].position) <= 2.8)
        .collect();
    let sensing_in_range: Vec<u32> = surely_in_range.iter().copied().filter(|j| j % 2 == 0).collect();
    assert!(
        sensing_in_range.len() > 1 && sensing_in_range.len() < surely_in_range.len(),
        "the case needs several sensing and some sleeping devices in range: {sensing_in_range:?} of {surely_in_range:?}"
    );
    let mut estimator = BatteryEstimator::new(&known);
    estimator.advance(Tti(1), &plan);
    let levels_before = estimator.levels().to_vec();
    estimator.update_from_reports(Tti(0), &plan, &[first_report, second_report(sensing_in_range[0])]);
    for j in 0..50 {
        let expected = match j {
            0 => Energy::from_micro(33_000_000),
            j if j == sensing_in_range[0] => Energy::from_micro(21_000_000),
            j if sensing_in_range.contains(&j) => Energy::ZERO,
            j => levels_before[j as usize],
        };
        assert_eq!(estimator.levels()[j as usize], expected, "device {j}");
    }
    // With probabilistic detection, one silent device shows little.
    let mut probabilistic = known.clone();
    probabilistic.sensing.kind = DetectionKind::Probabilistic;
    let mut estimator = BatteryEstimator::new(&probabilistic);
    estimator.advance(Tti(1), &plan);
    estimator.update_from_reports(Tti(0), &plan, &[first_report]);
    assert_eq!(
        estimator.levels()[sensing_in_range[0] as usize],
        levels_before[sensing_in_range[0] as usize]
    );
}

/// With losses, several missing reports are needed to show an empty battery.
#[test]
fn silence_counts_once_per_tti_and_not_per_reporter() {
    let plan = Plan::from_bits([true; 50]);
    let known = load_knowledge(&["area.width=3", "area.height=3", "radio.uplink_loss=0.3"]);
    let mut estimator = BatteryEstimator::new_estimated(&known);
    let reports: Vec<Report> = (0..49).map(|j| report(j, libm::exp(-1.0), 33)).collect();
    for k in 0..4 {
        // 0.3³ is above `MIN_SILENCE_LIKELIHOOD`, 0.3⁴ below.
        assert_eq!(estimator.levels()[49], known.devices[49].energy.initial, "TTI {k}");
        estimator.update_from_reports(Tti(k), &plan, &reports);
    }
    assert_eq!(estimator.levels()[49], Energy::ZERO);
}

/// The device is woken whenever its estimate allows a report.
#[test]
fn gaps_between_wake_ups_of_a_device_that_never_answers_grow() {
    let known = load_knowledge(&[]);
    let (mut estimator, asleep) = (BatteryEstimator::new_estimated(&known), Plan::from_bits([false; 50]));
    let device = DeviceId(7);
    let mut woken_ttis = Vec::new();
    for k in 0..5000 {
        if estimator.can_report(device, Tti(k), &asleep) {
            estimator.observe_unanswered_wake_up(device, Tti(k), &asleep);
            woken_ttis.push(k);
        }
    }
    let gaps: Vec<u64> = woken_ttis.windows(2).map(|pair| pair[1] - pair[0]).collect();
    // 10 units at 0.4524 − 0.0714 per TTI take 27 TTIs. From the second failure on, 11 units take the time since the
    // first.
    assert_eq!(gaps[..2], [27, 27], "gaps {gaps:?}");
    for (gap, tti) in gaps.iter().zip(&woken_ttis).skip(2) {
        let since_first_wake_up = (tti - woken_ttis[0]) as f64;
        assert!(
            (*gap as f64 - 10.0 / 11.0 * since_first_wake_up).abs() <= 1.0,
            "gaps {gaps:?}"
        );
    }
    // From 54 TTIs on, each gap multiplies that time by 21/11: about ten wake-ups in 5000 TTIs.
    assert!(woken_ttis.len() < 12, "woken in TTIs {woken_ttis:?}");
    // A report resets the doubt.
    estimator.observe_level(device, Tti(4999), Energy::ZERO);
    let next_woken_tti = (5000..6000).find(|&k| estimator.can_report(device, Tti(k), &asleep));
    assert_eq!(next_woken_tti, Some(4999 + 27));
}

/// `can_surely_report` saves the exact computation with the plan, so it may only succeed where that one does.
#[test]
fn can_report_equals_the_exact_computation() {
    // Cases that need the exact computation are counted by its result.
    let (mut surely_count, mut uncertain_counts) = (0, [0; 2]);
    for fields in [
        ["harvest.lambda=0.1", "energy.e_idle=1", "energy.e_max=100"],
        ["harvest.lambda=1", "energy.e_idle=0.01", "energy.e_max=100"],
        ["harvest.lambda=0", "energy.e_idle=1.5", "energy.e_max=30"],
        ["harvest.lambda=1", "energy.e_idle=5", "energy.e_max=13"],
    ] {
        let known = load_knowledge(&fields);
        let cycle = |j: u32| DutyCycle {
            t_on: 1 + j % 3,
            t_drx: 3 + j % 7,
            offset: j % 3,
        };
        let plan = Plan::Periodic((0..50).map(cycle).collect());
        let mut estimator = BatteryEstimator::new_estimated(&known);
        for k in 0..300 {
            for j in 0..50 {
                let (device, level) = (DeviceId(j), estimator.levels[j as usize]);
                let is_payable =
                    estimator.estimate_at(device, &plan, Tti(k + 1)).0 >= known.devices[j as usize].energy.e_tx;
                assert_eq!(
                    estimator.can_report(device, Tti(k), &plan),
                    is_payable,
                    "{fields:?}, TTI {k}, device {j}"
                );
                let is_sure = estimator.estimates[j as usize].can_surely_report(level, Tti(k + 1));
                surely_count += usize::from(is_sure);
                uncertain_counts[usize::from(is_payable)] += usize::from(!is_sure);
                match (k + u64::from(j)) % 37 {
                    0 => estimator.observe_unanswered_wake_up(device, Tti(k), &plan),
                    1 => estimator.observe_level(device, Tti(k), Energy::from_micro(u64::from(j) * 2_000_000)),
                    _ => {}
                }
            }
        }
    }
    assert!(
        surely_count > 5000 && uncertain_counts[0] > 5000 && uncertain_counts[1] > 1000,
        "too few cases: {surely_count} sure, {uncertain_counts:?} uncertain"
    );
}

/// Returns the number of TTIs after which `device`, the only one in S1, counts as empty.
fn ttis_until_empty(known: &Knowledge, device: u32) -> f64 {
    let mut estimator = BatteryEstimator::new(known);
    let plan = Plan::from_bits((0..50).map(|j| j == device));
    for k in 0..10_000 {
        estimator.advance(Tti(k + 1), &plan);
        if estimator.levels()[device as usize] == Energy::ZERO {
            assert!(
                estimator.levels()[2] > Energy::ZERO,
                "a sleeping device is not expected to report"
            );
            return (k + 1) as f64;
        }
    }
    panic!("device {device} never counts as empty");
}

#[test]
fn long_sensing_without_a_report_shows_an_empty_battery() {
    // An event in every second TTI. In the middle of the area, the full sensing area of π 4² of the 400 m² counts.
    let mut known = load_knowledge(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    known.devices[0].position = Point::new(10.0, 10.0);
    known.devices[1].position = Point::new(0.0, 0.0);
    for (kind, detection_share) in [
        (DetectionKind::Range, PI * 16.0 / 400.0),
        // 2π ∫ r exp(−r) dr from 0 to 4.
        (
            DetectionKind::Probabilistic,
            TAU * (1.0 - 5.0 * libm::exp(-4.0)) / 400.0,
        ),
    ] {
        known.sensing.kind = kind;
        let expected_ttis = MAX_EXPECTED_REPORTS / (0.5 * detection_share);
        let [middle, corner] = [0, 1].map(|device| ttis_until_empty(&known, device));
        assert!(
            (middle / expected_ttis - 1.0).abs() < 0.02,
            "{kind:?}: {middle} TTIs in the middle, not {expected_ttis}"
        );
        // In the corner, a quarter of the sensing area is inside the area. Few of the points on each circle decide it,
        // so the tolerance is larger.
        assert!(
            (corner / (4.0 * expected_ttis) - 1.0).abs() < 0.15,
            "{kind:?}: {corner} TTIs in the corner, not 4 · {expected_ttis}"
        );
    }
}

#[test]
fn a_silent_device_counts_as_empty_among_reporting_ones() {
    let mut known = load_knowledge(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    known.devices[0].position = Point::new(10.0, 10.0);
    let mut estimator = BatteryEstimator::new(&known);
    let plan = Plan::from_bits((0..50).map(|j| j < 2));
    let expected_ttis = MAX_EXPECTED_REPORTS / (0.5 * PI * 16.0 / 400.0);
    let mut empty_after = None;
    for k in 0..1000 {
        estimator.advance(Tti(k + 1), &plan);
        if k % 50 == 0 {
            estimator.observe_level(DeviceId(1), Tti(k), Energy::from_micro(60_000_000));
        }
        assert!(estimator.levels()[1] > Energy::ZERO);
        if empty_after.is_none() && estimator.levels()[0] == Energy::ZERO {
            empty_after = Some((k + 1) as f64);
        }
    }
    let empty_after = empty_after.expect("device 0 counts as empty");
    assert!(
        (empty_after / expected_ttis - 1.0).abs() < 0.02,
        "empty after {empty_after} TTIs, not {expected_ttis}"
    );
}

#[test]
fn a_class_without_reports_is_assumed_to_charge_more_slowly() {
    let known = load_knowledge(&["events.alpha=0.5", "harvest.lambda=1", "harvest.e_b=5"]);
    let mut estimator = BatteryEstimator::new(&known);
    // A report and a TTI in S1.
    let min_level = Energy::from_micro(11_000_000);
    // Imitates a policy: the first four charged devices sense. At first four do in nearly every TTI, in the end almost
    // none.
    let (mut sensing_counts, mut last_sensing_tti) = (Vec::new(), 0);
    for k in 0..40_000 {
        let charged = (0..50)
            .filter(|&j: &u32| estimator.levels()[j as usize] >= min_level)
            .take(4);
        let sensing_devices: Vec<DeviceId> = charged.map(DeviceId).collect();
        sensing_counts.push(sensing_devices.len());
        last_sensing_tti = if sensing_devices.is_empty() {
            last_sensing_tti
        } else {
            k
        };
        estimator.advance(Tti(k + 1), &Plan::from_devices(50, &sensing_devices));
    }
    let mean_sensing_count =
        |from: usize, to: usize| sensing_counts[from..to].iter().sum::<usize>() as f64 / (to - from) as f64;
    assert!(
        mean_sensing_count(0, 300) > 3.9,
        "at first: {}",
        mean_sensing_count(0, 300)
    );
    assert!(
        mean_sensing_count(20_000, 40_000) < 0.2,
        "in the end: {}",
        mean_sensing_count(20_000, 40_000)
    );
    // One report of the class restores normal charging estimates for all its devices.
    let asleep = Plan::from_bits([false; 50]);
    estimator.observe_level(DeviceId(3), Tti(40_000), Energy::from_micro(20_000_000));
    for k in 40_001..40_020 {
        estimator.advance(Tti(k + 1), &asleep);
    }
    // 5 e⁻¹ − 1/14 units in each of 19 TTIs.
    assert!(
        estimator.levels().iter().all(|level| *level >= min_level),
        "levels after a report: {:?}",
        estimator.levels()
    );
    assert!(
        last_sensing_tti > 20_000,
        "no device senses after TTI {last_sensing_tti}"
    );
}

#[test]
fn known_levels_are_not_estimated() {
    let mut known = load_knowledge(&[]);
    known.bs.battery_knowledge = BatteryKnowledge::Oracle;
    let mut estimator = BatteryEstimator::new(&known);
    let plan = Plan::from_bits((0..50).map(|j| j == 1));
    estimator.set_true_levels((0..50).map(|j| Energy::from_micro(10_000_000 + 50_000 * j)));
    let levels_before = estimator.levels().to_vec();
    estimator.advance(Tti(1), &plan);
    assert_eq!(estimator.levels(), levels_before);
    // These are levels before the TTI is paid, so a report needs E_Tx plus E_WuR or E_idle.
    let devices_able_to_report: Vec<u32> = (0..50)
        .filter(|&j| estimator.can_report(DeviceId(j), Tti(1), &plan))
        .collect();
    assert_eq!(devices_able_to_report, (2..50).collect::<Vec<u32>>());
    estimator.set_true_levels((0..50).map(|_| Energy::from_micro(11_000_000)));
    assert!(estimator.can_report(DeviceId(1), Tti(1), &plan));
}
