//! Files of trajectories.

use std::path::Path;

use super::Trajectories;
use super::parquet::{TrajectoryError, from_bytes, to_bytes};
use crate::io;
use crate::table::Hash;

/// Writes `trajectories` to the Parquet file at `path`.
///
/// # Errors
/// It cannot be written.
pub fn write(path: &Path, trajectories: &Trajectories) -> Result<(), TrajectoryError> {
    let bytes = to_bytes(trajectories)?;
    io::replace(path, &bytes).map_err(TrajectoryError::Io)
}

/// The trajectories in the Parquet file at `path`, with the SHA-256 of its bytes.
///
/// # Errors
/// It cannot be read, or is no such file.
pub fn read(path: &Path) -> Result<(Trajectories, Hash), TrajectoryError> {
    from_bytes(io::read(path).map_err(TrajectoryError::Io)?)
}
