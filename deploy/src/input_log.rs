//! The inputs of a run in its folder: `inputs.log`. A line is on the disk before the run goes on from what it says, so
//! that a replay of the run comes to the same.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use reveille_common::message::Outage;
use reveille_common::scenario::Scenario;
use reveille_lab::inputs;

/// The file in a run folder.
pub const INPUTS: &str = "inputs.log";
/// What is said of a log of which not all comes to pass.
pub const MISFIT: &str = "inputs.log names an outage that does not come in this run: was it changed?";

/// The log of a run.
#[derive(Debug)]
pub struct InputLog {
    path: PathBuf,
    first_line: String,
    /// Once there is something in it.
    file: Option<File>,
}

impl InputLog {
    /// The log in a run folder. A file comes about with the first input.
    pub fn new(folder: &Path, scenario: &Scenario) -> Self {
        Self {
            path: folder.join(INPUTS),
            first_line: inputs::first_line(scenario),
            file: None,
        }
    }

    /// Adds an outage.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn add(&mut self, outage: &Outage) -> anyhow::Result<()> {
        let written = self.write(outage);
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn write(&mut self, outage: &Outage) -> io::Result<()> {
        let opened = self.file.take();
        let mut file = opened.map_or_else(|| self.open(), Ok)?;
        file.write_all(inputs::line(outage).as_bytes())?;
        file.sync_data()?;
        self.file = Some(file);
        Ok(())
    }

    /// The file behind its last whole line, and with its first.
    fn open(&self) -> io::Result<File> {
        let mut options = OpenOptions::new();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&self.path)?;
        let whole = inputs::whole(&io::read_to_string(&file)?).len();
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        if whole == 0 {
            file.write_all(self.first_line.as_bytes())?;
            // After a power cut the folder must know of the file.
            if let Some(folder) = self.path.parent() {
                File::open(folder)?.sync_all()?;
            }
        }
        Ok(file)
    }
}

/// The inputs that a run folder holds, in the order in which they came; none if it holds no log.
///
/// # Errors
/// As of [`read`].
pub fn of_folder(folder: &Path, scenario: &Scenario) -> anyhow::Result<Vec<Outage>> {
    let path = folder.join(INPUTS);
    match std::fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Ok(_) | Err(_) => read(&path, scenario),
    }
}

/// The inputs in the log at `path`, in the order in which they came.
///
/// # Errors
/// It cannot be read, is no log, or is that of a run of another scenario.
pub fn read(path: &Path, scenario: &Scenario) -> anyhow::Result<Vec<Outage>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    inputs::parse(&text, scenario).with_context(|| path.display().to_string())
}
