//! The fields of an experiment file and the command line, before they form an experiment. `reveille sweep` fills a
//! builder from its options and takes missing values from a file; the names of [`ExperimentFile`] are the file format.
//! `Experiment::to_toml` writes them. The help in `deploy/src/cli/sweep.rs` repeats the defaults.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use reveille_bs::scenario::{current_field, declaration};
use reveille_common::declare::{former_name_warning, parse_toml};
use reveille_common::score::Metrics;
use serde::Deserialize;
use toml::{Table, Value};

use super::error::SweepError;
use super::experiment::{Experiment, Seeds, SweepActions, SweepAxis, UntilCi, is_metric};

/// The fields of an experiment file (docs/sweeps.md).
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, expecting = "an experiment")]
struct ExperimentFile {
    scenario: Option<String>,
    scenario_copy: Option<String>,
    preset: Option<Value>,
    policies: Option<Value>,
    devices: Option<Value>,
    ttis: Option<Value>,
    seeds: Option<RawSeeds>,
    until_ci: Option<Value>,
    ci_metrics: Option<Vec<String>>,
    min_seeds: Option<u64>,
    actions: Option<String>,
    action_script: Option<String>,
    set: Table,
    grid: Table,
}

/// `seeds = 1000`, or `seeds = { first = 501, count = 500 }`.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(
    untagged,
    expecting = "`seeds` must be a number of seeds, or { first = …, count = … }"
)]
enum RawSeeds {
    Count(u64),
    Range { first: u64, count: u64 },
}

/// Returns a hint about the unknown `field` in the file `name`, if it is a field of scenarios.
fn scenario_field_hint(field: &str, name: &str) -> String {
    let is_scenario_field = |path: String| path.split('.').next() == Some(field);
    if declaration().field_paths().any(is_scenario_field) {
        format!(
            "; this is a field of scenarios: `reveille sweep --scenario {name}` sweeps a scenario file, and an \
             experiment names one as `scenario = \"FILE\"` and sets fields under [set]"
        )
    } else {
        String::new()
    }
}

/// An incomplete experiment. A missing value comes from another builder ([`Self::with_defaults_from`]), then from the
/// default.
#[derive(Clone, Debug, Default)]
pub struct ExperimentBuilder {
    /// A preset's name or a scenario file [default: paper].
    pub scenario: Option<String>,
    /// The folder of a relative scenario file.
    pub base_dir: PathBuf,
    /// The copy of the scenario file in the folder of a sweep, which is read instead.
    pub scenario_copy: Option<PathBuf>,
    /// The fields set in all cells: by path, the value and its origin.
    pub set: BTreeMap<String, (Value, String)>,
    /// The swept fields, by path.
    pub axes: BTreeMap<String, SweepAxis>,
    /// The number of seeds of each cell, at most with `until_ci` [default: 100].
    pub seed_count: Option<u64>,
    /// The first seed [default: 1].
    pub first_seed: Option<u64>,
    /// The relative half-width of the 95 % interval at which a cell ends, such as `1%`.
    pub until_ci: Option<String>,
    /// The metrics that must be that narrow [default: see `UntilCi::default_metrics`].
    pub ci_metrics: Option<Vec<String>>,
    /// The smallest number of seeds of a cell [default: `UntilCi::MIN_SEEDS`].
    pub min_seeds: Option<u64>,
    /// The actions of every run [default: none].
    pub actions: Option<SweepActions>,
    /// The warnings about former names of fields.
    pub warnings: Vec<String>,
}

impl ExperimentBuilder {
    /// Parses the experiment in the TOML `text`. Messages use `name`; its scenario file is relative to `base_dir`.
    ///
    /// # Errors
    /// If the text is not TOML, or has unknown fields or values of wrong types; the message names file and line.
    pub fn parse(text: &str, name: &str, base_dir: &Path) -> Result<Self, SweepError> {
        let raw: ExperimentFile = parse_toml(text).map_err(|error| {
            let hint = error.unknown_field.as_deref();
            let hint = hint.map_or_else(String::new, |field| scenario_field_hint(field, name));
            SweepError::Syntax {
                name: name.to_owned(),
                line: error.line,
                reason: error.reason + &hint,
            }
        })?;
        let mut builder = Self {
            scenario: raw.scenario,
            base_dir: base_dir.to_owned(),
            scenario_copy: raw.scenario_copy.map(|copy| base_dir.join(copy)),
            ci_metrics: raw.ci_metrics,
            min_seeds: raw.min_seeds,
            ..Self::default()
        };
        builder.actions = match (raw.actions, raw.action_script) {
            (Some(file), Some(_)) => {
                let allowed = format!("excludes action_script, the lines themselves; remove one of them from {name}");
                return Err(SweepError::invalid("actions", file, allowed));
            }
            (Some(file), None) => Some(SweepActions::File(base_dir.join(file))),
            (None, script) => script.map(SweepActions::Script),
        };
        (builder.first_seed, builder.seed_count) = match raw.seeds {
            None => (None, None),
            Some(RawSeeds::Count(count)) => (None, Some(count)),
            Some(RawSeeds::Range { first, count }) => (Some(first), Some(count)),
        };
        builder.until_ci = raw
            .until_ci
            .map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_owned));
        let lists = [
            ("preset", "preset", raw.preset),
            ("policies", "policy.name", raw.policies),
            ("devices", "devices", raw.devices),
            ("ttis", "ttis", raw.ttis),
        ];
        for (field, path, value) in lists {
            match value {
                None => {}
                Some(Value::Array(values)) => builder.add_axis(&format!("`{field}` of {name}"), path, values)?,
                Some(value) => builder.add_axis(&format!("`{field}` of {name}"), path, vec![value])?,
            }
        }
        for (path, value) in flatten_table(raw.grid) {
            let origin = format!("`grid` of {name}");
            // A field with a single value belongs under `set`.
            let Value::Array(values) = value else {
                let allowed = format!("must be a list of values, such as [{value}]; set by {origin}");
                return Err(SweepError::invalid(format!("grid.{path}"), &value, allowed));
            };
            builder.add_axis(&origin, &path, values)?;
        }
        for (path, value) in flatten_table(raw.set) {
            let origin = format!("`set` of {name}");
            let current = builder.current_path(&path, &origin);
            if builder.set.contains_key(&current) {
                let allowed =
                    format!("is set under its former and its current name by {origin}; remove the former name");
                return Err(SweepError::invalid(current, &value, allowed));
            }
            builder.set.insert(current, (value, origin));
        }
        Ok(builder)
    }

    /// Sweeps the field at `path` over `values`; `origin` is for messages.
    ///
    /// # Errors
    /// If the list is empty, or the field is swept twice.
    pub fn add_axis(&mut self, origin: &str, path: &str, values: Vec<Value>) -> Result<(), SweepError> {
        if values.is_empty() {
            let allowed = format!("an empty list leaves no runs; give at least one value; set by {origin}");
            return Err(SweepError::invalid(path, "[]", allowed));
        }
        let path = &self.current_path(path, origin);
        let axis = SweepAxis {
            path: path.clone(),
            values,
            origin: origin.to_owned(),
        };
        if let Some(earlier_axis) = self.axes.insert(path.clone(), axis) {
            let allowed = format!(
                "is swept twice, by {} and by {origin}; list all values in one of them",
                earlier_axis.origin
            );
            return Err(SweepError::invalid(path, "…", allowed));
        }
        Ok(())
    }

    /// Returns today's path of the field at `path`, and warns about a former path, set by `origin`.
    pub fn current_path(&mut self, path: &str, origin: &str) -> String {
        let current = current_field(path);
        if current != path {
            let origin = format!("set by {origin}");
            self.warnings.push(former_name_warning(path, &current, origin));
        }
        current
    }

    /// Returns this builder with its missing values filled from `defaults`, field by field in `set` and `axes`. A field
    /// set here and swept in `defaults`, or the reverse, is an error of [`Self::build`].
    #[must_use]
    pub fn with_defaults_from(self, defaults: Self) -> Self {
        let (mut set, mut axes, mut warnings) = (defaults.set, defaults.axes, defaults.warnings);
        set.extend(self.set);
        axes.extend(self.axes);
        warnings.extend(self.warnings);
        // The folder and the copy belong to their scenario, so the three are taken together.
        let (scenario, base_dir, scenario_copy) = match self.scenario {
            Some(scenario) => (Some(scenario), self.base_dir, self.scenario_copy),
            None => (defaults.scenario, defaults.base_dir, defaults.scenario_copy),
        };
        Self {
            scenario,
            base_dir,
            scenario_copy,
            set,
            axes,
            seed_count: self.seed_count.or(defaults.seed_count),
            first_seed: self.first_seed.or(defaults.first_seed),
            until_ci: self.until_ci.or(defaults.until_ci),
            ci_metrics: self.ci_metrics.or(defaults.ci_metrics),
            min_seeds: self.min_seeds.or(defaults.min_seeds),
            actions: self.actions.or(defaults.actions),
            warnings,
        }
    }

    /// Builds the experiment.
    ///
    /// # Errors
    /// If a value is out of range or contradicts another one.
    pub fn build(self) -> Result<Experiment, SweepError> {
        let paths = self.set.iter().map(|(path, (_, origin))| (path, origin));
        let swept = self.axes.iter().map(|(path, axis)| (path, &axis.origin));
        for (path, origin) in paths.chain(swept) {
            if path == "seed" {
                let allowed = "a sweep counts its seeds itself: see --seeds and --first-seed";
                return Err(SweepError::invalid("seed", "…", format!("{allowed}; set by {origin}")));
            }
        }
        if let Some((path, (value, set_by))) = self.set.iter().find(|(path, _)| self.axes.contains_key(*path)) {
            let origin = &self.axes[path].origin;
            let allowed = format!("is set by {set_by} and swept by {origin}; leave one of them out");
            return Err(SweepError::invalid(path, value, allowed));
        }
        let seeds = Seeds {
            first: self.first_seed.unwrap_or(1),
            count: self.seed_count.unwrap_or(100),
        };
        seeds.check()?;
        let until_ci = build_until_ci(self.until_ci.as_deref(), self.ci_metrics, self.min_seeds, seeds)?;
        let mut axes: Vec<SweepAxis> = self.axes.into_values().collect();
        // Cells follow the order of the axes, which must not depend on the origin of a field.
        axes.sort_by(|a, b| a.rank().cmp(&b.rank()));
        Ok(Experiment {
            scenario: self.scenario.unwrap_or_else(|| "paper".to_owned()),
            base_dir: self.base_dir,
            scenario_copy: self.scenario_copy,
            set: self
                .set
                .into_iter()
                .map(|(path, (value, origin))| (path, value, origin))
                .collect(),
            axes,
            seeds,
            until_ci,
            actions: self.actions,
            warnings: self.warnings,
        })
    }
}

fn build_until_ci(
    target: Option<&str>,
    metrics: Option<Vec<String>>,
    min_seeds: Option<u64>,
    seeds: Seeds,
) -> Result<Option<UntilCi>, SweepError> {
    let Some(text) = target else {
        if metrics.is_some() || min_seeds.is_some() {
            let allowed = "has an effect only with until_ci (--until-ci), the target width of the intervals";
            return Err(SweepError::invalid("ci_metrics or min_seeds", "…", allowed));
        }
        return Ok(None);
    };
    let target = parse_relative_width(text)?;
    let metrics = metrics.unwrap_or_else(UntilCi::default_metrics).into_iter();
    let metrics: Vec<String> = metrics.map(|name| Metrics::current_name(&name).to_owned()).collect();
    if metrics.is_empty() {
        let allowed = "name at least one metric, or leave it out for all";
        return Err(SweepError::invalid("ci_metrics", "[]", allowed));
    }
    if let Some(unknown) = metrics.iter().find(|name| !is_metric(name)) {
        let names = Metrics::ALL.map(|metric| metric.name).join(", ");
        let allowed = format!("unknown metric; the metrics are {names}");
        return Err(SweepError::invalid("ci_metrics", unknown, allowed));
    }
    if let Some(min_seeds) = min_seeds.filter(|min_seeds| *min_seeds > seeds.count) {
        let allowed = format!(
            "exceeds the {} seeds of a cell; lower it, or raise seeds (--seeds)",
            seeds.count
        );
        return Err(SweepError::invalid("min_seeds", min_seeds, allowed));
    }
    let min_seeds = min_seeds.unwrap_or(UntilCi::MIN_SEEDS);
    // The default may exceed the seeds of a cell; the first check is then after all of them.
    if min_seeds.min(seeds.count) < 2 {
        let allowed = "an interval needs at least two runs; raise min_seeds and seeds";
        return Err(SweepError::invalid("min_seeds", min_seeds.min(seeds.count), allowed));
    }
    Ok(Some(UntilCi {
        target,
        metrics,
        min_seeds,
    }))
}

/// Parses a relative width: `1%`, or `0.01`.
fn parse_relative_width(text: &str) -> Result<f64, SweepError> {
    let (number, is_percent) = match text.strip_suffix('%') {
        Some(percent) => (percent.trim().parse::<f64>().map(|percent| percent / 100.0), true),
        None => (text.parse::<f64>(), false),
    };
    // A bare 1 may mean 1 %: only `100%` is read as the whole mean.
    let within = |width: &f64| *width > 0.0 && (*width < 1.0 || is_percent && *width <= 1.0);
    number.clone().ok().filter(within).ok_or_else(|| {
        let hint = match number {
            Ok(number) if !is_percent && (1.0..=100.0).contains(&number) => {
                format!("; write {number} % as {number}% or {}", number / 100.0)
            }
            Ok(_) | Err(_) => String::new(),
        };
        let allowed =
            "must be the half-width of the 95 % interval over the mean: above 0 and at most 100 %, such as 1% or 0.01";
        SweepError::invalid("until_ci", text, format!("{allowed}{hint}"))
    })
}

/// Returns the values of a table and its nested tables, with their dotted paths.
fn flatten_table(table: Table) -> Vec<(String, Value)> {
    let mut leaves = Vec::new();
    for (name, value) in table {
        if let Value::Table(inner) = value {
            let inner = flatten_table(inner).into_iter();
            leaves.extend(inner.map(|(path, value)| (format!("{name}.{path}"), value)));
        } else {
            leaves.push((name, value));
        }
    }
    leaves
}
