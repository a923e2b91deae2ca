//! Turns what serde says of a layer into a message about a field of a scenario.

use toml::de::{DeTable, DeValue};

use super::error::{ScenarioError, did_you_mean, listed, shortened};
use super::layers::{Layer, Places};

/// The error of a layer whose names or types are wrong. `known` holds the paths of all fields with a default.
pub(super) fn explain(layer: &Layer<'_>, error: &toml::de::Error, known: &Places) -> ScenarioError {
    let span = error.span().unwrap_or(0..0);
    let message = error.message();
    let names = backticked(message);
    let place = layer.origin.place(span.start);
    if let (true, [unknown, valid @ ..]) = (message.starts_with("unknown field"), names.as_slice()) {
        let elsewhere = known.keys().filter(|path| path.rsplit('.').next() == Some(*unknown));
        let candidates = elsewhere.map(String::as_str).chain(valid.iter().copied());
        return ScenarioError::UnknownField {
            field: path_of(layer, span.start, Some(unknown)),
            hint: did_you_mean(unknown, candidates),
            valid: listed(valid.iter().copied()),
            place,
        };
    }
    let offset = span.start;
    let written = layer.text.get(span).map_or("", str::trim);
    let allowed = match names.as_slice() {
        [unknown, valid @ ..] if message.starts_with("unknown variant") => {
            let hint = did_you_mean(unknown, valid.iter().copied());
            format!("must be one of {}{hint}", listed(valid.iter().copied()))
        }
        _ => allowed(message),
    };
    ScenarioError::Invalid {
        field: path_of(layer, offset, None),
        value: shortened(written),
        allowed,
        place,
    }
}

/// What a value has to be, in a user's words, from "invalid type: …, expected …".
fn allowed(message: &str) -> String {
    let Some((_, expected)) = message.rsplit_once(", expected ") else {
        return message.to_owned();
    };
    let expected = match expected {
        "f64" => "a number",
        "u64" => "a whole number that is not negative",
        "a boolean" => "true or false",
        "a sequence" => "a list",
        other => other,
    };
    format!("must be {expected}")
}

/// The words between backticks.
fn backticked(message: &str) -> Vec<&str> {
    message.split('`').skip(1).step_by(2).collect()
}

/// The full path of the field at `offset` in the layer's text.
fn path_of(layer: &Layer<'_>, offset: usize, unknown: Option<&str>) -> String {
    let Some(path) = layer.path else {
        return find(&layer.table, offset).unwrap_or_default();
    };
    let Some(unknown) = unknown else {
        return path.join(".");
    };
    let upto = path
        .iter()
        .position(|name| name == unknown)
        .map_or(path.len(), |at| at + 1);
    let extra = if upto == path.len() && path.last().is_none_or(|last| last != unknown) {
        Some(unknown)
    } else {
        None
    };
    let names: Vec<&str> = path[..upto].iter().map(String::as_str).chain(extra).collect();
    names.join(".")
}

/// The path of the deepest field whose name or value spans `offset`. Tables may span no more than their header, so
/// fields within are looked at first.
fn find(table: &DeTable<'_>, offset: usize) -> Option<String> {
    let inner = table.iter().find_map(|(name, value)| {
        let rest = find_within(value.get_ref(), offset)?;
        Some(format!("{}.{rest}", name.get_ref()))
    });
    inner.or_else(|| {
        let hit = table
            .iter()
            .find(|(name, value)| name.span().contains(&offset) || value.span().contains(&offset));
        hit.map(|(name, _)| name.get_ref().to_string())
    })
}

fn find_within(value: &DeValue<'_>, offset: usize) -> Option<String> {
    match value {
        DeValue::Table(table) => find(table, offset),
        DeValue::Array(items) => items.iter().enumerate().find_map(|(index, item)| {
            let rest = find_within(item.get_ref(), offset)?;
            let name = item.get_ref().get("name").and_then(|name| name.get_ref().as_str());
            Some(format!(
                "{}.{rest}",
                name.map_or_else(|| (index + 1).to_string(), shortened)
            ))
        }),
        DeValue::String(_) | DeValue::Integer(_) | DeValue::Float(_) | DeValue::Boolean(_) | DeValue::Datetime(_) => {
            None
        }
    }
}
