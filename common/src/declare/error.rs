//! Errors of a scenario, each as one sentence with the cause and the fix. `bs/src/scenario/tests/messages.rs` expects
//! their texts. Other errors use [`quoted_list`] and [`truncate`] too.

use std::io;
use std::path::PathBuf;

use strsim::osa_distance;

use super::origins::ValueOrigin;

/// The reason why a scenario cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The source is neither the name of a preset nor the path of a file.
    #[error("no scenario `{name}`: it is neither a file nor a preset{hint}; the presets are {presets}")]
    NotFound {
        /// The requested name.
        name: String,
        /// "; did you mean …", or nothing.
        hint: String,
        /// The names of the presets.
        presets: String,
    },
    /// The scenario file cannot be read.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The scenario file.
        path: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// The text is not valid TOML.
    #[error("{name}, line {line}: not valid TOML: {reason}")]
    Syntax {
        /// The file's name.
        name: String,
        /// The line, from 1.
        line: usize,
        /// The error of the TOML parser.
        reason: String,
    },
    /// An override is not of the form `path.to.field=value`.
    #[error("{flag} {text}: {reason}")]
    Override {
        /// The option of the command line.
        flag: String,
        /// Its argument.
        text: String,
        /// The reason for the error.
        reason: String,
    },
    /// The field does not exist.
    #[error("unknown field `{field}`{hint}; {origin}; the fields there are {valid}")]
    UnknownField {
        /// The full path of the field.
        field: String,
        /// "; did you mean …", or nothing.
        hint: String,
        /// The fields of its section.
        valid: String,
        /// The origin of the value.
        origin: ValueOrigin,
    },
    /// A layer sets a field under both its former name and its name of today.
    #[error("{former} is the former name of {current}, and {layer} sets both: remove {former}; {origin}")]
    FormerName {
        /// The full path under the former name.
        former: String,
        /// The full path of today.
        current: String,
        /// "the file" or "the option".
        layer: &'static str,
        /// The origin of the value under the former name.
        origin: ValueOrigin,
    },
    /// A value has the wrong type or is out of its range.
    #[error("{field} = {value}: {allowed}; {origin}")]
    Invalid {
        /// The full path of the field.
        field: String,
        /// Its value.
        value: String,
        /// The rest of the sentence: the allowed values, or the complaint about this one.
        allowed: String,
        /// The origin of the value.
        origin: ValueOrigin,
    },
    /// A required field has no value.
    #[error("{field}: required {why}")]
    Missing {
        /// The full path of the field.
        field: String,
        /// The end of the sentence: the setting that makes it required, with its origin, or "in every scenario".
        why: String,
    },
    /// Other settings leave the field without effect.
    #[error("{field}: has an effect only with {condition}; remove it, or set {condition}; {origin}")]
    UnusedField {
        /// The full path of the field.
        field: String,
        /// The setting under which the field has an effect, such as `harvest.kind = "mpp"`.
        condition: String,
        /// The origin of the value.
        origin: ValueOrigin,
    },
    /// A layout or trace file cannot be used.
    #[error("{field} = \"{}\": {reason}; {origin}", file.display())]
    InvalidFile {
        /// The field that names the file.
        field: String,
        /// The file.
        file: PathBuf,
        /// The reason for the error.
        reason: String,
        /// The origin of the field's value.
        origin: ValueOrigin,
    },
}

/// Returns "; did you mean `…`?" for the candidate nearest to `word`, or an empty text if none is near.
pub(crate) fn did_you_mean<'c>(word: &str, candidates: impl IntoIterator<Item = &'c str>) -> String {
    // The time grows with the length of the word, and a hostile file can hold a name of megabytes.
    const MAX_WORD_CHARS: usize = 64;
    let word: String = word.chars().take(MAX_WORD_CHARS).collect();
    // Two changes turn a word of three letters into almost any other.
    let chars = word.chars().count();
    let limit = if chars <= 3 { 1 } else { (chars / 3).max(2) };
    // Candidates can be full paths, but a typo concerns only their last part.
    let last_part = |c: &'c str| c.rsplit('.').next().unwrap_or(c);
    let nearest = candidates
        .into_iter()
        .map(|c| (osa_distance(&word, last_part(c)), c))
        .filter(|&(distance, _)| distance <= limit)
        .min_by_key(|&(distance, _)| distance);
    nearest.map_or_else(String::new, |(_, c)| format!("; did you mean `{c}`?"))
}

/// Formats names as a list in backticks, separated by commas; "(none)" without names.
pub fn quoted_list<'n>(names: impl IntoIterator<Item = &'n str>) -> String {
    let quoted: Vec<String> = names.into_iter().map(|n| format!("`{n}`")).collect();
    if quoted.is_empty() {
        "(none)".to_owned()
    } else {
        quoted.join(", ")
    }
}

/// Truncates `text` to its first line and to 60 characters; "…" marks a cut.
pub fn truncate(text: &str) -> String {
    const MAX_CHARS: usize = 60;
    let line = text.split(['\n', '\r']).next().unwrap_or_default();
    if line.len() == text.len() && line.chars().count() <= MAX_CHARS {
        text.to_owned()
    } else {
        line.chars().take(MAX_CHARS).chain("…".chars()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_similar_name_is_suggested() {
        assert_eq!(
            did_you_mean("dmax", ["kind", "d_max", "eta"]),
            "; did you mean `d_max`?"
        );
        assert_eq!(did_you_mean("alhpa", ["alpha", "duration"]), "; did you mean `alpha`?");
        assert_eq!(
            did_you_mean("d_max", ["ttis", "sensing.d_max"]),
            "; did you mean `sensing.d_max`?"
        );
        assert_eq!(did_you_mean("rnd", ["knn", "random"]), "");
        assert_eq!(did_you_mean("colour", ["alpha", "duration"]), "");
    }
}
