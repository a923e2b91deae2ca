//! Fuzzes the readers of sweep journals and tables, trajectories, recordings, resume marks and input logs. A file is
//! read or refused with an error; no content panics.
//!
//! The first byte selects the kind. Files that are read by path are in memory.

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

/// Returns the path of an in-memory file that only this process uses.
fn path(name: &str) -> PathBuf {
    Path::new("/dev/shm").join(format!("reveille-fuzz-{}-{name}", process::id()))
}

fn put(name: &str, bytes: &[u8]) -> PathBuf {
    let path = path(name);
    fs::write(&path, bytes).expect("memory to write to");
    path
}

/// Checks that a readable table survives a write and a second read unchanged.
fn table(name: &str, format: Format, bytes: &[u8]) {
    match Table::read(&put(name, bytes)) {
        Ok(table) => {
            let again = path(&format!("again-{name}"));
            table.write(&again, format).expect("a read table can be written");
            let again = Table::read(&again).expect("a written table can be read");
            assert_eq!(again.rows.len(), table.rows.len());
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

/// Checks that a journal keeps its complete lines and permanently drops the rest.
fn journal(lines: &[u8]) {
    let path = path("runs.journal");
    let _gone = fs::remove_file(&path);
    drop(Journal::open(&path, "sweep", 4, 8).expect("a new journal"));
    let mut bytes = fs::read(&path).expect("its first line");
    bytes.extend_from_slice(lines);
    fs::write(&path, bytes).expect("memory to write to");
    if let Ok(opened) = Journal::open(&path, "sweep", 4, 8) {
        // Compare debug output, since NaN differs from itself.
        let kept = format!("{:?}", opened.runs());
        drop(opened);
        let again = Journal::open(&path, "sweep", 4, 8).expect("the journal was repaired");
        assert_eq!((again.dropped_lines(), format!("{:?}", again.runs())), (0, kept));
    }
}

/// Reads a recording to its end or to the point where it is truncated.
fn recording(bytes: &[u8]) {
    let mut reader = match RecordingReader::open(Cursor::new(bytes)) {
        Ok(reader) => reader,
        Err(error) => {
            assert!(!error.to_string().trim().is_empty());
            return;
        }
    };
    let mut replay = reader
        .bundle()
        .load()
        .ok()
        .filter(|scenario| scenario.run.devices <= 64)
        .map(|s| Reconstruction::new(&s));
    let mut fits = true;
    while let Ok(Some(frame)) = reader.next_frame() {
        if let Some(replay) = replay.as_mut().filter(|_| fits) {
            fits = replay.apply(&frame).is_ok();
        }
    }
}

fn scenario() -> &'static Scenario {
    static SCENARIO: OnceLock<Scenario> = OnceLock::new();
    SCENARIO.get_or_init(|| load("quick", &[]).expect("a preset").scenario)
}

/// Checks that a readable resume mark is written unchanged and does not match another run.
fn mark(text: &str) {
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

/// Checks that a readable input log is written unchanged and that a run accepts its inputs.
fn log(text: &str) {
    match external_inputs::parse(text, scenario()) {
        Ok(all) => {
            let lines: String = all.iter().map(|input| external_inputs::line(&input)).collect();
            let again = external_inputs::parse(&(external_inputs::first_line(scenario()) + &lines), scenario());
            assert_eq!(again.expect("written text can be read"), all);
            for outage in all.outages {
                assert!(outage.is_valid(scenario().run.devices) && outage.tti.0 < scenario().run.ttis);
            }
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((choice, rest)) = data.split_first() else {
        return;
    };
    match choice % 7 {
        0 => journal(rest),
        1 => {
            // Table, then its sidecar.
            let cut = rest.iter().position(|byte| *byte == 0).unwrap_or(rest.len());
            let (rows, about) = rest.split_at(cut);
            put("results.csv.toml", about.get(1..).unwrap_or_default());
            table("results.csv", Format::Csv, rows);
        }
        2 => table("results.parquet", Format::Parquet, rest),
        3 => {
            if let Err(error) = Trajectories::read(&put("trajectories.parquet", rest)) {
                assert!(!error.to_string().trim().is_empty());
            }
        }
        4 => mark(&String::from_utf8_lossy(rest)),
        5 => {
            // With and without the first line, which names the run.
            let text = String::from_utf8_lossy(rest);
            log(&text);
            log(&(external_inputs::first_line(scenario()) + &text));
        }
        _ => recording(rest),
    }
});
