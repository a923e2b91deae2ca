//! The decision transformer beside the policy that it is built on.

use std::sync::Arc;

use reveille_bs::policy::dt::model::weights::Weights;
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_lab::preparation::run;
use serde_json::Value;

fn scenario(policy: &str, set: &[&str]) -> Scenario {
    let by_default = ["ttis=200", "devices=40"];
    let name = format!("policy.name={policy}");
    let all = by_default.iter().chain(set).copied().chain([name.as_str()]);
    let overrides: Vec<Override> = all.map(|set| Override::parse(set).expect("an override")).collect();
    load("paper", &overrides).expect("a scenario")
}

/// The shipped model with a head that gives zeros.
fn silent(settings: &DtSettings) -> DtSettings {
    let mut bytes = include_bytes!("../../bs/src/policy/dt/shipped.safetensors").to_vec();
    let header = u64::from_le_bytes(*bytes.first_chunk().expect("a length")) as usize;
    let json: Value = serde_json::from_slice(&bytes[8..8 + header]).expect("a header");
    for tensor in ["head.weight", "head.bias"] {
        let place = |index: usize| json[tensor]["data_offsets"][index].as_u64().expect("a place") as usize;
        bytes[8 + header + place(0)..8 + header + place(1)].fill(0);
    }
    DtSettings {
        weights: Arc::new(Weights::read(&bytes).expect("a model")),
        ..settings.clone()
    }
}

/// Protects: what a model changes is what it has learned. One that expects nothing but what age and α say decides as
/// `age-index` does, bit by bit.
#[test]
fn a_model_that_says_nothing_is_age_index() {
    for set in [
        &[][..],
        &["events.process=bursts"],
        &["bs.battery_knowledge=reported", "sensing.kind=probabilistic"],
    ] {
        let plain = run(&scenario("age-index", set)).digest;
        let mut learned = scenario("dt", set);
        assert_ne!(run(&learned).digest, plain, "the model says something: {set:?}");
        let settings = silent(learned.policy.settings().expect("its settings"));
        learned.policy = learned.policy.with_settings(settings);
        assert_eq!(run(&learned).digest, plain, "{set:?}");
    }
}
