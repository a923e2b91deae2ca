//! Tests of [`RadioSettings`], [`Air`] and [`FalseWakeUps`]: shares of losses and false wake-ups against their
//! probabilities, wake-up times, the same bursts for all users, and the fields of a scenario.

use super::*;
use crate::declare::Override;
use crate::ids::{DeviceId, Tti};
use crate::plan::Plan;
use crate::scenario::testing::load;

/// The number of devices over which losses are counted.
const DEVICES: u32 = 50;

/// A radio with losses, false wake-ups and latency, without bursts. The tests repeat its values.
fn lossy_radio() -> RadioSettings {
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
fn wake_ups_are_spaced_by_the_latency() {
    let (radio, without_latency) = (lossy_radio(), RadioSettings::default());
    assert_eq!(
        [0, 1, 5].map(|earlier_wake_ups| radio.send_tti(Tti(40), earlier_wake_ups)),
        [Tti(40), Tti(43), Tti(55)]
    );
    assert_eq!(
        [0, 1, 5].map(|earlier_wake_ups| without_latency.send_tti(Tti(40), earlier_wake_ups)),
        [Tti(40); 3]
    );
    assert_eq!(
        [44, 45, 46].map(|event_end| radio.is_late(Tti(43), Tti(event_end))),
        [true, true, false]
    );
    assert!(!without_latency.is_late(Tti(40), Tti(40)) && radio.is_late(Tti::NEVER, Tti(u64::MAX - 1)));
    let valid_send_ttis =
        |radio: &RadioSettings| [39, 40, 41, 43, 46].map(|sent| radio.is_valid_send_tti(Tti(sent), Tti(40)));
    assert_eq!(valid_send_ttis(&radio), [false, true, false, true, true]);
    assert_eq!(valid_send_ttis(&without_latency), [false, true, false, false, false]);
}

/// Returns the shares of wake-ups, reports and plans that are lost, in this order, over [`DEVICES`] and `ttis` TTIs.
fn loss_shares(radio: &RadioSettings, ttis: u64) -> [f64; 3] {
    let mut air = Air::new(7, radio);
    let plan = Plan::from_bits((0..DEVICES).map(|_| true));
    let (mut lost_wake_ups, mut lost_reports, mut lost_plans) = (0_u64, 0_u64, 0_u64);
    for k in (0..ttis).map(Tti) {
        let losses = air.losses_at(k);
        let mut received = 0;
        let missed_plans = air.deliver_plan(k, &plan, DeviceId(0), DEVICES as usize, |_, cycle| {
            received += u64::from(cycle.is_on(k));
        });
        assert_eq!(
            missed_plans + received,
            u64::from(DEVICES),
            "each device receives the plan or misses it"
        );
        lost_plans += missed_plans;
        for device in (0..DEVICES).map(DeviceId) {
            lost_wake_ups += u64::from(losses.misses_wake_up(device));
            lost_reports += u64::from(losses.loses_report(device));
        }
    }
    [lost_wake_ups, lost_reports, lost_plans].map(|sum| sum as f64 / draw_count(ttis))
}

/// Returns the number of draws of one kind over `ttis` TTIs.
fn draw_count(ttis: u64) -> f64 {
    (u64::from(DEVICES) * ttis) as f64
}

#[test]
fn shares_of_losses_equal_the_probabilities() {
    let (radio, ttis) = (lossy_radio(), 4_000);
    for (share, p) in loss_shares(&radio, ttis).into_iter().zip([0.1, 0.25, 0.4]) {
        let standard_error = (p * (1.0 - p) / draw_count(ttis)).sqrt();
        assert!(
            (share - p).abs() < 4.0 * standard_error,
            "a share of {share} is lost, not {p}"
        );
    }
    assert!(
        loss_shares(&RadioSettings::default(), 100)
            .iter()
            .all(|share| *share <= 0.0)
    );
    let total_loss = RadioSettings {
        wake_miss: 1.0,
        uplink_loss: 1.0,
        plan_loss: 1.0,
        ..radio
    };
    assert!(loss_shares(&total_loss, 100).iter().all(|share| *share >= 1.0));
}

#[test]
fn burst_losses_have_the_mean_rates() {
    let bursts = InterferenceBursts {
        burst_ttis: 8.0,
        quiet_ttis: 24.0,
        loss: 0.9,
    };
    let radio = RadioSettings {
        bursts: Some(bursts),
        ..lossy_radio()
    };
    let RadioLossRates {
        wake_miss,
        uplink_loss,
        plan_loss,
    } = radio.loss_rates();
    // A quarter of the TTIs is in bursts.
    let expected = [
        0.25 * 0.9 + 0.75 * 0.1,
        0.25 * 0.9 + 0.75 * 0.25,
        0.25 * 0.9 + 0.75 * 0.4,
    ];
    for (rate, expected) in [wake_miss, uplink_loss, plan_loss].into_iter().zip(expected) {
        assert!((rate - expected).abs() < 1e-12, "loss rate {rate}, not {expected}");
    }
    // Some 1250 bursts: their share varies more than the share of single TTIs, with a standard deviation near 0.006.
    for (share, expected) in loss_shares(&radio, 40_000).into_iter().zip(expected) {
        assert!(
            (share - expected).abs() < 0.03,
            "a share of {share} is lost, not {expected}"
        );
    }
    // A loss probability above the burst's is kept.
    let with_higher_plan_loss = RadioSettings {
        plan_loss: 0.95,
        ..radio
    };
    assert!((with_higher_plan_loss.loss_rates().plan_loss - 0.95).abs() < 1e-12);
}

#[test]
fn bursts_do_not_depend_on_which_ttis_are_read() {
    let radio = RadioSettings {
        bursts: Some(InterferenceBursts {
            burst_ttis: 3.0,
            quiet_ttis: 5.0,
            loss: 1.0,
        }),
        ..RadioSettings::default()
    };
    let mut every_tti = Air::new(3, &radio);
    let losses_by_tti: Vec<AirLosses> = (0..1000).map(|k| every_tti.losses_at(Tti(k))).collect();
    let mut some_ttis = Air::new(3, &radio);
    for k in (0..1000).step_by(37) {
        let losses = some_ttis.losses_at(Tti(k));
        assert_eq!(losses, losses_by_tti[k as usize], "TTI {k}");
        assert_eq!(losses, some_ttis.losses_at(Tti(k)), "TTI {k}, second read");
    }
    let in_burst = |losses: &&AirLosses| losses.loses_report(DeviceId(0));
    let change_count = losses_by_tti
        .windows(2)
        .filter(|pair| in_burst(&&pair[0]) != in_burst(&&pair[1]))
        .count();
    // Cycles of 8 TTIs, two changes each: 250 on average, with a standard deviation near 14.
    assert!((200..300).contains(&change_count), "{change_count} changes");
}

#[test]
fn false_wake_ups_are_bernoulli_trials() {
    let p = 0.03;
    let (mut false_wake_ups, n) = (FalseWakeUps::new(5, p, DeviceId(4)), 200_000_u64);
    let mut ttis = vec![false_wake_ups.next_tti().0];
    while ttis.last().is_some_and(|last| *last < n) {
        ttis.push(false_wake_ups.advance().0);
    }
    assert!(ttis.windows(2).all(|pair| pair[0] < pair[1]));
    let share = (ttis.len() - 1) as f64 / n as f64;
    assert!(
        (share - p).abs() < 4.0 * (p * (1.0 - p) / n as f64).sqrt(),
        "share {share}, not {p}"
    );
    let mut certain = FalseWakeUps::new(5, 1.0, DeviceId(0));
    assert_eq!(
        (certain.next_tti(), certain.advance(), certain.advance()),
        (Tti(0), Tti(1), Tti(2))
    );
    assert_eq!(FalseWakeUps::new(5, 0.0, DeviceId(0)).next_tti(), Tti::NEVER);
    let first_tti = |seed, device| FalseWakeUps::new(seed, 0.001, DeviceId(device)).next_tti();
    assert!(first_tti(1, 0) != first_tti(1, 1) && first_tti(1, 0) != first_tti(2, 0));
    let in_first_tti = (0..100_000)
        .filter(|&d| FalseWakeUps::new(1, p, DeviceId(d)).next_tti() == Tti(0))
        .count();
    // 3000 on average, with a standard deviation of 54.
    assert!(
        (2_780..3_220).contains(&in_first_tti),
        "{in_first_tti} of 100000 devices in TTI 0"
    );
}

#[test]
fn a_perfect_radio_does_not_affect_text_or_hash_of_a_scenario() {
    let overrides = |fields: &[&str]| -> Vec<Override> {
        let parse = |field: &&str| Override::parse(field).expect("an override");
        fields.iter().map(parse).collect()
    };
    let default = load("paper", &[]).expect("a preset");
    assert!(default.radio.is_perfect() && default.radio == RadioSettings::default() && default.radio.is_valid());
    let explicit_default = load("paper", &overrides(&["radio.wake_miss=0", "radio.interference=none"])).expect("valid");
    assert_eq!(
        (default.hash(), default.to_toml()),
        (explicit_default.hash(), explicit_default.to_toml())
    );
    let mut hashes = vec![default.hash()];
    for field in [
        "wake_miss=0.1",
        "false_wake_up=0.1",
        "uplink_loss=0.1",
        "plan_loss=0.1",
        "wake_latency=1",
        "interference=bursts",
    ] {
        let field = format!("radio.{field}");
        let scenario = load("paper", &overrides(&[&field])).expect("valid");
        assert!(!scenario.radio.is_perfect() && scenario.radio.is_valid(), "{field}");
        assert!(!hashes.contains(&scenario.hash()), "{field}");
        hashes.push(scenario.hash());
    }
    let with_burst_field = load(
        "paper",
        &overrides(&["radio.interference=bursts", "radio.bursts.loss=0.5"]),
    )
    .expect("valid");
    assert_eq!(
        with_burst_field
            .radio
            .bursts
            .map(|bursts| (bursts.burst_ttis, bursts.loss)),
        Some((10.0, 0.5))
    );
    assert!(load("paper", &overrides(&["radio.plan_loss=1.1"])).is_err());
    let invalid = RadioSettings {
        wake_miss: f64::NAN,
        ..RadioSettings::default()
    };
    assert!(!invalid.is_valid());
}
