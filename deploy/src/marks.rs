//! The mark of a run in its folder: `mark.json`, written again and again while it goes on.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use reveille_bs::observe::{Happening, Observer};
use reveille_common::scenario::Scenario;
use reveille_common::score::WindowRecord;
use reveille_lab::mark::{Mark, MarkError, Way};

use crate::wall::now;

/// The file in a run folder.
pub const MARK: &str = "mark.json";
/// Time between two marks.
const EVERY: Duration = Duration::from_secs(1);

/// The mark in a run folder; none if the run was killed before its first one, or while it wrote one.
///
/// # Errors
/// It is that of another scenario, or of a program that means something else by a digest.
pub fn read(folder: &Path, scenario: &Scenario) -> anyhow::Result<Option<Mark>> {
    let path = folder.join(MARK);
    let Ok(text) = fs::read_to_string(&path) else {
        return Ok(None);
    };
    match Mark::parse(&text, scenario) {
        Ok(mark) => Ok(Some(mark)),
        Err(torn @ MarkError::Torn(_)) => {
            tracing::warn!("{}: {torn}, so the run is taken up at its beginning", path.display());
            Ok(None)
        }
        Err(error) => bail!("{}: {error}", path.display()),
    }
}

/// An observer that leaves marks, and looks at the one that a run is taken up from.
pub struct Marker {
    path: PathBuf,
    way: Way,
    /// Whether the last mark could not be written.
    has_failed: bool,
    due: Instant,
}

impl Marker {
    /// Leaves marks in `folder`; the run must come by `expected`.
    pub fn new(folder: &Path, scenario: &Scenario, window: u64, expected: Option<Mark>) -> Self {
        Self {
            path: folder.join(MARK),
            way: Way::new(scenario, window, expected),
            has_failed: false,
            due: now() + EVERY,
        }
    }

    /// Whether the run has come by the mark that it is taken up from.
    ///
    /// # Errors
    /// It has not.
    pub fn check(&mut self) -> anyhow::Result<()> {
        self.way.arrive();
        if self.way.is_lost() {
            bail!(
                "{}: a replay does not come by what the run had come to there; was the folder changed, or the run \
                 meddled with?",
                self.path.display()
            );
        }
        Ok(())
    }

    /// Leaves a last mark, or none after a run that is `complete`.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(&self, complete: bool) -> anyhow::Result<()> {
        let done = if complete {
            match fs::remove_file(&self.path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
                Ok(()) | Err(_) => Ok(()),
            }
        } else {
            self.write()
        };
        done.with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn write(&self) -> std::io::Result<()> {
        let part = self.path.with_extension("json.part");
        fs::write(&part, self.way.mark().text())?;
        fs::rename(&part, &self.path)
    }
}

impl Observer for Marker {
    fn see(&mut self, happening: &Happening<'_>) {
        let is_closed = self.way.see(happening);
        if !is_closed || self.way.is_underway() || self.way.is_lost() || now() < self.due {
            return;
        }
        self.due = now() + EVERY;
        let failed = self.write().err();
        // On a disk that is full the tables end the run before the second time.
        if let Some(error) = failed.as_ref().filter(|_| self.has_failed) {
            tracing::warn!(%error, "cannot mark how far the run has come");
        }
        self.has_failed = failed.is_some();
    }

    fn window(&mut self, _: &WindowRecord) -> bool {
        !self.way.is_lost()
    }
}
