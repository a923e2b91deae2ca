//! Bundle of a scenario and its scenario files.

use std::io;
use std::path::{Path, PathBuf};

use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_common::declare::{FileError, Files};
use reveille_common::message::Description;
use reveille_common::scenario::{self, ScenarioError};

/// Name of the scenario file.
pub const SCENARIO: &str = "scenario.toml";
/// Name of the summary.
pub const SUMMARY: &str = "summary.json";

/// A scenario, and its scenario files by paths relative to it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bundle {
    /// Text of the scenario.
    pub scenario: String,
    /// Scenario files: path, with `/` between its parts, and bytes.
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
    /// Loads the scenario.
    ///
    /// # Errors
    /// If the scenario is invalid or a file is missing.
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        let loaded = scenario::parse(
            &self.scenario,
            SCENARIO,
            Path::new(""),
            &[],
            &outside::kinds_with_external(),
            self,
        )?;
        Ok(loaded.scenario)
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
