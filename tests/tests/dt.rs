//! The policy `dt`: with an untrained model it decides like `age-index`, on which it is built; the shape of its model
//! is checked. The decisions of trained models are not checked here.

use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::{Scenario, load};
use reveille_lab::preparation::run;
use reveille_tests::scenarios::overrides;

const UNTRAINED: &str = "policy.dt.model=untrained";
const ATTENTION: &str = "policy.dt.model=attention";

/// Loads the preset `paper` with the policy and `fields`, or returns the error message.
fn try_load(policy: &str, fields: &[&str]) -> Result<Scenario, String> {
    let name = format!("policy.name={policy}");
    let fields = [&["ttis=200", "devices=40"], fields, &[name.as_str()]].concat();
    let loaded = load("paper", &overrides(&fields)).map_err(|error| error.to_string())?;
    Ok(loaded.scenario)
}

fn scenario(policy: &str, fields: &[&str]) -> Scenario {
    try_load(policy, fields).expect("a scenario")
}

/// Protects: a model changes only learned decisions. An untrained model predicts exactly the value from age and α, so
/// it decides exactly like `age-index` if failed wake-ups are not charged (`miss_cost = 0`).
#[test]
fn an_untrained_model_equals_age_index() {
    let mut does_miss_cost_matter = false;
    for fields in [
        &[][..],
        &["events.process=bursts"],
        &["bs.battery_knowledge=reported", "sensing.kind=probabilistic"],
    ] {
        let age_index_digest = run(&scenario("age-index", fields)).digest;
        let dt_digest = |dt_fields: &[&str]| run(&scenario("dt", &[fields, dt_fields].concat())).digest;
        assert_eq!(
            dt_digest(&[UNTRAINED, "policy.dt.miss_cost=0"]),
            age_index_digest,
            "{fields:?}"
        );
        does_miss_cost_matter |= dt_digest(&[UNTRAINED, "policy.dt.miss_cost=1"]) != age_index_digest;
        assert_ne!(
            dt_digest(&["policy.dt.miss_cost=0"]),
            age_index_digest,
            "the trained model changes no decision: {fields:?}"
        );
    }
    assert!(does_miss_cost_matter, "the charge changes no wake-up");
}

#[test]
fn a_model_whose_shape_differs_from_the_scenario_is_refused() {
    let fields = [
        UNTRAINED,
        "policy.dt.memory=5",
        "policy.dt.width=24",
        "policy.dt.heads=3",
    ];
    let untrained_scenario = scenario("dt", &fields);
    let settings: &DtSettings = untrained_scenario
        .policy
        .settings()
        .downcast_ref()
        .expect("settings of dt");
    let shape = settings.weights.shape();
    assert_eq!((shape.memory, shape.width, shape.heads), (5, 24, 3));
    // The shape of the model with attention: memory 8, width 32, 2 heads.
    assert!(
        try_load(
            "dt",
            &[
                ATTENTION,
                "policy.dt.memory=8",
                "policy.dt.width=32",
                "policy.dt.heads=2"
            ]
        )
        .is_ok()
    );
    for (fields, message_parts) in [
        (
            &[ATTENTION, "policy.dt.memory=4"][..],
            &["policy.dt.memory", "model has 8", "reveille train dt"][..],
        ),
        (&[ATTENTION, "policy.dt.width=64"], &["policy.dt.width", "model has 32"]),
        (&[ATTENTION, "policy.dt.heads=1"], &["policy.dt.heads", "model has 2"]),
        (
            &["policy.dt.memory=8"],
            &["policy.dt.memory", "model has 1", "policy.dt.model=attention"],
        ),
        (
            &[UNTRAINED, "policy.dt.width=30", "policy.dt.heads=2"],
            &["policy.dt.width", "multiple of 4 times the heads, 8"],
        ),
        (&[UNTRAINED, "policy.dt.memory=65"], &["policy.dt.memory", "64"]),
    ] {
        let message = try_load("dt", fields).expect_err("an invalid shape");
        assert!(message_parts.iter().all(|part| message.contains(part)), "{message}");
    }
}
