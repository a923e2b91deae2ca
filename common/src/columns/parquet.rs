//! Columns of Parquet files; errors name the row, from 1. Only `columns/mod.rs` uses this module.
//! `common/src/parquet.rs` (`crate::parquet`) is another module, with the writer.

use std::ops::Range;

use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::record::Field;
use ::parquet::schema::types::Type;
use bytes::Bytes;

use super::data::{ColumnData, RowCollector, column_index};

/// Reads the columns `wanted` of a flat Parquet file as numbers.
pub(super) fn numbers(bytes: &[u8], wanted: &[String], needed_rows: Range<usize>) -> Result<ColumnData<f64>, String> {
    with_reader(bytes, |reader| {
        read_columns(reader, wanted, needed_rows, |field| {
            to_number(field).ok_or("is not a number")
        })
    })
}

/// Reads the column `wanted` as text; `None` without such a column.
pub(super) fn texts(bytes: &[u8], wanted: &str) -> Result<Option<ColumnData<String>>, String> {
    let to_text = |field: &Field| {
        if let Field::Str(text) = field {
            Ok(text.trim().to_owned())
        } else {
            Err("is not a text")
        }
    };
    with_reader(bytes, |reader| {
        let fields = reader.metadata().file_metadata().schema().get_fields();
        if !fields.iter().any(|field| field.name() == wanted) {
            return Ok(None);
        }
        read_columns(reader, &[wanted.to_owned()], 0..usize::MAX, to_text).map(Some)
    })
}

/// Opens the file `bytes` for `decode`, and returns an error if the decoder panics.
fn with_reader<T>(
    bytes: &[u8],
    decode: impl FnOnce(&SerializedFileReader<Bytes>) -> Result<T, String>,
) -> Result<T, String> {
    let opened = || SerializedFileReader::new(Bytes::copy_from_slice(bytes)).map_err(|error| unreadable(&error));
    crate::parquet::catch_decoder_panic(|| decode(&opened()?))
        .unwrap_or_else(|| Err("is a corrupt Parquet file".to_owned()))
}

fn unreadable(error: &ParquetError) -> String {
    format!("is not a readable Parquet file: {error}")
}

/// Reads the columns `wanted`, of a file with more than `MAX_VALUES` values only `needed_rows`.
fn read_columns<T>(
    reader: &SerializedFileReader<Bytes>,
    wanted: &[String],
    needed_rows: Range<usize>,
    parse_cell: impl Fn(&Field) -> Result<T, &'static str>,
) -> Result<ColumnData<T>, String> {
    let metadata = reader.metadata().file_metadata();
    let schema = metadata.schema();
    let fields = schema.get_fields();
    let indices = wanted
        .iter()
        .map(|name| column_index(name, fields.iter().map(|field| field.name())))
        .collect::<Result<Vec<usize>, String>>()?;
    let wanted_fields = fields
        .iter()
        .enumerate()
        .filter(|(index, _)| indices.contains(index))
        .map(|(_, field)| field.clone())
        .collect();
    let projection = Type::group_type_builder(schema.name())
        .with_fields(wanted_fields)
        .build()
        .map_err(|error| unreadable(&error))?;
    let mut collector = RowCollector::new(wanted.len(), needed_rows);
    let records = reader
        .get_row_iter(Some(projection))
        .map_err(|error| unreadable(&error))?;
    for (row, record) in records.enumerate() {
        let record = record.map_err(|error| format!("row {}: {error}", row + 1))?;
        let Some(columns) = collector.begin_row(None)? else {
            continue;
        };
        for (column, name) in columns.iter_mut().zip(wanted) {
            let field = record
                .get_column_iter()
                .find(|(known, _)| *known == name)
                .map(|(_, field)| field);
            let value = field.map_or(Err("is missing"), &parse_cell);
            column.push(value.map_err(|reason| format!("row {}, column `{name}`: {reason}", row + 1))?);
        }
    }
    Ok(collector.finish())
}

/// The finite number in a cell; `None` for other types and missing values.
fn to_number(field: &Field) -> Option<f64> {
    let value = match field {
        Field::Byte(value) => f64::from(*value),
        Field::Short(value) => f64::from(*value),
        Field::Int(value) => f64::from(*value),
        Field::Long(value) => *value as f64,
        Field::UByte(value) => f64::from(*value),
        Field::UShort(value) => f64::from(*value),
        Field::UInt(value) => f64::from(*value),
        Field::ULong(value) => *value as f64,
        Field::Float(value) => f64::from(*value),
        Field::Double(value) => *value,
        Field::Null
        | Field::Bool(_)
        | Field::Float16(_)
        | Field::Decimal(_)
        | Field::Str(_)
        | Field::Bytes(_)
        | Field::Date(_)
        | Field::TimeMillis(_)
        | Field::TimeMicros(_)
        | Field::TimestampMillis(_)
        | Field::TimestampMicros(_)
        | Field::Group(_)
        | Field::ListInternal(_)
        | Field::MapInternal(_) => return None,
    };
    value.is_finite().then_some(value)
}

#[cfg(test)]
mod tests {
    use ::parquet::basic::Type as Physical;
    use ::parquet::data_type::{DoubleType, Int32Type};

    use super::*;
    use crate::parquet::{Column, Writer, schema};

    /// Writes a file with the columns `hour` (0, 1, 2) and `w` (0.5, 1.5, 2.5).
    fn write_file() -> Vec<u8> {
        let columns = [
            Column::required("hour", Physical::INT32),
            Column::required("w", Physical::DOUBLE),
        ];
        let file_schema = schema("m", columns).expect("a schema");
        let mut writer = Writer::begin(Vec::new(), file_schema, []).expect("begun");
        let written = writer.write_row_group(|group| {
            group.write_required::<Int32Type>([0, 1, 2])?;
            group.write_required::<DoubleType>([0.5, 1.5, 2.5])
        });
        written.expect("written");
        writer.finish().expect("finished")
    }

    #[test]
    fn columns_come_in_the_requested_order() {
        let bytes = write_file();
        let read = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
            numbers(&bytes, &names, 0..usize::MAX).map(|columns| columns.values)
        };
        assert_eq!(read(&["w", "hour"]), Ok(vec![vec![0.5, 1.5, 2.5], vec![0.0, 1.0, 2.0]]));
        let missing = read(&["v"]).expect_err("no such column");
        assert!(missing.contains("its columns are `hour`, `w`"), "{missing}");
        assert_eq!(texts(&bytes, "class"), Ok(None));
        let no_text = texts(&bytes, "hour").expect_err("a column of numbers");
        assert_eq!(no_text, "row 1, column `hour`: is not a text");
    }

    #[test]
    fn truncated_files_are_refused() {
        let bytes = write_file();
        for length in 0..bytes.len() {
            numbers(&bytes[..length], &["w".to_owned()], 0..usize::MAX).expect_err("truncated");
        }
    }
}
