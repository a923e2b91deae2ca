//! The fields in which two scenario files differ.

use std::collections::BTreeMap;

use reveille_common::declare::Declaration;
use toml::{Table, Value};

use super::declaration;

/// A scenario field that differs: its name, the value of this run and the value of the other run, both as TOML or
/// `none`.
pub type FieldDifference = (String, String, String);

/// Lists the fields in which two scenario files differ, sorted by name. A missing field has its default value, or
/// `none` where it is unknown or has no effect. Presets are not applied: the texts must be resolved scenarios, such as
/// the `scenario.toml` of a run folder.
///
/// # Errors
/// If one of the texts is not valid TOML.
pub fn compare_scenarios(this: &str, other: &str) -> Result<Vec<FieldDifference>, toml::de::Error> {
    let (this_fields, other_fields) = (flatten(this)?, flatten(other)?);
    let mut names: Vec<&String> = this_fields.keys().chain(other_fields.keys()).collect();
    names.sort_unstable();
    names.dedup();
    let declaration = declaration();
    let value = |fields: &BTreeMap<String, String>, name: &str| {
        let default = || default_value(&declaration, fields, name);
        fields
            .get(name)
            .cloned()
            .or_else(default)
            .unwrap_or_else(|| "none".to_owned())
    };
    Ok(names
        .into_iter()
        .map(|name| (name.clone(), value(&this_fields, name), value(&other_fields, name)))
        .filter(|(_, this, other)| this != other)
        .collect())
}

/// Returns the default value of the field `name`, which `fields` lack; `None` if it has no effect there.
fn default_value(declaration: &Declaration, fields: &BTreeMap<String, String>, name: &str) -> Option<String> {
    let (section, field) = declaration.field_by_path(name)?;
    let has_effect = section.condition(field).is_none_or(|condition| {
        let default = || declaration.field_by_path(condition.field)?.1.default.to_toml();
        let deciding = fields.get(condition.field).cloned().or_else(default);
        deciding.is_some_and(|value| condition.values.contains(&value.trim_matches('"')))
    });
    has_effect.then(|| field.default.to_toml()).flatten()
}

/// Adds the values below `path` to `fields`, as TOML by dotted name. A list of tables is one value.
fn add_fields(path: &str, table: Table, fields: &mut BTreeMap<String, String>) {
    for (name, value) in table {
        let path = if path.is_empty() {
            name
        } else {
            format!("{path}.{name}")
        };
        if let Value::Table(inner) = value {
            add_fields(&path, inner, fields);
        } else {
            fields.insert(path, value.to_string());
        }
    }
}

/// Returns the fields of a scenario file by dotted name, with their values as TOML. A list of tables is one value.
///
/// # Errors
/// If the text is not valid TOML.
pub fn flatten(text: &str) -> Result<BTreeMap<String, String>, toml::de::Error> {
    let mut fields = BTreeMap::new();
    add_fields("", text.parse()?, &mut fields);
    Ok(fields)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenarios_are_compared_by_field() {
        let (this, other) = ("seed = 1\n[a.b]\nc = [1]\nd = 'x'", "seed = 2\n[a.b]\nc = [1]");
        let expected = [("a.b.d", "\"x\"", "none"), ("seed", "1", "2")];
        let expected = expected.map(|(name, this, other)| (name.to_owned(), this.to_owned(), other.to_owned()));
        assert_eq!(compare_scenarios(this, other).expect("TOML"), expected);
        assert!(compare_scenarios("seed", other).is_err());
        // A scenario file leaves out some fields at their default, and all fields without effect.
        let (this, other) = (
            "[harvest]\nkind = \"eq5\"",
            "[harvest]\nkind = \"diurnal\"\ndiurnal.start_hour = 0.0\n[radio]\nuplink_loss = 0.4\nwake_miss = 0.0",
        );
        let expected = [
            ("harvest.diurnal.start_hour", "none", "0.0"),
            ("harvest.kind", "\"eq5\"", "\"diurnal\""),
            ("radio.uplink_loss", "0.0", "0.4"),
        ];
        let expected = expected.map(|(name, this, other)| (name.to_owned(), this.to_owned(), other.to_owned()));
        assert_eq!(compare_scenarios(this, other).expect("TOML"), expected);
    }
}
