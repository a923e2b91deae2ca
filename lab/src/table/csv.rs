//! Encoding and decoding of tables as CSV. A table reads back with equal values; `parquet` has the same columns.

use std::str::FromStr;
use std::sync::Arc;

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
        let tail = [row.events.to_string(), row.digest.to_string()];
        writer.write_record(identity.into_iter().chain(swept).chain(metrics).chain(tail))?;
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
fn read_schema(
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
    let FileColumns { swept, metrics } = FileColumns::of_header(&header.iter().collect::<Vec<_>>())?;
    let schema = read_schema(swept, sidecar.column_types, &records)?;
    if let Some(rows) = sidecar.row_count.filter(|rows| *rows != records.len()) {
        let found = records.len();
        return Err(SchemaMismatch::Broken(format!(
            "it has {found} rows, but its side-car says {rows}"
        )));
    }
    Ok(Table {
        metadata: sidecar.metadata,
        rows: decode_rows(&schema, &metrics, &records)?,
        schema,
    })
}

fn decode_rows(
    schema: &Schema,
    metric_columns: &[usize],
    records: &[csv::StringRecord],
) -> Result<Vec<ResultRow>, SchemaMismatch> {
    let (mut preset, mut policy, mut cell) = (LastText::default(), LastText::default(), Arc::from([]));
    let mut rows = Vec::with_capacity(records.len());
    for (index, record) in records.iter().enumerate() {
        let fields = CsvRecord { record, index };
        let swept: Vec<SweptValue> = schema
            .swept
            .iter()
            .enumerate()
            .map(|(column, (_, column_type))| fields.swept(IDENTITY_COLUMNS.len() + column, *column_type))
            .collect::<Result<_, _>>()?;
        // Rows are sorted by cell, so nearly all of them share the values of the previous row.
        if *cell != *swept {
            cell = Arc::from(swept);
        }
        let first_metric = IDENTITY_COLUMNS.len() + schema.swept.len();
        let mut metrics = [f64::NAN; Metrics::COUNT];
        for (column, metric) in (first_metric..).zip(metric_columns) {
            if !record[column].is_empty() {
                metrics[*metric] = fields.get(column)?;
            }
        }
        let events_column = first_metric + metric_columns.len();
        let row = ResultRow {
            scenario_hash: fields.get(0)?,
            preset: preset.intern(&record[1]),
            policy: policy.intern(&record[2]),
            n: fields.get(3)?,
            ttis: fields.get(4)?,
            seed: fields.get(5)?,
            swept: Arc::clone(&cell),
            metrics,
            events: fields.get(events_column)?,
            digest: fields.get(events_column + 1)?,
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
    fn get<T: FromStr>(&self, column: usize) -> Result<T, SchemaMismatch> {
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

    fn swept(&self, column: usize, column_type: ColumnType) -> Result<SweptValue, SchemaMismatch> {
        Ok(match column_type {
            ColumnType::Int => SweptValue::Int(self.get(column)?),
            ColumnType::Float => SweptValue::Float(self.get(column)?),
            ColumnType::Text => SweptValue::Text(self.record[column].to_owned()),
        })
    }
}
