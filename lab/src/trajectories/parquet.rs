//! Trajectories as Parquet: one row per device and TTI, for `io`. Columns are written by [`write_group`] and read by
//! [`read_group`] by position, in the order of [`schema`]: change all three, and the names in `check_all_finite`. Raise
//! [`VERSION`] when the meaning of a column changes.

use ::parquet::basic::Type as Physical;
use ::parquet::data_type::{BoolType, ByteArray, ByteArrayType, FloatType, Int32Type, Int64Type};
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{FileReader, RowGroupReader, SerializedFileReader};
use ::parquet::schema::types::Type;
use bytes::Bytes;
use reveille_bs::policy::dt::record::{DeviceStep, TrajectoryStep};
use reveille_bs::policy::dt::tokens::{FEATURE_COUNT, FEATURES};
use reveille_common::declare::describe_read_error;
use reveille_common::ids::Tti;
use reveille_common::parquet::{self, Column, GroupReader, GroupWriter, Writer};
use sha2::{Digest as _, Sha256};

use super::{Chunk, Trajectories};
use crate::table::Hash;

/// The version of the schema, raised when the meaning of a column changes. Files of another version are refused.
const VERSION: &str = "1";
/// The key of the version in the metadata.
pub(super) const VERSION_KEY: &str = "reveille.trajectories";
/// The approximate number of rows in a row group.
const ROWS_PER_GROUP: usize = 100_000;

/// A reason why a file of trajectories cannot be used. Callers put `FILE: ` before the text.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    /// The file cannot be read.
    #[error("{}", describe_read_error(.0, "name a file that reveille train record wrote"))]
    Read(#[source] std::io::Error),
    /// The file cannot be written.
    #[error("cannot be written: {0}")]
    Write(#[source] std::io::Error),
    /// The file is not a Parquet file, or is damaged.
    #[error("is not a readable Parquet file ({0}); record one: reveille train record")]
    Format(String),
    /// The file belongs to another program or version.
    #[error("is not a trajectory file of this program ({0}); record one: reveille train record")]
    Foreign(String),
    /// A column is missing or has another type.
    #[error("its column {0}; record it again: reveille train record")]
    Column(String),
    /// Rows are inconsistent.
    #[error("its rows are inconsistent: {0}; record it again: reveille train record")]
    Rows(String),
}

impl From<ParquetError> for TrajectoryError {
    fn from(error: ParquetError) -> Self {
        Self::Format(error.to_string())
    }
}

/// All columns before the features.
const COLUMNS_BEFORE_FEATURES: [Column<'_>; 6] = [
    Column::required("run", Physical::INT32),
    Column::required("policy", Physical::BYTE_ARRAY),
    Column::optional("price", Physical::FLOAT),
    Column::required("tti", Physical::INT64),
    Column::required("device", Physical::INT32),
    Column::required("devices", Physical::INT32),
];
/// All columns after the features.
const COLUMNS_AFTER_FEATURES: [Column<'_>; 9] = [
    Column::required("expected", Physical::FLOAT),
    Column::required("on", Physical::BOOLEAN),
    Column::required("found", Physical::BOOLEAN),
    Column::optional("wake_expected", Physical::FLOAT),
    Column::optional("wake_brought", Physical::FLOAT),
    Column::required("share", Physical::FLOAT),
    Column::required("reward", Physical::FLOAT),
    Column::required("wake_reward", Physical::FLOAT),
    Column::required("return", Physical::FLOAT),
];

fn schema() -> Result<Type, ParquetError> {
    let features = FEATURES.map(|name| Column::required(name, Physical::FLOAT));
    let columns = COLUMNS_BEFORE_FEATURES
        .into_iter()
        .chain(features)
        .chain(COLUMNS_AFTER_FEATURES);
    parquet::schema("trajectories", columns)
}

pub(super) fn to_bytes(trajectories: &Trajectories) -> Result<Vec<u8>, TrajectoryError> {
    let version = (VERSION_KEY.to_owned(), VERSION.to_owned());
    let about = std::iter::once(version).chain(trajectories.about.clone());
    let mut writer = Writer::begin(Vec::new(), schema()?, about)?;
    let mut unwritten = &trajectories.chunks[..];
    while !unwritten.is_empty() {
        let mut rows = 0;
        let first_beyond = unwritten.iter().position(|chunk| {
            rows += chunk.steps.len() * chunk.devices;
            rows > ROWS_PER_GROUP
        });
        // At least one chunk, even if it alone exceeds the size of a group; otherwise the loop would not end.
        let (group_chunks, later) = unwritten.split_at(first_beyond.unwrap_or(unwritten.len()).max(1));
        writer.write_row_group(|group| write_group(group, group_chunks))?;
        unwritten = later;
    }
    Ok(writer.finish()?)
}

/// A row of the file.
struct RowRef<'c> {
    chunk: &'c Chunk,
    /// The index of the TTI in the chunk.
    step_index: usize,
    device: usize,
}

impl<'c> RowRef<'c> {
    fn step(&self) -> &'c TrajectoryStep {
        &self.chunk.steps[self.step_index]
    }

    fn device_step(&self) -> &'c DeviceStep {
        &self.step().devices[self.device]
    }
}

fn write_group(group: &mut GroupWriter<'_, Vec<u8>>, chunks: &[Chunk]) -> Result<(), ParquetError> {
    let rows: Vec<RowRef<'_>> = chunks
        .iter()
        .flat_map(|chunk| {
            (0..chunk.steps.len()).flat_map(move |step_index| {
                (0..chunk.devices).map(move |device| RowRef {
                    chunk,
                    step_index,
                    device,
                })
            })
        })
        .collect();
    let ints = |value: fn(&RowRef<'_>) -> u32| rows.iter().map(move |row| value(row).cast_signed());
    let floats = |value: fn(&RowRef<'_>) -> f32| rows.iter().map(value);
    let optional_floats = |value: fn(&RowRef<'_>) -> Option<f32>| rows.iter().map(value);
    let flags = |value: fn(&RowRef<'_>) -> bool| rows.iter().map(value);
    // In the order of `schema`: the writer takes columns by position.
    group.write_required::<Int32Type>(ints(|row| row.chunk.run))?;
    group.write_required::<ByteArrayType>(rows.iter().map(|row| ByteArray::from(&*row.chunk.policy)))?;
    group.write_optional::<FloatType>(optional_floats(|row| row.chunk.price))?;
    group.write_required::<Int64Type>(rows.iter().map(|row| row.step().tti.0.cast_signed()))?;
    group.write_required::<Int32Type>(ints(|row| row.device as u32))?;
    group.write_required::<Int32Type>(ints(|row| row.chunk.devices as u32))?;
    for feature in 0..FEATURE_COUNT {
        group.write_required::<FloatType>(
            rows.iter()
                .map(|row| row.step().tokens[row.device * FEATURE_COUNT + feature]),
        )?;
    }
    group.write_required::<FloatType>(floats(|row| row.device_step().expected_events))?;
    group.write_required::<BoolType>(flags(|row| row.device_step().is_sensing))?;
    group.write_required::<BoolType>(flags(|row| row.device_step().has_reported_first))?;
    group.write_optional::<FloatType>(optional_floats(|row| {
        row.device_step().wake_up.map(|(expected_gain, _)| expected_gain)
    }))?;
    group.write_optional::<FloatType>(optional_floats(|row| {
        row.device_step().wake_up.map(|(_, actual_gain)| actual_gain)
    }))?;
    group.write_required::<FloatType>(floats(|row| row.step().covered_share))?;
    group.write_required::<FloatType>(floats(|row| row.step().reward))?;
    group.write_required::<FloatType>(floats(|row| row.step().wake_reward))?;
    group.write_required::<FloatType>(floats(|row| row.chunk.returns[row.step_index]))
}

/// Decodes the bytes of a file. Also returns their SHA-256.
pub(super) fn from_bytes(bytes: Vec<u8>) -> Result<(Trajectories, Hash), TrajectoryError> {
    let hash = Hash(Sha256::digest(&bytes).into());
    let decoded = parquet::catch_decoder_panic(|| decode(Bytes::from(bytes)));
    let decoded = decoded.unwrap_or_else(|| Err(TrajectoryError::Format("its content is corrupt".to_owned())));
    decoded.map(|trajectories| (trajectories, hash))
}

fn decode(bytes: Bytes) -> Result<Trajectories, TrajectoryError> {
    let reader = SerializedFileReader::new(bytes)?;
    let file = reader.metadata().file_metadata();
    let pairs = file.key_value_metadata().map_or(&[][..], Vec::as_slice);
    let version = pairs
        .iter()
        .find(|pair| pair.key == VERSION_KEY)
        .and_then(|pair| pair.value.as_deref());
    match version {
        Some(VERSION) => {}
        Some(other) => return Err(TrajectoryError::Foreign(format!("version {other}, not {VERSION}"))),
        None => return Err(TrajectoryError::Foreign(format!("no {VERSION_KEY} in its metadata"))),
    }
    let (expected_schema, file_fields) = (schema()?, file.schema().get_fields());
    for (index, field) in expected_schema.get_fields().iter().enumerate() {
        let name = field.name();
        match file_fields.get(index) {
            Some(other) if other == field => {}
            Some(other) if other.name() == name => {
                return Err(TrajectoryError::Column(format!("{name} has another type")));
            }
            Some(_) | None => return Err(TrajectoryError::Column(format!("{name} is missing"))),
        }
    }
    let about = pairs.iter().filter(|pair| pair.key != VERSION_KEY);
    let about = about
        .filter_map(|pair| Some((pair.key.clone(), pair.value.clone()?)))
        .collect();
    let mut chunks = Vec::new();
    for group in 0..reader.num_row_groups() {
        read_group(&*reader.get_row_group(group)?, &mut chunks)?;
    }
    Ok(Trajectories { about, chunks })
}

/// Appends the rows of `group` to `chunks`. Files do not mark the chunks: consecutive TTIs of a run are one chunk.
fn read_group(group: &dyn RowGroupReader, chunks: &mut Vec<Chunk>) -> Result<(), TrajectoryError> {
    let mut columns = GroupReader::new(group);
    // In the order of `schema`: the reader takes columns by position. Each local has the name of its column, if that
    // name is clear.
    let rows = columns.rows();
    let runs = columns.read_required::<Int32Type>()?;
    let policies = columns.read_required::<ByteArrayType>()?;
    let prices = columns.read_optional::<FloatType>()?;
    let ttis = columns.read_required::<Int64Type>()?;
    let device_ids = columns.read_required::<Int32Type>()?;
    let device_counts = columns.read_required::<Int32Type>()?;
    let mut features = Vec::with_capacity(FEATURE_COUNT);
    for _ in FEATURES {
        features.push(columns.read_required::<FloatType>()?);
    }
    let expected = columns.read_required::<FloatType>()?;
    let is_sensing = columns.read_required::<BoolType>()?;
    let has_reported_first = columns.read_required::<BoolType>()?;
    let wake_expected = columns.read_optional::<FloatType>()?;
    let wake_brought = columns.read_optional::<FloatType>()?;
    let covered_share = columns.read_required::<FloatType>()?;
    let reward = columns.read_required::<FloatType>()?;
    let wake_reward = columns.read_required::<FloatType>()?;
    let returns = columns.read_required::<FloatType>()?;
    let required_columns = [&expected, &covered_share, &reward, &wake_reward, &returns];
    let required = ["expected", "share", "reward", "wake_reward", "return"]
        .into_iter()
        .zip(required_columns);
    let optional = [
        ("price", &prices),
        ("wake_expected", &wake_expected),
        ("wake_brought", &wake_brought),
    ];
    check_all_finite(
        required.into_iter().chain(FEATURES.into_iter().zip(&features)),
        optional,
    )?;
    let mut row = 0;
    while row < rows {
        // A negative count is as invalid as 0, which is refused below: the loop then always advances.
        let n = usize::try_from(device_counts[row]).unwrap_or(0);
        let tti_rows = row..row + n;
        let is_whole = n > 0
            && tti_rows.end <= rows
            && tti_rows.clone().enumerate().all(|(j, other)| {
                (runs[other], ttis[other], device_counts[other]) == (runs[row], ttis[row], device_counts[row])
                    && usize::try_from(device_ids[other]) == Ok(j)
            });
        if !is_whole {
            return Err(TrajectoryError::Rows(format!(
                "TTI {} of run {} is incomplete",
                ttis[row], runs[row]
            )));
        }
        let device_step_of = |device_row: usize| DeviceStep {
            expected_events: expected[device_row],
            is_sensing: is_sensing[device_row],
            has_reported_first: has_reported_first[device_row],
            wake_up: wake_expected[device_row].zip(wake_brought[device_row]),
        };
        let step = TrajectoryStep {
            tti: Tti(ttis[row].cast_unsigned()),
            tokens: tti_rows
                .clone()
                .flat_map(|device_row| features.iter().map(move |column| column[device_row]))
                .collect(),
            devices: tti_rows.map(device_step_of).collect(),
            covered_share: covered_share[row],
            reward: reward[row],
            wake_reward: wake_reward[row],
        };
        let run = runs[row].cast_unsigned();
        let ends_before_step = |chunk: &Chunk| {
            chunk.run == run && chunk.devices == n && chunk.steps.last().is_some_and(|last| last.tti + 1 == step.tti)
        };
        if !chunks.last().is_some_and(ends_before_step) {
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

/// Refuses columns with a value that is present and not finite.
fn check_all_finite<'a>(
    required: impl Iterator<Item = (&'a str, &'a Vec<f32>)>,
    optional: [(&'a str, &'a Vec<Option<f32>>); 3],
) -> Result<(), TrajectoryError> {
    for (name, column) in required {
        check_finite(name, column.iter().copied().map(Some))?;
    }
    for (name, column) in optional {
        check_finite(name, column.iter().copied())?;
    }
    Ok(())
}

/// Refuses a column with a value that is present and not finite.
fn check_finite(name: &str, values: impl Iterator<Item = Option<f32>>) -> Result<(), TrajectoryError> {
    let is_bad = |value: Option<f32>| value.is_some_and(|value| !value.is_finite());
    match values.zip(0_u64..).find(|(value, _)| is_bad(*value)) {
        Some((_, row)) => Err(TrajectoryError::Rows(format!(
            "{name} is not finite in row {row} of its group"
        ))),
        None => Ok(()),
    }
}
