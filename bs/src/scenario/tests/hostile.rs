//! Hostile and random texts: they are refused in bounded time, and accepted texts survive a round trip.

use proptest::prelude::*;

use super::*;

#[test]
fn hostile_texts_are_refused_in_time() {
    let deep = |piece: &str, end: &str| format!("{}{end}", piece.repeat(100_000));
    for text in [
        deep("a.", "a = 1"),
        deep("area.", "a = 1"),
        format!("area = {}", deep("[", "")),
        format!("[{}]", deep("policy.", "knn")),
        "[[class]]\nharvest.trace.columns=[]\n".repeat(25_000),
        "\n".repeat(2_000_000),
    ] {
        let message = from(&text).expect_err("hostile").to_string();
        assert!(message.len() < 1000, "{message}");
    }
}

/// Generates a preset's text with one piece replaced.
fn mutated() -> impl Strategy<Value = String> {
    let paper = load("paper", &[]).expect("a preset").scenario.to_toml();
    let source = format!("{paper}\n[[class]]\nname = \"a\"\nshare = 1\n");
    let length = source.chars().count();
    (0..length, 0..12usize, "[-0-9a-z.=\"\\[\\]{}#\n _+\u{e4}]{0,8}").prop_map(move |(at, cut, new)| {
        let head = source.chars().take(at);
        head.chain(new.chars()).chain(source.chars().skip(at + cut)).collect()
    })
}

/// Checks that the scenario survives a round trip.
fn there_and_back(scenario: &Scenario) -> Result<(), TestCaseError> {
    let text = scenario.to_toml();
    let again = from(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
    prop_assert_eq!(&again, scenario, "{}", text);
    prop_assert_eq!(again.hash(), scenario.hash());
    Ok(())
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in any::<String>()) {
        let _ = from(&text);
        let _ = Override::parse(&text).map(|given| load("quick", &[given]));
    }

    #[test]
    fn a_mutated_preset_never_panics(text in mutated()) {
        if let Ok(scenario) = from(&text) {
            there_and_back(&scenario)?;
        }
    }

    #[test]
    fn to_toml_loads_back(
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
        let scenario = from(&text).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
        prop_assert_eq!(scenario.run.seed, seed);
        there_and_back(&scenario)?;
    }
}
