//! Flat Parquet files: the writer and the reader of columns that result tables, trajectories and exports share. The
//! callers (`lab/src/table/`, `lab/src/trajectories/`, `view/src/export/`) define names, types and order of the
//! columns; each writes or reads all columns, in the order of the schema. `columns/parquet.rs` reads foreign files.

use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use ::parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use ::parquet::column::reader::get_typed_column_reader;
use ::parquet::data_type::DataType;
use ::parquet::errors::ParquetError;
use ::parquet::file::metadata::KeyValue;
use ::parquet::file::properties::WriterProperties;
use ::parquet::file::reader::RowGroupReader;
use ::parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use ::parquet::schema::types::Type;

/// The name, type and optionality of a column. A column of bytes holds texts.
#[derive(Clone, Copy, Debug)]
pub struct Column<'n> {
    name: &'n str,
    physical_type: Physical,
    repetition: Repetition,
}

impl<'n> Column<'n> {
    /// Returns a column with a value in each row.
    pub const fn required(name: &'n str, physical_type: Physical) -> Self {
        Self {
            name,
            physical_type,
            repetition: Repetition::REQUIRED,
        }
    }

    /// Returns a column in which values may be missing.
    pub const fn optional(name: &'n str, physical_type: Physical) -> Self {
        Self {
            name,
            physical_type,
            repetition: Repetition::OPTIONAL,
        }
    }
}

/// Returns the schema `name` of these columns.
///
/// # Errors
/// If Parquet does not support a column.
pub fn schema<'n>(name: &str, columns: impl IntoIterator<Item = Column<'n>>) -> Result<Type, ParquetError> {
    let field = |column: Column<'_>| {
        let text = (column.physical_type == Physical::BYTE_ARRAY).then_some(LogicalType::String);
        let builder =
            Type::primitive_type_builder(column.name, column.physical_type).with_repetition(column.repetition);
        builder.with_logical_type(text).build().map(Arc::new)
    };
    let fields = columns.into_iter().map(field).collect::<Result<_, _>>()?;
    Type::group_type_builder(name).with_fields(fields).build()
}

/// An unfinished file, written row group by row group. Without [`Self::finish`] it is unreadable.
pub struct Writer<W: Write + Send>(SerializedFileWriter<W>);

impl<W: Write + Send> Writer<W> {
    /// Starts a file with the key-value pairs `metadata`.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn begin(
        out: W,
        schema: Type,
        metadata: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, ParquetError> {
        let pairs: Vec<KeyValue> = metadata
            .into_iter()
            .map(|(key, value)| KeyValue::new(key, value))
            .collect();
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_key_value_metadata((!pairs.is_empty()).then_some(pairs))
            .build();
        SerializedFileWriter::new(out, Arc::new(schema), Arc::new(properties)).map(Self)
    }

    /// Writes a row group; `write_columns` writes each column of the schema in order.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write_row_group(
        &mut self,
        write_columns: impl FnOnce(&mut GroupWriter<'_, W>) -> Result<(), ParquetError>,
    ) -> Result<(), ParquetError> {
        let mut group = GroupWriter(self.0.next_row_group()?);
        write_columns(&mut group)?;
        group.0.close().map(drop)
    }

    /// Finishes the file and returns the inner writer.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(self) -> Result<W, ParquetError> {
        self.0.into_inner()
    }
}

/// A row group that is being written.
pub struct GroupWriter<'f, W: Write>(SerializedRowGroupWriter<'f, W>);

impl<W: Write + Send> GroupWriter<'_, W> {
    /// Writes the next column, which must be [required](Column::required), with a value in each row.
    ///
    /// # Errors
    /// If it cannot be written, or the schema has no further column.
    ///
    /// # Panics
    /// If it is of another type in the schema.
    pub fn write_required<T: DataType>(&mut self, values: impl IntoIterator<Item = T::T>) -> Result<(), ParquetError> {
        self.write_column::<T>(&values.into_iter().collect::<Vec<_>>(), None)
    }

    /// Writes the next column, which must be [optional](Column::optional): values may be missing.
    ///
    /// # Errors
    /// If it cannot be written, or the schema has no further column.
    ///
    /// # Panics
    /// If it is of another type in the schema.
    pub fn write_optional<T: DataType>(
        &mut self,
        values: impl IntoIterator<Item = Option<T::T>>,
    ) -> Result<(), ParquetError> {
        let values: Vec<Option<T::T>> = values.into_iter().collect();
        // Definition levels of a flat optional column: 1 for a value, 0 for none.
        let levels: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
        self.write_column::<T>(&values.into_iter().flatten().collect::<Vec<_>>(), Some(&levels))
    }

    fn write_column<T: DataType>(&mut self, values: &[T::T], levels: Option<&[i16]>) -> Result<(), ParquetError> {
        let no_column_left = || ParquetError::General("more columns than the schema has".to_owned());
        let mut column = self.0.next_column()?.ok_or_else(no_column_left)?;
        column.typed::<T>().write_batch(values, levels, None)?;
        column.close()
    }
}

/// A reader of the columns of a row group, in order.
pub struct GroupReader<'f> {
    group: &'f dyn RowGroupReader,
    rows: usize,
    /// The index of the next column.
    next_column: usize,
}

impl<'f> GroupReader<'f> {
    /// Creates a reader that starts at the first column of `group`.
    pub fn new(group: &'f dyn RowGroupReader) -> Self {
        Self {
            group,
            rows: usize::try_from(group.metadata().num_rows()).unwrap_or(0),
            next_column: 0,
        }
    }

    /// The number of rows in the group.
    pub const fn rows(&self) -> usize {
        self.rows
    }

    /// Reads the next column, which must be required, with a value in each row.
    ///
    /// # Errors
    /// If it cannot be read or is shorter than the group.
    ///
    /// # Panics
    /// If it is of another type, see [`catch_decoder_panic`].
    pub fn read_required<T: DataType>(&mut self) -> Result<Vec<T::T>, ParquetError> {
        self.read_column::<T>(None)
    }

    /// Reads the next column, which must be optional: values may be missing.
    ///
    /// # Errors
    /// If it cannot be read or is shorter than the group.
    ///
    /// # Panics
    /// If it is of another type, see [`catch_decoder_panic`].
    pub fn read_optional<T: DataType>(&mut self) -> Result<Vec<Option<T::T>>, ParquetError> {
        let mut levels = Vec::new();
        let mut values = self.read_column::<T>(Some(&mut levels))?.into_iter();
        // The reader returns only the values that exist; the levels tell in which rows they belong.
        let value = |level| if level > 0 { values.next() } else { None };
        Ok(levels.into_iter().map(value).collect())
    }

    fn read_column<T: DataType>(&mut self, levels: Option<&mut Vec<i16>>) -> Result<Vec<T::T>, ParquetError> {
        let mut reader = get_typed_column_reader::<T>(self.group.get_column_reader(self.next_column)?);
        self.next_column += 1;
        let mut values = Vec::new();
        let (records, _, _) = reader.read_records(self.rows, levels, None, &mut values)?;
        // A corrupt file can hold fewer records than its metadata claims. The error counts columns from 1.
        if records == self.rows {
            Ok(values)
        } else {
            Err(ParquetError::General(format!(
                "column {} has {records} rows of {}",
                self.next_column, self.rows
            )))
        }
    }
}

/// Runs `decode`; `None` if the decoder panics, as it does on some corrupt files. It needs `panic = "unwind"`, the
/// default of cargo profiles.
pub fn catch_decoder_panic<T>(decode: impl FnOnce() -> T) -> Option<T> {
    catch_unwind(AssertUnwindSafe(decode)).ok()
}
