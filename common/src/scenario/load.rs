//! Loading: preset, file and command line, in this order of precedence from low to high.

use std::io::Read;
use std::path::Path;

use super::error::{ScenarioError, did_you_mean, listed};
use super::layers::{LONGEST_TEXT, Layer, Layers, Origin};
use super::model::Scenario;
use super::overrides::Override;
use super::validate::validate;

/// The presets: name and description.
pub const PRESETS: &[(&str, &str)] = &[
    (
        "paper",
        "Table II, with the calibration that came closest to the paper's figures",
    ),
    (
        "paper-literal",
        "the paper's words taken literally: uniform layout, detection by p(d), events of one TTI",
    ),
    (
        "quick",
        "20 devices and 1000 TTIs of `paper`: a first look within seconds",
    ),
];

/// The preset that a file starts from unless it names another, and the complete base of all others.
const BASE: &str = "paper";

const TEXTS: &[(&str, &str)] = &[
    ("paper", include_str!("presets/paper.toml")),
    ("paper-literal", include_str!("presets/paper-literal.toml")),
    ("quick", include_str!("presets/quick.toml")),
];

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` on top; later overrides
/// win. Layout and trace files that the scenario file names are relative to its folder, those that an override names to
/// the working directory.
///
/// # Errors
/// There is no such preset or file, or the scenario cannot be used; the message names the field, its value, what is
/// allowed and where it was set.
pub fn load(source: &str, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    if TEXTS.iter().any(|(name, _)| *name == source) {
        return resolve(source, None, Path::new(""), overrides);
    }
    let path = Path::new(source);
    if !path.exists() {
        return Err(ScenarioError::NoSuchScenario {
            name: source.to_owned(),
            hint: did_you_mean(source, preset_names()),
            presets: listed(preset_names()),
        });
    }
    let text = read(path).map_err(|error| ScenarioError::Read {
        path: path.to_owned(),
        error,
    })?;
    parse(&text, source, path.parent().unwrap_or(Path::new("")), overrides)
}

/// The scenario of the TOML `text`. `origin` names it in messages; files that it names are relative to `base_dir`. Reads
/// nothing but those files, and never panics, whatever the text.
///
/// # Errors
/// As [`load`].
pub fn parse(text: &str, origin: &str, base_dir: &Path, overrides: &[Override]) -> Result<Scenario, ScenarioError> {
    let file = Layer::from_text(text, Origin::file(origin, text))?;
    resolve(BASE, Some(file), base_dir, overrides)
}

fn resolve(
    default_preset: &str,
    file: Option<Layer<'_>>,
    base_dir: &Path,
    overrides: &[Override],
) -> Result<Scenario, ScenarioError> {
    let given = overrides
        .iter()
        .map(Layer::from_override)
        .collect::<Result<Vec<_>, ScenarioError>>()?;
    let asked = file.iter().chain(&given).filter_map(Layer::preset).next_back();
    let preset = match &asked {
        Some((name, _)) => *name,
        None => default_preset,
    };
    let Some((preset, text)) = TEXTS.iter().find(|(name, _)| *name == preset) else {
        return Err(ScenarioError::Invalid {
            field: "preset".to_owned(),
            value: super::error::shortened(preset),
            allowed: format!(
                "must be one of {}{}",
                listed(preset_names()),
                did_you_mean(preset, preset_names())
            ),
            place: asked.map_or(super::Place::Nowhere, |(_, place)| place),
        });
    };
    let mut layers = Layers::default();
    for (name, text) in TEXTS
        .iter()
        .filter(|(name, _)| *name == BASE)
        .chain([&(*preset, *text)])
    {
        layers.add(Layer::from_text(text, Origin::Preset(name))?)?;
    }
    for layer in file.into_iter().chain(given) {
        layers.add(layer)?;
    }
    let (raw, places) = layers.finish()?;
    validate(preset, &raw, &places, base_dir)
}

fn preset_names() -> impl Iterator<Item = &'static str> + Clone {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The text of a scenario file, not much more of it than [`Layer::from_text`] accepts.
fn read(path: &Path) -> std::io::Result<String> {
    if !path.is_file() {
        return Err(std::io::Error::other(if path.is_dir() {
            "it is a folder"
        } else {
            "it is no regular file"
        }));
    }
    let mut text = String::new();
    std::fs::File::open(path)?
        .take(LONGEST_TEXT + 1)
        .read_to_string(&mut text)?;
    Ok(text)
}
