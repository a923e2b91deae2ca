//! The experiment that the command line selects, for `sweep` and `train record`: an experiment file and options on top.
//! `lab/src/sweep/` defines the file. The order of options does not matter, except that the last of several `--set` for
//! one field applies.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use reveille_bs::policy::outside;
use reveille_common::declare::parse_toml;
use reveille_lab::sweep::{Experiment, ExperimentBuilder};
use toml::Value;

use super::resolve_scenario::REPLAY_PREFIX;
use crate::cli::GridArgs;

/// Loads the optional experiment `file` and applies the options, which take precedence.
pub(super) fn build_experiment(file: Option<&Path>, args: &GridArgs) -> anyhow::Result<Experiment> {
    let defaults = match file {
        Some(path) => ExperimentBuilder::load(path)?,
        None => ExperimentBuilder::default(),
    };
    let experiment = builder_from_options(args)?.with_defaults_from(defaults).build()?;
    check_policies(&experiment)?;
    Ok(experiment)
}

/// Returns an error for a policy that only a single run can have, wherever `policy.name` is swept or set.
fn check_policies(experiment: &Experiment) -> anyhow::Result<()> {
    let axes = experiment.axes.iter();
    let swept_values = axes.flat_map(|axis| axis.values.iter().map(|value| (&axis.path, value, &axis.origin)));
    let set_values = experiment
        .set
        .iter()
        .map(|(field, value, origin)| (field, value, origin));
    for (_, value, origin) in swept_values
        .chain(set_values)
        .filter(|(field, ..)| *field == "policy.name")
    {
        let name = value.as_str().unwrap_or_default();
        if name == outside::EXTERNAL_NAME {
            bail!(
                "{origin}: policy external needs a policy process, and runs in memory have none; start each run with \
                 `reveille up --policy external --seed SEED`, or step environments in a Python program"
            );
        }
        if name.starts_with(REPLAY_PREFIX) {
            bail!("{origin}: {name} repeats the decisions of one run; use `reveille run --policy {name}`");
        }
    }
    Ok(())
}

/// Returns a builder with the values of the options alone.
fn builder_from_options(args: &GridArgs) -> anyhow::Result<ExperimentBuilder> {
    let mut builder = ExperimentBuilder {
        scenario: args.scenario.clone(),
        // A scenario file of an option is relative to the working directory.
        base_dir: PathBuf::new(),
        seed_count: args.seeds,
        first_seed: args.first_seed,
        until_ci: args.until_ci.clone(),
        ci_metrics: args.ci_metrics.clone(),
        min_seeds: args.min_seeds,
        ..ExperimentBuilder::default()
    };
    for (option, field, values) in [
        ("--policies", "policy.name", &args.policies),
        ("--devices", "devices", &args.devices),
        ("--ttis", "ttis", &args.ttis),
    ] {
        if let Some(values) = values {
            let texts = values.iter().filter(|text| !text.trim().is_empty());
            builder.add_axis(option, field, texts.map(|text| parse_value(text)).collect())?;
        }
    }
    for text in &args.grid {
        let Some((field, values)) = text.split_once('=') else {
            bail!("--grid {text}: must be FIELD=VALUE,VALUE…, such as harvest.lambda=0.05,0.1");
        };
        let values = if values.trim_start().starts_with('[') {
            parse_value_list(values).with_context(|| format!("--grid {text}"))?
        } else {
            let parts = values.split(',').map(str::trim).filter(|part| !part.is_empty());
            parts.map(parse_value).collect()
        };
        let field = field.trim();
        builder.add_axis(&format!("--grid {field}"), field, values)?;
    }
    for text in &args.set {
        let Some((field, value)) = text.split_once('=') else {
            bail!("--set {text}: must be FIELD=VALUE, such as sensing.d_max=5");
        };
        if value.contains(',') && matches!(parse_value(value), Value::String(_)) && !value.contains('"') {
            bail!("--set {text}: sets one value in all runs; sweep several values with --grid {text}");
        }
        let origin = format!("--set {}", text.trim());
        // `add_axis` maps former names itself.
        let field = builder.current_path(field.trim(), &origin);
        builder.set.insert(field, (parse_value(value), origin));
    }
    Ok(builder)
}

/// Parses a TOML value. Any other text, such as a bare word or several values, becomes a string.
fn parse_value(text: &str) -> Value {
    parse_value_list(&format!("[{text}]"))
        .ok()
        .and_then(|values| <[Value; 1]>::try_from(values).ok())
        .map_or_else(|| Value::String(text.trim().to_owned()), |[value]| value)
}

/// Parses a TOML list.
fn parse_value_list(text: &str) -> anyhow::Result<Vec<Value>> {
    const CAUSE: &str = "the values of the field are not a TOML list, such as [0.05, 0.1]";
    let table: toml::Table =
        parse_toml(&format!("list = {text}")).map_err(|error| anyhow!("{CAUSE}: {}", error.reason))?;
    match table.into_iter().next() {
        Some((_, Value::Array(values))) => Ok(values),
        Some(_) | None => bail!("{CAUSE}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_toml_or_plain_text() {
        assert_eq!(parse_value("10"), Value::Integer(10));
        assert_eq!(parse_value(" 0.5"), Value::Float(0.5));
        assert_eq!(parse_value("knn"), Value::String("knn".to_owned()));
        assert_eq!(parse_value("\"a,b\""), Value::String("a,b".to_owned()));
        assert_eq!(parse_value("true"), Value::Boolean(true));
        assert_eq!(
            parse_value("[1, 2]"),
            Value::Array(vec![Value::Integer(1), Value::Integer(2)])
        );
        assert_eq!(parse_value("1, 2"), Value::String("1, 2".to_owned()));
        assert_eq!(parse_value_list("[[1], [2, 3]]").expect("valid").len(), 2);
        assert!(parse_value_list("[1,").is_err());
    }
}
