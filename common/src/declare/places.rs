//! Where values were set.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// Where a value of a scenario was set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// In a preset.
    Preset(&'static str),
    /// In a scenario file.
    File {
        /// The file's name as the user gave it.
        name: Arc<str>,
        /// The line, from 1.
        line: usize,
    },
    /// On the command line.
    Flag(Arc<str>),
    /// Neither in a preset, nor in the file, nor on the command line.
    Nowhere,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Preset(name) => write!(f, "set by the preset `{name}`"),
            Self::File { name, line } => write!(f, "set in {name}, line {line}"),
            Self::Flag(flag) => write!(f, "set by {flag}"),
            Self::Nowhere => write!(f, "not set anywhere"),
        }
    }
}

/// Where values were set, by path; items of the list are numbered there (`class.0.energy.e_max`).
pub type Places = BTreeMap<String, Place>;

/// Where the values of a layer come from.
#[derive(Clone, Debug)]
pub enum Origin {
    /// A preset.
    Preset(&'static str),
    /// A file.
    File {
        /// Its name as the user gave it.
        name: Arc<str>,
        /// The offsets at which its lines begin, but for the first.
        line_starts: Vec<usize>,
    },
    /// An option of the command line.
    Flag(Arc<str>),
}

impl Origin {
    /// A file whose text is `text`.
    pub fn file(name: &str, text: &str) -> Self {
        let breaks = text.bytes().enumerate().filter(|&(_, byte)| byte == b'\n');
        Self::File {
            name: Arc::from(name),
            line_starts: breaks.map(|(at, _)| at + 1).collect(),
        }
    }

    /// The place of the byte at `offset` of the layer's text.
    pub fn place(&self, offset: usize) -> Place {
        match self {
            Self::Preset(name) => Place::Preset(name),
            Self::File { name, line_starts } => Place::File {
                name: Arc::clone(name),
                line: line_starts.partition_point(|&start| start <= offset) + 1,
            },
            Self::Flag(flag) => Place::Flag(Arc::clone(flag)),
        }
    }
}
