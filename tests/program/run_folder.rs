//! A run folder keeps the files of its scenario in `scenario-files`: it can be moved, and run again with the same
//! digest after the original files are removed. `deploy/src/scenario_files.rs` chooses the names of the copies.

use std::fs;

use reveille_tests::process::{SummaryJson, TestFolder};

/// Writes the scenario `my.toml`, whose layout, traces and tables are files, two of them with the same name. Its
/// classes `a` and `b` read the traces in the folders `a` and `b`.
fn write_scenario_with_files(folder: &TestFolder) {
    for name in ["a", "b"] {
        fs::create_dir(folder.join(name)).expect("a folder");
    }
    folder.write("a/energy.csv", "sun\n2\n0\n1\n");
    folder.write("b/energy.csv", "sun\n0\n3\n");
    // Eight places within the area of 20 m × 20 m, one for each device.
    let points = [2, 3, 4, 5, 6, 7, 8, 9]
        .map(|i| format!("{},{}\n", 2 * i - 2, i + 1))
        .concat();
    folder.write("points.csv", &format!("x,y\n{points}"));
    let trained = folder.run("train q-learning --quiet -n 8 --episodes 1 --episode-ttis 50 --out table.json");
    assert!(trained.is_success(), "{trained}");
    folder.write(
        "my.toml",
        "devices = 8\nttis = 400\npolicy.name = \"q-learning\"\npolicy.q-learning.table = \"table.json\"\n\
         [layout]\nkind = \"file\"\nfile = \"points.csv\"\n\
         [harvest]\nkind = \"trace\"\ntrace.column = \"sun\"\n\
         [[class]]\nname = \"a\"\nshare = 0.5\nharvest.trace.file = \"a/energy.csv\"\n\
         [[class]]\nname = \"b\"\nshare = 0.5\nharvest.trace.file = \"b/energy.csv\"\n",
    );
}

#[test]
fn a_moved_run_folder_can_be_run_again() {
    let folder = TestFolder::new();
    write_scenario_with_files(&folder);
    let first = folder.summary("run -s my.toml --out first");
    let text = String::from_utf8(folder.bytes("first/scenario.toml")).expect("text");
    assert!(!text.contains(&folder.path().display().to_string()), "{text}");
    assert_eq!(
        folder.list("first/scenario-files"),
        ["energy-2.csv", "energy.csv", "points.csv", "table.json"]
    );
    for name in ["a", "b"] {
        fs::remove_dir_all(folder.join(name)).expect("a folder");
    }
    for name in ["points.csv", "table.json", "my.toml"] {
        fs::remove_file(folder.join(name)).expect("a file");
    }
    fs::create_dir(folder.join("elsewhere")).expect("a folder");
    fs::rename(folder.join("first"), folder.join("elsewhere/moved")).expect("a move");
    let repeated = folder.summary("run -s elsewhere/moved/scenario.toml --out repeated");
    assert_eq!(repeated.digest(), first.digest());
    // In the run folder itself: the run replaces the files that it reads.
    let in_place = folder.summary("up -P 0 -s elsewhere/moved/scenario.toml --out elsewhere/moved --force");
    assert_eq!(in_place.digest(), first.digest());
    assert_eq!(folder.list("elsewhere/moved/scenario-files").len(), 4);
    // A run without files replaces a run with files.
    let plain = folder.summary("run -n 5 -k 50 --out repeated --force");
    assert_ne!(plain.digest(), first.digest());
    assert!(!folder.join("repeated/scenario-files").exists());
}

#[test]
fn the_summary_has_the_memory_of_measured_device_processes_only() {
    let folder = TestFolder::new();
    for (command, is_measured) in [("run", false), ("up -P 0", false), ("up -P 2", true)] {
        let finished = folder.run(&format!("{command} -n 10 -k 300 --quiet --force --out o"));
        assert!(finished.is_success(), "{finished}");
        let summary: serde_json::Value = serde_json::from_slice(&folder.bytes("o/summary.json")).expect("a summary");
        for field in ["host_rss_mb", "host_pss_mb"] {
            let memory = summary["timing"].get(field).map(|value| value.as_f64() > Some(0.1));
            assert_eq!(memory, is_measured.then_some(true), "{command}: {field} in {summary}");
        }
    }
}

/// The trace is a column of a result table, a metric of eight runs.
#[test]
fn a_run_folder_keeps_models_and_parquet_traces() {
    let folder = TestFolder::new();
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../bs/src/policy/dt/shipped.safetensors");
    fs::copy(shipped, folder.join("model.safetensors")).expect("it is shipped");
    let sweep = folder.run("sweep -n 5 --ttis 100 --seeds 8 --quiet --out s");
    assert!(sweep.is_success(), "{sweep}");
    fs::rename(folder.join("s/results.parquet"), folder.join("sun.parquet")).expect("a table");
    folder.write(
        "my.toml",
        "devices = 8\nttis = 300\npolicy.name = \"dt\"\npolicy.dt.model = \"model.safetensors\"\n\
         [harvest]\nkind = \"trace\"\ntrace.file = \"sun.parquet\"\ntrace.column = \"reports_per_event\"\n",
    );
    let first = folder.summary("up -P 2 -s my.toml --out first");
    assert_eq!(
        folder.list("first/scenario-files"),
        ["model.safetensors", "sun.parquet"]
    );
    for name in ["model.safetensors", "sun.parquet", "my.toml"] {
        fs::remove_file(folder.join(name)).expect("a file");
    }
    fs::create_dir(folder.join("elsewhere")).expect("a folder");
    fs::rename(folder.join("first"), folder.join("elsewhere/moved")).expect("a move");
    let repeated = folder.summary("run -s elsewhere/moved/scenario.toml --out repeated");
    assert_eq!(repeated.digest(), first.digest());
    let scenario_hash = |name: &str| {
        let summary = SummaryJson::read(&folder.join(name));
        summary.text("scenario_hash").to_owned()
    };
    assert_eq!(scenario_hash("repeated"), scenario_hash("elsewhere/moved"));
}
