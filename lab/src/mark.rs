//! How far a run has come, for one that goes on after it was killed: a TTI, and a fingerprint of all before it.
//!
//! A run that is taken up is replayed to there in memory, and must come by the same fingerprint.

use std::fmt::Write as _;

use reveille_bs::observe::Happening;
use reveille_common::codec;
use reveille_common::ids::Tti;
use reveille_common::message::Frame;
use reveille_common::scenario::Scenario;
use reveille_common::score::DIGEST_VERSION;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::shadow::Noting;

/// The form of a mark.
const VERSION: u32 = 1;

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

/// Why a mark is of no use for a run.
#[derive(Debug, thiserror::Error)]
pub enum MarkError {
    /// It is no whole mark: the run may have been killed while it wrote one.
    #[error("is no whole mark")]
    Torn(#[from] serde_json::Error),
    /// It is of another version, or of one that means something else by a digest.
    #[error("another version of reveille made that run; run that one")]
    Version,
    /// It is of another run.
    #[error("is the mark of another scenario than the one beside it")]
    Scenario,
    /// It names a TTI that the run does not come to.
    #[error("names TTI {0}, after the end of the run")]
    Tti(u64),
    /// It has windows without TTIs.
    #[error("has rows of no TTIs")]
    Window,
}

impl Mark {
    /// The mark in `text`, of a run of `scenario`.
    ///
    /// # Errors
    /// There is none.
    pub fn parse(text: &str, scenario: &Scenario) -> Result<Self, MarkError> {
        let mark: Self = serde_json::from_str(text)?;
        if (mark.version, mark.digest_version) != (VERSION, DIGEST_VERSION) {
            Err(MarkError::Version)
        } else if mark.scenario_hash != scenario.hash_hex() {
            Err(MarkError::Scenario)
        } else if mark.window == 0 {
            Err(MarkError::Window)
        } else if mark.tti > scenario.ttis {
            Err(MarkError::Tti(mark.tti))
        } else {
            Ok(mark)
        }
    }

    /// Its text.
    pub fn text(&self) -> String {
        serde_json::to_string(self).expect("a mark is JSON")
    }
}

/// Follows a run from its beginning, and knows the mark of where it is.
#[derive(Clone)]
pub struct Way {
    noting: Noting,
    so_far: Sha256,
    /// The same of all before `next`: a run may end in the middle of a TTI.
    whole: Sha256,
    scenario_hash: String,
    window: u64,
    next: Tti,
    /// The mark that it has to come by, until it has.
    expected: Option<Mark>,
    is_lost: bool,
}

impl Way {
    /// The way of a run of `scenario`, with `window` TTIs in a row of windows.csv, that has to come by `expected`.
    pub fn new(scenario: &Scenario, window: u64, expected: Option<Mark>) -> Self {
        Self {
            noting: Noting::default(),
            so_far: Sha256::new(),
            whole: Sha256::new(),
            scenario_hash: scenario.hash_hex(),
            window,
            next: Tti::ZERO,
            expected,
            is_lost: false,
        }
    }

    /// Something has happened. Whether a TTI is closed by it.
    pub fn see(&mut self, happening: &Happening<'_>) -> bool {
        let mut noting = self.noting;
        noting.of(happening, |frame| self.take(&frame));
        self.noting = noting;
        let Happening::Closed(last) = happening else {
            return false;
        };
        self.next = *last + 1;
        self.whole.clone_from(&self.so_far);
        true
    }

    /// The mark of where it is.
    pub fn mark(&self) -> Mark {
        Mark {
            version: VERSION,
            digest_version: DIGEST_VERSION,
            scenario_hash: self.scenario_hash.clone(),
            window: self.window,
            tti: self.next.0,
            fingerprint: fingerprint(&self.whole),
        }
    }

    /// Whether the mark that it has to come by is still ahead.
    pub const fn is_underway(&self) -> bool {
        self.expected.is_some()
    }

    /// Whether it has come to the TTI of that mark with another fingerprint.
    pub const fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// All that comes is of TTI `k` or later.
    fn pass(&mut self, k: Tti) {
        if let Some(mark) = self.expected.take_if(|mark| Tti(mark.tti) <= k) {
            self.is_lost = mark.fingerprint != fingerprint(&self.so_far);
        }
    }

    /// The run has come to where it is to go on.
    pub fn arrive(&mut self) {
        self.pass(self.next);
    }

    fn take(&mut self, frame: &Frame) {
        self.pass(frame.tti);
        self.so_far.update(codec::encode(frame));
    }
}

fn fingerprint(of: &Sha256) -> String {
    of.clone().finalize().iter().fold(String::new(), |mut text, byte| {
        let _written = write!(text, "{byte:02x}").is_ok();
        text
    })
}

#[cfg(test)]
mod tests {
    use reveille_bs::observe::Observer;
    use reveille_bs::scenario::{Override, load};
    use reveille_common::score::WindowRecord;

    use super::*;
    use crate::preparation::prepare;
    use crate::run::{Options, Run};

    struct Following(Way);

    impl Observer for Following {
        fn see(&mut self, happening: &Happening<'_>) {
            self.0.see(happening);
        }

        fn window(&mut self, _: &WindowRecord) -> bool {
            true
        }
    }

    fn scenario(seed: &str) -> Scenario {
        let set = [seed, "ttis=400"].map(|field| Override::parse(field).expect("an override"));
        load("quick", &set).expect("a preset")
    }

    /// The way of a run up to TTI `to`.
    fn followed(scenario: &Scenario, to: u64, expected: Option<Mark>) -> Way {
        let mut way = Following(Way::new(scenario, 10, expected));
        Run::new(&prepare(scenario), Options::default()).advance(Tti(to), &mut way);
        way.0.arrive();
        way.0
    }

    #[test]
    fn a_run_that_is_done_again_comes_by_its_mark_and_no_other_does() {
        let scenario = scenario("seed=3");
        let mark = followed(&scenario, 120, None).mark();
        assert_eq!((mark.tti, mark.window), (120, 10));
        let read = Mark::parse(&mark.text(), &scenario).expect("a mark");
        let again = followed(&scenario, 300, Some(read));
        assert!(!again.is_underway() && !again.is_lost());
        let ahead = followed(&scenario, 100, Some(mark.clone()));
        assert!(ahead.is_underway() && !ahead.is_lost());
        let other = Mark {
            fingerprint: followed(&scenario, 200, None).mark().fingerprint,
            ..mark
        };
        assert!(followed(&scenario, 300, Some(other)).is_lost());
    }

    #[test]
    fn marks_of_other_runs_and_torn_ones_are_refused() {
        let own = scenario("seed=3");
        let mark = followed(&own, 50, None).mark();
        let of = |mark: &Mark| Mark::parse(&mark.text(), &own).expect_err("of no use");
        let changed = |change: fn(&mut Mark)| {
            let mut mark = mark.clone();
            change(&mut mark);
            of(&mark)
        };
        assert!(matches!(changed(|mark| mark.version += 1), MarkError::Version));
        assert!(matches!(changed(|mark| mark.digest_version += 1), MarkError::Version));
        assert!(matches!(changed(|mark| mark.tti = 401), MarkError::Tti(401)));
        assert!(matches!(changed(|mark| mark.window = 0), MarkError::Window));
        assert!(matches!(
            Mark::parse(&mark.text(), &scenario("seed=4")),
            Err(MarkError::Scenario)
        ));
        let text = mark.text();
        for end in 0..text.len() {
            assert!(
                matches!(Mark::parse(&text[..end], &own), Err(MarkError::Torn(_))),
                "{end}"
            );
        }
    }
}
