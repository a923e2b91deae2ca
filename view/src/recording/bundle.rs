//! A scenario without a disk: its text and the files that it refers to. Recordings hold a bundle, and a base station
//! sends one to observers; observers and readers rebuild the scenario of the run from it. File names and paths are
//! part of recordings and of the bus message. No referenced file may be called [`SCENARIO_FILE`] or `summary.json`,
//! which nothing checks. `deploy/src/run_folder.rs` has the same two names for files of a run folder.

use std::io;
use std::path::{Path, PathBuf};

use reveille_bs::policy::outside;
use reveille_bs::scenario::Scenario;
use reveille_common::declare::{FileError, Files};
use reveille_common::message::ScenarioDescription;
use reveille_common::scenario::{self, ScenarioError};

/// Name of the scenario file in a recording, and in messages about it.
pub const SCENARIO_FILE: &str = "scenario.toml";

/// The text of a scenario, and the files that it refers to, by paths relative to it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ScenarioBundle {
    /// Text of the scenario in TOML.
    pub text: String,
    /// Referenced files: path, with `/` between its parts, and bytes.
    pub referenced_files: Vec<(String, Vec<u8>)>,
}

impl From<ScenarioDescription> for ScenarioBundle {
    fn from(ScenarioDescription { scenario, files }: ScenarioDescription) -> Self {
        Self {
            text: scenario,
            referenced_files: files,
        }
    }
}

impl From<ScenarioBundle> for ScenarioDescription {
    fn from(bundle: ScenarioBundle) -> Self {
        Self {
            scenario: bundle.text,
            files: bundle.referenced_files,
        }
    }
}

impl ScenarioBundle {
    /// Loads the scenario.
    ///
    /// # Errors
    /// If the scenario is invalid or a file is missing.
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        let loaded = scenario::parse(
            &self.text,
            SCENARIO_FILE,
            Path::new(""),
            &[],
            &outside::kinds_with_external(),
            self,
        )?;
        Ok(loaded.scenario)
    }

    fn referenced_file(&self, path: &Path) -> Option<&[u8]> {
        let has_path = |(name, _): &&(String, Vec<u8>)| Path::new(name) == path;
        self.referenced_files.iter().find(has_path).map(|(_, bytes)| &bytes[..])
    }
}

impl Files for ScenarioBundle {
    fn read(&self, path: &Path, max_bytes: u64) -> Result<Vec<u8>, FileError> {
        let bytes = self
            .referenced_file(path)
            .ok_or(io::Error::from(io::ErrorKind::NotFound))?;
        let length = bytes.len() as u64;
        if length > max_bytes {
            return Err(FileError::TooLong { length, max_bytes });
        }
        Ok(bytes.to_vec())
    }

    fn exists(&self, path: &Path) -> bool {
        self.referenced_file(path).is_some()
    }

    fn absolute(&self, path: &Path) -> io::Result<PathBuf> {
        // Paths stay relative: they are the keys of `referenced_files`.
        Ok(path.to_owned())
    }
}
