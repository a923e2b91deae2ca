//! Reading of scenarios for the functions of this module. A list `set` holds overrides, each `path=value` with a TOML
//! value; `overrides` in `python/reveille/scenario.py` makes it, and a later entry replaces an earlier one. The
//! categories of warnings are part of the package's interface (docs/python-reference.md).

use std::ffi::CString;
use std::fmt::Display;

use pyo3::exceptions::{PyFutureWarning, PyUserWarning, PyValueError};
use pyo3::prelude::*;
use reveille_bs::policy::{outside, registry};
use reveille_bs::scenario::{Loaded, Scenario};
use reveille_common::declare::FORMER_NAME_NOTICE;
use reveille_common::io::Disk;
use reveille_common::scenario::{Override, load};

/// Converts an error of Reveille to a `ValueError` with the same message.
pub(crate) fn value_error(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Reads the scenario `source`, a preset or a file, with the overrides `set`. Issues its warnings.
fn read(py: Python<'_>, source: &str, set: &[String]) -> PyResult<Scenario> {
    let loaded = load_silently(source, set)?;
    warn(py, &loaded.warnings)?;
    Ok(loaded.scenario)
}

/// Reads a scenario like [`read`], for a run without an environment.
///
/// # Errors
/// Also if its policy is `external`.
pub(crate) fn read_with_builtin_policy(py: Python<'_>, source: &str, set: &[String]) -> PyResult<Scenario> {
    let scenario = read(py, source, set)?;
    if registry::named(scenario.policy.name()).is_none() {
        return Err(value_error(
            "policy external: an environment makes its decisions; choose a built-in policy",
        ));
    }
    Ok(scenario)
}

/// Reads a scenario like [`read`], with the policy `external` instead of its policy.
pub(crate) fn read_external(py: Python<'_>, source: &str, set: &[String]) -> PyResult<Scenario> {
    read(py, source, &with_external(set))
}

/// Reads a scenario like [`read_external`], without its warnings: for a scenario whose warnings [`read`] has issued.
pub(crate) fn read_external_silently(source: &str, set: &[String]) -> PyResult<Scenario> {
    Ok(load_silently(source, &with_external(set))?.scenario)
}

fn load_silently(source: &str, set: &[String]) -> PyResult<Loaded> {
    let overrides = set.iter().map(|text| Override::parse(text));
    let overrides: Vec<Override> = overrides.collect::<Result<_, _>>().map_err(value_error)?;
    load(source, &overrides, &outside::kinds_with_external(), &Disk).map_err(value_error)
}

fn with_external(set: &[String]) -> Vec<String> {
    set.iter().cloned().chain(["policy.name=external".to_owned()]).collect()
}

/// Issues warnings about a scenario: a `FutureWarning` for a former name, recognised by the end of the text, a
/// `UserWarning` for all else.
///
/// # Errors
/// If a filter turns a warning into an exception, or a warning contains a NUL.
pub(crate) fn warn<'w>(py: Python<'_>, warnings: impl IntoIterator<Item = &'w String>) -> PyResult<()> {
    // The frame that called a function of the package, if that function calls the native one itself.
    const STACK_LEVEL: i32 = 2;
    for warning in warnings {
        let category = if warning.ends_with(FORMER_NAME_NOTICE) {
            py.get_type::<PyFutureWarning>()
        } else {
            py.get_type::<PyUserWarning>()
        };
        PyErr::warn(py, &category, &CString::new(warning.as_str())?, STACK_LEVEL)?;
    }
    Ok(())
}
