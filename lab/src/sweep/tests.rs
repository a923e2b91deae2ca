//! Reading, expanding, running and merging experiments.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use reveille_common::declare::FORMER_NAME_NOTICE;
use reveille_common::io::Disk;

use super::*;
use crate::preparation;
use crate::stats;
use crate::table::{ColumnType, Format, SweptValue, Table};

/// A temporary folder that is removed on drop.
struct SweepTestFolder(PathBuf);

impl SweepTestFolder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("reveille-sweep-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).expect("writable");
        Self(path)
    }
}

impl Drop for SweepTestFolder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Stops after some runs have started.
struct Until(AtomicU64);

impl SweepProgress for Until {
    fn planned(&self, _: usize, _: u64) {}
    fn started(&self, _: usize) {
        let _ = self
            .0
            .try_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
    }
    fn finished(&self, _: usize) {}
    fn stop(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
}

fn never() -> Until {
    Until(AtomicU64::new(u64::MAX))
}

fn draft(text: &str) -> Result<ExperimentBuilder, SweepError> {
    ExperimentBuilder::parse(text, "e.toml", Path::new(""))
}

fn grid(text: &str) -> Result<SweepGrid, SweepError> {
    SweepGrid::new(draft(text)?.build()?, &Disk)
}

const SMALL: &str = r#"
policies = ["random", "knn"]
devices = [5, 12]
ttis = 300
seeds = { first = 3, count = 7 }
[grid]
harvest.lambda = [0.1, 1]
"#;

fn swept(grid: &SweepGrid, shard: &str, threads: usize, folder: &Path) -> (SweepResult, Vec<u8>) {
    let mut sweep = Sweep::open(grid, shard.parse().expect("a shard"), folder).expect("a folder");
    let ended = sweep.run(threads, Format::Parquet, &never());
    let finished = ended.expect("no failure").expect("not stopped");
    let bytes = fs::read(&finished.path).expect("written");
    (finished, bytes)
}

#[test]
fn cells_come_in_the_order_of_the_contract() {
    let grid = grid(SMALL).expect("valid");
    let labels: Vec<&str> = grid.cells.iter().map(|cell| cell.label.as_str()).collect();
    assert_eq!(labels[0], "random, devices = 5, ttis = 300, harvest.lambda = 0.1");
    assert_eq!(labels[1], "random, devices = 5, ttis = 300, harvest.lambda = 1");
    assert_eq!(labels[2], "random, devices = 12, ttis = 300, harvest.lambda = 0.1");
    assert_eq!(labels[7], "knn, devices = 12, ttis = 300, harvest.lambda = 1");
    assert_eq!(grid.schema.swept, [("harvest.lambda".to_owned(), ColumnType::Float)]);
    assert_eq!(*grid.cells[7].swept, [SweptValue::Float(1.0)]);
    assert_eq!((grid.cells.len(), grid.run_count()), (8, 56));
    assert_eq!(grid.cells[0].scenario.run.seed, 3);
}

#[test]
fn an_experiment_reads_back_from_its_own_text() {
    let more = format!(
        "until_ci = \"2 %\"\nci_metrics = [\"events\"]\n{SMALL}[set]\nsensing.d_max = 5\n\"class.a.b\" = [1, 2]\n"
    );
    for text in [
        SMALL,
        &more,
        "until_ci = \"100%\"",
        "until_ci = 0.01\nmin_seeds = 5\nseeds = 5",
    ] {
        let experiment = draft(text).expect("valid").build().expect("valid");
        let own = experiment.to_toml();
        let again = draft(&own).expect("valid").build().expect("valid");
        assert_eq!(again.to_toml(), own);
        assert_eq!(again.axes.len(), experiment.axes.len());
        assert_eq!((again.seeds, again.until_ci), (experiment.seeds, experiment.until_ci));
    }
}

#[test]
fn what_cannot_be_run_is_refused_with_its_field() {
    for (text, part) in [
        ("polices = [\"knn\"]", "line 1: unknown field `polices`"),
        ("\n[grid]\nharvest.lamda = [1]", "harvest.lamda"),
        ("devices = []", "an empty list leaves no runs"),
        ("[grid]\nharvest.lambda = []", "harvest.lambda = []"),
        ("[grid]\nharvest.lambda = 1", "such as [1]"),
        ("devices = [10, 10]", "devices = 10: is listed twice"),
        ("devices = [10, 0]", "the cell devices = 0: devices = 0"),
        ("policies = [\"kmm\"]", "policy.name"),
        ("scenario = \"papr\"", "no scenario `papr`"),
        ("seeds = 0", "seeds = 0: must be"),
        ("seeds = { first = 9223372036854775807, count = 2 }", "first_seed"),
        ("seeds = \"many\"", "seeds"),
        ("until_ci = \"0%\"", "until_ci = 0%"),
        ("until_ci = 2", "until_ci = 2"),
        (
            "until_ci = \"1%\"\nci_metrics = [\"colour\"]",
            "the metrics are info_p1, info_per_event",
        ),
        ("until_ci = \"1%\"\nci_metrics = []", "at least one metric"),
        ("until_ci = \"1%\"\nseeds = 1", "at least two runs"),
        ("min_seeds = 4", "only with until_ci"),
        ("until_ci = 1", "write 1 % as 1% or 0.01"),
        ("until_ci = \"5\"", "write 5 % as 5% or 0.05"),
        (
            "until_ci = 0.1\nseeds = 20\nmin_seeds = 21",
            "min_seeds = 21: exceeds the 20 seeds",
        ),
        (
            "devices = [10]\n[set]\ndevices = 5",
            "is set by `set` of e.toml and swept by",
        ),
        (
            "[set]\nradio.false_wake = 0.1\n[grid]\nradio.false_wake_up = [0.2]",
            "radio.false_wake_up = 0.1: is set by",
        ),
        (
            "[set]\nradio.false_wake = 0.1\nradio.false_wake_up = 0.2",
            "radio.false_wake_up = 0.2: is set under its former and its current name by `set` of e.toml",
        ),
        (
            "[grid]\nradio.false_wake = [0.1]\nradio.false_wake_up = [0.2]",
            "radio.false_wake_up = …: is swept twice",
        ),
        ("[grid]\nseed = [1, 2]", "--first-seed"),
        ("devices = [10]\n[grid]\ndevices = [20]", "swept twice"),
        ("devices = 10\nttis", "line 2"),
    ] {
        let message = grid(text).expect_err(text).to_string();
        assert!(message.contains(part), "{text}: {message}");
    }
}

#[test]
fn former_names_of_fields_are_accepted_with_a_warning() {
    let mut above = ExperimentBuilder::default();
    let values = vec![toml::Value::Float(0.2)];
    above.add_axis("--grid", "policy.dt.in_vain", values).expect("valid");
    let file = draft("policies = [\"dt\"]\n[set]\nradio.false_wake = 0.1").expect("valid");
    let experiment = above.with_defaults_from(file).build().expect("valid");
    let [cell] = &SweepGrid::new(experiment, &Disk).expect("valid").cells[..] else {
        panic!("one cell");
    };
    let expected = [
        "radio.false_wake is now called radio.false_wake_up (set by `set` of e.toml); ",
        "policy.dt.in_vain is now called policy.dt.miss_cost (set by --grid); ",
    ];
    assert_eq!(
        cell.warnings,
        expected.map(|start| format!("{start}{FORMER_NAME_NOTICE}"))
    );
}

#[test]
fn the_command_line_wins_over_the_file() {
    let mut above = ExperimentBuilder {
        seed_count: Some(2),
        ..ExperimentBuilder::default()
    };
    above
        .add_axis("--devices", "devices", vec![toml::Value::Integer(9)])
        .expect("valid");
    let experiment = above
        .with_defaults_from(draft(SMALL).expect("valid"))
        .build()
        .expect("valid");
    assert_eq!(experiment.seeds, Seeds { first: 3, count: 2 });
    assert_eq!(experiment.cell_count(), 4);
}

#[test]
fn rows_are_those_of_single_runs() {
    let folder = SweepTestFolder::new("rows");
    let grid = grid(SMALL).expect("valid");
    let (finished, _) = swept(&grid, "1/1", 1, &folder.0);
    assert_eq!(finished.table.rows.len(), 56);
    let mut rows = finished.table.rows.iter();
    for cell in &grid.cells {
        for seed in 3..10 {
            let row = rows.next().expect("a row per run");
            let scenario = cell.with_seed(seed);
            let outcome = preparation::run(&scenario);
            assert_eq!(
                (row.seed, row.n, &*row.policy),
                (seed, scenario.run.devices, scenario.policy.name())
            );
            assert_eq!(row.digest.to_string(), outcome.digest.to_string());
            assert_eq!(row.scenario_hash.to_string(), scenario.hash_hex());
            for (name, value, _) in outcome.metrics.rows() {
                assert_eq!(row.metric(name), Some(value).filter(|value| !value.is_nan()), "{name}");
            }
        }
    }
    assert_eq!(Table::read(&finished.path).expect("readable"), finished.table);
}

#[test]
fn threads_interruptions_and_shards_change_nothing() {
    let (whole, threaded, cut) = (
        SweepTestFolder::new("whole"),
        SweepTestFolder::new("threads"),
        SweepTestFolder::new("interrupted"),
    );
    let grid = grid(SMALL).expect("valid");
    let (_, expected) = swept(&grid, "1/1", 1, &whole.0);
    assert!(swept(&grid, "1/1", 2, &threaded.0).1 == expected, "two threads");

    let mut found = 0;
    for round in 0.. {
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &cut.0).expect("a folder");
        assert!(sweep.known_runs() >= found, "runs were lost");
        found = sweep.known_runs();
        let ended = sweep
            .run(2, Format::Parquet, &Until(AtomicU64::new(7)))
            .expect("no failure");
        assert_eq!(ended.is_some(), cut.0.join("results.parquet").exists(), "round {round}");
        if ended.is_some() {
            assert!(round >= 56 / 7, "it was never interrupted");
            break;
        }
    }
    assert!(
        fs::read(cut.0.join("results.parquet")).expect("finished") == expected,
        "interrupted"
    );

    let shards = SweepTestFolder::new("shards");
    let tables = |of: &[u64], count: u64| -> Vec<(PathBuf, Table)> {
        let one = |index: &u64| {
            let folder = shards.0.join(format!("{index}-{count}"));
            let (finished, _) = swept(&grid, &format!("{index}/{count}"), 1, &folder);
            (finished.path.clone(), Table::read(&finished.path).expect("readable"))
        };
        of.iter().map(one).collect()
    };
    for count in [2, 3, 5] {
        let mut order: Vec<u64> = (1..=count).collect();
        order.rotate_left(1);
        let merged = merge(tables(&order, count), false).expect("whole");
        let path = shards.0.join("merged.parquet");
        merged.write(&path, Format::Parquet).expect("written");
        assert!(fs::read(&path).expect("there") == expected, "{count} shards");
    }
    let missing = merge(tables(&[1, 4], 5), false).expect_err("missing").to_string();
    assert!(
        missing.contains("3 of 5 shards are missing: 2/5, 3/5, 5/5"),
        "{missing}"
    );
    let partial = merge(tables(&[1, 4], 5), true).expect("partial");
    assert_eq!(
        (partial.rows.len(), partial.metadata.shard.as_deref()),
        (11 + 11, Some("1,4/5"))
    );
    let twice = merge(tables(&[2, 2], 2), true).expect_err("twice").to_string();
    assert!(twice.contains("name each shard once"), "{twice}");
    let mixed = [tables(&[1], 2), tables(&[2], 3)].concat();
    let mixed = merge(mixed, true).expect_err("mixed").to_string();
    assert!(mixed.contains("is shard 2/3, but"), "{mixed}");
}

#[test]
fn runs_of_another_sweep_are_taken_over_and_change_nothing() {
    let (first, fresh, own) = (
        SweepTestFolder::new("first"),
        SweepTestFolder::new("fresh"),
        SweepTestFolder::new("own"),
    );
    let (made, _) = swept(&grid(SMALL).expect("valid"), "1/1", 2, &first.0);
    // Half of its cells, more seeds, and a number of devices that it lacks.
    let other = grid(
        "policies = [\"knn\"]\ndevices = [12, 20]\nttis = 300\nseeds = { first = 1, count = 10 }\n[grid]\n\
         harvest.lambda = [1, 0.1, 0.3]\n",
    );
    let other = other.expect("valid");
    let (_, expected) = swept(&other, "1/1", 2, &fresh.0);

    let mut known = vec![(made.path, made.table)];
    let mut sweep = Sweep::open(&other, Shard::WHOLE, &own.0).expect("a folder");
    let taken = sweep.reuse(&ReusableRuns::from_tables(&known).expect("of this version"));
    // Seeds 3 to 9 with both rates for 12 devices.
    assert_eq!((taken.expect("written"), sweep.known_runs()), (14, 14));
    assert_eq!(
        sweep
            .reuse(&ReusableRuns::from_tables(&known).expect("the same"))
            .expect("written"),
        0
    );
    drop(sweep);
    assert!(swept(&other, "1/1", 2, &own.0).1 == expected, "the table differs");

    known[0].1.metadata.version = "0.0.1".to_owned();
    let refused = ReusableRuns::from_tables(&known)
        .expect_err("another version")
        .to_string();
    assert!(refused.contains("--reuse") && refused.contains("0.0.1"), "{refused}");
}

#[test]
fn tables_that_do_not_fit_are_not_merged() {
    let folder = SweepTestFolder::new("misfits");
    let table = |text: &str, shard: &str, name: &str| {
        let (finished, _) = swept(&grid(text).expect("valid"), shard, 1, &folder.0.join(name));
        (finished.path, finished.table)
    };
    let first = table(SMALL, "1/2", "first");
    let refused = |other: (PathBuf, Table), part: &str| {
        let message = merge(vec![first.clone(), other], false).expect_err(part).to_string();
        assert!(message.contains(part), "{message}");
    };
    refused(table(&SMALL.replace("12", "13"), "2/2", "other"), "devices = [5, 13]");
    refused(
        table(SMALL, "1/1", "whole"),
        "cannot be merged: it is the table of a whole sweep",
    );
    let second = table(SMALL, "2/2", "second");
    let mut version = second.clone();
    version.1.metadata.version = "9.9.9".to_owned();
    refused(version, "reveille 9.9.9");
    let mut scenario = second.clone();
    scenario.1.metadata.grid = "0".repeat(64);
    refused(scenario, "scenario files or traces");
    let mut short = second;
    short.1.rows.pop();
    refused(short, "27 rows that are not the 28 runs");
}

#[test]
fn csv_shards_whose_text_looks_like_numbers_are_merged() {
    let folder = SweepTestFolder::new("kinds");
    let trace = folder.0.join("t.csv");
    fs::write(&trace, "5,abc\n1,2\n2,1\n").expect("writable");
    let text = format!(
        "devices = 4\nttis = 50\nseeds = 1\n[set]\nharvest.kind = \"trace\"\nharvest.trace.file = {}\n\
         [grid]\nharvest.trace.column = [\"5\", \"abc\"]\n",
        toml::Value::String(trace.to_string_lossy().into_owned())
    );
    let grid = grid(&text).expect("valid");
    let whole = swept(&grid, "1/1", 1, &folder.0.join("whole")).0.table;
    let shards = |is_told: bool| -> Vec<(PathBuf, Table)> {
        let one = |shard: &str| {
            let table = swept(&grid, shard, 1, &folder.0.join(shard)).0.table;
            let path = folder.0.join(shard).join("results.csv");
            table.write(&path, Format::Csv).expect("written");
            if !is_told {
                let side = folder.0.join(shard).join("results.csv.toml");
                let lines = fs::read_to_string(&side).expect("there");
                let kept = lines.lines().filter(|line| !line.contains("reveille.kinds"));
                fs::write(&side, kept.collect::<Vec<_>>().join("\n")).expect("written");
            }
            (path.clone(), Table::read(&path).expect("readable"))
        };
        ["1/2", "2/2"].map(one).into()
    };
    for is_told in [true, false] {
        let merged = merge(shards(is_told), false).expect("whole");
        assert_eq!(merged, whole, "kinds told: {is_told}");
        let path = folder.0.join("merged.parquet");
        merged.write(&path, Format::Parquet).expect("one kind for all");
    }
}

#[test]
fn a_folder_of_another_sweep_is_refused() {
    let folder = SweepTestFolder::new("foreign");
    let small = grid(SMALL).expect("valid");
    swept(&small, "1/1", 1, &folder.0);
    let other = grid(&SMALL.replace("300", "301")).expect("valid");
    for (grid, shard) in [(&other, "1/1"), (&small, "1/2")] {
        let refused = Sweep::open(grid, shard.parse().expect("a shard"), &folder.0);
        let message = refused.expect_err("another").to_string();
        assert!(message.contains("another experiment, shard or version"), "{message}");
    }
    let elsewhere = SweepTestFolder::new("elsewhere");
    fs::write(elsewhere.0.join("thesis.tex"), "").expect("writable");
    let message = Sweep::open(&small, Shard::WHOLE, &elsewhere.0)
        .expect_err("not empty")
        .to_string();
    assert!(message.contains("thesis.tex"), "{message}");
}

#[test]
fn a_cell_stops_at_the_first_look_at_which_it_is_narrow() {
    let text = "policies = [\"knn\", \"genie\"]\ndevices = 12\nttis = 2000\nseeds = 200\nmin_seeds = 5\n\
                until_ci = \"8%\"\nci_metrics = [\"energy_per_device_tti\", \"info_per_event\"]\n";
    let grid = grid(text).expect("valid");
    let (one, two, cut) = (
        SweepTestFolder::new("ci-1"),
        SweepTestFolder::new("ci-2"),
        SweepTestFolder::new("ci-cut"),
    );
    let (finished, expected) = swept(&grid, "1/1", 1, &one.0);
    assert!(swept(&grid, "1/1", 2, &two.0).1 == expected, "two threads");
    loop {
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &cut.0).expect("a folder");
        if sweep
            .run(2, Format::Parquet, &Until(AtomicU64::new(9)))
            .expect("no failure")
            .is_some()
        {
            break;
        }
    }
    assert!(
        fs::read(cut.0.join("results.parquet")).expect("finished") == expected,
        "interrupted"
    );

    // The expected decision: all prefixes at the checks, with the two-pass formulas.
    let looks = [5u64, 15, 25, 35, 45, 65, 85, 115, 145, 185, 200];
    let until = grid.experiment.until_ci.as_ref().expect("set");
    let steps: Vec<u64> = std::iter::successors(Some(5), |&runs| Some(until.next_check(runs, 200)))
        .take(11)
        .collect();
    assert_eq!(steps, looks);
    let cells = stats::group_by_cell(&finished.table);
    for (cell, end) in cells.iter().zip(&finished.cells) {
        assert_eq!(cell.rows.len() as u64, end.runs);
        let narrow = |runs: u64| {
            until.metrics.iter().all(|name| {
                let values: Vec<f64> = cell
                    .rows
                    .iter()
                    .take(runs as usize)
                    .filter_map(|row| row.metric(name))
                    .collect();
                let count = values.len() as f64;
                let mean = values.iter().sum::<f64>() / count;
                let variance = values.iter().map(|value| (value - mean) * (value - mean)).sum::<f64>() / (count - 1.0);
                stats::student_t_quantile_95(values.len() - 1) * (variance / count).sqrt() / mean <= 0.08
            })
        };
        let first = looks
            .into_iter()
            .find(|&runs| runs == 200 || (runs <= end.runs && narrow(runs)));
        assert_eq!(first, Some(end.runs), "{}", cell.policy);
    }
    assert!(
        finished.cells[0].runs < 200 && finished.cells[0].runs > 5,
        "{:?}",
        finished.cells
    );
}

#[test]
fn the_fewest_seeds_are_part_of_a_sweep_if_they_are_asked_for() {
    let folder = SweepTestFolder::new("min-seeds");
    let with = |min_seeds: &str| {
        let text = "devices = 4\nttis = 50\nuntil_ci = \"90%\"\nci_metrics = [\"events\"]\nseeds = 40\n";
        grid(&format!("{text}{min_seeds}")).expect("valid")
    };
    swept(&with("min_seeds = 5"), "1/1", 1, &folder.0);
    for other in ["min_seeds = 6", ""] {
        let message = Sweep::open(&with(other), Shard::WHOLE, &folder.0)
            .expect_err(other)
            .to_string();
        assert!(message.contains("another experiment"), "{message}");
    }
    assert_ne!(
        experiment_hash(&with("min_seeds = 5")),
        experiment_hash(&with("min_seeds = 6"))
    );
    assert_eq!(
        experiment_hash(&with("min_seeds = 30")),
        experiment_hash(&with("")),
        "the default"
    );
}

#[test]
fn a_raised_folder_loses_its_old_table_and_no_other() {
    let folder = SweepTestFolder::new("stale");
    let with = |count: u64| grid(&SMALL.replace("count = 7", &format!("count = {count}"))).expect("valid");
    let of = |count: u64, format: Format| {
        let grid = with(count);
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &folder.0).expect("a folder");
        sweep
            .run(1, format, &never())
            .expect("no failure")
            .expect("not stopped");
    };
    of(2, Format::Parquet);
    of(2, Format::Csv);
    let tables = ["results.csv", "results.csv.toml", "results.parquet"];
    let there = || tables.map(|name| folder.0.join(name).exists());
    assert_eq!(there(), [true; 3], "tables of the same seeds");
    let one = with(1);
    let fewer = Sweep::open(&one, Shard::WHOLE, &folder.0)
        .expect_err("fewer")
        .to_string();
    assert!(fewer.contains("2 seeds a cell"), "{fewer}");
    assert_eq!(there(), [true; 3], "nothing was raised");
    assert!(find_table(&folder.0).is_ok());
    drop(Sweep::open(&with(3), Shard::WHOLE, &folder.0).expect("a folder"));
    assert_eq!(there(), [false; 3], "the journal lacks runs");
    let missing = find_table(&folder.0).expect_err("no table").to_string();
    assert!(missing.contains("its sweep is not finished"), "{missing}");
    of(3, Format::Csv);
    assert_eq!(there(), [true, true, false]);
    assert_eq!(find_table(&folder.0).expect("a table"), folder.0.join("results.csv"));

    // A table with fewer seeds than the experiment next to it is refused.
    let path = folder.0.join("experiment.toml");
    let text = fs::read_to_string(&path).expect("there");
    fs::write(&path, text.replace("count = 3", "count = 4")).expect("written");
    let refused = find_table(&folder.0).expect_err("other seeds").to_string();
    assert!(
        refused.contains("asks for 4 seeds a cell, but results.csv holds 3"),
        "{refused}"
    );
}

#[test]
fn shards_cannot_tell_when_a_cell_has_enough() {
    let folder = SweepTestFolder::new("ci-shard");
    let grid = grid("until_ci = \"1%\"").expect("valid");
    let message = Sweep::open(&grid, "1/2".parse().expect("a shard"), &folder.0)
        .expect_err("both")
        .to_string();
    assert!(message.contains("shard = 1/2: excludes until_ci"), "{message}");
}
