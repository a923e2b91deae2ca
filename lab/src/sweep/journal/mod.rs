//! The journal of a sweep: an append-only file with a line for every finished run.
//!
//! Each line ends with a checksum of itself. A line is written as soon as its run has finished, so that a killed
//! process only loses the runs in progress. It is synced to the disk at intervals, so that a power cut loses little.
//! Torn and garbled lines are removed when the journal is opened; missing runs are repeated.
//!
//! The first line names the sweep and the seeds of each cell. To raise the seeds, a copy with another first line and
//! all runs replaces the journal atomically. A change of the lines, or of the metrics' number or order, needs a new
//! `FORMAT`: older journals are then refused. `folder` puts `--out FOLDER: ` before the error texts of this module.

mod io;

use std::collections::BTreeMap;

use reveille_common::digits::count_noun;
use reveille_common::score::Metrics;

use crate::sweep::error::SweepError;
use crate::table::{Hash, ResultRow};

pub use io::Journal;

/// The first word of a journal.
const MAGIC: &str = "reveille-journal ";
/// The version of the format, the second word.
const FORMAT: &str = "4";
/// The number of bytes in which [`Journal::read_seed_count`] expects the first line.
pub(super) const MAX_HEADER_BYTES: u64 = 1024;

/// The place of a run: its cell and the index of its seed, both from 0. The order, by cell and then by seed, is the
/// order of rows in tables: `folder` takes ranges of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunIndex {
    /// The cell.
    pub cell: u32,
    /// The index of the seed, not its value.
    pub seed: u32,
}

/// The part of a run's row that does not follow from its place.
#[derive(Clone, Debug)]
pub struct JournalEntry {
    /// The hash of its scenario.
    pub scenario_hash: Hash,
    /// The metrics, NaN where not defined.
    pub metrics: [f64; Metrics::COUNT],
    /// The number of events that count.
    pub events: u64,
    /// The run's digest.
    pub digest: Hash,
}

impl From<&ResultRow> for JournalEntry {
    fn from(row: &ResultRow) -> Self {
        Self {
            scenario_hash: row.scenario_hash,
            metrics: row.metrics,
            events: row.events,
            digest: row.digest,
        }
    }
}

/// First line of a journal.
pub(super) enum JournalHeader {
    /// The line was cut off while it was written: there are no runs yet.
    Torn,
    /// The number of seeds of each cell.
    Seeds(u64),
}

impl JournalHeader {
    /// Parses `line` as the header of the sweep whose header begins with `prefix`. Returns `None` for any other line.
    pub(super) fn parse(line: &[u8], prefix: &str) -> Option<Self> {
        let text = std::str::from_utf8(line).ok()?;
        let Some(text) = text.strip_suffix('\n') else {
            let seed_digits = text.strip_prefix(prefix).and_then(|suffix| suffix.strip_prefix(' '));
            let is_number = |digits: &str| digits.bytes().all(|byte| byte.is_ascii_digit());
            // A first line cut off anywhere, in the prefix or in the number, belongs to this sweep.
            let is_torn = prefix.starts_with(text) || seed_digits.is_some_and(is_number);
            return is_torn.then_some(Self::Torn);
        };
        let seeds = text.strip_prefix(prefix)?.strip_prefix(' ')?;
        seeds.parse().ok().map(Self::Seeds)
    }
}

/// Explains why a journal of `journal_seeds` seeds a cell cannot become one of `seeds`.
pub(super) fn too_many_seeds(journal_seeds: u64, seeds: u64) -> String {
    format!(
        "holds the runs of {} a cell, more than the requested {seeds}; use --seeds {journal_seeds} \
         or more, or choose another folder with --out",
        count_noun(journal_seeds, "seed")
    )
}

/// Returns the start of the first line; the number of seeds follows.
pub(super) fn header_prefix(identity: &str) -> String {
    format!("{MAGIC}{FORMAT} {identity}")
}

/// Explains why a journal that begins with `line` does not belong to this sweep.
pub(super) fn foreign_journal(line: &[u8]) -> String {
    let line = String::from_utf8_lossy(line);
    let format = line.strip_prefix(MAGIC);
    let format = format.and_then(|after_magic| after_magic.split_whitespace().next());
    match format {
        Some(FORMAT) => {
            "holds the runs of another experiment, shard or version of reveille (see experiment.toml there); \
             repeat its command to resume it, with the same first seed and at least as many seeds, or choose another \
             folder"
                .to_owned()
        }
        Some(format) if format.bytes().all(|byte| byte.is_ascii_digit()) => format!(
            "holds a runs.journal of format {format}, but this version of reveille resumes format {FORMAT} only; use \
             the version that began the sweep, or choose another folder"
        ),
        Some(_) | None => "holds a runs.journal with a damaged first line; choose another folder".to_owned(),
    }
}

/// Returns the line of a run, including its line break. [`parse_line`] is its inverse.
pub(super) fn encode_line(run_index: RunIndex, entry: &JournalEntry) -> String {
    let RunIndex { cell, seed } = run_index;
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

/// Parses the run of a line. Returns `None` if the line is torn or garbled, or the run is beyond `cells` or `seeds`.
pub(super) fn parse_line(line: &[u8], cells: u64, seeds: u64) -> Option<(RunIndex, JournalEntry)> {
    let (text, checksum) = std::str::from_utf8(line).ok()?.strip_suffix('\n')?.rsplit_once(' ')?;
    // `from_str_radix` also accepts a sign and fewer digits, which the format excludes.
    if checksum.len() != 8 || u32::from_str_radix(checksum, 16).ok()? != crc32fast::hash(text.as_bytes()) {
        return None;
    }
    let mut fields = text.split(' ');
    let run_index = RunIndex {
        cell: fields.next()?.parse().ok()?,
        seed: fields.next()?.parse().ok()?,
    };
    if u64::from(run_index.cell) >= cells || u64::from(run_index.seed) >= seeds {
        return None;
    }
    let scenario_hash = fields.next()?.parse().ok()?;
    let mut metrics = [f64::NAN; Metrics::COUNT];
    for metric in &mut metrics {
        match fields.next()? {
            "-" => {}
            number => *metric = number.parse().ok()?,
        }
    }
    let entry = JournalEntry {
        scenario_hash,
        metrics,
        events: fields.next()?.parse().ok()?,
        digest: fields.next()?.parse().ok()?,
    };
    fields.next().is_none().then_some((run_index, entry))
}

/// A store of finished runs, to which the threads of `executor` add. [`Journal`] is the only one.
pub trait RunStore: Send {
    /// The finished runs.
    fn runs(&self) -> &BTreeMap<RunIndex, JournalEntry>;

    /// Adds a finished run that took `device_ttis`; this number only counts towards the next sync. The store must not
    /// hold the run yet.
    ///
    /// # Errors
    /// If the run cannot be stored; earlier runs are kept.
    fn add(&mut self, run_index: RunIndex, entry: JournalEntry, device_ttis: u64) -> Result<(), SweepError>;

    /// Syncs everything, so that it survives a power cut.
    ///
    /// # Errors
    /// If the sync fails.
    fn sync(&mut self) -> Result<(), SweepError>;
}
