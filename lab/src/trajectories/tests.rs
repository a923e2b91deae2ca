//! Recordings match the run, and files hold all of it.

use ::parquet::basic::Type as Physical;
use reveille_bs::policy::dt::tokens::{FEATURE_COUNT, FEATURES};
use reveille_common::declare::NoFiles;
use reveille_common::parquet::{Column, Writer, schema};

use super::parquet::{KEY, TrajectoryError, from_bytes, to_bytes};
use super::*;
use crate::sweep::ExperimentBuilder;

fn grid(text: &str) -> SweepGrid {
    let draft = ExperimentBuilder::parse(text, "test", std::path::Path::new("")).expect("an experiment");
    SweepGrid::new(draft.build().expect("complete"), &NoFiles).expect("a grid")
}

fn recorded(recording: &RecordingConfig) -> Trajectories {
    let text = "scenario = \"paper\"\npolicies = [\"age-index\", \"knn\"]\ndevices = [30]\nttis = 300\n\
                seeds = { first = 5, count = 2 }\n";
    record(&grid(text), recording, &|| false, &|| ()).expect("not stopped")
}

/// A corruption of recorded data.
type CorruptChunk = fn(&mut Chunk);

fn recording(explore: &[f64]) -> RecordingConfig {
    RecordingConfig {
        length: 6,
        stride: 50,
        explore: explore.to_vec(),
        true_batteries: false,
    }
}

#[test]
fn chunks_are_whole_and_what_they_say_fits_together() {
    let trajectories = recorded(&recording(&[0.0, 0.3]));
    // Four runs of six chunks; the last begins at TTI 250.
    assert_eq!(trajectories.chunks.len(), 24);
    let (mut found, mut woken, mut explored) = (0, 0, 0);
    for chunk in &trajectories.chunks {
        assert_eq!((chunk.devices, chunk.steps.len(), chunk.returns.len()), (30, 6, 6));
        assert_eq!(chunk.price.is_some(), &*chunk.policy == "age-index");
        for (step, after) in chunk.steps.iter().zip(&chunk.steps[1..]) {
            assert_eq!(after.tti, step.tti + 1);
            let names = |name: &str| FEATURES.iter().position(|known| *known == name).expect("a feature");
            let (is_found, idle) = (names("found"), names("idle"));
            let reporters = step.devices.iter().filter(|look| look.has_reported_first).count();
            for (j, look) in step.devices.iter().enumerate() {
                assert!(
                    !look.has_reported_first || look.is_sensing,
                    "who reports first has looked"
                );
                let next = &after.tokens[j * FEATURE_COUNT..(j + 1) * FEATURE_COUNT];
                // In the next TTI the base station knows that an event was found, and which devices have just sensed.
                assert_eq!(next[is_found] > 0.5, reporters > 0);
                assert_eq!(next[idle] == 0.0, look.is_sensing, "TTI {:?}, device {j}", step.tti);
                woken += usize::from(look.wake_up.is_some());
            }
            let asleep = step.devices.iter().filter(|look| !look.is_sensing).count() as f32 / 30.0;
            // r(k) = mean over sleeping devices − αμ1·uncovered (Sec. V-B), α = 0.2 and μ1 = 14.
            assert!(
                (step.reward - (asleep - 2.8 * (1.0 - step.covered_share))).abs() < 1e-4,
                "{step:?}"
            );
            found += usize::from(reporters > 0);
        }
        explored += usize::from(chunk.run % 2 == 1);
    }
    assert!(found > 5 && woken > 3 && explored == 12, "{found} found, {woken} woken");
}

#[test]
fn files_hold_all_of_it_and_the_same_runs_give_the_same_bytes() {
    let trajectories = recorded(&recording(&[0.1]));
    let bytes = to_bytes(&trajectories).expect("bytes");
    assert_eq!(bytes, to_bytes(&recorded(&recording(&[0.1]))).expect("bytes"));
    let (read, _) = from_bytes(bytes).expect("a file");
    assert_eq!(read, trajectories);
}

/// A recorded policy decides as in an unrecorded run, even if it may not see the recorded batteries.
#[test]
fn what_is_recorded_is_the_run() {
    let draft = "scenario = \"paper\"\npolicies = [\"random\", \"adjusted\", \"knn\", \"q-learning\", \"dt\"]\n\
                 devices = [80]\nttis = 800\nseeds = { first = 3, count = 1 }\n\
                 [set]\n\"harvest.e_b\" = 3.0\n[grid]\n\"bs.ranking\" = [\"p42\", \"posterior\"]\n";
    let grid = grid(draft);
    let mut others = 0;
    for cell in &grid.cells {
        let scenario = cell.with_seed(3);
        let outcome = Run::new(&RunPreparer::default().prepare(&scenario), RunOptions::default()).finish(&mut ());
        let digest = |told: bool| {
            let recording = RecordingConfig {
                true_batteries: told,
                ..recording(&[0.0])
            };
            let again = record_from_scenario(&scenario, 0, &recording, &|| false).expect("not stopped");
            again.0.expect("no genie")
        };
        assert_eq!(digest(false), outcome.digest, "{}", scenario.policy.name());
        others += usize::from(digest(true) != outcome.digest);
    }
    assert!(others > 0, "knowing batteries never helps");
}

#[test]
fn files_that_hold_something_else_are_refused() {
    let trajectories = recorded(&recording(&[0.0]));
    let bytes = to_bytes(&trajectories).expect("bytes");
    for cut in [0, 10, bytes.len() / 2, bytes.len() - 3] {
        assert!(
            matches!(from_bytes(bytes[..cut].to_vec()), Err(TrajectoryError::Format(_))),
            "{cut} bytes"
        );
    }
    let breaks: [(&str, CorruptChunk); 4] = [
        (FEATURES[3], |chunk| chunk.steps[0].tokens[FEATURE_COUNT + 3] = f32::NAN),
        ("wake_reward is", |chunk| chunk.steps[0].wake_reward = f32::INFINITY),
        ("wake_brought is", |chunk| {
            chunk.steps[0].devices[1].wake_up = Some((0.1, f32::NAN));
        }),
        ("price is", |chunk| chunk.price = Some(f32::INFINITY)),
    ];
    for (said, spoil) in breaks {
        let mut broken = trajectories.clone();
        spoil(&mut broken.chunks[0]);
        let refused = from_bytes(to_bytes(&broken).expect("bytes"))
            .expect_err(said)
            .to_string();
        let row = if said == "price is" { "row 0 " } else { "row " };
        assert!(refused.contains(said) && refused.contains(row), "{refused}");
    }
    assert!(matches!(from_bytes(other(None)), Err(TrajectoryError::Foreign(_))));
    assert!(matches!(from_bytes(other(Some("0"))), Err(TrajectoryError::Foreign(_))));
    let missing = from_bytes(other(Some("1"))).expect_err("refused").to_string();
    assert!(
        missing.contains("run is missing") && missing.contains("train record"),
        "{missing}"
    );
}

/// A Parquet file with another column, labelled with `version`.
fn other(version: Option<&str>) -> Vec<u8> {
    let schema = schema("other", [Column::required("x", Physical::INT32)]).expect("a schema");
    let about = version.map(|version| (KEY.to_owned(), version.to_owned()));
    let writer = Writer::begin(Vec::new(), schema, about);
    writer.and_then(Writer::finish).expect("a file")
}
