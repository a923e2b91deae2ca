//! Whatever a scenario file or the command line says: it is refused in words or becomes a scenario whose own text loads
//! and means the same.
//!
//! The first byte says which line of which preset the text replaces, if any; a line that begins with `--set ` is an
//! override.

#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use reveille_bs::scenario::{Override, PRESETS, Scenario, ScenarioError, load, parse};

/// Nothing is there, so that no file of this machine plays a part.
const NOWHERE: &str = "/nonexistent/reveille-fuzz";

/// The full text of `preset` with one line replaced by `text`, which is how a person breaks a file.
fn mutated(preset: &str, line: u8, text: &str) -> String {
    let whole = load(preset, &[]).expect("presets load").to_toml();
    let mut lines: Vec<&str> = whole.lines().collect();
    let at = usize::from(line) % lines.len();
    lines[at] = text;
    lines.join("\n")
}

/// An error is one paragraph that says something.
fn check_error(error: &ScenarioError) {
    let message = error.to_string();
    assert!(!message.trim().is_empty());
    assert!(!message.contains("\n\n"), "{message}");
}

/// The text of a loaded scenario loads and means the same.
fn check_scenario(scenario: &Scenario) {
    let text = scenario.to_toml();
    match parse(&text, "written", Path::new(NOWHERE), &[]) {
        Ok(again) => {
            assert_eq!(again.hash_hex(), scenario.hash_hex(), "{text}");
            assert_eq!(&again, scenario, "{text}");
        }
        Err(error) => panic!("{error}\n{text}"),
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&mode, rest)) = data.split_first() else {
        return;
    };
    let Ok(text) = std::str::from_utf8(rest) else { return };
    let (sets, lines): (Vec<&str>, Vec<&str>) = text.split('\n').partition(|line| line.starts_with("--set "));
    let mut overrides = Vec::new();
    for set in sets.into_iter().take(8) {
        match Override::parse(&set["--set ".len()..]) {
            Ok(given) => overrides.push(given),
            Err(error) => check_error(&error),
        }
    }
    let body = lines.join("\n");
    let text = match mode % 8 {
        preset @ 0..=2 => mutated(PRESETS[usize::from(preset)].name, mode / 8, &body),
        _ => body,
    };
    match parse(&text, "fuzzed", Path::new(NOWHERE), &overrides) {
        Ok(scenario) => check_scenario(&scenario),
        Err(error) => check_error(&error),
    }
});
