//! Messages as a table: a row for each, for statistics programs.
//!
//! | column | what |
//! |---|---|
//! | `tti` | the TTI that the base station was in |
//! | `plane`, `kind` | the plane and the kind of message |
//! | `number` | the device or host of its key, nothing for a kind without |
//! | `bytes` | its length as encoded |
//! | `information`, `battery` | of a report: I_ij, and what is left in the battery, units |
//! | `message` | all of its fields in JSON |

use std::io::Write;
use std::sync::Arc;

use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::Type;
use reveille_common::message::{Frame, Message};
use serde_json::json;

/// Rows that are written at a time.
const GROUP: usize = 100_000;

/// The columns.
pub const COLUMNS: [&str; 8] = [
    "tti",
    "plane",
    "kind",
    "number",
    "bytes",
    "information",
    "battery",
    "message",
];

/// A row.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    tti: u64,
    plane: &'static str,
    kind: &'static str,
    number: Option<u32>,
    bytes: usize,
    report: Option<(f64, f64)>,
    message: String,
}

impl Row {
    /// The row of a frame.
    pub fn of(frame: &Frame) -> Self {
        let message = frame.message();
        let report = match &message {
            Ok(Message::Report(report)) => Some((report.information, report.battery.units())),
            Ok(_) | Err(_) => None,
        };
        Self {
            tti: frame.tti.0,
            plane: frame.kind.plane().name(),
            kind: frame.kind.name(),
            number: frame.number,
            bytes: frame.payload.len(),
            report,
            message: match message {
                // Not by way of a value, which would make more digits of numbers in single precision.
                Ok(message) => serde_json::to_string(&message).expect("messages have a form in JSON"),
                Err(error) => json!({ "malformed": error.to_string() }).to_string(),
            },
        }
    }

    /// As the fields of a line of CSV.
    pub fn fields(&self) -> [String; COLUMNS.len()] {
        let text = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
        [
            self.tti.to_string(),
            self.plane.to_owned(),
            self.kind.to_owned(),
            self.number.map_or_else(String::new, |number| number.to_string()),
            self.bytes.to_string(),
            text(self.report.map(|(information, _)| information)),
            text(self.report.map(|(_, battery)| battery)),
            self.message.clone(),
        ]
    }
}

/// A Parquet file that is being written.
pub struct Rows<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    held: Vec<Row>,
}

impl<W: Write + Send> Rows<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn begin(out: W) -> Result<Self, ParquetError> {
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        Ok(Self {
            writer: SerializedFileWriter::new(out, Arc::new(schema()?), Arc::new(properties))?,
            held: Vec::new(),
        })
    }

    /// Takes in a row.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&mut self, row: Row) -> Result<(), ParquetError> {
        self.held.push(row);
        if self.held.len() < GROUP {
            Ok(())
        } else {
            self.write_group()
        }
    }

    /// Ends the file. Gives back what it was written to.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(mut self) -> Result<W, ParquetError> {
        if !self.held.is_empty() {
            self.write_group()?;
        }
        self.writer.into_inner()
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        let rows = std::mem::take(&mut self.held);
        let mut group = self.writer.next_row_group()?;
        required::<Int64Type, _>(&mut group, &rows, |row| row.tti.cast_signed())?;
        required::<ByteArrayType, _>(&mut group, &rows, |row| row.plane.into())?;
        required::<ByteArrayType, _>(&mut group, &rows, |row| row.kind.into())?;
        optional::<Int32Type, _>(&mut group, &rows, |row| row.number.map(u32::cast_signed))?;
        required::<Int32Type, _>(&mut group, &rows, |row| (row.bytes as u32).cast_signed())?;
        optional::<DoubleType, _>(&mut group, &rows, |row| row.report.map(|(information, _)| information))?;
        optional::<DoubleType, _>(&mut group, &rows, |row| row.report.map(|(_, battery)| battery))?;
        required::<ByteArrayType, _>(&mut group, &rows, |row| ByteArray::from(row.message.as_str()))?;
        group.close()?;
        Ok(())
    }
}

fn required<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    rows: &[Row],
    value: impl Fn(&Row) -> T::T,
) -> Result<(), ParquetError> {
    let values: Vec<T::T> = rows.iter().map(value).collect();
    column::<T, W>(group, &values, None)
}

fn optional<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    rows: &[Row],
    value: impl Fn(&Row) -> Option<T::T>,
) -> Result<(), ParquetError> {
    let values: Vec<Option<T::T>> = rows.iter().map(value).collect();
    let levels: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
    let values: Vec<T::T> = values.into_iter().flatten().collect();
    column::<T, W>(group, &values, Some(&levels))
}

fn column<T: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[T::T],
    levels: Option<&[i16]>,
) -> Result<(), ParquetError> {
    let missing = || ParquetError::General("a column too many".to_owned());
    let mut column = group.next_column()?.ok_or_else(missing)?;
    column.typed::<T>().write_batch(values, levels, None)?;
    column.close()
}

fn schema() -> Result<Type, ParquetError> {
    let types = [
        (Physical::INT64, Repetition::REQUIRED),
        (Physical::BYTE_ARRAY, Repetition::REQUIRED),
        (Physical::BYTE_ARRAY, Repetition::REQUIRED),
        (Physical::INT32, Repetition::OPTIONAL),
        (Physical::INT32, Repetition::REQUIRED),
        (Physical::DOUBLE, Repetition::OPTIONAL),
        (Physical::DOUBLE, Repetition::OPTIONAL),
        (Physical::BYTE_ARRAY, Repetition::REQUIRED),
    ];
    let column = |(name, (physical, repetition)): (&str, (Physical, Repetition))| {
        let text = (physical == Physical::BYTE_ARRAY).then_some(LogicalType::String);
        let column = Type::primitive_type_builder(name, physical).with_repetition(repetition);
        column.with_logical_type(text).build().map(Arc::new)
    };
    let columns = COLUMNS.into_iter().zip(types).map(column).collect::<Result<_, _>>()?;
    Type::group_type_builder("messages").with_fields(columns).build()
}
