//! The bytes of Parquet files and the tables that they hold.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::column::reader::{ColumnReader, get_typed_column_reader};
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{ChunkReader, FileReader, RowGroupReader, SerializedFileReader};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{Type, TypePtr};

use reveille_common::score::Metrics;

use super::about::About;
use super::columns::{ColumnType, IDENTITY, Schema, TAIL, Value};
use super::contents::Table;
use super::error::Refusal;
use super::row::{Hash, Row, Shared};

/// Rows in a row group: a bound on the memory of readers.
const GROUP: usize = 65_536;

/// The bytes of the file of `table`.
pub(super) fn to_bytes(table: &Table) -> Result<Vec<u8>, String> {
    encode(table).map_err(|error| error.to_string())
}

fn encode(table: &Table) -> Result<Vec<u8>, ParquetError> {
    let pairs = table.about.pairs();
    let metadata = pairs
        .into_iter()
        .map(|(key, value)| KeyValue::new(key.to_owned(), value))
        .collect();
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_key_value_metadata(Some(metadata))
        .build();
    let schema = Arc::new(message_type(&table.schema)?);
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties))?;
    for rows in table.rows.chunks(GROUP) {
        let mut group = writer.next_row_group()?;
        write_group(&mut group, &table.schema, rows)?;
        group.close()?;
    }
    writer.into_inner()
}

fn message_type(schema: &Schema) -> Result<Type, ParquetError> {
    let [hash, preset, policy, n, ttis, seed] = IDENTITY;
    let [events, digest] = TAIL;
    let mut fields = vec![text(hash)?, text(preset)?, text(policy)?];
    for name in [n, ttis, seed] {
        fields.push(number(name, Physical::INT64, Repetition::REQUIRED)?);
    }
    for (name, column_type) in &schema.swept {
        fields.push(match column_type {
            ColumnType::Int => number(name, Physical::INT64, Repetition::REQUIRED)?,
            ColumnType::Float => number(name, Physical::DOUBLE, Repetition::REQUIRED)?,
            ColumnType::Text => text(name)?,
        });
    }
    for name in Metrics::NAMES {
        fields.push(number(name, Physical::DOUBLE, Repetition::OPTIONAL)?);
    }
    fields.push(number(events, Physical::INT64, Repetition::REQUIRED)?);
    fields.push(text(digest)?);
    Type::group_type_builder("runs").with_fields(fields).build()
}

fn text(name: &str) -> Result<TypePtr, ParquetError> {
    let column = Type::primitive_type_builder(name, Physical::BYTE_ARRAY)
        .with_repetition(Repetition::REQUIRED)
        .with_logical_type(Some(LogicalType::String));
    column.build().map(Arc::new)
}

fn number(name: &str, physical: Physical, repetition: Repetition) -> Result<TypePtr, ParquetError> {
    let column = Type::primitive_type_builder(name, physical).with_repetition(repetition);
    column.build().map(Arc::new)
}

fn write_group(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    schema: &Schema,
    rows: &[Row],
) -> Result<(), ParquetError> {
    write_texts(group, rows.iter().map(|row| row.scenario_hash.to_string()))?;
    write_texts(group, rows.iter().map(|row| row.preset.to_string()))?;
    write_texts(group, rows.iter().map(|row| row.policy.to_string()))?;
    write_ints(group, rows.iter().map(|row| i64::from(row.n)))?;
    write_ints(group, rows.iter().map(|row| row.ttis.cast_signed()))?;
    write_ints(group, rows.iter().map(|row| row.seed.cast_signed()))?;
    for (column, (_, column_type)) in schema.swept.iter().enumerate() {
        let values = rows.iter().map(|row| &row.swept[column]);
        match column_type {
            ColumnType::Int => write_ints(group, values.map(int).collect::<Result<Vec<_>, _>>()?.into_iter())?,
            ColumnType::Float => write::<DoubleType>(group, &values.map(float).collect::<Result<Vec<_>, _>>()?, None)?,
            ColumnType::Text => write_texts(group, values.map(ToString::to_string))?,
        }
    }
    for metric in 0..Metrics::COUNT {
        let values: Vec<f64> = rows.iter().map(|row| row.metrics[metric]).collect();
        let levels: Vec<i16> = values.iter().map(|value| i16::from(!value.is_nan())).collect();
        let defined: Vec<f64> = values.into_iter().filter(|value| !value.is_nan()).collect();
        write::<DoubleType>(group, &defined, Some(&levels))?;
    }
    write_ints(group, rows.iter().map(|row| row.events.cast_signed()))?;
    write_texts(group, rows.iter().map(|row| row.digest.to_string()))
}

/// The value of a column of whole numbers.
fn int(value: &Value) -> Result<i64, ParquetError> {
    match value {
        Value::Int(value) => Ok(*value),
        Value::Float(_) | Value::Text(_) => Err(misplaced(value, "whole numbers")),
    }
}

/// The value of a column of numbers.
fn float(value: &Value) -> Result<f64, ParquetError> {
    match value {
        Value::Float(value) => Ok(*value),
        Value::Int(value) => Ok(*value as f64),
        Value::Text(_) => Err(misplaced(value, "numbers")),
    }
}

fn misplaced(value: &Value, types: &str) -> ParquetError {
    ParquetError::General(format!("`{value}` stands in a column of {types}"))
}

fn write_texts(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    values: impl Iterator<Item = String>,
) -> Result<(), ParquetError> {
    let values: Vec<ByteArray> = values.map(|value| ByteArray::from(value.into_bytes())).collect();
    write::<ByteArrayType>(group, &values, None)
}

fn write_ints(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    values: impl Iterator<Item = i64>,
) -> Result<(), ParquetError> {
    write::<Int64Type>(group, &values.collect::<Vec<_>>(), None)
}

fn write<T: DataType>(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    values: &[T::T],
    levels: Option<&[i16]>,
) -> Result<(), ParquetError> {
    let missing = || ParquetError::General("more columns than the schema has".to_owned());
    let mut column = group.next_column()?.ok_or_else(missing)?;
    column.typed::<T>().write_batch(values, levels, None)?;
    column.close()
}

/// The table in `file`.
pub(super) fn decode<F: ChunkReader + 'static>(file: F) -> Result<Table, Refusal> {
    guarded(|| table_of(&SerializedFileReader::new(file)?))
}

/// What the table in `file` says of itself.
pub(super) fn about<F: ChunkReader + 'static>(file: F) -> Result<About, Refusal> {
    guarded(|| about_of(&SerializedFileReader::new(file)?))
}

/// The decoder panics on some corrupt files.
fn guarded<T>(decode: impl FnOnce() -> Result<T, Refusal>) -> Result<T, Refusal> {
    catch_unwind(AssertUnwindSafe(decode))
        .unwrap_or_else(|_| Err(Refusal::Broken("the Parquet decoder gave up".to_owned())))
}

impl From<ParquetError> for Refusal {
    fn from(error: ParquetError) -> Self {
        Self::Broken(error.to_string())
    }
}

fn about_of(reader: &impl FileReader) -> Result<About, Refusal> {
    let pairs = reader.metadata().file_metadata().key_value_metadata();
    let pairs = pairs.map_or(&[][..], Vec::as_slice);
    About::from_pairs(|key| pairs.iter().find(|pair| pair.key == key)?.value.as_deref())
}

fn table_of(reader: &impl FileReader) -> Result<Table, Refusal> {
    let about = about_of(reader)?;
    let fields = reader.metadata().file_metadata().schema().get_fields();
    let header: Vec<&str> = fields.iter().map(|field| field.name()).collect();
    let names = Schema::swept_among(&header)?;
    let first = IDENTITY.len();
    let types = fields[first..first + names.len()].iter().map(|field| type_of(field));
    let swept = names.into_iter().map(str::to_owned).zip(types).collect();
    let schema = Schema { swept };
    let own = message_type(&schema)?;
    let differing = own.get_fields().iter().zip(fields).find(|(own, found)| own != found);
    if let Some((own, _)) = differing {
        return Err(Refusal::Columns(format!(
            "the column `{}` is of another type",
            own.name()
        )));
    }
    let mut rows = Vec::new();
    for number in 0..reader.num_row_groups() {
        read_group(&*reader.get_row_group(number)?, &schema, &mut rows)?;
    }
    Ok(Table { about, schema, rows })
}

fn type_of(field: &Type) -> ColumnType {
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

/// The columns of a row group, one after another.
struct Columns<'r> {
    group: &'r dyn RowGroupReader,
    rows: usize,
    next: usize,
}

impl Columns<'_> {
    fn reader(&mut self) -> Result<ColumnReader, Refusal> {
        let reader = self.group.get_column_reader(self.next)?;
        self.next += 1;
        Ok(reader)
    }

    fn values<T: DataType>(&mut self) -> Result<Vec<T::T>, Refusal> {
        let mut values = Vec::new();
        let mut reader = get_typed_column_reader::<T>(self.reader()?);
        let (records, _, _) = reader.read_records(self.rows, None, None, &mut values)?;
        self.complete(records)?;
        Ok(values)
    }

    fn ints(&mut self) -> Result<Vec<i64>, Refusal> {
        self.values::<Int64Type>()
    }

    fn texts(&mut self) -> Result<Vec<String>, Refusal> {
        let values = self.values::<ByteArrayType>()?;
        let text = |value: &ByteArray| value.as_utf8().map(str::to_owned);
        Ok(values.iter().map(text).collect::<Result<_, _>>()?)
    }

    fn hashes(&mut self) -> Result<Vec<Hash>, Refusal> {
        let texts = self.texts()?;
        texts.iter().map(|text| text.parse().map_err(Refusal::Broken)).collect()
    }

    fn metric(&mut self) -> Result<Vec<f64>, Refusal> {
        let (mut levels, mut defined) = (Vec::new(), Vec::new());
        let mut reader = get_typed_column_reader::<DoubleType>(self.reader()?);
        let (records, _, _) = reader.read_records(self.rows, Some(&mut levels), None, &mut defined)?;
        self.complete(records)?;
        let mut defined = defined.into_iter();
        let values = levels
            .iter()
            .map(|&level| if level == 0 { None } else { defined.next() });
        Ok(values.map(|value| value.unwrap_or(f64::NAN)).collect())
    }

    fn swept(&mut self, column_type: ColumnType) -> Result<Vec<Value>, Refusal> {
        Ok(match column_type {
            ColumnType::Int => self.ints()?.into_iter().map(Value::Int).collect(),
            ColumnType::Float => self.values::<DoubleType>()?.into_iter().map(Value::Float).collect(),
            ColumnType::Text => self.texts()?.into_iter().map(Value::Text).collect(),
        })
    }

    fn complete(&self, records: usize) -> Result<(), Refusal> {
        if records == self.rows {
            Ok(())
        } else {
            Err(Refusal::Broken(format!(
                "column {} has {records} rows of {}",
                self.next, self.rows
            )))
        }
    }
}

fn read_group(group: &dyn RowGroupReader, schema: &Schema, rows: &mut Vec<Row>) -> Result<(), Refusal> {
    let count = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
    let mut columns = Columns {
        group,
        rows: count,
        next: 0,
    };
    let (hashes, presets, policies) = (columns.hashes()?, columns.texts()?, columns.texts()?);
    let (n, ttis, seeds) = (columns.ints()?, columns.ints()?, columns.ints()?);
    let swept = schema
        .swept
        .iter()
        .map(|(_, column_type)| columns.swept(*column_type))
        .collect::<Result<Vec<_>, _>>()?;
    let metrics = (0..Metrics::COUNT)
        .map(|_| columns.metric())
        .collect::<Result<Vec<_>, _>>()?;
    let (events, digests) = (columns.ints()?, columns.hashes()?);
    let positive = |value: i64, name: &str| {
        u64::try_from(value).map_err(|_| Refusal::Broken(format!("`{name}` = {value} is negative")))
    };
    let (mut preset, mut policy, mut cell) = (Shared::default(), Shared::default(), Arc::from([]));
    for at in 0..count {
        let values: Vec<Value> = swept.iter().map(|column| column[at].clone()).collect();
        if *cell != *values {
            cell = Arc::from(values);
        }
        let row = Row {
            scenario_hash: hashes[at],
            preset: preset.of(&presets[at]),
            policy: policy.of(&policies[at]),
            n: u32::try_from(n[at]).map_err(|_| Refusal::Broken(format!("`n` = {} is out of range", n[at])))?,
            ttis: positive(ttis[at], "ttis")?,
            seed: positive(seeds[at], "seed")?,
            swept: Arc::clone(&cell),
            metrics: std::array::from_fn(|metric| metrics[metric][at]),
            events: positive(events[at], "events")?,
            digest: digests[at],
        };
        rows.push(row.check(rows.len() + 1)?);
    }
    Ok(())
}
