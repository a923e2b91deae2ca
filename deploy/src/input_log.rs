//! The inputs of a run in its folder: `inputs.log`. A line is written before the run goes on from what it says, so that
//! a replay of the run comes to the same, whatever is killed. An outage is on the disk then; of decisions, of which
//! there may be thousands in a second, a power cut can take the last second.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use reveille_common::message::LogPart;
use reveille_common::scenario::Scenario;
use reveille_lab::inputs::{self, Input, Inputs};

use crate::wall::now;

/// The file in a run folder.
pub const INPUTS: &str = "inputs.log";
/// What is said of a log of which not all comes to pass.
pub const MISFIT: &str =
    "the log of inputs names an outage or a decision that does not come in this run: was it changed?";
/// Time between two moments at which decisions are on the disk.
const SYNC: Duration = Duration::from_secs(1);

/// The log of a run.
#[derive(Debug)]
pub struct InputLog {
    path: PathBuf,
    first_line: String,
    /// Once there is something in it.
    file: Option<File>,
    synced: Instant,
}

impl InputLog {
    /// The log in a run folder. A file comes about with the first input.
    pub fn new(folder: &Path, scenario: &Scenario) -> Self {
        Self {
            path: folder.join(INPUTS),
            first_line: inputs::first_line(scenario),
            file: None,
            synced: now(),
        }
    }

    /// Adds an input.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn add(&mut self, input: &Input) -> anyhow::Result<()> {
        let written = self.write(input);
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Adds each of these.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn add_all(&mut self, inputs: &Inputs) -> anyhow::Result<()> {
        inputs.iter().try_for_each(|input| self.add(&input))
    }

    /// Has no more in it than these.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn replace(&mut self, inputs: &Inputs) -> anyhow::Result<()> {
        self.file = None;
        let lines = inputs.iter().map(|input| inputs::line(&input));
        let text: String = std::iter::once(self.first_line.clone()).chain(lines).collect();
        reveille_lab::io::replace(&self.path, text.as_bytes())
            .with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn write(&mut self, input: &Input) -> io::Result<()> {
        let opened = self.file.take();
        let mut file = opened.map_or_else(|| self.open(), Ok)?;
        file.write_all(inputs::line(input).as_bytes())?;
        let is_due = match input {
            Input::Outage(_) => true,
            Input::Decision(_) => self.synced.elapsed() >= SYNC,
        };
        if is_due {
            file.sync_data()?;
            self.synced = now();
        }
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
pub fn of_folder(folder: &Path, scenario: &Scenario) -> anyhow::Result<Inputs> {
    let path = folder.join(INPUTS);
    match std::fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Inputs::default()),
        Ok(_) | Err(_) => read(&path, scenario),
    }
}

/// The inputs in the log at `path`, in the order in which they came.
///
/// # Errors
/// It cannot be read, is no log, or is that of a run of another scenario.
pub fn read(path: &Path, scenario: &Scenario) -> anyhow::Result<Inputs> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    inputs::parse(&text, scenario).with_context(|| path.display().to_string())
}

/// The part of the log at `path` from byte `from` on, for an observer, up to the end of a line at least; empty if there
/// is none.
///
/// # Errors
/// It cannot be read.
pub fn part(path: &Path, from: u64) -> io::Result<LogPart> {
    let mut bytes = Vec::new();
    match File::open(path) {
        Ok(mut file) => {
            file.seek(SeekFrom::Start(from))?;
            let mut file = BufReader::new(file);
            file.by_ref().take(LogPart::LONGEST).read_to_end(&mut bytes)?;
            if !bytes.contains(&b'\n') {
                file.read_until(b'\n', &mut bytes)?;
            }
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    Ok(LogPart { bytes })
}

/// As [`read`], of a log that somebody has named, which is to hold something.
///
/// # Errors
/// As of [`read`]; it is none.
pub fn read_named(path: &Path, scenario: &Scenario) -> anyhow::Result<Inputs> {
    let inputs = read(path, scenario)?;
    anyhow::ensure!(inputs != Inputs::default(), "{}: nothing is in it", path.display());
    Ok(inputs)
}
