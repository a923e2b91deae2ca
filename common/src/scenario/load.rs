//! Loading of scenarios: preset, file and command line, in this order of precedence from low to high.
//! `bs/src/scenario/tests/` expects the precedence and the texts of errors. `bs/src/scenario/` calls [`load`] and
//! [`parse`] with the policies of the program.

use std::io;
use std::path::Path;

use super::declaration::declaration;
use super::model::LoadedScenario;
use super::policy::{Policies, PolicyChoice, PolicyKind};
use super::run::PRESETS;
use super::validate::validate;
use crate::declare::{
    Declaration, FileContext, FileError, Files, Layer, LayerOrigin, Layers, MAX_TEXT_BYTES, Override, Preset,
    ScenarioError, ValueOrigin, did_you_mean, quoted_list, truncate,
};

/// Loads the scenario `source`, the name of a preset or the path of a scenario file, with `overrides` on top; later
/// overrides win. Paths of layout and trace files in the scenario file are relative to its folder, those in an
/// override to the working directory. The scenario may name one of `policies`. Files that the scenario refers to are
/// read through `files`.
///
/// # Errors
/// If the preset or file does not exist, or the scenario is invalid. The message names the field, its value, the
/// allowed values and the origin of the value.
pub fn load<K: PolicyKind>(
    source: &str,
    overrides: &[Override],
    policies: Policies<'_, K>,
    files: &dyn Files,
) -> Result<LoadedScenario<PolicyChoice<K>>, ScenarioError> {
    let base_dir = Path::new("");
    if let Some(preset) = PRESETS.iter().find(|preset| preset.name == source) {
        return resolve(preset, None, overrides, policies, FileContext { files, base_dir });
    }
    let path = Path::new(source);
    if !files.exists(path) {
        return Err(ScenarioError::NotFound {
            name: source.to_owned(),
            hint: did_you_mean(source, preset_names()),
            presets: quoted_list(preset_names()),
        });
    }
    let text = read_text(path, source, files)?;
    parse(
        &text,
        source,
        path.parent().unwrap_or(base_dir),
        overrides,
        policies,
        files,
    )
}

/// Parses the scenario in the TOML `text`. `origin` names it in messages; paths in it are relative to `base_dir`.
/// Only files that the text refers to are read. Never panics, whatever the text.
///
/// # Errors
/// As [`load`].
pub fn parse<K: PolicyKind>(
    text: &str,
    origin: &str,
    base_dir: &Path,
    overrides: &[Override],
    policies: Policies<'_, K>,
    files: &dyn Files,
) -> Result<LoadedScenario<PolicyChoice<K>>, ScenarioError> {
    let file = Layer::from_text(text, LayerOrigin::file(origin, text))?;
    resolve(
        default_preset(),
        Some(file),
        overrides,
        policies,
        FileContext { files, base_dir },
    )
}

fn resolve<K: PolicyKind>(
    base_preset: &Preset,
    file: Option<Layer<'_>>,
    overrides: &[Override],
    policies: Policies<'_, K>,
    file_context: FileContext<'_>,
) -> Result<LoadedScenario<PolicyChoice<K>>, ScenarioError> {
    let declaration = declaration(policies);
    let override_layers = overrides
        .iter()
        .map(|field_override| Layer::from_override(field_override, &declaration))
        .collect::<Result<Vec<_>, ScenarioError>>()?;
    // The last layer has the highest precedence.
    let preset_field = file
        .iter()
        .chain(&override_layers)
        .filter_map(|layer| layer.text_at("preset"))
        .next_back();
    let preset_name = preset_field.as_ref().map_or(base_preset.name, |(name, _)| *name);
    let Some(preset) = PRESETS.iter().find(|preset| preset.name == preset_name) else {
        return Err(ScenarioError::Invalid {
            field: "preset".to_owned(),
            value: truncate(preset_name),
            allowed: format!(
                "must be one of {}{}",
                quoted_list(preset_names()),
                did_you_mean(preset_name, preset_names())
            ),
            origin: preset_field.map_or(ValueOrigin::Unset, |(_, origin)| origin),
        });
    };
    let merged = merge_layers(&declaration, preset, file, override_layers)?;
    validate(preset.name, &declaration, &merged, policies, file_context)
}

fn merge_layers<'a>(
    declaration: &'a Declaration,
    preset: &Preset,
    file: Option<Layer<'a>>,
    overrides: Vec<Layer<'a>>,
) -> Result<crate::declare::Merged<'a>, ScenarioError> {
    let mut layers = Layers::new(declaration);
    layers.add(Layer::from_text(preset.text, LayerOrigin::Preset(preset.name))?)?;
    for layer in file.into_iter().chain(overrides) {
        layers.add(layer)?;
    }
    Ok(layers.finish())
}

/// The preset from which a file starts unless it names another; the default of the field `preset` in `run.rs` repeats
/// its name.
const fn default_preset() -> &'static Preset {
    &PRESETS[0]
}

fn preset_names() -> impl Iterator<Item = &'static str> + Clone {
    PRESETS.iter().map(|preset| preset.name)
}

/// Advice about a file without a scenario.
const OTHER_SOURCE: &str = "name a scenario file or, for a recording, the folder of its run";

fn read_text(path: &Path, source: &str, files: &dyn Files) -> Result<String, ScenarioError> {
    let refused = |error: io::Error| ScenarioError::Read {
        path: path.to_owned(),
        error,
    };
    let bytes = files.read(path, MAX_TEXT_BYTES).map_err(|error| match error {
        FileError::Io(error) => refused(error),
        FileError::Folder => refused(io::Error::other("it is a folder, not a file")),
        FileError::Special => refused(io::Error::other("it is not a regular file")),
        FileError::TooLong { max_bytes, .. } => ScenarioError::Syntax {
            name: source.to_owned(),
            line: 1,
            reason: format!("longer than {max_bytes} bytes; {OTHER_SOURCE}"),
        },
    })?;
    String::from_utf8(bytes).map_err(|_| {
        let cause = format!("it is not UTF-8 text; {OTHER_SOURCE}");
        refused(io::Error::new(io::ErrorKind::InvalidData, cause))
    })
}
