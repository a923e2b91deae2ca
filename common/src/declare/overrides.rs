//! Single fields set on the command line.

use std::str::FromStr;
use std::sync::Arc;

use toml::Spanned;
use toml::de::DeValue;

use super::error::ScenarioError;

/// Sections within sections that a path may go through; no field is as deep.
const DEEPEST: usize = 8;

/// One field set on the command line, on top of the preset and the scenario file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// The option that set it, for messages.
    pub(super) flag: Arc<str>,
    /// The path of the field, at least one name.
    pub(super) path: Vec<String>,
    /// A TOML value, or a bare word that stands for a string.
    pub(super) value: String,
}

impl Override {
    /// An override from the argument of `--set`: `path.to.field=value`, such as `sensing.d_max=5`, `policy.name=genie`
    /// or, for one class of devices, `class.NAME.energy.e_tx=3`.
    ///
    /// # Errors
    /// The argument is not of that form.
    pub fn parse(text: &str) -> Result<Self, ScenarioError> {
        let Some((path, value)) = text.split_once('=') else {
            return Err(malformed("--set", text, "expected path.to.field=value".to_owned()));
        };
        let shown = format!("--set {}", text.trim());
        Self::with_shown("--set", &shown, path, value)
    }

    /// An override of the field at `path` by an option of its own, such as `--devices` for `devices`. `value` is
    /// written as after `--set`.
    ///
    /// # Errors
    /// `path` is empty or `value` is a broken TOML string, list or table.
    pub fn flag(flag: &str, path: &str, value: &str) -> Result<Self, ScenarioError> {
        Self::with_shown(flag, flag, path, value)
    }

    fn with_shown(flag: &str, shown: &str, path: &str, value: &str) -> Result<Self, ScenarioError> {
        let names: Vec<String> = path.split('.').map(|name| name.trim().to_owned()).collect();
        if names.iter().any(String::is_empty) || names.len() > DEEPEST {
            let reason = format!("`{}` is not the path of a field", path.trim());
            return Err(malformed(flag, &format!("{path}={value}"), reason));
        }
        let made = Self {
            flag: Arc::from(super::error::shortened(shown)),
            path: names,
            value: value.trim().to_owned(),
        };
        made.toml()?;
        Ok(made)
    }

    /// The value as TOML.
    pub(super) fn toml(&self) -> Result<Spanned<DeValue<'_>>, ScenarioError> {
        match DeValue::parse(&self.value) {
            Ok(value) => Ok(value),
            Err(error) if self.value.starts_with(['"', '\'', '[', '{']) => {
                let text = format!("{}={}", self.path.join("."), self.value);
                let reason = format!("the value is not valid TOML: {}", error.message());
                Err(malformed(&self.flag, &text, reason))
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

fn malformed(flag: &str, text: &str, reason: String) -> ScenarioError {
    ScenarioError::Override {
        flag: flag.split(' ').next().unwrap_or(flag).to_owned(),
        text: super::error::shortened(text),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_word_is_a_string_and_a_number_a_number() {
        let word = Override::parse("policy.name = genie").expect("valid");
        assert_eq!(word.path, ["policy", "name"]);
        assert_eq!(word.toml().expect("valid").get_ref().as_str(), Some("genie"));
        let number = Override::parse("sensing.d_max=5").expect("valid");
        assert!(number.toml().expect("valid").get_ref().is_integer());
    }

    #[test]
    fn malformed_overrides_are_refused() {
        for (text, part) in [
            ("d_max", "path.to.field=value"),
            ("=5", "not the path"),
            ("sensing..d_max=5", "not the path"),
            ("harvest.trace.columns=[\"a\"", "not valid TOML"),
        ] {
            let message = Override::parse(text).expect_err(text).to_string();
            assert!(message.contains(part) && message.starts_with("--set "), "{message}");
        }
    }
}
