//! Whatever is in the files that programs leave: journals and tables of sweeps, trajectories, recordings, marks and
//! logs of inputs of runs. They are refused in words or read, and nothing in them brings the reader down.
//!
//! The first byte chooses the kind. Files that are read by path lie in memory.

#![no_main]

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::{fs, process};

use libfuzzer_sys::fuzz_target;
use reveille_bs::scenario::load;
use reveille_common::scenario::Scenario;
use reveille_lab::inputs;
use reveille_lab::mark::Mark;
use reveille_lab::sweep::journal::{Journal, Keeper as _};
use reveille_lab::table::{Format, Table};
use reveille_lab::trajectories;
use reveille_view::recording::Reader;
use reveille_view::replay::Replay;

/// A file in memory for this process alone.
fn path(name: &str) -> PathBuf {
    Path::new("/dev/shm").join(format!("reveille-fuzz-{}-{name}", process::id()))
}

fn put(name: &str, bytes: &[u8]) -> PathBuf {
    let path = path(name);
    fs::write(&path, bytes).expect("memory to write to");
    path
}

/// A table that is read is written and read again as the same.
fn table(name: &str, format: Format, bytes: &[u8]) {
    match Table::read(&put(name, bytes)) {
        Ok(table) => {
            let again = path(&format!("again-{name}"));
            table.write(&again, format).expect("what was read is written");
            let again = Table::read(&again).expect("what was written is read");
            assert_eq!(again.rows.len(), table.rows.len());
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

/// A journal's whole lines are kept, the rest is taken out once and for all.
fn journal(lines: &[u8]) {
    let path = path("runs.journal");
    let _gone = fs::remove_file(&path);
    drop(Journal::open(&path, "sweep", 4, 8).expect("a new journal"));
    let mut bytes = fs::read(&path).expect("its first line");
    bytes.extend_from_slice(lines);
    fs::write(&path, bytes).expect("memory to write to");
    if let Ok(opened) = Journal::open(&path, "sweep", 4, 8) {
        // NaN is no equal to itself, and is shown like itself.
        let kept = format!("{:?}", opened.runs());
        drop(opened);
        let again = Journal::open(&path, "sweep", 4, 8).expect("it was mended");
        assert_eq!((again.dropped(), format!("{:?}", again.runs())), (0, kept));
    }
}

/// A recording is gone through to its end or to where it is torn.
fn recording(bytes: &[u8]) {
    let mut reader = match Reader::open(Cursor::new(bytes)) {
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
        .filter(|scenario| scenario.devices <= 64)
        .map(|s| Replay::new(&s));
    let mut fits = true;
    while let Ok(Some(frame)) = reader.next_frame() {
        if let Some(replay) = replay.as_mut().filter(|_| fits) {
            fits = replay.take(&frame).is_ok();
        }
    }
}

fn scenario() -> &'static Scenario {
    static SCENARIO: OnceLock<Scenario> = OnceLock::new();
    SCENARIO.get_or_init(|| load("quick", &[]).expect("a preset"))
}

/// A mark that is read is written as the same, and another run is none that comes by it.
fn mark(text: &str) {
    match Mark::parse(text, scenario()) {
        Ok(mark) => {
            assert_eq!(Mark::parse(&mark.text(), scenario()).expect("what was written"), mark);
            assert!(mark.window > 0 && mark.tti <= scenario().ttis);
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

/// Inputs that are read are written as the same, and a run can have them.
fn log(text: &str) {
    match inputs::parse(text, scenario()) {
        Ok(all) => {
            let lines: String = all.iter().map(|input| inputs::line(&input)).collect();
            let again = inputs::parse(&(inputs::first_line(scenario()) + &lines), scenario());
            assert_eq!(again.expect("what was written"), all);
            for outage in all.outages {
                assert!(outage.is_sound(scenario().devices) && outage.tti.0 < scenario().ttis);
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
            // The table, and what it says of itself.
            let cut = rest.iter().position(|byte| *byte == 0).unwrap_or(rest.len());
            let (rows, about) = rest.split_at(cut);
            put("results.csv.toml", about.get(1..).unwrap_or_default());
            table("results.csv", Format::Csv, rows);
        }
        2 => table("results.parquet", Format::Parquet, rest),
        3 => {
            if let Err(error) = trajectories::read(&put("trajectories.parquet", rest)) {
                assert!(!error.to_string().trim().is_empty());
            }
        }
        4 => mark(&String::from_utf8_lossy(rest)),
        5 => {
            // Behind the line that names the run, or for itself.
            let text = String::from_utf8_lossy(rest);
            log(&text);
            log(&(inputs::first_line(scenario()) + &text));
        }
        _ => recording(rest),
    }
});
