//! Files of trajectories: reading and atomic writing, for `reveille train record` and `train dt`. `parquet` defines
//! their format.

use std::path::Path;

use super::Trajectories;
use super::parquet::{TrajectoryError, from_bytes, to_bytes};
use crate::io::{read, replace};
use crate::table::Hash;

impl Trajectories {
    /// Reads the Parquet file at `path`. Returns its trajectories and the SHA-256 of its bytes.
    ///
    /// # Errors
    /// If the file cannot be read or is not a file of trajectories.
    pub fn read(path: &Path) -> Result<(Self, Hash), TrajectoryError> {
        from_bytes(read(path).map_err(TrajectoryError::Read)?)
    }

    /// Writes the trajectories to the Parquet file at `path`, in one step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TrajectoryError> {
        replace(path, &to_bytes(self)?).map_err(TrajectoryError::Write)
    }
}
