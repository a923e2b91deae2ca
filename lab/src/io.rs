//! Where files are read and written. What is written is whole or not there.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Puts `bytes` in the file at `path`: under another name first, synced to the disk, then renamed.
///
/// # Errors
/// If it cannot be written; then whatever was at `path` is still there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = part(path);
    let written = write(&part, bytes).and_then(|()| fs::rename(&part, path));
    if written.is_err() {
        // The first error is the one that matters.
        let _ = fs::remove_file(&part);
    }
    written?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    // A folder that cannot be opened for a sync still holds the file.
    if let Ok(folder) = File::open(folder.unwrap_or(Path::new("."))) {
        let _ = folder.sync_all();
    }
    Ok(())
}

/// Puts `bytes` where a user wants them: a file is replaced as by [`replace`]; into a link, a device or a pipe, such as
/// `/dev/stdout`, they are written, since a rename would put a file in its place.
///
/// # Errors
/// If they cannot be written.
pub fn put(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => fs::write(path, bytes),
        Ok(_) | Err(_) => replace(path, bytes),
    }
}

/// The bytes of the file at `path`.
///
/// # Errors
/// If it cannot be read.
pub(crate) fn read(path: &Path) -> io::Result<Vec<u8>> {
    fs::read(path)
}

/// The text of the file at `path`.
///
/// # Errors
/// If it cannot be read or is not UTF-8.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    fs::read_to_string(path)
}

/// The text of the regular file at `path`, of at most `longest` bytes.
///
/// # Errors
/// If it is longer or no regular file, cannot be read, or is not UTF-8.
pub(crate) fn read_short(path: &Path, longest: u64) -> io::Result<String> {
    let found = fs::metadata(path)?;
    if !found.is_file() || found.len() > longest {
        return Err(io::Error::other("it is no file, or too long for an experiment"));
    }
    read_text(path)
}

/// The regular file at `path`, to read from.
///
/// # Errors
/// If it cannot be opened or is no regular file.
pub(crate) fn open(path: &Path) -> io::Result<File> {
    let file = File::open(path)?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(io::Error::other("it is no regular file"))
    }
}

/// The names of what is in `folder`, which is made if it is not there.
///
/// # Errors
/// If it cannot be made or read.
pub(crate) fn with_names(folder: &Path) -> io::Result<Vec<OsString>> {
    fs::create_dir_all(folder)?;
    let names = fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name()));
    names.collect()
}

/// Removes the file at `path`, if there is one.
///
/// # Errors
/// It is there and cannot be removed.
pub(crate) fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}

fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

fn part(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".part");
    PathBuf::from(name)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_file_is_replaced_and_a_link_is_followed() {
        let folder = std::env::temp_dir().join(format!("reveille-put-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("writable");
        let [file, before, link] = ["file", "before", "link"].map(|name| folder.join(name));
        put(&file, b"first").expect("written");
        fs::hard_link(&file, &before).expect("possible");
        put(&file, b"second").expect("replaced");
        symlink(&file, &link).expect("possible");
        let read = |path: &Path| fs::read_to_string(path).expect("there");
        assert_eq!((read(&before).as_str(), read(&file).as_str()), ("first", "second"));
        put(&link, b"third").expect("written");
        assert!(link.is_symlink());
        assert_eq!(read(&file), "third");
        assert_eq!(fs::read_dir(&folder).expect("there").count(), 3, "nothing is left over");
        fs::remove_dir_all(&folder).expect("ours");
    }
}
