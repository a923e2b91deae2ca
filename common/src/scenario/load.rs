//! Loading: preset, file and command line, in this order of precedence from low to high.

use std::io;
use std::path::Path;

use super::declaration::declaration;
use super::model::{Policies, Scenario};
use super::run::PRESETS;
use super::settle::settle;
use crate::declare::{
    Declaration, FileError, Files, Ground, LONGEST_TEXT, Layer, Layers, Origin, Override, Place, Preset, ScenarioError,
    did_you_mean, listed, shortened,
};

/// Loads the scenario `source`, a preset's name or the path of a scenario file, with `overrides` on top; later
/// overrides win. Layout and trace files that the scenario file names are relative to its folder, those that an
/// override names to the working directory. `policies` are those that it may name, `files` opens what it names.
///
/// # Errors
/// There is no such preset or file, or the scenario cannot be used; the message names the field, its value, what is
/// allowed and where it was set.
pub fn load(
    source: &str,
    overrides: &[Override],
    policies: Policies<'_>,
    files: &dyn Files,
) -> Result<Scenario, ScenarioError> {
    let base_dir = Path::new("");
    if let Some(preset) = PRESETS.iter().find(|preset| preset.name == source) {
        return resolve(preset, None, overrides, policies, Ground { files, base_dir });
    }
    let path = Path::new(source);
    if !files.exists(path) {
        return Err(ScenarioError::NoSuchScenario {
            name: source.to_owned(),
            hint: did_you_mean(source, preset_names()),
            presets: listed(preset_names()),
        });
    }
    let text = read(path, source, files)?;
    parse(
        &text,
        source,
        path.parent().unwrap_or(base_dir),
        overrides,
        policies,
        files,
    )
}

/// The scenario of the TOML `text`. `origin` names it in messages; files that it names are relative to `base_dir`.
/// Reads nothing but those files, and never panics, whatever the text.
///
/// # Errors
/// As [`load`].
pub fn parse(
    text: &str,
    origin: &str,
    base_dir: &Path,
    overrides: &[Override],
    policies: Policies<'_>,
    files: &dyn Files,
) -> Result<Scenario, ScenarioError> {
    let file = Layer::from_text(text, Origin::file(origin, text))?;
    resolve(&PRESETS[0], Some(file), overrides, policies, Ground { files, base_dir })
}

fn resolve(
    start: &Preset,
    file: Option<Layer<'_>>,
    overrides: &[Override],
    policies: Policies<'_>,
    ground: Ground<'_>,
) -> Result<Scenario, ScenarioError> {
    let declaration = declaration(policies);
    let given = overrides
        .iter()
        .map(|given| Layer::from_override(given, &declaration))
        .collect::<Result<Vec<_>, ScenarioError>>()?;
    let asked = file
        .iter()
        .chain(&given)
        .filter_map(|layer| layer.text_of("preset"))
        .next_back();
    let name = asked.as_ref().map_or(start.name, |(name, _)| *name);
    let Some(preset) = PRESETS.iter().find(|preset| preset.name == name) else {
        return Err(ScenarioError::Invalid {
            field: "preset".to_owned(),
            value: shortened(name),
            allowed: format!(
                "must be one of {}{}",
                listed(preset_names()),
                did_you_mean(name, preset_names())
            ),
            place: asked.map_or(Place::Nowhere, |(_, place)| place),
        });
    };
    let merged = merged(&declaration, preset, file, given)?;
    settle(preset.name, &declaration, &merged, policies, ground)
}

/// `preset`, the file and the command line, laid over one another.
fn merged<'a>(
    declaration: &'a Declaration,
    preset: &Preset,
    file: Option<Layer<'a>>,
    given: Vec<Layer<'a>>,
) -> Result<crate::declare::Merged<'a>, ScenarioError> {
    let mut layers = Layers::new(declaration);
    layers.add(Layer::from_text(preset.text, Origin::Preset(preset.name))?)?;
    for layer in file.into_iter().chain(given) {
        layers.add(layer)?;
    }
    Ok(layers.finish())
}

fn preset_names() -> impl Iterator<Item = &'static str> + Clone {
    PRESETS.iter().map(|preset| preset.name)
}

/// The text of a scenario file.
fn read(path: &Path, source: &str, files: &dyn Files) -> Result<String, ScenarioError> {
    let refused = |error: io::Error| ScenarioError::Read {
        path: path.to_owned(),
        error,
    };
    let bytes = files.read(path, LONGEST_TEXT).map_err(|error| match error {
        FileError::Io(error) => refused(error),
        FileError::Folder => refused(io::Error::other("it is a folder")),
        FileError::Special => refused(io::Error::other("it is no regular file")),
        FileError::TooLong { most, .. } => ScenarioError::Syntax {
            name: source.to_owned(),
            line: 1,
            reason: format!("longer than {most} bytes"),
        },
    })?;
    String::from_utf8(bytes).map_err(|_| refused(io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8 text")))
}
