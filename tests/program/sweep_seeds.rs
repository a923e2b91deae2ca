//! The number of seeds of `sweep`: `--until-ci` ends a cell at the wanted precision. A sweep whose number of seeds is
//! raised ends with the table of a sweep that started with this number, and loses no finished run to kills or a full
//! disk. `sweep.rs` tests sweeps with a constant number of seeds.

use std::fs;
use std::time::Duration;

use reveille_tests::machine::{Mount, print_skipped};
use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, wait_until};
use rustix::process::Signal;
use serde_json::Value;

/// Cells of [`GRID`]: four policies, two numbers of devices.
const CELLS: u64 = 4 * 2;
/// Options of short runs in [`CELLS`] cells, without the number of seeds.
const GRID: &str = "--policies knn,random,adjusted,genie --devices 8,20 --ttis 600 --first-seed 5 \
    --set policy.adjusted.pilot_ttis=100 --set policy.adjusted.t_on=[1,2] --set policy.adjusted.t_drx=[2,8]";

/// Runs `reveille sweep ARGS --out OUT`. Returns the bytes of its table, and the number of earlier runs that it found
/// in its folder.
fn sweep_table(folder: &TestFolder, args: &str, out: &str) -> (Vec<u8>, u64) {
    let finished = folder.run(&format!("sweep {args} --out {out} --json"));
    assert!(finished.is_success(), "{finished}");
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let table = fs::read(folder.join(&format!("{out}/results.parquet"))).expect("a table");
    (table, report["found"].as_u64().expect("a number"))
}

#[test]
fn a_sweep_with_added_seeds_equals_a_fresh_sweep() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 12"), "fresh");
    sweep_table(&folder, &format!("{GRID} --seeds 3"), "s");
    let (_, found) = sweep_table(&folder, "s/experiment.toml --seeds 7", "s");
    assert_eq!(found, CELLS * 3);
    let (table, found) = sweep_table(&folder, &format!("{GRID} --seeds 12"), "s");
    assert_eq!(found, CELLS * 7);
    assert!(table == expected, "the table of a sweep with more seeds differs");
    let experiment = |out: &str| fs::read_to_string(folder.join(&format!("{out}/experiment.toml"))).expect("there");
    assert_eq!(experiment("s"), experiment("fresh"));
}

/// Runs `reveille sweep ARGS --json` without `--out`. Returns the numbers of runs and of earlier runs found, and the
/// folder that the sweep chose.
fn sweep_without_out(folder: &TestFolder, args: &str) -> (u64, u64, String) {
    let finished = folder.run(&format!("sweep {args} --json"));
    assert!(finished.is_success(), "{finished}");
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let number = |name: &str| report[name].as_u64().expect("a number");
    let out = report["folder"].as_str().expect("a path").to_owned();
    (number("runs"), number("found"), out)
}

#[test]
fn an_unnamed_sweep_can_be_extended() {
    let folder = TestFolder::new();
    let args = "--devices 5 --ttis 50";
    let (_, _, five_seeds) = sweep_without_out(&folder, &format!("{args} --seeds 5"));
    let (runs, found, two_seeds) = sweep_without_out(&folder, &format!("{args} --seeds 2"));
    assert!(
        five_seeds != two_seeds && (runs, found) == (2, 0),
        "{five_seeds}, {two_seeds}: {runs} runs, {found} found"
    );
    let repeated = sweep_without_out(&folder, &format!("{args} --seeds 2"));
    assert_eq!(repeated, (2, 2, two_seeds.clone()));
    // With its own experiment file the sweep continues in its folder; the number of seeds cannot be lowered.
    let with_more_seeds = sweep_without_out(&folder, &format!("{two_seeds}/experiment.toml --seeds 4"));
    assert_eq!(with_more_seeds, (4, 2, two_seeds.clone()));
    let with_fewer_seeds = folder.run(&format!("sweep {two_seeds}/experiment.toml --seeds 3"));
    assert_refused(&with_fewer_seeds, 1, &[&two_seeds, "4 seeds a cell"]);
    let (_, found, other_folder) = sweep_without_out(&folder, &format!("{two_seeds}/experiment.toml --ttis 60"));
    assert!(
        found == 0 && other_folder != two_seeds,
        "another experiment gets a separate folder: {other_folder}"
    );
    assert_eq!(folder.list("runs").len(), 3);
}

#[test]
fn an_unfinished_table_with_more_seeds_is_not_used() {
    let folder = TestFolder::new();
    for index in 1..=2 {
        sweep_table(
            &folder,
            &format!("{GRID} --seeds 3 --shard {index}/2"),
            &format!("s{index}"),
        );
    }
    sweep_table(&folder, &format!("{GRID} --seeds 3"), "whole");
    assert!(folder.run("figures whole --only energy --out a").is_success());
    assert!(folder.run("report whole --out b").is_success());
    for (args, out) in [("--shard 1/2", "s1"), ("", "whole")] {
        let sweep = folder.start(&format!("sweep {GRID} --seeds 100000 {args} --out {out}"));
        let runs_before = folder.count_finished_runs(out);
        wait_until("runs of the new seeds", PATIENCE, || {
            (folder.count_finished_runs(out) > runs_before).then_some(())
        });
        sweep.signal(Signal::KILL);
        sweep.finish();
    }
    let parts = [
        "s1: the folder holds no table with all runs of its sweep: its sweep is not finished",
        "give its command again",
        "--partial",
    ];
    assert_refused(&folder.run("merge s1 s2 --out m.parquet"), 1, &parts);
    assert!(!folder.join("m.parquet").exists());
    for command in ["figures", "report"] {
        let finished = folder.run(&format!("{command} whole --out c"));
        assert_refused(
            &finished,
            1,
            &["whole: the folder holds no table with all runs of its sweep: its sweep is not finished"],
        );
        let finished = folder.run(&format!("{command} runtime --out c"));
        assert_refused(
            &finished,
            1,
            &["runtime: the folder holds no table with all runs of its sweep: it is not the folder of a sweep"],
        );
    }
    assert!(!folder.join("c").exists());
    // The state after a kill between the change of the experiment and the removal of its table.
    let path = folder.join("s2/experiment.toml");
    let text = fs::read_to_string(&path).expect("there");
    fs::write(&path, text.replace("count = 3", "count = 5")).expect("written");
    let parts = [
        "s2: the folder holds no table with all runs of its sweep: its experiment.toml asks for 5 seeds a cell",
        "but results.parquet holds 3",
    ];
    assert_refused(&folder.run("merge s2 --partial --out m.parquet"), 1, &parts);
}

#[test]
fn a_kill_between_the_writes_of_journal_and_experiment_loses_no_run() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 4"), "fresh");
    for changed in ["runs.journal", "experiment.toml"] {
        for args in ["s/experiment.toml", &format!("{GRID} --seeds 4")] {
            sweep_table(&folder, &format!("{GRID} --seeds 2"), "s");
            let files = ["runs.journal", "experiment.toml", "results.parquet"].map(|name| {
                let path = folder.join(&format!("s/{name}"));
                (name, path.clone(), fs::read(path).expect("there"))
            });
            // As after a kill: only one of the files has the new number of seeds.
            sweep_table(&folder, &format!("{GRID} --seeds 4"), "s");
            for (name, path, before) in &files {
                if *name != changed {
                    fs::write(path, before).expect("written");
                }
            }
            let (table, found) = sweep_table(&folder, args, "s");
            assert!(table == expected, "{changed} has more seeds, resumed by {args}");
            let seeds_found = if changed == "runs.journal" { 4 } else { 2 };
            assert_eq!(
                found,
                CELLS * seeds_found,
                "{changed} has more seeds, resumed by {args}"
            );
            fs::remove_dir_all(folder.join("s")).expect("ours");
        }
    }
}

#[test]
fn a_full_disk_while_seeds_are_added_leaves_the_folder_unchanged() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 12"), "fresh");
    let path = folder.join("disk");
    let Some(_disk) = Mount::small(&path) else {
        print_skipped("cannot mount a small tmpfs here (root is needed)");
        return;
    };
    sweep_table(&folder, &format!("{GRID} --seeds 10"), "disk/s");
    let (names, ballast) = (folder.list("disk/s"), path.join("ballast"));
    let file_contents = || {
        names
            .clone()
            .into_iter()
            .map(|name| fs::read(path.join("s").join(name)).expect("there"))
    };
    let contents_before: Vec<Vec<u8>> = file_contents().collect();
    let written = fs::write(&ballast, vec![0; 256 * 1024]);
    assert!(written.is_err(), "the disk has more space than requested");
    let finished = folder.run(&format!("sweep {GRID} --seeds 12 --out disk/s"));
    assert_refused(
        &finished,
        1,
        &[
            "disk/s",
            "runs.journal cannot be used",
            "No space left",
            "free some space",
        ],
    );
    assert_eq!(folder.list("disk/s"), names, "files of the sweep");
    assert!(file_contents().eq(contents_before), "the folder has changed");
    fs::remove_file(ballast).expect("there");
    let (table, found) = sweep_table(&folder, &format!("{GRID} --seeds 12"), "disk/s");
    assert!(table == expected && found == CELLS * 10);
}

#[test]
fn fewer_seeds_and_another_first_seed_are_refused() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 4"), "s");
    let journal = || fs::read(folder.join("s/runs.journal")).expect("there");
    let journal_before = journal();
    for (args, parts) in [
        (
            format!("{GRID} --seeds 3"),
            &["--out s", "4 seeds a cell", "the requested 3", "--seeds 4 or more"][..],
        ),
        (
            format!("{} --seeds 6", GRID.replace("--first-seed 5", "--first-seed 4")),
            &["--out s", "another experiment", "the same first seed"],
        ),
        (
            format!("{GRID} --seeds 6 --set harvest.lambda=0.2"),
            &["--out s", "another experiment"],
        ),
    ] {
        assert_refused(&folder.run(&format!("sweep {args} --out s")), 1, parts);
        assert!(journal() == journal_before, "{args}: the journal has changed");
    }
    let (table, found) = sweep_table(&folder, &format!("{GRID} --seeds 4"), "s");
    assert!(table == expected && found == CELLS * 4);
}

#[test]
fn a_cell_stops_at_the_wanted_precision() {
    let folder = TestFolder::new();
    let args = "--policies genie --devices 20 --ttis 2000 --seeds 400 --until-ci 5% --ci-metrics energy_per_device_tti";
    let finished = folder.run(&format!("sweep {args} --json --out s"));
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let cell = &report["cells"][0];
    let (mean, half_width) = (
        &cell["metrics"]["energy_per_device_tti"]["mean"],
        &cell["metrics"]["energy_per_device_tti"]["half_width"],
    );
    let relative_half_width = half_width.as_f64().expect("a number") / mean.as_f64().expect("a number");
    assert!(
        relative_half_width <= 0.05 && cell["runs"].as_u64() < Some(400),
        "{report}"
    );
    assert_eq!(report["not_narrow"], Value::Array(Vec::new()));

    // A sensing device can detect events in almost all of the area and has enough energy: no run has a misdetection.
    let args = "--policies random --devices 20 --ttis 500 --seeds 12 --min-seeds 4 --until-ci 50% \
        --set sensing.d_max=28 --set harvest.lambda=1 --ci-metrics misdetection_pct";
    let finished = folder.run(&format!("sweep {args} --json --out none"));
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let cell = &report["cells"][0];
    assert_eq!(cell["metrics"]["misdetection_pct"]["mean"], 0.0, "{report}");
    assert_eq!(
        cell["runs"], 12,
        "without misdetections their rate is not bounded, so all seeds run"
    );
    let wide_metric = &report["not_narrow"][0];
    assert_eq!(
        (&wide_metric["metric"], &wide_metric["relative_half_width"]),
        (&"misdetection_pct".into(), &Value::Null)
    );
}

#[test]
fn a_cell_below_the_precision_continues_with_more_seeds() {
    let folder = TestFolder::new();
    // With 20 seeds the first check of the precision is at 20, with 200 at 30, the default of `--min-seeds`.
    let args = "--policies genie,knn --devices 20 --ttis 500 --until-ci 8% --ci-metrics info_per_event";
    let (expected, _) = sweep_table(&folder, &format!("{args} --seeds 200"), "fresh");
    sweep_table(&folder, &format!("{args} --seeds 20"), "s");
    let (table, found) = sweep_table(&folder, &format!("{args} --seeds 200"), "s");
    assert_eq!(found, 2 * 20);
    assert!(table == expected);
}

#[test]
fn shards_with_more_seeds_equal_a_fresh_sweep() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 7"), "fresh");
    let mut total_found = 0;
    for index in 1..=3 {
        let (shard, out) = (format!("--shard {index}/3"), format!("s{index}"));
        sweep_table(&folder, &format!("{GRID} --seeds 5 {shard}"), &out);
        let finished_runs = folder.count_finished_runs(&out);
        assert!(
            (12..=14).contains(&finished_runs),
            "{finished_runs} runs in a third of 40"
        );
        let (_, found) = sweep_table(&folder, &format!("{GRID} --seeds 7 {shard}"), &out);
        assert_eq!(found as usize, finished_runs, "a run stays in its shard");
        total_found += found;
    }
    assert_eq!(total_found, CELLS * 5);
    let merged = folder.run("merge s1 s2 s3 --out merged.parquet");
    assert!(merged.is_success(), "{merged}");
    assert!(fs::read(folder.join("merged.parquet")).expect("a table") == expected);
}

#[test]
fn a_kill_while_seeds_are_added_loses_no_run() {
    let folder = TestFolder::new();
    let (expected, _) = sweep_table(&folder, &format!("{GRID} --seeds 40"), "fresh");
    sweep_table(&folder, &format!("{GRID} --seeds 20"), "s");
    let journal = folder.join("s/runs.journal");
    // It states the number of seeds.
    let first_line = || {
        fs::read_to_string(&journal)
            .expect("there")
            .lines()
            .next()
            .map(str::to_owned)
    };
    let mut kept_runs = folder.count_finished_runs("s");
    for kill in 1..=10_u64 {
        let line_before = first_line();
        let sweep = folder.start(&format!("sweep {GRID} --seeds {} --threads 2 --out s", 20 + kill));
        // In half of the cases immediately after the journal is replaced, otherwise slightly before or after.
        if kill % 2 == 0 {
            wait_until("the new number of seeds in the journal", PATIENCE, || {
                (first_line() != line_before).then_some(())
            });
        } else {
            std::thread::sleep(Duration::from_micros(1500 * kill));
        }
        sweep.signal(Signal::KILL);
        sweep.finish();
        let finished_runs = folder.count_finished_runs("s");
        println!("kill {kill}: {finished_runs} runs after {kept_runs}");
        assert!(finished_runs >= kept_runs, "finished runs were lost");
        kept_runs = finished_runs;
    }
    let (table, found_at_end) = sweep_table(&folder, &format!("{GRID} --seeds 40"), "s");
    assert_eq!(found_at_end as usize, kept_runs, "runs found in the journal");
    assert!(table == expected);
}
