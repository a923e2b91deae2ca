//! Tests of action scripts: the actions of a script, random times, and the error of each invalid line. Runs with
//! scripts are tested in `tests/program/actions.rs` and `sweep_actions.rs`. The limits of size and number are not
//! reached.

use reveille_bs::scenario::{Override, load};

use super::*;

fn scenario(fields: &[&str]) -> Scenario {
    let fields: Vec<Override> = fields
        .iter()
        .map(|field| Override::parse(field).expect("an override"))
        .collect();
    load("quick", &fields).expect("a preset").scenario
}

/// A scenario of 50 devices and 6000 TTIs, whose policy has a price.
fn test_scenario() -> Scenario {
    scenario(&["devices=50", "ttis=6000", "policy.name=age-index"])
}

/// Returns the actions as lines of TTI and change.
fn action_lines(text: &str) -> Vec<String> {
    let actions = parse(text, &test_scenario()).unwrap_or_else(|error| panic!("{text}: {error}"));
    let line = |action: &OperatorAction| format!("{} {}", action.tti, action.change);
    actions.iter().map(line).collect()
}

#[test]
fn lines_become_actions_in_the_order_of_ttis() {
    let text = "# a comment\n\n900 revive 7\n500 fail 3,10-14 # another\n500 energy 7 2.5\n0 set events.alpha 0.05\n\
                5999 set policy.age-index.price 0\n10 fail 1 for 20";
    let expected = [
        "0 events.alpha is set to 0.05",
        "10 device 1 fails",
        "30 device 1 is revived",
        "500 device 3 fails",
        "500 devices 10 to 14 fail",
        "500 device 7 receives 2.5 units",
        "900 device 7 is revived",
        "5999 policy.age-index.price is set to 0",
    ];
    assert_eq!(action_lines(text), expected);
}

#[test]
fn an_input_log_is_a_script_of_its_actions_for_another_scenario() {
    let logged = scenario(&["devices=20", "ttis=3000"]);
    let lines = [
        "{\"outage\":{\"tti\":700,\"first\":0,\"count\":2,\"wake_ups\":null}}",
        "{\"revive\":{\"tti\":900,\"first\":3,\"count\":5}}",
        "{\"fail\":{\"tti\":500,\"first\":3,\"count\":5}}",
    ];
    let log = external_inputs::first_line(&logged) + &lines.join("\n") + "\n";
    assert!(external_inputs::parse(&log, &logged).is_ok(), "{log}");
    assert!(external_inputs::parse(&log, &test_scenario()).is_err());
    assert_eq!(
        action_lines(&log),
        ["500 devices 3 to 7 fail", "900 devices 3 to 7 are revived"]
    );
    let error = parse(&log, &scenario(&["devices=5"])).expect_err("devices 5 to 7 do not exist");
    assert!(error.to_string().starts_with("line 3: "), "{error}");
}

#[test]
fn all_are_the_devices_of_the_run() {
    let expected = [
        "10 devices 0 to 49 fail",
        "30 devices 0 to 49 are revived",
        "40 devices 0 to 49 are revived",
        "50 devices 0 to 49 receive 2.5 units each",
    ];
    assert_eq!(
        action_lines("10 fail all for 20\n40 revive all\n50 energy all 2.5"),
        expected
    );
    let random = |devices| {
        parse(
            &format!("from 0 every 600 fail {devices} for 60 at random"),
            &test_scenario(),
        )
    };
    assert_eq!(random("all").expect("a script"), random("0-49").expect("a script"));
}

#[test]
fn repeated_lines_become_an_action_in_each_period() {
    assert_eq!(
        action_lines("from 100 to 2000 every 900 fail 0-1 for 60"),
        [
            "100 devices 0 to 1 fail",
            "160 devices 0 to 1 are revived",
            "1000 devices 0 to 1 fail",
            "1060 devices 0 to 1 are revived",
            "1900 devices 0 to 1 fail",
            "1960 devices 0 to 1 are revived",
        ]
    );
    // The revival after the end of the run is left out.
    assert_eq!(
        action_lines("from 5990 every 5 fail 2 for 4"),
        [
            "5990 device 2 fails",
            "5994 device 2 is revived",
            "5995 device 2 fails",
            "5999 device 2 is revived"
        ]
    );
    assert_eq!(
        action_lines("from 5990 every 20 fail 2 for 15"),
        ["5990 device 2 fails"]
    );
    assert_eq!(action_lines("from 5997 every 1 energy 0 1").len(), 3);
}

#[test]
fn random_times_lie_within_their_periods_and_follow_from_the_seed() {
    let text = "from 0 every 600 fail 0-49 for 60 at random";
    let actions = parse(text, &test_scenario()).expect("a script");
    assert_eq!(actions, parse(text, &test_scenario()).expect("a script"));
    assert!(actions.is_sorted_by_key(|action| action.tti));
    let mut offset_sum = 0;
    for device in (0..50).map(DeviceId) {
        let device_actions: Vec<&OperatorAction> = actions
            .iter()
            .filter(|action| action.change.devices().is_some_and(|range| range.contains(device)))
            .collect();
        assert_eq!(device_actions.len(), 20, "device {device}");
        for (period, pair) in (0..).zip(device_actions.chunks(2)) {
            let offset = pair[0].tti.0.checked_sub(600 * period).expect("in its period");
            assert!(matches!(pair[0].change, Change::Fail(_)) && offset <= 540, "{pair:?}");
            assert!(matches!(pair[1].change, Change::Revive(_)) && pair[1].tti.0 - pair[0].tti.0 == 60);
            offset_sum += offset;
        }
    }
    // 500 offsets, uniform on 0..=540: their mean has the standard error 156 / √500 = 7.
    let mean = f64::from(u32::try_from(offset_sum).expect("small")) / 500.0;
    assert!((mean - 270.0).abs() < 4.0 * 7.0, "mean offset {mean}");
    let other_seed = scenario(&["devices=50", "ttis=6000", "policy.name=age-index", "seed=2"]);
    assert_ne!(actions, parse(text, &other_seed).expect("a script"));
}

#[test]
fn an_invalid_line_is_refused_with_the_fix() {
    let cases = [
        ("500 fail", "line 1: `fail` is not an action; use `TTI ACTION`"),
        ("500", "the action is missing"),
        (
            "\nsoon fail 7",
            "line 2: `soon` must be the TTI of the action, or `from`",
        ),
        ("6000 fail 7", "TTI 6000 is not in the run; use TTIs before 6000"),
        (
            "5 fail 50",
            "device 50: not in the run; use `all`, or devices from 0 to 49",
        ),
        ("5 fail 40-50", "devices 40 to 50: not in the run"),
        ("5 fail 9-3", "`9-3`: 9 is larger than 3; use 3-9"),
        ("5 fail 1,,2", "must be `all`"),
        ("5 fail all,2", "must be `all`"),
        ("5 fail 0-4294967294", "must be `all`"),
        ("5 fail 0-4294967295", "must be `all`"),
        ("5 fail 3 for 0", "at least 1 TTI"),
        ("5 fail 3 for ever", "`ever` must be a whole number of TTIs"),
        ("5 energy 3 -1", "`-1` must be an energy above 0"),
        ("5 energy 3 0", "above 0"),
        ("5 energy 3 nan", "above 0"),
        (
            "5 set devices 9",
            "`devices` cannot change during a run; use events.alpha or policy.age-index.price",
        ),
        ("5 set events.alpha 0", "events.alpha 0: must be above 0, and at most 1"),
        ("5 set events.alpha x", "`x` must be a number"),
        ("5 set policy.age-index.price -1", "must be at least 0"),
        ("from 5 fail 3", "incomplete repetition"),
        ("from 5 every 0 fail 3", "`every` must be at least 1 TTI"),
        (
            "from 5 every 60 fail 3 for 60",
            "`every` 60 must be longer than the failure",
        ),
        ("from 5 to 5 every 60 fail 3", "`to` must be after `from`"),
        ("5 fail 3 at random", "`at random` needs a repetition"),
        ("from 0 every 9 set events.alpha 0.1 at random", "leave out `at random`"),
        (
            "from 0 every 1 energy 0-49 1 at random\nfrom 0 every 1 explode 3",
            "line 2: `explode 3` is not an action",
        ),
    ];
    for (text, expected) in cases {
        let error = parse(text, &test_scenario()).expect_err(text).to_string();
        assert!(error.contains(expected), "{text:?}: {error}");
    }
    let knn = scenario(&["policy.name=knn"]);
    let error = parse("5 set policy.age-index.price 1", &knn)
        .expect_err("no price")
        .to_string();
    assert!(error.contains("policy knn does not use it"), "{error}");
    let bursts = scenario(&["events.process=bursts"]);
    let error = parse("5 set events.alpha 1", &bursts).expect_err("no rate").to_string();
    assert!(error.contains("no constant rate"), "{error}");
}

#[test]
fn a_revival_without_a_failure_causes_a_warning() {
    let scenario = test_scenario();
    let warning = |text: &str| {
        let warnings = warnings(&parse(text, &scenario).expect(text), &scenario);
        assert!(warnings.len() <= 1, "{warnings:?}");
        warnings.into_iter().next()
    };
    for text in [
        "700 fail 3\n900 revive 3",
        "700 fail 3\n900 revive all",
        "700 fail all for 9\n800 fail 0-4\n900 revive 4-5",
        "from 700 every 100 fail 0-9 for 50 at random",
    ] {
        assert_eq!(warning(text), None, "{text}");
    }
    for (text, start) in [
        (
            "900 fail 3\n700 revive 3",
            "1 revival without effect, the first in TTI 700",
        ),
        (
            "700 fail 3 for 100\n900 revive 3",
            "1 revival without effect, the first in TTI 900",
        ),
        (
            "700 revive 3\n800 fail 3\n900 revive 4\n950 revive all",
            "2 revivals without effect, the first in TTI 700",
        ),
    ] {
        let warning = warning(text).expect(text);
        assert!(warning.starts_with(start), "{text}: {warning}");
    }
}

#[test]
fn actions_in_the_warm_up_cause_a_warning() {
    let scenario = test_scenario();
    let warning = |text: &str| warm_up_warning(&parse(text, &scenario).expect(text), &scenario);
    assert_eq!(scenario.warm_up_end(), Tti(600));
    assert_eq!(warning("600 fail 3\n900 revive 3"), None);
    assert_eq!(
        warning("599 fail 3").as_deref(),
        Some(
            "1 of 1 actions (TTI 599) are in the warm-up, which no metric counts; use TTIs from 600 on, or --set \
             warm_up=0.0998 to count from the first action"
        )
    );
    let partly = warning("0 fail 3\nfrom 100 every 400 energy 1 1").expect("a warning");
    assert!(partly.starts_with("3 of 16 actions (TTIs 0 to 500) are in"), "{partly}");
    assert!(partly.contains("--set warm_up=0 to"), "{partly}");
}
