//! The time for which learned tables count a place as covered: [`Lookback`], a window in TTIs or ages. Its text and its
//! order are part of the file of learned tables.

use std::fmt;
use std::fmt::Display;
use std::str::FromStr;

use reveille_common::digits::count_noun;
use serde::{Deserialize, Serialize};

use super::tables::{AREA_BUCKETS, area_end, worth_end};
use crate::beliefs::ages;

/// Longest window for covering the area once, TTIs.
pub const MAX_WINDOW: u32 = 1000;

/// Duration for which a covered place counts as covered. Entries of a file are sorted by it: the variants stay in this
/// order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "LookbackRepr", into = "LookbackRepr")]
pub enum Lookback {
    /// The place counts as covered for this many TTIs, `1 ..= `[`MAX_WINDOW`], the TTI of the sensing included.
    Window(u32),
    /// The place returns to age 1 and grows older.
    Ages,
}

/// Representation of a [`Lookback`] in files: a window as a number, ages as the word `ages`.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum LookbackRepr {
    /// A window, TTIs.
    Window(u32),
    /// The word `ages`.
    Word(String),
}

impl TryFrom<LookbackRepr> for Lookback {
    type Error = String;

    fn try_from(written: LookbackRepr) -> Result<Self, String> {
        match written {
            LookbackRepr::Window(window) => Ok(Self::Window(window)),
            LookbackRepr::Word(word) => word.parse(),
        }
    }
}

impl From<Lookback> for LookbackRepr {
    fn from(lookback: Lookback) -> Self {
        match lookback {
            Lookback::Window(window) => Self::Window(window),
            Lookback::Ages => Self::Word(lookback.to_string()),
        }
    }
}

/// Parses `ages`, or a window as a number of TTIs, from a file or the option `--windows`. [`Display`] writes the same.
impl FromStr for Lookback {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word.trim() {
            "ages" => Ok(Self::Ages),
            number => match number.parse() {
                Ok(window @ 1..=MAX_WINDOW) => Ok(Self::Window(window)),
                _ => Err(format!(
                    "must be a number of TTIs from 1 to {MAX_WINDOW}, or ages, not {word:?}"
                )),
            },
        }
    }
}

impl Lookback {
    /// Returns a phrase for messages and descriptions of tables: "a window of 4 TTIs", or "ages".
    pub fn describe(self) -> String {
        match self {
            Self::Window(window) => format!("a window of {}", count_noun(window, "TTI")),
            Self::Ages => self.to_string(),
        }
    }

    /// Returns the bucket of the newly covered part, `0 .. AREA_BUCKETS`; 0 is negligible. `share` is an area, or with
    /// ages the sum of the worths of its places, as a share of a sensing disc of places of age 1.
    pub fn bucket(self, share: f64) -> usize {
        (0..AREA_BUCKETS - 1)
            .take_while(|&bucket| share >= self.bucket_end(bucket))
            .count()
    }

    /// Returns the end of the `bucket`-th bucket of [`Self::bucket`], in the same unit.
    pub fn bucket_end(self, bucket: usize) -> f64 {
        match self {
            Self::Window(_) => area_end(bucket),
            Self::Ages => worth_end(bucket),
        }
    }

    /// Returns the most that a device can cover, in the unit of [`Self::bucket`], if it detects every event within
    /// d_max.
    pub const fn max_gain(self) -> f64 {
        match self {
            Self::Window(_) => 1.0,
            Self::Ages => ages::MAX_WORTH,
        }
    }

    /// Returns the start of the first bucket with an advantage of sensing, in the unit of [`Self::bucket`], from the
    /// advantages of one battery bucket; `None` without an advantage.
    pub fn advantage_start(self, advantages: &[f64; AREA_BUCKETS]) -> Option<f64> {
        let first = advantages.iter().position(|&advantage| advantage > 0.0)?;
        Some(first.checked_sub(1).map_or(0.0, |previous| self.bucket_end(previous)))
    }

    /// Returns the label in a table or figure: "window 4", or "ages".
    pub fn label(self) -> String {
        match self {
            Self::Window(window) => format!("window {window}"),
            Self::Ages => self.to_string(),
        }
    }

    /// Returns the number of TTIs for which a covered place counts as covered; 1 with ages.
    pub const fn window(self) -> u32 {
        match self {
            Self::Window(window) => window,
            Self::Ages => 1,
        }
    }
}

impl Display for Lookback {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Window(window) => window.fmt(f),
            Self::Ages => f.pad("ages"),
        }
    }
}
