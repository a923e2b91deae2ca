//! Files that are whole or not there.

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
