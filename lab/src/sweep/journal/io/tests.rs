//! Journals that are cut off, garbled, of another sweep, or of fewer seeds.

use std::fs;

use reveille_common::score::Metrics;

use super::*;
use crate::table::Hash;

struct TempJournal(PathBuf);

impl TempJournal {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("reveille-journal-{}-{name}", std::process::id()));
        let _ = fs::remove_file(&path);
        Self(path)
    }

    fn open(&self) -> Journal {
        Journal::open(&self.0, "me", 3, 5).expect("usable")
    }
}

impl Drop for TempJournal {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

fn entry(number: u8) -> JournalEntry {
    let mut metrics = [f64::NAN; Metrics::COUNT];
    metrics[1] = f64::from(number) / 3.0;
    metrics[2] = 1e-300;
    JournalEntry {
        scenario_hash: Hash([number; 32]),
        metrics,
        events: u64::from(number),
        digest: Hash([!number; 32]),
    }
}

const JOBS: [RunIndex; 3] = [
    RunIndex { cell: 0, seed: 0 },
    RunIndex { cell: 2, seed: 4 },
    RunIndex { cell: 1, seed: 3 },
];

fn filled(name: &str) -> (TempJournal, Vec<u8>) {
    let place = TempJournal::new(name);
    let mut journal = place.open();
    for (job, number) in JOBS.into_iter().zip(7..) {
        journal.add(job, entry(number), 1).expect("written");
    }
    drop(journal);
    let bytes = fs::read(&place.0).expect("there");
    (place, bytes)
}

fn same(a: &JournalEntry, b: &JournalEntry) -> bool {
    encode_line(JOBS[0], a) == encode_line(JOBS[0], b) && a.metrics[1].to_bits() == b.metrics[1].to_bits()
}

#[test]
fn runs_are_found_again_bit_for_bit() {
    let (place, _) = filled("whole");
    let journal = place.open();
    assert_eq!((journal.runs().len(), journal.dropped_lines()), (3, 0));
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
        assert_eq!(journal.dropped_lines(), 0, "cut at {length}");
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
        assert_eq!((journal.runs().len(), journal.dropped_lines()), (2, 1), "byte {at}");
        let reason = Journal::open(&place.0, "me", 3, 5).expect_err("the new file is locked as well");
        assert!(reason.contains("another `reveille sweep`"), "{reason}");
        drop(journal);
        let mut journal = place.open();
        assert_eq!(
            (journal.runs().len(), journal.dropped_lines()),
            (2, 0),
            "byte {at}, again"
        );
        journal.add(JOBS[0], entry(7), 1).expect("written");
        drop(journal);
        assert_eq!(place.open().runs().len(), 3, "byte {at}, repaired");
    }
}

#[test]
fn seeds_are_raised_with_all_runs_and_never_lowered() {
    let (place, bytes) = filled("raised");
    // A truncated copy does no harm.
    fs::write(place.0.with_extension("part"), &bytes[..bytes.len() / 2]).expect("written");
    let journal = Journal::open(&place.0, "me", 3, 20).expect("more seeds");
    assert_eq!((journal.runs().len(), journal.dropped_lines()), (3, 0));
    let reason = Journal::open(&place.0, "me", 3, 20).expect_err("the new file is locked as well");
    assert!(reason.contains("another `reveille sweep`"), "{reason}");
    drop(journal);
    let raised = fs::read(&place.0).expect("there");
    let reason = Journal::open(&place.0, "me", 3, 19).expect_err("fewer seeds");
    assert!(
        reason.contains("20 seeds") && reason.contains("the requested 19"),
        "{reason}"
    );
    assert_eq!(fs::read(&place.0).expect("there"), raised, "untouched");
    let mut journal = Journal::open(&place.0, "me", 3, 20).expect("the same");
    journal
        .add(RunIndex { cell: 2, seed: 19 }, entry(1), 1)
        .expect("written");
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
            Some(_) => "a runs.journal of format 1, but this version of reveille resumes format 2",
            None => "damaged first line",
        };
        assert!(reason.contains(part), "{text}: {reason}");
        assert_eq!(fs::read_to_string(&place.0).expect("there"), text, "untouched");
    }
}
