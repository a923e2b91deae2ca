//! Tests of loss frequencies against probabilities, and of equal draws for all users of the air.

use super::*;
use crate::declare::Override;
use crate::ids::{DeviceId, Tti};
use crate::plan::Plan;
use crate::scenario::testing::load;

fn radio() -> RadioSettings {
    RadioSettings {
        wake_miss: 0.1,
        false_wake_up: 0.02,
        uplink_loss: 0.25,
        plan_loss: 0.4,
        wake_latency: 3,
        bursts: None,
    }
}

#[test]
fn wake_ups_follow_one_another_by_the_latency() {
    let (radio, at_once) = (radio(), RadioSettings::default());
    assert_eq!(
        [0, 1, 5].map(|before| radio.send_tti(Tti(40), before)),
        [Tti(40), Tti(43), Tti(55)]
    );
    assert_eq!([0, 1, 5].map(|before| at_once.send_tti(Tti(40), before)), [Tti(40); 3]);
    assert_eq!(
        [44, 45, 46].map(|until| radio.is_late(Tti(43), Tti(until))),
        [true, true, false]
    );
    assert!(!at_once.is_late(Tti(40), Tti(40)) && radio.is_late(Tti::NEVER, Tti(u64::MAX - 1)));
    let may_be = |radio: &RadioSettings| [39, 40, 41, 43, 46].map(|sent| radio.is_valid_send_tti(Tti(sent), Tti(40)));
    assert_eq!(may_be(&radio), [false, true, false, true, true]);
    assert_eq!(may_be(&at_once), [false, true, false, false, false]);
}

/// The shares of `ttis` TTIs of 50 devices in which a wake-up, a report and a plan are lost.
fn shares(radio: &RadioSettings, ttis: u64) -> [f64; 3] {
    let mut air = Air::new(7, radio);
    let plan = Plan::from_bits((0..50).map(|_| true));
    let mut lost = [0_u64; 3];
    for k in (0..ttis).map(Tti) {
        let now = air.losses_at(k);
        let mut received = 0;
        let missed = air.deliver_plan(k, &plan, DeviceId(0), 50, |_, cycle| {
            received += u64::from(cycle.is_on(k));
        });
        assert_eq!(missed + received, 50, "each device receives the plan or misses it");
        lost[2] += missed;
        for device in (0..50).map(DeviceId) {
            lost[0] += u64::from(now.misses_wake_up(device));
            lost[1] += u64::from(now.loses_report(device));
        }
    }
    lost.map(|sum| sum as f64 / (50 * ttis) as f64)
}

#[test]
fn as_much_is_lost_as_is_said() {
    let (radio, ttis) = (radio(), 4_000);
    for (share, p) in shares(&radio, ttis).into_iter().zip([0.1, 0.25, 0.4]) {
        let error = (p * (1.0 - p) / (50 * ttis) as f64).sqrt();
        assert!((share - p).abs() < 4.0 * error, "{share}, not {p}");
    }
    assert!(shares(&RadioSettings::default(), 100).iter().all(|share| *share <= 0.0));
    let all = RadioSettings {
        wake_miss: 1.0,
        uplink_loss: 1.0,
        plan_loss: 1.0,
        ..radio
    };
    assert!(shares(&all, 100).iter().all(|share| *share >= 1.0));
}

#[test]
fn bursts_take_their_share_and_the_mean_is_known() {
    let bursts = InterferenceBursts {
        burst_ttis: 8.0,
        quiet_ttis: 24.0,
        loss: 0.9,
    };
    let radio = RadioSettings {
        bursts: Some(bursts),
        ..radio()
    };
    let RadioLossRates {
        wake_miss,
        uplink_loss,
        plan_loss,
    } = radio.loss_rates();
    let expected = [
        0.25 * 0.9 + 0.75 * 0.1,
        0.25 * 0.9 + 0.75 * 0.25,
        0.25 * 0.9 + 0.75 * 0.4,
    ];
    for (known, expected) in [wake_miss, uplink_loss, plan_loss].into_iter().zip(expected) {
        assert!((known - expected).abs() < 1e-12);
    }
    // The share of bursts varies more than the share of single TTIs: some 1250 cycles.
    for (share, expected) in shares(&radio, 40_000).into_iter().zip(expected) {
        assert!((share - expected).abs() < 0.03, "{share}, not {expected}");
    }
    // A loss probability above the burst's is kept.
    let worse = RadioSettings {
        plan_loss: 0.95,
        ..radio
    };
    assert!((worse.loss_rates().plan_loss - 0.95).abs() < 1e-12);
}

#[test]
fn a_burst_is_the_same_whoever_asks_and_when() {
    let radio = RadioSettings {
        bursts: Some(InterferenceBursts {
            burst_ttis: 3.0,
            quiet_ttis: 5.0,
            loss: 1.0,
        }),
        ..RadioSettings::default()
    };
    let mut often = Air::new(3, &radio);
    let each: Vec<AirLosses> = (0..1000).map(|k| often.losses_at(Tti(k))).collect();
    let mut seldom = Air::new(3, &radio);
    for k in (0..1000).step_by(37) {
        let now = seldom.losses_at(Tti(k));
        assert_eq!(now, each[k as usize], "TTI {k}");
        assert_eq!(now, seldom.losses_at(Tti(k)), "asked again");
    }
    let in_burst = |now: &&AirLosses| now.loses_report(DeviceId(0));
    let changes = each
        .windows(2)
        .filter(|two| in_burst(&&two[0]) != in_burst(&&two[1]))
        .count();
    // Cycles of 8 TTIs, two changes each.
    assert!((200..300).contains(&changes), "{changes}");
}

#[test]
fn false_wakes_are_bernoulli_trials() {
    let p = 0.03;
    let (mut wakes, n) = (FalseWakeUps::new(5, p, DeviceId(4)), 200_000_u64);
    let mut all = vec![wakes.next().0];
    while all.last().is_some_and(|last| *last < n) {
        all.push(wakes.advance().0);
    }
    assert!(all.windows(2).all(|two| two[0] < two[1]));
    let share = (all.len() - 1) as f64 / n as f64;
    assert!((share - p).abs() < 4.0 * (p * (1.0 - p) / n as f64).sqrt(), "{share}");
    let mut each = FalseWakeUps::new(5, 1.0, DeviceId(0));
    assert_eq!((each.next(), each.advance(), each.advance()), (Tti(0), Tti(1), Tti(2)));
    assert_eq!(FalseWakeUps::new(5, 0.0, DeviceId(0)).next(), Tti::NEVER);
    let first = |seed, device| FalseWakeUps::new(seed, 0.001, DeviceId(device)).next();
    assert!(first(1, 0) != first(1, 1) && first(1, 0) != first(2, 0));
    let at_once = (0..100_000)
        .filter(|&d| FalseWakeUps::new(1, p, DeviceId(d)).next() == Tti(0))
        .count();
    assert!((2_780..3_220).contains(&at_once), "{at_once} in TTI 0");
}

#[test]
fn a_radio_that_never_fails_is_no_part_of_a_scenario() {
    let set = |fields: &[&str]| -> Vec<Override> {
        let parse = |field: &&str| Override::parse(field).expect("an override");
        fields.iter().map(parse).collect()
    };
    let plain = load("paper", &[]).expect("a preset");
    assert!(plain.radio.is_perfect() && plain.radio == RadioSettings::default() && plain.radio.is_valid());
    let same = load("paper", &set(&["radio.wake_miss=0", "radio.interference=none"])).expect("valid");
    assert_eq!((plain.hash(), plain.to_toml()), (same.hash(), same.to_toml()));
    let mut hashes = vec![plain.hash()];
    for field in [
        "wake_miss=0.1",
        "false_wake_up=0.1",
        "uplink_loss=0.1",
        "plan_loss=0.1",
        "wake_latency=1",
        "interference=bursts",
    ] {
        let field = format!("radio.{field}");
        let scenario = load("paper", &set(&[&field])).expect("valid");
        assert!(!scenario.radio.is_perfect() && scenario.radio.is_valid(), "{field}");
        assert!(!hashes.contains(&scenario.hash()), "{field}");
        hashes.push(scenario.hash());
    }
    let both = load("paper", &set(&["radio.interference=bursts", "radio.bursts.loss=0.5"])).expect("valid");
    assert_eq!(
        both.radio.bursts.map(|bursts| (bursts.burst_ttis, bursts.loss)),
        Some((10.0, 0.5))
    );
    assert!(load("paper", &set(&["radio.plan_loss=1.1"])).is_err());
    let unsound = RadioSettings {
        wake_miss: f64::NAN,
        ..RadioSettings::default()
    };
    assert!(!unsound.is_valid());
}
