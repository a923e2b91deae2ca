//! The scenario of a run with the files that it names.

use std::io;
use std::path::{Path, PathBuf};

use reveille_bs::policy::outside;
use reveille_common::declare::{FileError, Files};
use reveille_common::message::Description;
use reveille_common::scenario::{self, Scenario, ScenarioError};

/// The name of the scenario file.
pub const SCENARIO: &str = "scenario.toml";
/// The name of the summary.
pub const SUMMARY: &str = "summary.json";

/// A scenario file, and the files that it names by paths relative to its own.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bundle {
    /// The text of the scenario file.
    pub scenario: String,
    /// The other files: path, with `/` between its parts, and bytes.
    pub files: Vec<(String, Vec<u8>)>,
}

impl From<Description> for Bundle {
    fn from(Description { scenario, files }: Description) -> Self {
        Self { scenario, files }
    }
}

impl From<Bundle> for Description {
    fn from(Bundle { scenario, files }: Bundle) -> Self {
        Self { scenario, files }
    }
}

impl Bundle {
    /// The scenario.
    ///
    /// # Errors
    /// If it cannot be used, or a file is missing.
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        scenario::parse(&self.scenario, SCENARIO, Path::new(""), &[], &outside::kinds(), self)
    }

    fn find(&self, path: &Path) -> Option<&[u8]> {
        let is_it = |(name, _): &&(String, Vec<u8>)| Path::new(name) == path;
        self.files.iter().find(is_it).map(|(_, bytes)| &bytes[..])
    }
}

impl Files for Bundle {
    fn read(&self, path: &Path, most: u64) -> Result<Vec<u8>, FileError> {
        let bytes = self.find(path).ok_or(io::Error::from(io::ErrorKind::NotFound))?;
        let length = bytes.len() as u64;
        if length > most {
            return Err(FileError::TooLong { length, most });
        }
        Ok(bytes.to_vec())
    }

    fn exists(&self, path: &Path) -> bool {
        self.find(path).is_some()
    }

    fn absolute(&self, path: &Path) -> io::Result<PathBuf> {
        Ok(path.to_owned())
    }
}
