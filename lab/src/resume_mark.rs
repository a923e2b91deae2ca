//! The resume mark of a run (`resume.json`): a TTI, and a fingerprint of everything before it.
//!
//! A resumed run is replayed in memory up to that TTI and must reach the same fingerprint. The fingerprint covers the
//! frames of [`DigestFrameEncoder`] in their order, as wire messages; a change of it or of the fields needs a new
//! `VERSION`. `deploy/src/resume_mark.rs` reads and writes the file and feeds the tracker.

use std::fmt::Write as _;

use reveille_bs::observer::Notification;
use reveille_bs::scenario::Scenario;
use reveille_common::codec;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::score::DIGEST_VERSION;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::replay::DigestFrameEncoder;

const VERSION: u32 = 1;

/// The progress of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResumeMark {
    version: u32,
    digest_version: u32,
    scenario_hash: String,
    /// The number of TTIs in a row of windows.csv. A resumed run must keep it.
    pub window: u64,
    /// The TTI before which everything is complete.
    pub tti: u64,
    /// The hash of the frames before `tti`, hexadecimal.
    fingerprint: String,
}

/// A reason why a mark cannot be used for a run.
#[derive(Debug, thiserror::Error)]
pub enum ResumeMarkError {
    /// The mark is truncated or damaged: the run may have been killed while writing it.
    #[error("is truncated or damaged")]
    Torn(#[from] serde_json::Error),
    /// The mark has another format version or another digest version.
    #[error("was written by another version of reveille; use that version")]
    Version,
    /// The mark belongs to another run.
    #[error("belongs to another scenario than the one in this folder")]
    Scenario,
    /// The mark names a TTI after the end of the run.
    #[error("names TTI {0}, after the end of the run")]
    Tti(u64),
    /// The mark has windows without TTIs.
    #[error("has windows without TTIs")]
    Window,
}

impl ResumeMark {
    /// Parses the mark in `text`, of a run of `scenario`.
    ///
    /// # Errors
    /// If the text is not a mark of such a run.
    pub fn parse(text: &str, scenario: &Scenario) -> Result<Self, ResumeMarkError> {
        let mark: Self = serde_json::from_str(text)?;
        // The versions first: in another version the other fields may have another meaning.
        if (mark.version, mark.digest_version) != (VERSION, DIGEST_VERSION) {
            Err(ResumeMarkError::Version)
        } else if mark.scenario_hash != scenario.hash_hex() {
            Err(ResumeMarkError::Scenario)
        } else if mark.window == 0 {
            Err(ResumeMarkError::Window)
        } else if mark.tti > scenario.run.ttis {
            Err(ResumeMarkError::Tti(mark.tti))
        } else {
            Ok(mark)
        }
    }

    /// The mark as text.
    pub fn text(&self) -> String {
        serde_json::to_string(self).expect("a mark is JSON")
    }
}

/// Follows a run from TTI 0 and computes its current mark.
#[derive(Clone)]
pub struct ResumeTracker {
    encoder: DigestFrameEncoder,
    /// The hash of all frames so far, also of an open TTI.
    frame_hash: Sha256,
    /// The hash of the frames before `next_tti`; a run may end in the middle of a TTI.
    hash_before_next_tti: Sha256,
    scenario_hash: String,
    window: u64,
    /// The TTI after the last closed one.
    next_tti: Tti,
    /// The mark that the run has to reach; `None` once it has.
    expected: Option<ResumeMark>,
    has_diverged: bool,
}

impl ResumeTracker {
    /// Creates the tracker of a run of `scenario`, with `window` TTIs in a row of windows.csv. The run has to reach
    /// `expected`. It must receive every notification from TTI 0 on.
    pub fn new(scenario: &Scenario, window: u64, expected: Option<ResumeMark>) -> Self {
        Self {
            encoder: DigestFrameEncoder::default(),
            frame_hash: Sha256::new(),
            hash_before_next_tti: Sha256::new(),
            scenario_hash: scenario.hash_hex(),
            window,
            next_tti: Tti::ZERO,
            expected,
            has_diverged: false,
        }
    }

    /// Processes a notification and returns whether it closes a TTI.
    pub fn notify(&mut self, notification: &Notification<'_>) -> bool {
        // The closure borrows all of `self`, so `encoder` is copied and put back.
        let mut encoder = self.encoder;
        encoder.encode(notification, |frame| self.hash_frame(&frame));
        self.encoder = encoder;
        let Notification::TtiClosed(last) = notification else {
            return false;
        };
        self.next_tti = *last + 1;
        self.hash_before_next_tti.clone_from(&self.frame_hash);
        true
    }

    /// The mark of the current TTI.
    pub fn mark(&self) -> ResumeMark {
        ResumeMark {
            version: VERSION,
            digest_version: DIGEST_VERSION,
            scenario_hash: self.scenario_hash.clone(),
            window: self.window,
            tti: self.next_tti.0,
            fingerprint: fingerprint(&self.hash_before_next_tti),
        }
    }

    /// Whether the expected mark is still ahead.
    pub const fn is_mark_ahead(&self) -> bool {
        self.expected.is_some()
    }

    /// Whether the run has reached the expected TTI with another fingerprint.
    pub const fn has_diverged(&self) -> bool {
        self.has_diverged
    }

    /// Checks the expected mark once every further frame belongs to TTI `k` or later.
    fn check_mark(&mut self, k: Tti) {
        if let Some(mark) = self.expected.take_if(|mark| Tti(mark.tti) <= k) {
            self.has_diverged = mark.fingerprint != fingerprint(&self.frame_hash);
        }
    }

    /// Finishes the replay at the TTI where the run resumes. Call it before the first new TTI: [`Self::is_mark_ahead`]
    /// and [`Self::has_diverged`] are final only then.
    pub fn finish_replay(&mut self) {
        // Quiet TTIs have no frames, so the mark can lie after the last frame.
        self.check_mark(self.next_tti);
    }

    fn hash_frame(&mut self, frame: &Frame) {
        // A mark covers the frames before its TTI, so it is compared before this frame is added.
        self.check_mark(frame.tti);
        self.frame_hash.update(codec::encode(frame));
    }
}

fn fingerprint(hash: &Sha256) -> String {
    hash.clone().finalize().iter().fold(String::new(), |mut text, byte| {
        let _written = write!(text, "{byte:02x}").is_ok();
        text
    })
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::Observer;
    use reveille_bs::scenario::{Override, load};
    use reveille_common::score::WindowRecord;

    use super::*;
    use crate::preparation::prepare;
    use crate::run::{Run, RunOptions};

    /// An observer that passes the notifications of a run to the tracker and asks for windows.
    struct TrackingObserver(ResumeTracker);

    impl Observer for TrackingObserver {
        fn notify(&mut self, notification: &Notification<'_>) {
            self.0.notify(notification);
        }

        fn window_closed(&mut self, _: &WindowRecord) -> bool {
            true
        }
    }

    fn scenario_with_seed(seed: &str) -> Scenario {
        let set = [seed, "ttis=400"].map(|field| Override::parse(field).expect("an override"));
        load("quick", &set).expect("a preset").scenario
    }

    /// Returns the tracker of a run that is advanced to TTI `end`.
    fn track_run(scenario: &Scenario, end: u64, expected: Option<ResumeMark>) -> ResumeTracker {
        let mut observer = TrackingObserver(ResumeTracker::new(scenario, 10, expected));
        Run::new(&prepare(scenario), RunOptions::default()).advance(Tti(end), &mut observer);
        observer.0.finish_replay();
        observer.0
    }

    #[test]
    fn a_repeated_run_passes_its_mark_and_another_fingerprint_diverges() {
        let scenario = scenario_with_seed("seed=3");
        let mark = track_run(&scenario, 120, None).mark();
        assert_eq!((mark.tti, mark.window), (120, 10));
        let read = ResumeMark::parse(&mark.text(), &scenario).expect("a mark");
        let again = track_run(&scenario, 300, Some(read));
        assert!(!again.is_mark_ahead() && !again.has_diverged());
        let ahead = track_run(&scenario, 100, Some(mark.clone()));
        assert!(ahead.is_mark_ahead() && !ahead.has_diverged());
        let other_fingerprint = ResumeMark {
            fingerprint: track_run(&scenario, 200, None).mark().fingerprint,
            ..mark
        };
        assert!(track_run(&scenario, 300, Some(other_fingerprint)).has_diverged());
    }

    #[test]
    fn an_invalid_mark_is_refused_with_the_reason() {
        let scenario = scenario_with_seed("seed=3");
        let mark = track_run(&scenario, 50, None).mark();
        let error_of = |change: fn(&mut ResumeMark)| {
            let mut mark = mark.clone();
            change(&mut mark);
            ResumeMark::parse(&mark.text(), &scenario).expect_err("an invalid mark")
        };
        assert!(matches!(error_of(|mark| mark.version += 1), ResumeMarkError::Version));
        assert!(matches!(
            error_of(|mark| mark.digest_version += 1),
            ResumeMarkError::Version
        ));
        assert!(matches!(error_of(|mark| mark.tti = 401), ResumeMarkError::Tti(401)));
        assert!(matches!(error_of(|mark| mark.window = 0), ResumeMarkError::Window));
        assert!(matches!(
            ResumeMark::parse(&mark.text(), &scenario_with_seed("seed=4")),
            Err(ResumeMarkError::Scenario)
        ));
        let text = mark.text();
        for end in 0..text.len() {
            assert!(
                matches!(
                    ResumeMark::parse(&text[..end], &scenario),
                    Err(ResumeMarkError::Torn(_))
                ),
                "{end} bytes"
            );
        }
    }
}
