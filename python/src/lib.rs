//! The module `reveille._native`: environments, runs and sweeps of `reveille-lab` for Python, and figures of
//! `reveille-study`.
//!
//! The package around it, in `python/reveille/`, is documented for users, with shapes and units. `_native.pyi` there
//! repeats the signatures, so change both. `python/Cargo.toml`, `python/pyproject.toml` and the `module` of each class
//! repeat the name of the module.

mod batch;
mod figures;
mod runs;
mod scenarios;

use pyo3::prelude::*;

#[pymodule]
mod _native {
    #[pymodule_export]
    use super::batch::{PyEnvBatch, Snapshot};
    #[pymodule_export]
    use super::figures::{PyFigure, deployment_picture, sweep_pictures, timeline_picture};
    #[pymodule_export]
    use super::runs::{features, policies, run, run_with_actions, sweep};
}
