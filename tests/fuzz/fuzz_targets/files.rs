//! Fuzzes the readers of sweep journals and tables, trajectories, recordings, resume marks and input logs. A file is
//! read or refused with an error; no content panics.
//!
//! The first byte modulo 7 selects: 0 a journal, 1 a CSV table, a zero byte and its sidecar, 2 a Parquet table, 3
//! trajectories, 4 a resume mark, 5 an input log, 6 a recording. Files that are read by path are in memory, in
//! `/dev/shm`. Marks and logs belong to the preset `quick`. tests/fuzz/README.md shows how to run the target.

#![no_main]

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::{fs, process};

use libfuzzer_sys::fuzz_target;
use reveille_bs::scenario::{Scenario, load};
use reveille_lab::external_inputs;
use reveille_lab::resume_mark::ResumeMark;
use reveille_lab::sweep::journal::{Journal, RunStore as _};
use reveille_lab::table::{Format, Table};
use reveille_lab::trajectories::Trajectories;
use reveille_view::reconstruction::Reconstruction;
use reveille_view::recording::RecordingReader;

/// Identity of the sweep whose journal is fuzzed.
const SWEEP_IDENTITY: &str = "sweep";
/// Cells of the sweep.
const CELLS: u64 = 4;
/// Seeds of each cell.
const SEEDS: u64 = 8;

/// Returns the path of an in-memory file that only this process uses.
fn memory_path(name: &str) -> PathBuf {
    Path::new("/dev/shm").join(format!("reveille-fuzz-{}-{name}", process::id()))
}

fn write_in_memory(name: &str, bytes: &[u8]) -> PathBuf {
    let path = memory_path(name);
    fs::write(&path, bytes).expect("memory to write to");
    path
}

/// Checks that a readable table keeps the number of its rows in a write and a second read.
fn check_table(name: &str, format: Format, bytes: &[u8]) {
    match Table::read(&write_in_memory(name, bytes)) {
        Ok(table) => {
            let copy_path = memory_path(&format!("again-{name}"));
            table.write(&copy_path, format).expect("a read table can be written");
            let copy = Table::read(&copy_path).expect("a written table can be read");
            assert_eq!(copy.rows.len(), table.rows.len());
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

/// Checks that a readable journal is repaired when it is opened: a second opening drops no line and finds the same
/// runs.
fn check_journal(lines: &[u8]) {
    let path = memory_path("runs.journal");
    // The file is left over from the previous input, except for the first one.
    let _result = fs::remove_file(&path);
    drop(Journal::open(&path, SWEEP_IDENTITY, CELLS, SEEDS).expect("a new journal"));
    let mut bytes = fs::read(&path).expect("its first line");
    bytes.extend_from_slice(lines);
    fs::write(&path, bytes).expect("memory to write to");
    if let Ok(opened) = Journal::open(&path, SWEEP_IDENTITY, CELLS, SEEDS) {
        // Compare debug output, since NaN differs from itself.
        let kept = format!("{:?}", opened.runs());
        drop(opened);
        let reopened = Journal::open(&path, SWEEP_IDENTITY, CELLS, SEEDS).expect("the journal was repaired");
        assert_eq!((reopened.dropped_lines(), format!("{:?}", reopened.runs())), (0, kept));
    }
}

/// Reads a recording to its end or to the point where it is truncated. Reconstructs the run up to the first frame that
/// does not fit.
fn check_recording(bytes: &[u8]) {
    let mut reader = match RecordingReader::open(Cursor::new(bytes)) {
        Ok(reader) => reader,
        Err(error) => {
            assert!(!error.to_string().trim().is_empty());
            return;
        }
    };
    let mut reconstruction = reader
        .bundle()
        .load()
        .ok()
        // A larger scenario would make the input slow.
        .filter(|scenario| scenario.run.devices <= 64)
        .map(|scenario| Reconstruction::new(&scenario));
    let mut fits_so_far = true;
    while let Ok(Some(frame)) = reader.next_frame() {
        if let Some(reconstruction) = reconstruction.as_mut().filter(|_| fits_so_far) {
            fits_so_far = reconstruction.apply(&frame).is_ok();
        }
    }
}

fn scenario() -> &'static Scenario {
    static SCENARIO: OnceLock<Scenario> = OnceLock::new();
    SCENARIO.get_or_init(|| load("quick", &[]).expect("a preset").scenario)
}

/// Checks that a readable resume mark lies within the run and is equal after writing and reading.
fn check_mark(text: &str) {
    match ResumeMark::parse(text, scenario()) {
        Ok(mark) => {
            assert_eq!(
                ResumeMark::parse(&mark.text(), scenario()).expect("written text can be read"),
                mark
            );
            assert!(mark.window > 0 && mark.tti <= scenario().run.ttis);
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

/// Checks that the inputs of a readable log are equal after writing and reading, and that removals lie within the run.
fn check_input_log(text: &str) {
    match external_inputs::parse(text, scenario()) {
        Ok(inputs) => {
            let lines: String = inputs.iter().map(|input| external_inputs::input_line(&input)).collect();
            let reread = external_inputs::parse(&(external_inputs::first_line(scenario()) + &lines), scenario());
            assert_eq!(reread.expect("written text can be read"), inputs);
            for removal in inputs.removals {
                assert!(removal.is_valid(scenario().run.devices) && removal.tti.0 < scenario().run.ttis);
            }
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((selector, content)) = data.split_first() else {
        return;
    };
    match selector % 7 {
        0 => check_journal(content),
        1 => {
            // The sidecar of a CSV file has its name with `.toml` after it.
            let table_end = content.iter().position(|byte| *byte == 0).unwrap_or(content.len());
            let (rows, sidecar) = content.split_at(table_end);
            write_in_memory("results.csv.toml", sidecar.get(1..).unwrap_or_default());
            check_table("results.csv", Format::Csv, rows);
        }
        2 => check_table("results.parquet", Format::Parquet, content),
        3 => {
            if let Err(error) = Trajectories::read(&write_in_memory("trajectories.parquet", content)) {
                assert!(!error.to_string().trim().is_empty());
            }
        }
        4 => check_mark(&String::from_utf8_lossy(content)),
        5 => {
            // With and without the first line, which names the run.
            let text = String::from_utf8_lossy(content);
            check_input_log(&text);
            check_input_log(&(external_inputs::first_line(scenario()) + &text));
        }
        _ => check_recording(content),
    }
});
