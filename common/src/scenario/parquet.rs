//! Columns of numbers from Parquet files.

use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};

use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::{Field, Row};
use parquet::schema::types::Type;

use super::table::{column_index, within_limit};

/// The columns `wanted` of a flat Parquet file, at most the first `rows` rows.
pub(super) fn read_parquet(file: File, wanted: &[String], rows: usize) -> Result<Vec<Vec<f64>>, String> {
    // The decoder panics on some corrupt files.
    catch_unwind(AssertUnwindSafe(|| read(file, wanted, rows)))
        .unwrap_or_else(|_| Err("is a corrupt Parquet file".to_owned()))
}

fn read(file: File, wanted: &[String], rows: usize) -> Result<Vec<Vec<f64>>, String> {
    let broken = |error: parquet::errors::ParquetError| format!("is not a readable Parquet file: {error}");
    let reader = SerializedFileReader::new(file).map_err(broken)?;
    let metadata = reader.metadata().file_metadata();
    let schema = metadata.schema();
    let fields = schema.get_fields();
    let indices = wanted
        .iter()
        .map(|name| column_index(name, fields.iter().map(|field| field.name())))
        .collect::<Result<Vec<usize>, String>>()?;
    within_limit(
        usize::try_from(metadata.num_rows()).unwrap_or(usize::MAX).min(rows),
        wanted.len(),
    )?;
    let taken = fields
        .iter()
        .enumerate()
        .filter(|(index, _)| indices.contains(index))
        .map(|(_, field)| field.clone())
        .collect();
    let projection = Type::group_type_builder(schema.name())
        .with_fields(taken)
        .build()
        .map_err(broken)?;
    let mut columns = vec![Vec::new(); wanted.len()];
    for (row, record) in reader
        .get_row_iter(Some(projection))
        .map_err(broken)?
        .take(rows)
        .enumerate()
    {
        let record = record.map_err(|error| format!("row {}: {error}", row + 1))?;
        within_limit(row + 1, wanted.len())?;
        for (column, name) in columns.iter_mut().zip(wanted) {
            column.push(
                number(&record, name).ok_or_else(|| format!("row {}, column `{name}`: is not a number", row + 1))?,
            );
        }
    }
    Ok(columns)
}

/// The number in a record's column, if there is one.
fn number(record: &Row, name: &str) -> Option<f64> {
    let (_, field) = record.get_column_iter().find(|(column, _)| *column == name)?;
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
    use std::sync::Arc;

    use parquet::basic::Compression;
    use parquet::data_type::{DoubleType, Int32Type};
    use parquet::file::properties::WriterProperties;
    use parquet::file::writer::SerializedFileWriter;
    use parquet::schema::parser::parse_message_type;

    use super::*;

    /// A file of the columns `hour` (0, 1, 2) and `w` (0.5, 1.5, 2.5).
    fn written(name: &str) -> std::path::PathBuf {
        let path = std::env::temp_dir().join(format!("reveille-{}-{name}.parquet", std::process::id()));
        let schema = parse_message_type("message m { REQUIRED INT32 hour; REQUIRED DOUBLE w; }").expect("a schema");
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let file = File::create(&path).expect("a file");
        let mut writer = SerializedFileWriter::new(file, Arc::new(schema), Arc::new(properties)).expect("a writer");
        let mut group = writer.next_row_group().expect("a group");
        let mut hour = group.next_column().expect("no error").expect("a column");
        hour.typed::<Int32Type>()
            .write_batch(&[0, 1, 2], None, None)
            .expect("written");
        hour.close().expect("closed");
        let mut w = group.next_column().expect("no error").expect("a column");
        w.typed::<DoubleType>()
            .write_batch(&[0.5, 1.5, 2.5], None, None)
            .expect("written");
        w.close().expect("closed");
        group.close().expect("closed");
        writer.close().expect("closed");
        path
    }

    #[test]
    fn columns_of_numbers_are_read() {
        let path = written("numbers");
        let read = |wanted: &[&str], rows| {
            let wanted: Vec<String> = wanted.iter().map(|&name| name.to_owned()).collect();
            read_parquet(File::open(&path).expect("there"), &wanted, rows)
        };
        assert_eq!(
            read(&["w", "hour"], usize::MAX),
            Ok(vec![vec![0.5, 1.5, 2.5], vec![0.0, 1.0, 2.0]])
        );
        assert_eq!(read(&["w"], 2), Ok(vec![vec![0.5, 1.5]]));
        let missing = read(&["v"], 2).expect_err("no such column");
        assert!(missing.contains("its columns are `hour`, `w`"), "{missing}");
        std::fs::remove_file(path).expect("its own file");
    }

    #[test]
    fn cut_files_are_refused() {
        let path = written("cut");
        let bytes = std::fs::read(&path).expect("there");
        for length in 0..bytes.len() {
            std::fs::write(&path, &bytes[..length]).expect("written");
            read_parquet(File::open(&path).expect("there"), &["w".to_owned()], 9).expect_err("cut off");
        }
        std::fs::remove_file(path).expect("its own file");
    }
}
