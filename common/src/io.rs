//! The one place outside the bus that opens files.

use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use crate::declare::{FileError, Files};

/// The files of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

impl Files for Disk {
    fn read(&self, path: &Path, most: u64) -> Result<Vec<u8>, FileError> {
        let about = std::fs::metadata(path)?;
        if about.is_dir() {
            return Err(FileError::Folder);
        }
        if !about.is_file() {
            return Err(FileError::Special);
        }
        let length = about.len();
        if length > most {
            return Err(FileError::TooLong { length, most });
        }
        let mut bytes = Vec::with_capacity(length as usize);
        // It may have grown since.
        std::fs::File::open(path)?.take(most).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn exists(&self, path: &Path) -> bool {
        path.exists()
    }

    fn absolute(&self, path: &Path) -> io::Result<PathBuf> {
        std::path::absolute(path)
    }
}
