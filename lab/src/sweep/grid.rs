//! The cells of an experiment, each with a checked scenario. Sweeps, `train record` and the Python package run them.
//! Journals and shards name a cell by its number, so the order of the cells must not change.

use std::sync::Arc;

use reveille_bs::scenario::{Override, Scenario, ScenarioError, load_with_files};
use reveille_common::declare::Files;
use sha2::{Digest as _, Sha256};
use toml::Value as Toml;

use super::error::SweepError;
use super::experiment::{Experiment, SweepActions, SweepAxis};
use super::shard::Shard;
use crate::action_script;
use crate::external_inputs::ExternalInputs;
use crate::table::{ColumnType, Hash, Schema, SweptValue};

/// The largest number of cells. Casts of cell numbers to `u32` in `executor` and `folder` rely on it.
const MAX_CELLS: u64 = 100_000;
/// The largest number of runs of a sweep. A sweep keeps all of them in memory.
const MAX_RUNS: u64 = 100_000_000;

/// One cell: a scenario except for its seed.
#[derive(Clone, Debug)]
pub struct GridCell {
    /// The cell's label in messages, progress and JSON: `knn, devices = 50, harvest.lambda = 0.05`. Errors put it after
    /// the words `the cell`.
    pub label: String,
    /// The values of the swept columns.
    pub swept: Arc<[SweptValue]>,
    /// The scenario with the first seed.
    pub scenario: Scenario,
    /// The warnings about the experiment, the same in each cell, and about the scenario; a sentence each, without its
    /// stop.
    pub warnings: Vec<String>,
}

impl GridCell {
    /// Returns the scenario of the run with `seed`.
    pub fn with_seed(&self, seed: u64) -> Scenario {
        self.scenario.with_seed(seed)
    }

    /// The approximate number of device-TTIs of a run, for estimates of time. It includes the first pilot runs of a
    /// policy that searches with pilot runs.
    pub fn device_ttis(&self) -> u64 {
        let search = self.scenario.policy.settings().pilot_search();
        let pilot_ttis = search.map_or(0, |search| {
            search.initial_ttis.saturating_mul(search.candidates.len() as u64)
        });
        let ttis = self.scenario.run.ttis.saturating_add(pilot_ttis);
        ttis.saturating_mul(u64::from(self.scenario.run.devices))
    }
}

/// All cells of an experiment, in its order.
#[derive(Clone, Debug)]
pub struct SweepGrid {
    /// The experiment.
    pub experiment: Experiment,
    /// The columns of the table.
    pub schema: Schema,
    /// The cells.
    pub cells: Vec<GridCell>,
}

impl SweepGrid {
    /// Creates the grid of `experiment` and checks every scenario; `files` opens the scenario files. In the grid's
    /// experiment, the lines of a script of actions replace its path ([`SweepActions::Script`]).
    ///
    /// # Errors
    /// If a value is listed twice, the grid is too large, the scenario of a cell is invalid, or an action is impossible
    /// in a cell; the message names the field.
    pub fn new(mut experiment: Experiment, files: &dyn Files) -> Result<Self, SweepError> {
        // Before any cell is built: a few long lists multiply to more cells than memory holds.
        check_size(&experiment)?;
        let columns = experiment.axes.iter().map(swept_column);
        let columns: Vec<(String, Vec<SweptValue>)> = columns.collect::<Result<_, _>>()?;
        let schema = Schema {
            swept: experiment
                .axes
                .iter()
                .zip(&columns)
                .filter(|(axis, _)| !axis.is_built_in())
                .map(|(axis, (_, values))| (axis.path.clone(), values[0].column_type()))
                .collect(),
        };
        let shared_overrides = overrides_of_all_cells(&experiment)?;
        let mut cells = Vec::new();
        for number in 0..experiment.cell_count() {
            cells.push(build_cell(&experiment, &columns, &shared_overrides, number, files)?);
        }
        if let Some(actions) = &mut experiment.actions {
            read_actions(actions, &mut cells, files)?;
        }
        Ok(Self {
            experiment,
            schema,
            cells,
        })
    }

    /// Returns the actions of the run of `scenario`, the scenario of a cell with one of the seeds.
    ///
    /// # Panics
    /// If the script is not valid for the cell; [`Self::new`] has checked it.
    pub fn inputs(&self, scenario: &Scenario) -> ExternalInputs {
        let Some(SweepActions::Script(text)) = &self.experiment.actions else {
            return ExternalInputs::default();
        };
        // Seeds change the times of random actions only, never whether an action is possible.
        let actions = action_script::parse(text, scenario).expect("checked with the first seed");
        ExternalInputs::from_actions(&actions)
    }

    /// Checks that the experiment permits `shard`. Every experiment permits [`Shard::WHOLE`].
    ///
    /// # Errors
    /// If `shard` is a part of the sweep and the experiment has `until_ci`.
    pub fn check_shard(&self, shard: Shard) -> Result<(), SweepError> {
        if shard == Shard::WHOLE || self.experiment.until_ci.is_none() {
            return Ok(());
        }
        let requirement = "excludes until_ci: no shard has all runs of a cell, so a shard cannot decide when the cell \
            is complete; set only one of them";
        Err(SweepError::invalid("shard", shard, requirement))
    }

    /// Returns a SHA-256 over the first-seed scenarios of all cells, in order; the number of seeds does not enter.
    /// Result tables and the identity of journals hold it: after a change, old shards do not merge and old sweeps do
    /// not resume.
    pub fn fingerprint(&self) -> Hash {
        let mut hasher = Sha256::new();
        for cell in &self.cells {
            hasher.update(cell.scenario.hash());
        }
        Hash(hasher.finalize().into())
    }

    /// The number of runs of the whole experiment; with `until_ci` the largest possible number.
    pub fn run_count(&self) -> u64 {
        self.cells.len() as u64 * self.experiment.seeds.count
    }

    /// Returns the number of runs that belong to `shard`.
    pub fn shard_run_count(&self, shard: Shard) -> u64 {
        shard.run_count(self.cells.len() as u64, self.experiment.seeds.count)
    }
}

/// Checks the numbers of cells and runs, from the lengths of the lists alone.
pub(super) fn check_size(experiment: &Experiment) -> Result<(), SweepError> {
    let (cells, seeds) = (experiment.cell_count(), experiment.seeds.count);
    if cells > MAX_CELLS {
        let requirement = format!("a grid has at most {MAX_CELLS} cells; sweep fewer fields");
        return Err(SweepError::invalid("cells", cells, requirement));
    }
    let runs = cells.saturating_mul(seeds);
    if runs > MAX_RUNS {
        let requirement = format!(
            "{cells} cells × {seeds} seeds, but a sweep has at most {MAX_RUNS} runs; use fewer seeds \
             (--seeds), or split the grid"
        );
        return Err(SweepError::invalid("runs", runs, requirement));
    }
    Ok(())
}

/// Reads the script of `actions`, checks it in all `cells`, and replaces a path in `actions` by the lines. The first
/// cell with doubtful actions gets the warnings.
fn read_actions(actions: &mut SweepActions, cells: &mut [GridCell], files: &dyn Files) -> Result<(), SweepError> {
    let refused = |name: String, reason: String| SweepError::Actions { name, reason };
    let (name, text) = match actions {
        SweepActions::File(path) => {
            let name = format!("--actions {}", path.display());
            let text = action_script::read(path, files).map_err(|reason| refused(name.clone(), reason))?;
            (name, text)
        }
        SweepActions::Script(text) => ("action_script".to_owned(), std::mem::take(text)),
    };
    let mut has_warned = false;
    for cell in cells {
        let parsed = action_script::parse(&text, &cell.scenario);
        let parsed = parsed.map_err(|error| refused(name.clone(), format!("{error}; in the cell {}", cell.label)))?;
        if !has_warned {
            let warnings = action_script::warnings(&parsed, &cell.scenario);
            has_warned = !warnings.is_empty();
            let in_cell = |warning| format!("{name}: {warning}; in the cell {}", cell.label);
            cell.warnings.extend(warnings.into_iter().map(in_cell));
        }
    }
    *actions = SweepActions::Script(text);
    Ok(())
}

/// Returns the path of an axis, and its values in the type of their column.
fn swept_column(axis: &SweepAxis) -> Result<(String, Vec<SweptValue>), SweepError> {
    let values: Vec<SweptValue> = axis.values.iter().map(swept_value).collect();
    let column_type = values
        .iter()
        .map(SweptValue::column_type)
        .reduce(ColumnType::join)
        .unwrap_or(ColumnType::Text);
    let values: Vec<SweptValue> = values.into_iter().map(|value| value.into_type(column_type)).collect();
    for (index, value) in values.iter().enumerate() {
        if values[..index].contains(value) {
            let requirement = format!("is listed twice; set by {}", axis.origin);
            return Err(SweepError::invalid(&axis.path, value, requirement));
        }
    }
    Ok((axis.path.clone(), values))
}

fn swept_value(value: &Toml) -> SweptValue {
    match value {
        Toml::Integer(number) => SweptValue::Int(*number),
        Toml::Float(number) => SweptValue::Float(*number),
        Toml::String(text) => SweptValue::Text(text.clone()),
        Toml::Boolean(_) | Toml::Datetime(_) | Toml::Array(_) | Toml::Table(_) => SweptValue::Text(value.to_string()),
    }
}

fn overrides_of_all_cells(experiment: &Experiment) -> Result<Vec<Override>, SweepError> {
    let fields = experiment.set.iter();
    fields
        .map(|(path, value, origin)| Override::from_flag(origin, path, &value.to_string()))
        .collect::<Result<_, _>>()
        // The error puts this text after `the cell`.
        .map_err(|error| scenario_error("of every seed", error))
}

fn scenario_error(cell: &str, error: ScenarioError) -> SweepError {
    SweepError::Scenario {
        cell: cell.to_owned(),
        error: Box::new(error),
    }
}

/// Builds the cell `number`, from 0. `columns` holds the values of all axes, as [`swept_column`] returns them.
fn build_cell(
    experiment: &Experiment,
    columns: &[(String, Vec<SweptValue>)],
    shared_overrides: &[Override],
    number: u64,
    files: &dyn Files,
) -> Result<GridCell, SweepError> {
    let mut quotient = usize::try_from(number).unwrap_or(usize::MAX);
    let mut value_indices = vec![0; experiment.axes.len()];
    // The number in mixed radix, from its last digit: the first axis varies slowest.
    for (value_index, axis) in value_indices.iter_mut().zip(&experiment.axes).rev() {
        *value_index = quotient % axis.values.len();
        quotient /= axis.values.len();
    }
    let mut overrides = shared_overrides.to_vec();
    let (mut label_parts, mut swept) = (Vec::new(), Vec::new());
    for ((axis, (_, values)), &value_index) in experiment.axes.iter().zip(columns).zip(&value_indices) {
        label_parts.push(match axis.path.as_str() {
            "preset" | "policy.name" => values[value_index].to_string(),
            path => format!("{path} = {}", values[value_index]),
        });
        if !axis.is_built_in() {
            swept.push(values[value_index].clone());
        }
        let text = axis.values[value_index].to_string();
        let value_override = Override::from_flag(&axis.origin, &axis.path, &text);
        overrides.push(value_override.map_err(|error| scenario_error(&label_parts.join(", "), error))?);
    }
    let label = if label_parts.is_empty() {
        "of the scenario as it is".to_owned()
    } else {
        label_parts.join(", ")
    };
    let first_seed = experiment.seeds.first.to_string();
    let seed_override = Override::from_flag("--first-seed", "seed", &first_seed);
    overrides.push(seed_override.map_err(|error| scenario_error(&label, error))?);
    let loaded = load_with_files(&experiment.scenario_source(), &overrides, files);
    let loaded = loaded.map_err(|error| scenario_error(&label, error))?;
    Ok(GridCell {
        label,
        swept: Arc::from(swept),
        scenario: loaded.scenario,
        warnings: experiment.warnings.iter().cloned().chain(loaded.warnings).collect(),
    })
}
