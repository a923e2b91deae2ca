//! Figures of sweeps and runs for Python, drawn by `study/src/figures/` as in `reveille figures`. Only
//! `python/reveille/figures.py` uses these names, and its class `Figure` shows each [`PyFigure`] to users.

#![expect(
    clippy::needless_pass_by_value,
    reason = "arguments from Python are converted for the call"
)]

use std::path::PathBuf;

use pyo3::prelude::*;
use pyo3::types::PyBytes;
use reveille_common::io::Disk;
use reveille_lab::sweep::find_table;
use reveille_lab::table::Table;
use reveille_study::figures::deployment::{self, EventChoice, EventScene};
use reveille_study::figures::results::Results;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::sweep::{SweepFigureSpec, canonical_field, note_on_several};
use reveille_study::figures::timeline::{self, Timeline};
use reveille_study::figures::{png, svg};

use crate::scenarios::{read_with_builtin_policy, value_error};

/// A figure. The getters describe its fields.
#[pyclass(name = "Picture", module = "reveille._native", frozen)]
pub struct PyFigure {
    scene: Scene,
    name: String,
    facet: Vec<(String, String)>,
    csv: Option<String>,
    lines_without_value: Vec<String>,
}

impl PyFigure {
    fn new(scene: Scene, name: String) -> Self {
        Self {
            scene,
            name,
            facet: Vec::new(),
            csv: None,
            lines_without_value: Vec::new(),
        }
    }
}

#[pymethods]
impl PyFigure {
    /// The file name of the figure, without an extension.
    #[getter]
    fn name(&self) -> &str {
        &self.name
    }

    /// The fields that distinguish the figure from others of the same sweep, with their values.
    #[getter]
    fn facet(&self) -> Vec<(String, String)> {
        self.facet.clone()
    }

    /// The data of a chart, as CSV; `None` for other figures.
    #[getter]
    fn csv(&self) -> Option<&str> {
        self.csv.as_deref()
    }

    /// Lines that are not drawn, because none of their runs has a value of the metric.
    #[getter]
    fn undefined(&self) -> Vec<String> {
        self.lines_without_value.clone()
    }

    /// Returns the figure as SVG.
    fn svg(&self, py: Python<'_>) -> String {
        py.detach(|| svg::svg(&self.scene, &self.name))
    }

    /// Returns the figure as PNG.
    fn png<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        let bytes = py.detach(|| png::png(&self.scene));
        PyBytes::new(py, &bytes)
    }
}

/// Draws a metric against a field from tables with names and paths: one figure for each combination of values of the
/// other fields. The values of `by` distinguish the lines, `only` filters the rows, and `log` selects logarithmic axes,
/// x and y. Also returns a note on the differing fields if there are several figures. `reveille.figure` refuses several
/// by this note and prints it in its error.
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
    let spec = SweepFigureSpec {
        x_field: canonical_field(&x),
        metric: y,
        line_field: canonical_field(&by),
        filter: only
            .into_iter()
            .map(|(field, value)| (canonical_field(&field), value))
            .collect(),
        is_log_x: log[0],
        is_log_y: log[1],
    };
    py.detach(|| {
        let read_table = |(name, mut path): (String, PathBuf)| {
            // `find_table` also refuses the folder of a sweep that has not finished.
            if path.is_dir() {
                path = find_table(&path).map_err(value_error)?;
            }
            Ok((name, Table::read(&path).map_err(value_error)?))
        };
        let tables = tables.into_iter().map(read_table).collect::<PyResult<Vec<_>>>()?;
        let results = Results::new(&tables, &Disk).map_err(value_error)?;
        let figures = spec.draw(&results).map_err(value_error)?;
        let note = note_on_several(&figures);
        let pictures = figures.into_iter().map(|figure| PyFigure {
            scene: figure.chart.scene(),
            name: spec.file_name(&figure.facet),
            facet: figure.facet,
            csv: Some(figure.csv),
            lines_without_value: figure.lines_without_value,
        });
        Ok((pictures.collect(), note))
    })
}

/// Draws the deployment of a scenario at the end of one of its events; without `event`, of the one that
/// [`EventScene::from_scenario`] chooses.
#[pyfunction]
#[pyo3(signature = (source, set, event))]
pub(crate) fn deployment_picture(
    py: Python<'_>,
    source: &str,
    set: Vec<String>,
    event: Option<u64>,
) -> PyResult<PyFigure> {
    let scenario = read_with_builtin_policy(py, source, &set)?;
    py.detach(|| {
        let choice = event.map_or(EventChoice::Automatic, EventChoice::Number);
        let event_scene = EventScene::from_scenario(&scenario, choice).map_err(value_error)?;
        let name = deployment::file_name(&scenario, &event_scene);
        Ok(PyFigure::new(deployment::scene(&scenario, &event_scene), name))
    })
}

/// Draws batteries and states of `devices` over `length` TTIs of a run; if empty, of the three with most reports and
/// wake-ups. Without `first` the TTIs begin after the warm-up.
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
    let scenario = read_with_builtin_policy(py, source, &set)?;
    py.detach(|| {
        let first = first.unwrap_or(scenario.warm_up_end().0);
        let timeline_data = Timeline::from_scenario(&scenario, &devices, first, length).map_err(value_error)?;
        let name = timeline::file_name(&scenario, &timeline_data);
        Ok(PyFigure::new(timeline::scene(&scenario, &timeline_data), name))
    })
}
