//! Tables and folders that the command line names.

use std::path::{Path, PathBuf};

use reveille_lab::sweep::{SweepError, table_in};

/// The table that `given` names: that of the sweep in it if it is a folder.
pub fn table_of(given: &Path) -> Result<PathBuf, SweepError> {
    if given.is_dir() {
        table_in(given)
    } else {
        Ok(given.to_owned())
    }
}

/// Whether both paths lead to one file or folder.
pub fn is_same(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        (Err(_), _) | (_, Err(_)) => false,
    }
}
