//! Why a scenario was refused, in one sentence that a user can act on.

use std::io;
use std::path::PathBuf;

use super::places::Place;

/// A scenario that cannot be used, and why.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The source is no preset's name and no file's path.
    #[error("no scenario `{name}`: it is neither a file nor a preset{hint}; the presets are {presets}")]
    NoSuchScenario {
        /// What was asked for.
        name: String,
        /// "; did you mean …", or nothing.
        hint: String,
        /// The presets there are.
        presets: String,
    },
    /// The scenario file cannot be read.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The scenario file.
        path: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
    /// The text is not TOML.
    #[error("{name}, line {line}: not valid TOML: {reason}")]
    Syntax {
        /// The file's name.
        name: String,
        /// The line, from 1.
        line: usize,
        /// What the TOML parser said.
        reason: String,
    },
    /// An override is not of the form `path.to.field=value`.
    #[error("{flag} {text}: {reason}")]
    Override {
        /// The option of the command line.
        flag: String,
        /// Its argument.
        text: String,
        /// What is wrong with it.
        reason: String,
    },
    /// There is no such field.
    #[error("unknown field `{field}`{hint}; {place}; the fields there are {valid}")]
    UnknownField {
        /// Its full path.
        field: String,
        /// "; did you mean …", or nothing.
        hint: String,
        /// The fields of the section that it is in.
        valid: String,
        /// Where it was set.
        place: Place,
    },
    /// A value is of the wrong type or out of its range.
    #[error("{field} = {value}: {allowed}; {place}")]
    Invalid {
        /// The field's full path.
        field: String,
        /// Its value.
        value: String,
        /// What it has to be.
        allowed: String,
        /// Where it was set.
        place: Place,
    },
    /// A field that the scenario needs has no value.
    #[error("{field}: required {why}")]
    Missing {
        /// The field's full path.
        field: String,
        /// What makes it required, and where that was set.
        why: String,
    },
    /// A field that the rest of the scenario leaves without effect.
    #[error("{field}: has an effect only with {holds}; leave it out, or set that; {place}")]
    Idle {
        /// The field's full path.
        field: String,
        /// The setting under which it counts.
        holds: String,
        /// Where it was set.
        place: Place,
    },
    /// A layout or trace file cannot be used.
    #[error("{field} = \"{}\": {reason}; {place}", file.display())]
    Data {
        /// The field that names the file.
        field: String,
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: String,
        /// Where the field was set.
        place: Place,
    },
}

/// "; did you mean `…`?" for the candidates nearest to `word`, or nothing where none is near.
pub fn did_you_mean<'c>(word: &str, candidates: impl IntoIterator<Item = &'c str>) -> String {
    let limit = (word.chars().count() / 3).max(2);
    let leaf = |c: &'c str| c.rsplit('.').next().unwrap_or(c);
    let nearest = candidates
        .into_iter()
        .map(|c| (edit_distance(word, leaf(c)), c))
        .filter(|&(distance, _)| distance <= limit)
        .min_by_key(|&(distance, _)| distance);
    nearest.map_or_else(String::new, |(_, c)| format!("; did you mean `{c}`?"))
}

/// `a`, `b` and `c` in backticks.
pub fn listed<'n>(names: impl IntoIterator<Item = &'n str>) -> String {
    let quoted: Vec<String> = names.into_iter().map(|n| format!("`{n}`")).collect();
    if quoted.is_empty() {
        "(none)".to_owned()
    } else {
        quoted.join(", ")
    }
}

/// `text` cut to a length that fits a message.
pub fn shortened(text: &str) -> String {
    const LONGEST: usize = 60;
    let line = text.split(['\n', '\r']).next().unwrap_or_default();
    if line.len() == text.len() && line.chars().count() <= LONGEST {
        text.to_owned()
    } else {
        line.chars().take(LONGEST).chain("…".chars()).collect()
    }
}

/// The least number of letters to insert, delete, replace or swap with their neighbour (of the first 64).
fn edit_distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().take(64).collect(), b.chars().take(64).collect());
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 1..=a.len() {
        let mut row = vec![i];
        for j in 1..=b.len() {
            let replaced = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            let mut least = replaced.min(rows[i - 1][j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                least = least.min(rows[i - 2][j - 2] + 1);
            }
            row.push(least);
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_name_is_suggested() {
        assert_eq!(
            did_you_mean("dmax", ["kind", "d_max", "eta"]),
            "; did you mean `d_max`?"
        );
        assert_eq!(did_you_mean("alhpa", ["alpha", "duration"]), "; did you mean `alpha`?");
        assert_eq!(
            did_you_mean("d_max", ["ttis", "sensing.d_max"]),
            "; did you mean `sensing.d_max`?"
        );
        assert_eq!(did_you_mean("colour", ["alpha", "duration"]), "");
    }

    #[test]
    fn distances_count_single_edits() {
        for (a, b, distance) in [
            ("", "abc", 3),
            ("kitten", "sitting", 3),
            ("ab", "ba", 1),
            ("same", "same", 0),
        ] {
            assert_eq!(edit_distance(a, b), distance, "{a} {b}");
        }
    }
}
