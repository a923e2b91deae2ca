//! Tests of [`Journal::open`] and [`Journal::add`]: journals that are truncated, damaged, locked, of another sweep, or
//! of fewer seeds. Not checked: failed writes and the syncs; `tests/program/sweep.rs` fills a disk and kills a process.

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

    /// Opens the journal of the sweep `me`, which has 3 cells with 5 seeds each.
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

const RUNS: [RunIndex; 3] = [
    RunIndex { cell: 0, seed: 0 },
    RunIndex { cell: 2, seed: 4 },
    RunIndex { cell: 1, seed: 3 },
];

/// Returns a journal with [`RUNS`], of which the entries are `entry(7)` to `entry(9)`, and its bytes.
fn three_runs(name: &str) -> (TempJournal, Vec<u8>) {
    let file = TempJournal::new(name);
    let mut journal = file.open();
    for (run, number) in RUNS.into_iter().zip(7..) {
        journal.add(run, entry(number), 1).expect("written");
    }
    drop(journal);
    let bytes = fs::read(&file.0).expect("there");
    (file, bytes)
}

fn is_same_entry(a: &JournalEntry, b: &JournalEntry) -> bool {
    encode_line(RUNS[0], a) == encode_line(RUNS[0], b) && a.metrics[1].to_bits() == b.metrics[1].to_bits()
}

#[test]
fn runs_are_restored_bit_for_bit() {
    let (file, _) = three_runs("whole");
    let journal = file.open();
    assert_eq!((journal.runs().len(), journal.dropped_lines()), (3, 0));
    for (run, number) in RUNS.into_iter().zip(7..) {
        assert!(is_same_entry(&journal.runs()[&run], &entry(number)));
    }
}

#[test]
fn a_truncated_journal_loses_only_the_torn_line() {
    let (file, bytes) = three_runs("cut");
    let line_ends: Vec<usize> = (0..bytes.len())
        .filter(|&index| bytes[index] == b'\n')
        .map(|index| index + 1)
        .collect();
    for length in 0..=bytes.len() {
        fs::write(&file.0, &bytes[..length]).expect("written");
        let mut journal = file.open();
        let complete_lines = line_ends.iter().filter(|&&end| end <= length).count();
        // The first line is the header.
        assert_eq!(
            journal.runs().len(),
            complete_lines.saturating_sub(1),
            "truncated to {length} bytes"
        );
        journal.add(RUNS[2], entry(9), 1).expect("written");
        drop(journal);
        let journal = file.open();
        assert!(
            is_same_entry(&journal.runs()[&RUNS[2]], &entry(9)),
            "truncated to {length} bytes"
        );
        assert_eq!(journal.dropped_lines(), 0, "truncated to {length} bytes");
    }
}

#[test]
fn only_a_damaged_line_is_dropped() {
    let (file, bytes) = three_runs("damaged");
    let first_run = bytes.iter().position(|&byte| byte == b'\n').expect("a line") + 1;
    let second_run = first_run
        + bytes[first_run..]
            .iter()
            .position(|&byte| byte == b'\n')
            .expect("a line")
        + 1;
    for index in (first_run..second_run - 1).step_by(3) {
        let mut damaged = bytes.clone();
        damaged[index] ^= 1;
        fs::write(&file.0, &damaged).expect("written");
        let journal = file.open();
        assert_eq!((journal.runs().len(), journal.dropped_lines()), (2, 1), "byte {index}");
        let message = Journal::open(&file.0, "me", 3, 5).expect_err("the new file is locked as well");
        assert!(message.contains("another `reveille sweep`"), "{message}");
        drop(journal);
        let mut journal = file.open();
        assert_eq!(
            (journal.runs().len(), journal.dropped_lines()),
            (2, 0),
            "byte {index}, again"
        );
        journal.add(RUNS[0], entry(7), 1).expect("written");
        drop(journal);
        assert_eq!(file.open().runs().len(), 3, "byte {index}, repaired");
    }
}

#[test]
fn raised_seeds_keep_all_runs_and_lowered_seeds_are_refused() {
    let (file, bytes) = three_runs("raised");
    // A temporary file that a killed process has left: NAME.part, since the name has no extension to replace.
    fs::write(file.0.with_extension("part"), &bytes[..bytes.len() / 2]).expect("written");
    let journal = Journal::open(&file.0, "me", 3, 20).expect("more seeds");
    assert_eq!((journal.runs().len(), journal.dropped_lines()), (3, 0));
    let message = Journal::open(&file.0, "me", 3, 20).expect_err("the new file is locked as well");
    assert!(message.contains("another `reveille sweep`"), "{message}");
    drop(journal);
    let raised = fs::read(&file.0).expect("there");
    let message = Journal::open(&file.0, "me", 3, 19).expect_err("fewer seeds");
    assert!(
        message.contains("20 seeds") && message.contains("the requested 19"),
        "{message}"
    );
    assert_eq!(fs::read(&file.0).expect("there"), raised, "untouched");
    let mut journal = Journal::open(&file.0, "me", 3, 20).expect("the same");
    journal
        .add(RunIndex { cell: 2, seed: 19 }, entry(1), 1)
        .expect("written");
    drop(journal);
    assert_eq!(Journal::open(&file.0, "me", 3, 20).expect("the same").runs().len(), 4);
}

#[test]
fn another_sweep_and_a_second_process_are_refused() {
    let (file, _) = three_runs("refused");
    let first = file.open();
    let message = Journal::open(&file.0, "me", 3, 5).expect_err("locked");
    assert!(message.contains("another `reveille sweep`"), "{message}");
    drop(first);
    let message = Journal::open(&file.0, "you", 3, 5).expect_err("another");
    assert!(message.contains("another experiment"), "{message}");
    // The texts repeat `FORMAT`, which is 4.
    for text in [
        "letters\n",
        "my precious notes",
        "reveille-journal 4 you",
        "reveille-journal 4 me too",
        "reveille-journal 4 me 5 6\n",
        "reveille-journal 4 me\n",
        "reveille-journal 1 me 5\n",
        "r\n",
    ] {
        fs::write(&file.0, text).expect("written");
        let message = Journal::open(&file.0, "me", 3, 5).expect_err("no journal");
        let cause = match text.strip_prefix("reveille-journal ").map(|format| &format[..1]) {
            Some("4") => "another experiment",
            Some(_) => "a runs.journal of format 1, but this version of reveille resumes format 4",
            None => "damaged first line",
        };
        assert!(message.contains(cause), "{text}: {message}");
        assert_eq!(fs::read_to_string(&file.0).expect("there"), text, "untouched");
    }
}
