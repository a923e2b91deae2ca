//! The decision transformer compared with the `age-index` policy, on which it is built.

use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_lab::preparation::run;

fn read(policy: &str, set: &[&str]) -> Result<Scenario, String> {
    let by_default = ["ttis=200", "devices=40"];
    let name = format!("policy.name={policy}");
    let all = by_default.iter().chain(set).copied().chain([name.as_str()]);
    let overrides: Vec<Override> = all.map(|set| Override::parse(set).expect("an override")).collect();
    let loaded = load("paper", &overrides).map_err(|error| error.to_string())?;
    Ok(loaded.scenario)
}

fn scenario(policy: &str, set: &[&str]) -> Scenario {
    read(policy, set).expect("a scenario")
}

/// Protects: a model changes only learned decisions. A model that predicts exactly the value from age and α decides
/// like `age-index`, bit by bit, if failed wake-ups are not charged.
#[test]
fn an_untrained_model_equals_age_index() {
    let mut are_others_woken = false;
    for set in [
        &[][..],
        &["events.process=bursts"],
        &["bs.battery_knowledge=reported", "sensing.kind=probabilistic"],
    ] {
        let plain = run(&scenario("age-index", set)).digest;
        let with = |more: &[&str]| run(&scenario("dt", &[set, more].concat())).digest;
        let untrained = "policy.dt.model=untrained";
        assert_eq!(with(&[untrained, "policy.dt.miss_cost=0"]), plain, "{set:?}");
        are_others_woken |= with(&[untrained, "policy.dt.miss_cost=1"]) != plain;
        assert_ne!(
            with(&["policy.dt.miss_cost=0"]),
            plain,
            "the model says something: {set:?}"
        );
    }
    assert!(are_others_woken, "no charge changes any wake-up");
}

#[test]
fn a_scenario_names_the_shape_that_the_model_must_have() {
    let untrained = "policy.dt.model=untrained";
    let asked = [
        untrained,
        "policy.dt.memory=5",
        "policy.dt.width=24",
        "policy.dt.heads=3",
    ];
    let settled = scenario("dt", &asked);
    let settings: &DtSettings = settled.policy.settings().downcast_ref().expect("its settings");
    let shape = settings.weights.shape();
    assert_eq!((shape.memory, shape.width, shape.heads), (5, 24, 3));
    assert!(read("dt", &["policy.dt.memory=8", "policy.dt.width=32", "policy.dt.heads=2"]).is_ok());
    for (set, parts) in [
        (
            &["policy.dt.memory=4"][..],
            &["policy.dt.memory", "model has 8", "reveille train dt"][..],
        ),
        (&["policy.dt.width=64"], &["policy.dt.width", "model has 32"]),
        (&["policy.dt.heads=1"], &["policy.dt.heads", "model has 2"]),
        (
            &[untrained, "policy.dt.width=30"],
            &["policy.dt.width", "multiple of 4 times the heads, 8"],
        ),
        (&[untrained, "policy.dt.memory=65"], &["policy.dt.memory", "64"]),
    ] {
        let refused = read("dt", set).expect_err("refused");
        assert!(parts.iter().all(|part| refused.contains(part)), "{refused}");
    }
}
