//! Environments that step together, and the NumPy arrays that each step overwrites. `lab/src/gym/` steps; shapes and
//! element types here must match its [`BatchBuffers`]. `python/reveille/` wraps the class `Batch` for Gymnasium and
//! PettingZoo, and `python/benches/` calls it directly. `_native.pyi` repeats the signatures.

#![expect(
    clippy::needless_pass_by_value,
    reason = "arguments from Python are converted for the call"
)]

use std::sync::{Mutex, MutexGuard, PoisonError};

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::{PyIndexError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use reveille_bs::policy::external::{DEVICE_FEATURES, GLOBAL_FEATURES};
use reveille_bs::scenario::Scenario;
use reveille_lab::gym::{self, BatchBuffers, Environment, REWARD_TERMS, RewardWeights};

use crate::runs::outcome_dict;
use crate::scenarios::read_external;

/// A batch of K environments with N devices each. Construction, reset, restore and step overwrite its arrays, which the
/// getters hand out without a copy.
#[pyclass(name = "Batch", module = "reveille._native", frozen)]
pub struct PyEnvBatch {
    inner: Mutex<gym::EnvBatch>,
    /// The preset or file of the scenario, as given to the constructor.
    source: String,
    /// The overrides of the constructor; resets add theirs without a change here.
    set: Vec<String>,
    weights: RewardWeights,
    arrays: Arrays,
}

/// The NumPy arrays behind [`BatchBuffers`], which describes their contents.
struct Arrays {
    device_features: Py<PyArray3<f32>>,
    global_features: Py<PyArray2<f32>>,
    stage: Py<PyArray1<i64>>,
    mask: Py<PyArray2<i8>>,
    reward: Py<PyArray1<f64>>,
    reward_terms: Py<PyArray2<f64>>,
    ttis: Py<PyArray1<i64>>,
    ended: Py<PyArray1<bool>>,
}

impl Arrays {
    /// Creates the arrays of `k` environments with `n` devices each.
    fn new(py: Python<'_>, k: usize, n: usize) -> Self {
        Self {
            device_features: PyArray3::zeros(py, [k, n, DEVICE_FEATURES.len()], false).unbind(),
            global_features: PyArray2::zeros(py, [k, GLOBAL_FEATURES.len()], false).unbind(),
            stage: PyArray1::zeros(py, [k], false).unbind(),
            mask: PyArray2::zeros(py, [k, n], false).unbind(),
            reward: PyArray1::zeros(py, [k], false).unbind(),
            reward_terms: PyArray2::zeros(py, [k, REWARD_TERMS], false).unbind(),
            ttis: PyArray1::zeros(py, [k], false).unbind(),
            ended: PyArray1::zeros(py, [k], false).unbind(),
        }
    }

    /// Runs `work` on the memory of the arrays, while other Python threads may run.
    ///
    /// # Errors
    /// If another thread is writing into the arrays, or Python code has made one read-only.
    fn with_buffers(&self, py: Python<'_>, work: impl FnOnce(BatchBuffers<'_>) + Send) -> PyResult<()> {
        // `try_readwrite` raises an exception, instead of a panic, while another thread writes into these arrays.
        let mut device_features = self.device_features.bind(py).try_readwrite()?;
        let mut global_features = self.global_features.bind(py).try_readwrite()?;
        let mut stage = self.stage.bind(py).try_readwrite()?;
        let mut mask = self.mask.bind(py).try_readwrite()?;
        let mut reward = self.reward.bind(py).try_readwrite()?;
        let mut reward_terms = self.reward_terms.bind(py).try_readwrite()?;
        let mut ttis = self.ttis.bind(py).try_readwrite()?;
        let mut ended = self.ended.bind(py).try_readwrite()?;
        let buffers = BatchBuffers {
            device_features: device_features.as_slice_mut()?,
            global_features: global_features.as_slice_mut()?,
            stage: stage.as_slice_mut()?,
            mask: mask.as_slice_mut()?,
            reward: reward.as_slice_mut()?,
            reward_terms: reward_terms.as_slice_mut()?,
            ttis: ttis.as_slice_mut()?,
            ended: ended.as_slice_mut()?,
        };
        // Released before `work` waits for the batch: a thread that waits while it holds the interpreter blocks all
        // others.
        py.detach(|| work(buffers));
        Ok(())
    }
}

/// A copy of an environment, for [`PyEnvBatch::restore`] of this or another batch.
#[pyclass(module = "reveille._native", frozen)]
pub(crate) struct Snapshot {
    environment: Mutex<Environment>,
}

impl PyEnvBatch {
    fn lock(&self) -> MutexGuard<'_, gym::EnvBatch> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn check_index(index: usize, batch_size: usize) -> PyResult<()> {
        if index < batch_size {
            return Ok(());
        }
        Err(PyIndexError::new_err(format!(
            "environment {index} does not exist; the batch has {batch_size}, numbered from 0"
        )))
    }

    fn fill_arrays(&self, py: Python<'_>) -> PyResult<()> {
        self.arrays
            .with_buffers(py, |buffers| self.lock().write_observations(buffers))
    }
}

#[pymethods]
impl PyEnvBatch {
    /// Creates an environment of the scenario `source`, overridden by `set`, for each of `seeds`.
    #[new]
    #[pyo3(signature = (source, set, seeds, threads, mu1, mu2))]
    fn new(
        py: Python<'_>,
        source: String,
        set: Vec<String>,
        seeds: Vec<u64>,
        threads: usize,
        mu1: f64,
        mu2: f64,
    ) -> PyResult<Self> {
        if seeds.is_empty() || threads == 0 {
            return Err(PyValueError::new_err(
                "a batch needs at least one environment and one thread",
            ));
        }
        let scenario = read_external(py, &source, &set)?;
        let weights = RewardWeights { mu1, mu2 };
        let scenarios: Vec<Scenario> = seeds.iter().map(|seed| scenario.with_seed(*seed)).collect();
        let inner = py.detach(|| gym::EnvBatch::new(&scenarios, weights, threads));
        let inner = inner.map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        let batch = Self {
            arrays: Arrays::new(py, seeds.len(), inner.device_count()),
            inner: Mutex::new(inner),
            source,
            set,
            weights,
        };
        batch.fill_arrays(py)?;
        Ok(batch)
    }

    /// Restarts each of the environments `indices` with the seed at its place in `seeds`. The Python package passes
    /// lists of one length; the rest of a longer one is ignored. `set` overrides fields in addition to the overrides of
    /// the batch; it replaces the `set` of an earlier reset.
    fn reset(&self, py: Python<'_>, indices: Vec<usize>, seeds: Vec<u64>, set: Vec<String>) -> PyResult<()> {
        let set: Vec<String> = self.set.iter().cloned().chain(set).collect();
        let scenario = read_external(py, &self.source, &set)?;
        let (batch_size, device_count) = {
            let inner = self.lock();
            (inner.len(), inner.device_count())
        };
        if scenario.run.devices as usize != device_count {
            let cause = format!("the environment has {device_count} devices, and its spaces cannot change");
            return Err(PyValueError::new_err(format!(
                "devices = {}: {cause}",
                scenario.run.devices
            )));
        }
        let mut scenarios = vec![None; batch_size];
        for (index, seed) in indices.into_iter().zip(seeds) {
            // Checked before any environment restarts, so that an error changes none.
            Self::check_index(index, batch_size)?;
            scenarios[index] = Some(scenario.with_seed(seed));
        }
        py.detach(|| self.lock().reset(scenarios));
        self.fill_arrays(py)
    }

    /// Applies a decision, its row of `actions`, in each environment whose flag in `is_resting` is false. Both arrays
    /// must be contiguous. The others keep their observation and have a reward of 0; the package sets the flag of
    /// environments that have ended, also of those that it has just reset.
    fn step(
        &self,
        py: Python<'_>,
        actions: PyReadonlyArray2<'_, i8>,
        is_resting: PyReadonlyArray1<'_, bool>,
    ) -> PyResult<()> {
        // Checked here, since `gym::EnvBatch::step` panics on another length.
        let shape = [actions.shape()[0], actions.shape()[1], is_resting.shape()[0]];
        let expected = {
            let inner = self.lock();
            [inner.len(), inner.device_count(), inner.len()]
        };
        if shape != expected {
            let [k, n, _] = expected;
            return Err(PyValueError::new_err(format!(
                "actions of shape ({}, {}): must be ({k}, {n})",
                shape[0], shape[1]
            )));
        }
        let (actions, is_resting) = (actions.as_slice()?, is_resting.as_slice()?);
        self.arrays
            .with_buffers(py, |buffers| self.lock().step(actions, is_resting, buffers))
    }

    /// Returns the outcome so far of the run in environment `index`.
    fn outcome<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        let outcome = {
            let inner = self.lock();
            Self::check_index(index, inner.len())?;
            inner.environments()[index].outcome()
        };
        outcome_dict(py, &outcome)
    }

    /// Copies environment `index`.
    fn snapshot(&self, index: usize) -> PyResult<Snapshot> {
        let inner = self.lock();
        Self::check_index(index, inner.len())?;
        Ok(Snapshot {
            environment: Mutex::new(inner.environments()[index].fork()),
        })
    }

    /// Restores environment `index` from a snapshot.
    fn restore(&self, py: Python<'_>, index: usize, snapshot: &Snapshot) -> PyResult<()> {
        let environment = snapshot
            .environment
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            // A copy, so that a snapshot can be restored any number of times.
            .fork();
        {
            let mut inner = self.lock();
            Self::check_index(index, inner.len())?;
            // The arrays have the shape of the first scenario.
            if environment.template().scenario().run.devices as usize != inner.device_count() {
                return Err(PyValueError::new_err("the snapshot has another number of devices"));
            }
            inner.replace(index, environment);
        }
        self.fill_arrays(py)
    }

    /// Whether both batches were created with the same weights, source and overrides, compared as texts. Seeds and the
    /// overrides of resets do not count.
    fn is_like(&self, other: &Self) -> bool {
        let sources = (&self.source, &self.set) == (&other.source, &other.set);
        sources && self.weights == other.weights
    }

    /// The scenario of environment 0, all fields, as TOML.
    #[getter]
    fn scenario(&self) -> String {
        self.lock().environments()[0].template().scenario().to_toml()
    }

    /// Number of devices N.
    #[getter]
    fn n(&self) -> usize {
        self.lock().device_count()
    }

    /// Length of a run of environment 0, TTIs.
    #[getter]
    fn length(&self) -> u64 {
        self.lock().environments()[0].template().scenario().run.ttis
    }

    /// The features of the devices; see [`BatchBuffers`], as for the getters below.
    #[getter]
    fn devices(&self, py: Python<'_>) -> Py<PyArray3<f32>> {
        self.arrays.device_features.clone_ref(py)
    }

    #[getter]
    fn globals(&self, py: Python<'_>) -> Py<PyArray2<f32>> {
        self.arrays.global_features.clone_ref(py)
    }

    #[getter]
    fn stage(&self, py: Python<'_>) -> Py<PyArray1<i64>> {
        self.arrays.stage.clone_ref(py)
    }

    #[getter]
    fn mask(&self, py: Python<'_>) -> Py<PyArray2<i8>> {
        self.arrays.mask.clone_ref(py)
    }

    #[getter]
    fn reward(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        self.arrays.reward.clone_ref(py)
    }

    #[getter]
    fn parts(&self, py: Python<'_>) -> Py<PyArray2<f64>> {
        self.arrays.reward_terms.clone_ref(py)
    }

    #[getter]
    fn ttis(&self, py: Python<'_>) -> Py<PyArray1<i64>> {
        self.arrays.ttis.clone_ref(py)
    }

    #[getter]
    fn ended(&self, py: Python<'_>) -> Py<PyArray1<bool>> {
        self.arrays.ended.clone_ref(py)
    }
}
