//! The input log of a run folder: `inputs.log`, written during a run and read by `--resume`, `--input-log`, `--policy
//! replay=FILE` and observers. `lab/src/external_inputs/mod.rs` defines its lines.
//!
//! An input is logged before the run acts on it, so that a replay repeats the run after any kill. Removals and actions
//! are synced to the disk immediately. Decisions can be thousands a second, so a power cut can lose the last second of
//! them.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use reveille_bs::scenario::Scenario;
use reveille_common::declare::describe_read_error;
use reveille_common::message::InputLogPart;
use reveille_lab::external_inputs::{self, ExternalInput, ExternalInputs};

use crate::runtime::now;

/// The file name of the log in a run folder; part of the documented layout (`docs/results.md`) and of error texts.
pub(crate) const INPUT_LOG_FILE: &str = "inputs.log";
/// The error for a log with inputs that do not occur in the run: found at the end of the run or replay.
pub(crate) const MISMATCH: &str = "inputs.log names a removal or a decision that does not occur in this run; use the \
    log of a run with this scenario";
/// Time between two syncs of decisions to the disk.
const SYNC_INTERVAL: Duration = Duration::from_secs(1);

/// The input log of a run.
#[derive(Debug)]
pub(crate) struct InputLog {
    path: PathBuf,
    /// The line with which the file starts.
    first_line: String,
    /// The open file, once there is an input.
    file: Option<File>,
    last_sync: Instant,
}

impl InputLog {
    /// Creates the log of a run folder. The file is created with the first input.
    pub(crate) fn new(folder: &Path, scenario: &Scenario) -> Self {
        Self {
            path: folder.join(INPUT_LOG_FILE),
            first_line: external_inputs::first_line(scenario),
            file: None,
            last_sync: now(),
        }
    }

    /// Appends an input. Call it before the run acts on the input.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn add(&mut self, input: &ExternalInput) -> anyhow::Result<()> {
        // Removals and actions are rare. A sync for each of thousands of decisions a second would slow the run down.
        let must_sync = match input {
            ExternalInput::Removal(_) | ExternalInput::Action(_) => true,
            ExternalInput::Decision(_) => self.last_sync.elapsed() >= SYNC_INTERVAL,
        };
        let written = self.write([input.clone()], must_sync);
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Appends several inputs, before the run starts; creates no file without inputs.
    ///
    /// # Errors
    /// If they cannot be written.
    pub(crate) fn add_all(&mut self, inputs: &ExternalInputs) -> anyhow::Result<()> {
        if *inputs == ExternalInputs::default() {
            return Ok(());
        }
        let written = self.write(inputs.iter(), true);
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Replaces the content of the log with `inputs`.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn replace(&mut self, inputs: &ExternalInputs) -> anyhow::Result<()> {
        // The open handle belongs to the file that is replaced.
        self.file = None;
        let lines = inputs.iter().map(|input| external_inputs::input_line(&input));
        let text: String = std::iter::once(self.first_line.clone()).chain(lines).collect();
        reveille_lab::io::replace(&self.path, text.as_bytes())
            .with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn write(&mut self, inputs: impl IntoIterator<Item = ExternalInput>, must_sync: bool) -> io::Result<()> {
        // Taken out: after a failed write the file is reopened, which removes a torn line.
        let open_file = self.file.take();
        let mut file = open_file.map_or_else(|| self.open(), Ok)?;
        let lines: String = inputs
            .into_iter()
            .map(|input| external_inputs::input_line(&input))
            .collect();
        file.write_all(lines.as_bytes())?;
        if must_sync {
            file.sync_data()?;
            self.last_sync = now();
        }
        self.file = Some(file);
        Ok(())
    }

    /// Opens the file after its last whole line, without checking that it belongs to this run. Writes the first line of
    /// a new one.
    fn open(&self) -> io::Result<File> {
        let mut options = OpenOptions::new();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&self.path)?;
        // A kill can leave half a line, which the next entry must not continue.
        let whole_bytes = external_inputs::complete_lines(&io::read_to_string(&file)?).len();
        file.set_len(whole_bytes as u64)?;
        file.seek(SeekFrom::End(0))?;
        if whole_bytes == 0 {
            file.write_all(self.first_line.as_bytes())?;
            // The folder is synced too, so that the new file survives a power cut.
            if let Some(folder) = self.path.parent() {
                File::open(folder)?.sync_all()?;
            }
        }
        Ok(file)
    }
}

/// The external inputs in a run folder, in order; empty without a log.
///
/// # Errors
/// See [`read`].
pub(crate) fn read_folder(folder: &Path, scenario: &Scenario) -> anyhow::Result<ExternalInputs> {
    let path = folder.join(INPUT_LOG_FILE);
    // A dangling link is an error, not a missing log.
    match std::fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(ExternalInputs::default()),
        Ok(_) | Err(_) => read(&path, scenario),
    }
}

/// Reads the external inputs in the log at `path`, in order.
///
/// # Errors
/// If the file cannot be read, is not an input log, or belongs to another scenario.
pub(crate) fn read(path: &Path, scenario: &Scenario) -> anyhow::Result<ExternalInputs> {
    let text = std::fs::read_to_string(path).map_err(|error| {
        let hint = "name the inputs.log of a run folder; a run without removals, decisions or actions has none";
        let cause = describe_read_error(&error, hint);
        anyhow!("{}: {cause}", path.display())
    })?;
    external_inputs::parse(&text, scenario).with_context(|| path.display().to_string())
}

/// Reads a part of the log at `path` for an observer, from byte `from` on. The part can end within a line, but holds
/// at least one whole line if the log has one. It is empty without a log.
///
/// # Errors
/// If the log cannot be read.
pub(crate) fn read_part(path: &Path, from: u64) -> io::Result<InputLogPart> {
    let mut bytes = Vec::new();
    match File::open(path) {
        Ok(mut file) => {
            file.seek(SeekFrom::Start(from))?;
            let mut file = BufReader::new(file);
            file.by_ref().take(InputLogPart::MAX_BYTES).read_to_end(&mut bytes)?;
            // A line can be longer than a part; without a whole line an observer would never get further.
            if !bytes.contains(&b'\n') {
                file.read_until(b'\n', &mut bytes)?;
            }
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    Ok(InputLogPart { bytes })
}

/// Reads a log named by the user, which must not be empty; see [`read`].
///
/// # Errors
/// See [`read`]; also if the log is empty.
pub(crate) fn read_nonempty(path: &Path, scenario: &Scenario) -> anyhow::Result<ExternalInputs> {
    let inputs = read(path, scenario)?;
    anyhow::ensure!(
        inputs != ExternalInputs::default(),
        "{}: the input log holds no inputs; use the inputs.log of a run with decisions, actions or removals",
        path.display()
    );
    Ok(inputs)
}
