//! The file of a journal: locked while it is open, repaired on opening, and synced to the disk at intervals. The parent
//! module has the format of its lines. A [`Journal`] also keeps all runs in memory; both copies must agree.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, BufRead, BufReader, BufWriter, Read as _, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::{
    JournalEntry, JournalHeader, MAX_HEADER_BYTES, RunIndex, RunStore, encode_line, foreign_journal, header_prefix,
    parse_line, too_many_seeds,
};
use crate::io::open_part_file;
use crate::sweep::error::SweepError;

/// The number of lines between two syncs to the disk.
const SYNC_LINES: u32 = 8192;
/// The number of device-TTIs between two syncs: some seconds of work.
const SYNC_DEVICE_TTIS: u64 = 1_000_000_000;

/// An open journal, locked against other processes.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: File,
    /// The damaged file that `file` has replaced. It stays locked for processes that have opened it meanwhile.
    replaced_file: Option<File>,
    /// The number of bytes up to the end of the last complete line. A failed write is cut off here.
    valid_bytes: u64,
    /// The runs in the file.
    runs: BTreeMap<RunIndex, JournalEntry>,
    dropped_lines: usize,
    unsynced_lines: u32,
    unsynced_device_ttis: u64,
}

impl Journal {
    /// Opens or creates the journal at `path`. `identity` names its sweep, in one line of text. Lines of runs beyond
    /// `cells` or `seeds` count as garbled. A journal with fewer seeds is raised to `seeds`.
    ///
    /// # Errors
    /// If another process has it open, it belongs to another sweep or to more seeds, or it cannot be read or written.
    /// The message does not name the folder; the caller does.
    pub fn open(path: &Path, identity: &str, cells: u64, seeds: u64) -> Result<Self, String> {
        let options = OpenOptions::new().read(true).append(true).create(true).clone();
        let file = options.open(path).map_err(|error| unusable_file(path, &error))?;
        match file.try_lock() {
            // Some network file systems cannot lock: there, two sweeps in one folder are not prevented.
            Ok(()) => {}
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {}
            Err(TryLockError::Error(error)) => return Err(unusable_file(path, &error)),
            Err(TryLockError::WouldBlock) => {
                return Err(
                    "another `reveille sweep` uses this folder; wait for its end, or choose another folder".to_owned(),
                );
            }
        }
        let mut journal = Self {
            path: path.to_owned(),
            file,
            replaced_file: None,
            valid_bytes: 0,
            runs: BTreeMap::new(),
            dropped_lines: 0,
            unsynced_lines: 0,
            unsynced_device_ttis: 0,
        };
        journal.recover(&header_prefix(identity), cells, seeds)?;
        Ok(journal)
    }

    /// Returns the seeds per cell of the journal at `path`, if it belongs to the sweep named by `identity`.
    pub fn read_seed_count(path: &Path, identity: &str) -> Option<u64> {
        let mut line = Vec::new();
        let file = File::open(path).ok()?;
        BufReader::new(file)
            .take(MAX_HEADER_BYTES)
            .read_until(b'\n', &mut line)
            .ok()?;
        match JournalHeader::parse(&line, &header_prefix(identity))? {
            JournalHeader::Torn => None,
            JournalHeader::Seeds(journal_seeds) => Some(journal_seeds),
        }
    }

    /// Reads the runs, removes torn and garbled lines from the file, and raises the seeds of its first line.
    fn recover(&mut self, prefix: &str, cells: u64, seeds: u64) -> Result<(), String> {
        let unusable = |error: io::Error| unusable_file(&self.path, &error);
        let header = format!("{prefix} {seeds}\n");
        let mut reader = BufReader::new(&self.file);
        let mut line = Vec::new();
        let (mut valid_bytes, mut read_bytes, mut needs_rewrite) = (0, 0, false);
        while reader.read_until(b'\n', &mut line).map_err(unusable)? > 0 {
            read_bytes += line.len() as u64;
            // No valid byte yet: this line is the first.
            if valid_bytes == 0 {
                match JournalHeader::parse(&line, prefix) {
                    None => return Err(foreign_journal(&line)),
                    // `valid_bytes` is still 0, so the file is emptied and gets a new first line.
                    Some(JournalHeader::Torn) => break,
                    Some(JournalHeader::Seeds(journal_seeds)) if journal_seeds > seeds => {
                        return Err(too_many_seeds(journal_seeds, seeds));
                    }
                    Some(JournalHeader::Seeds(journal_seeds)) => needs_rewrite = journal_seeds < seeds,
                }
                valid_bytes = read_bytes;
            } else if let Some((run_index, entry)) = parse_line(&line, cells, seeds) {
                self.runs.insert(run_index, entry);
                valid_bytes = read_bytes;
            } else {
                self.dropped_lines += 1;
                // A torn last line is cut off by `set_len`; a garbled one with lines after it needs a new file.
                needs_rewrite |= line.ends_with(b"\n");
            }
            line.clear();
        }
        if needs_rewrite {
            return self.rewrite(&header).map_err(|error| unusable_file(&self.path, &error));
        }
        self.file.set_len(valid_bytes).map_err(unusable)?;
        self.file.seek(SeekFrom::End(0)).map_err(unusable)?;
        if valid_bytes == 0 {
            self.file.write_all(header.as_bytes()).map_err(unusable)?;
            valid_bytes = header.len() as u64;
        }
        self.valid_bytes = valid_bytes;
        Ok(())
    }

    /// Replaces this journal by one with the recovered runs. Both files stay locked.
    fn rewrite(&mut self, header: &str) -> io::Result<()> {
        let part = open_part_file(&self.path, |part_path| {
            let file = OpenOptions::new()
                .read(true)
                .append(true)
                .create(true)
                .open(part_path)?;
            match file.try_lock() {
                Err(TryLockError::Error(error)) if error.kind() != io::ErrorKind::Unsupported => return Err(error),
                Err(TryLockError::WouldBlock) => return Err(io::ErrorKind::ResourceBusy.into()),
                Ok(()) | Err(TryLockError::Error(_)) => {}
            }
            // Emptied under the lock only: another process may be writing to this file.
            file.set_len(0)?;
            Ok(file)
        })?;
        let byte_count = self.write_copy(part.as_file(), header)?;
        let file = part.persist(&self.path)?;
        self.valid_bytes = byte_count;
        self.replaced_file = Some(std::mem::replace(&mut self.file, file));
        Ok(())
    }

    /// Writes `header` and the runs to `file` and syncs it to the disk. Returns the number of bytes.
    fn write_copy(&self, file: &File, header: &str) -> io::Result<u64> {
        let mut writer = BufWriter::new(file);
        let mut byte_count = header.len();
        writer.write_all(header.as_bytes())?;
        for (run_index, entry) in &self.runs {
            let line = encode_line(*run_index, entry);
            writer.write_all(line.as_bytes())?;
            byte_count += line.len();
        }
        writer.flush()?;
        drop(writer);
        file.sync_all()?;
        Ok(byte_count as u64)
    }

    /// The number of torn or garbled lines that were removed when the journal was opened.
    pub fn dropped_lines(&self) -> usize {
        self.dropped_lines
    }

    fn write_error(&self, error: io::Error) -> SweepError {
        SweepError::Journal {
            path: self.path.clone(),
            recorded: self.runs.len(),
            error,
        }
    }
}

impl RunStore for Journal {
    fn runs(&self) -> &BTreeMap<RunIndex, JournalEntry> {
        &self.runs
    }

    fn add(&mut self, run_index: RunIndex, entry: JournalEntry, device_ttis: u64) -> Result<(), SweepError> {
        let line = encode_line(run_index, &entry);
        if let Err(error) = self.file.write_all(line.as_bytes()) {
            // Another thread may find space again: its line must not follow half of this one.
            let _ = self.file.set_len(self.valid_bytes);
            return Err(self.write_error(error));
        }
        self.valid_bytes += line.len() as u64;
        self.runs.insert(run_index, entry);
        self.unsynced_lines += 1;
        self.unsynced_device_ttis = self.unsynced_device_ttis.saturating_add(device_ttis);
        if self.unsynced_lines >= SYNC_LINES || self.unsynced_device_ttis >= SYNC_DEVICE_TTIS {
            self.sync()?;
        }
        Ok(())
    }

    fn sync(&mut self) -> Result<(), SweepError> {
        (self.unsynced_lines, self.unsynced_device_ttis) = (0, 0);
        self.file.sync_data().map_err(|error| self.write_error(error))
    }
}

fn unusable_file(path: &Path, error: &io::Error) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    format!("its {name} cannot be used: {error}; free some space, correct the permissions, or choose another folder")
}

#[cfg(test)]
mod tests;
