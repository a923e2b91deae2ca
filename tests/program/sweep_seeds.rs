//! Number of seeds of a sweep: as few as give the wanted precision. With more seeds in the same folder, the sweep ends
//! as if started with them and loses no finished run.

use std::fs;
use std::time::Duration;

use reveille_tests::machine::{Mount, skipped};
use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, wait_until};
use rustix::process::Signal;
use serde_json::Value;

/// Options of short runs over all policies, without the number of seeds.
const GRID: &str = "--policies knn,random,adjusted,genie --devices 8,20 --ttis 600 --first-seed 5 \
    --set policy.adjusted.pilot_ttis=100 --set policy.adjusted.t_on=[1,2] --set policy.adjusted.t_drx=[2,8]";

/// Runs `reveille sweep ARGS --out OUT`; returns the bytes of its table and the number of runs found.
fn swept(folder: &TestFolder, args: &str, out: &str) -> (Vec<u8>, u64) {
    let end = folder.run(&format!("sweep {args} --out {out} --json"));
    assert!(end.is_success(), "{end}");
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    let table = fs::read(folder.join(&format!("{out}/results.parquet"))).expect("a table");
    (table, report["found"].as_u64().expect("a number"))
}

#[test]
fn more_seeds_end_as_a_fresh_sweep() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 12"), "fresh");
    swept(&folder, &format!("{GRID} --seeds 3"), "s");
    let (_, found) = swept(&folder, "s/experiment.toml --seeds 7", "s");
    assert_eq!(found, 4 * 2 * 3);
    let (table, found) = swept(&folder, &format!("{GRID} --seeds 12"), "s");
    assert_eq!(found, 4 * 2 * 7);
    assert!(table == expected, "the table of a sweep with more seeds differs");
    let text = |out: &str| fs::read_to_string(folder.join(&format!("{out}/experiment.toml"))).expect("there");
    assert_eq!(text("s"), text("fresh"));
}

/// Runs `reveille sweep ARGS --json` without `--out`; returns the runs, the runs found, and the folder.
fn swept_by_default(folder: &TestFolder, args: &str) -> (u64, u64, String) {
    let end = folder.run(&format!("sweep {args} --json"));
    assert!(end.is_success(), "{end}");
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    let number = |name: &str| report[name].as_u64().expect("a number");
    let place = report["folder"].as_str().expect("a path").to_owned();
    (number("runs"), number("found"), place)
}

#[test]
fn an_unnamed_sweep_can_be_extended() {
    let folder = TestFolder::new();
    let args = "--devices 5 --ttis 50";
    let (_, _, long) = swept_by_default(&folder, &format!("{args} --seeds 5"));
    let (runs, found, short) = swept_by_default(&folder, &format!("{args} --seeds 2"));
    assert!(long != short && (runs, found) == (2, 0), "{long}, {short}");
    let again = swept_by_default(&folder, &format!("{args} --seeds 2"));
    assert_eq!(again, (2, 2, short.clone()));
    // With its own experiment file the sweep continues in its folder; the number of seeds cannot be lowered.
    let more = swept_by_default(&folder, &format!("{short}/experiment.toml --seeds 4"));
    assert_eq!(more, (4, 2, short.clone()));
    let fewer = folder.run(&format!("sweep {short}/experiment.toml --seeds 3"));
    assert_refused(&fewer, 1, &[&short, "4 seeds a cell"]);
    let (_, found, place) = swept_by_default(&folder, &format!("{short}/experiment.toml --ttis 60"));
    assert!(
        found == 0 && place != short,
        "another experiment gets a separate folder: {place}"
    );
    assert_eq!(folder.list("runs").len(), 3);
}

#[test]
fn a_table_with_fewer_seeds_is_not_reused() {
    let folder = TestFolder::new();
    for index in 1..=2 {
        swept(
            &folder,
            &format!("{GRID} --seeds 3 --shard {index}/2"),
            &format!("s{index}"),
        );
    }
    swept(&folder, &format!("{GRID} --seeds 3"), "whole");
    assert!(folder.run("figures whole --only energy --out a").is_success());
    assert!(folder.run("report whole --out b").is_success());
    for (args, out) in [("--shard 1/2", "s1"), ("", "whole")] {
        let sweep = folder.start(&format!("sweep {GRID} --seeds 100000 {args} --out {out}"));
        let before = folder.journal_lines(out);
        wait_until("runs of the new seeds", PATIENCE, || {
            (folder.journal_lines(out) > before).then_some(())
        });
        sweep.signal(Signal::KILL);
        sweep.finish();
    }
    let parts = [
        "s1: holds no complete table: its sweep is not finished",
        "give its command again",
        "--partial",
    ];
    assert_refused(&folder.run("merge s1 s2 --out m.parquet"), 1, &parts);
    assert!(!folder.join("m.parquet").exists());
    for command in ["figures", "report"] {
        let end = folder.run(&format!("{command} whole --out c"));
        assert_refused(&end, 1, &["whole: holds no complete table: its sweep is not finished"]);
        let end = folder.run(&format!("{command} runtime --out c"));
        assert_refused(
            &end,
            1,
            &["runtime: holds no complete table: it is not the folder of a sweep"],
        );
    }
    assert!(!folder.join("c").exists());
    // State after a kill before the removal of the table.
    let path = folder.join("s2/experiment.toml");
    let text = fs::read_to_string(&path).expect("there");
    fs::write(&path, text.replace("count = 3", "count = 5")).expect("written");
    let parts = [
        "s2: holds no complete table: its experiment.toml asks for 5 seeds a cell",
        "but results.parquet holds 3",
    ];
    assert_refused(&folder.run("merge s2 --partial --out m.parquet"), 1, &parts);
}

#[test]
fn a_kill_between_the_journal_and_the_experiment_is_harmless() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 4"), "fresh");
    for changed in ["runs.journal", "experiment.toml"] {
        for by in ["s/experiment.toml", &format!("{GRID} --seeds 4")] {
            swept(&folder, &format!("{GRID} --seeds 2"), "s");
            let files = ["runs.journal", "experiment.toml", "results.parquet"].map(|name| {
                let path = folder.join(&format!("s/{name}"));
                (name, path.clone(), fs::read(path).expect("there"))
            });
            // Restores everything else.
            swept(&folder, &format!("{GRID} --seeds 4"), "s");
            for (name, path, before) in &files {
                if *name != changed {
                    fs::write(path, before).expect("written");
                }
            }
            let (table, found) = swept(&folder, by, "s");
            assert!(table == expected, "{changed} was raised, {by}");
            let runs = if changed == "runs.journal" { 4 } else { 2 };
            assert_eq!(found, 4 * 2 * runs, "{changed} was raised, {by}");
            fs::remove_dir_all(folder.join("s")).expect("ours");
        }
    }
}

#[test]
fn a_full_disk_while_seeds_are_raised_leaves_the_folder_as_it_was() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 12"), "fresh");
    let path = folder.join("disk");
    let Some(_disk) = Mount::small(&path) else {
        skipped("a small tmpfs cannot be mounted here (it takes root)");
        return;
    };
    swept(&folder, &format!("{GRID} --seeds 10"), "disk/s");
    let (names, ballast) = (folder.list("disk/s"), path.join("ballast"));
    let read = || {
        names
            .clone()
            .into_iter()
            .map(|name| fs::read(path.join("s").join(name)).expect("there"))
    };
    let before: Vec<Vec<u8>> = read().collect();
    let full = fs::write(&ballast, vec![0; 256 * 1024]);
    assert!(full.is_err(), "the disk has more space than requested");
    let end = folder.run(&format!("sweep {GRID} --seeds 12 --out disk/s"));
    assert_refused(
        &end,
        1,
        &[
            "disk/s",
            "runs.journal cannot be used",
            "No space left",
            "free some space",
        ],
    );
    assert_eq!(folder.list("disk/s"), names, "no new files");
    assert!(read().eq(before), "the folder has changed");
    fs::remove_file(ballast).expect("there");
    let (table, found) = swept(&folder, &format!("{GRID} --seeds 12"), "disk/s");
    assert!(table == expected && found == 4 * 2 * 10);
}

#[test]
fn fewer_seeds_and_another_first_one_are_refused() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 4"), "s");
    let journal = || fs::read(folder.join("s/runs.journal")).expect("there");
    let before = journal();
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
        assert!(journal() == before, "{args}: the journal has changed");
    }
    let (table, found) = swept(&folder, &format!("{GRID} --seeds 4"), "s");
    assert!(table == expected && found == 4 * 2 * 4);
}

#[test]
fn a_cell_stops_when_it_is_narrow_enough() {
    let folder = TestFolder::new();
    let args = "--policies genie --devices 20 --ttis 2000 --seeds 400 --until-ci 5% --ci-metrics energy_per_device_tti";
    let end = folder.run(&format!("sweep {args} --json --out s"));
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    let cell = &report["cells"][0];
    let (mean, half) = (
        &cell["metrics"]["energy_per_device_tti"]["mean"],
        &cell["metrics"]["energy_per_device_tti"]["half_width"],
    );
    let width = half.as_f64().expect("a number") / mean.as_f64().expect("a number");
    assert!(width <= 0.05 && cell["runs"].as_u64() < Some(400), "{report}");
    assert_eq!(report["not_narrow"], Value::Array(Vec::new()));

    // Every device can detect every event and has enough energy: no run has a misdetection.
    let args = "--policies random --devices 20 --ttis 500 --seeds 12 --min-seeds 4 --until-ci 50% \
        --set sensing.d_max=28 --set harvest.lambda=1 --ci-metrics misdetection_pct";
    let end = folder.run(&format!("sweep {args} --json --out none"));
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    let cell = &report["cells"][0];
    assert_eq!(cell["metrics"]["misdetection_pct"]["mean"], 0.0, "{report}");
    assert_eq!(cell["runs"], 12, "without misses their rate is unknown");
    let wide = &report["not_narrow"][0];
    assert_eq!(
        (&wide["metric"], &wide["relative_half_width"]),
        (&"misdetection_pct".into(), &Value::Null)
    );
}

#[test]
fn a_cell_that_was_not_narrow_continues_with_more_seeds() {
    let folder = TestFolder::new();
    // With 20 seeds the first check is at 20, with 200 at 30.
    let args = "--policies genie,knn --devices 20 --ttis 500 --until-ci 8% --ci-metrics info_per_event";
    let (expected, _) = swept(&folder, &format!("{args} --seeds 200"), "fresh");
    swept(&folder, &format!("{args} --seeds 20"), "s");
    let (table, found) = swept(&folder, &format!("{args} --seeds 200"), "s");
    assert_eq!(found, 2 * 20);
    assert!(table == expected);
}

#[test]
fn shards_with_more_seeds_equal_a_fresh_sweep() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 7"), "fresh");
    let mut all = 0;
    for index in 1..=3 {
        let (shard, out) = (format!("--shard {index}/3"), format!("s{index}"));
        swept(&folder, &format!("{GRID} --seeds 5 {shard}"), &out);
        let lines = folder.journal_lines(&out);
        assert!((12..=14).contains(&lines), "a third of 40 runs, or so: {lines}");
        let (_, found) = swept(&folder, &format!("{GRID} --seeds 7 {shard}"), &out);
        assert_eq!(found as usize, lines, "a run stays in its shard");
        all += found;
    }
    assert_eq!(all, 4 * 2 * 5);
    let merged = folder.run("merge s1 s2 s3 --out merged.parquet");
    assert!(merged.is_success(), "{merged}");
    assert!(fs::read(folder.join("merged.parquet")).expect("a table") == expected);
}

#[test]
fn a_kill_while_seeds_are_added_loses_no_run() {
    let folder = TestFolder::new();
    let (expected, _) = swept(&folder, &format!("{GRID} --seeds 40"), "fresh");
    swept(&folder, &format!("{GRID} --seeds 20"), "s");
    let journal = folder.join("s/runs.journal");
    let head = || {
        fs::read_to_string(&journal)
            .expect("there")
            .lines()
            .next()
            .map(str::to_owned)
    };
    let mut found = folder.journal_lines("s");
    for more in 1..=10_u64 {
        let before = head();
        let sweep = folder.start(&format!("sweep {GRID} --seeds {} --threads 2 --out s", 20 + more));
        // In half of the cases immediately after the journal is replaced, otherwise slightly before or after.
        if more % 2 == 0 {
            wait_until("the seeds to be raised", PATIENCE, || (head() != before).then_some(()));
        } else {
            std::thread::sleep(Duration::from_micros(1500 * more));
        }
        sweep.signal(Signal::KILL);
        sweep.finish();
        let lines = folder.journal_lines("s");
        println!("kill {more}: {lines} runs after {found}");
        assert!(lines >= found, "finished runs were lost");
        found = lines;
    }
    let (table, again) = swept(&folder, &format!("{GRID} --seeds 40"), "s");
    assert_eq!(again as usize, found, "all runs of the journal are taken over");
    assert!(table == expected);
}
