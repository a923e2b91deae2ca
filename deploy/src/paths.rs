//! Files and folders given on the command line: checks before a command begins its work. `tests/program/bad_input.rs`
//! compares texts of errors.

use std::path::{Path, PathBuf};

use anyhow::bail;
use reveille_lab::sweep::{SweepError, find_table};

/// The table that `path` names; for a folder, the table of the sweep in it.
pub(crate) fn resolve_table(path: &Path) -> Result<PathBuf, SweepError> {
    if path.is_dir() {
        find_table(path)
    } else {
        Ok(path.to_owned())
    }
}

/// Whether both paths lead to the same file or folder.
pub(crate) fn is_same_path(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        (Err(_), _) | (_, Err(_)) => false,
    }
}

/// Returns an error if `path`, given by `option`, is a file and therefore cannot be a folder.
pub(crate) fn check_output_folder(option: &str, path: &Path) -> anyhow::Result<()> {
    // A link to a missing folder has no metadata; its use returns the error.
    if path.metadata().is_ok_and(|found| !found.is_dir()) {
        bail!("{option} {}: is a file, not a folder; name a folder", path.display());
    }
    Ok(())
}

/// Returns an error if `path` is a folder or its folder does not exist, so that no file for `what` can be written
/// there.
pub(crate) fn check_output_path(path: &Path, what: &str) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!("{}: is a folder; name a file for {what}", path.display());
    }
    // A file name alone has the empty parent, which is the working directory.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        bail!(
            "{}: the folder {} does not exist; create it, or name another file",
            path.display(),
            folder.display()
        );
    }
    Ok(())
}
