//! What tables were learned for: how long a look at a place counts.

use std::fmt;
use std::fmt::Display;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::tables::{AREAS, area_edge, worth_edge};
use crate::beliefs::ages;

/// The longest time within which the area can be asked to be covered once, TTIs.
pub const LONGEST_WINDOW: u32 = 1000;

/// What a look at a place counts for later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub enum Lookback {
    /// The place counts as covered for so many TTIs, `1 ..= `[`LONGEST_WINDOW`], the look's own included.
    Window(u32),
    /// The place is of age 1 again, and gets older.
    Ages,
}

/// How files write what a look counts for later.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Written {
    Window(u32),
    Word(String),
}

impl TryFrom<Written> for Lookback {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        match written {
            Written::Window(window) => Ok(Self::Window(window)),
            Written::Word(word) => word.parse(),
        }
    }
}

impl From<Lookback> for Written {
    fn from(lookback: Lookback) -> Self {
        match lookback {
            Lookback::Window(window) => Self::Window(window),
            Lookback::Ages => Self::Word(lookback.to_string()),
        }
    }
}

/// `ages`, or a window by its TTIs.
impl FromStr for Lookback {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word.trim() {
            "ages" => Ok(Self::Ages),
            number => match number.parse() {
                Ok(window @ 1..=LONGEST_WINDOW) => Ok(Self::Window(window)),
                _ => Err(format!(
                    "must be a number of TTIs from 1 to {LONGEST_WINDOW}, or ages, not {word:?}"
                )),
            },
        }
    }
}

impl Lookback {
    /// As a phrase: "a window of 4 TTIs".
    pub fn in_words(self) -> String {
        match self {
            Self::Window(window) => format!("a window of {window} TTIs"),
            Self::Ages => self.to_string(),
        }
    }

    /// The bucket of what a device would newly look at: an area, or with ages the sum over its places of what their
    /// ages are worth; a share of its sensing disc with places of age 1. `0 .. AREAS`; 0 is as good as nothing.
    pub fn bucket(self, share: f64) -> usize {
        (0..AREAS - 1).take_while(|&bucket| share >= self.edge(bucket)).count()
    }

    /// The end of the `bucket`-th of these buckets.
    pub fn edge(self, bucket: usize) -> f64 {
        match self {
            Self::Window(_) => area_edge(bucket),
            Self::Ages => worth_edge(bucket),
        }
    }

    /// The most that a device can look at, in that unit, if it is sure to detect what is within d_max.
    pub const fn most(self) -> f64 {
        match self {
            Self::Window(_) => 1.0,
            Self::Ages => ages::MOST,
        }
    }

    /// Where the first bucket begins in which sensing has an advantage, by the advantages of one battery.
    pub fn begin(self, advantages: &[f64; AREAS]) -> Option<f64> {
        let first = advantages.iter().position(|&advantage| advantage > 0.0)?;
        Some(first.checked_sub(1).map_or(0.0, |before| self.edge(before)))
    }

    /// As a table of them names it: "window 4".
    pub fn label(self) -> String {
        match self {
            Self::Window(window) => format!("window {window}"),
            Self::Ages => self.to_string(),
        }
    }

    /// TTIs for which a place counts as covered altogether.
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
