//! Fuzzes scenario files and overrides: a text is refused with an error, or loads as a scenario. The text of that
//! scenario loads as an equal scenario.
//!
//! The first byte modulo 8 selects: 0 to 2 the preset of this index in `PRESETS`, in which the text replaces a line,
//! otherwise the text alone. The byte divided by 8 is the line, so only the first 32 lines are replaced. A line that
//! begins with `--set ` is an override, of which eight count. The seeds of the corpus rely on the meaning of the first
//! byte and on the order of `PRESETS`. tests/fuzz/README.md shows how to run the target.

#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use reveille_bs::scenario::{Loaded, Override, PRESETS, Scenario, ScenarioError, load, parse};

/// Folder that does not exist, so that no file of this machine affects the result.
const NOWHERE: &str = "/nonexistent/reveille-fuzz";

/// Returns the full text of `preset` with a line replaced by `text`, a typical editing mistake. `line` counts from 0
/// and continues from the first line after the last.
fn preset_with_line(preset: &str, line: u8, text: &str) -> String {
    let preset_text = load(preset, &[]).expect("presets load").scenario.to_toml();
    let mut lines: Vec<&str> = preset_text.lines().collect();
    let index = usize::from(line) % lines.len();
    lines[index] = text;
    lines.join("\n")
}

/// Checks that an error is one paragraph and not empty.
fn check_error(error: &ScenarioError) {
    let message = error.to_string();
    assert!(!message.trim().is_empty());
    assert!(!message.contains("\n\n"), "{message}");
}

/// Checks that the text of a loaded scenario loads as an equal scenario.
fn check_scenario(scenario: &Scenario) {
    let text = scenario.to_toml();
    match parse(&text, "written", Path::new(NOWHERE), &[]) {
        Ok(Loaded { scenario: reloaded, .. }) => {
            assert_eq!(reloaded.hash_hex(), scenario.hash_hex(), "{text}");
            assert_eq!(&reloaded, scenario, "{text}");
        }
        Err(error) => panic!("{error}\n{text}"),
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&selector, content)) = data.split_first() else {
        return;
    };
    let Ok(text) = std::str::from_utf8(content) else { return };
    let (override_lines, lines): (Vec<&str>, Vec<&str>) = text.split('\n').partition(|line| line.starts_with("--set "));
    let mut overrides = Vec::new();
    // Further overrides would only make the input slow.
    for line in override_lines.into_iter().take(8) {
        match Override::parse(&line["--set ".len()..]) {
            Ok(parsed) => overrides.push(parsed),
            Err(error) => check_error(&error),
        }
    }
    let body = lines.join("\n");
    let text = match selector % 8 {
        preset @ 0..=2 => preset_with_line(PRESETS[usize::from(preset)].name, selector / 8, &body),
        _ => body,
    };
    match parse(&text, "fuzzed", Path::new(NOWHERE), &overrides) {
        Ok(loaded) => check_scenario(&loaded.scenario),
        Err(error) => check_error(&error),
    }
});
