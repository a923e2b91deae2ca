//! The command `tune` (`--features reveille-deploy/tune`): the same history with any threads and after kills, its
//! pictures and JSON, and refusals. Without the cargo feature it names the build command. `.ci/run` selects the tests
//! with the feature by `tun` in their names, which the name of this file contains.

#[cfg(not(feature = "tune"))]
#[test]
fn without_the_feature_the_error_names_the_build_command() {
    use reveille_tests::process::{TestFolder, assert_refused};

    let folder = TestFolder::new();
    let finished = folder.run("tune -n 100");
    assert_refused(&finished, 2, &["cargo run --release --features tune -- tune"]);
    let help = folder.run("--help");
    assert!(help.stdout.contains("  tune "), "{help}");
}

#[cfg(feature = "tune")]
mod with_the_feature {
    use std::fs;

    use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, wait_until};
    use rustix::process::Signal;
    use serde_json::Value;

    /// Command of a small tuning, whose history has [`POINTS`] points.
    const TUNE: &str = "tune -n 12 --design 3 --iterations 2 --episodes 2 --episode-ttis 200 --seeds 2 --ttis 1000";

    /// Points of [`TUNE`]: three of the design and two iterations.
    const POINTS: usize = 3 + 2;

    /// Reads a file; empty if it does not exist.
    fn text_or_empty(folder: &TestFolder, name: &str) -> String {
        fs::read_to_string(folder.join(name)).unwrap_or_default()
    }

    /// Counts the finished points in a history.
    fn point_count(folder: &TestFolder, name: &str) -> usize {
        let is_point = |line: &&str| line.starts_with(|c: char| c.is_ascii_digit());
        text_or_empty(folder, name).lines().filter(is_point).count()
    }

    #[test]
    fn threads_and_kills_do_not_change_the_history() {
        let folder = TestFolder::new();
        let finished = folder.run(&format!("{TUNE} --out whole.csv --threads 1"));
        assert!(finished.is_success(), "{finished}");
        for part in [
            "best: μ1 = ",
            "reveille train q-learning --devices 12 ",
            "whole.svg, whole.png",
        ] {
            assert!(finished.stdout.contains(part), "no {part}: {finished}");
        }
        assert_eq!(point_count(&folder, "whole.csv"), POINTS);
        let resumable = format!("{TUNE} --threads 2 --out killed.csv");
        for (signal, code) in [(Signal::KILL, None), (Signal::INT, Some(130))] {
            let points_before = point_count(&folder, "killed.csv");
            let tuning = folder.start(&resumable);
            wait_until("a point", PATIENCE, || {
                // A finished tuning, which adds no point, also passes.
                (point_count(&folder, "killed.csv") > points_before.min(POINTS - 1)).then_some(())
            });
            tuning.signal(signal);
            let finished = tuning.finish();
            // On a fast machine the tuning may have ended before the signal.
            assert!(finished.code() == code || finished.is_success(), "{finished}");
        }
        let finished = folder.run(&format!("{resumable} --json"));
        assert!(finished.is_success(), "{finished}");
        assert!(
            finished.stderr.contains("finished points found in killed.csv"),
            "{finished}"
        );
        for ending in ["csv", "svg", "png"] {
            let bytes = |name: &str| fs::read(folder.join(&format!("{name}.{ending}"))).expect("written");
            let (whole, killed) = (bytes("whole"), bytes("killed"));
            // The picture contains its file name.
            assert!(ending == "svg" || whole == killed, "the {ending} file differs");
        }
        let json: Value = serde_json::from_str(&finished.stdout).expect("JSON");
        assert_eq!(json["points"].as_array().map(Vec::len), Some(POINTS));
        let objective = |value: &Value| value["objective"].as_f64().expect("a number");
        let objectives = json["points"].as_array().expect("points").iter().map(objective);
        assert!((objective(&json["best"]) - objectives.fold(f64::NEG_INFINITY, f64::max)).abs() < 1e-15);
        assert_refused(
            &folder.run(&format!("{TUNE} --seed 2 --out whole.csv")),
            1,
            &["another tuning", "seed"],
        );
        fs::remove_file(folder.join("whole.png")).expect("ours");
        let finished = folder.run("tune --picture-only whole.csv --format png");
        assert_eq!(
            (finished.code(), finished.stdout.trim()),
            (Some(0), "whole.png"),
            "{finished}"
        );
    }

    #[test]
    fn invalid_tuning_requests_are_refused() {
        let folder = TestFolder::new();
        folder.write("foreign.csv", "a,b\n1,2\n");
        for (args, code, part) in [
            ("--mu1 20,0.5", 2, "20 is larger than 0.5"),
            ("--mu2 0,5", 1, "mu2 = 0,5"),
            ("--mu2 1", 2, "must be two numbers, the smaller one first"),
            ("--design 2", 1, "design = 2"),
            ("-n 0", 1, "devices"),
            ("-n many", 1, "devices"),
            ("--objective fame", 2, "balance"),
            ("--energy-weight=-1", 1, "energy-weight = -1"),
            ("--set policy.name=knn", 1, "only q-learning"),
            ("--out foreign.csv", 1, "is not a history of a tuning"),
            ("--out tuning.svg", 1, "tuning.svg: the history is a CSV file"),
            ("--picture-only tuning.png", 1, "tuning.png: the history is a CSV file"),
            ("--set ttis=300", 1, "from --episode-ttis"),
            ("--picture-only foreign.csv", 1, "is not a history of a tuning"),
            ("--picture-only nowhere.csv", 1, "nowhere.csv: no such file"),
        ] {
            let finished = folder.run(&format!("tune {args}"));
            assert_eq!(finished.code(), Some(code), "{args}: {finished}");
            assert!(finished.stderr.contains(part), "{args}: no {part:?}: {finished}");
            assert!(!finished.stderr.contains("panicked"), "{args}: {finished}");
        }
        assert_eq!(text_or_empty(&folder, "foreign.csv"), "a,b\n1,2\n");
    }
}
