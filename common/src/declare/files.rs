//! Files as pure code asks for them. Who opens them stands at the edge: [`crate::io::Disk`].

use std::io;
use std::path::{Path, PathBuf};

/// Why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refuses.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    /// The path is that of a folder.
    #[error("is not a file")]
    Folder,
    /// It is a pipe or a device, which may never end.
    #[error("is not a file")]
    Special,
    /// The file is longer than was asked for.
    #[error("is larger than {most} bytes")]
    TooLong {
        /// Its length in bytes.
        length: u64,
        /// The most that was asked for.
        most: u64,
    },
}

/// Gives the bytes of files.
pub trait Files {
    /// The bytes of the regular file at `path`, if they are at most `most`.
    ///
    /// # Errors
    /// See [`FileError`].
    fn read(&self, path: &Path, most: u64) -> Result<Vec<u8>, FileError>;

    /// Whether there is anything at `path`.
    fn exists(&self, path: &Path) -> bool;

    /// `path` from the root on, without a look at what is there.
    ///
    /// # Errors
    /// There is no working directory.
    fn absolute(&self, path: &Path) -> io::Result<PathBuf>;
}

/// A disk without any file.
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
