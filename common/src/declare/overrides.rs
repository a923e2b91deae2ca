//! Fields set on the command line, by `--set` or by a dedicated option. Sweeps and the Python package use the same
//! `path=value` format.

use std::str::FromStr;
use std::sync::Arc;

use toml::Spanned;
use toml::de::DeValue;

use super::error::ScenarioError;
use super::toml_error::explain_syntax;

/// Maximum number of names in the path of a field, with the name of the field. No field has as many.
const MAX_PATH_NAMES: usize = 8;

/// A field set on the command line, which overrides the preset and the scenario file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// The option that set the field, for messages; `--set` with its argument, truncated.
    pub(super) label: Arc<str>,
    /// The path of the field: 1 to [`MAX_PATH_NAMES`] names, none empty.
    pub(super) path: Vec<String>,
    /// A TOML value, or a bare word that stands for a string.
    pub(super) value: String,
}

impl Override {
    /// Parses the argument of `--set`: `path.to.field=value`, such as `sensing.d_max=5`, `policy.name=genie` or, for
    /// one class of devices without a dot in its name, `class.NAME.energy.e_tx=3`.
    ///
    /// # Errors
    /// If the argument does not have this format.
    pub fn parse(text: &str) -> Result<Self, ScenarioError> {
        let Some((path, value)) = text.split_once('=') else {
            return Err(malformed("--set", text, "expected path.to.field=value".to_owned()));
        };
        let label = format!("--set {}", text.trim());
        Self::with_label("--set", &label, path, value)
    }

    /// Creates an override of the field at `path` by a dedicated option, such as `--devices` for `devices`. `value`
    /// has the same format as after `--set`.
    ///
    /// # Errors
    /// If `path` has an empty name or too many names, or `value` is a broken TOML string, list or table.
    pub fn from_flag(flag: &str, path: &str, value: &str) -> Result<Self, ScenarioError> {
        Self::with_label(flag, flag, path, value)
    }

    /// Parses an override. `flag` is the option in errors, `label` the origin of the value in later messages.
    fn with_label(flag: &str, label: &str, path: &str, value: &str) -> Result<Self, ScenarioError> {
        let names: Vec<String> = path.split('.').map(|name| name.trim().to_owned()).collect();
        if names.iter().any(String::is_empty) || names.len() > MAX_PATH_NAMES {
            let reason = format!("`{}` is not the path of a field", path.trim());
            return Err(malformed(flag, &format!("{path}={value}"), reason));
        }
        let parsed = Self {
            label: Arc::from(super::error::truncate(label)),
            path: names,
            value: value.trim().to_owned(),
        };
        // Parsed here, so that the error names the option.
        parsed.parse_value()?;
        Ok(parsed)
    }

    /// Returns the value, a string if it is a bare word. An override that exists has a valid value.
    pub(super) fn parse_value(&self) -> Result<Spanned<DeValue<'_>>, ScenarioError> {
        match DeValue::parse(&self.value) {
            Ok(value) => Ok(value),
            // A value that begins like a TOML string, list or table is a broken one; any other is a bare word.
            Err(error) if self.value.starts_with(['"', '\'', '[', '{']) => {
                let text = format!("{}={}", self.path.join("."), self.value);
                let reason = format!("the value is not valid TOML: {}", explain_syntax(error.message()));
                Err(malformed(&self.label, &text, reason))
            }
            Err(_) => Ok(Spanned::new(
                0..self.value.len(),
                DeValue::String(self.value.as_str().into()),
            )),
        }
    }
}

impl FromStr for Override {
    type Err = ScenarioError;

    fn from_str(text: &str) -> Result<Self, ScenarioError> {
        Self::parse(text)
    }
}

/// Returns the error for the argument `text`; of `flag`, an option or a label, it shows the first word.
fn malformed(flag: &str, text: &str, reason: String) -> ScenarioError {
    ScenarioError::Override {
        flag: flag.split(' ').next().unwrap_or(flag).to_owned(),
        text: super::error::truncate(text),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_word_is_read_as_a_string_and_a_number_as_a_number() {
        let word = Override::parse("policy.name = genie").expect("valid");
        assert_eq!(word.path, ["policy", "name"]);
        assert_eq!(word.parse_value().expect("valid").get_ref().as_str(), Some("genie"));
        let number = Override::parse("sensing.d_max=5").expect("valid");
        assert!(number.parse_value().expect("valid").get_ref().is_integer());
    }

    #[test]
    fn malformed_overrides_are_refused() {
        for (text, expected) in [
            ("d_max", "path.to.field=value"),
            ("=5", "not the path"),
            ("sensing..d_max=5", "not the path"),
            ("harvest.trace.columns=[\"a\"", "not valid TOML"),
        ] {
            let message = Override::parse(text).expect_err(text).to_string();
            assert!(
                message.contains(expected) && message.starts_with("--set "),
                "{text}: {message}"
            );
        }
    }
}
