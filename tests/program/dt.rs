//! The commands `train record` and `train dt`, and `run -p dt` with a model file: reproducible recordings and models,
//! also after a kill, and refusals of invalid files. `lab/src/transformer/` tests the training itself.
//!
//! Tests of `train dt` need the cargo feature `train-dt` and belong to the module `transformer` here: `.ci/run` selects
//! them by this word.

use std::fs;

use reveille_tests::process::{TestFolder, assert_refused};

/// Command for a small recording. `signals.rs` repeats it.
const RECORD: &str =
    "train record -p age-index,knn -n 12 -k 400 --seeds 6 --set events.process=bursts --chunk 12 --stride 40";

#[test]
fn recordings_are_reproducible_and_invalid_requests_are_refused() {
    let folder = TestFolder::new();
    for out in ["a.parquet", "b.parquet"] {
        let finished = folder.run(&format!("{RECORD} --out {out}"));
        assert!(
            finished.is_success() && finished.stderr.contains("device-TTIs"),
            "{finished}"
        );
    }
    assert!(folder.bytes("a.parquet") == folder.bytes("b.parquet"));
    for (args, code, parts) in [
        (format!("{RECORD} --out a.parquet"), 1, &["a.parquet", "--force"][..]),
        (
            "train record -p knn -k 400 --chunk 50 --stride 40 --out c.parquet".into(),
            1,
            &["--stride 40", "--chunk"],
        ),
        (
            "train record -p knn -k 400 --chunk 40 --stride 40 --out c.parquet".into(),
            1,
            &["--stride 40", "more than --chunk"],
        ),
        (
            format!("{RECORD} --explore 1 --out c.parquet"),
            1,
            &["--explore 1", "less than 1"],
        ),
        (
            "train record -p genie -k 400 --out c.parquet".into(),
            1,
            &["other than genie"],
        ),
        (
            "train record -p knn -k 10 --out c.parquet".into(),
            1,
            &["use runs longer than --chunk"],
        ),
        (format!("{RECORD} --out nowhere/c.parquet"), 1, &["nowhere"]),
    ] {
        assert_refused(&folder.run(&args), code, parts);
    }
    assert!(!folder.join("c.parquet").exists());
}

#[test]
fn a_run_over_the_bus_is_recorded_from_its_folder() {
    let folder = TestFolder::new();
    let finished = folder.run("up -p knn -n 12 -k 300 --processes 2 --quiet --out live");
    assert!(finished.is_success(), "{finished}");
    let record = "train record --from live --chunk 12 --stride 40";
    let finished = folder.run(&format!("{record} --out live.parquet"));
    assert!(finished.is_success(), "{finished}");
    let finished = folder.run("up -p genie -n 12 -k 60 --processes 1 --quiet --out genie");
    assert!(finished.is_success(), "{finished}");
    assert_refused(&folder.run("train record --from genie --out c.parquet"), 1, &["genie"]);
    // A recording from a folder takes its settings from there, and its replay has to reproduce the run's digest.
    assert_refused(
        &folder.run(&format!("{record} -n 50 --out c.parquet")),
        2,
        &["--from", "--devices"],
    );
    let summary = folder.join("live").join("summary.json");
    let text = fs::read_to_string(&summary).expect("a summary");
    let digest = folder
        .summary("run -p knn -n 12 -k 300 --out same-run")
        .digest()
        .to_owned();
    folder.write("live/summary.json", &text.replace(&digest, "0123"));
    assert_refused(&folder.run(&format!("{record} --out c.parquet")), 1, &[&digest, "0123"]);
    fs::remove_file(&summary).expect("removed");
    assert_refused(&folder.run(&format!("{record} --out c.parquet")), 1, &["summary.json"]);
    let finished = folder.run("train record --from . --out c.parquet");
    assert_refused(&finished, 1, &["not a run folder", "scenario.toml"]);
}

#[test]
fn invalid_models_are_refused() {
    let folder = TestFolder::new();
    let shipped = include_bytes!("../../bs/src/policy/dt/shipped.safetensors");
    fs::write(folder.join("good.safetensors"), shipped).expect("written");
    fs::write(folder.join("cut.safetensors"), &shipped[..shipped.len() / 2]).expect("written");
    folder.write("empty.safetensors", "");
    folder.write("text.safetensors", "these are no weights");
    let run_with_model = |model: &str| {
        folder.run(&format!(
            "run -n 10 -k 50 -p dt --set policy.dt.model={model}.safetensors"
        ))
    };
    let finished = run_with_model("good");
    assert!(finished.is_success(), "{finished}");
    for name in ["cut", "empty", "text"] {
        assert_refused(
            &run_with_model(name),
            1,
            &[name, "policy.dt.model", "reveille train dt"],
        );
    }
    assert_refused(&run_with_model("missing"), 1, &["missing.safetensors", "no such file"]);
}

#[cfg(not(feature = "train-dt"))]
#[test]
fn without_the_feature_the_error_names_the_build_command() {
    let folder = TestFolder::new();
    let finished = folder.run("train dt some.parquet --out model.safetensors");
    assert_refused(&finished, 2, &["cargo run --release --features train-dt -- train dt"]);
}

#[cfg(feature = "train-dt")]
mod transformer {
    use super::*;
    use reveille_tests::process::{PATIENCE, wait_until};
    use rustix::process::Signal;

    /// Command for a small training on `a.parquet`, long enough for a kill between two checkpoints.
    const TRAIN: &str = "train dt a.parquet --steps 600 --batch 600 --patience 99 --set policy.dt.width=8 \
        --set policy.dt.heads=1 --set policy.dt.memory=3";

    /// Returns a folder with the recording `a.parquet`.
    fn folder_with_recording() -> TestFolder {
        let folder = TestFolder::new();
        let finished = folder.run(&format!("{RECORD} --out a.parquet"));
        assert!(finished.is_success(), "{finished}");
        folder
    }

    #[test]
    fn an_interrupted_training_ends_with_the_same_model_which_runs() {
        let folder = folder_with_recording();
        let finished = folder.run(&format!("{TRAIN} --out whole.safetensors"));
        assert!(
            finished.is_success() && finished.stderr.contains("held out"),
            "{finished}"
        );
        for (signal, code) in [(Signal::KILL, None), (Signal::INT, Some(130))] {
            let checkpoint_before = fs::read(folder.join("killed.safetensors.checkpoint")).unwrap_or_default();
            let training = folder.start(&format!("{TRAIN} --out killed.safetensors"));
            wait_until("a new checkpoint", PATIENCE, || {
                let checkpoint = fs::read(folder.join("killed.safetensors.checkpoint")).unwrap_or_default();
                (checkpoint != checkpoint_before || folder.join("killed.safetensors").exists()).then_some(())
            });
            training.signal(signal);
            let finished = training.finish();
            // On a fast machine the training may have ended before the signal.
            assert!(finished.code() == code || finished.is_success(), "{finished}");
            if folder.join("killed.safetensors").exists() {
                break;
            }
        }
        if !folder.join("killed.safetensors").exists() {
            let other_seed = folder.run(&format!("{TRAIN} --seed 2 --out killed.safetensors"));
            assert_refused(&other_seed, 1, &["killed.safetensors.checkpoint", "another training"]);
            let finished = folder.run(&format!("{TRAIN} --out killed.safetensors"));
            assert!(finished.is_success(), "{finished}");
        }
        assert!(folder.bytes("whole.safetensors") == folder.bytes("killed.safetensors"));
        assert!(!folder.join("killed.safetensors.checkpoint").exists());
        let run = "run -n 12 -k 100 -p dt --set policy.dt.model=";
        let trained = folder.summary(&format!("{run}whole.safetensors --out trained"));
        let shipped = folder.summary(&format!("{run}shipped --out shipped"));
        assert_ne!(trained.digest(), shipped.digest());
    }

    #[test]
    fn invalid_trajectories_are_refused() {
        let folder = folder_with_recording();
        let whole = folder.bytes("a.parquet");
        fs::write(folder.join("cut.parquet"), &whole[..whole.len() / 2]).expect("written");
        folder.write("text.parquet", "these are no columns");
        let finished = folder.run("sweep -p knn -n 10 -k 50 --seeds 1 --out swept");
        assert!(finished.is_success(), "{finished}");
        for (file, part) in [
            ("cut.parquet", "cut.parquet"),
            ("text.parquet", "text.parquet"),
            ("missing.parquet", "missing.parquet"),
            ("swept/results.parquet", "trajector"),
        ] {
            let finished = folder.run(&format!("train dt {file} --out m.safetensors"));
            assert_refused(&finished, 1, &[file, part]);
        }
        for (args, part) in [
            ("--set policy.dt.width=10", "multiple of 4 times the heads, 4"),
            ("--rate 0", "--rate 0"),
            ("--rate nan", "--rate"),
        ] {
            assert_refused(
                &folder.run(&format!("train dt a.parquet --out m.safetensors {args}")),
                1,
                &[part],
            );
        }
        assert!(!folder.join("m.safetensors").exists());
    }
}
