//! Text for people fits 80 columns, `WIDTH` in `deploy/src/display.rs`, also if the output is no terminal. Here are the
//! tables of sweeps, `scenario check` and `inspect stats`; `compare.rs`, `compare_sweeps.rs` and `misses.rs` check the
//! texts of their commands.

use reveille_tests::process::{FinishedProcess, TestFolder};

/// Checks that the command succeeded and that no line of its text is wider than 80 columns. A line that is a path alone
/// may be longer.
fn assert_narrow(finished: &FinishedProcess) {
    assert!(finished.is_success(), "{finished}");
    let is_narrow = |line: &str| line.chars().count() <= 80 || !line.trim().contains(' ');
    let wide: Vec<&str> = finished.stdout.lines().filter(|line| !is_narrow(line)).collect();
    assert!(wide.is_empty(), "{wide:?}: {finished}");
}

#[test]
fn a_sweep_over_several_fields_has_narrow_tables() {
    let folder = TestFolder::new();
    let sweep = "sweep --policies q-learning,age-index --devices 8,120 --ttis 300,400 --seeds 3 --out s";
    // Of different lengths, which name the folders.
    for grid in [
        "--grid harvest.lambda=0.05,0.1",
        "--grid harvest.lambda=0.05,0.1 --grid sensing.d_max=4,5",
        "--grid policy.age-index.price=0.3,0.4 --grid events.duration_kind=fixed,geometric --grid sensing.d_max=4,5",
    ] {
        let finished = folder.run(&format!("{sweep}{} {grid}", grid.len()));
        assert_narrow(&finished);
        assert!(
            finished.stdout.starts_with("preset paper · 3 runs per row\n"),
            "{finished}"
        );
        for heading in ["info (P1)", "battery", "missed %"] {
            assert_eq!(finished.stdout.matches(heading).count(), 1, "{heading}: {finished}");
        }
        let repeated = folder.run(&format!("{sweep}{} {grid}", grid.len()));
        assert_narrow(&repeated);
        assert!(repeated.stdout.contains(" runs, already finished\n"), "{repeated}");
    }
}

#[test]
fn a_sweep_shows_why_events_were_missed() {
    let folder = TestFolder::new();
    let finished = folder.run("sweep -p knn,genie -n 8,60 -k 600 --seeds 2 --set energy.e_max=12 --out several");
    assert_narrow(&finished);
    let (_, causes) = finished
        .stdout
        .split_once("missed events by cause, % of events, means\n")
        .unwrap_or_else(|| panic!("{finished}"));
    // The same shares as in the table of runs, which has a column for every cause.
    let rows = folder.run("sweep -p knn,genie -n 8,60 -k 600 --seeds 2 --set energy.e_max=12 --out several --json");
    let report: serde_json::Value = serde_json::from_str(&rows.stdout).expect("JSON");
    let cells = report["cells"].as_array().expect("a list");
    let occurs = |cause: &str| {
        let metric = format!("missed_{}_pct", cause.replace(' ', "_"));
        cells
            .iter()
            .any(|cell| cell["metrics"][&metric]["mean"].as_f64() > Some(0.0))
    };
    for cause in ["asleep", "unpowered", "undetected", "lost", "out of reach", "no energy"] {
        assert_eq!(causes.contains(cause), occurs(cause), "{cause}: {finished}");
    }
    assert!(occurs("no energy"), "{rows}");
    let finished = folder.run("sweep -p random -n 250 -k 600 --seeds 2 --set policy.random.t_drx=[64] --out one");
    assert_narrow(&finished);
    let sentence = "cause of all missed events: devices within d_max slept by plan\n";
    assert!(finished.stdout.contains(sentence), "{finished}");
}

#[test]
fn checks_and_message_counts_are_narrow() {
    let folder = TestFolder::new();
    let long_path = "a-folder-with-a-name/that-is-long/and-another-one-in-it/with-a-scenario/that-is-long-too";
    std::fs::create_dir_all(folder.join(long_path)).expect("new");
    folder.write(&format!("{long_path}/scenario.toml"), "preset = \"quick\"\n");
    let finished = folder.run(&format!("scenario check {long_path}/scenario.toml quick"));
    assert_narrow(&finished);
    assert!(finished.stdout.contains("scenario.toml:\nok. 20 devices"), "{finished}");
    let recorded = folder.run("up -n 60 -k 1200 -p age-index -P 2 --record r.mcap --quiet --out r");
    assert!(recorded.is_success(), "{recorded}");
    assert_narrow(&folder.run("inspect stats r.mcap --devices"));
}
