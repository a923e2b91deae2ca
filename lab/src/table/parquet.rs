//! Encoding and decoding of tables as Parquet, for `io`. Columns are written by [`write_group`] and read by
//! [`read_group`] by position, in the order of [`message_type`]: change all three. `csv` has the same columns.

use std::sync::Arc;

use ::parquet::basic::Type as Physical;
use ::parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{ChunkReader, FileReader, RowGroupReader, SerializedFileReader};
use ::parquet::schema::types::Type;
use reveille_common::parquet::{self, Column, GroupReader, GroupWriter, Writer};
use reveille_common::score::Metrics;

use super::Table;
use super::columns::{ColumnType, FileColumns, IDENTITY_COLUMNS, Schema, SweptValue, TRAILING_COLUMNS};
use super::error::SchemaMismatch;
use super::metadata::TableMetadata;
use super::row::{Hash, LastText, ResultRow};

/// The number of rows in a row group, which bounds the memory of readers. Another number changes the bytes of files.
const ROWS_PER_GROUP: usize = 65_536;

pub(super) fn to_bytes(table: &Table) -> Result<Vec<u8>, String> {
    encode(table).map_err(|error| error.to_string())
}

fn encode(table: &Table) -> Result<Vec<u8>, ParquetError> {
    let pairs = table.metadata.pairs().into_iter();
    let metadata = pairs.map(|(key, value)| (key.to_owned(), value));
    let mut writer = Writer::begin(Vec::new(), message_type(&table.schema, 0..Metrics::COUNT)?, metadata)?;
    for rows in table.rows.chunks(ROWS_PER_GROUP) {
        writer.write_row_group(|group| write_group(group, &table.schema, rows))?;
    }
    writer.finish()
}

/// Returns the columns of a file with the swept fields of `schema` and the metrics at these indices of
/// [`Metrics::NAMES`].
fn message_type(schema: &Schema, metric_indices: impl Iterator<Item = usize>) -> Result<Type, ParquetError> {
    let [hash, preset, policy, n, ttis, seed] = IDENTITY_COLUMNS;
    let [events, digest] = TRAILING_COLUMNS;
    let text_column = |name| Column::required(name, Physical::BYTE_ARRAY);
    let int_column = |name| Column::required(name, Physical::INT64);
    let mut columns = vec![
        text_column(hash),
        text_column(preset),
        text_column(policy),
        int_column(n),
        int_column(ttis),
        int_column(seed),
    ];
    columns.extend(schema.swept.iter().map(|(name, column_type)| match column_type {
        ColumnType::Int => int_column(name),
        ColumnType::Float => Column::required(name, Physical::DOUBLE),
        ColumnType::Text => text_column(name),
    }));
    columns.extend(metric_indices.map(|index| Column::optional(Metrics::NAMES[index], Physical::DOUBLE)));
    columns.extend([int_column(events), text_column(digest)]);
    parquet::schema("runs", columns)
}

fn write_group(group: &mut GroupWriter<'_, Vec<u8>>, schema: &Schema, rows: &[ResultRow]) -> Result<(), ParquetError> {
    let byte_array = |text: String| ByteArray::from(text.into_bytes());
    // In the order of `message_type`: the writer takes columns by position.
    group.write_required::<ByteArrayType>(rows.iter().map(|row| byte_array(row.scenario_hash.to_string())))?;
    group.write_required::<ByteArrayType>(rows.iter().map(|row| byte_array(row.preset.to_string())))?;
    group.write_required::<ByteArrayType>(rows.iter().map(|row| byte_array(row.policy.to_string())))?;
    group.write_required::<Int64Type>(rows.iter().map(|row| i64::from(row.n)))?;
    group.write_required::<Int64Type>(rows.iter().map(|row| row.ttis.cast_signed()))?;
    // The cast holds: `Seeds::check` refuses seeds above `i64::MAX`.
    group.write_required::<Int64Type>(rows.iter().map(|row| row.seed.cast_signed()))?;
    for (column, (_, column_type)) in schema.swept.iter().enumerate() {
        let values = rows.iter().map(|row| &row.swept[column]);
        match column_type {
            ColumnType::Int => {
                group.write_required::<Int64Type>(values.map(int_value).collect::<Result<Vec<_>, _>>()?)?;
            }
            ColumnType::Float => {
                group.write_required::<DoubleType>(values.map(float_value).collect::<Result<Vec<_>, _>>()?)?;
            }
            ColumnType::Text => {
                group.write_required::<ByteArrayType>(values.map(|value| byte_array(value.to_string())))?;
            }
        }
    }
    for index in 0..Metrics::COUNT {
        let defined_value = |row: &ResultRow| Some(row.metrics[index]).filter(|value| !value.is_nan());
        group.write_optional::<DoubleType>(rows.iter().map(defined_value))?;
    }
    group.write_required::<Int64Type>(rows.iter().map(|row| row.events.cast_signed()))?;
    group.write_required::<ByteArrayType>(rows.iter().map(|row| byte_array(row.digest.to_string())))
}

/// Returns the value in a column of whole numbers.
fn int_value(value: &SweptValue) -> Result<i64, ParquetError> {
    match value {
        SweptValue::Int(value) => Ok(*value),
        SweptValue::Float(_) | SweptValue::Text(_) => Err(type_error(value, "whole numbers")),
    }
}

/// Returns the value in a column of numbers.
fn float_value(value: &SweptValue) -> Result<f64, ParquetError> {
    match value {
        SweptValue::Float(value) => Ok(*value),
        SweptValue::Int(value) => Ok(*value as f64),
        SweptValue::Text(_) => Err(type_error(value, "numbers")),
    }
}

fn type_error(value: &SweptValue, column_content: &str) -> ParquetError {
    ParquetError::General(format!("`{value}` is in a column of {column_content}"))
}

/// Whether both columns have the same type, whatever their names.
fn has_same_type(expected: &Type, found: &Type) -> bool {
    let (expected_info, found_info) = (expected.get_basic_info(), found.get_basic_info());
    // First, because a group of columns has no physical type: the getter panics.
    found.is_primitive()
        && expected.get_physical_type() == found.get_physical_type()
        && expected_info.repetition() == found_info.repetition()
        && expected_info.converted_type() == found_info.converted_type()
}

pub(super) fn decode<F: ChunkReader + 'static>(file: F) -> Result<Table, SchemaMismatch> {
    catch_panic(|| read_table(&SerializedFileReader::new(file)?))
}

pub(super) fn decode_metadata<F: ChunkReader + 'static>(file: F) -> Result<TableMetadata, SchemaMismatch> {
    catch_panic(|| read_metadata(&SerializedFileReader::new(file)?))
}

/// Runs `decode`, and turns a panic of the Parquet decoder into an error.
fn catch_panic<T>(decode: impl FnOnce() -> Result<T, SchemaMismatch>) -> Result<T, SchemaMismatch> {
    let decoder_failed = || Err(SchemaMismatch::Broken("its Parquet content is corrupt".to_owned()));
    parquet::catch_decoder_panic(decode).unwrap_or_else(decoder_failed)
}

impl From<ParquetError> for SchemaMismatch {
    fn from(error: ParquetError) -> Self {
        Self::Broken(error.to_string())
    }
}

fn read_metadata(reader: &impl FileReader) -> Result<TableMetadata, SchemaMismatch> {
    let pairs = reader.metadata().file_metadata().key_value_metadata();
    let pairs = pairs.map_or(&[][..], Vec::as_slice);
    TableMetadata::from_pairs(|key| pairs.iter().find(|pair| pair.key == key)?.value.as_deref())
}

fn read_table(reader: &impl FileReader) -> Result<Table, SchemaMismatch> {
    let metadata = read_metadata(reader)?;
    let fields = reader.metadata().file_metadata().schema().get_fields();
    let header: Vec<&str> = fields.iter().map(|field| field.name()).collect();
    let FileColumns {
        swept_names,
        metric_indices,
    } = FileColumns::from_header(&header)?;
    let types = fields[IDENTITY_COLUMNS.len()..]
        .iter()
        .map(|field| swept_type_of(field));
    let schema = Schema {
        swept: swept_names.into_iter().zip(types).collect(),
    };
    let expected = message_type(&schema, metric_indices.iter().copied())?;
    // The names are checked, so both have the same length. A type may still differ, as in a file of another program.
    let mut field_pairs = expected.get_fields().iter().zip(fields);
    let differing = field_pairs.find(|(expected, found)| !has_same_type(expected, found));
    if let Some((column, _)) = differing {
        return Err(SchemaMismatch::Columns(format!(
            "the column `{}` has another type",
            column.name()
        )));
    }
    let mut rows = Vec::new();
    for number in 0..reader.num_row_groups() {
        read_group(&*reader.get_row_group(number)?, &schema, &metric_indices, &mut rows)?;
    }
    Ok(Table { metadata, schema, rows })
}

/// Returns the type of a swept column. A field of any other type becomes text, which [`has_same_type`] then refuses.
fn swept_type_of(field: &Type) -> ColumnType {
    if !field.is_primitive() {
        return ColumnType::Text;
    }
    match field.get_physical_type() {
        Physical::INT64 => ColumnType::Int,
        Physical::DOUBLE => ColumnType::Float,
        Physical::BYTE_ARRAY
        | Physical::BOOLEAN
        | Physical::INT32
        | Physical::INT96
        | Physical::FLOAT
        | Physical::FIXED_LEN_BYTE_ARRAY => ColumnType::Text,
    }
}

/// Reads the next column as texts.
fn read_texts(columns: &mut GroupReader<'_>) -> Result<Vec<String>, SchemaMismatch> {
    let values = columns.read_required::<ByteArrayType>()?;
    let text_of = |value: &ByteArray| value.as_utf8().map(str::to_owned);
    Ok(values.iter().map(text_of).collect::<Result<_, _>>()?)
}

/// Reads the next column as hashes.
fn read_hashes(columns: &mut GroupReader<'_>) -> Result<Vec<Hash>, SchemaMismatch> {
    let texts = read_texts(columns)?;
    texts
        .iter()
        .map(|text| text.parse().map_err(SchemaMismatch::Broken))
        .collect()
}

/// Reads the next column as values of a swept field.
fn read_swept(columns: &mut GroupReader<'_>, column_type: ColumnType) -> Result<Vec<SweptValue>, SchemaMismatch> {
    Ok(match column_type {
        ColumnType::Int => columns
            .read_required::<Int64Type>()?
            .into_iter()
            .map(SweptValue::Int)
            .collect(),
        ColumnType::Float => columns
            .read_required::<DoubleType>()?
            .into_iter()
            .map(SweptValue::Float)
            .collect(),
        ColumnType::Text => read_texts(columns)?.into_iter().map(SweptValue::Text).collect(),
    })
}

/// Appends the rows of `group`. `metric_indices` are the indices in [`Metrics::NAMES`] of the file's metrics.
fn read_group(
    group: &dyn RowGroupReader,
    schema: &Schema,
    metric_indices: &[usize],
    rows: &mut Vec<ResultRow>,
) -> Result<(), SchemaMismatch> {
    let mut columns = GroupReader::new(group);
    // In the order of `message_type`, which `read_table` has checked: the reader takes columns by position.
    let scenario_hashes = read_hashes(&mut columns)?;
    let (presets, policies) = (read_texts(&mut columns)?, read_texts(&mut columns)?);
    let device_counts = columns.read_required::<Int64Type>()?;
    let (ttis, seeds) = (
        columns.read_required::<Int64Type>()?,
        columns.read_required::<Int64Type>()?,
    );
    let swept_fields = schema.swept.iter();
    let swept_columns = swept_fields
        .map(|(_, column_type)| read_swept(&mut columns, *column_type))
        .collect::<Result<Vec<_>, _>>()?;
    let metric_columns = metric_indices
        .iter()
        .map(|metric_index| Ok((*metric_index, columns.read_optional::<DoubleType>()?)))
        .collect::<Result<Vec<_>, ParquetError>>()?;
    let events = columns.read_required::<Int64Type>()?;
    let digests = read_hashes(&mut columns)?;
    let non_negative = |value: i64, name: &str| {
        u64::try_from(value).map_err(|_| SchemaMismatch::Broken(format!("`{name}` = {value} is negative")))
    };
    let (mut last_preset, mut last_policy) = (LastText::default(), LastText::default());
    let mut last_swept = Arc::from([]);
    for index in 0..columns.rows() {
        let swept: Vec<SweptValue> = swept_columns.iter().map(|column| column[index].clone()).collect();
        // Rows are sorted by cell, so nearly all of them share the values of the previous row.
        if *last_swept != *swept {
            last_swept = Arc::from(swept);
        }
        let n = u32::try_from(device_counts[index]);
        let mut metrics = [f64::NAN; Metrics::COUNT];
        for (metric_index, values) in &metric_columns {
            metrics[*metric_index] = values[index].unwrap_or(f64::NAN);
        }
        let row = ResultRow {
            scenario_hash: scenario_hashes[index],
            preset: last_preset.intern(&presets[index]),
            policy: last_policy.intern(&policies[index]),
            n: n.map_err(|_| SchemaMismatch::Broken(format!("`n` = {} is out of range", device_counts[index])))?,
            ttis: non_negative(ttis[index], "ttis")?,
            seed: non_negative(seeds[index], "seed")?,
            swept: Arc::clone(&last_swept),
            metrics,
            events: non_negative(events[index], "events")?,
            digest: digests[index],
        };
        rows.push(row.check(rows.len() + 1)?);
    }
    Ok(())
}
