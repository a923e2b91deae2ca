//! Sweeps with a script of actions: rows equal single runs with the script. A sweep with another script is another
//! sweep, which is not resumed, merged or reused.

use std::fs;

use reveille_tests::process::{TestFolder, assert_refused};
use serde_json::Value;

/// Random times follow from the seed, so they differ between the runs of a cell. Texts of refusals below repeat its
/// lines.
const SCRIPT: &str = "# stress\nfrom 100 every 100 fail 0-4 for 20 at random\n300 set events.alpha 0.2\n";
/// Options of a sweep of 12 runs: two policies, two numbers of devices and three seeds.
const GRID: &str = "--policies knn,random --devices 8,12 --ttis 600 --seeds 3 --first-seed 5";

/// Creates a folder with the scripts `script`, which is [`SCRIPT`], and `other`, which differs in one TTI.
fn folder_with_scripts() -> TestFolder {
    let folder = TestFolder::new();
    folder.write("script", SCRIPT);
    folder.write("other", &SCRIPT.replace("300 set", "301 set"));
    folder
}

/// Runs `sweep ARGS --out OUT` and returns the bytes of its CSV table.
fn csv_table(folder: &TestFolder, args: &str, out: &str) -> Vec<u8> {
    let finished = folder.run(&format!("sweep {args} --format csv --quiet --out {out}"));
    assert!(finished.is_success(), "{finished}");
    folder.bytes(&format!("{out}/results.csv"))
}

#[test]
fn rows_equal_single_runs_with_the_script() {
    let folder = folder_with_scripts();
    let table = String::from_utf8(csv_table(&folder, &format!("{GRID} --actions script"), "s")).expect("text");
    let mut lines = table.lines();
    let names: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| names.iter().position(|known| *known == name).expect("a column");
    assert_eq!(lines.clone().count(), 12);
    for (number, line) in lines.enumerate() {
        let cells: Vec<&str> = line.split(',').collect();
        let get = |name: &str| cells[column(name)];
        let scenario = format!("-p {} -n {} -k 600 --seed {}", get("policy"), get("n"), get("seed"));
        let with_script = folder.summary(&format!("run {scenario} --actions script --out run{number}"));
        assert_eq!(with_script.digest(), get("digest"), "{scenario}");
        let without_script = folder.summary(&format!("run {scenario} --out plain{number}"));
        assert_ne!(
            without_script.digest(),
            get("digest"),
            "{scenario}: the script had no effect"
        );
    }
}

#[test]
fn a_script_in_the_experiment_equals_the_option_and_shards_merge() {
    let folder = folder_with_scripts();
    let expected = csv_table(&folder, &format!("{GRID} --actions script"), "s");
    let sidecar = folder.bytes("s/results.csv.toml");
    fs::create_dir(folder.join("sub")).expect("new");
    let experiment = "policies = [\"knn\", \"random\"]\ndevices = [8, 12]\nttis = 600\nactions = \"../script\"\n\
                      seeds = { first = 5, count = 3 }\n";
    folder.write("sub/e.toml", experiment);
    assert!(csv_table(&folder, "sub/e.toml", "from-file") == expected);
    assert!(
        folder.bytes("from-file/results.csv.toml") == sidecar,
        "the same experiment"
    );
    // The folder of a sweep holds the script itself.
    fs::remove_file(folder.join("script")).expect("there");
    let with_more_seeds = folder.run("sweep s/experiment.toml --seeds 4 --format csv --json");
    let report: Value = serde_json::from_str(&with_more_seeds.stdout).expect("JSON");
    assert_eq!(
        (&report["found"], &report["runs"]),
        (&12.into(), &16.into()),
        "{with_more_seeds}"
    );
    assert_eq!(report["actions"], SCRIPT);
    folder.write("script", SCRIPT);
    for shard in 1..=2 {
        csv_table(
            &folder,
            &format!("{GRID} --actions script --shard {shard}/2"),
            &format!("s{shard}"),
        );
    }
    let merged = folder.run("merge s1 s2 --out merged.csv");
    assert!(
        merged.is_success() && folder.bytes("merged.csv") == expected,
        "{merged}"
    );
    assert!(folder.bytes("merged.csv.toml") == sidecar);
    csv_table(&folder, &format!("{GRID} --actions other --shard 2/2"), "other2");
    let mixed = folder.run("merge s1 other2 --out mixed.csv");
    let difference = "its experiment differs: `301 set events.alpha 0.2` here, `300 set events.alpha 0.2` there";
    assert_refused(&mixed, 1, &[difference]);
}

#[test]
fn a_sweep_with_another_script_is_not_resumed_or_reused() {
    let folder = folder_with_scripts();
    csv_table(&folder, &format!("{GRID} --actions script"), "s");
    let with_other_script = folder.run(&format!("sweep {GRID} --actions other --out s"));
    let difference = "other actions: `301 set events.alpha 0.2` here, `300 set events.alpha 0.2` there";
    assert_refused(
        &with_other_script,
        1,
        &["--out s", difference, "action_script", "another folder"],
    );
    let without_script = folder.run(&format!("sweep {GRID} --out s"));
    assert_refused(&without_script, 1, &["other actions: no line here, `# stress` there"]);
    let with_same_script = folder.run(&format!("sweep {GRID} --actions script --out s"));
    assert!(
        with_same_script.stderr.contains("12 finished runs found in s"),
        "{with_same_script}"
    );
    assert!(
        with_same_script
            .stdout
            .contains("\nactions of every run: from 100 every 100 fail 0-4 for 20 at random; 300 set\n")
    );
    // Options of different lengths, which name the folders.
    for (actions, reused) in [("", 0), ("--actions other", 0), ("--actions script", 12)] {
        let finished = folder.run(&format!(
            "sweep {GRID} {actions} --reuse s --out reused{}",
            actions.len()
        ));
        assert!(finished.is_success(), "{finished}");
        let expected = if reused == 0 {
            None
        } else {
            Some(format!("{reused} runs taken over by --reuse"))
        };
        let note = finished.stderr.lines().find(|line| line.contains("taken over"));
        assert_eq!(note, expected.as_deref(), "{actions}: {finished}");
    }
}

#[test]
fn an_invalid_script_is_refused_before_the_first_run() {
    let folder = folder_with_scripts();
    folder.write("ten", "5 fail 9\n");
    folder.write("both.toml", "actions = \"ten\"\naction_script = \"5 fail 3\"\n");
    folder.write("with.toml", "ttis = 50\nseeds = 1\naction_script = \"5 fail 3\"\n");
    let record_refusal = "actions: trajectories have no actions of operators";
    for (args, parts) in [
        (
            "sweep --devices 12,8 --actions ten --out s",
            &[
                "--actions ten: line 1: device 9: not in the run",
                "in the cell devices = 8",
            ][..],
        ),
        (
            "sweep --actions missing --out s",
            &["--actions missing: no such file", "docs/actions.md"],
        ),
        ("sweep both.toml --out s", &["actions = ten: excludes action_script"]),
        ("train record with.toml --out t.parquet", &[record_refusal]),
    ] {
        assert_refused(&folder.run(args), 1, parts);
    }
    assert!(!folder.join("s").exists());
}
