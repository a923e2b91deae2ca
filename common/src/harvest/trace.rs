//! Recorded energy from files.

use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::panel::{self, Panel};
use crate::columns::{self, Columns, LARGEST_FILE};
use crate::declare::choices;
use crate::declare::{
    NOT_NEGATIVE, Reader, ScenarioError, Section, Sink, Value, choice, file, number, text, texts, whole,
};
use crate::ids::{MAX_TTIS, Tti};
use crate::units::{Energy, MAX_UNITS};

choices! {
    /// What follows the last row of a trace.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum TraceEnd {
        /// It begins again.
        Cycle = "cycle",
        /// Nothing more is harvested.
        Stop = "stop",
    }
}

choices! {
    /// What a trace recorded.
    pub enum Quantity {
        /// Energy per TTI.
        Energy = "energy",
        /// Irradiance in W/m², which `harvest.trace.panel` turns into energy.
        Irradiance = "irradiance",
    }
}

crate::declare! {
    /// Recorded energy, or what it comes from.
    #[derive(Clone, Copy, Debug)]
    struct Recorded in "harvest.trace" only with "harvest.kind" = &["trace"]; {
        /// What the file recorded.
        quantity: Quantity = choice::<Quantity>("energy"),
    }
}

crate::declare! {
    /// The record.
    #[derive(Clone, Debug)]
    struct Settings in "harvest.trace" only with "harvest.kind" = &["trace"]; {
        /// A CSV file with a header, or a Parquet file in a build with that feature. Relative to the scenario file.
        file: Option<String> = file(),
        /// The column that all devices read.
        column: Option<String> = text().instead_of("columns"),
        /// Columns of which the i-th device of a class reads the i-th, in a circle.
        columns: Option<Vec<String>> = texts().instead_of("column"),
        /// Energy for one in the file.
        scale: f64 = number(NOT_NEGATIVE, 1.0).unit("units"),
        /// How long one row lasts; its energy comes in each of them.
        ttis_per_row: u64 = whole(1, MAX_TTIS, 1).unit("TTIs"),
        /// What follows the last row.
        end: TraceEnd = choice::<TraceEnd>("cycle"),
    }
}

/// Recorded energy per TTI.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// The file it came from.
    pub file: PathBuf,
    /// Where the columns were taken.
    pub columns: TraceColumns,
    /// Units of energy for one unit in the file, ≥ 0.
    pub scale: f64,
    /// TTIs that one row lasts, ≥ 1; its energy comes in each of them.
    pub ttis_per_row: u64,
    /// What follows the last row.
    pub end: TraceEnd,
    /// What turned the file's irradiance into energy, where that is what it recorded.
    pub panel: Option<Panel>,
    /// Energy per TTI by column and row, scaled; under a panel a row for each TTI.
    pub values: Arc<Vec<Vec<Energy>>>,
}

/// Which column of a trace a device reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TraceColumns {
    /// All devices of the class read this column.
    Shared(String),
    /// The i-th device of the class reads the i-th of these columns, in a circle.
    PerDevice(Vec<String>),
}

impl Trace {
    /// The fields of a trace.
    pub const SECTIONS: [&'static Section; 3] = [Recorded::SECTION, Settings::SECTION, panel::SECTION];

    /// The trace that `reader` has, its values read and scaled.
    pub(super) fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        let panel = match Recorded::read(reader)?.quantity {
            Quantity::Energy => None,
            Quantity::Irradiance => Some(Panel::read(reader)?),
        };
        let mut settings = Settings::read(reader)?;
        if panel.is_some() && (settings.scale, settings.ttis_per_row) != (1.0, 1) {
            (settings.scale, settings.ttis_per_row) = (1.0, 1);
            reader.warn(
                "harvest.trace.scale and ttis_per_row have no effect on irradiance: harvest.trace.panel says what a \
                 row comes to, and how long it lasts",
            );
        }
        let (path, because) = ("harvest.trace.file", "harvest.kind");
        let file = settings.file.ok_or_else(|| reader.needed(path, because))?;
        let columns = match (settings.column, settings.columns) {
            (Some(column), None) => TraceColumns::Shared(column),
            (None, Some(columns)) => TraceColumns::PerDevice(columns),
            (Some(column), Some(_)) => {
                let allowed = "cannot be set together with harvest.trace.columns: all devices share one \
                    column, or each has its own";
                return Err(reader.refuse("harvest.trace.column", column, allowed));
            }
            (None, None) => return Err(reader.needed("harvest.trace.column (or harvest.trace.columns)", because)),
        };
        let file = reader.file(path, &file)?;
        let names = match &columns {
            TraceColumns::Shared(name) => std::slice::from_ref(name),
            TraceColumns::PerDevice(names) => names,
        };
        let values = reader
            .bytes(&file, LARGEST_FILE)
            .map_err(|error| error.to_string())
            .and_then(|bytes| columns::numbers(&file, &bytes, names))
            .and_then(|numbers| match &panel {
                None => energies(&numbers, names, settings.scale),
                Some(panel) => under(panel, &numbers, names, settings.end),
            });
        match values {
            Ok(values) => Ok(Self {
                file,
                columns,
                scale: settings.scale,
                ttis_per_row: settings.ttis_per_row,
                end: settings.end,
                panel,
                values: Arc::new(values),
            }),
            Err(reason) => Err(reader.data(path, file, reason)),
        }
    }

    /// Hands every field to `sink`.
    pub(super) fn visit(&self, sink: &mut dyn Sink) {
        // Without it, a record is what it always was, and so is the hash of its scenario.
        if self.panel.is_some() {
            let quantity = Quantity::Irradiance;
            Recorded { quantity }.visit(sink);
        }
        let section = Settings::SECTION;
        if let Some(field) = section.field("file") {
            sink.field(section, field, Value::Path(&self.file.to_string_lossy()));
            for column in self.values.iter() {
                sink.content(
                    &column
                        .iter()
                        .flat_map(|energy| energy.micro().to_le_bytes())
                        .collect::<Vec<u8>>(),
                );
            }
        }
        let (column, columns) = match &self.columns {
            TraceColumns::Shared(name) => (Some(name.clone()), None),
            TraceColumns::PerDevice(names) => (None, Some(names.clone())),
        };
        let settings = Settings {
            file: None,
            column,
            columns,
            scale: self.scale,
            ttis_per_row: self.ttis_per_row,
            end: self.end,
        };
        settings.visit(sink);
        panel::visit(self.panel.as_ref(), sink);
    }

    /// The most that comes in a TTI.
    pub(super) fn peak(&self) -> Energy {
        self.values.iter().flatten().max().copied().unwrap_or_default()
    }

    /// The column, counted from the first, that the `nth` device of a class reads.
    pub(super) fn column_of(&self, nth: u32) -> u32 {
        match &self.columns {
            TraceColumns::Shared(_) => 0,
            TraceColumns::PerDevice(columns) => nth % columns.len() as u32,
        }
    }

    /// The source that reads trace number `trace` of a run.
    pub(super) fn setup(&self, trace: u32) -> TraceSetup {
        TraceSetup {
            trace,
            ttis_per_row: self.ttis_per_row,
            end: self.end,
        }
    }
}

/// `numbers` by column and row as energy per TTI.
fn energies(numbers: &Columns<f64>, names: &[String], scale: f64) -> Result<Vec<Vec<Energy>>, String> {
    let energy = |name: &str, (row, &number): (usize, &f64)| {
        Energy::from_units(number * scale).ok_or_else(|| {
            format!(
                "{}, column `{name}`: {number} times the scale {scale} must be at least 0 and \
                 at most {MAX_UNITS} units",
                numbers.place(row)
            )
        })
    };
    let column =
        |(values, name): (&Vec<f64>, &String)| values.iter().enumerate().map(|item| energy(name, item)).collect();
    numbers.values.iter().zip(names).map(column).collect()
}

/// `numbers` by column and row, W/m², as energy per TTI by column and TTI.
fn under(panel: &Panel, numbers: &Columns<f64>, names: &[String], end: TraceEnd) -> Result<Vec<Vec<Energy>>, String> {
    let column = |(values, name): (&Vec<f64>, &String)| {
        if let Some(row) = values.iter().position(|&value| value < 0.0) {
            return Err(format!(
                "{}, column `{name}`: an irradiance of {} W/m² must be at least 0; write 0 for what a sensor is off at \
                 night",
                numbers.place(row),
                values[row]
            ));
        }
        let energies = panel.energies(values, end == TraceEnd::Stop);
        energies.map_err(|reason| format!("column `{name}`: {reason}"))
    };
    numbers.values.iter().zip(names).map(column).collect()
}

/// Recorded energy, as a device needs it: one of the run's traces.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TraceSetup {
    /// The number of the trace among the run's traces.
    pub trace: u32,
    /// TTIs that one row lasts, ≥ 1.
    pub ttis_per_row: u64,
    /// What follows the last row.
    pub end: TraceEnd,
}

impl TraceSetup {
    /// Its rows among the run's `traces`.
    fn rows<'t>(&self, traces: &'t [Arc<Vec<Energy>>]) -> Option<&'t Arc<Vec<Energy>>> {
        traces.get(self.trace as usize)
    }

    /// Whether a device can be given it.
    pub(super) fn is_sound(&self, traces: &[Arc<Vec<Energy>>]) -> bool {
        self.ttis_per_row > 0 && self.rows(traces).is_some_and(|rows| !rows.is_empty())
    }

    /// The mean harvest in a TTI.
    pub(super) fn mean(&self, traces: &[Arc<Vec<Energy>>]) -> Energy {
        let rows = self.rows(traces).map_or(&[][..], |rows| rows);
        let sum: u128 = rows.iter().map(|energy| u128::from(energy.micro())).sum();
        Energy::from_micro((sum / (rows.len() as u128).max(1)) as u64)
    }

    /// The source, and the TTI of its first arrival.
    pub(super) fn source(&self, traces: &[Arc<Vec<Energy>>]) -> (TraceSource, Tti) {
        let source = TraceSource {
            rows: Arc::clone(&traces[self.trace as usize]),
            ttis_per_row: self.ttis_per_row,
            end: self.end,
        };
        let next = source.next_from(Tti::ZERO);
        (source, next)
    }
}

/// Recorded energy at one device.
#[derive(Clone, Debug)]
pub(super) struct TraceSource {
    rows: Arc<Vec<Energy>>,
    ttis_per_row: u64,
    end: TraceEnd,
}

impl TraceSource {
    /// The arrival in `now`, and the TTI of the next.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        let row = now.0 / self.ttis_per_row % self.rows.len() as u64;
        (self.rows[row as usize], self.next_from(now + 1))
    }

    /// The first TTI, not before `from`, whose row is not zero.
    fn next_from(&self, from: Tti) -> Tti {
        let (first, n) = (from.0 / self.ttis_per_row, self.rows.len() as u64);
        let past_last = match self.end {
            TraceEnd::Cycle => first.saturating_add(n + 1),
            TraceEnd::Stop => n,
        };
        (first..past_last)
            .find(|&row| self.rows[(row % n) as usize] > Energy::ZERO)
            .map_or(Tti::NEVER, |row| Tti((row * self.ttis_per_row).max(from.0)))
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn column(text: &str) -> Columns<f64> {
        columns::numbers(Path::new("t.csv"), text.as_bytes(), &["ghi".to_owned()]).expect("a column")
    }

    #[test]
    fn values_are_scaled_to_micro_units() {
        let values = energies(&column("ghi\n0\n500\n"), &["ghi".to_owned()], 0.002).expect("valid");
        assert_eq!(values, [[Energy::ZERO, Energy::from_micro(1_000_000)]]);
    }

    #[test]
    fn a_sensor_that_is_off_at_night_is_named() {
        let panel = Panel {
            area_cm2: 10.0,
            efficiency: 0.1,
            unit_mj: 1.0,
            tti_seconds: 60.0,
            row_seconds: 60.0,
        };
        let names = ["ghi".to_owned()];
        let reason = under(&panel, &column("ghi\n1\n-3\n"), &names, TraceEnd::Cycle).expect_err("negative");
        assert!(
            reason.starts_with("line 3, column `ghi`: an irradiance of -3 W/m² must be"),
            "{reason}"
        );
        // 10 cm² at a tenth: 1 W/m² is 0.1 mJ a second.
        let rows = under(&panel, &column("ghi\n2\n2\n"), &names, TraceEnd::Stop).expect("valid");
        assert_eq!(rows, [[Energy::from_micro(12_000_000); 2]]);
    }

    #[test]
    fn a_negative_value_is_named() {
        let reason = energies(&column("ghi\n1\n-3\n"), &["ghi".to_owned()], 1.0).expect_err("negative");
        assert!(reason.starts_with("line 3, column `ghi`: -3 times"), "{reason}");
    }
}
