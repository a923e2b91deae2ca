//! Reading and writing of files, for this crate and the programs. A write replaces the file in one step or fails, so a
//! reader or a resumed process never finds half a file. Only one process may write a path at a time: part files have
//! fixed names. `sweep/folder.rs` and `deploy/src/run_folder.rs` know the suffix `.part`.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use tempfile::{NamedTempFile, TempPath};

/// Creates a temporary file next to `path`, `PATH.part`, opened by `open`, which must empty an existing one. Persisting
/// it replaces `path` in one step, so no reader sees a partial file; dropping it removes it. Unlike [`replace`], it
/// does not sync.
///
/// # Errors
/// If it cannot be opened.
pub fn open_part_file(path: &Path, open: impl FnOnce(&Path) -> io::Result<File>) -> io::Result<NamedTempFile> {
    // A fixed name: files with random names would accumulate in the folders of killed processes.
    let mut part_path = OsString::from(path);
    part_path.push(".part");
    Ok(NamedTempFile::from_parts(
        open(Path::new(&part_path))?,
        TempPath::try_from_path(part_path)?,
    ))
}

/// Writes `bytes` to the file at `path`: under another name first, synced to the disk, then renamed.
///
/// # Errors
/// If it cannot be written; an existing file at `path` is then unchanged.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = open_part_file(path, |part_path| File::create(part_path))?;
    file.as_file_mut().write_all(bytes)?;
    // A rename can reach the disk before the data: without the sync, a power cut could leave an empty file.
    file.as_file().sync_all()?;
    file.persist(path)?;
    // The parent of a bare file name is the empty path, which cannot be opened.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    // A folder that cannot be opened for a sync still holds the file.
    if let Ok(folder) = File::open(folder.unwrap_or(Path::new("."))) {
        let _ = folder.sync_all();
    }
    Ok(())
}

/// Writes `bytes` to a path given by the user. A file is replaced as by [`replace`]. A link, a device or a pipe, such
/// as `/dev/stdout`, is written to, because a rename would put a file in its place.
///
/// # Errors
/// If the bytes cannot be written.
pub fn write_output(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(metadata) if !metadata.is_file() => fs::write(path, bytes),
        Ok(_) | Err(_) => replace(path, bytes),
    }
}

/// Returns the bytes of the file at `path`.
///
/// # Errors
/// If it cannot be read.
pub(crate) fn read(path: &Path) -> io::Result<Vec<u8>> {
    fs::read(path)
}

/// Returns the text of the file at `path`.
///
/// # Errors
/// If it cannot be read or is not UTF-8.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    fs::read_to_string(path)
}

/// Returns the text of the regular file at `path`, of at most `max_bytes` bytes.
///
/// # Errors
/// If it is longer or not a regular file, cannot be read, or is not UTF-8.
pub(crate) fn read_short(path: &Path, max_bytes: u64) -> io::Result<String> {
    // Checked before the file is opened: opening a pipe would block until another process writes to it.
    let metadata = fs::metadata(path)?;
    if !metadata.is_file() {
        return Err(io::Error::other("it is not a file"));
    }
    if metadata.len() > max_bytes {
        return Err(io::Error::other(format!("it has more than {max_bytes} bytes")));
    }
    read_text(path)
}

/// Opens the regular file at `path` for reading.
///
/// # Errors
/// If it cannot be opened or is not a regular file.
pub(crate) fn open_regular(path: &Path) -> io::Result<File> {
    // Checked before the file is opened: opening a pipe would block until another process writes to it.
    if fs::metadata(path)?.is_file() {
        File::open(path)
    } else {
        Err(io::Error::other("it is not a regular file"))
    }
}

/// Returns the names of the entries of `folder`, which is created if missing.
///
/// # Errors
/// If it cannot be created or read.
pub(crate) fn create_and_list(folder: &Path) -> io::Result<Vec<OsString>> {
    fs::create_dir_all(folder)?;
    let names = fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name()));
    names.collect()
}

/// Removes the file at `path`, if it exists.
///
/// # Errors
/// If it exists and cannot be removed.
pub(crate) fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn write_output_replaces_a_file_and_follows_a_link() {
        let folder = std::env::temp_dir().join(format!("reveille-output-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("writable");
        // `old` is a second name for the first file: a replaced file does not change it.
        let [file, old, link] = ["file", "old", "link"].map(|name| folder.join(name));
        write_output(&file, b"first").expect("written");
        fs::hard_link(&file, &old).expect("possible");
        write_output(&file, b"second").expect("replaced");
        symlink(&file, &link).expect("possible");
        let read = |path: &Path| fs::read_to_string(path).expect("there");
        assert_eq!((read(&old).as_str(), read(&file).as_str()), ("first", "second"));
        write_output(&link, b"third").expect("written");
        assert!(link.is_symlink());
        assert_eq!(read(&file), "third");
        assert_eq!(
            fs::read_dir(&folder).expect("there").count(),
            3,
            "no temporary file is left"
        );
        fs::remove_dir_all(&folder).expect("ours");
    }

    #[test]
    fn a_part_file_is_overwritten_if_present_and_removed_if_unused() {
        let folder = std::env::temp_dir().join(format!("reveille-part-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("writable");
        let (path, part) = (folder.join("file"), folder.join("file.part"));
        fs::write(&part, "left over").expect("writable");
        replace(&path, b"new").expect("written");
        drop(open_part_file(&path, |part_path| File::create(part_path)).expect("opened"));
        assert_eq!(fs::read(&path).expect("there"), b"new");
        assert!(!part.exists());
        let mode = |path: &Path| fs::metadata(path).expect("there").permissions();
        let plain = folder.join("plain");
        fs::write(&plain, "").expect("writable");
        assert_eq!(mode(&path), mode(&plain), "the permissions of other new files");
        fs::remove_dir_all(&folder).expect("ours");
    }
}
