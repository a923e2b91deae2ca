//! Files and folders that the command line names.

use std::path::{Path, PathBuf};

use anyhow::bail;
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

/// Refuses a place for a file that cannot be written there, before any work is done. `what` it is to hold.
pub fn check_place(path: &Path, what: &str) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!("{}: is a folder; --out names the file for {what}", path.display());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        bail!("{}: the folder {} is not there", path.display(), folder.display());
    }
    Ok(())
}
