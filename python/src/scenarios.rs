//! Reading of scenarios for Python.

use std::fmt::Display;

use pyo3::PyErr;
use pyo3::exceptions::PyValueError;
use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_common::io::Disk;
use reveille_common::scenario::{Override, load};

/// Converts an error of Reveille to a `ValueError` with the same message.
pub(crate) fn value_error(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Reads the scenario `source` with the overrides `set`, each `path=value` with a TOML value.
pub(crate) fn read(source: &str, set: &[String]) -> Result<Scenario, PyErr> {
    let overrides = set.iter().map(|set| Override::parse(set));
    let overrides: Vec<Override> = overrides.collect::<Result<_, _>>().map_err(value_error)?;
    let loaded = load(source, &overrides, &outside::kinds_with_external(), &Disk).map_err(value_error)?;
    Ok(loaded.scenario)
}

/// Reads a scenario like [`read`], with the policy `external`.
pub(crate) fn read_external(source: &str, set: &[String]) -> Result<Scenario, PyErr> {
    let set: Vec<String> = set.iter().cloned().chain(["policy.name=external".to_owned()]).collect();
    read(source, &set)
}
