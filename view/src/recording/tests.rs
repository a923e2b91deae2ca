//! Recordings read back whole, torn or from a TTI on, with the outcome of their runs.

use std::io::Cursor;

use proptest::prelude::*;
use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::{Override, Scenario, load};
use reveille_common::codec;
use reveille_common::ids::Tti;
use reveille_common::message::{Frame, Message, MessageKind};
use reveille_common::units::Energy;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

use super::*;
use crate::device_mirror::Discrepancy;
use crate::reconstruction::Reconstruction;

fn scenario(set: &[&str]) -> Scenario {
    let set: Vec<Override> = set
        .iter()
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    load("paper", &set).expect("a scenario").scenario
}

/// Frames and outcome of a run of `scenario`, with states every `states_every` TTIs.
fn record(scenario: &Scenario, lookahead: bool, states_every: u64) -> (Vec<Frame>, RunOutcome) {
    let mut frames = Vec::new();
    let options = RunOptions { lookahead, window: 70 };
    let outcome =
        Run::new(&prepare(scenario), options).finish(&mut FrameObserver::new(states_every, |frame| frames.push(frame)));
    (frames, outcome)
}

fn replayed(scenario: &Scenario, frames: &[Frame]) -> Result<reveille_common::score::FinalScore, Discrepancy> {
    let mut replay = Reconstruction::new(scenario);
    frames.iter().try_for_each(|frame| replay.apply(frame))?;
    Ok(replay.finish())
}

fn small() -> (Scenario, Vec<Frame>) {
    let scenario = scenario(&["devices=40", "ttis=400", "policy.name=knn", "events.alpha=0.4"]);
    let (frames, _) = record(&scenario, true, 50);
    (scenario, frames)
}

fn recorded(scenario: &Scenario, frames: &[Frame], summary: Option<&str>) -> Vec<u8> {
    let bundle = ScenarioBundle {
        text: scenario.to_toml(),
        referenced_files: vec![("scenario-files/x.csv".to_owned(), vec![1, 2, 3])],
    };
    let mut writer = RecordingWriter::begin(Cursor::new(Vec::new()), "r1", &bundle).expect("begun");
    for (nth, frame) in frames.iter().enumerate() {
        writer.write(frame).expect("written");
        if nth % 100 == 99 {
            writer.flush().expect("flushed");
        }
    }
    writer.finish(summary).expect("finished").into_inner()
}

/// Frames of a recording, and the result at its end.
fn read(bytes: &[u8]) -> (Vec<Frame>, Result<(), RecordingError>) {
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
fn metrics_and_digest_follow_from_the_messages() {
    for policy in ["random", "adjusted", "knn", "q-learning", "age-index", "dt", "genie"] {
        for (n, harvest, kind) in [(12, "0.5", "range"), (90, "5", "range"), (60, "5", "probabilistic")] {
            let name = format!("policy.name={policy}");
            let (n, harvest, kind) = (
                format!("devices={n}"),
                format!("harvest.e_b={harvest}"),
                format!("sensing.kind={kind}"),
            );
            let scenario = scenario(&[&name, &n, &harvest, &kind, "ttis=600", "bs.sync_interval=9"]);
            for lookahead in [true, false] {
                let (frames, outcome) = record(&scenario, lookahead, 13);
                let own = replayed(&scenario, &frames).expect("it fits");
                assert_eq!(own.digest, outcome.digest, "{policy}, {n}, {kind}");
                assert_eq!(format!("{:?}", own.metrics), format!("{:?}", outcome.metrics));
                assert_eq!((own.totals, own.devices), (outcome.totals, outcome.devices));
                let states = frames.iter().filter(|frame| frame.kind == MessageKind::States).count();
                assert!(states > 20, "{states}");
            }
        }
    }
}

#[test]
fn a_frame_that_is_missing_or_changed_is_found() {
    let (scenario, frames) = small();
    assert!(replayed(&scenario, &frames).is_ok());
    let mut found = 0;
    for at in 0..frames.len() {
        let mut without = frames.clone();
        let gone = without.remove(at);
        // Later frames do not depend on states, on a repeated plan or on the last frames of a run.
        let is_needed = !matches!(gone.kind, MessageKind::States | MessageKind::Plan);
        if is_needed && gone.tti.0 < 380 {
            let refused = replayed(&scenario, &without).expect_err(gone.kind.name());
            assert!(refused.tti >= gone.tti, "{refused}");
            found += 1;
        }
    }
    assert!(found > 200, "{found}");
    for (at, frame) in frames.iter().enumerate() {
        let Ok(Message::Report(mut report)) = frame.message() else {
            continue;
        };
        report.battery += Energy::from_micro(1);
        let mut changed = frames.clone();
        changed[at].payload = codec::encode(&report);
        let refused = replayed(&scenario, &changed).expect_err("a changed report");
        assert_eq!(refused.tti, frame.tti);
    }
}

#[test]
fn a_recording_holds_everything() {
    let (scenario, frames) = small();
    let bytes = recorded(&scenario, &frames, Some("{}"));
    let (read, end) = read(&bytes);
    assert!(end.is_ok() && read == frames);
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
    assert!(
        bytes.len() < frames.len() * 110,
        "{} bytes, {} frames",
        bytes.len(),
        frames.len()
    );
}

#[test]
fn a_recording_is_read_from_a_tti_on() {
    let (scenario, frames) = small();
    let whole = recorded(&scenario, &frames, None);
    for bytes in [&whole[..], &whole[..whole.len() - 900]] {
        for tti in [0, 1, 57, 200, 399, 400, 100_000] {
            let mut reader = RecordingReader::open(Cursor::new(bytes)).expect("a recording");
            reader.seek(Tti(tti)).expect("found");
            let mut own = Vec::new();
            while let Ok(Some(frame)) = reader.next_frame() {
                own.push(frame);
            }
            let later: Vec<Frame> = frames.iter().filter(|frame| frame.tti.0 >= tti).cloned().collect();
            assert!(later.starts_with(&own), "TTI {tti}");
            assert!(bytes.len() < whole.len() || own.len() == later.len(), "TTI {tti}");
        }
    }
}

#[test]
fn what_is_no_recording_is_refused() {
    let foreign = |bytes: &[u8]| read(bytes).1.expect_err("refused").to_string();
    assert!(foreign(b"").contains("truncated") || foreign(b"").contains("not a recording"));
    assert!(foreign(b"this is a text, and not a short one").contains("not an MCAP file"));
    let empty = mcap::Writer::new(Cursor::new(Vec::new())).and_then(|mut writer| {
        writer.finish()?;
        Ok(writer.into_inner().into_inner())
    });
    assert!(foreign(&empty.expect("a container")).contains("not recorded by reveille"));
    let (scenario, frames) = small();
    let mut newer = recorded(&scenario, &frames[..3], None);
    // The value follows its key with its length before it.
    let key = b"recording\x01\x00\x00\x00";
    let at = newer
        .windows(key.len())
        .position(|window| window == key)
        .expect("a version");
    newer[at + key.len()] = b'9';
    let said = foreign(&newer);
    assert!(said.contains("version 9") && said.contains("reads version 2"), "{said}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(50))]

    #[test]
    fn a_torn_recording_is_read_up_to_the_tear(cut in 0.0..1.0_f64) {
        let (scenario, frames) = small();
        let bytes = recorded(&scenario, &frames, Some("{}"));
        let cut = (cut * bytes.len() as f64) as usize;
        let (own, end) = read(&bytes[..cut]);
        prop_assert!(frames.starts_with(&own));
        if own.len() < frames.len() {
            let said = end.expect_err("not all of it").to_string();
            prop_assert!(said.contains("truncated") || said.contains("not a recording"), "{}", said);
        }
        // Chunks hold about a hundred frames, so at most the last chunk is lost.
        let whole = |count: usize| recorded(&scenario, &frames[..count], None).len();
        if own.len() + 200 < frames.len() {
            prop_assert!(cut < whole(own.len() + 200), "{} frames of {} bytes", own.len(), cut);
        }
    }

    #[test]
    fn a_damaged_recording_tells_nothing_else(at in 0.0..1.0_f64, bit in 0..8_u32) {
        let (scenario, frames) = small();
        let mut bytes = recorded(&scenario, &frames, Some("{}"));
        let at = (at * bytes.len() as f64) as usize;
        bytes[at] ^= 1 << bit;
        let (own, _) = read(&bytes);
        prop_assert!(frames.starts_with(&own));
    }
}

/// The format requires a reader to skip unknown records. A damaged record of a known kind must not be skipped silently.
#[test]
fn chunks_that_are_none_any_more_are_missed() {
    let (scenario, frames) = small();
    let bytes = recorded(&scenario, &frames, Some("{}"));
    let summary = mcap::Summary::read(&bytes)
        .expect("a container")
        .expect("it was closed");
    let chunks: Vec<usize> = summary
        .chunk_indexes
        .iter()
        // The first chunk has channels and no messages.
        .filter(|chunk| !chunk.message_index_offsets.is_empty())
        .map(|chunk| chunk.chunk_start_offset as usize)
        .collect();
    assert!(chunks.len() > 5);
    for at in chunks {
        let mut damaged = bytes.clone();
        // The opcode of the record.
        damaged[at] = 0x7f;
        let (own, end) = read(&damaged);
        assert!(own.len() < frames.len() && frames.starts_with(&own), "at {at}");
        let said = end.expect_err("not all of it").to_string();
        assert!(said.contains("messages are missing"), "at {at}: {said}");
    }
}
