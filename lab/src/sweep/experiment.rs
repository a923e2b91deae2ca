//! An experiment: a scenario, fields with lists of values, and seeds. `ExperimentBuilder` checks and builds it, and
//! `SweepGrid` expands it to cells. Its TOML text identifies it in tables and journals: after a change of
//! [`Experiment::to_toml`], older sweeps can neither be resumed nor merged with new ones. `ExperimentFile` in
//! `experiment_builder.rs` reads the text; a new field belongs in both.

use std::io;
use std::path::{Path, PathBuf};

use reveille_bs::scenario::{declaration, flatten};
use reveille_common::declare::{Declaration, FieldType, FileError, Files, MAX_TEXT_BYTES, join_path};
use reveille_common::scenario::PRESETS;
use reveille_common::score::Metrics;
use toml::{Table, Value};

use super::error::SweepError;

/// The largest number of seeds of a cell; `executor.rs` and the journal store their indices as `u32`.
const MAX_SEEDS: u64 = 10_000_000;
/// The smallest number of runs between two checks of the intervals, and the unit to which it is rounded up. Each check
/// decides the number of runs of a cell, so a change changes result tables.
const MIN_RUNS_BETWEEN_CHECKS: u64 = 10;

/// A field of the scenario and its swept values.
#[derive(Clone, Debug, PartialEq)]
pub struct SweepAxis {
    /// The field's dotted path, such as `harvest.lambda`.
    pub path: String,
    /// The values, at least one.
    pub values: Vec<Value>,
    /// The origin of the axis, for messages.
    pub origin: String,
}

impl SweepAxis {
    /// The rank of the axis: preset, policy, N, TTIs, then the others by path; the first varies slowest. It fixes the
    /// order of cells in tables and shards.
    pub(super) fn rank(&self) -> (usize, &str) {
        let column = Self::COLUMNS.iter().position(|(path, _)| *path == self.path);
        (column.unwrap_or(Self::COLUMNS.len()), &self.path)
    }

    /// The fields that have a column in every table, with its name.
    pub(super) const COLUMNS: [(&'static str, &'static str); 4] = [
        ("preset", "preset"),
        ("policy.name", "policy"),
        ("devices", "n"),
        ("ttis", "ttis"),
    ];

    /// Whether the field has a column in every table.
    pub(crate) fn is_built_in(&self) -> bool {
        Self::COLUMNS.iter().any(|(path, _)| *path == self.path)
    }
}

/// The seeds of every cell: `first ..= first + count - 1`. All cells have the same seeds (common random numbers).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seeds {
    /// The first seed.
    pub first: u64,
    /// The number of seeds.
    pub count: u64,
}

impl Seeds {
    pub(super) fn check(self) -> Result<(), SweepError> {
        if self.count == 0 || self.count > MAX_SEEDS {
            let allowed = format!("must be a number of seeds from 1 to {MAX_SEEDS}");
            return Err(SweepError::invalid("seeds", self.count, allowed));
        }
        // Tables and TOML hold whole numbers as `i64`. The subtraction is safe, because the count is at least 1.
        let last = self.first.checked_add(self.count - 1);
        if last.is_none_or(|last| i64::try_from(last).is_err()) {
            let allowed = format!("with {} seeds the last one would be above {}", self.count, i64::MAX);
            return Err(SweepError::invalid("first_seed", self.first, allowed));
        }
        Ok(())
    }
}

/// The condition that ends a cell: the 95 % interval of each of these metrics is narrow. It is checked in the order of
/// seeds, after `min_seeds` runs, and again whenever the number of runs has grown by a quarter, rounded up to a
/// multiple of ten.
///
/// A cell with an accidentally small spread ends too early, and every check is another opportunity for this. Intervals
/// of cells that ended early therefore cover a little less than 95 %. A metric that is 0 in all runs is never narrow.
#[derive(Clone, Debug, PartialEq)]
pub struct UntilCi {
    /// The largest half-width over the mean, `(0, 1]`.
    pub target: f64,
    /// The metrics that must be that narrow; a metric that is undefined in every run does not count.
    pub metrics: Vec<String>,
    /// The number of runs before the first check, ≥ 2; a cell with fewer seeds is checked after all of them.
    pub min_seeds: u64,
}

impl UntilCi {
    /// The default number of runs before the first check. The help of `--min-seeds` and docs/command-line.md repeat it.
    pub(crate) const MIN_SEEDS: u64 = 30;

    /// Returns all metrics except `events` and differences. The mean of a difference may be 0, so a relative width has
    /// no meaning.
    pub(crate) fn default_metrics() -> Vec<String> {
        let metrics = Metrics::ALL[..Metrics::COUNT].iter();
        let chosen = metrics.filter(|metric| !metric.is_difference);
        chosen.map(|metric| metric.name.to_owned()).collect()
    }

    /// Returns the number of runs at the check after the one at `runs`, at most `count`.
    pub(crate) fn next_check(&self, runs: u64, count: u64) -> u64 {
        if runs < self.min_seeds {
            return self.min_seeds.min(count);
        }
        // Below 4 runs the quotient is 0, whose next multiple is 0.
        let added = (runs / 4)
            .next_multiple_of(MIN_RUNS_BETWEEN_CHECKS)
            .max(MIN_RUNS_BETWEEN_CHECKS);
        (runs + added).min(count)
    }
}

/// Returns whether `name` is the name of a metric.
pub(super) fn is_metric(name: &str) -> bool {
    Metrics::find(name).is_some()
}

/// The actions of every run of a sweep.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SweepActions {
    /// The path of a script, which [`super::SweepGrid::new`] reads.
    File(PathBuf),
    /// The lines of a script.
    Script(String),
}

/// The complete description of a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Experiment {
    /// A preset's name or a scenario file.
    pub scenario: String,
    /// The folder of a relative scenario file.
    pub base_dir: PathBuf,
    /// The copy of the scenario file in the folder of a sweep, which is read instead of the file. It does not belong to
    /// the identity of the experiment and is not in [`Experiment::to_toml`].
    pub scenario_copy: Option<PathBuf>,
    /// The fields set in all cells: path, value and origin.
    pub set: Vec<(String, Value, String)>,
    /// The swept fields; the first varies slowest.
    pub axes: Vec<SweepAxis>,
    /// The seeds of every cell; with `until_ci`, the largest number of them.
    pub seeds: Seeds,
    /// The condition that ends a cell; `None` to run all seeds.
    pub until_ci: Option<UntilCi>,
    /// The actions of every run, if any; a script once `SweepGrid::new` has read its file.
    pub actions: Option<SweepActions>,
    /// The warnings about former names of fields, each a sentence without its full stop.
    pub warnings: Vec<String>,
}

impl Experiment {
    /// The scenario's name for [`reveille_common::scenario::load`]: the name of a preset, or the path of a file.
    pub(super) fn scenario_source(&self) -> String {
        if let Some(copy) = &self.scenario_copy {
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

    /// Returns the text of the scenario file for use in another folder: its files are named with full paths. `None` for
    /// a preset. `files` opens it.
    ///
    /// # Errors
    /// If the file cannot be read any more.
    pub(super) fn scenario_text(&self, files: &dyn Files) -> io::Result<Option<String>> {
        let Some(text) = self.read_scenario_file(files)? else {
            return Ok(None);
        };
        let path = PathBuf::from(self.scenario_source());
        let table: Table = toml::from_str(&text).map_err(io::Error::other)?;
        // The parent of a bare file name is the empty path, which has no absolute form; `.` has one.
        let folder = files.absolute(&path.parent().unwrap_or(Path::new("")).join("."))?;
        let mut scenario = Value::Table(table);
        resolve_file_paths(&declaration(), "", &mut scenario, &folder);
        Ok(Some(scenario.as_table().map(Table::to_string).unwrap_or_default()))
    }

    /// Returns the fields of the scenario file as lines of TOML; `None` for a preset. Fields that name files are left
    /// out, and so are lists of tables, which can hold such fields: with them, the same scenario could have another
    /// text in another folder.
    ///
    /// # Errors
    /// If the file cannot be read any more.
    pub(super) fn scenario_fields(&self, files: &dyn Files) -> io::Result<Option<String>> {
        let Some(text) = self.read_scenario_file(files)? else {
            return Ok(None);
        };
        let declaration = declaration();
        let fields = flatten(&text).map_err(io::Error::other)?;
        let names_file = |path: &str, value: &str| is_file_field(&declaration, path, value.trim_matches('"'));
        let kept = fields
            .iter()
            .filter(|(path, value)| !names_file(path, value) && !value.starts_with("[{"));
        let lines: Vec<String> = kept.map(|(path, value)| format!("{path} = {value}\n")).collect();
        Ok(Some(lines.concat()))
    }

    /// Returns the text of the scenario file; `None` for a preset.
    fn read_scenario_file(&self, files: &dyn Files) -> io::Result<Option<String>> {
        if self.is_preset() {
            return Ok(None);
        }
        let path = PathBuf::from(self.scenario_source());
        let bytes = files.read(&path, MAX_TEXT_BYTES).map_err(|error| match error {
            FileError::Io(error) => error,
            FileError::Folder | FileError::Special | FileError::TooLong { .. } => io::Error::other(error),
        })?;
        String::from_utf8(bytes).map(Some).map_err(io::Error::other)
    }

    /// The number of cells of the grid: the product of the axes' lengths.
    pub(crate) fn cell_count(&self) -> u64 {
        let lengths = self.axes.iter().map(|axis| axis.values.len() as u64);
        lengths.fold(1, u64::saturating_mul)
    }

    /// Returns the experiment as TOML that reads back as the same experiment. Equal experiments have equal texts,
    /// regardless of their origin.
    pub fn to_toml(&self) -> String {
        let mut lines = vec![format!("scenario = {}", Value::String(self.scenario.clone()))];
        let value_list = |axis: &SweepAxis| Value::Array(axis.values.clone()).to_string();
        for (field, path) in [
            ("preset", "preset"),
            ("policies", "policy.name"),
            ("devices", "devices"),
            ("ttis", "ttis"),
        ] {
            let axis = self.axes.iter().find(|axis| axis.path == path);
            lines.extend(axis.map(|axis| format!("{field} = {}", value_list(axis))));
        }
        let Seeds { first, count } = self.seeds;
        lines.push(format!("seeds = {{ first = {first}, count = {count} }}"));
        if let Some(until) = &self.until_ci {
            // A bare 1 is refused on reading, because it may mean 1 %.
            lines.push(if until.target < 1.0 {
                format!("until_ci = {}", Value::Float(until.target))
            } else {
                "until_ci = \"100%\"".to_owned()
            });
            let names = until.metrics.iter().cloned().map(Value::String);
            lines.push(format!("ci_metrics = {}", Value::Array(names.collect())));
            // Written out, the default could exceed the number of seeds, which reading refuses.
            if until.min_seeds != UntilCi::MIN_SEEDS {
                lines.push(format!("min_seeds = {}", until.min_seeds));
            }
        }
        lines.extend(self.actions.as_ref().map(|actions| match actions {
            SweepActions::File(path) => format!("actions = {}", quoted(&path.to_string_lossy())),
            // The lines and not their file: a changed script is another experiment.
            SweepActions::Script(text) => format!("action_script = {}", quoted(text)),
        }));
        if !self.set.is_empty() {
            lines.push("\n[set]".to_owned());
            let set = self.set.iter();
            lines.extend(set.map(|(path, value, _)| format!("{} = {value}", quoted(path))));
        }
        let grid_axes: Vec<&SweepAxis> = self.axes.iter().filter(|axis| !axis.is_built_in()).collect();
        if !grid_axes.is_empty() {
            lines.push("\n[grid]".to_owned());
            lines.extend(
                grid_axes
                    .iter()
                    .map(|axis| format!("{} = {}", quoted(&axis.path), value_list(axis))),
            );
        }
        lines.join("\n") + "\n"
    }
}

/// Returns whether the field at `path` with this `value` names a file.
fn is_file_field(fields: &Declaration, path: &str, value: &str) -> bool {
    let field = fields
        .field_by_path(path)
        .or_else(|| fields.field_by_path(path.strip_prefix("class.")?));
    match field.map(|(_, field)| &field.field_type) {
        Some(FieldType::File) => !value.is_empty(),
        Some(FieldType::WordOrFile(words)) => !value.is_empty() && words.iter().all(|word| word.name != value),
        Some(_) | None => false,
    }
}

/// Resolves the relative paths of files against `folder`, in `value`: the field or table at `path`.
fn resolve_file_paths(fields: &Declaration, path: &str, value: &mut Value, folder: &Path) {
    match value {
        Value::String(file) if is_file_field(fields, path, file) => {
            *file = folder.join(&*file).to_string_lossy().into_owned();
        }
        Value::Table(inner) => {
            for (name, value) in inner {
                resolve_file_paths(fields, &join_path(path, name), value, folder);
            }
        }
        // Only the items of a list of tables; the values of an axis stay unchanged.
        Value::Array(items) => {
            let tables = items.iter_mut().filter(|item| item.is_table());
            tables.for_each(|item| resolve_file_paths(fields, path, item, folder));
        }
        Value::String(_) | Value::Integer(_) | Value::Float(_) | Value::Boolean(_) | Value::Datetime(_) => {}
    }
}

/// Describes the first line in which two experiments, as [`Experiment::to_toml`] returns them, or two scripts differ.
pub(super) fn describe_difference(own_text: &str, other_text: &str) -> String {
    let (mut own_lines, mut other_lines) = (own_text.lines(), other_text.lines());
    loop {
        let (own, other) = (own_lines.next(), other_lines.next());
        if own != other || own.is_none() {
            let shown = |line: Option<&str>| line.map_or("no line".to_owned(), |line| format!("`{line}`"));
            return format!("{} here, {} there", shown(own), shown(other));
        }
    }
}

fn quoted(text: &str) -> String {
    Value::String(text.to_owned()).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_fields_that_name_a_file_get_the_folder() {
        // Other fields also have the values `file` and `table`.
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
        resolve_file_paths(&declaration(), "", &mut value, Path::new("there"));
        assert_eq!(value["layout"]["file"].as_str(), Some("there/points.csv"));
        assert_eq!(value["layout"]["kind"].as_str(), Some("file"));
        assert_eq!(value["policy"]["q-learning"]["table"].as_str(), Some("there/own.json"));
        assert_eq!(
            value["class"][0]["harvest"]["trace"]["file"].as_str(),
            Some("there/sun.csv")
        );
        assert_eq!(value["class"][0]["name"].as_str(), Some("file"));
        let mut shipped = Value::Table("policy.q-learning.table = \"shipped\"".parse().expect("TOML"));
        resolve_file_paths(&declaration(), "", &mut shipped, Path::new("there"));
        assert_eq!(shipped["policy"]["q-learning"]["table"].as_str(), Some("shipped"));
    }
}
