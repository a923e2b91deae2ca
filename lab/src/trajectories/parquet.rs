//! Trajectories as Parquet: a row a device and TTI.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use bytes::Bytes;
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::column::reader::get_typed_column_reader;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, FloatType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{FileReader, RowGroupReader, SerializedFileReader};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::Type;
use reveille_bs::policy::dt::record::{Look, Step};
use reveille_bs::policy::dt::senses::{COUNT, FEATURES};
use reveille_common::ids::Tti;
use sha2::{Digest as _, Sha256};

use super::{Chunk, Trajectories};
use crate::table::Hash;

/// The version of the schema, raised when the meaning of a column changes.
const VERSION: &str = "1";
/// Its key in the metadata.
pub(super) const KEY: &str = "reveille.trajectories";
/// Rows of a row group, about.
const GROUP: usize = 100_000;

/// Why a file of trajectories cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    /// It cannot be read or written.
    #[error("{0}")]
    Io(#[source] std::io::Error),
    /// It is no Parquet file, or damaged.
    #[error("is not a readable Parquet file ({0}); record one: reveille train record")]
    Format(String),
    /// It is of another program or version.
    #[error("is not a file of trajectories of this program ({0}); record one: reveille train record")]
    Foreign(String),
    /// A column is missing or of another type.
    #[error("its column {0}; record it again: reveille train record")]
    Column(String),
    /// Rows do not fit together.
    #[error("its rows do not fit together: {0}")]
    Rows(String),
}

impl From<ParquetError> for TrajectoryError {
    fn from(error: ParquetError) -> Self {
        Self::Format(error.to_string())
    }
}

/// A column: its name, type, and whether values may be missing.
type Column = (&'static str, Physical, bool);

/// All columns before and after the features.
const BEFORE: [Column; 6] = [
    ("run", Physical::INT32, false),
    ("policy", Physical::BYTE_ARRAY, false),
    ("price", Physical::FLOAT, true),
    ("tti", Physical::INT64, false),
    ("device", Physical::INT32, false),
    ("devices", Physical::INT32, false),
];
const AFTER: [Column; 9] = [
    ("expected", Physical::FLOAT, false),
    ("on", Physical::BOOLEAN, false),
    ("found", Physical::BOOLEAN, false),
    ("wake_expected", Physical::FLOAT, true),
    ("wake_brought", Physical::FLOAT, true),
    ("share", Physical::FLOAT, false),
    ("reward", Physical::FLOAT, false),
    ("wake_reward", Physical::FLOAT, false),
    ("return", Physical::FLOAT, false),
];

fn schema() -> Result<Type, ParquetError> {
    let features = FEATURES.iter().map(|name| (*name, Physical::FLOAT, false));
    let columns = BEFORE.into_iter().chain(features).chain(AFTER);
    let field = |(name, physical, is_optional): Column| {
        let repetition = if is_optional {
            Repetition::OPTIONAL
        } else {
            Repetition::REQUIRED
        };
        let text = (physical == Physical::BYTE_ARRAY).then_some(LogicalType::String);
        let column = Type::primitive_type_builder(name, physical).with_repetition(repetition);
        column.with_logical_type(text).build().map(Arc::new)
    };
    let fields = columns.map(field).collect::<Result<Vec<_>, _>>()?;
    Type::group_type_builder("trajectories").with_fields(fields).build()
}

/// The bytes of the file of `trajectories`.
pub(super) fn to_bytes(trajectories: &Trajectories) -> Result<Vec<u8>, TrajectoryError> {
    let mut pairs = vec![KeyValue::new(KEY.to_owned(), VERSION.to_owned())];
    pairs.extend(
        trajectories
            .about
            .iter()
            .map(|(key, value)| KeyValue::new(key.clone(), value.clone())),
    );
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_key_value_metadata(Some(pairs))
        .build();
    let mut writer = SerializedFileWriter::new(Vec::new(), Arc::new(schema()?), Arc::new(properties))?;
    let mut rest = &trajectories.chunks[..];
    while !rest.is_empty() {
        let mut rows = 0;
        let end = rest.iter().position(|chunk| {
            rows += chunk.steps.len() * chunk.devices;
            rows > GROUP
        });
        let (now, later) = rest.split_at(end.unwrap_or(rest.len()).max(1));
        let mut group = writer.next_row_group()?;
        write_group(&mut group, now)?;
        group.close()?;
        rest = later;
    }
    Ok(writer.into_inner()?)
}

/// A row: its chunk, the TTI within it, and the device.
type Row<'c> = (&'c Chunk, usize, usize);

fn write_group(group: &mut SerializedRowGroupWriter<'_, Vec<u8>>, chunks: &[Chunk]) -> Result<(), ParquetError> {
    let rows: Vec<Row<'_>> = chunks
        .iter()
        .flat_map(|chunk| {
            let devices = chunk.devices;
            (0..chunk.steps.len()).flat_map(move |t| (0..devices).map(move |j| (chunk, t, j)))
        })
        .collect();
    let all = |of: fn(&Row<'_>) -> f32| rows.iter().map(of).collect::<Vec<f32>>();
    write::<Int32Type>(
        group,
        &rows.iter().map(|row| row.0.run.cast_signed()).collect::<Vec<_>>(),
        None,
    )?;
    let policies: Vec<ByteArray> = rows.iter().map(|row| ByteArray::from(&*row.0.policy)).collect();
    write::<ByteArrayType>(group, &policies, None)?;
    optional(group, rows.iter().map(|row| row.0.price))?;
    write::<Int64Type>(
        group,
        &rows.iter().map(|row| at(row).tti.0.cast_signed()).collect::<Vec<_>>(),
        None,
    )?;
    write::<Int32Type>(
        group,
        &rows.iter().map(|row| (row.2 as u32).cast_signed()).collect::<Vec<_>>(),
        None,
    )?;
    write::<Int32Type>(
        group,
        &rows
            .iter()
            .map(|row| (row.0.devices as u32).cast_signed())
            .collect::<Vec<_>>(),
        None,
    )?;
    for feature in 0..COUNT {
        let values: Vec<f32> = rows.iter().map(|row| at(row).tokens[row.2 * COUNT + feature]).collect();
        write::<FloatType>(group, &values, None)?;
    }
    write::<FloatType>(group, &all(|row| look(row).expected), None)?;
    write::<BoolType>(group, &rows.iter().map(|row| look(row).on).collect::<Vec<_>>(), None)?;
    write::<BoolType>(group, &rows.iter().map(|row| look(row).found).collect::<Vec<_>>(), None)?;
    optional(
        group,
        rows.iter().map(|row| look(row).wake_up.map(|(expected, _)| expected)),
    )?;
    optional(
        group,
        rows.iter().map(|row| look(row).wake_up.map(|(_, brought)| brought)),
    )?;
    write::<FloatType>(group, &all(|row| at(row).share), None)?;
    write::<FloatType>(group, &all(|row| at(row).reward), None)?;
    write::<FloatType>(group, &all(|row| at(row).wake_reward), None)?;
    write::<FloatType>(group, &all(|row| row.0.returns[row.1]), None)
}

fn at<'c>(row: &Row<'c>) -> &'c Step {
    &row.0.steps[row.1]
}

fn look<'c>(row: &Row<'c>) -> &'c Look {
    &at(row).looks[row.2]
}

fn optional(
    group: &mut SerializedRowGroupWriter<'_, Vec<u8>>,
    values: impl Iterator<Item = Option<f32>> + Clone,
) -> Result<(), ParquetError> {
    let levels: Vec<i16> = values.clone().map(|value| i16::from(value.is_some())).collect();
    write::<FloatType>(group, &values.flatten().collect::<Vec<_>>(), Some(&levels))
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

/// The trajectories in the bytes of a file, and their SHA-256.
pub(super) fn from_bytes(bytes: Vec<u8>) -> Result<(Trajectories, Hash), TrajectoryError> {
    let hash = Hash(Sha256::digest(&bytes).into());
    // The decoder panics on some corrupt files.
    let read = catch_unwind(AssertUnwindSafe(|| decode(Bytes::from(bytes))));
    let read = read.unwrap_or_else(|_| Err(TrajectoryError::Format("the decoder gave up".to_owned())));
    read.map(|trajectories| (trajectories, hash))
}

fn decode(bytes: Bytes) -> Result<Trajectories, TrajectoryError> {
    let reader = SerializedFileReader::new(bytes)?;
    let file = reader.metadata().file_metadata();
    let pairs = file.key_value_metadata().map_or(&[][..], Vec::as_slice);
    let version = pairs
        .iter()
        .find(|pair| pair.key == KEY)
        .and_then(|pair| pair.value.as_deref());
    match version {
        Some(VERSION) => {}
        Some(other) => return Err(TrajectoryError::Foreign(format!("version {other}, not {VERSION}"))),
        None => return Err(TrajectoryError::Foreign(format!("no {KEY} in its metadata"))),
    }
    let (own, found) = (schema()?, file.schema().get_fields());
    for (index, field) in own.get_fields().iter().enumerate() {
        let name = field.name();
        match found.get(index) {
            Some(other) if other == field => {}
            Some(other) if other.name() == name => {
                return Err(TrajectoryError::Column(format!("{name} is of another type")));
            }
            Some(_) | None => return Err(TrajectoryError::Column(format!("{name} is missing"))),
        }
    }
    let about = pairs.iter().filter(|pair| pair.key != KEY);
    let about = about
        .filter_map(|pair| Some((pair.key.clone(), pair.value.clone()?)))
        .collect();
    let mut chunks = Vec::new();
    for group in 0..reader.num_row_groups() {
        read_group(&*reader.get_row_group(group)?, &mut chunks)?;
    }
    Ok(Trajectories { about, chunks })
}

/// The columns of a row group, one after another.
struct Columns<'r> {
    group: &'r dyn RowGroupReader,
    rows: usize,
    next: usize,
}

impl Columns<'_> {
    fn required<T: DataType>(&mut self) -> Result<Vec<T::T>, TrajectoryError> {
        let mut values = Vec::new();
        let mut reader = get_typed_column_reader::<T>(self.group.get_column_reader(self.next)?);
        self.next += 1;
        let (records, _, _) = reader.read_records(self.rows, None, None, &mut values)?;
        self.complete(records)?;
        Ok(values)
    }

    fn optional(&mut self) -> Result<Vec<Option<f32>>, TrajectoryError> {
        let (mut values, mut levels) = (Vec::new(), Vec::new());
        let mut reader = get_typed_column_reader::<FloatType>(self.group.get_column_reader(self.next)?);
        self.next += 1;
        let (records, _, _) = reader.read_records(self.rows, Some(&mut levels), None, &mut values)?;
        self.complete(records)?;
        let mut values = values.into_iter();
        Ok(levels
            .into_iter()
            .map(|level| if level > 0 { values.next() } else { None })
            .collect())
    }

    fn complete(&self, records: usize) -> Result<(), TrajectoryError> {
        if records == self.rows {
            Ok(())
        } else {
            Err(TrajectoryError::Rows("a column is shorter than the others".to_owned()))
        }
    }
}

fn read_group(group: &dyn RowGroupReader, chunks: &mut Vec<Chunk>) -> Result<(), TrajectoryError> {
    let rows = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
    let mut columns = Columns { group, rows, next: 0 };
    let runs = columns.required::<Int32Type>()?;
    let policies = columns.required::<ByteArrayType>()?;
    let prices = columns.optional()?;
    let ttis = columns.required::<Int64Type>()?;
    let devices = columns.required::<Int32Type>()?;
    let counts = columns.required::<Int32Type>()?;
    let mut features = Vec::with_capacity(COUNT);
    for _ in FEATURES {
        features.push(columns.required::<FloatType>()?);
    }
    let expected = columns.required::<FloatType>()?;
    let on = columns.required::<BoolType>()?;
    let found = columns.required::<BoolType>()?;
    let wake_expected = columns.optional()?;
    let wake_brought = columns.optional()?;
    let share = columns.required::<FloatType>()?;
    let reward = columns.required::<FloatType>()?;
    let wake_reward = columns.required::<FloatType>()?;
    let returns = columns.required::<FloatType>()?;
    let all = [&expected, &share, &reward, &wake_reward, &returns];
    let required = ["expected", "share", "reward", "wake_reward", "return"]
        .into_iter()
        .zip(all);
    let optional = [
        ("price", &prices),
        ("wake_expected", &wake_expected),
        ("wake_brought", &wake_brought),
    ];
    all_finite(
        required.into_iter().chain(FEATURES.into_iter().zip(&features)),
        optional,
    )?;
    let mut row = 0;
    while row < rows {
        let n = usize::try_from(counts[row]).unwrap_or(0);
        let own = row..row + n;
        let is_whole = n > 0
            && own.end <= rows
            && own.clone().enumerate().all(|(j, at)| {
                (runs[at], ttis[at], counts[at]) == (runs[row], ttis[row], counts[row])
                    && usize::try_from(devices[at]) == Ok(j)
            });
        if !is_whole {
            return Err(TrajectoryError::Rows(format!(
                "TTI {} of run {} is not whole",
                ttis[row], runs[row]
            )));
        }
        let look = |at: usize| Look {
            expected: expected[at],
            on: on[at],
            found: found[at],
            wake_up: wake_expected[at].zip(wake_brought[at]),
        };
        let step = Step {
            tti: Tti(ttis[row].cast_unsigned()),
            tokens: own
                .clone()
                .flat_map(|at| features.iter().map(move |column| column[at]))
                .collect(),
            looks: own.map(look).collect(),
            share: share[row],
            reward: reward[row],
            wake_reward: wake_reward[row],
        };
        let run = runs[row].cast_unsigned();
        let follows = |chunk: &Chunk| {
            chunk.run == run && chunk.devices == n && chunk.steps.last().is_some_and(|last| last.tti + 1 == step.tti)
        };
        if !chunks.last().is_some_and(follows) {
            let policy = policies[row].as_utf8().map_err(TrajectoryError::from)?;
            chunks.push(Chunk {
                run,
                policy: policy.into(),
                price: prices[row],
                devices: n,
                steps: Vec::new(),
                returns: Vec::new(),
            });
        }
        let chunk = chunks.last_mut().expect("one was begun");
        chunk.steps.push(step);
        chunk.returns.push(returns[row]);
        row += n;
    }
    Ok(())
}

/// Refuses columns of which a value that is there is not finite.
fn all_finite<'a>(
    required: impl Iterator<Item = (&'a str, &'a Vec<f32>)>,
    optional: [(&'a str, &'a Vec<Option<f32>>); 3],
) -> Result<(), TrajectoryError> {
    for (name, column) in required {
        finite(name, column.iter().copied().map(Some))?;
    }
    for (name, column) in optional {
        finite(name, column.iter().copied())?;
    }
    Ok(())
}

/// Refuses a column of which a value that is there is not finite.
fn finite(name: &str, values: impl Iterator<Item = Option<f32>>) -> Result<(), TrajectoryError> {
    let is_bad = |value: Option<f32>| value.is_some_and(|value| !value.is_finite());
    match values.zip(0_u64..).find(|(value, _)| is_bad(*value)) {
        Some((_, row)) => Err(TrajectoryError::Rows(format!(
            "{name} is not finite in row {row} of its group"
        ))),
        None => Ok(()),
    }
}
