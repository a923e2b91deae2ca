//! The resume mark of a run: `resume.json`, rewritten every second during the run, as `docs/running.md` and the help of
//! `--resume` state. [`ResumeMarkWriter`] writes it as an observer, and checks that the replay of a resumed run
//! reproduces it. `lab/src/resume_mark.rs` defines its content. `run` and `bs` observe with it.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::io::open_part_file;
use reveille_lab::resume_mark::{ResumeMark, ResumeMarkError, ResumeTracker};

use crate::runtime::now;

/// The file name of the mark in a run folder.
pub(crate) const RESUME_MARK_FILE: &str = "resume.json";
/// Time between two marks.
const MARK_INTERVAL: Duration = Duration::from_secs(1);

/// Reads the mark in a run folder; `None` if the file cannot be read, usually because the run was killed before its
/// first mark, or if the mark is torn. The run then resumes from TTI 0.
///
/// # Errors
/// If the mark belongs to another scenario or version, or is impossible in the run.
pub(crate) fn read(folder: &Path, scenario: &Scenario) -> anyhow::Result<Option<ResumeMark>> {
    let path = folder.join(RESUME_MARK_FILE);
    let Ok(text) = fs::read_to_string(&path) else {
        return Ok(None);
    };
    match ResumeMark::parse(&text, scenario) {
        Ok(mark) => Ok(Some(mark)),
        Err(torn_mark @ ResumeMarkError::Torn(_)) => {
            tracing::warn!("{}: {torn_mark}; resuming from TTI 0", path.display());
            Ok(None)
        }
        Err(error) => bail!("{}: {error}", path.display()),
    }
}

/// An observer that writes marks, and checks that a resumed run reproduces its old mark.
pub(crate) struct ResumeMarkWriter {
    path: PathBuf,
    tracker: ResumeTracker,
    /// Whether the last write of a mark has failed.
    has_failed: bool,
    next_write: Instant,
}

impl ResumeMarkWriter {
    /// Creates a writer of marks in `folder`. A resumed run must reproduce `expected`, with the `window` of that mark.
    /// The writer must observe the run from TTI 0, replay included.
    pub(crate) fn new(folder: &Path, scenario: &Scenario, window: u64, expected: Option<ResumeMark>) -> Self {
        Self {
            path: folder.join(RESUME_MARK_FILE),
            tracker: ResumeTracker::new(scenario, window, expected),
            has_failed: false,
            next_write: now() + MARK_INTERVAL,
        }
    }

    /// Checks that the run has reproduced the mark from which it resumes. Call it once the run is past the mark.
    ///
    /// # Errors
    /// If it has not.
    pub(crate) fn check(&mut self) -> anyhow::Result<()> {
        self.tracker.finish_replay();
        if self.tracker.has_diverged() {
            bail!(
                "{}: the replay diverged from the run before the resume mark; resume from an unchanged copy of the \
                 folder, or start the run again",
                self.path.display()
            );
        }
        Ok(())
    }

    /// Writes a last mark at the end of the run; removes the mark of a complete run.
    ///
    /// # Errors
    /// If the mark cannot be written or removed.
    pub(crate) fn finish(&self, is_complete: bool) -> anyhow::Result<()> {
        let result = if is_complete {
            match fs::remove_file(&self.path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
                Ok(()) | Err(_) => Ok(()),
            }
        } else {
            self.write()
        };
        result.with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Replaces the mark. Its part file is in `run_folder::PART_FILES`.
    fn write(&self) -> std::io::Result<()> {
        // Not synced, since it is written often: a torn mark only means that a resumed run starts at TTI 0.
        let mut file = open_part_file(&self.path, |part| File::create(part))?;
        file.as_file_mut().write_all(self.tracker.mark().text().as_bytes())?;
        file.persist(&self.path)?;
        Ok(())
    }
}

impl Observer for ResumeMarkWriter {
    fn notify(&mut self, notification: &Notification<'_>) {
        let is_tti_closed = self.tracker.notify(notification);
        // A mark names a closed TTI. During a replay the old mark stays until the run has passed it.
        if !is_tti_closed || self.tracker.is_mark_ahead() || self.tracker.has_diverged() || now() < self.next_write {
            return;
        }
        self.next_write = now() + MARK_INTERVAL;
        let write_error = self.write().err();
        // A first failure is not reported: on a full disk the tables have ended the run before the second.
        if let Some(error) = write_error.as_ref().filter(|_| self.has_failed) {
            tracing::warn!(%error, "cannot write the resume mark");
        }
        self.has_failed = write_error.is_some();
    }

    /// Ends a replay that diverges from its mark.
    fn window_closed(&mut self, _: &WindowRecord) -> bool {
        !self.tracker.has_diverged()
    }
}
