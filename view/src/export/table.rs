//! `reveille inspect export --to csv` or `parquet`: a table for statistics programs, one row a message. The columns are
//! a file format, in CSV by [`MessageRow::csv_fields`] and in Parquet by [`MessageTableWriter`], in the order of
//! [`COLUMNS`], which both repeat. docs/inspecting.md describes them, and `tests/recordings/check.py` reads both files.
//!
//! | column | content |
//! |---|---|
//! | `tti` | TTI of the base station |
//! | `plane`, `kind` | plane and kind of the message |
//! | `number` | device or host in its key; empty for a kind without one |
//! | `bytes` | encoded length |
//! | `information`, `battery` | of kind `report` only: I_ij, and the remaining battery, units |
//! | `message` | all fields in JSON; `{"malformed": REASON}` if the payload cannot be decoded |

use std::io::Write;

use parquet::basic::Type as Physical;
use parquet::data_type::{ByteArrayType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use reveille_common::message::{Frame, Message};
use reveille_common::parquet::{Column, Writer, schema};
use serde_json::json;

/// Rows in a row group.
const ROWS_PER_GROUP: usize = 100_000;

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
pub struct MessageRow {
    tti: u64,
    plane: &'static str,
    kind: &'static str,
    number: Option<u32>,
    bytes: usize,
    /// Information, and remaining battery in units, of a message of kind `report`.
    information_and_battery: Option<(f64, f64)>,
    message: String,
}

impl MessageRow {
    /// Creates the row of a frame.
    pub fn new(frame: &Frame) -> Self {
        let message = frame.message();
        let information_and_battery = match &message {
            Ok(Message::Report(report)) => Some((report.information, report.battery.units())),
            Ok(_) | Err(_) => None,
        };
        Self {
            tti: frame.tti.0,
            plane: frame.kind.plane().name(),
            kind: frame.kind.name(),
            number: frame.number,
            bytes: frame.payload.len(),
            information_and_battery,
            message: match message {
                // Serialised directly: a `Value` holds single precision as double, which prints more digits.
                Ok(message) => serde_json::to_string(&message).expect("messages have a form in JSON"),
                Err(error) => json!({ "malformed": error.to_string() }).to_string(),
            },
        }
    }

    /// Formats the row as the fields of a CSV line.
    pub fn csv_fields(&self) -> [String; COLUMNS.len()] {
        let text = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
        [
            self.tti.to_string(),
            self.plane.to_owned(),
            self.kind.to_owned(),
            self.number.map_or_else(String::new, |number| number.to_string()),
            self.bytes.to_string(),
            text(self.information_and_battery.map(|(information, _)| information)),
            text(self.information_and_battery.map(|(_, battery)| battery)),
            self.message.clone(),
        ]
    }
}

/// Writer of a Parquet file.
pub struct MessageTableWriter<W: Write + Send> {
    writer: Writer<W>,
    pending_rows: Vec<MessageRow>,
}

impl<W: Write + Send> MessageTableWriter<W> {
    /// Writes the start of a file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn begin(out: W) -> Result<Self, ParquetError> {
        let [tti, plane, kind, number, bytes, information, battery, message] = COLUMNS;
        let columns = [
            Column::required(tti, Physical::INT64),
            Column::required(plane, Physical::BYTE_ARRAY),
            Column::required(kind, Physical::BYTE_ARRAY),
            Column::optional(number, Physical::INT32),
            Column::required(bytes, Physical::INT32),
            Column::optional(information, Physical::DOUBLE),
            Column::optional(battery, Physical::DOUBLE),
            Column::required(message, Physical::BYTE_ARRAY),
        ];
        Ok(Self {
            writer: Writer::begin(out, schema("messages", columns)?, [])?,
            pending_rows: Vec::new(),
        })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&mut self, row: MessageRow) -> Result<(), ParquetError> {
        self.pending_rows.push(row);
        if self.pending_rows.len() < ROWS_PER_GROUP {
            Ok(())
        } else {
            self.write_group()
        }
    }

    /// Completes the file and returns its output.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn finish(mut self) -> Result<W, ParquetError> {
        if !self.pending_rows.is_empty() {
            self.write_group()?;
        }
        self.writer.finish()
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        let pending = std::mem::take(&mut self.pending_rows);
        let rows = || pending.iter();
        self.writer.write_row_group(|group| {
            // Parquet's integers are signed. TTIs, ids and lengths of a run are far below their limits.
            group.write_required::<Int64Type>(rows().map(|row| row.tti.cast_signed()))?;
            group.write_required::<ByteArrayType>(rows().map(|row| row.plane.into()))?;
            group.write_required::<ByteArrayType>(rows().map(|row| row.kind.into()))?;
            group.write_optional::<Int32Type>(rows().map(|row| row.number.map(u32::cast_signed)))?;
            group.write_required::<Int32Type>(rows().map(|row| (row.bytes as u32).cast_signed()))?;
            group.write_optional::<DoubleType>(
                rows().map(|row| row.information_and_battery.map(|(information, _)| information)),
            )?;
            group.write_optional::<DoubleType>(
                rows().map(|row| row.information_and_battery.map(|(_, battery)| battery)),
            )?;
            group.write_required::<ByteArrayType>(rows().map(|row| row.message.as_str().into()))
        })
    }
}
