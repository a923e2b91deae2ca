//! The lines of a journal.

use reveille_common::score::Metrics;

use crate::table::{Hash, Row};

/// The first word of a journal.
const MAGIC: &str = "reveille-journal ";
/// The form of the journal.
const FORM: &str = "2";
/// Bytes that a first line has at the most.
pub(super) const LONGEST_HEAD: u64 = 1024;
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
    pub metrics: [f64; Metrics::COUNT],
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

/// What the first line of a journal says.
pub(super) enum Head {
    /// It was cut off while it was written: there are no runs yet.
    Torn,
    /// The journal is for so many seeds of each cell.
    Seeds(u64),
}

impl Head {
    /// The head in `line`, if it is one of the sweep called `name`.
    pub(super) fn of(line: &[u8], name: &str) -> Option<Self> {
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

/// Why a journal of `held` seeds a cell cannot be one of `seeds`.
pub(super) fn fewer(held: u64, seeds: u64) -> String {
    format!(
        "holds the runs of {held} seeds a cell, more than the {seeds} asked for: they can be raised, not lowered; \
         give --seeds {held} or more, or choose another folder by --out"
    )
}

/// How the first line of a journal begins; the number of seeds follows.
pub(super) fn name_of(identity: &str) -> String {
    format!("{MAGIC}{FORM} {identity}")
}

/// Why a journal that begins with `line` is none of this sweep.
pub(super) fn foreign(line: &[u8]) -> String {
    let line = String::from_utf8_lossy(line);
    let form = line.strip_prefix(MAGIC).and_then(|rest| rest.split_whitespace().next());
    match form {
        Some(FORM) => {
            "holds the runs of another experiment, shard or version of reveille (see experiment.toml there); \
             give the same command again to go on with it, with the same first seed and at least as many seeds, \
             or choose another folder"
                .to_owned()
        }
        Some(form) if form.bytes().all(|byte| byte.is_ascii_digit()) => format!(
            "holds a runs.journal of form {form}, but this version of reveille goes on with form {FORM} alone; go on \
             with the version that began the sweep, or choose another folder"
        ),
        Some(_) | None => {
            "holds a runs.journal that is none, or one with a damaged first line; choose another folder".to_owned()
        }
    }
}

/// The line of a run, with its end.
pub(super) fn line(job: Job, entry: &Entry) -> String {
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
pub(super) fn parse(line: &[u8], cells: u64, seeds: u64) -> Option<(Job, Entry)> {
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
    let mut metrics = [f64::NAN; Metrics::COUNT];
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
