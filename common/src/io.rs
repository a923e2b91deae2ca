//! File access for [`crate::declare::Files`]; no other module of this crate outside the bus and tests opens files,
//! which `tests/tests/tidy/` checks. Loaders of scenarios and scripts pass [`Disk`]. For tests: the comparison of a
//! generated table with its page.

use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use crate::declare::{FileError, Files};

/// The file system of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

impl Files for Disk {
    fn read(&self, path: &Path, max_bytes: u64) -> Result<Vec<u8>, FileError> {
        let metadata = std::fs::metadata(path)?;
        if metadata.is_dir() {
            return Err(FileError::Folder);
        }
        // Checked before opening, because opening a pipe waits for its writer.
        if !metadata.is_file() {
            return Err(FileError::Special);
        }
        let length = metadata.len();
        if length > max_bytes {
            return Err(FileError::TooLong { length, max_bytes });
        }
        let mut bytes = Vec::with_capacity(length as usize);
        // Limited a second time, because the file may grow while it is read. One byte more than allowed shows this.
        let file = std::fs::File::open(path)?;
        file.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
        let length = bytes.len() as u64;
        if length > max_bytes {
            return Err(FileError::TooLong { length, max_bytes });
        }
        Ok(bytes)
    }

    fn exists(&self, path: &Path) -> bool {
        path.exists()
    }

    fn absolute(&self, path: &Path) -> io::Result<PathBuf> {
        std::path::absolute(path)
    }
}

/// Checks that `page`, a path from the repository's root, holds `table` between the lines `<!-- NAME -->` and
/// `<!-- /NAME -->`.
///
/// # Panics
/// If it does not; the table is then written there.
#[cfg(test)]
pub(crate) fn assert_table(page: &str, name: &str, table: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(page);
    let [start_mark, end_mark] = [format!("<!-- {name} -->\n"), format!("<!-- /{name} -->")];
    let text = std::fs::read_to_string(&path).expect("the page");
    let (text_before, text_from_table) = text.split_once(&start_mark).expect("the mark above the table");
    let (current_table, text_after) = text_from_table.split_once(&end_mark).expect("the mark below the table");
    if current_table != table {
        let text = [text_before, &start_mark, table, &end_mark, text_after].concat();
        std::fs::write(&path, text).expect("writable");
        panic!("{page} was out of date and has been rewritten; commit it");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_grows_beyond_the_limit_is_refused() {
        // Files in /proc (Linux) state a length of 0, as a file does that grows after its length was read.
        let growing = Path::new("/proc/self/status");
        assert_eq!(std::fs::metadata(growing).expect("a file").len(), 0);
        for max_bytes in [0, 10] {
            let refused = Disk.read(growing, max_bytes).expect_err("longer");
            assert!(
                matches!(refused, FileError::TooLong { length, .. } if length == max_bytes + 1),
                "{refused}"
            );
        }
        let whole = Disk.read(growing, u64::MAX).expect("short enough");
        assert!(whole.starts_with(b"Name:"), "{whole:?}");
    }

    #[test]
    fn folders_and_special_files_are_refused_with_different_reasons() {
        let refused = |path: &str| {
            Disk.read(Path::new(path), 100)
                .expect_err("no regular file")
                .to_string()
        };
        assert_eq!(refused("/"), "is a folder; name a file");
        assert_eq!(refused("/dev/null"), "is a pipe or a device; name a regular file");
    }
}
