//! Who writes into a run folder: one run at a time.
//!
//! `RUNNING` lies in the folder while its run goes, and is locked for so long. The kernel gives the lock back however
//! the process ends, so a mark without a lock is that of a run that was killed.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// The mark of a run that goes on, or was killed.
pub const RUNNING: &str = "RUNNING";

/// The right to write into a folder; given back when dropped.
pub struct Claim {
    path: PathBuf,
    mark: File,
    /// What was in the mark that a killed run has left.
    left: Option<String>,
}

/// How the run in a folder stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// No run has marked it: it has ended, or there is none.
    Ended,
    /// A run is writing there, if it could be read in the process with this id.
    Alive(Option<u32>),
    /// The run was killed.
    Killed,
}

impl Claim {
    /// Claims `folder`, which is made if it is not there. What is in it stays as it is.
    ///
    /// # Errors
    /// A run is writing there, or the folder cannot be written to.
    pub fn take(folder: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write in the run folder {}", folder.display());
        fs::create_dir_all(folder).with_context(cannot)?;
        let path = folder.join(RUNNING);
        loop {
            let was_there = path.symlink_metadata().is_ok();
            // Opened for writing: network file systems lock no file that is not.
            let mark = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&path);
            let mark = mark.with_context(cannot)?;
            match mark.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => bail!("{}", refusal(folder, pid(&mark))),
                Err(TryLockError::Error(error)) => tracing::warn!(
                    "{}: {error}: this file system cannot lock files, so a second run in the folder is not kept out",
                    folder.display()
                ),
            }
            // A run that has ended meanwhile has taken away the file that was locked here.
            if is_at(&mark, &path) {
                let left = was_there.then(|| text(&mark));
                return Ok(Self { path, mark, left });
            }
        }
    }

    /// Whether the mark of a killed run was there.
    pub fn was_killed(&self) -> bool {
        self.left.as_ref().is_some_and(|text| text.starts_with(PID))
    }

    /// Marks the folder as that of a run of this process.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn mark(&mut self) -> io::Result<()> {
        self.mark.set_len(0)?;
        self.mark.write_all(format!("{PID}{}\n", std::process::id()).as_bytes())
    }

    /// Leaves the folder as it was found.
    pub fn withdraw(self) {
        if self.left.is_none() {
            // The refusal is what is told.
            let _stays = self.release().is_err();
        }
    }

    /// Takes the mark away, then the lock.
    ///
    /// # Errors
    /// It cannot be removed.
    pub fn release(self) -> io::Result<()> {
        fs::remove_file(&self.path)
    }
}

/// What the mark begins with.
const PID: &str = "pid ";

/// How the run in `folder` stands.
pub fn standing(folder: &Path) -> Standing {
    let Ok(mark) = File::open(folder.join(RUNNING)) else {
        return Standing::Ended;
    };
    match mark.try_lock_shared() {
        Err(TryLockError::WouldBlock) => Standing::Alive(pid(&mark)),
        Ok(()) | Err(TryLockError::Error(_)) => Standing::Killed,
    }
}

/// Says that a run is writing in `folder`.
fn refusal(folder: &Path, pid: Option<u32>) -> String {
    let by = pid.map_or_else(String::new, |pid| format!(" (pid {pid})"));
    format!(
        "--out {}: a run is going on in this folder{by}; choose another, or wait until it has ended: --force never \
         replaces a run that goes on",
        folder.display()
    )
}

fn text(mut mark: &File) -> String {
    let mut text = String::new();
    // Whatever else is in it, it is no mark of ours.
    let _unread = io::Read::read_to_string(&mut mark, &mut text).is_err();
    text
}

fn pid(mark: &File) -> Option<u32> {
    text(mark).strip_prefix(PID)?.trim().parse().ok()
}

/// Whether `path` leads to the file that was opened as `file`.
fn is_at(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        (Ok(own), Ok(found)) => (own.dev(), own.ino()) == (found.dev(), found.ino()),
        (Err(_), _) | (_, Err(_)) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Place(PathBuf);

    impl Place {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("reveille-claim-{name}-{}", std::process::id()));
            let _ = fs::remove_dir_all(&path);
            Self(path)
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn a_folder_is_claimed_once_at_a_time() {
        let place = Place::new("once");
        assert_eq!(standing(&place.0), Standing::Ended);
        let mut claim = Claim::take(&place.0).expect("free");
        assert!(!claim.was_killed());
        claim.mark().expect("writable");
        let own = std::process::id();
        assert_eq!(standing(&place.0), Standing::Alive(Some(own)));
        let why = Claim::take(&place.0).err().expect("claimed").to_string();
        assert!(
            why.contains(&format!("(pid {own})")) && why.contains("--force"),
            "{why}"
        );
        claim.release().expect("removable");
        assert_eq!(standing(&place.0), Standing::Ended);
        Claim::take(&place.0).expect("free again").withdraw();
        assert_eq!(fs::read_dir(&place.0).expect("there").count(), 0);
    }

    #[test]
    fn the_mark_of_a_killed_run_is_no_claim() {
        let place = Place::new("killed");
        let mut claim = Claim::take(&place.0).expect("free");
        claim.mark().expect("writable");
        drop(claim);
        assert_eq!(standing(&place.0), Standing::Killed);
        let next = Claim::take(&place.0).expect("nobody is alive");
        assert!(next.was_killed());
        next.withdraw();
        assert_eq!(standing(&place.0), Standing::Killed, "it is left as it was found");
    }

    #[test]
    fn a_claim_on_a_file_that_is_gone_is_none() {
        let place = Place::new("gone");
        let claim = Claim::take(&place.0).expect("free");
        let late = File::open(place.0.join(RUNNING)).expect("there");
        claim.release().expect("removable");
        late.try_lock().expect("its lock is free");
        assert!(!is_at(&late, &place.0.join(RUNNING)));
        Claim::take(&place.0).expect("free").release().expect("removable");
    }
}
