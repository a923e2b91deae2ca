//! Tests of [`RecordingWriter`], [`RecordingReader`] and [`Reconstruction`]. Recordings are compared with the recorded
//! frames, also when truncated, damaged or read from a TTI on. Reconstructions are compared with the outcomes of runs
//! in memory without actions and lost devices, which `tests/tests/actions.rs` and `device_removal.rs` have. The thread
//! of [`Recorder`] is tested with the program, in `tests/program/recording.rs`.
//!
//! Minimum numbers of frames are not requirements: they show that the tested case occurs.

use std::io::Cursor;

use proptest::prelude::*;
use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::codec;
use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message, MessageKind};
use reveille_common::score::FinalScore;
use reveille_common::units::Energy;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

use super::*;
use crate::device_mirror::Discrepancy;
use crate::reconstruction::Reconstruction;

/// Loads the preset `paper` with `fields`, each of the form `field=value`.
fn scenario_with(fields: &[&str]) -> Scenario {
    let overrides: Vec<Override> = fields
        .iter()
        .map(|field| Override::parse(field).expect("an override"))
        .collect();
    load("paper", &overrides).expect("a scenario").scenario
}

/// Returns frames and outcome of a run of `scenario`, with states every `states_every` TTIs.
fn run_with_frames(scenario: &Scenario, lookahead: bool, states_every: u64) -> (Vec<Frame>, RunOutcome) {
    let mut frames = Vec::new();
    let options = RunOptions { lookahead, window: 70 };
    let outcome =
        Run::new(&prepare(scenario), options).finish(&mut FrameObserver::new(states_every, |frame| frames.push(frame)));
    (frames, outcome)
}

fn reconstruct(scenario: &Scenario, frames: &[Frame]) -> Result<FinalScore, Discrepancy> {
    let mut reconstruction = Reconstruction::new(scenario);
    frames.iter().try_for_each(|frame| reconstruction.apply(frame))?;
    Ok(reconstruction.finish())
}

/// Returns a short scenario and the frames of its run.
fn small_run() -> (Scenario, Vec<Frame>) {
    let scenario = scenario_with(&["devices=40", "ttis=400", "policy.name=knn", "events.alpha=0.4"]);
    let (frames, _) = run_with_frames(&scenario, true, 50);
    (scenario, frames)
}

/// Returns a recording that is flushed every 100 frames.
fn write_recording(scenario: &Scenario, frames: &[Frame], summary: Option<&str>) -> Vec<u8> {
    let bundle = ScenarioBundle {
        text: scenario.to_toml(),
        referenced_files: vec![("scenario-files/x.csv".to_owned(), vec![1, 2, 3])],
    };
    let mut writer = RecordingWriter::begin(Cursor::new(Vec::new()), "r1", &bundle).expect("begun");
    for (index, frame) in frames.iter().enumerate() {
        writer.write(frame).expect("written");
        if index % 100 == 99 {
            writer.flush().expect("flushed");
        }
    }
    writer.finish(summary).expect("finished").into_inner()
}

/// Returns the frames of a recording, and the result at its end.
fn read_recording(bytes: &[u8]) -> (Vec<Frame>, Result<(), RecordingError>) {
    let mut reader = match RecordingReader::open(Cursor::new(bytes)) {
        Ok(reader) => reader,
        Err(error) => return (Vec::new(), Err(error)),
    };
    let mut frames = Vec::new();
    loop {
        match reader.next_frame() {
            Ok(Some(frame)) => frames.push(frame),
            Ok(None) => return (frames, Ok(())),
            Err(error) => return (frames, Err(error)),
        }
    }
}

#[test]
fn a_reconstruction_has_the_metrics_and_digest_of_the_run() {
    for policy in ["random", "adjusted", "knn", "q-learning", "age-index", "dt", "genie"] {
        for (n, e_b, kind) in [(12, "0.5", "range"), (90, "5", "range"), (60, "5", "probabilistic")] {
            let name = format!("policy.name={policy}");
            let scenario = scenario_with(&[
                &name,
                &format!("devices={n}"),
                &format!("harvest.e_b={e_b}"),
                &format!("sensing.kind={kind}"),
                "ttis=600",
                "bs.sync_interval=9",
            ]);
            for lookahead in [true, false] {
                let (frames, outcome) = run_with_frames(&scenario, lookahead, 13);
                let score = reconstruct(&scenario, &frames).expect("consistent frames");
                assert_eq!(score.digest, outcome.digest, "{policy}, {n} devices, {kind}");
                assert_eq!(format!("{:?}", score.metrics), format!("{:?}", outcome.metrics));
                assert_eq!((score.totals, score.devices), (outcome.totals, outcome.devices));
                let states = frames.iter().filter(|frame| frame.kind == MessageKind::States).count();
                assert!(states > 20, "only {states} frames of states");
            }
        }
    }
}

#[test]
fn a_reconstruction_detects_missing_and_changed_frames() {
    let (scenario, frames) = small_run();
    assert!(reconstruct(&scenario, &frames).is_ok());
    let mut detected = 0;
    for index in 0..frames.len() {
        let mut remaining = frames.clone();
        let removed = remaining.remove(index);
        // Later frames do not depend on states, on a repeated plan or on the last frames of a run.
        let is_needed = !matches!(removed.kind, MessageKind::States | MessageKind::Plan);
        if is_needed && removed.tti.0 < 380 {
            let discrepancy = reconstruct(&scenario, &remaining).expect_err(removed.kind.name());
            assert!(discrepancy.tti >= removed.tti, "{discrepancy}");
            detected += 1;
        }
    }
    assert!(detected > 200, "only {detected} missing frames detected");
    for (index, frame) in frames.iter().enumerate() {
        let Ok(Message::Report(mut report)) = frame.message() else {
            continue;
        };
        report.battery += Energy::from_micro(1);
        let mut changed = frames.clone();
        changed[index].payload = codec::encode(&report);
        let discrepancy = reconstruct(&scenario, &changed).expect_err("a changed report");
        assert_eq!(discrepancy.tti, frame.tti);
    }
}

#[test]
fn a_recording_round_trips() {
    let (scenario, frames) = small_run();
    let bytes = write_recording(&scenario, &frames, Some("{}"));
    let (read_frames, end) = read_recording(&bytes);
    assert!(end.is_ok() && read_frames == frames);
    let reader = RecordingReader::open(Cursor::new(&bytes)).expect("a recording");
    assert_eq!((reader.run(), reader.summary()), ("r1", Some("{}")));
    assert_eq!(reader.len(), Some(frames.len() as u64));
    assert_eq!(
        reader.bundle().referenced_files,
        [("scenario-files/x.csv".to_owned(), vec![1, 2, 3])]
    );
    assert_eq!(
        reader.bundle().load().expect("a scenario").hash_hex(),
        scenario.hash_hex()
    );
    // Measured with a margin: more bytes per frame show that compression fails.
    assert!(
        bytes.len() < frames.len() * 120,
        "{} bytes, {} frames",
        bytes.len(),
        frames.len()
    );
}

#[test]
fn a_recording_is_read_from_the_requested_tti() {
    let (scenario, frames) = small_run();
    let complete = write_recording(&scenario, &frames, None);
    // Truncated by any bytes of its end, the recording lacks its index.
    for bytes in [&complete[..], &complete[..complete.len() - 900]] {
        for tti in [0, 1, 57, 200, 399, 400, 100_000] {
            let mut reader = RecordingReader::open(Cursor::new(bytes)).expect("a recording");
            reader.seek(Tti(tti)).expect("found");
            let mut read = Vec::new();
            while let Ok(Some(frame)) = reader.next_frame() {
                read.push(frame);
            }
            let expected: Vec<Frame> = frames.iter().filter(|frame| frame.tti.0 >= tti).cloned().collect();
            assert!(expected.starts_with(&read), "TTI {tti}");
            assert!(
                bytes.len() < complete.len() || read.len() == expected.len(),
                "TTI {tti}"
            );
        }
    }
}

#[test]
fn an_invalid_recording_is_refused_with_the_reason() {
    let error_of = |bytes: &[u8]| read_recording(bytes).1.expect_err("refused").to_string();
    assert!(error_of(b"").contains("truncated") || error_of(b"").contains("not a recording"));
    assert!(error_of(b"text").contains("not an MCAP file"));
    assert!(error_of(b"this is a text, and not a short one").contains("not an MCAP file"));
    let empty = mcap::Writer::new(Cursor::new(Vec::new())).and_then(|mut writer| {
        writer.finish()?;
        Ok(writer.into_inner().into_inner())
    });
    assert!(error_of(&empty.expect("a container")).contains("not recorded by reveille"));
    let (scenario, frames) = small_run();
    let mut newer_version = write_recording(&scenario, &frames[..3], None);
    // The key, and the length of the value that follows.
    let key = b"recording\x01\x00\x00\x00";
    let key_start = newer_version
        .windows(key.len())
        .position(|window| window == key)
        .expect("a version");
    newer_version[key_start + key.len()] = b'9';
    let message = error_of(&newer_version);
    assert!(
        message.contains("version 9") && message.contains(&format!("reads version {VERSION}")),
        "{message}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(50))]

    #[test]
    fn a_truncated_recording_is_read_up_to_its_end(kept_share in 0.0..1.0_f64) {
        let (scenario, frames) = small_run();
        let bytes = write_recording(&scenario, &frames, Some("{}"));
        let kept_bytes = (kept_share * bytes.len() as f64) as usize;
        let (read, end) = read_recording(&bytes[..kept_bytes]);
        prop_assert!(frames.starts_with(&read));
        if read.len() < frames.len() {
            let message = end.expect_err("missing frames").to_string();
            prop_assert!(message.contains("truncated") || message.contains("not a recording"), "{}", message);
        }
        // Chunks hold about a hundred frames, so at most the last chunk is lost.
        let bytes_of_first = |count: usize| write_recording(&scenario, &frames[..count], None).len();
        if read.len() + 200 < frames.len() {
            let next_bytes = bytes_of_first(read.len() + 200);
            prop_assert!(kept_bytes < next_bytes, "{} frames of {} bytes", read.len(), kept_bytes);
        }
    }

    #[test]
    fn a_damaged_recording_returns_no_other_frames(place in 0.0..1.0_f64, bit in 0..8_u32) {
        let (scenario, frames) = small_run();
        let mut bytes = write_recording(&scenario, &frames, Some("{}"));
        let index = (place * bytes.len() as f64) as usize;
        bytes[index] ^= 1 << bit;
        let (read, _) = read_recording(&bytes);
        prop_assert!(frames.starts_with(&read));
    }
}

/// The format requires a reader to skip unknown records. A damaged record of a known kind must not be skipped silently.
#[test]
fn a_chunk_with_a_damaged_opcode_is_reported() {
    let (scenario, frames) = small_run();
    let bytes = write_recording(&scenario, &frames, Some("{}"));
    let summary = mcap::Summary::read(&bytes).expect("a container").expect("a summary");
    let chunk_starts: Vec<usize> = summary
        .chunk_indexes
        .iter()
        // The first chunk has channels and no messages.
        .filter(|chunk| !chunk.message_index_offsets.is_empty())
        .map(|chunk| chunk.chunk_start_offset as usize)
        .collect();
    assert!(chunk_starts.len() > 5);
    for start in chunk_starts {
        let mut damaged = bytes.clone();
        // An opcode of no known record.
        damaged[start] = 0x7f;
        let (read, end) = read_recording(&damaged);
        assert!(
            read.len() < frames.len() && frames.starts_with(&read),
            "chunk at byte {start}"
        );
        let message = end.expect_err("missing frames").to_string();
        assert!(
            message.contains("messages are missing"),
            "chunk at byte {start}: {message}"
        );
    }
}
