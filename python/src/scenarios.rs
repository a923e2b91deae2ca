//! Scenarios as Python names them.

use std::fmt::Display;

use pyo3::PyErr;
use pyo3::exceptions::PyValueError;
use reveille_bs::policy::outside;
use reveille_common::io::Disk;
use reveille_common::scenario::{Override, Scenario, load};

/// An error of the caller's, in the words of the program.
pub fn refused(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// The scenario `source` with `set` on top, each `path=value` with a TOML value.
pub fn read(source: &str, set: &[String]) -> Result<Scenario, PyErr> {
    let overrides = set.iter().map(|set| Override::parse(set));
    let overrides: Vec<Override> = overrides.collect::<Result<_, _>>().map_err(refused)?;
    load(source, &overrides, &outside::kinds(), &Disk).map_err(refused)
}

/// As [`read`], with decisions from outside.
pub fn read_external(source: &str, set: &[String]) -> Result<Scenario, PyErr> {
    let set: Vec<String> = set.iter().cloned().chain(["policy.name=external".to_owned()]).collect();
    read(source, &set)
}
