//! Errors of the TOML parser for users: with the line, the field and the fix. Every file of users in TOML is read with
//! them: scenarios, experiments and `testbed.toml`.

use serde::de::DeserializeOwned;

use super::error::{did_you_mean, quoted_list};

/// An error in a TOML text.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {reason}")]
pub struct TomlError {
    /// The line, from 1.
    pub line: usize,
    /// The field, if known, with the cause and the fix.
    pub reason: String,
    /// The unknown field, if this is the cause.
    pub unknown_field: Option<String>,
}

/// Reads a value from the TOML `text` of a user.
///
/// # Errors
/// If the text is not valid TOML, or has unknown fields or values of wrong types.
pub fn parse_toml<T: DeserializeOwned>(text: &str) -> Result<T, TomlError> {
    toml::from_str(text).map_err(|error| {
        let span = error.span().unwrap_or_default();
        let before = text.get(..span.start).unwrap_or(text);
        let value = text.get(span).unwrap_or_default();
        let unknown_field = unknown_field(error.message()).map(|(field, _)| field.to_owned());
        TomlError {
            line: before.matches('\n').count() + 1,
            reason: explain(error.message(), before, value),
            unknown_field,
        }
    })
}

/// Returns the message of a syntax error, with a hint for text without quotes.
pub(super) fn explain_syntax(message: &str) -> String {
    // A bare word that begins like `true` or `false` has this message.
    let is_bare_word = message.starts_with("invalid boolean");
    let hint = if is_bare_word { "; put text in quotes" } else { "" };
    format!("{message}{hint}")
}

/// Returns "; use a whole number such as …" if `value` is a whole number in the notation of other numbers, such as
/// `1e4`.
pub(super) fn whole_number_hint(value: &str) -> String {
    let value = value.trim().replace('_', "");
    let number = value.parse::<f64>().ok().filter(|_| value.parse::<i64>().is_err());
    match number.filter(|number| number.fract() == 0.0 && *number >= 0.0 && *number < 1e15) {
        Some(number) => format!("; use a whole number such as {number}"),
        None => String::new(),
    }
}

/// Explains a `message` about `value`, which follows the text `before`.
fn explain(message: &str, before: &str, value: &str) -> String {
    if let Some((field, valid)) = unknown_field(message) {
        let hint = did_you_mean(field, valid.iter().copied());
        return format!(
            "unknown field `{field}`{hint}; the fields there are {}",
            quoted_list(valid)
        );
    }
    let is_mismatch = message.starts_with("invalid type: ") || message.starts_with("invalid value: ");
    let Some((found, expected)) = message.split_once(", expected ").filter(|_| is_mismatch) else {
        let hint = if message.contains("number") {
            whole_number_hint(value)
        } else {
            String::new()
        };
        return explain_syntax(message) + &hint;
    };
    let is_whole = ["usize", "u64", "u32"].contains(&expected);
    let expected = match expected {
        "f64" => "a number",
        "a boolean" => "true or false",
        "a string" => "text in quotes",
        "a sequence" => "a list",
        _ if is_whole => "a whole number that is not negative",
        other => other,
    };
    let hint = if is_whole {
        whole_number_hint(value)
    } else {
        String::new()
    };
    // The text before a value is its field, except in lists of several lines.
    let line = before.rsplit('\n').next().unwrap_or_default();
    let field = line
        .split_once('=')
        .map_or_else(String::new, |(field, _)| format!("{}: ", field.trim()));
    format!("{field}{found}, expected {expected}{hint}")
}

/// Returns the unknown field in a `message`, with the known ones.
fn unknown_field(message: &str) -> Option<(&str, Vec<&str>)> {
    let (field, rest) = message.strip_prefix("unknown field `")?.split_once('`')?;
    // The names in backticks are every second part.
    Some((field, rest.split('`').skip(1).step_by(2).collect()))
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    #[expect(dead_code, reason = "only the errors matter")]
    struct File {
        name: String,
        containers: Option<usize>,
        cpus: Option<f64>,
        faults: Option<Vec<String>>,
    }

    #[test]
    fn an_error_has_the_line_the_field_and_the_fix() {
        for (line, reason) in [
            ("name = two", "invalid boolean, expected `true`; put text in quotes"),
            (
                "names = \"a\"",
                "unknown field `names`; did you mean `name`?; the fields there are `name`, `containers`, `cpus`, \
                 `faults`",
            ),
            ("colour = 1", "unknown field `colour`; the fields there are `name`"),
            (
                "containers = 1e4",
                "containers: invalid type: floating point `10000.0`, expected a whole number that is not negative; use \
                 a whole number such as 10000",
            ),
            (
                "containers = \"5\"",
                "containers: invalid type: string \"5\", expected a whole number that is not negative",
            ),
            (
                "cpus = \"all\"",
                "cpus: invalid type: string \"all\", expected a number",
            ),
            ("faults = 3", "faults: invalid type: integer `3`, expected a list"),
            (
                "faults = [3]",
                "faults: invalid type: integer `3`, expected text in quotes",
            ),
        ] {
            let error = parse_toml::<File>(&format!("# a comment\n{line}\n")).expect_err(line);
            assert_eq!(error.line, 2, "{line}");
            assert!(error.reason.contains(reason), "{line}: {error}");
        }
    }
}
