//! Pictures of sweeps and runs.

#![expect(
    clippy::needless_pass_by_value,
    reason = "what Python hands over is converted for the call"
)]

use std::path::PathBuf;

use pyo3::prelude::*;
use pyo3::types::PyBytes;
use reveille_bs::policy::registry;
use reveille_bs::scenario::Scenario;
use reveille_common::io::Disk;
use reveille_lab::sweep::table_in;
use reveille_lab::table::Table;
use reveille_study::figures::deployment::{self, EventScene};
use reveille_study::figures::results::Results;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::sweep::{SweepFigureSpec, named, several};
use reveille_study::figures::timeline::{self, Timeline};
use reveille_study::figures::{png, svg};

use crate::scenarios::{read, refused};

/// A picture.
#[pyclass(name = "Picture", module = "reveille._native", frozen)]
pub struct PyFigure {
    scene: Scene,
    name: String,
    facet: Vec<(String, String)>,
    csv: Option<String>,
    undefined: Vec<String>,
}

impl PyFigure {
    fn new(scene: Scene, name: String) -> Self {
        Self {
            scene,
            name,
            facet: Vec::new(),
            csv: None,
            undefined: Vec::new(),
        }
    }
}

#[pymethods]
impl PyFigure {
    /// What it is called, as the name of a file without its ending.
    #[getter]
    fn name(&self) -> &str {
        &self.name
    }

    /// The fields that set it apart from others, with their values.
    #[getter]
    fn facet(&self) -> Vec<(String, String)> {
        self.facet.clone()
    }

    /// What is drawn, as CSV, where it is a chart.
    #[getter]
    fn csv(&self) -> Option<&str> {
        self.csv.as_deref()
    }

    /// Lines that are not drawn, as no run of theirs has a value of the metric.
    #[getter]
    fn undefined(&self) -> Vec<String> {
        self.undefined.clone()
    }

    /// The picture as SVG.
    fn svg(&self, py: Python<'_>) -> String {
        py.detach(|| svg::svg(&self.scene, &self.name))
    }

    /// The picture as PNG.
    fn png<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        let bytes = py.detach(|| png::png(&self.scene));
        PyBytes::new(py, &bytes)
    }
}

/// A metric against a field, from tables each with its name and path: a picture for each combination of the values of
/// the other fields, and that there are several, in words.
#[pyfunction]
#[pyo3(signature = (tables, x, y, by, only, log))]
pub(crate) fn sweep_pictures(
    py: Python<'_>,
    tables: Vec<(String, PathBuf)>,
    x: String,
    y: String,
    by: String,
    only: Vec<(String, String)>,
    log: [bool; 2],
) -> PyResult<(Vec<PyFigure>, Option<String>)> {
    let wish = SweepFigureSpec {
        x: named(&x).to_owned(),
        y,
        by: named(&by).to_owned(),
        only: only
            .into_iter()
            .map(|(field, value)| (named(&field).to_owned(), value))
            .collect(),
        is_log_x: log[0],
        is_log_y: log[1],
    };
    py.detach(|| {
        let read = |(name, mut path): (String, PathBuf)| {
            // `table_in` also refuses the folder of a sweep that has not finished.
            if path.is_dir() {
                path = table_in(&path).map_err(refused)?;
            }
            Ok((name, Table::read(&path).map_err(refused)?))
        };
        let tables = tables.into_iter().map(read).collect::<PyResult<Vec<_>>>()?;
        let results = Results::new(&tables, &Disk).map_err(refused)?;
        let drawn = wish.draw(&results).map_err(refused)?;
        let words = several(&drawn);
        let pictures = drawn.into_iter().map(|picture| PyFigure {
            scene: picture.chart.scene(),
            name: wish.name(&picture.facet),
            facet: picture.facet,
            csv: Some(picture.csv),
            undefined: picture.undefined,
        });
        Ok((pictures.collect(), words))
    })
}

/// The scenario of a run that can be drawn.
fn drawable(source: &str, set: &[String]) -> PyResult<Scenario> {
    let scenario = read(source, set)?;
    if registry::named(scenario.policy.name()).is_none() {
        return Err(refused(
            "policy external: decisions come from an environment, not from a run",
        ));
    }
    Ok(scenario)
}

/// The deployment of a scenario as one of its events ends.
#[pyfunction]
#[pyo3(signature = (source, set, event))]
pub(crate) fn deployment_picture(
    py: Python<'_>,
    source: &str,
    set: Vec<String>,
    event: Option<u64>,
) -> PyResult<PyFigure> {
    let scenario = drawable(source, &set)?;
    py.detach(|| {
        let moment = EventScene::of(&scenario, event).map_err(refused)?;
        let name = deployment::name(&scenario, &moment);
        Ok(PyFigure::new(deployment::scene(&scenario, &moment), name))
    })
}

/// Batteries and states of some devices over some TTIs of a run.
#[pyfunction]
#[pyo3(signature = (source, set, devices, first, length))]
pub(crate) fn timeline_picture(
    py: Python<'_>,
    source: &str,
    set: Vec<String>,
    devices: Vec<u32>,
    first: Option<u64>,
    length: u64,
) -> PyResult<PyFigure> {
    let scenario = drawable(source, &set)?;
    py.detach(|| {
        let first = first.unwrap_or(scenario.warm_up_end().0);
        let shown = Timeline::of(&scenario, &devices, first, length).map_err(refused)?;
        let name = timeline::name(&scenario, &shown);
        Ok(PyFigure::new(timeline::scene(&scenario, &shown), name))
    })
}
