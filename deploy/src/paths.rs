//! Files and folders given on the command line: checks before a command begins its work. Tests in `tests/program/`,
//! such as `bad_input.rs` and `train.rs`, compare texts of errors.

use std::path::{Path, PathBuf};

use anyhow::bail;
use reveille_lab::sweep::{SweepError, find_table};

/// Returns the path of the table that `path` names; for a folder, of the table of the sweep in it.
///
/// # Errors
/// If `path` is a folder without such a table. A missing file is no error here.
pub(crate) fn resolve_table(path: &Path) -> Result<PathBuf, SweepError> {
    if path.is_dir() {
        find_table(path)
    } else {
        Ok(path.to_owned())
    }
}

/// Whether both paths lead to the same existing file or folder.
pub(crate) fn is_same_path(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        (Err(_), _) | (_, Err(_)) => false,
    }
}

/// Checks that a folder can exist at `path`, which was given by `option`.
///
/// # Errors
/// If `path` is a file.
pub(crate) fn check_output_folder(option: &str, path: &Path) -> anyhow::Result<()> {
    // A link to a missing folder has no metadata; its use returns the error.
    if path.metadata().is_ok_and(|found| !found.is_dir()) {
        bail!("{option} {}: is a file, not a folder; name a folder", path.display());
    }
    Ok(())
}

/// Checks that a file can be written at `path`. The error names its `content`, such as "the model".
///
/// # Errors
/// If `path` is a folder, or its folder does not exist.
pub(crate) fn check_output_path(path: &Path, content: &str) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!("{}: is a folder; name a file for {content}", path.display());
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
