//! Tests of [`record`] and of trajectory files. Recorded steps are compared with each other and with the reward formula
//! of the paper, recorded runs with unrecorded ones, and files with the trajectories from which they were written. Not
//! checked: [`record_steps`], and the genie, whose runs are not recorded.

use ::parquet::basic::Type as Physical;
use reveille_bs::policy::dt::tokens::{FEATURE_COUNT, FEATURES};
use reveille_common::declare::NoFiles;
use reveille_common::parquet::{Column, Writer, schema};

use super::parquet::{TrajectoryError, VERSION_KEY, from_bytes, to_bytes};
use super::*;
use crate::sweep::ExperimentBuilder;

fn parse_grid(text: &str) -> SweepGrid {
    let draft = ExperimentBuilder::parse(text, "test", std::path::Path::new("")).expect("an experiment");
    SweepGrid::new(draft.build().expect("complete"), &NoFiles).expect("a grid")
}

/// Records four runs of 300 TTIs: two policies with two seeds each.
fn record_runs(config: &RecordingConfig) -> Trajectories {
    let text = "scenario = \"paper\"\npolicies = [\"age-index\", \"knn\"]\ndevices = [30]\nttis = 300\n\
                seeds = { first = 5, count = 2 }\n";
    record(&parse_grid(text), config, &|| false, &|| ()).expect("not stopped")
}

fn config_with(explore: &[f64]) -> RecordingConfig {
    RecordingConfig {
        length: 6,
        stride: 50,
        explore: explore.to_vec(),
        true_batteries: false,
    }
}

#[test]
fn chunks_are_complete_and_consistent() {
    let trajectories = record_runs(&config_with(&[0.0, 0.3]));
    // Four runs of six chunks; the last begins at TTI 250, and its last return needs TTIs up to 274.
    assert_eq!(trajectories.chunks.len(), 24);
    let (mut ttis_with_reports, mut wake_ups, mut explored_chunks) = (0, 0, 0);
    for chunk in &trajectories.chunks {
        assert_eq!((chunk.devices, chunk.steps.len(), chunk.returns.len()), (30, 6, 6));
        assert_eq!(chunk.price.is_some(), &*chunk.policy == "age-index");
        for (step, next_step) in chunk.steps.iter().zip(&chunk.steps[1..]) {
            assert_eq!(next_step.tti, step.tti + 1);
            let feature_index = |name: &str| FEATURES.iter().position(|known| *known == name).expect("a feature");
            let (found_index, idle_index) = (feature_index("found"), feature_index("idle"));
            let reporters = step.devices.iter().filter(|device| device.has_reported_first).count();
            for (j, device) in step.devices.iter().enumerate() {
                assert!(
                    !device.has_reported_first || device.is_sensing,
                    "device {j} reported first without sensing"
                );
                let next_token = &next_step.tokens[j * FEATURE_COUNT..(j + 1) * FEATURE_COUNT];
                // In the next TTI the base station knows that an event was found, and which devices have just sensed.
                assert_eq!(next_token[found_index] > 0.5, reporters > 0);
                assert_eq!(
                    next_token[idle_index] == 0.0,
                    device.is_sensing,
                    "TTI {:?}, device {j}",
                    step.tti
                );
                wake_ups += usize::from(device.wake_up.is_some());
            }
            let asleep = step.devices.iter().filter(|device| !device.is_sensing).count() as f32 / 30.0;
            // r(k) = mean over sleeping devices − αμ1·uncovered (Sec. V-B), α = 0.2 and μ1 = 14.
            assert!(
                (step.reward - (asleep - 2.8 * (1.0 - step.covered_share))).abs() < 1e-4,
                "{step:?}"
            );
            ttis_with_reports += usize::from(reporters > 0);
        }
        // Odd runs use the second probability. Only their number is checked, not the effect.
        explored_chunks += usize::from(chunk.run % 2 == 1);
    }
    assert_eq!(explored_chunks, 12);
    // Below these limits, the assertions above would have checked little.
    assert!(
        ttis_with_reports > 5 && wake_ups > 3,
        "too few cases: {ttis_with_reports} TTIs with reports, {wake_ups} wake-ups"
    );
}

#[test]
fn trajectories_round_trip_and_the_same_runs_give_the_same_bytes() {
    let trajectories = record_runs(&config_with(&[0.1]));
    let bytes = to_bytes(&trajectories).expect("bytes");
    assert_eq!(bytes, to_bytes(&record_runs(&config_with(&[0.1]))).expect("bytes"));
    let (read, _) = from_bytes(bytes).expect("a file");
    assert_eq!(read, trajectories);
}

/// A policy that does not see the recorded batteries decides as in an unrecorded run.
#[test]
fn a_recording_does_not_change_the_run() {
    let text = "scenario = \"paper\"\npolicies = [\"random\", \"adjusted\", \"knn\", \"q-learning\", \"dt\"]\n\
                 devices = [80]\nttis = 800\nseeds = { first = 3, count = 1 }\n\
                 [set]\n\"harvest.e_b\" = 3.0\n[grid]\n\"bs.ranking\" = [\"p42\", \"posterior\"]\n";
    let grid = parse_grid(text);
    let mut changed_runs = 0;
    for cell in &grid.cells {
        let scenario = cell.with_seed(3);
        let outcome = Run::new(&RunPreparer::default().prepare(&scenario), RunOptions::default()).finish(&mut ());
        let recorded_digest = |true_batteries: bool| {
            let config = RecordingConfig {
                true_batteries,
                ..config_with(&[0.0])
            };
            let recorded = record_from_scenario(&scenario, 0, &config, &|| false).expect("not stopped");
            recorded.0.expect("not a genie")
        };
        assert_eq!(recorded_digest(false), outcome.digest, "{}", scenario.policy.name());
        changed_runs += usize::from(recorded_digest(true) != outcome.digest);
    }
    assert!(changed_runs > 0, "true batteries have no effect");
}

#[test]
fn invalid_files_are_refused_with_the_reason() {
    let trajectories = record_runs(&config_with(&[0.0]));
    let bytes = to_bytes(&trajectories).expect("bytes");
    for length in [0, 10, bytes.len() / 2, bytes.len() - 3] {
        assert!(
            matches!(from_bytes(bytes[..length].to_vec()), Err(TrajectoryError::Format(_))),
            "{length} bytes"
        );
    }
    let corruptions: [(&str, Corruption); 4] = [
        (FEATURES[3], |chunk| chunk.steps[0].tokens[FEATURE_COUNT + 3] = f32::NAN),
        ("wake_reward is", |chunk| chunk.steps[0].wake_reward = f32::INFINITY),
        ("wake_brought is", |chunk| {
            chunk.steps[0].devices[1].wake_up = Some((0.1, f32::NAN));
        }),
        ("price is", |chunk| chunk.price = Some(f32::INFINITY)),
    ];
    for (cause, corrupt) in corruptions {
        let mut corrupted = trajectories.clone();
        corrupt(&mut corrupted.chunks[0]);
        let message = from_bytes(to_bytes(&corrupted).expect("bytes"))
            .expect_err(cause)
            .to_string();
        // The price is a property of the chunk, so its first row is named.
        let row = if cause == "price is" { "row 0 " } else { "row " };
        assert!(message.contains(cause) && message.contains(row), "{message}");
    }
    assert!(matches!(
        from_bytes(foreign_file(None)),
        Err(TrajectoryError::Foreign(_))
    ));
    assert!(matches!(
        from_bytes(foreign_file(Some("0"))),
        Err(TrajectoryError::Foreign(_))
    ));
    // The version of the format, but other columns.
    let missing = from_bytes(foreign_file(Some("1"))).expect_err("refused").to_string();
    assert!(
        missing.contains("run is missing") && missing.contains("train record"),
        "{missing}"
    );
}

/// Corrupts a recorded chunk.
type Corruption = fn(&mut Chunk);

/// Returns a Parquet file with another column, and `version` as the version of trajectories in its metadata.
fn foreign_file(version: Option<&str>) -> Vec<u8> {
    let schema = schema("other", [Column::required("x", Physical::INT32)]).expect("a schema");
    let about = version.map(|version| (VERSION_KEY.to_owned(), version.to_owned()));
    let writer = Writer::begin(Vec::new(), schema, about);
    writer.and_then(Writer::finish).expect("a file")
}
