//! The lock of a run folder: one run at a time writes into it.
//!
//! The file `RUNNING`, the running mark, holds `pid N`. It exists and is locked while the run lasts. The kernel
//! releases the lock when the process ends for any reason, so a `RUNNING` file without a lock belongs to a killed run.
//! `run_folder` takes the lock, also for `--resume`; `run_reader`, `inspect` and `train record` read its status.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// The file that marks an active or killed run.
pub(crate) const RUNNING_FILE: &str = "RUNNING";

/// The right to write into a folder, until it is dropped.
pub(crate) struct FolderLock {
    /// The path of `RUNNING`.
    path: PathBuf,
    /// The open and locked file `RUNNING`.
    running_file: File,
    /// The content of a `RUNNING` file found in the folder, by a killed run or another program.
    found_text: Option<String>,
}

/// The status of the run in a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum FolderStatus {
    /// No running mark: the run has ended, or the folder holds no run.
    Finished,
    /// A run is writing there; its process id, if readable.
    Running(Option<u32>),
    /// The run was killed, or the file system cannot lock files.
    Killed,
}

impl FolderLock {
    /// Locks `folder`, which is created if missing. Its content stays unchanged, except for a new, empty `RUNNING`.
    /// Call [`Self::mark_running`] before the run: without it, [`Self::was_killed`] does not recognise the run after a
    /// kill. End with [`Self::release`] or [`Self::abandon`]: a drop leaves `RUNNING` behind, as a kill does.
    ///
    /// # Errors
    /// If a run is writing there, or the folder cannot be written to.
    pub(crate) fn acquire(folder: &Path) -> anyhow::Result<Self> {
        let write_error = || format!("cannot write in the run folder {}", folder.display());
        fs::create_dir_all(folder).with_context(write_error)?;
        let path = folder.join(RUNNING_FILE);
        loop {
            // Checked before the open, which creates the file.
            let existed = path.symlink_metadata().is_ok();
            // Opened for writing, since network file systems refuse to lock a file that is open for reading only. The
            // content stays: it names the process of a live run, or shows that a run was killed.
            let running_file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&path);
            let running_file = running_file.with_context(write_error)?;
            match running_file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => bail!("{}", in_use_error(folder, read_pid(&running_file))),
                Err(TryLockError::Error(error)) => tracing::warn!(
                    "{}: {error}: this file system cannot lock files, so a second run in the folder is not kept out",
                    folder.display()
                ),
            }
            // A run that ended meanwhile has removed this file: its lock protects nothing, and another try is needed.
            if is_file_at(&running_file, &path) {
                let found_text = existed.then(|| read_text(&running_file));
                return Ok(Self {
                    path,
                    running_file,
                    found_text,
                });
            }
        }
    }

    /// Whether [`Self::acquire`] has found the mark of a killed run.
    pub(crate) fn was_killed(&self) -> bool {
        self.found_text
            .as_ref()
            .is_some_and(|text| text.starts_with(PID_PREFIX))
    }

    /// Marks the folder as in use by this process. Call it once, after [`Self::acquire`].
    ///
    /// # Errors
    /// If the mark cannot be written.
    pub(crate) fn mark_running(&mut self) -> io::Result<()> {
        self.running_file.set_len(0)?;
        // The mark of a killed run has been read to its end, and a write there would leave a gap of zero bytes.
        self.running_file.rewind()?;
        self.running_file
            .write_all(format!("{PID_PREFIX}{}\n", std::process::id()).as_bytes())
    }

    /// Releases a folder that was not used, and leaves its content as it was found. Not after [`Self::mark_running`].
    pub(crate) fn abandon(self) {
        if self.found_text.is_none() {
            // The caller reports why it abandons the folder; an error from here would hide that.
            let _stays = self.release().is_err();
        }
    }

    /// Removes the mark and releases the lock.
    ///
    /// # Errors
    /// If the mark cannot be removed.
    pub(crate) fn release(self) -> io::Result<()> {
        // Removed while the lock is held: after an unlock the file could already be the mark of another run.
        fs::remove_file(&self.path)
    }
}

/// The start of the text in `RUNNING`.
const PID_PREFIX: &str = "pid ";

/// The status of the run in `folder`.
pub(crate) fn status(folder: &Path) -> FolderStatus {
    let Ok(running_file) = File::open(folder.join(RUNNING_FILE)) else {
        return FolderStatus::Finished;
    };
    // A shared lock, so that two readers do not take each other for a run.
    match running_file.try_lock_shared() {
        Err(TryLockError::WouldBlock) => FolderStatus::Running(read_pid(&running_file)),
        Ok(()) | Err(TryLockError::Error(_)) => FolderStatus::Killed,
    }
}

/// Returns the error message for a folder in use.
fn in_use_error(folder: &Path, pid: Option<u32>) -> String {
    let by = pid.map_or_else(String::new, |pid| format!(" (pid {pid})"));
    format!(
        "--out {}: a run is running in this folder{by}; choose another folder, or wait until the run has finished \
         (--force never replaces a running run)",
        folder.display()
    )
}

fn read_text(mut running_file: &File) -> String {
    let mut text = String::new();
    // Text that is not UTF-8 is not a mark of this program and counts as empty.
    let _unread = io::Read::read_to_string(&mut running_file, &mut text).is_err();
    text
}

/// The process id in `RUNNING`, read from the current position of the file.
fn read_pid(running_file: &File) -> Option<u32> {
    read_text(running_file).strip_prefix(PID_PREFIX)?.trim().parse().ok()
}

/// Whether `path` leads to the open file `file`.
fn is_file_at(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        // The same path can lead to a new file; device and inode tell the two apart.
        (Ok(open_file), Ok(at_path)) => (open_file.dev(), open_file.ino()) == (at_path.dev(), at_path.ino()),
        (Err(_), _) | (_, Err(_)) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A temporary folder that is removed on drop.
    struct LockTestFolder(PathBuf);

    impl LockTestFolder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("reveille-lock-{name}-{}", std::process::id()));
            let _ = fs::remove_dir_all(&path);
            Self(path)
        }
    }

    impl Drop for LockTestFolder {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn a_locked_folder_is_refused() {
        let folder = LockTestFolder::new("once");
        assert_eq!(status(&folder.0), FolderStatus::Finished);
        let mut lock = FolderLock::acquire(&folder.0).expect("free");
        assert!(!lock.was_killed());
        lock.mark_running().expect("writable");
        let pid = std::process::id();
        assert_eq!(status(&folder.0), FolderStatus::Running(Some(pid)));
        let message = FolderLock::acquire(&folder.0).err().expect("locked").to_string();
        assert!(
            message.contains(&format!("(pid {pid})")) && message.contains("--force"),
            "{message}"
        );
        lock.release().expect("removable");
        assert_eq!(status(&folder.0), FolderStatus::Finished);
        FolderLock::acquire(&folder.0).expect("free again").abandon();
        assert_eq!(fs::read_dir(&folder.0).expect("there").count(), 0);
    }

    #[test]
    fn a_folder_of_a_killed_run_can_be_locked() {
        let folder = LockTestFolder::new("killed");
        let mut lock = FolderLock::acquire(&folder.0).expect("free");
        lock.mark_running().expect("writable");
        drop(lock);
        assert_eq!(status(&folder.0), FolderStatus::Killed);
        let next_lock = FolderLock::acquire(&folder.0).expect("the run was killed");
        assert!(next_lock.was_killed());
        next_lock.abandon();
        assert_eq!(
            status(&folder.0),
            FolderStatus::Killed,
            "the mark of the killed run is kept"
        );
    }

    #[test]
    fn a_lock_on_a_removed_file_is_detected() {
        let folder = LockTestFolder::new("removed");
        let lock = FolderLock::acquire(&folder.0).expect("free");
        // Another process can open the file before it is removed, and lock it after.
        let late_file = File::open(folder.0.join(RUNNING_FILE)).expect("there");
        lock.release().expect("removable");
        late_file.try_lock().expect("its lock is free");
        assert!(!is_file_at(&late_file, &folder.0.join(RUNNING_FILE)));
        FolderLock::acquire(&folder.0)
            .expect("free")
            .release()
            .expect("removable");
    }

    #[test]
    fn each_kill_of_a_resumed_run_is_recognised() {
        let folder = LockTestFolder::new("twice");
        for kills in 0..3 {
            let mut lock = FolderLock::acquire(&folder.0).expect("free");
            assert_eq!(lock.was_killed(), kills > 0, "after {kills} kills");
            lock.mark_running().expect("writable");
            let mark = fs::read_to_string(folder.0.join(RUNNING_FILE)).expect("there");
            assert_eq!(mark, format!("pid {}\n", std::process::id()), "after {kills} kills");
            // A killed process leaves its mark, and the kernel drops the lock.
            drop(lock);
            assert_eq!(status(&folder.0), FolderStatus::Killed);
        }
    }
}
