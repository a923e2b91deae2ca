//! The experiment that the command line selects.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_lab::sweep::{Experiment, ExperimentBuilder};
use toml::Value;

use crate::cli::GridArgs;

/// Loads the optional experiment `file` and applies the options.
pub(super) fn experiment(file: Option<&Path>, given: &GridArgs) -> anyhow::Result<Experiment> {
    let file = match file {
        Some(path) => ExperimentBuilder::load(path)?,
        None => ExperimentBuilder::default(),
    };
    Ok(options(given)?.with_defaults_from(file).build()?)
}

fn options(given: &GridArgs) -> anyhow::Result<ExperimentBuilder> {
    let mut draft = ExperimentBuilder {
        scenario: given.scenario.clone(),
        base_dir: PathBuf::new(),
        count: given.seeds,
        first: given.first_seed,
        until_ci: given.until_ci.clone(),
        ci_metrics: given.ci_metrics.clone(),
        min_seeds: given.min_seeds,
        ..ExperimentBuilder::default()
    };
    for (flag, path, values) in [
        ("--policies", "policy.name", &given.policies),
        ("--devices", "devices", &given.devices),
        ("--ttis", "ttis", &given.ttis),
    ] {
        if let Some(values) = values {
            let given = values.iter().filter(|text| !text.trim().is_empty());
            draft.axis(flag, path, given.map(|text| value(text)).collect())?;
        }
    }
    for text in &given.grid {
        let Some((path, values)) = text.split_once('=') else {
            bail!("--grid {text}: must be FIELD=VALUE,VALUE…, such as harvest.lambda=0.05,0.1");
        };
        let values = if values.trim_start().starts_with('[') {
            list(values).with_context(|| format!("--grid {text}"))?
        } else {
            let parts = values.split(',').map(str::trim).filter(|part| !part.is_empty());
            parts.map(value).collect()
        };
        let path = path.trim();
        draft.axis(&format!("--grid {path}"), path, values)?;
    }
    for text in &given.set {
        let Some((path, given)) = text.split_once('=') else {
            bail!("--set {text}: must be FIELD=VALUE, such as sensing.d_max=5");
        };
        let by = format!("--set {}", text.trim());
        draft.set.insert(path.trim().to_owned(), (value(given), by));
    }
    Ok(draft)
}

/// Parses a TOML value; a bare word becomes a string.
fn value(text: &str) -> Value {
    list(&format!("[{text}]"))
        .ok()
        .and_then(|values| <[Value; 1]>::try_from(values).ok())
        .map_or_else(|| Value::String(text.trim().to_owned()), |[value]| value)
}

/// Parses a TOML list.
fn list(text: &str) -> anyhow::Result<Vec<Value>> {
    let table: toml::Table = toml::from_str(&format!("list = {text}")).context("the list is not valid TOML")?;
    match table.into_iter().next() {
        Some((_, Value::Array(values))) => Ok(values),
        Some(_) | None => bail!("the list is not valid TOML"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_toml_or_bare_words() {
        assert_eq!(value("10"), Value::Integer(10));
        assert_eq!(value(" 0.5"), Value::Float(0.5));
        assert_eq!(value("knn"), Value::String("knn".to_owned()));
        assert_eq!(value("\"a,b\""), Value::String("a,b".to_owned()));
        assert_eq!(value("true"), Value::Boolean(true));
        assert_eq!(
            value("[1, 2]"),
            Value::Array(vec![Value::Integer(1), Value::Integer(2)])
        );
        assert_eq!(value("1, 2"), Value::String("1, 2".to_owned()));
        assert_eq!(list("[[1], [2, 3]]").expect("valid").len(), 2);
        assert!(list("[1,").is_err());
    }
}
