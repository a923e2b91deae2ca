//! Encoding and decoding of tables as CSV, for `io`. A table reads back with equal values; `parquet` has the same
//! columns. The fixed columns are written and read by position, in the order of `columns`. The sidecar holds the types
//! of the swept columns; without it, they are guessed.

use std::str::FromStr;
use std::sync::Arc;

use reveille_common::digits::count_noun;
use reveille_common::score::Metrics;

use super::Table;
use super::columns::{ColumnType, FileColumns, IDENTITY_COLUMNS, Schema, SweptValue};
use super::error::SchemaMismatch;
use super::row::{LastText, ResultRow};
use super::sidecar::Sidecar;

/// Encodes the file of `table`. Numbers read back as the same bits.
pub(super) fn to_bytes(table: &Table) -> Result<Vec<u8>, String> {
    encode(table).map_err(|error| error.to_string())
}

fn encode(table: &Table) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(table.schema.names())?;
    for row in &table.rows {
        let identity = [
            row.scenario_hash.to_string(),
            row.preset.to_string(),
            row.policy.to_string(),
            row.n.to_string(),
            row.ttis.to_string(),
            row.seed.to_string(),
        ];
        let swept = row.swept.iter().map(format_value);
        let metrics = row.metrics.iter().map(|value| {
            if value.is_nan() {
                String::new()
            } else {
                value.to_string()
            }
        });
        let trailing = [row.events.to_string(), row.digest.to_string()];
        writer.write_record(identity.into_iter().chain(swept).chain(metrics).chain(trailing))?;
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}

/// Formats a swept value. A float with a whole value keeps its decimal point, so that its column stays one of floats.
fn format_value(value: &SweptValue) -> String {
    match value {
        SweptValue::Float(value) => format!("{value:?}"),
        SweptValue::Int(_) | SweptValue::Text(_) => value.to_string(),
    }
}

/// Returns the swept columns `names`, with the types in the sidecar or else guessed from the values.
fn schema_of_records(
    names: Vec<String>,
    sidecar_types: Option<Vec<ColumnType>>,
    records: &[csv::StringRecord],
) -> Result<Schema, SchemaMismatch> {
    let types = sidecar_types.unwrap_or_else(|| {
        let column_type = |column: usize| {
            // The reader refuses rows of another length than the header, so the index is valid.
            let types = records
                .iter()
                .map(|record| guess_type(&record[IDENTITY_COLUMNS.len() + column]));
            types.reduce(ColumnType::join).unwrap_or(ColumnType::Text)
        };
        (0..names.len()).map(column_type).collect()
    });
    if types.len() != names.len() {
        let (listed, found) = (types.len(), names.len());
        return Err(SchemaMismatch::Broken(format!(
            "its side-car lists {listed} swept columns, but it has {found}"
        )));
    }
    Ok(Schema {
        swept: names.into_iter().zip(types).collect(),
    })
}

/// Decodes the table in `text`, with the content of its sidecar.
pub(super) fn decode(text: &str, sidecar: Sidecar) -> Result<Table, SchemaMismatch> {
    let broken = |error: csv::Error| SchemaMismatch::Broken(error.to_string());
    if !text.ends_with('\n') {
        return Err(SchemaMismatch::Broken("its last row is incomplete".to_owned()));
    }
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let header = reader.headers().map_err(broken)?.clone();
    let records = reader.records().collect::<Result<Vec<_>, _>>().map_err(broken)?;
    let columns = FileColumns::from_header(&header.iter().collect::<Vec<_>>())?;
    let schema = schema_of_records(columns.swept_names, sidecar.column_types, &records)?;
    if let Some(rows) = sidecar.row_count.filter(|rows| *rows != records.len()) {
        let found = records.len();
        return Err(SchemaMismatch::Broken(format!(
            "it has {}, but its side-car says {rows}",
            count_noun(found, "row")
        )));
    }
    Ok(Table {
        metadata: sidecar.metadata,
        rows: decode_rows(&schema, &columns.metric_indices, &records)?,
        schema,
    })
}

/// Decodes the rows. `metric_indices` are the indices in [`Metrics::NAMES`] of the file's metrics, in its order.
fn decode_rows(
    schema: &Schema,
    metric_indices: &[usize],
    records: &[csv::StringRecord],
) -> Result<Vec<ResultRow>, SchemaMismatch> {
    let (mut last_preset, mut last_policy) = (LastText::default(), LastText::default());
    let mut last_swept = Arc::from([]);
    let mut rows = Vec::with_capacity(records.len());
    for (index, record) in records.iter().enumerate() {
        let fields = CsvRecord { record, index };
        let swept: Vec<SweptValue> = schema
            .swept
            .iter()
            .enumerate()
            .map(|(column, (_, column_type))| fields.parse_swept(IDENTITY_COLUMNS.len() + column, *column_type))
            .collect::<Result<_, _>>()?;
        // Rows are sorted by cell, so nearly all of them share the values of the previous row.
        if *last_swept != *swept {
            last_swept = Arc::from(swept);
        }
        let first_metric = IDENTITY_COLUMNS.len() + schema.swept.len();
        let mut metrics = [f64::NAN; Metrics::COUNT];
        for (column, metric_index) in (first_metric..).zip(metric_indices) {
            if !record[column].is_empty() {
                metrics[*metric_index] = fields.parse(column)?;
            }
        }
        let events_column = first_metric + metric_indices.len();
        // The positions of `IDENTITY_COLUMNS` and `TRAILING_COLUMNS`.
        let row = ResultRow {
            scenario_hash: fields.parse(0)?,
            preset: last_preset.intern(&record[1]),
            policy: last_policy.intern(&record[2]),
            n: fields.parse(3)?,
            ttis: fields.parse(4)?,
            seed: fields.parse(5)?,
            swept: Arc::clone(&last_swept),
            metrics,
            events: fields.parse(events_column)?,
            digest: fields.parse(events_column + 1)?,
        };
        rows.push(row.check(index + 1)?);
    }
    Ok(rows)
}

fn guess_type(text: &str) -> ColumnType {
    if text.parse::<i64>().is_ok() {
        ColumnType::Int
    } else if text.parse::<f64>().is_ok() {
        ColumnType::Float
    } else {
        ColumnType::Text
    }
}

/// One row of the file.
struct CsvRecord<'r> {
    record: &'r csv::StringRecord,
    /// The index of the row, from 0; errors count from 1.
    index: usize,
}

impl CsvRecord<'_> {
    fn parse<T: FromStr>(&self, column: usize) -> Result<T, SchemaMismatch> {
        let text = &self.record[column];
        text.parse().map_err(|_| {
            let row = self.index + 1;
            SchemaMismatch::Broken(format!(
                "row {row}, field {}: \"{}\"",
                column + 1,
                text.escape_default()
            ))
        })
    }

    fn parse_swept(&self, column: usize, column_type: ColumnType) -> Result<SweptValue, SchemaMismatch> {
        Ok(match column_type {
            ColumnType::Int => SweptValue::Int(self.parse(column)?),
            ColumnType::Float => SweptValue::Float(self.parse(column)?),
            ColumnType::Text => SweptValue::Text(self.record[column].to_owned()),
        })
    }
}
