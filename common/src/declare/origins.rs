//! The origins of values: preset, file or command line. They affect errors and warnings, and the folder to which a
//! relative path refers: the folder of the file, or the working directory for the command line. Tests expect the texts.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// The origin of a value of a scenario.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ValueOrigin {
    /// In a preset.
    Preset(&'static str),
    /// In a scenario file.
    File {
        /// The file's name as the user gave it.
        name: Arc<str>,
        /// The line, from 1.
        line: usize,
    },
    /// On the command line, by this option; `--set` includes its argument.
    Flag(Arc<str>),
    /// Not set by a preset, a file or the command line.
    Unset,
}

impl fmt::Display for ValueOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Preset(name) => write!(f, "set by the preset `{name}`"),
            Self::File { name, line } => write!(f, "set in {name}, line {line}"),
            Self::Flag(flag) => write!(f, "set by {flag}"),
            Self::Unset => write!(f, "not set anywhere"),
        }
    }
}

/// The origins of values by path; the path holds the index of a list item (`class.0.energy.e_max`).
pub type ValueOrigins = BTreeMap<String, ValueOrigin>;

/// The source of a layer.
#[derive(Clone, Debug)]
pub enum LayerOrigin {
    /// A preset.
    Preset(&'static str),
    /// A file.
    File {
        /// The name as the user gave it.
        name: Arc<str>,
        /// The offsets at which the lines begin, except the first.
        line_starts: Vec<usize>,
    },
    /// An option of the command line; `--set` includes its argument.
    Flag(Arc<str>),
}

impl LayerOrigin {
    /// Returns the origin for a file with the content `text`.
    pub fn file(name: &str, text: &str) -> Self {
        let breaks = text.bytes().enumerate().filter(|&(_, byte)| byte == b'\n');
        Self::File {
            name: Arc::from(name),
            line_starts: breaks.map(|(offset, _)| offset + 1).collect(),
        }
    }

    /// Returns the origin of the value at the byte `offset` of the layer's text. Only a file distinguishes offsets.
    pub fn origin_at(&self, offset: usize) -> ValueOrigin {
        match self {
            Self::Preset(name) => ValueOrigin::Preset(name),
            Self::File { name, line_starts } => ValueOrigin::File {
                name: Arc::clone(name),
                line: line_starts.partition_point(|&start| start <= offset) + 1,
            },
            Self::Flag(flag) => ValueOrigin::Flag(Arc::clone(flag)),
        }
    }
}
