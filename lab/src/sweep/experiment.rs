//! An experiment: a scenario, fields with lists of values, and seeds.

use std::io;
use std::path::{Path, PathBuf};

use reveille_bs::scenario::declaration;
use reveille_common::declare::{Declaration, FileError, Files, Form, LONGEST_TEXT, dotted};
use reveille_common::scenario::PRESETS;
use reveille_common::score::Metrics;
use toml::{Table, Value};

use super::error::SweepError;

/// The most seeds of a cell.
const MOST_SEEDS: u64 = 10_000_000;
/// Runs between two looks at the intervals, at the least.
const BATCH: u64 = 10;

/// A field of the scenario and the values that it takes in turn.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// The field's dotted path, such as `harvest.lambda`.
    pub path: String,
    /// Its values, at least one.
    pub values: Vec<Value>,
    /// Where the axis was asked for, for messages.
    pub origin: String,
}

impl Axis {
    /// The place among the axes: preset, policy, N, TTIs, then the others by path; the first varies slowest.
    pub(super) fn rank(&self) -> (usize, &str) {
        let known = Self::COLUMNS.iter().position(|(path, _)| *path == self.path);
        (known.unwrap_or(Self::COLUMNS.len()), &self.path)
    }

    /// Fields that have a column in every table, with its name.
    pub(super) const COLUMNS: [(&'static str, &'static str); 4] = [
        ("preset", "preset"),
        ("policy.name", "policy"),
        ("devices", "n"),
        ("ttis", "ttis"),
    ];

    /// Whether the field has a column in every table.
    pub fn is_built_in(&self) -> bool {
        Self::COLUMNS.iter().any(|(path, _)| *path == self.path)
    }
}

/// The seeds of every cell: `first ..= first + count - 1`. All cells have the same (common random numbers).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seeds {
    /// The first seed.
    pub first: u64,
    /// The number of seeds.
    pub count: u64,
}

impl Seeds {
    pub(super) fn check(self) -> Result<(), SweepError> {
        if self.count == 0 || self.count > MOST_SEEDS {
            let allowed = format!("must be a number of seeds from 1 to {MOST_SEEDS}");
            return Err(SweepError::invalid("seeds", self.count, allowed));
        }
        let last = self.first.checked_add(self.count - 1);
        if last.is_none_or(|last| i64::try_from(last).is_err()) {
            let allowed = format!("with {} seeds the last one would be above {}", self.count, i64::MAX);
            return Err(SweepError::invalid("first_seed", self.first, allowed));
        }
        Ok(())
    }
}

/// When a cell has enough runs: as soon as the 95 % interval of each of these metrics is narrow, looked at in the order
/// of seeds after `min_seeds` runs, then after every quarter more (at least ten).
///
/// A cell whose spread looks small by chance is stopped too soon, and every look gives chance another opportunity:
/// intervals of cells that were stopped early cover a little less than 95 %. A metric that is 0 in all runs is never
/// narrow.
#[derive(Clone, Debug, PartialEq)]
pub struct UntilCi {
    /// The half-width over the mean, `(0, 1]`.
    pub target: f64,
    /// The metrics that must be that narrow; one that is not defined in any run does not count.
    pub metrics: Vec<String>,
    /// Runs before the first look, ≥ 2; where a cell has fewer seeds, it is looked at when they are all there.
    pub min_seeds: u64,
}

impl UntilCi {
    /// Runs before the first look, where nothing else is asked for.
    pub const MIN_SEEDS: u64 = 30;

    /// All metrics with a column of their own but for differences: where the mean may be 0, a width has nothing to be
    /// relative to.
    pub fn default_metrics() -> Vec<String> {
        let metrics = Metrics::ALL[..Metrics::COUNT].iter();
        let chosen = metrics.filter(|metric| !metric.is_difference);
        chosen.map(|metric| metric.name.to_owned()).collect()
    }

    /// The number of runs at the look after the one at `runs`, of at most `count`.
    pub fn next_look(&self, runs: u64, count: u64) -> u64 {
        if runs < self.min_seeds {
            return self.min_seeds.min(count);
        }
        let more = (runs / 4).next_multiple_of(BATCH).max(BATCH);
        (runs + more).min(count)
    }
}

/// Whether `name` is a metric's.
pub(super) fn is_metric(name: &str) -> bool {
    Metrics::named(name).is_some()
}

/// What a sweep runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Experiment {
    /// A preset's name or a scenario file.
    pub scenario: String,
    /// Where a relative scenario file is looked for.
    pub base_dir: PathBuf,
    /// The copy of the scenario file that a sweep has left in its folder: read instead of the file. It is no part of
    /// what the experiment is, and not in [`Experiment::to_toml`].
    pub copy: Option<PathBuf>,
    /// Fields set in all cells: path, value and who set it.
    pub set: Vec<(String, Value, String)>,
    /// The swept fields; the first varies slowest.
    pub axes: Vec<Axis>,
    /// The seeds of every cell, or the most of them with `until_ci`.
    pub seeds: Seeds,
    /// When a cell has enough runs; `None` for all seeds.
    pub until_ci: Option<UntilCi>,
}

impl Experiment {
    /// The scenario's name for [`reveille_common::scenario::load`]: a preset's, or the path of a file.
    pub(super) fn source(&self) -> String {
        if let Some(copy) = &self.copy {
            return copy.to_string_lossy().into_owned();
        }
        if self.is_preset() || self.base_dir == Path::new("") {
            self.scenario.clone()
        } else {
            self.base_dir.join(&self.scenario).to_string_lossy().into_owned()
        }
    }

    fn is_preset(&self) -> bool {
        PRESETS.iter().any(|preset| preset.name == self.scenario)
    }

    /// The text of the scenario file, for a folder of its own: files that it names stand there with their full paths.
    /// `None` for a preset. `files` opens it.
    ///
    /// # Errors
    /// The file cannot be read any more.
    pub(super) fn scenario_text(&self, files: &dyn Files) -> io::Result<Option<String>> {
        if self.is_preset() {
            return Ok(None);
        }
        let path = PathBuf::from(self.source());
        let bytes = files.read(&path, LONGEST_TEXT).map_err(|error| match error {
            FileError::Io(error) => error,
            FileError::Folder | FileError::Special | FileError::TooLong { .. } => io::Error::other(error),
        })?;
        let text = String::from_utf8(bytes).map_err(io::Error::other)?;
        let table: Table = toml::from_str(&text).map_err(io::Error::other)?;
        let folder = files.absolute(&path.parent().unwrap_or(Path::new("")).join("."))?;
        let mut placed = Value::Table(table);
        place(&declaration(), "", &mut placed, &folder);
        Ok(Some(placed.as_table().map(Table::to_string).unwrap_or_default()))
    }

    /// Cells of the grid: the product of the axes' lengths.
    pub fn cell_count(&self) -> u64 {
        let lengths = self.axes.iter().map(|axis| axis.values.len() as u64);
        lengths.fold(1, u64::saturating_mul)
    }

    /// The experiment as TOML that reads back as the same experiment. Equal experiments have equal texts, whoever asked
    /// for them.
    pub fn to_toml(&self) -> String {
        let mut lines = vec![format!("scenario = {}", Value::String(self.scenario.clone()))];
        let list = |axis: &Axis| Value::Array(axis.values.clone()).to_string();
        for (field, path) in [
            ("preset", "preset"),
            ("policies", "policy.name"),
            ("devices", "devices"),
            ("ttis", "ttis"),
        ] {
            let axis = self.axes.iter().find(|axis| axis.path == path);
            lines.extend(axis.map(|axis| format!("{field} = {}", list(axis))));
        }
        let Seeds { first, count } = self.seeds;
        lines.push(format!("seeds = {{ first = {first}, count = {count} }}"));
        if let Some(until) = &self.until_ci {
            // A bare 1 is refused on reading: it may be meant as 1 %.
            lines.push(if until.target < 1.0 {
                format!("until_ci = {}", Value::Float(until.target))
            } else {
                "until_ci = \"100%\"".to_owned()
            });
            let names = until.metrics.iter().cloned().map(Value::String);
            lines.push(format!("ci_metrics = {}", Value::Array(names.collect())));
            // The default may be above the number of seeds, which who asks for it may not.
            if until.min_seeds != UntilCi::MIN_SEEDS {
                lines.push(format!("min_seeds = {}", until.min_seeds));
            }
        }
        if !self.set.is_empty() {
            lines.push("\n[set]".to_owned());
            let set = self.set.iter();
            lines.extend(set.map(|(path, value, _)| format!("{} = {value}", quoted(path))));
        }
        let others: Vec<&Axis> = self.axes.iter().filter(|axis| !axis.is_built_in()).collect();
        if !others.is_empty() {
            lines.push("\n[grid]".to_owned());
            lines.extend(
                others
                    .iter()
                    .map(|axis| format!("{} = {}", quoted(&axis.path), list(axis))),
            );
        }
        lines.join("\n") + "\n"
    }
}

/// Whether the field at `path` with this `value` names a file.
fn is_file(fields: &Declaration, path: &str, value: &str) -> bool {
    let field = fields
        .field_at(path)
        .or_else(|| fields.field_at(path.strip_prefix("class.")?));
    match field.map(|(_, field)| &field.form) {
        Some(Form::File) => !value.is_empty(),
        Some(Form::Source(words)) => !value.is_empty() && words.iter().all(|word| word.name != value),
        Some(_) | None => false,
    }
}

/// Puts `folder` in front of the relative files in the field or table at `path`.
fn place(fields: &Declaration, path: &str, value: &mut Value, folder: &Path) {
    match value {
        Value::String(file) if is_file(fields, path, file) => {
            *file = folder.join(&*file).to_string_lossy().into_owned();
        }
        Value::Table(inner) => {
            for (name, value) in inner {
                place(fields, &dotted(path, name), value, folder);
            }
        }
        // The items of a list of tables; the values of an axis stay as they are.
        Value::Array(items) => {
            let tables = items.iter_mut().filter(|item| item.is_table());
            tables.for_each(|item| place(fields, path, item, folder));
        }
        Value::String(_) | Value::Integer(_) | Value::Float(_) | Value::Boolean(_) | Value::Datetime(_) => {}
    }
}

fn quoted(path: &str) -> String {
    Value::String(path.to_owned()).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_that_names_a_file_is_placed_and_no_other() {
        let text = r#"
            layout = { kind = "file", file = "points.csv" }
            policy = { name = "q-learning", q-learning = { table = "own.json" } }
            [[class]]
            name = "file"
            harvest = { kind = "trace", trace = { file = "sun.csv" } }
            [[class]]
            name = "table"
        "#;
        let mut value = Value::Table(text.parse().expect("TOML"));
        place(&declaration(), "", &mut value, Path::new("there"));
        assert_eq!(value["layout"]["file"].as_str(), Some("there/points.csv"));
        assert_eq!(value["layout"]["kind"].as_str(), Some("file"));
        assert_eq!(value["policy"]["q-learning"]["table"].as_str(), Some("there/own.json"));
        assert_eq!(
            value["class"][0]["harvest"]["trace"]["file"].as_str(),
            Some("there/sun.csv")
        );
        assert_eq!(value["class"][0]["name"].as_str(), Some("file"));
        let mut word = Value::Table("policy.q-learning.table = \"shipped\"".parse().expect("TOML"));
        place(&declaration(), "", &mut word, Path::new("there"));
        assert_eq!(word["policy"]["q-learning"]["table"].as_str(), Some("shipped"));
    }
}
