//! A run that `reveille compare` compares: its folder, or a recording of it. Texts of [`Difference`] are also `first`
//! in `--json`; `docs/reading-results.md` shows them.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use reveille_common::message::{Message, MessageKind, OperatorAction};
use reveille_common::score::Metrics;
use reveille_lab::metric_estimate::{MAX_FEW_CASES_OF_ONE_RUN, value_per_case};
use reveille_lab::stats::ratio_half_width;
use reveille_view::compare::RunSide;
use serde_json::Value;

use super::messages;
use crate::commands::inspect::source::{RecordingFile, open_recording};
use crate::results_table::is_cause;
use crate::run_folder::{EVENTS_FILE, SCENARIO_FILE, WINDOWS_FILE};
use crate::run_reader::{Row, RowTable, RunReader};

/// Number of parts of a run from whose means a half-width is computed; the text in `super::text_report` names it.
const PARTS: usize = 10;
/// Most columns of `events.csv` that a difference names.
const MAX_NAMED_COLUMNS: usize = 3;

/// The tables of a run folder, or a recording.
enum Source {
    Folder(Box<RunReader>),
    Recording(PathBuf),
}

/// A run with its results.
pub(super) struct ComparedRun {
    path: PathBuf,
    source: Source,
    /// The scenario file, as TOML.
    scenario_text: String,
    /// `summary.json`; null for a recording without a summary.
    summary: Value,
    actions: Vec<OperatorAction>,
    /// The windows of measured TTIs in `windows.csv`; empty for a recording.
    windows: Vec<Window>,
}

/// A row of `windows.csv`: sums over the events of the window, and means over devices and TTIs from
/// `energy_per_device_tti` on.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    ttis: f64,
    events: f64,
    misdetected: f64,
    delay_ttis: f64,
    information: f64,
    wake_ups: f64,
    wrong_activations: f64,
    energy_per_device_tti: f64,
    mean_battery: f64,
    low_energy_pct: f64,
}

impl ComparedRun {
    /// Opens the run folder or recording at `path`.
    ///
    /// # Errors
    /// If it is neither, or the run has no results yet.
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        if path.is_file() {
            let mut recording = open_recording(path)?;
            let summary = recording.summary().map(serde_json::from_str).transpose();
            return Ok(Self {
                path: path.to_owned(),
                scenario_text: recording.bundle().text.clone(),
                summary: summary.with_context(|| path.display().to_string())?.unwrap_or_default(),
                actions: recorded_actions(&mut recording),
                source: Source::Recording(path.to_owned()),
                windows: Vec::new(),
            });
        }
        if !path.exists() {
            bail!(
                "{}: no such file or folder; name the folder of a run, such as runs/knn-n50-s1, or a recording",
                path.display()
            );
        }
        let reader = RunReader::open(path)?;
        let Some(summary) = reader.summary.clone() else {
            let state = reader.unfinished_state().unwrap_or_default();
            bail!(
                "{}: {state}, so it has no results; wait for its end, or resume it",
                path.display()
            );
        };
        let scenario_file = path.join(SCENARIO_FILE);
        Ok(Self {
            path: path.to_owned(),
            scenario_text: std::fs::read_to_string(&scenario_file)
                .with_context(|| scenario_file.display().to_string())?,
            windows: read_windows(&reader)?,
            actions: reader.actions()?,
            source: Source::Folder(Box::new(reader)),
            summary,
        })
    }

    /// The path as given.
    pub(super) fn name(&self) -> String {
        self.path.display().to_string()
    }

    /// The scenario file.
    pub(super) fn scenario_text(&self) -> &str {
        &self.scenario_text
    }

    /// The summary; null for a recording without one.
    pub(super) const fn summary(&self) -> &Value {
        &self.summary
    }

    /// The actions of operators and scripts, in the order in which they take effect.
    pub(super) fn actions(&self) -> &[OperatorAction] {
        &self.actions
    }

    /// The digest, if there is a summary.
    pub(super) fn digest(&self) -> Option<&str> {
        self.summary["digest"].as_str()
    }

    /// Describes a run whose results do not cover all TTIs, followed by a comma; else empty.
    pub(super) fn state(&self) -> String {
        match self.summary["status"].as_str() {
            Some("interrupted") => format!("interrupted before TTI {}, ", self.summary["ttis_done"]),
            _ => String::new(),
        }
    }

    /// The value of a metric; NaN if it is undefined.
    pub(super) fn metric(&self, name: &str) -> f64 {
        self.summary["metrics"][name].as_f64().unwrap_or(f64::NAN)
    }

    /// Half the width of the 95 % interval of a metric, from the means of ten parts of the measured TTIs; `None` for
    /// recordings, short runs, few cases, metrics without an entry, and intervals that would reach below 0.
    pub(super) fn half_width(&self, metric: &str) -> Option<f64> {
        let half_width = self.half_width_of_parts(metric)?;
        let is_difference = Metrics::find(metric).is_some_and(|metric| metric.is_difference);
        let reaches_below_0 = !is_difference && half_width > self.metric(metric);
        (!reaches_below_0 && !self.has_few_cases(metric)).then_some(half_width)
    }

    /// Whether `metric` counts cases per event, such as missed events, and the run has too few for an interval.
    pub(super) fn has_few_cases(&self, metric: &str) -> bool {
        let events = self.summary["totals"]["events"]["events"].as_f64().unwrap_or(f64::NAN);
        let value_per_case = value_per_case(metric).or_else(|| is_cause(metric).then_some(100.0));
        value_per_case.is_some_and(|per_case| {
            let cases = (self.metric(metric) * events / per_case).round();
            cases <= MAX_FEW_CASES_OF_ONE_RUN as f64
        })
    }

    /// Computes the half-width, also where it is not shown. The entries repeat the definitions in
    /// `common/src/score/metrics.rs` for the columns of `windows.csv`.
    fn half_width_of_parts(&self, metric: &str) -> Option<f64> {
        let alpha = self.summary["start_probability"].as_f64().unwrap_or(f64::NAN);
        let ratio: fn(&Window, f64) -> (f64, f64) = match metric {
            "info_p1" => |w, alpha| (w.information, alpha * w.ttis),
            "info_per_event" => |w, _| (w.information, w.events),
            "misdetection_pct" => |w, _| (100.0 * w.misdetected, w.events),
            "detection_delay_ttis" => |w, _| (w.delay_ttis, w.events - w.misdetected),
            "wake_ups_per_event" => |w, _| (w.wake_ups, w.events),
            "wrong_activations_per_event" => |w, _| (w.wrong_activations, w.events),
            "energy_per_device_tti" => |w, _| (w.energy_per_device_tti * w.ttis, w.ttis),
            "mean_battery" => |w, _| (w.mean_battery * w.ttis, w.ttis),
            "low_energy_pct" => |w, _| (w.low_energy_pct * w.ttis, w.ttis),
            _ => return None,
        };
        if self.windows.len() < PARTS {
            return None;
        }
        let mut parts = [(0.0, 0.0); PARTS];
        for (index, window) in self.windows.iter().enumerate() {
            let (sum, count) = ratio(window, alpha);
            let part = &mut parts[index * PARTS / self.windows.len()];
            *part = (part.0 + sum, part.1 + count);
        }
        ratio_half_width(&parts).filter(|half_width| half_width.is_finite())
    }

    /// Compares this run, run 1, with `other`, run `other_number`.
    ///
    /// # Errors
    /// If a table or recording cannot be read.
    pub(super) fn compare(&self, other: &Self, other_number: usize) -> anyhow::Result<Difference> {
        let has_equal_digest = self.digest().is_some() && self.digest() == other.digest();
        match (&self.source, &other.source) {
            (Source::Recording(own_path), Source::Recording(other_path)) => {
                let mut recordings = (open_recording(own_path)?, open_recording(other_path)?);
                let difference = messages::compare(&mut recordings.0, &mut recordings.1, other_number);
                let torn = difference.torn.map(|(side, error)| {
                    let path = if side == RunSide::This { own_path } else { other_path };
                    format!(
                        "{}: {error}; the recordings were compared up to this point",
                        path.display()
                    )
                });
                Ok(Difference {
                    is_equal: difference.text.is_none() && torn.is_none(),
                    text: difference
                        .text
                        .unwrap_or_else(|| "no difference in the messages".to_owned()),
                    torn,
                })
            }
            _ if has_equal_digest => Ok(Difference {
                is_equal: true,
                text: "equal digests: the runs are identical".to_owned(),
                torn: None,
            }),
            (Source::Folder(own_reader), Source::Folder(other_reader)) => {
                let events_of = |reader: &RunReader| {
                    let missing = || format!("{}: no {EVENTS_FILE}; repeat the run", reader.path().display());
                    reader.table(EVENTS_FILE)?.with_context(missing)
                };
                let (own_events, other_events) = (events_of(own_reader)?, events_of(other_reader)?);
                Ok(Difference {
                    is_equal: false,
                    text: first_event_difference(&own_events, &other_events, other_number)?,
                    torn: None,
                })
            }
            _ => Ok(Difference {
                is_equal: false,
                text: "different digests; compare two recordings or two run folders to find the first difference"
                    .to_owned(),
                torn: None,
            }),
        }
    }
}

/// The difference of two runs.
pub(super) struct Difference {
    /// Whether the runs are identical: by their messages if both are recordings, else by their digests.
    pub(super) is_equal: bool,
    /// Description of the first difference, or of the equality.
    pub(super) text: String,
    /// The error of a torn recording, with its path; the command prints the rest, then fails with it.
    pub(super) torn: Option<String>,
}

/// Reads the actions in the rest of a recording, up to a tear.
fn recorded_actions(recording: &mut RecordingFile) -> Vec<OperatorAction> {
    let mut actions = Vec::new();
    while let Ok(Some(frame)) = recording.next_frame() {
        if frame.kind == MessageKind::Action
            && let Ok(Message::Action(action)) = frame.message()
        {
            actions.push(action);
        }
    }
    actions
}

/// Reads the windows that contain only measured TTIs.
fn read_windows(reader: &RunReader) -> anyhow::Result<Vec<Window>> {
    let Some(table) = reader.table(WINDOWS_FILE)? else {
        return Ok(Vec::new());
    };
    let mut windows = Vec::new();
    for row in table.rows() {
        let (first, end): (u64, u64) = (row.number("first_tti")?, row.number("end_tti")?);
        if first < reader.scenario.warm_up_end().0 {
            continue;
        }
        windows.push(Window {
            ttis: end.saturating_sub(first) as f64,
            events: row.number("events")?,
            misdetected: row.number("misdetected")?,
            delay_ttis: row.number("delay_ttis")?,
            information: row.number("information")?,
            wake_ups: row.number("wake_ups")?,
            wrong_activations: row.number("wrong_activations")?,
            energy_per_device_tti: row.number("energy_per_device_tti")?,
            mean_battery: row.number("mean_battery")?,
            low_energy_pct: row.number("low_energy_pct")?,
        });
    }
    Ok(windows)
}

/// Describes the first row in which the tables of events of run 1, `this`, and run `other_number` differ.
fn first_event_difference(this: &RowTable, other: &RowTable, other_number: usize) -> anyhow::Result<String> {
    const RECORDING_HINT: &str = "folders show events only; record both runs with --record to compare all messages";
    let (mut own_rows, mut other_rows) = (this.rows(), other.rows());
    loop {
        let (row, counterpart) = match (own_rows.next(), other_rows.next()) {
            (Some(row), Some(counterpart)) => (row, counterpart),
            (Some(row), None) => return Ok(format!("{} is only in run 1; {RECORDING_HINT}", event_label(&row)?)),
            (None, Some(row)) => {
                return Ok(format!(
                    "{} is only in run {other_number}; {RECORDING_HINT}",
                    event_label(&row)?
                ));
            }
            (None, None) => return Ok(format!("different digests, but equal events; {RECORDING_HINT}")),
        };
        // The warm-up is a share of the run, so the same event can be counted in one run only.
        let columns = this.column_names().filter(|column| *column != "counted");
        let differing = columns.filter_map(|column| {
            let (value, other_value) = (row.text(column)?, counterpart.text(column)?);
            let shown = |value: &str| if value.is_empty() { "none" } else { value }.to_owned();
            (value != other_value).then(|| {
                format!(
                    "{column} {} in run 1, {} in run {other_number}",
                    shown(value),
                    shown(other_value)
                )
            })
        });
        let differing: Vec<String> = differing.take(MAX_NAMED_COLUMNS).collect();
        if !differing.is_empty() {
            return Ok(format!(
                "first difference in {}: {}; {RECORDING_HINT}",
                event_label(&row)?,
                differing.join("; ")
            ));
        }
    }
}

fn event_label(row: &Row<'_>) -> anyhow::Result<String> {
    let (event, start): (u64, u64) = (row.number("event")?, row.number("start_tti")?);
    Ok(format!("event {event} of TTI {start}"))
}
