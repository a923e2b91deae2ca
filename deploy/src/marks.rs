//! How far a run has come, for one that goes on after it was killed.
//!
//! A mark names a TTI and a fingerprint of all that had happened before it. A run that is taken up is replayed to there
//! in memory, and must come by the same fingerprint.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use reveille_bs::observe::{Happening, Observer};
use reveille_common::codec;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::scenario::Scenario;
use reveille_common::score::{DIGEST_VERSION, WindowRecord};
use reveille_lab::shadow::Noting;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::wall::now;

/// The file in a run folder.
pub const MARK: &str = "mark.json";
/// The form of that file.
const VERSION: u32 = 1;
/// Time between two marks.
const EVERY: Duration = Duration::from_secs(1);

/// How far a run has come.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mark {
    version: u32,
    digest_version: u32,
    scenario_hash: String,
    /// TTIs in a row of windows.csv.
    pub window: u64,
    /// The TTI before which all is done.
    pub tti: u64,
    fingerprint: String,
}

impl Mark {
    /// The mark in a run folder; none if the run was killed before its first one, or while it wrote one.
    ///
    /// # Errors
    /// It is that of another scenario, or of a program that means something else by a digest.
    pub fn read(folder: &Path, scenario: &Scenario) -> anyhow::Result<Option<Self>> {
        let path = folder.join(MARK);
        let Ok(text) = fs::read_to_string(&path) else {
            return Ok(None);
        };
        let Ok(mark) = serde_json::from_str::<Self>(&text) else {
            tracing::warn!(
                "{}: is no whole mark, so the run is taken up at its beginning",
                path.display()
            );
            return Ok(None);
        };
        if (mark.version, mark.digest_version) != (VERSION, DIGEST_VERSION) {
            bail!(
                "{}: another version of reveille made that run; run that one",
                path.display()
            );
        }
        if mark.scenario_hash != scenario.hash_hex() {
            bail!(
                "{}: is the mark of another scenario than the one beside it",
                path.display()
            );
        }
        if mark.tti > scenario.ttis {
            bail!("{}: names TTI {}, after the end of the run", path.display(), mark.tti);
        }
        Ok(Some(mark))
    }
}

/// An observer that leaves marks, and looks at the one that a run is taken up from.
pub struct Marker {
    path: PathBuf,
    noting: Noting,
    so_far: Sha256,
    /// The same of all before `next`: a run may end in the middle of a TTI.
    whole: Sha256,
    expected: Option<Mark>,
    is_wrong: bool,
    /// Whether the last mark could not be written.
    has_failed: bool,
    scenario_hash: String,
    window: u64,
    due: Instant,
    next: Tti,
}

impl Marker {
    /// Leaves marks in `folder`; the run must come by `expected`.
    pub fn new(folder: &Path, scenario: &Scenario, window: u64, expected: Option<Mark>) -> Self {
        Self {
            path: folder.join(MARK),
            noting: Noting::default(),
            so_far: Sha256::new(),
            whole: Sha256::new(),
            expected,
            is_wrong: false,
            has_failed: false,
            scenario_hash: scenario.hash_hex(),
            window,
            due: now() + EVERY,
            next: Tti::ZERO,
        }
    }

    /// Whether the run has come by the mark that it is taken up from.
    ///
    /// # Errors
    /// It has not.
    pub fn check(&mut self) -> anyhow::Result<()> {
        self.pass(self.next);
        if self.is_wrong {
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

    /// All that comes is of TTI `k` or later.
    fn pass(&mut self, k: Tti) {
        if let Some(mark) = self.expected.take_if(|mark| Tti(mark.tti) <= k) {
            self.is_wrong = mark.fingerprint != fingerprint(&self.so_far);
        }
    }

    fn take(&mut self, frame: &Frame) {
        self.pass(frame.tti);
        self.so_far.update(codec::encode(frame));
    }

    fn write(&self) -> std::io::Result<()> {
        let mark = Mark {
            version: VERSION,
            digest_version: DIGEST_VERSION,
            scenario_hash: self.scenario_hash.clone(),
            window: self.window,
            tti: self.next.0,
            fingerprint: fingerprint(&self.whole),
        };
        let part = self.path.with_extension("json.part");
        fs::write(&part, serde_json::to_vec(&mark)?)?;
        fs::rename(&part, &self.path)
    }
}

fn fingerprint(of: &Sha256) -> String {
    let mut text = String::new();
    for byte in of.clone().finalize() {
        let _written = write!(text, "{byte:02x}").is_ok();
    }
    text
}

impl Observer for Marker {
    fn see(&mut self, happening: &Happening<'_>) {
        let mut noting = self.noting;
        noting.of(happening, |frame| self.take(&frame));
        self.noting = noting;
        if let Happening::Closed(last) = happening {
            self.next = *last + 1;
            self.whole.clone_from(&self.so_far);
            let now = now();
            if now >= self.due && self.expected.is_none() && !self.is_wrong {
                self.due = now + EVERY;
                let failed = self.write().err();
                // On a disk that is full the tables end the run before the second time.
                if let Some(error) = failed.as_ref().filter(|_| self.has_failed) {
                    tracing::warn!(%error, "cannot mark how far the run has come");
                }
                self.has_failed = failed.is_some();
            }
        }
    }

    fn window(&mut self, _: &WindowRecord) -> bool {
        !self.is_wrong
    }
}
