//! Run folders as input: `inspect misses`, `figures misses` and `compare` read the files that `run_folder` writes.
//! Columns are found by the names in `run_tables`, since other versions of Reveille write other columns; fields of
//! `summary.json` are found by the names in `summary`. A renamed column or field compiles and is missed here.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use reveille_bs::scenario::{Scenario, load_with_external};
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::OperatorAction;
use reveille_common::totals::MissCause;
use reveille_study::misses::{MissedEvent, Misses, RunEnergy};
use serde_json::Value;

use crate::display::note;
use crate::folder_lock::{FolderStatus, status};
use crate::input_log;
use crate::run_folder::{self, DEVICES_FILE, EVENTS_FILE, SCENARIO_FILE, SUMMARY_FILE, failure};

/// The folder of a run.
pub(crate) struct RunReader {
    path: PathBuf,
    /// The scenario of the run.
    pub(crate) scenario: Scenario,
    /// The content of its `summary.json`, if the run has one.
    pub(crate) summary: Option<Value>,
}

/// The rows of a CSV table, with cells by column.
pub(crate) struct RowTable {
    path: PathBuf,
    /// Names of the columns, in order.
    header: csv::StringRecord,
    /// Index of each column.
    columns: BTreeMap<String, usize>,
    rows: Vec<csv::StringRecord>,
}

impl RunReader {
    /// Opens the run in the folder `path`, or in the folder that holds the recording `path`.
    ///
    /// # Errors
    /// If the folder holds no run, or a file of it is invalid.
    pub(crate) fn open(path: &Path) -> anyhow::Result<Self> {
        let path = &run_folder::of_recording(path);
        let scenario_file = path.join(SCENARIO_FILE);
        if !scenario_file.is_file() {
            let cause = match path.metadata() {
                Err(_) => "no such folder",
                Ok(found) if found.is_dir() && has_broken_summary(path) => {
                    "the folder holds no run: it has no scenario.toml, and its summary.json is not readable"
                }
                Ok(found) if found.is_dir() => "the folder holds no run",
                Ok(_) => "not a folder (a recording lacks the tables of its run)",
            };
            bail!(
                "{}: {cause}; name the folder of a run, such as runs/knn-n50-s1",
                path.display()
            );
        }
        let scenario = load_with_external(&scenario_file.to_string_lossy(), &[])?.scenario;
        let summary_file = path.join(SUMMARY_FILE);
        let summary: Option<Value> =
            match fs::read(&summary_file) {
                Ok(text) => {
                    let summary = serde_json::from_slice(&text).ok();
                    let has_metrics = |summary: &Value| summary["metrics"].is_object();
                    Some(summary.filter(has_metrics).with_context(|| {
                        format!("{}: not the summary of a run; repeat the run", summary_file.display())
                    })?)
                }
                Err(_) => None,
            };
        Ok(Self {
            path: path.to_owned(),
            scenario,
            summary,
        })
    }

    /// Prints a note if the run has no summary: its tables then cover only a part of it.
    fn note_if_unfinished(&self) {
        if let Some(state) = self.unfinished_state() {
            note!("{}: {state}; its tables cover the TTIs so far", self.path.display());
        }
    }

    /// Describes the state of a run without a summary; `None` with one, which an interrupted run has too.
    pub(crate) fn unfinished_state(&self) -> Option<String> {
        if self.summary.is_some() {
            return None;
        }
        Some(match (status(&self.path), failure(&self.path)) {
            (FolderStatus::Running(_), _) => "the run is still active".to_owned(),
            (_, Some(reason)) => format!("the run failed ({reason})"),
            (FolderStatus::Killed | FolderStatus::Finished, None) => "the run was killed".to_owned(),
        })
    }

    /// The path as given.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the actions of operators and scripts, in the order in which they take effect. The input log also holds the
    /// actions of a script after the end of an interrupted run, which are left out.
    ///
    /// # Errors
    /// If the input log cannot be read, or belongs to another scenario.
    pub(crate) fn actions(&self) -> anyhow::Result<Vec<OperatorAction>> {
        let mut actions = input_log::read_folder(&self.path, &self.scenario)?.actions;
        if let Some(ttis_done) = self.ttis_done() {
            actions.retain(|action| action.tti < ttis_done);
        }
        Ok(actions)
    }

    /// The number of TTIs that the run has done, and thus its end; `None` without a summary.
    fn ttis_done(&self) -> Option<Tti> {
        self.summary.as_ref()?["ttis_done"].as_u64().map(Tti)
    }

    /// Reads the table `name`; `None` if the run has not written it.
    ///
    /// # Errors
    /// If it is not a table.
    pub(crate) fn table(&self, name: &str) -> anyhow::Result<Option<RowTable>> {
        let path = self.path.join(name);
        if !path.exists() {
            return Ok(None);
        }
        RowTable::read(path).map(Some)
    }

    /// Reads the missed events. Prints a note if the run has no summary.
    ///
    /// # Errors
    /// If `events.csv` is missing, or it or the input log is invalid.
    pub(crate) fn misses(&self) -> anyhow::Result<Misses> {
        let Some(events) = self.table(EVENTS_FILE)? else {
            bail!("{}: holds no {EVENTS_FILE}; repeat the run", self.path.display());
        };
        // Checked first: a table without rows would otherwise read as a run without events. The file of an active run
        // can still be empty.
        if events.column_names().next().is_some() {
            for column in ["event", "start_tti", "counted", "reports", "x_m", "y_m"] {
                events.column_index(column)?;
            }
        }
        self.note_if_unfinished();
        let mut misses = Misses::new(self.scenario.clone());
        misses.actions = self.actions()?;
        let mut missed = Vec::new();
        for row in events.rows() {
            let is_counted = row.number::<u8>("counted")? == 1;
            let is_missed = row.number::<u64>("reports")? == 0;
            let start = Tti(row.number("start_tti")?);
            if is_counted {
                misses.counted_starts.push(start);
            }
            match (is_counted, is_missed) {
                (true, true) => missed.push(missed_event(&row, start)?),
                (false, true) if start < misses.scenario.warm_up_end() => misses.in_warm_up += 1,
                _ => {}
            }
        }
        let nearest = misses.nearest_devices(missed.iter().map(|event| event.epicentre));
        for (event, (device, distance_m)) in missed.iter_mut().zip(nearest) {
            (event.nearest, event.distance_m) = (device, distance_m);
        }
        misses.missed = missed;
        self.check_event_counts(&misses)?;
        let metric = |name: &str| self.summary.as_ref()?["metrics"][name].as_f64();
        misses.energy = metric("low_energy_pct").zip(metric("overflow_per_device_tti")).map(
            |(low_energy_pct, overflow_per_device_tti)| RunEnergy {
                low_energy_pct,
                overflow_per_device_tti,
            },
        );
        misses.end = match (self.ttis_done(), misses.counted_starts.last()) {
            (Some(ttis_done), _) => ttis_done,
            (None, Some(last)) => *last + 1,
            (None, None) => misses.end,
        };
        Ok(misses)
    }

    /// Compares the counted events and missed events in `events.csv` with the summary of a complete run.
    ///
    /// # Errors
    /// If they differ.
    fn check_event_counts(&self, misses: &Misses) -> anyhow::Result<()> {
        let Some(summary) = self.summary.as_ref().filter(|summary| summary["status"] == "complete") else {
            return Ok(());
        };
        let totals = &summary["totals"]["events"];
        let expected = ["events", "misdetected"].map(|name| totals[name].as_u64());
        let found = [misses.counted_starts.len(), misses.missed.len()].map(|count| Some(count as u64));
        if expected == found {
            return Ok(());
        }
        let [expected, found] = [expected, found]
            .map(|[events, missed]| format!("{} events and {} missed ones", events.unwrap_or(0), missed.unwrap_or(0)));
        bail!(
            "{}: {EVENTS_FILE} has {found}, {SUMMARY_FILE} {expected}; the table is truncated or changed, repeat the \
             run",
            self.path.display()
        )
    }

    /// Reads the rows of `devices.csv`; `None` before the end of the run, which writes it.
    ///
    /// # Errors
    /// If it is invalid.
    pub(crate) fn devices(&self) -> anyhow::Result<Option<RowTable>> {
        self.table(DEVICES_FILE)
    }
}

/// Whether the folder has a summary that is not JSON.
fn has_broken_summary(folder: &Path) -> bool {
    fs::read(folder.join(SUMMARY_FILE)).is_ok_and(|text| serde_json::from_slice::<Value>(&text).is_err())
}

/// Reads a missed event. Its nearest device and distance are placeholders that the caller replaces.
fn missed_event(row: &Row<'_>, start: Tti) -> anyhow::Result<MissedEvent> {
    let cause = match row.text("miss_cause") {
        None | Some("") => None,
        Some(name) => Some(
            MissCause::from_name(name)
                .with_context(|| format!("{}: unknown cause of a missed event, `{name}`", row.place("miss_cause")))?,
        ),
    };
    Ok(MissedEvent {
        event: row.number("event")?,
        start,
        epicentre: Point::new(row.number("x_m")?, row.number("y_m")?),
        cause,
        nearest: DeviceId(0),
        distance_m: f64::NAN,
    })
}

/// Describes an error in a row. The usual one is a row that a full disk or an editor has cut.
fn describe_table_error(error: csv::Error) -> anyhow::Error {
    let csv::ErrorKind::UnequalLengths { pos, expected_len, len } = error.kind() else {
        return error.into();
    };
    let line = pos.as_ref().map_or(0, csv::Position::line);
    anyhow!("line {line}: {len} of {expected_len} columns; the file was cut or edited, run the scenario again")
}

impl RowTable {
    fn read(path: PathBuf) -> anyhow::Result<Self> {
        let path_text = || path.display().to_string();
        let mut reader = csv::ReaderBuilder::new().from_path(&path).with_context(path_text)?;
        let header = reader.headers().with_context(path_text)?.clone();
        let columns = (0..)
            .zip(&header)
            .map(|(index, name)| (name.to_owned(), index))
            .collect();
        let rows = reader
            .into_records()
            .collect::<Result<Vec<_>, _>>()
            .map_err(describe_table_error)
            .with_context(path_text)?;
        Ok(Self {
            path,
            header,
            columns,
            rows,
        })
    }

    /// Returns the position of a column.
    ///
    /// # Errors
    /// If the table has no such column.
    fn column_index(&self, column: &str) -> anyhow::Result<usize> {
        self.columns.get(column).copied().with_context(|| {
            let path = self.path.display();
            format!("{path}: has no column {column}; repeat the run with this version of Reveille")
        })
    }

    /// The names of the columns, in order.
    pub(crate) fn column_names(&self) -> impl Iterator<Item = &str> {
        self.header.iter()
    }

    /// The rows, in order.
    pub(crate) fn rows(&self) -> impl Iterator<Item = Row<'_>> {
        self.rows.iter().map(|cells| Row { table: self, cells })
    }

    /// The rows by the device in the column `device`.
    ///
    /// # Errors
    /// If a cell of the column is not a number.
    pub(crate) fn by_device(&self) -> anyhow::Result<BTreeMap<DeviceId, Row<'_>>> {
        self.rows()
            .map(|row| Ok((DeviceId(row.number("device")?), row)))
            .collect()
    }
}

/// A row of a table.
#[derive(Clone, Copy)]
pub(crate) struct Row<'t> {
    table: &'t RowTable,
    cells: &'t csv::StringRecord,
}

impl<'t> Row<'t> {
    /// The cell in a column; `None` if the table has no such column.
    pub(crate) fn text(&self, column: &str) -> Option<&'t str> {
        self.cells.get(*self.table.columns.get(column)?)
    }

    /// Returns the number in a column.
    ///
    /// # Errors
    /// If the table has no such column, or the cell is not a number.
    pub(crate) fn number<T: std::str::FromStr>(&self, column: &str) -> anyhow::Result<T> {
        let text = &self.cells[self.table.column_index(column)?];
        text.parse()
            .ok()
            .with_context(|| format!("{}: not a number, `{text}`", self.place(column)))
    }

    fn place(&self, column: &str) -> String {
        let line = self.cells.position().map_or(0, csv::Position::line);
        format!("{}, line {line}, column {column}", self.table.path.display())
    }
}
