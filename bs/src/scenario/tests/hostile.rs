//! Tests of loading hostile and random texts: no panic, short messages, and accepted texts round-trip. No test measures
//! the time: a text that loads in quadratic time only makes its test slow. Of the policies, only `knn`, `random` and
//! `genie` are generated.

use proptest::prelude::*;

use super::*;

#[test]
fn hostile_texts_are_refused_with_a_short_message() {
    let repeated = |piece: &str, suffix: &str| format!("{}{suffix}", piece.repeat(100_000));
    for text in [
        repeated("a.", "a = 1"),
        repeated("area.", "a = 1"),
        format!("area = {}", repeated("[", "")),
        format!("[{}]", repeated("policy.", "knn")),
        "[[class]]\nharvest.trace.columns=[]\n".repeat(25_000),
        "\n".repeat(2_000_000),
    ] {
        let message = load_text(&text).expect_err("hostile").to_string();
        // A few lines of a terminal, whatever the length of the text.
        assert!(message.len() < 1000, "{message}");
    }
}

/// Generates a preset's text with one piece replaced.
fn mutated_preset() -> impl Strategy<Value = String> {
    let paper = load("paper", &[]).expect("a preset").scenario.to_toml();
    let preset_text = format!("{paper}\n[[class]]\nname = \"a\"\nshare = 1\n");
    let length = preset_text.chars().count();
    (0..length, 0..12usize, "[-0-9a-z.=\"\\[\\]{}#\n _+\u{e4}]{0,8}").prop_map(move |(start, removed, inserted)| {
        let kept_before = preset_text.chars().take(start);
        let kept_after = preset_text.chars().skip(start + removed);
        kept_before.chain(inserted.chars()).chain(kept_after).collect()
    })
}

fn check_round_trip(scenario: &Scenario) -> Result<(), TestCaseError> {
    let text = scenario.to_toml();
    let reloaded = load_text(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
    prop_assert_eq!(&reloaded, scenario, "{}", text);
    prop_assert_eq!(reloaded.hash(), scenario.hash());
    Ok(())
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in any::<String>()) {
        let _ = load_text(&text);
        let _ = Override::parse(&text).map(|given| load("quick", &[given]));
    }

    #[test]
    fn a_mutated_preset_never_panics(text in mutated_preset()) {
        if let Ok(scenario) = load_text(&text) {
            check_round_trip(&scenario)?;
        }
    }

    #[test]
    fn a_generated_scenario_round_trips(
        (devices, seed, tau) in (1u32..=1000, any::<u64>(), 1e-3..1e3f64),
        (e_max, lambda, e_b, share) in (10.0..1e4f64, 1e-3..10.0f64, 0.0..1e4f64, 0.01..0.99f64),
        kind in prop::sample::select(vec!["eq5", "exp-minus-lambda", "mpp"]),
        policy in prop::sample::select(vec!["knn", "random", "genie"]),
        process in prop::sample::select(vec!["uniform", "hot-spots", "aftershocks", "bursts"]),
        name in "\\PC{0,6}[a-z\"'\\\\]",
    ) {
        let text = format!(
            "devices = {devices}\nseed = {seed}\ntau = {tau}\nharvest.off_mean = 3.5\npolicy.name = \"{policy}\"\n\
             events.process = \"{process}\"\nevents.hot-spots.share = {share}\nevents.bursts.busy_alpha = {share}\n\
             events.aftershocks.radius = {lambda}\n\
             [[class]]\nname = {}\nshare = {share}\nenergy.e_max = {e_max}\nharvest.kind = \"{kind}\"\n\
             harvest.lambda = {lambda}\n[[class]]\nname = \"rest of all\"\nshare = {}\nharvest.e_b = {e_b}\n",
            toml::Value::String(name),
            1.0 - share,
        );
        let scenario = load_text(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
        prop_assert_eq!(scenario.run.seed, seed);
        check_round_trip(&scenario)?;
    }
}
