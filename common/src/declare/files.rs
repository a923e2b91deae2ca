//! The file access that pure code needs. The implementation for real files is [`crate::io::Disk`], the one for scenario
//! files in recordings `view/src/recording/bundle.rs`; [`NoFiles`] has none. Error texts are parts of sentences: their
//! callers put the path before them, and tests expect them.

use std::io;
use std::path::{Path, PathBuf};

/// The reason why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system returned an error.
    #[error("{}", describe_read_error(.0, "correct the path"))]
    Io(#[from] io::Error),
    /// The path names a folder.
    #[error("is a folder; name a file")]
    Folder,
    /// The path names a pipe or a device, which may never end.
    #[error("is a pipe or a device; name a regular file")]
    Special,
    /// The file is longer than the limit.
    #[error("is larger than {max_bytes} bytes")]
    TooLong {
        /// Its length in bytes; of a file that grows while it is read, the length read so far.
        length: u64,
        /// The limit in bytes.
        max_bytes: u64,
    },
}

/// Describes why a file cannot be read, without its path. Only a missing file gets the `hint`, an imperative.
pub fn describe_read_error(error: &io::Error, hint: &str) -> String {
    if error.kind() == io::ErrorKind::NotFound {
        format!("no such file; {hint}")
    } else {
        format!("cannot be read: {error}")
    }
}

/// An interface that reads files.
pub trait Files {
    /// Returns the bytes of the regular file at `path`, if it has at most `max_bytes` bytes.
    ///
    /// # Errors
    /// See [`FileError`].
    fn read(&self, path: &Path, max_bytes: u64) -> Result<Vec<u8>, FileError>;

    /// Whether `path` exists.
    fn exists(&self, path: &Path) -> bool;

    /// Returns the path under which `path` is read, without accessing the file: absolute on a disk, unchanged
    /// elsewhere.
    ///
    /// # Errors
    /// If there is no working directory.
    fn absolute(&self, path: &Path) -> io::Result<PathBuf>;
}

/// A disk without files.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoFiles;

impl Files for NoFiles {
    fn read(&self, _: &Path, _: u64) -> Result<Vec<u8>, FileError> {
        Err(FileError::Io(io::ErrorKind::NotFound.into()))
    }

    fn exists(&self, _: &Path) -> bool {
        false
    }

    fn absolute(&self, path: &Path) -> io::Result<PathBuf> {
        Ok(path.to_owned())
    }
}
