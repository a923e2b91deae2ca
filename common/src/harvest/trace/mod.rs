//! The source `trace`: recorded energy, or irradiance that [`super::panel`] converts, from a CSV or Parquet file.
//!
//! The scenario hash covers the converted values, and the names and order of the fields in `visit`. Digests and the
//! reference in `tests/src/` depend on the values too. [`TraceSetup`] and [`TraceEnd`] are part of the wire format
//! (`WIRE_VERSION`). A test compares the words and doc comments of choices and fields with `docs/scenario.md`.

use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::gap::{HarvestGap, longest_gap};
use super::panel::{self, Panel};
use crate::columns::{self, ColumnData, MAX_FILE_BYTES};
use crate::declare::choices;
use crate::declare::{
    FieldReader, FieldSink, FieldValue, NOT_NEGATIVE, ScenarioError, Section, Visit, choice, file, number, text, texts,
    whole,
};
use crate::digits::format_significant;
use crate::ids::{MAX_TTIS, Tti};
use crate::units::{Energy, MAX_UNITS, ROUNDING_RULE, is_changed_by_rounding};

choices! {
    /// Behaviour after the last row of a trace.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum TraceEnd {
        /// The trace starts again from its first row.
        Cycle = "cycle",
        /// The device harvests no more energy.
        Stop = "stop",
    }
}

choices! {
    /// Quantity recorded in a trace.
    pub enum TraceQuantity {
        /// Energy per TTI.
        Energy = "energy",
        /// Irradiance in W/m², which `harvest.trace.panel` converts to energy.
        Irradiance = "irradiance",
    }
}

crate::declare! {
    /// Recorded quantity: energy, or the irradiance from which it is computed.
    #[derive(Clone, Copy, Debug)]
    struct TraceQuantityFields in "harvest.trace" only with "harvest.kind" = &["trace"]; {
        /// Quantity recorded in the file.
        quantity: TraceQuantity = choice::<TraceQuantity>("energy"),
    }
}

crate::declare! {
    /// File, columns and scale of the trace.
    #[derive(Clone, Debug)]
    struct Settings in "harvest.trace" only with "harvest.kind" = &["trace"]; {
        /// CSV file with a header, or Parquet file in a build with that feature. The path is relative to the scenario
        /// file.
        file: Option<String> = file(),
        /// Column that all devices read.
        column: Option<String> = text().instead_of("columns"),
        /// Columns for the devices of a class: the i-th device reads the i-th column, and the list repeats after its
        /// end.
        columns: Option<Vec<String>> = texts().instead_of("column"),
        /// Energy for the value 1 in the file.
        scale: f64 = number(NOT_NEGATIVE, 1.0).unit("units"),
        /// Duration of one row; the device harvests the row's energy in each of its TTIs.
        ttis_per_row: u64 = whole(1, MAX_TTIS, 1).unit("TTIs"),
        /// Behaviour after the last row.
        end: TraceEnd = choice::<TraceEnd>("cycle"),
        /// Row, counted from 0, in which TTI 0 begins. With `end = "cycle"` the rows before it follow the last row;
        /// `"stop"` skips them.
        start: Option<u64> = whole(0, MAX_START_ROW, 0).unit("rows"),
    }
}

/// Largest start row: no file that can be read has more rows.
const MAX_START_ROW: u64 = MAX_FILE_BYTES;

/// A trace of recorded energy per TTI.
#[derive(Clone, Debug, PartialEq)]
pub struct HarvestTrace {
    /// The path of the file.
    pub file: PathBuf,
    /// The selected columns.
    pub columns: TraceColumns,
    /// Units of energy for one unit in the file, ≥ 0.
    pub scale: f64,
    /// TTIs per row, ≥ 1; each of them brings the row's energy.
    pub ttis_per_row: u64,
    /// Behaviour after the last row.
    pub end: TraceEnd,
    /// The panel that converts irradiance to energy, if the file recorded irradiance.
    pub panel: Option<Panel>,
    /// Row of the file in which TTI 0 begins, from 0.
    pub start: u64,
    /// Energy per TTI by column and row, scaled, from row `start` on; under a panel one row per TTI. Of a trace with
    /// too many values for the memory, only the part that the run reads.
    pub values: Arc<Vec<Vec<Energy>>>,
}

/// The columns of a trace that the devices read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TraceColumns {
    /// All devices of the class read this column.
    Shared(String),
    /// The i-th device of the class reads the i-th of these columns, cyclically; at least one.
    PerDevice(Vec<String>),
}

impl HarvestTrace {
    /// The fields of a trace.
    pub(crate) const SECTIONS: [&'static Section; 3] =
        [TraceQuantityFields::SECTION, Settings::SECTION, panel::SECTION];

    /// Builds the trace in `reader` for a run of `ttis` TTIs; reads and scales its values.
    pub(super) fn from_fields(reader: &FieldReader<'_>, ttis: u64) -> Result<Self, ScenarioError> {
        let panel = match TraceQuantityFields::read(reader)?.quantity {
            TraceQuantity::Energy => None,
            TraceQuantity::Irradiance => Some(Panel::read(reader)?),
        };
        let mut settings = Settings::read(reader)?;
        if panel.is_some() && (settings.scale, settings.ttis_per_row) != (1.0, 1) {
            (settings.scale, settings.ttis_per_row) = (1.0, 1);
            reader.warn(
                "harvest.trace.scale and ttis_per_row have no effect on irradiance: harvest.trace.panel sets the \
                 energy and the duration of a row",
            );
        }
        let (field_path, required_by) = ("harvest.trace.file", "harvest.kind");
        let file = settings
            .file
            .ok_or_else(|| reader.missing_value(field_path, required_by))?;
        let columns = match (settings.column, settings.columns) {
            (Some(column), None) => TraceColumns::Shared(column),
            (None, Some(columns)) => TraceColumns::PerDevice(columns),
            (Some(column), Some(_)) => {
                let allowed = "excludes harvest.trace.columns; set only one of them";
                return Err(reader.invalid_value("harvest.trace.column", column, allowed));
            }
            (None, None) => {
                return Err(reader.missing_value("harvest.trace.column (or harvest.trace.columns)", required_by));
            }
        };
        let file = reader.absolute_path(field_path, &file)?;
        let names = match &columns {
            TraceColumns::Shared(name) => std::slice::from_ref(name),
            TraceColumns::PerDevice(names) => names,
        };
        let start = settings.start.unwrap_or(0);
        let first_row = start as usize;
        // An irradiance file is needed as a whole, since its rows are converted together.
        let needed_rows = match &panel {
            None => first_row..first_row.saturating_add(ttis.div_ceil(settings.ttis_per_row) as usize),
            Some(_) => 0..usize::MAX,
        };
        let numbers = reader
            .read_bytes(&file, MAX_FILE_BYTES)
            .map_err(|error| error.to_string())
            .and_then(|bytes| columns::read_numbers(&file, &bytes, names, needed_rows));
        let numbers = match numbers {
            Ok(numbers) => numbers,
            Err(reason) => return Err(reader.file_error(field_path, file, reason)),
        };
        if first_row >= numbers.rows_in_file {
            let allowed = format!(
                "must be below {}, the number of rows of {}",
                numbers.rows_in_file,
                file.display()
            );
            return Err(reader.invalid_value("harvest.trace.start", start, allowed));
        }
        let values =
            start_at_row(numbers, first_row, settings.end, ttis.div_ceil(settings.ttis_per_row)).and_then(|numbers| {
                match &panel {
                    None => scale_to_energy(&numbers, names, settings.scale, &|text| reader.warn(text)),
                    Some(panel) => convert_irradiance(panel, &numbers, names, settings.end, ttis),
                }
            });
        match values {
            Ok(values) => Ok(Self {
                file,
                columns,
                scale: settings.scale,
                ttis_per_row: settings.ttis_per_row,
                end: settings.end,
                panel,
                start,
                values: Arc::new(values),
            }),
            Err(reason) => Err(reader.file_error(field_path, file, reason)),
        }
    }

    pub(super) fn visit(&self, sink: &mut dyn FieldSink) {
        // Omitted for recorded energy, so that the hashes of such scenarios do not depend on the field.
        if self.panel.is_some() {
            let quantity = TraceQuantity::Irradiance;
            TraceQuantityFields { quantity }.visit(sink);
        }
        let section = Settings::SECTION;
        if let Some(field) = section.field("file") {
            sink.field(section, field, FieldValue::Path(&self.file.to_string_lossy()));
            // The values are hashed, not only the path: the file at a path can change.
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
            // Omitted at the first row, so that the hashes of such scenarios do not depend on the field.
            start: (self.start > 0).then_some(self.start),
        };
        settings.visit(sink);
        panel::visit(self.panel.as_ref(), sink);
    }

    pub(super) fn max_per_tti(&self) -> Energy {
        self.values.iter().flatten().max().copied().unwrap_or_default()
    }

    /// The index of the column that the `nth` device of a class reads, both from 0.
    pub(super) fn column_index(&self, nth: u32) -> u32 {
        match &self.columns {
            TraceColumns::Shared(_) => 0,
            TraceColumns::PerDevice(columns) => nth % columns.len() as u32,
        }
    }

    /// The setup of a source that reads trace number `trace` of a run.
    pub(super) fn setup(&self, trace: u32) -> TraceSetup {
        TraceSetup {
            trace,
            ttis_per_row: self.ttis_per_row,
            end: self.end,
        }
    }
}

/// Moves row `start` of the file to the front: the rows before it follow the last one if the trace cycles, and are
/// removed if it stops.
///
/// # Errors
/// If only a part of the file is in `numbers`, and it ends before the run has read `needed_rows` of a trace that
/// cycles. [`columns::read_numbers`] decides whether it keeps a part.
fn start_at_row(
    mut numbers: ColumnData<f64>,
    start: usize,
    end: TraceEnd,
    needed_rows: u64,
) -> Result<ColumnData<f64>, String> {
    if numbers.first_row > 0 || numbers.len() < numbers.rows_in_file {
        // Reading has already moved the row to the front.
        if end == TraceEnd::Cycle && (numbers.len() as u64) < needed_rows {
            return Err(format!(
                "has too many values to repeat: the run needs {needed_rows} rows from row {start} on, and {} follow; \
                 set a smaller harvest.trace.start, fewer ttis or harvest.trace.end = \"stop\"",
                numbers.len()
            ));
        }
        return Ok(numbers);
    }
    match end {
        TraceEnd::Cycle => numbers.rotate_rows(start),
        TraceEnd::Stop => numbers.remove_first_rows(start),
    }
    Ok(numbers)
}

/// Converts `numbers` by column and row to energy per TTI. Warns of columns whose mean changes by rounding.
fn scale_to_energy(
    numbers: &ColumnData<f64>,
    names: &[String],
    scale: f64,
    warn: &dyn Fn(String),
) -> Result<Vec<Vec<Energy>>, String> {
    let energy = |name: &str, (row, &number): (usize, &f64)| {
        Energy::from_units(number * scale).ok_or_else(|| {
            format!(
                "{}, column `{name}`: {number} times the scale {scale} must be at least 0 and \
                 at most {MAX_UNITS} units",
                numbers.describe_row(row)
            )
        })
    };
    let column = |(values, name): (&Vec<f64>, &String)| {
        let energies: Vec<Energy> = values
            .iter()
            .enumerate()
            .map(|item| energy(name, item))
            .collect::<Result<_, _>>()?;
        let rows = values.len().max(1) as f64;
        let exact_mean = scale * values.iter().sum::<f64>() / rows;
        let rounded_mean = energies.iter().map(|energy| energy.units()).sum::<f64>() / rows;
        if is_changed_by_rounding(exact_mean, rounded_mean) {
            let [exact_mean, rounded_mean] = [exact_mean, rounded_mean].map(|mean| format_significant(mean, 3));
            warn(format!(
                "the mean of column `{name}` of the trace changes from {exact_mean} to {rounded_mean} per TTI, since \
                 {ROUNDING_RULE}"
            ));
        }
        Ok(energies)
    };
    numbers.values.iter().zip(names).map(column).collect()
}

/// Converts `numbers` by column and row, W/m², to energy per TTI by column and TTI, for a run of `ttis` TTIs.
fn convert_irradiance(
    panel: &Panel,
    numbers: &ColumnData<f64>,
    names: &[String],
    end: TraceEnd,
    ttis: u64,
) -> Result<Vec<Vec<Energy>>, String> {
    let column = |(values, name): (&Vec<f64>, &String)| {
        if let Some(row) = values.iter().position(|&value| value < 0.0) {
            return Err(format!(
                "{}, column `{name}`: the irradiance {} W/m² must be at least 0; write 0 for negative offsets at night",
                numbers.describe_row(row),
                values[row]
            ));
        }
        let energies = panel.energies(values, end == TraceEnd::Stop, ttis);
        energies.map_err(|reason| format!("column `{name}`: {reason}"))
    };
    numbers.values.iter().zip(names).map(column).collect()
}

/// The setup of a trace source on a device: one of the run's traces.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TraceSetup {
    /// Index in the run's traces.
    pub trace: u32,
    /// TTIs per row, ≥ 1.
    pub ttis_per_row: u64,
    /// Behaviour after the last row.
    pub end: TraceEnd,
}

impl TraceSetup {
    /// The rows of this trace, from the run's `traces`, energy per TTI; `None` if it is not among them.
    fn find_rows<'t>(&self, traces: &'t [Arc<Vec<Energy>>]) -> Option<&'t Arc<Vec<Energy>>> {
        traces.get(self.trace as usize)
    }

    pub(super) fn is_valid(&self, traces: &[Arc<Vec<Energy>>]) -> bool {
        self.ttis_per_row > 0 && self.find_rows(traces).is_some_and(|rows| !rows.is_empty())
    }

    /// The mean per TTI of all rows, rounded down to micro-units. A base station does not know that a trace stops.
    pub(super) fn mean(&self, traces: &[Arc<Vec<Energy>>]) -> Energy {
        let rows = self.find_rows(traces).map_or(&[][..], |rows| rows);
        let sum: u128 = rows.iter().map(|energy| u128::from(energy.micro())).sum();
        Energy::from_micro((sum / (rows.len() as u128).max(1)) as u64)
    }

    /// The harvest in the first `ttis` TTIs, micro-units; 0 if `traces` lacks this trace.
    pub(super) fn micro_in(&self, traces: &[Arc<Vec<Energy>>], ttis: u64) -> u128 {
        let rows = self.find_rows(traces).map_or(&[][..], |rows| rows);
        let sum = |rows: &[Energy]| rows.iter().map(|energy| u128::from(energy.micro())).sum::<u128>();
        let per_row = u128::from(self.ttis_per_row);
        let trace_ttis = rows.len() as u128 * per_row;
        let (cycles, last_cycle_ttis) = match u128::from(ttis).checked_div(trace_ttis) {
            None => return 0,
            Some(cycles) => (cycles, u128::from(ttis) % trace_ttis),
        };
        if cycles > 0 && self.end == TraceEnd::Stop {
            return sum(rows) * per_row;
        }
        let (row, ttis_in_row) = ((last_cycle_ttis / per_row) as usize, last_cycle_ttis % per_row);
        let micro_in_row = u128::from(rows[row].micro()) * ttis_in_row;
        (cycles * sum(rows) + sum(&rows[..row])) * per_row + micro_in_row
    }

    /// The longest gap of the first `ttis` TTIs, in rows without energy.
    pub(super) fn longest_gap(&self, traces: &[Arc<Vec<Energy>>], ttis: u64) -> HarvestGap {
        let rows = self.find_rows(traces).map_or(&[][..], |rows| rows);
        let parts = rows.iter().map(|energy| (*energy == Energy::ZERO, self.ttis_per_row));
        longest_gap(parts, self.end == TraceEnd::Stop, ttis)
    }

    /// Creates the source. Also returns the TTI of its first arrival.
    ///
    /// # Panics
    /// If the setup is not [valid](Self::is_valid) with these `traces`.
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

#[derive(Clone, Debug)]
pub(super) struct TraceSource {
    rows: Arc<Vec<Energy>>,
    ttis_per_row: u64,
    end: TraceEnd,
}

impl TraceSource {
    /// Returns the arrival in `now` and the TTI of the next one.
    #[inline]
    pub(super) fn take(&mut self, now: Tti) -> (Energy, Tti) {
        let row = now.0 / self.ttis_per_row % self.rows.len() as u64;
        (self.rows[row as usize], self.next_from(now + 1))
    }

    /// The first TTI, not before `from`, whose row is not zero.
    fn next_from(&self, from: Tti) -> Tti {
        let (first_row, row_count) = (from.0 / self.ttis_per_row, self.rows.len() as u64);
        let past_last = match self.end {
            TraceEnd::Cycle => first_row.saturating_add(row_count + 1),
            TraceEnd::Stop => row_count,
        };
        (first_row..past_last)
            .find(|&row| self.rows[(row % row_count) as usize] > Energy::ZERO)
            .map_or(Tti::NEVER, |row| Tti((row * self.ttis_per_row).max(from.0)))
    }
}

#[cfg(test)]
mod tests;
