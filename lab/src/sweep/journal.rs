//! The journal of a sweep: an append-only file with a line for every finished run.
//!
//! Each line ends with a checksum of itself. A line is handed to the operating system as soon as its run has finished, so
//! that a killed process loses the runs under way and no other; it reaches the disk now and then, so that a power cut loses
//! little. Lines that are torn or garbled are taken out when the journal is opened; runs that are missing are done again.
//!
//! The first line names the sweep and the seeds of each cell. When there shall be more, a copy with another first line takes
//! the journal's place at one stroke, and all runs with it.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, BufRead, BufReader, BufWriter, Read as _, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::error::SweepError;
use crate::table::{Hash, METRICS, Row};

/// The first word of a journal.
const MAGIC: &str = "reveille-journal ";
/// The form of the journal.
const FORM: &str = "2";
/// Bytes that a first line has at the most.
const LONGEST_HEAD: u64 = 1024;
/// Lines between two syncs to the disk.
const SYNC_LINES: u32 = 8192;
/// Device-TTIs between two syncs: some seconds of work.
const SYNC_DEVICE_TTIS: u64 = 1_000_000_000;

/// A run's place: its cell and the number of its seed, both from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Job {
    /// The cell.
    pub cell: u32,
    /// The seed's number.
    pub seed: u32,
}

/// What the journal keeps of a run: what does not follow from its place.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Hash of its scenario.
    pub scenario_hash: Hash,
    /// The metrics, NaN where not defined.
    pub metrics: [f64; METRICS],
    /// Events counted.
    pub events: u64,
    /// The run's fingerprint.
    pub digest: Hash,
}

impl From<&Row> for Entry {
    fn from(row: &Row) -> Self {
        Self {
            scenario_hash: row.scenario_hash,
            metrics: row.metrics,
            events: row.events,
            digest: row.digest,
        }
    }
}

/// An open journal, locked against other processes.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: File,
    /// The damaged file whose place `file` has taken: locked as long, for those who have opened it meanwhile.
    replaced: Option<File>,
    /// Bytes up to the end of the last whole line.
    length: u64,
    runs: BTreeMap<Job, Entry>,
    dropped: usize,
    unsynced_lines: u32,
    unsynced_device_ttis: u64,
}

impl Journal {
    /// Opens the journal at `path` or begins one. `identity` names the sweep that it belongs to; `cells` and `seeds` bound
    /// the places of its runs. A journal of fewer seeds is one of `seeds` from now on.
    ///
    /// # Errors
    /// Another process has it open, it belongs to another sweep or to more seeds, or it cannot be read or written. The
    /// reason stands alone; the caller knows the folder.
    pub fn open(path: &Path, identity: &str, cells: u64, seeds: u64) -> Result<Self, String> {
        let options = OpenOptions::new().read(true).append(true).create(true).clone();
        let file = options.open(path).map_err(|error| unusable(path, &error))?;
        match file.try_lock() {
            // Some network file systems cannot lock; there, who starts two sweeps in one folder is on their own.
            Ok(()) => {}
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {}
            Err(TryLockError::Error(error)) => return Err(unusable(path, &error)),
            Err(TryLockError::WouldBlock) => {
                return Err(
                    "another `reveille sweep` is at work in this folder; wait for its end, or choose another"
                        .to_owned(),
                );
            }
        }
        let mut journal = Self {
            path: path.to_owned(),
            file,
            replaced: None,
            length: 0,
            runs: BTreeMap::new(),
            dropped: 0,
            unsynced_lines: 0,
            unsynced_device_ttis: 0,
        };
        journal.recover(&name_of(identity), cells, seeds)?;
        Ok(journal)
    }

    /// Seeds of each cell that the journal at `path` is for, if it is one of the sweep that `identity` names.
    pub fn seeds(path: &Path, identity: &str) -> Option<u64> {
        let mut line = Vec::new();
        let file = File::open(path).ok()?;
        BufReader::new(file)
            .take(LONGEST_HEAD)
            .read_until(b'\n', &mut line)
            .ok()?;
        match Head::of(&line, &name_of(identity))? {
            Head::Torn => None,
            Head::Seeds(held) => Some(held),
        }
    }

    /// Reads what is there, takes torn and garbled lines out of the file, and raises the seeds of its first line.
    fn recover(&mut self, name: &str, cells: u64, seeds: u64) -> Result<(), String> {
        let failed = |error: io::Error| unusable(&self.path, &error);
        let header = format!("{name} {seeds}\n");
        let mut reader = BufReader::new(&self.file);
        let mut line = Vec::new();
        let (mut whole, mut length, mut is_stale) = (0, 0, false);
        while reader.read_until(b'\n', &mut line).map_err(failed)? > 0 {
            length += line.len() as u64;
            if whole == 0 {
                match Head::of(&line, name) {
                    None => return Err(foreign(&line)),
                    Some(Head::Torn) => break,
                    Some(Head::Seeds(held)) if held > seeds => return Err(fewer(held, seeds)),
                    Some(Head::Seeds(held)) => is_stale = held < seeds,
                }
                whole = length;
            } else if let Some((job, entry)) = parse(&line, cells, seeds) {
                self.runs.insert(job, entry);
                whole = length;
            } else {
                self.dropped += 1;
                is_stale |= line.ends_with(b"\n");
            }
            line.clear();
        }
        if is_stale {
            return self.rewrite(&header).map_err(|error| unusable(&self.path, &error));
        }
        self.file.set_len(whole).map_err(failed)?;
        self.file.seek(SeekFrom::End(0)).map_err(failed)?;
        if whole == 0 {
            self.file.write_all(header.as_bytes()).map_err(failed)?;
            whole = header.len() as u64;
        }
        self.length = whole;
        Ok(())
    }

    /// Puts a journal of the runs that were found in the place of this one. Both stay locked.
    fn rewrite(&mut self, header: &str) -> io::Result<()> {
        let part = self.path.with_extension("journal.part");
        let file = OpenOptions::new().read(true).append(true).create(true).open(&part)?;
        file.set_len(0)?;
        match file.try_lock() {
            Err(TryLockError::Error(error)) if error.kind() != io::ErrorKind::Unsupported => return Err(error),
            Err(TryLockError::WouldBlock) => return Err(io::ErrorKind::ResourceBusy.into()),
            Ok(()) | Err(TryLockError::Error(_)) => {}
        }
        let copied = self.copy(&file, header);
        let placed = copied.and_then(|length| fs::rename(&part, &self.path).map(|()| length));
        if placed.is_err() {
            // The first error is the one that matters.
            let _ = fs::remove_file(&part);
        }
        self.length = placed?;
        self.replaced = Some(std::mem::replace(&mut self.file, file));
        Ok(())
    }

    /// Writes `header` and the runs to `file`, and brings them to the disk. Gives the bytes.
    fn copy(&self, file: &File, header: &str) -> io::Result<u64> {
        let mut writer = BufWriter::new(file);
        let mut length = header.len();
        writer.write_all(header.as_bytes())?;
        for (job, entry) in &self.runs {
            let line = line(*job, entry);
            writer.write_all(line.as_bytes())?;
            length += line.len();
        }
        writer.flush()?;
        drop(writer);
        file.sync_all()?;
        Ok(length as u64)
    }

    /// The finished runs.
    pub fn runs(&self) -> &BTreeMap<Job, Entry> {
        &self.runs
    }

    /// Lines that were torn or garbled when the journal was opened, and have been taken out of it.
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Adds a finished run that took `device_ttis`.
    ///
    /// # Errors
    /// It cannot be written; the runs before it are kept.
    pub fn add(&mut self, job: Job, entry: Entry, device_ttis: u64) -> Result<(), SweepError> {
        let line = line(job, &entry);
        if let Err(error) = self.file.write_all(line.as_bytes()) {
            // Another thread may find room again: its line must not follow half of this one.
            let _ = self.file.set_len(self.length);
            return Err(self.failed(error));
        }
        self.length += line.len() as u64;
        self.runs.insert(job, entry);
        self.unsynced_lines += 1;
        self.unsynced_device_ttis = self.unsynced_device_ttis.saturating_add(device_ttis);
        if self.unsynced_lines >= SYNC_LINES || self.unsynced_device_ttis >= SYNC_DEVICE_TTIS {
            self.sync()?;
        }
        Ok(())
    }

    /// Brings everything to the disk.
    ///
    /// # Errors
    /// It cannot.
    pub fn sync(&mut self) -> Result<(), SweepError> {
        (self.unsynced_lines, self.unsynced_device_ttis) = (0, 0);
        self.file.sync_data().map_err(|error| self.failed(error))
    }

    fn failed(&self, error: io::Error) -> SweepError {
        SweepError::Journal {
            path: self.path.clone(),
            kept: self.runs.len(),
            error,
        }
    }
}

fn unusable(path: &Path, error: &io::Error) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    format!("its {name} cannot be used: {error}; free some space, mend the permissions, or choose another folder")
}

/// What the first line of a journal says.
enum Head {
    /// It was cut off while it was written: there are no runs yet.
    Torn,
    /// The journal is for so many seeds of each cell.
    Seeds(u64),
}

impl Head {
    /// The head in `line`, if it is one of the sweep called `name`.
    fn of(line: &[u8], name: &str) -> Option<Self> {
        let text = std::str::from_utf8(line).ok()?;
        let Some(text) = text.strip_suffix('\n') else {
            let seeds = text.strip_prefix(name).and_then(|rest| rest.strip_prefix(' '));
            let is_number = |seeds: &str| seeds.bytes().all(|byte| byte.is_ascii_digit());
            let is_torn = name.starts_with(text) || seeds.is_some_and(is_number);
            return is_torn.then_some(Self::Torn);
        };
        let seeds = text.strip_prefix(name)?.strip_prefix(' ')?;
        seeds.parse().ok().map(Self::Seeds)
    }
}

fn fewer(held: u64, seeds: u64) -> String {
    format!(
        "holds the runs of {held} seeds a cell, more than the {seeds} asked for: they can be raised, not lowered; \
         give --seeds {held} or more, or choose another folder by --out"
    )
}

/// How the first line of a journal begins; the number of seeds follows.
fn name_of(identity: &str) -> String {
    format!("{MAGIC}{FORM} {identity}")
}

fn foreign(line: &[u8]) -> String {
    let line = String::from_utf8_lossy(line);
    let form = line.strip_prefix(MAGIC).and_then(|rest| rest.split_whitespace().next());
    match form {
        Some(FORM) => "holds the runs of another experiment, shard or version of reveille (see experiment.toml there); \
             give the same command again to go on with it, with the same first seed and at least as many seeds, or choose \
             another folder"
            .to_owned(),
        Some(form) if form.bytes().all(|byte| byte.is_ascii_digit()) => format!(
            "holds a runs.journal of form {form}, but this version of reveille goes on with form {FORM} alone; go on with \
             the version that began the sweep, or choose another folder"
        ),
        Some(_) | None => {
            "holds a runs.journal that is none, or one with a damaged first line; choose another folder".to_owned()
        }
    }
}

/// The line of a run, with its end.
fn line(job: Job, entry: &Entry) -> String {
    let Job { cell, seed } = job;
    let metrics = entry.metrics.map(|value| {
        if value.is_nan() {
            "-".to_owned()
        } else {
            value.to_string()
        }
    });
    let (hash, events, digest) = (entry.scenario_hash, entry.events, entry.digest);
    let text = format!("{cell} {seed} {hash} {} {events} {digest}", metrics.join(" "));
    format!("{text} {:08x}\n", crc32fast::hash(text.as_bytes()))
}

/// The run of a line, if the line is whole.
fn parse(line: &[u8], cells: u64, seeds: u64) -> Option<(Job, Entry)> {
    let (text, sum) = std::str::from_utf8(line).ok()?.strip_suffix('\n')?.rsplit_once(' ')?;
    if sum.len() != 8 || u32::from_str_radix(sum, 16).ok()? != crc32fast::hash(text.as_bytes()) {
        return None;
    }
    let mut fields = text.split(' ');
    let job = Job {
        cell: fields.next()?.parse().ok()?,
        seed: fields.next()?.parse().ok()?,
    };
    if u64::from(job.cell) >= cells || u64::from(job.seed) >= seeds {
        return None;
    }
    let scenario_hash = fields.next()?.parse().ok()?;
    let mut metrics = [f64::NAN; METRICS];
    for slot in &mut metrics {
        match fields.next()? {
            "-" => {}
            number => *slot = number.parse().ok()?,
        }
    }
    let entry = Entry {
        scenario_hash,
        metrics,
        events: fields.next()?.parse().ok()?,
        digest: fields.next()?.parse().ok()?,
    };
    fields.next().is_none().then_some((job, entry))
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Place(PathBuf);

    impl Place {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("reveille-journal-{}-{name}", std::process::id()));
            let _ = fs::remove_file(&path);
            Self(path)
        }

        fn open(&self) -> Journal {
            Journal::open(&self.0, "me", 3, 5).expect("usable")
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            let _ = fs::remove_file(&self.0);
        }
    }

    fn entry(number: u8) -> Entry {
        let mut metrics = [f64::NAN; METRICS];
        metrics[1] = f64::from(number) / 3.0;
        metrics[2] = 1e-300;
        Entry {
            scenario_hash: Hash([number; 32]),
            metrics,
            events: u64::from(number),
            digest: Hash([!number; 32]),
        }
    }

    const JOBS: [Job; 3] = [
        Job { cell: 0, seed: 0 },
        Job { cell: 2, seed: 4 },
        Job { cell: 1, seed: 3 },
    ];

    fn filled(name: &str) -> (Place, Vec<u8>) {
        let place = Place::new(name);
        let mut journal = place.open();
        for (job, number) in JOBS.into_iter().zip(7..) {
            journal.add(job, entry(number), 1).expect("written");
        }
        drop(journal);
        let bytes = fs::read(&place.0).expect("there");
        (place, bytes)
    }

    fn same(a: &Entry, b: &Entry) -> bool {
        line(JOBS[0], a) == line(JOBS[0], b) && a.metrics[1].to_bits() == b.metrics[1].to_bits()
    }

    #[test]
    fn runs_are_found_again_bit_for_bit() {
        let (place, _) = filled("whole");
        let journal = place.open();
        assert_eq!((journal.runs().len(), journal.dropped()), (3, 0));
        for (job, number) in JOBS.into_iter().zip(7..) {
            assert!(same(&journal.runs()[&job], &entry(number)));
        }
    }

    #[test]
    fn a_journal_cut_anywhere_loses_the_torn_line_alone_and_goes_on() {
        let (place, bytes) = filled("cut");
        let ends: Vec<usize> = (0..bytes.len())
            .filter(|&at| bytes[at] == b'\n')
            .map(|at| at + 1)
            .collect();
        for length in 0..=bytes.len() {
            fs::write(&place.0, &bytes[..length]).expect("written");
            let mut journal = place.open();
            let whole = ends.iter().filter(|&&end| end <= length).count();
            assert_eq!(journal.runs().len(), whole.saturating_sub(1), "cut at {length}");
            journal.add(JOBS[2], entry(9), 1).expect("written");
            drop(journal);
            let journal = place.open();
            assert!(same(&journal.runs()[&JOBS[2]], &entry(9)), "cut at {length}");
            assert_eq!(journal.dropped(), 0, "cut at {length}");
        }
    }

    #[test]
    fn a_garbled_line_is_dropped_and_no_other() {
        let (place, bytes) = filled("garbled");
        let header = bytes.iter().position(|&byte| byte == b'\n').expect("a line") + 1;
        let second = header + bytes[header..].iter().position(|&byte| byte == b'\n').expect("a line") + 1;
        for at in (header..second - 1).step_by(3) {
            let mut garbled = bytes.clone();
            garbled[at] ^= 1;
            fs::write(&place.0, &garbled).expect("written");
            let journal = place.open();
            assert_eq!((journal.runs().len(), journal.dropped()), (2, 1), "byte {at}");
            let reason = Journal::open(&place.0, "me", 3, 5).expect_err("the new file is locked as well");
            assert!(reason.contains("another `reveille sweep`"), "{reason}");
            drop(journal);
            let mut journal = place.open();
            assert_eq!((journal.runs().len(), journal.dropped()), (2, 0), "byte {at}, again");
            journal.add(JOBS[0], entry(7), 1).expect("written");
            drop(journal);
            assert_eq!(place.open().runs().len(), 3, "byte {at}, mended");
        }
    }

    #[test]
    fn seeds_are_raised_with_all_runs_and_never_lowered() {
        let (place, bytes) = filled("raised");
        // A copy that was cut off is no harm.
        fs::write(place.0.with_extension("journal.part"), &bytes[..bytes.len() / 2]).expect("written");
        let journal = Journal::open(&place.0, "me", 3, 20).expect("more seeds");
        assert_eq!((journal.runs().len(), journal.dropped()), (3, 0));
        let reason = Journal::open(&place.0, "me", 3, 20).expect_err("the new file is locked as well");
        assert!(reason.contains("another `reveille sweep`"), "{reason}");
        drop(journal);
        let raised = fs::read(&place.0).expect("there");
        let reason = Journal::open(&place.0, "me", 3, 19).expect_err("fewer seeds");
        assert!(
            reason.contains("20 seeds") && reason.contains("the 19 asked for"),
            "{reason}"
        );
        assert_eq!(fs::read(&place.0).expect("there"), raised, "untouched");
        let mut journal = Journal::open(&place.0, "me", 3, 20).expect("the same");
        journal.add(Job { cell: 2, seed: 19 }, entry(1), 1).expect("written");
        drop(journal);
        assert_eq!(Journal::open(&place.0, "me", 3, 20).expect("the same").runs().len(), 4);
    }

    #[test]
    fn another_sweep_and_a_second_process_are_refused() {
        let (place, _) = filled("refused");
        let first = place.open();
        let reason = Journal::open(&place.0, "me", 3, 5).expect_err("locked");
        assert!(reason.contains("another `reveille sweep`"), "{reason}");
        drop(first);
        let reason = Journal::open(&place.0, "you", 3, 5).expect_err("another");
        assert!(reason.contains("another experiment"), "{reason}");
        for text in [
            "letters\n",
            "my precious notes",
            "reveille-journal 2 you",
            "reveille-journal 2 me too",
            "reveille-journal 2 me 5 6\n",
            "reveille-journal 2 me\n",
            "reveille-journal 1 me 5\n",
            "r\n",
        ] {
            fs::write(&place.0, text).expect("written");
            let reason = Journal::open(&place.0, "me", 3, 5).expect_err("no journal");
            let part = match text.strip_prefix("reveille-journal ").map(|rest| &rest[..1]) {
                Some("2") => "another experiment",
                Some(_) => "a runs.journal of form 1, but this version of reveille goes on with form 2",
                None => "is none",
            };
            assert!(reason.contains(part), "{text}: {reason}");
            assert_eq!(fs::read_to_string(&place.0).expect("there"), text, "untouched");
        }
    }
}
