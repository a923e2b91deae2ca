//! Result tables merged for figures and judging: runs by condition, policy and N. Everything that is drawn or judged
//! from tables is read through [`RunCondition`].
//!
//! Figures use [`Results::conditions`], in which rankings of wake-ups are series of one condition; the report uses
//! [`Results::by_ranking`]. A condition has a scenario only if the scenario's hash equals the hash in the table.
//!
//! [`RunCondition::label`] and [`LabelledTable`] end up in the report, in docs/reproduction.md, which the report fills,
//! and in the output of `reveille compare`. The fields of conditions are also columns of sweep figures, and parts of
//! file names (`file_labels`).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use reveille_bs::policy::registry;
use reveille_bs::scenario::{Override, Scenario, compare_scenarios, flatten, load_with_files};
use reveille_common::declare::Files;
use sha2::{Digest as _, Sha256};

use super::error::FigureError;
use crate::claims::POLICIES;
use reveille_lab::metric_estimate::MetricEstimate;
use reveille_lab::series::{self, RANKING, SeriesNames};
use reveille_lab::stats::{CellRuns, Estimate, group_by_cell};
use reveille_lab::table::{Hash, ResultRow, Table, TableMetadata};

/// Summary of a result table.
#[derive(Clone, Debug)]
pub struct LabelledTable {
    /// Name of the file that the table was read from.
    pub name: String,
    /// Metadata on the table's origin.
    pub metadata: TableMetadata,
    /// Number of runs.
    pub run_count: usize,
    /// Name of the series of the first run in this table alone, by default the reference of `reveille compare`. An
    /// empty table has `None`.
    pub first_series: Option<String>,
    /// SHA-256 over the digests of the runs, in table order, hexadecimal.
    pub digest_hash: String,
}

/// The preset, length and changed fields that runs share; their policies, N and seeds may differ. A `policy` in its
/// methods is the name of a series, as in [`Self::policies`]. A new setting also needs a line in `has_same_settings`
/// and in `without_ranking`.
#[derive(Clone, Debug)]
pub struct RunCondition {
    /// Preset name.
    pub preset: String,
    /// Length of the runs K, TTIs.
    pub ttis: u64,
    /// Swept fields with their values.
    pub swept_fields: Vec<(String, String)>,
    /// Fields whose value in the experiment differs from the preset, with their values.
    pub changed_fields: Vec<(String, String)>,
    /// Name of the table, if its scenarios differ from their preset in unknown fields.
    pub changed_in_table: Option<String>,
    /// Script of actions of every run; `None` for runs without actions.
    pub actions: Option<ActionScript>,
    /// Scenario of the first run; `None` if it cannot be reconstructed, or if actions change its runs.
    pub scenario: Option<Scenario>,
    /// Whether all runs use the preset unchanged and no actions. For policies unknown here, only actions count.
    is_preset: bool,
    /// Indices in [`Results::by_ranking`] of the conditions merged into this one; empty for the conditions there.
    pub ranking_indices: Vec<usize>,
    /// Runs by series and N, each in seed order.
    runs: RunsBySeries,
}

/// The script of actions of a table's runs.
#[derive(Clone, Debug)]
pub struct ActionScript {
    /// Text of the script.
    pub text: String,
    /// Name of the first table with this script.
    pub table: String,
}

/// Runs by series and N, each in seed order.
type RunsBySeries = BTreeMap<(String, u32), BTreeMap<u64, Arc<ResultRow>>>;

/// The merged tables.
#[derive(Clone, Debug)]
pub struct Results {
    /// Summaries of the tables.
    pub tables: Vec<LabelledTable>,
    /// Conditions in the order in which tables introduce them. Conditions that differ only in the ranking of wake-ups
    /// are merged, with one series per policy and ranking, so that figures compare like with like.
    pub conditions: Vec<RunCondition>,
    /// Conditions with one entry per ranking. Policies have the names that the paper's claims use.
    pub by_ranking: Vec<RunCondition>,
}

impl Results {
    /// Merges `tables`. A run that occurs in several tables counts once. `files` opens the files that their scenarios
    /// name.
    ///
    /// # Errors
    /// The tables hold no run, or two outcomes of one run.
    pub fn new(tables: &[(String, Table)], files: &dyn Files) -> Result<Self, FigureError> {
        let mut results = Self {
            tables: Vec::new(),
            conditions: Vec::new(),
            by_ranking: Vec::new(),
        };
        for (name, table) in tables {
            results.tables.push(LabelledTable {
                name: name.clone(),
                metadata: table.metadata.clone(),
                run_count: table.rows.len(),
                first_series: table.rows.first().map(|row| SeriesNames::from_table(table).name(row)),
                digest_hash: hash_of_digests(table),
            });
            results.add_table(name, table, files)?;
        }
        if results.by_ranking.is_empty() {
            let names: Vec<&str> = tables.iter().map(|(name, _)| name.as_str()).collect();
            return Err(FigureError::NoRuns {
                tables: names.join(", "),
            });
        }
        results.conditions = merge_rankings(&results.by_ranking);
        Ok(results)
    }

    fn add_table(&mut self, name: &str, table: &Table, files: &dyn Files) -> Result<(), FigureError> {
        let cells = group_by_cell(table);
        let swept_of = |cell: &CellRuns<'_>| {
            let fields = table.schema.swept.iter().map(|(path, _)| path.clone());
            fields
                .zip(cell.swept.iter().map(ToString::to_string))
                .collect::<Vec<_>>()
        };
        let mut set_fields = fields_set_by(&table.metadata.experiment);
        // All policies of a table share its changes, even a change that affects one policy, so that they stay together.
        let scenario_with = |cell: &CellRuns<'_>, set_fields: &[(String, String)]| {
            reconstruct_scenario(cell.rows[0], &swept_of(cell), set_fields, files)
        };
        // The scenario of a policy unknown to this program cannot be loaded, so its cells decide nothing here.
        let cells_of_known_policies = || cells.iter().filter(|cell| registry::named(cell.policy).is_some());
        // Scenarios do not contain actions, which make runs of the same scenario differ.
        let actions = table.metadata.action_script().map(|text| ActionScript {
            text,
            table: name.to_owned(),
        });
        if let Some(scenario_fields) = &table.metadata.scenario_fields {
            let with_file = |cell: &CellRuns<'_>| {
                let all_fields = [fields_of_file(scenario_fields, &swept_of(cell)), set_fields.clone()].concat();
                changes_from_preset(cell.rows[0], &scenario_with(cell, &all_fields)?, &swept_of(cell), files)
            };
            let by_cell: Option<Vec<_>> = cells_of_known_policies().map(with_file).collect();
            let changes: Option<BTreeMap<String, String>> = by_cell.map(|cells| cells.into_iter().flatten().collect());
            set_fields = changes.map_or(set_fields, |changes| changes.into_iter().collect());
        }
        let has_only_swept_fields = cells_of_known_policies().all(|cell| scenario_with(cell, &[]).is_some());
        let has_known_changes = cells_of_known_policies().all(|cell| scenario_with(cell, &set_fields).is_some());
        let changes = if has_known_changes && !has_only_swept_fields {
            set_fields
        } else {
            Vec::new()
        };
        let changed_in_table = (!has_known_changes && !has_only_swept_fields).then(|| name.to_owned());
        for cell in cells {
            let is_known_policy = registry::named(cell.policy).is_some();
            let is_unchanged = actions.is_none()
                && (!is_known_policy || reconstruct_scenario(cell.rows[0], &[], &[], files).is_some());
            let new_condition = RunCondition {
                preset: cell.preset.to_owned(),
                ttis: cell.ttis,
                changed_fields: changes.clone(),
                changed_in_table: changed_in_table.clone(),
                actions: actions.clone(),
                scenario: scenario_with(&cell, &changes).filter(|_| changed_in_table.is_none() && actions.is_none()),
                swept_fields: swept_of(&cell),
                is_preset: true,
                ranking_indices: Vec::new(),
                runs: BTreeMap::new(),
            };
            let existing = self.by_ranking.iter().position(|c| c.has_same_settings(&new_condition));
            let index = existing.unwrap_or_else(|| {
                self.by_ranking.push(new_condition);
                self.by_ranking.len() - 1
            });
            self.by_ranking[index].is_preset &= is_unchanged;
            let runs_by_series = &mut self.by_ranking[index].runs;
            let runs_by_seed = runs_by_series.entry((cell.policy.to_owned(), cell.n)).or_default();
            for row in cell.rows {
                // Condition, policy, N and seed identify a run, so a second outcome contradicts the first.
                if let Some(previous) = runs_by_seed.insert(row.seed, Arc::new(row.clone()))
                    && previous.digest != row.digest
                {
                    return Err(FigureError::Contradiction {
                        scenario: row.scenario_hash.to_string(),
                        first: previous.digest.to_string(),
                        second: row.digest.to_string(),
                    });
                }
            }
        }
        Ok(())
    }
}

/// Merges the conditions of `by_ranking` that differ only in the ranking of wake-ups, the paper's ranking first.
fn merge_rankings(by_ranking: &[RunCondition]) -> Vec<RunCondition> {
    let mut groups: Vec<(RunCondition, Vec<usize>)> = Vec::new();
    for (index, condition) in by_ranking.iter().enumerate() {
        let without_ranking = condition.without_ranking();
        match groups
            .iter_mut()
            .find(|(group, _)| group.has_same_settings(&without_ranking))
        {
            Some((_, indices)) => indices.push(index),
            None => groups.push((without_ranking, vec![index])),
        }
    }
    let merge = |(without_ranking, mut indices): (RunCondition, Vec<usize>)| {
        if let [single] = indices[..] {
            return RunCondition {
                ranking_indices: indices,
                ..by_ranking[single].clone()
            };
        }
        // The paper's ranking comes first: policies with equal runs under another ranking are left out.
        indices.sort_by_key(|index| !series::is_paper_ranking(&by_ranking[*index].ranking()));
        let mut runs = RunsBySeries::new();
        for index in &indices {
            let ranking = by_ranking[*index].ranking();
            for ((policy, n), runs_by_seed) in &by_ranking[*index].runs {
                let key = (series::join_name(policy, &ranking), *n);
                let by_paper_ranking = runs.get(&(policy.clone(), *n)).filter(|_| key.0 != *policy);
                let rows = || runs_by_seed.values().map(Arc::as_ref);
                if !by_paper_ranking
                    .is_some_and(|of_paper| series::has_equal_outcomes(of_paper.values().map(Arc::as_ref), rows()))
                {
                    runs.entry(key).or_default().extend(runs_by_seed.clone());
                }
            }
        }
        RunCondition {
            scenario: by_ranking[indices[0]].scenario.clone(),
            is_preset: by_ranking[indices[0]].is_preset,
            ranking_indices: indices,
            runs,
            ..without_ranking
        }
    };
    groups.into_iter().map(merge).collect()
}

fn hash_of_digests(table: &Table) -> String {
    let mut hasher = Sha256::new();
    for row in &table.rows {
        hasher.update(row.digest.0);
    }
    Hash(hasher.finalize().into()).to_string()
}

/// Returns fields and values that the experiment `text` sets for all its runs; empty if it cannot be parsed.
fn fields_set_by(text: &str) -> Vec<(String, String)> {
    let Ok(experiment) = text.parse::<toml::Table>() else {
        return Vec::new();
    };
    let set_fields = experiment.get("set").and_then(toml::Value::as_table);
    let to_text = |value: &toml::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let set_fields = set_fields.into_iter().flatten();
    set_fields.map(|(path, value)| (path.clone(), to_text(value))).collect()
}

/// Fields of a scenario file that have a column in every table, or only name the preset.
const COLUMN_FIELDS: [&str; 5] = ["preset", "devices", "ttis", "seed", "policy.name"];

/// Returns the fields of a scenario file that the columns of a table, `swept` included, do not set; empty if the `text`
/// cannot be parsed.
fn fields_of_file(text: &str, swept: &[(String, String)]) -> Vec<(String, String)> {
    let fields = flatten(text).unwrap_or_default();
    let is_column = |field: &str| COLUMN_FIELDS.contains(&field) || swept.iter().any(|(path, _)| path == field);
    fields.into_iter().filter(|(field, _)| !is_column(field)).collect()
}

/// Returns the fields of the scenario of `row` that differ from its preset, apart from `swept` ones; `None` if a value
/// cannot be read. A field of the preset without effect in `scenario` is left out.
fn changes_from_preset(
    row: &ResultRow,
    scenario: &Scenario,
    swept: &[(String, String)],
    files: &dyn Files,
) -> Option<Vec<(String, String)>> {
    let preset = load_with_files(&row.preset, &row_overrides(row, swept)?, files).ok()?;
    let differences = compare_scenarios(&preset.scenario.to_toml(), &scenario.to_toml()).ok()?;
    let with_effect = differences.into_iter().filter(|(_, _, value)| value != "none");
    Some(with_effect.map(|(field, _, value)| (field, value)).collect())
}

/// Returns the scenario of `row`, if the preset with the table's columns, `swept` and `assignments` reproduces its
/// hash.
fn reconstruct_scenario(
    row: &ResultRow,
    swept: &[(String, String)],
    assignments: &[(String, String)],
    files: &dyn Files,
) -> Option<Scenario> {
    let overrides = row_overrides(row, &[assignments, swept].concat())?;
    let scenario = load_with_files(&row.preset, &overrides, files).ok()?.scenario;
    // The hash covers every setting of a run, so equal hashes rule out any other change.
    (scenario.hash() == row.scenario_hash.0).then_some(scenario)
}

/// Returns the overrides of the run in `row` with the other `fields`; `None` if one cannot be parsed.
fn row_overrides(row: &ResultRow, fields: &[(String, String)]) -> Option<Vec<Override>> {
    let assignments = fields.iter().map(|(path, value)| format!("{path}={value}"));
    let row_assignments = [
        format!("policy.name={}", row.policy),
        format!("devices={}", row.n),
        format!("ttis={}", row.ttis),
        format!("seed={}", row.seed),
    ];
    let overrides = assignments.chain(row_assignments).map(|text| Override::parse(&text));
    overrides.collect::<Result<_, _>>().ok()
}

impl RunCondition {
    fn has_same_settings(&self, other: &Self) -> bool {
        self.preset == other.preset
            && self.ttis == other.ttis
            && self.swept_fields == other.swept_fields
            && self.changed_fields == other.changed_fields
            && self.changed_in_table == other.changed_in_table
            && self.action_text() == other.action_text()
    }

    /// Copy of the condition without ranking fields and runs.
    fn without_ranking(&self) -> Self {
        let remove_ranking = |fields: &[(String, String)]| -> Vec<(String, String)> {
            let kept = fields.iter().filter(|(path, _)| path != RANKING);
            kept.cloned().collect()
        };
        Self {
            swept_fields: remove_ranking(&self.swept_fields),
            changed_fields: remove_ranking(&self.changed_fields),
            runs: RunsBySeries::new(),
            preset: self.preset.clone(),
            changed_in_table: self.changed_in_table.clone(),
            actions: self.actions.clone(),
            scenario: None,
            ranking_indices: Vec::new(),
            ..*self
        }
    }

    /// Name of the ranking of wake-ups in its runs.
    fn ranking(&self) -> String {
        let changed = self.all_changes().find(|(path, _)| path == RANKING);
        let of_scenario = self.scenario.as_ref().map(|scenario| scenario.bs.ranking.name());
        changed.map_or_else(
            || of_scenario.unwrap_or_default().to_owned(),
            |(_, value)| value.clone(),
        )
    }

    /// Names of the series, the paper's policies first in its order, then others by name.
    pub fn policies(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for (series, _) in self.runs.keys() {
            if !names.contains(&series.as_str()) {
                names.push(series);
            }
        }
        let rank = |series: &str| {
            let listed = POLICIES
                .iter()
                .position(|policy| *policy == series::split_policy(series).0);
            listed.unwrap_or(POLICIES.len())
        };
        names.sort_by_key(|series| rank(series));
        names
    }

    /// Returns the values of N that were run with `policy`, in ascending order.
    pub fn device_counts(&self, policy: &str) -> Vec<u32> {
        let of_policy = self.runs.keys().filter(|(name, _)| name == policy);
        of_policy.map(|(_, n)| *n).collect()
    }

    /// Returns the N with runs of any policy, ascending.
    pub fn all_device_counts(&self) -> BTreeSet<u32> {
        self.runs.keys().map(|(_, n)| *n).collect()
    }

    /// Returns the estimate of `metric` with its bounds; `None` if it is undefined in all runs of the cell.
    pub fn metric_estimate(&self, policy: &str, n: u32, metric: &str) -> Option<MetricEstimate> {
        let runs: Vec<&ResultRow> = self.runs(policy, n).collect();
        MetricEstimate::from_rows(&runs, metric)
    }

    /// Returns [`Self::metric_estimate`] as a mean with half a width.
    ///
    /// If the interval is uninformative, half its width is the distance from the mean to the one-sided bound. For
    /// `misdetection_pct` without a missed event the bound is 300 / Σ events %, by the rule of three.
    pub fn estimate(&self, policy: &str, n: u32, metric: &str) -> Option<Estimate> {
        let metric_estimate = self.metric_estimate(policy, n, metric)?;
        Some(Estimate {
            half_width: metric_estimate.half_width(),
            ..metric_estimate.mean_estimate
        })
    }

    /// Returns the runs of a cell, in seed order.
    pub fn runs(&self, policy: &str, n: u32) -> impl Iterator<Item = &ResultRow> {
        let runs = self.runs.get(&(policy.to_owned(), n));
        runs.into_iter().flat_map(BTreeMap::values).map(Arc::as_ref)
    }

    /// Smallest and largest number of runs per cell.
    pub(crate) fn runs_per_cell(&self) -> (usize, usize) {
        let counts = || self.runs.values().map(BTreeMap::len);
        (counts().min().unwrap_or(0), counts().max().unwrap_or(0))
    }

    /// First and last seed.
    pub fn seed_range(&self) -> (u64, u64) {
        let seeds = || self.runs.values().flat_map(BTreeMap::keys);
        (seeds().min().copied().unwrap_or(0), seeds().max().copied().unwrap_or(0))
    }

    /// Changed fields with their values: first table-wide changes, then changes of some cells.
    pub fn all_changes(&self) -> impl Iterator<Item = &(String, String)> {
        self.changed_fields.iter().chain(&self.swept_fields)
    }

    /// Human-readable description of the condition, without K.
    pub fn label(&self) -> String {
        let mut label = self.preset.clone();
        for (path, value) in self.all_changes() {
            label = format!("{label}, {path} = {value}");
        }
        label + &self.table_changes_text()
    }

    /// Text of the script of actions; `None` for runs without actions.
    pub fn action_text(&self) -> Option<&str> {
        self.actions.as_ref().map(|actions| actions.text.as_str())
    }

    /// Changes that only a table identifies: "other fields" and "actions", each with a reference to the table. Sweep
    /// figures and fronts use both as names of fields.
    pub fn table_changes(&self) -> impl Iterator<Item = (String, String)> {
        let unknown = self.changed_in_table.as_ref().map(|table| ("other fields", table));
        let actions = self.actions.as_ref().map(|actions| ("actions", &actions.table));
        let changes = unknown.into_iter().chain(actions);
        changes.map(|(kind, table)| (kind.to_owned(), format!("as in {table}")))
    }

    /// Describes [`Self::table_changes`], each after a comma; empty without such changes.
    pub(crate) fn table_changes_text(&self) -> String {
        let unknown = self.changed_in_table.as_ref();
        let unknown = unknown.map(|table| format!(", changed as in {table}"));
        let actions = self.actions.as_ref();
        let actions = actions.map(|actions| format!(", with the actions of {}", actions.table));
        unknown.into_iter().chain(actions).collect()
    }

    /// Returns the scenario of the first run of `policy` with `n` devices as TOML, without actions. `None` if it cannot
    /// be reconstructed. `files` opens the files that it names.
    pub fn scenario_toml(&self, policy: &str, n: u32, files: &dyn Files) -> Option<String> {
        let changes: Vec<(String, String)> = self.all_changes().cloned().collect();
        let scenario = reconstruct_scenario(self.runs(policy, n).next()?, &[], &changes, files)?;
        Some(scenario.to_toml())
    }

    /// Whether the runs use the preset unchanged: nothing is swept or set to another value, and there are no actions.
    pub const fn is_unchanged_preset(&self) -> bool {
        self.is_preset
    }

    /// Whether the runs use a preset in which nothing but the ranking of wake-ups may be changed.
    pub(crate) fn is_preset_of_any_ranking(&self) -> bool {
        let is_ranking = |(path, _): &(String, String)| path == RANKING;
        self.is_preset || (self.table_changes().next().is_none() && self.all_changes().all(is_ranking))
    }

    /// Total number of runs.
    pub(crate) fn run_count(&self) -> usize {
        self.runs.values().map(BTreeMap::len).sum()
    }
}

impl Results {
    /// Conditions grouped by preset and K, with a part of a file name for each group. Trade-offs and fronts of several
    /// conditions need such groups.
    pub fn by_preset_and_length(&self) -> Vec<(String, Vec<&RunCondition>)> {
        let has_several_lengths = self.conditions.windows(2).any(|pair| pair[0].ttis != pair[1].ttis);
        let mut groups: Vec<(String, Vec<&RunCondition>)> = Vec::new();
        for condition in &self.conditions {
            let mut label = condition.preset.clone();
            if has_several_lengths {
                label = format!("{label}-k{}", condition.ttis);
            }
            match groups.iter_mut().find(|(known, _)| *known == label) {
                Some((_, group)) => group.push(condition),
                None => groups.push((label, vec![condition])),
            }
        }
        groups
    }
}

/// Result tables for tests.
#[cfg(test)]
pub(crate) mod fixtures {
    use std::sync::Arc;

    use reveille_bs::scenario::{Override, load};
    use reveille_common::score::Metrics;
    use reveille_lab::table::{Hash, ResultRow, Schema, SweptValue, Table, TableMetadata};

    /// Creates a table of runs under `preset`: for each policy and N, one value of `metric` per run. Every other metric
    /// is its index plus 1.
    pub(crate) fn table(preset: &str, metric: &str, runs: &[(&str, u32, &[f64])]) -> (String, Table) {
        let mut rows = Vec::new();
        for (policy, n, values) in runs {
            for (seed, value) in (1..).zip(*values) {
                rows.push(run((preset, &[]), (policy, *n, seed), (metric, *value)));
            }
        }
        let metadata = TableMetadata {
            version: "0.1.0".to_owned(),
            experiment: format!("preset = \"{preset}\"\n"),
            ..TableMetadata::default()
        };
        let schema = Schema::default();
        (format!("{preset}.parquet"), Table { metadata, schema, rows })
    }

    /// Creates a table of runs under `preset` that sweeps `path`: for each policy, N and field value, one value of
    /// `metric` per run. Each run has its own digest.
    pub(crate) fn swept(
        preset: &str,
        metric: &str,
        path: &str,
        runs: &[(&str, u32, SweptValue, &[f64])],
    ) -> (String, Table) {
        let mut rows = Vec::new();
        for (policy, n, field_value, values) in runs {
            for (seed, value) in (1..).zip(*values) {
                let set = format!("{path}={field_value}");
                let mut row = run((preset, &[set.as_str()]), (policy, *n, seed), (metric, *value));
                row.swept = Arc::from([field_value.clone()]);
                row.digest = row.scenario_hash;
                rows.push(row);
            }
        }
        let schema = Schema {
            swept: vec![(path.to_owned(), runs[0].2.column_type())],
        };
        let (name, table) = table(preset, metric, &[]);
        (name, Table { schema, rows, ..table })
    }

    /// Creates a run of 2000 TTIs with 300 events. The digest depends only on the seed.
    fn run(
        (preset, set): (&str, &[&str]),
        (policy, n, seed): (&str, u32, u64),
        (metric, value): (&str, f64),
    ) -> ResultRow {
        let overrides = [format!("devices={n}"), "ttis=2000".to_owned(), format!("seed={seed}")];
        // Policies that do not exist can still be drawn.
        let is_known = reveille_bs::policy::registry::named(policy).is_some();
        let policy_field = is_known.then(|| format!("policy.name={policy}"));
        let set = set.iter().map(|text| (*text).to_owned());
        let overrides = overrides.into_iter().chain(policy_field).chain(set);
        let overrides: Vec<Override> = overrides
            .map(|text| Override::parse(&text).expect("an override"))
            .collect();
        let scenario = load(preset, &overrides).expect("a scenario").scenario;
        let mut metrics = [0.0; Metrics::COUNT];
        for (index, (slot, name)) in metrics.iter_mut().zip(Metrics::NAMES).enumerate() {
            *slot = if name == metric { value } else { 1.0 + index as f64 };
        }
        ResultRow {
            scenario_hash: Hash(scenario.hash()),
            preset: Arc::from(preset),
            policy: Arc::from(policy),
            n,
            ttis: 2000,
            seed,
            swept: Arc::from([]),
            metrics,
            events: 300,
            digest: Hash([seed as u8; 32]),
        }
    }
}
