//! Runs and sweeps of the built-in policies, for `python/reveille/runs.py`, and the lists of policies and features.
//! Users see the keys of the dictionaries.
//! Long work releases the interpreter, so that other Python threads continue; [`sweep`] also checks for Ctrl-C.

#![expect(
    clippy::needless_pass_by_value,
    reason = "arguments from Python are converted for the call"
)]

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use reveille_bs::cycle::RunOutcome;
use reveille_bs::policy::external::{DEVICE_FEATURES, GLOBAL_FEATURES};
use reveille_bs::policy::registry;
use reveille_common::io::Disk;
use reveille_lab::gym::record;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_lab::sweep::{ExperimentBuilder, Shard, Sweep, SweepError, SweepGrid, SweepProgress};
use reveille_lab::table::Format;

use crate::scenarios::{read_external_silently, read_with_builtin_policy, value_error, warn};

/// Time between two checks for Ctrl-C.
const SIGNAL_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Converts `outcome` to a dictionary. `python/reveille/vector.py` repeats its keys, and a key missing there makes the
/// last step of a vector environment fail.
pub(crate) fn outcome_dict<'py>(py: Python<'py>, outcome: &RunOutcome) -> PyResult<Bound<'py, PyDict>> {
    let metrics = PyDict::new(py);
    for (name, value, _) in outcome.metrics.rows() {
        metrics.set_item(name, value)?;
    }
    let facts = PyDict::new(py);
    for (name, value) in &outcome.facts {
        facts.set_item(name, value)?;
    }
    let dict = PyDict::new(py);
    dict.set_item("digest", outcome.digest.to_string())?;
    dict.set_item("metrics", metrics)?;
    dict.set_item("policy_facts", facts)?;
    dict.set_item("ttis_done", outcome.ttis_done)?;
    dict.set_item("complete", outcome.is_complete)?;
    Ok(dict)
}

/// Returns the names of the built-in policies.
#[pyfunction]
pub(crate) fn policies() -> Vec<&'static str> {
    registry::names().collect()
}

/// Returns name and meaning of the features of a device and of the global features, in the order of the arrays.
#[pyfunction]
pub(crate) fn features() -> [Vec<(&'static str, &'static str)>; 2] {
    let pairs = |features: &[reveille_bs::policy::external::Feature]| {
        features.iter().map(|feature| (feature.name, feature.about)).collect()
    };
    [pairs(&DEVICE_FEATURES), pairs(&GLOBAL_FEATURES)]
}

/// Runs a scenario and returns its outcome.
#[pyfunction]
pub(crate) fn run<'py>(py: Python<'py>, source: &str, set: Vec<String>) -> PyResult<Bound<'py, PyDict>> {
    let scenario = read_with_builtin_policy(py, source, &set)?;
    let outcome = py.detach(|| Run::new(&prepare(&scenario), RunOptions::default()).finish(&mut ()));
    outcome_dict(py, &outcome)
}

/// Runs a scenario and returns its outcome, with the actions that repeat the run in an environment, their stages, and
/// the outcome of that environment as `stepped`.
#[pyfunction]
pub(crate) fn run_with_actions<'py>(py: Python<'py>, source: &str, set: Vec<String>) -> PyResult<Bound<'py, PyDict>> {
    let scenario = read_with_builtin_policy(py, source, &set)?;
    let external_scenario = read_external_silently(source, &set)?;
    let recorded = py.detach(|| record(&scenario, &external_scenario));
    let recorded =
        recorded.ok_or_else(|| value_error("policy genie: it wakes devices before any report is received"))?;
    let dict = outcome_dict(py, &recorded.policy_outcome)?;
    let n = scenario.run.devices as usize;
    let rows = PyArray1::from_vec(py, recorded.rows).reshape([recorded.stages.len(), n])?;
    dict.set_item("actions", rows)?;
    dict.set_item("stages", PyArray1::from_vec(py, recorded.stages))?;
    dict.set_item("stepped", outcome_dict(py, &recorded.environment_outcome)?)?;
    Ok(dict)
}

/// Progress callbacks that show nothing and stop the sweep once the flag is set, which [`sweep`] does after Ctrl-C.
struct StopFlag<'a>(&'a AtomicBool);

impl SweepProgress for StopFlag<'_> {
    fn planned(&self, _: usize, _: u64) {}
    fn started(&self, _: usize) {}
    fn finished(&self, _: usize) {}

    fn should_stop(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Runs the experiment in the TOML `text` in `folder`, or resumes it there. Returns the path of its Parquet table, for
/// `python/reveille/runs.py`.
#[pyfunction]
pub(crate) fn sweep(py: Python<'_>, text: &str, folder: PathBuf, threads: usize) -> PyResult<PathBuf> {
    let draft = ExperimentBuilder::parse(text, "the experiment", Path::new("")).map_err(value_error)?;
    let grid = SweepGrid::new(draft.build().map_err(value_error)?, &Disk).map_err(value_error)?;
    let warnings: BTreeSet<&String> = grid.cells.iter().flat_map(|cell| &cell.warnings).collect();
    warn(py, warnings)?;
    let stop = AtomicBool::new(false);
    let run_sweep = || -> Result<Option<PathBuf>, SweepError> {
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &folder)?;
        let finished = sweep.run(threads.max(1), Format::Parquet, &StopFlag(&stop))?;
        Ok(finished.map(|finished| finished.path))
    };
    let result = std::thread::scope(|scope| -> PyResult<Result<Option<PathBuf>, SweepError>> {
        let (sender, mut receiver) = channel();
        scope.spawn(move || {
            // A panic that left the scope would reach Python as a `PanicException`, which `except Exception` misses.
            let result = catch_unwind(AssertUnwindSafe(run_sweep));
            let result = result.unwrap_or_else(|panic| Err(SweepError::from_panic(&*panic)));
            // The receiver outlives this thread: also after Ctrl-C the loop below waits for the message.
            let _ = sender.send(result);
        });
        let mut interrupted = None;
        loop {
            let received;
            // A receiver cannot be shared between threads, so it is moved into the closure and back.
            (receiver, received) = py.detach(move || {
                let received = receiver.recv_timeout(SIGNAL_CHECK_INTERVAL);
                (receiver, received)
            });
            match received {
                // The sweep has ended by now, so its journal is synced also after Ctrl-C.
                Ok(result) => return interrupted.map_or(Ok(result), Err),
                Err(RecvTimeoutError::Timeout) => {
                    // Signal handlers of Python run only in this call; the wait above does not end by Ctrl-C.
                    if let Err(error) = py.check_signals() {
                        stop.store(true, Ordering::Relaxed);
                        interrupted = Some(error);
                    }
                }
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(PyRuntimeError::new_err(
                        "internal error: the thread of the sweep ended without a result; please report it",
                    ));
                }
            }
        }
    })?;
    let to_py_error = |error: SweepError| {
        if matches!(error, SweepError::Panicked(_)) {
            PyRuntimeError::new_err(error.to_string())
        } else {
            value_error(error)
        }
    };
    result
        .map_err(to_py_error)?
        .ok_or_else(|| PyRuntimeError::new_err("the sweep was stopped"))
}
