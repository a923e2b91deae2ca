//! Tests of experiments ([`ExperimentBuilder`], [`SweepGrid`]), of [`Sweep`] and its folder, of [`merge`] and of
//! [`ReusableRuns`]. Rows are compared with single runs, and the tables of threads, interruptions and shards with the
//! table of one uninterrupted sweep. Not checked: killed processes, which `tests/program/sweep.rs` covers.

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

/// Stops after this number of started runs.
struct StopAfterRuns(AtomicU64);

impl SweepProgress for StopAfterRuns {
    fn planned(&self, _: usize, _: u64) {}
    fn started(&self, _: usize) {
        let _ = self
            .0
            .try_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
    }
    fn finished(&self, _: usize) {}
    fn should_stop(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
}

fn never_stop() -> StopAfterRuns {
    StopAfterRuns(AtomicU64::new(u64::MAX))
}

fn parse_experiment(text: &str) -> Result<ExperimentBuilder, SweepError> {
    ExperimentBuilder::parse(text, "e.toml", Path::new(""))
}

fn parse_grid(text: &str) -> Result<SweepGrid, SweepError> {
    SweepGrid::new(parse_experiment(text)?.build()?, &Disk)
}

/// The experiment of most tests: 8 cells with 7 seeds each, 56 runs. Tests vary it by replacing `12`, `300` and
/// `count = 7` in this text.
const SMALL: &str = r#"
policies = ["random", "knn"]
devices = [5, 12]
ttis = 300
seeds = { first = 3, count = 7 }
[grid]
harvest.lambda = [0.1, 1]
"#;

/// Runs a shard of `grid`, `1/1` for all of it. Returns its result and the bytes of its table.
fn run_sweep(grid: &SweepGrid, shard: &str, threads: usize, folder: &Path) -> (SweepResult, Vec<u8>) {
    let mut sweep = Sweep::open(grid, shard.parse().expect("a shard"), folder).expect("a folder");
    let ended = sweep.run(threads, Format::Parquet, &never_stop());
    let finished = ended.expect("no failure").expect("not stopped");
    let bytes = fs::read(&finished.path).expect("written");
    (finished, bytes)
}

#[test]
fn cells_have_the_documented_order() {
    let grid = parse_grid(SMALL).expect("valid");
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
fn an_experiment_round_trips() {
    let with_optional_fields = format!(
        "until_ci = \"2 %\"\nci_metrics = [\"events\"]\n{SMALL}[set]\nsensing.d_max = 5\n\"class.a.b\" = [1, 2]\n"
    );
    for text in [
        SMALL,
        &with_optional_fields,
        "until_ci = \"100%\"",
        "until_ci = 0.01\nmin_seeds = 5\nseeds = 5",
    ] {
        let experiment = parse_experiment(text).expect("valid").build().expect("valid");
        let written = experiment.to_toml();
        let read = parse_experiment(&written).expect("valid").build().expect("valid");
        assert_eq!(read.to_toml(), written);
        assert_eq!(read.axes.len(), experiment.axes.len());
        assert_eq!((read.seeds, read.until_ci), (experiment.seeds, experiment.until_ci));
    }
}

#[test]
fn an_invalid_experiment_is_refused_with_the_field() {
    for (text, cause) in [
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
        let message = parse_grid(text).expect_err(text).to_string();
        assert!(message.contains(cause), "{text}: {message}");
    }
}

#[test]
fn a_script_of_actions_reads_back_and_is_part_of_the_identity() {
    let grid_with_script = |script: &str| {
        let mut builder = parse_experiment("devices = [9]\nttis = 50\nseeds = 2").expect("valid");
        builder.actions = Some(SweepActions::Script(script.to_owned()));
        SweepGrid::new(builder.build().expect("valid"), &Disk)
    };
    let mut texts = Vec::new();
    for script in ["", "\n\n5 fail 3", "5 fail 3\r\n# \"a\" \\ '''b''' \u{1} é", "6 fail 3"] {
        let text = grid_with_script(script).expect("valid").experiment.to_toml();
        let read = parse_experiment(&text).expect(&text);
        assert_eq!(read.actions, Some(SweepActions::Script(script.to_owned())), "{text}");
        assert_eq!(read.build().expect("valid").to_toml(), text);
        assert!(!texts.contains(&text), "{text}");
        texts.push(text);
    }
    let error = grid_with_script("5 fail 9").expect_err("9 devices").to_string();
    assert!(
        error.contains("action_script: line 1: device 9: not in the run") && error.contains("in the cell devices = 9"),
        "{error}"
    );
}

#[test]
fn former_names_of_fields_are_accepted_with_a_warning() {
    let mut options = ExperimentBuilder::default();
    let values = vec![toml::Value::Float(0.2)];
    options.add_axis("--grid", "policy.dt.in_vain", values).expect("valid");
    let file = parse_experiment("policies = [\"dt\"]\n[set]\nradio.false_wake = 0.1").expect("valid");
    let experiment = options.with_defaults_from(file).build().expect("valid");
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
fn options_of_the_command_line_replace_those_of_the_file() {
    let mut options = ExperimentBuilder {
        seed_count: Some(2),
        ..ExperimentBuilder::default()
    };
    options
        .add_axis("--devices", "devices", vec![toml::Value::Integer(9)])
        .expect("valid");
    let experiment = options
        .with_defaults_from(parse_experiment(SMALL).expect("valid"))
        .build()
        .expect("valid");
    assert_eq!(experiment.seeds, Seeds { first: 3, count: 2 });
    assert_eq!(experiment.cell_count(), 4);
}

#[test]
fn rows_equal_single_runs() {
    let folder = SweepTestFolder::new("rows");
    let grid = parse_grid(SMALL).expect("valid");
    let (finished, _) = run_sweep(&grid, "1/1", 1, &folder.0);
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
fn threads_interruptions_and_shards_give_the_same_table() {
    const RUNS_PER_ROUND: u64 = 7;
    let (whole, threaded, interrupted) = (
        SweepTestFolder::new("whole"),
        SweepTestFolder::new("threads"),
        SweepTestFolder::new("interrupted"),
    );
    let grid = parse_grid(SMALL).expect("valid");
    let (_, expected) = run_sweep(&grid, "1/1", 1, &whole.0);
    assert!(run_sweep(&grid, "1/1", 2, &threaded.0).1 == expected, "two threads");

    let mut known_runs = 0;
    for round in 0_u64.. {
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &interrupted.0).expect("a folder");
        assert!(sweep.known_runs() >= known_runs, "runs were lost");
        known_runs = sweep.known_runs();
        let ended = sweep
            .run(2, Format::Parquet, &StopAfterRuns(AtomicU64::new(RUNS_PER_ROUND)))
            .expect("no failure");
        assert_eq!(
            ended.is_some(),
            interrupted.0.join("results.parquet").exists(),
            "round {round}"
        );
        if ended.is_some() {
            assert!(round >= 56 / RUNS_PER_ROUND, "the sweep was not interrupted");
            break;
        }
    }
    assert!(
        fs::read(interrupted.0.join("results.parquet")).expect("finished") == expected,
        "interrupted"
    );

    let shards = SweepTestFolder::new("shards");
    let tables = |indices: &[u64], count: u64| -> Vec<(PathBuf, Table)> {
        let run_shard = |index: &u64| {
            let folder = shards.0.join(format!("{index}-{count}"));
            let (finished, _) = run_sweep(&grid, &format!("{index}/{count}"), 1, &folder);
            (finished.path.clone(), Table::read(&finished.path).expect("readable"))
        };
        indices.iter().map(run_shard).collect()
    };
    for count in [2, 3, 5] {
        // Not in their order.
        let mut indices: Vec<u64> = (1..=count).collect();
        indices.rotate_left(1);
        let merged = merge(tables(&indices, count), false).expect("whole");
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
        // 11 of the 56 runs each.
        (11 + 11, Some("1,4/5"))
    );
    let twice = merge(tables(&[2, 2], 2), true).expect_err("twice").to_string();
    assert!(twice.contains("name each shard once"), "{twice}");
    let mixed = [tables(&[1], 2), tables(&[2], 3)].concat();
    let mixed = merge(mixed, true).expect_err("mixed").to_string();
    assert!(mixed.contains("is shard 2/3, but"), "{mixed}");
}

#[test]
fn reused_runs_of_another_sweep_give_the_same_table() {
    let (known_folder, without_reuse, with_reuse) = (
        SweepTestFolder::new("known"),
        SweepTestFolder::new("without-reuse"),
        SweepTestFolder::new("with-reuse"),
    );
    let (known, _) = run_sweep(&parse_grid(SMALL).expect("valid"), "1/1", 2, &known_folder.0);
    // Half of its cells, more seeds, and a number of devices that it lacks.
    let other = parse_grid(
        "policies = [\"knn\"]\ndevices = [12, 20]\nttis = 300\nseeds = { first = 1, count = 10 }\n[grid]\n\
         harvest.lambda = [1, 0.1, 0.3]\n",
    );
    let other = other.expect("valid");
    let (_, expected) = run_sweep(&other, "1/1", 2, &without_reuse.0);

    let mut known_tables = vec![(known.path, known.table)];
    let mut sweep = Sweep::open(&other, Shard::WHOLE, &with_reuse.0).expect("a folder");
    let reused = sweep.reuse(&ReusableRuns::from_tables(&known_tables).expect("of this version"));
    // Seeds 3 to 9 with both rates for 12 devices.
    assert_eq!((reused.expect("written"), sweep.known_runs()), (14, 14));
    assert_eq!(
        sweep
            .reuse(&ReusableRuns::from_tables(&known_tables).expect("the same"))
            .expect("written"),
        0
    );
    drop(sweep);
    assert!(
        run_sweep(&other, "1/1", 2, &with_reuse.0).1 == expected,
        "the table differs"
    );

    known_tables[0].1.metadata.version = "0.0.1".to_owned();
    let refused = ReusableRuns::from_tables(&known_tables)
        .expect_err("another version")
        .to_string();
    assert!(refused.contains("--reuse") && refused.contains("0.0.1"), "{refused}");
}

#[test]
fn tables_of_different_sweeps_are_not_merged() {
    let folder = SweepTestFolder::new("mismatches");
    let table = |text: &str, shard: &str, name: &str| {
        let (finished, _) = run_sweep(&parse_grid(text).expect("valid"), shard, 1, &folder.0.join(name));
        (finished.path, finished.table)
    };
    let first = table(SMALL, "1/2", "first");
    let assert_refused = |other: (PathBuf, Table), cause: &str| {
        let message = merge(vec![first.clone(), other], false).expect_err(cause).to_string();
        assert!(message.contains(cause), "{message}");
    };
    assert_refused(table(&SMALL.replace("12", "13"), "2/2", "other"), "devices = [5, 13]");
    assert_refused(
        table(SMALL, "1/1", "whole"),
        "cannot be merged: it is the table of a whole sweep",
    );
    let second = table(SMALL, "2/2", "second");
    let mut other_version = second.clone();
    other_version.1.metadata.version = "9.9.9".to_owned();
    assert_refused(other_version, "reveille 9.9.9");
    let mut other_files = second.clone();
    other_files.1.metadata.grid_hash = "0".repeat(64);
    assert_refused(other_files, "scenario files or traces");
    let mut incomplete = second;
    incomplete.1.rows.pop();
    assert_refused(incomplete, "27 rows, not the 28 runs");
}

#[test]
fn csv_shards_with_text_of_digits_are_merged() {
    let folder = SweepTestFolder::new("kinds");
    let trace = folder.0.join("t.csv");
    fs::write(&trace, "5,abc\n1,2\n2,1\n").expect("writable");
    let text = format!(
        "devices = 4\nttis = 50\nseeds = 1\n[set]\nharvest.kind = \"trace\"\nharvest.trace.file = {}\n\
         [grid]\nharvest.trace.column = [\"5\", \"abc\"]\n",
        toml::Value::String(trace.to_string_lossy().into_owned())
    );
    let grid = parse_grid(&text).expect("valid");
    let whole = run_sweep(&grid, "1/1", 1, &folder.0.join("whole")).0.table;
    let shards = |has_types: bool| -> Vec<(PathBuf, Table)> {
        let run_shard = |shard: &str| {
            let table = run_sweep(&grid, shard, 1, &folder.0.join(shard)).0.table;
            let path = folder.0.join(shard).join("results.csv");
            table.write(&path, Format::Csv).expect("written");
            if !has_types {
                let sidecar = folder.0.join(shard).join("results.csv.toml");
                let lines = fs::read_to_string(&sidecar).expect("there");
                let other_lines = lines.lines().filter(|line| !line.contains("reveille.kinds"));
                fs::write(&sidecar, other_lines.collect::<Vec<_>>().join("\n")).expect("written");
            }
            (path.clone(), Table::read(&path).expect("readable"))
        };
        ["1/2", "2/2"].map(run_shard).into()
    };
    for has_types in [true, false] {
        let merged = merge(shards(has_types), false).expect("whole");
        assert_eq!(merged, whole, "column types in the side-car: {has_types}");
        let path = folder.0.join("merged.parquet");
        merged.write(&path, Format::Parquet).expect("one type per column");
    }
}

#[test]
fn a_folder_of_another_sweep_is_refused() {
    let folder = SweepTestFolder::new("foreign");
    let small = parse_grid(SMALL).expect("valid");
    run_sweep(&small, "1/1", 1, &folder.0);
    let other = parse_grid(&SMALL.replace("300", "301")).expect("valid");
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
fn a_cell_stops_at_the_first_check_with_narrow_intervals() {
    let text = "policies = [\"knn\", \"genie\"]\ndevices = 12\nttis = 2000\nseeds = 200\nmin_seeds = 5\n\
                until_ci = \"8%\"\nci_metrics = [\"energy_per_device_tti\", \"info_per_event\"]\n";
    let grid = parse_grid(text).expect("valid");
    let (one_thread, two_threads, interrupted) = (
        SweepTestFolder::new("ci-1"),
        SweepTestFolder::new("ci-2"),
        SweepTestFolder::new("ci-cut"),
    );
    let (finished, expected) = run_sweep(&grid, "1/1", 1, &one_thread.0);
    assert!(run_sweep(&grid, "1/1", 2, &two_threads.0).1 == expected, "two threads");
    loop {
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &interrupted.0).expect("a folder");
        if sweep
            .run(2, Format::Parquet, &StopAfterRuns(AtomicU64::new(9)))
            .expect("no failure")
            .is_some()
        {
            break;
        }
    }
    assert!(
        fs::read(interrupted.0.join("results.parquet")).expect("finished") == expected,
        "interrupted"
    );

    // The expected decision: the intervals of the first runs at each check, with the two-pass formulas. The first check
    // follows after `min_seeds` runs; each later one adds a quarter, rounded up to a multiple of ten.
    let expected_checks = [5u64, 15, 25, 35, 45, 65, 85, 115, 145, 185, 200];
    let until = grid.experiment.until_ci.as_ref().expect("set");
    let checks: Vec<u64> = std::iter::successors(Some(5), |&runs| Some(until.next_check(runs, 200)))
        .take(expected_checks.len())
        .collect();
    assert_eq!(checks, expected_checks);
    let cells = stats::group_by_cell(&finished.table);
    for (cell, summary) in cells.iter().zip(&finished.cells) {
        assert_eq!(cell.rows.len() as u64, summary.runs);
        let is_narrow = |runs: u64| {
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
                stats::student_t_quantile_95(values.len() - 1) * (variance / count).sqrt() / mean <= until.target
            })
        };
        let expected_runs = expected_checks
            .into_iter()
            .find(|&runs| runs == 200 || (runs <= summary.runs && is_narrow(runs)));
        assert_eq!(expected_runs, Some(summary.runs), "{}", cell.policy);
    }
    // The test relies on a cell that ends between the first check and the last seed.
    assert!(
        finished.cells[0].runs < 200 && finished.cells[0].runs > 5,
        "the cell ran all seeds or no more than the fewest: {:?}",
        finished.cells
    );
}

#[test]
fn min_seeds_identify_a_sweep_unless_they_are_the_default() {
    let folder = SweepTestFolder::new("min-seeds");
    let grid_with = |min_seeds: &str| {
        let text = "devices = 4\nttis = 50\nuntil_ci = \"90%\"\nci_metrics = [\"events\"]\nseeds = 40\n";
        parse_grid(&format!("{text}{min_seeds}")).expect("valid")
    };
    run_sweep(&grid_with("min_seeds = 5"), "1/1", 1, &folder.0);
    for other in ["min_seeds = 6", ""] {
        let message = Sweep::open(&grid_with(other), Shard::WHOLE, &folder.0)
            .expect_err(other)
            .to_string();
        assert!(message.contains("another experiment"), "{message}");
    }
    assert_ne!(
        experiment_hash(&grid_with("min_seeds = 5")),
        experiment_hash(&grid_with("min_seeds = 6"))
    );
    // 30 is `UntilCi::MIN_SEEDS`.
    assert_eq!(
        experiment_hash(&grid_with("min_seeds = 30")),
        experiment_hash(&grid_with("")),
        "the default"
    );
}

#[test]
fn raising_the_seeds_removes_outdated_tables() {
    let folder = SweepTestFolder::new("stale");
    let grid_with = |count: u64| parse_grid(&SMALL.replace("count = 7", &format!("count = {count}"))).expect("valid");
    let sweep_with = |count: u64, format: Format| {
        let grid = grid_with(count);
        let mut sweep = Sweep::open(&grid, Shard::WHOLE, &folder.0).expect("a folder");
        sweep
            .run(1, format, &never_stop())
            .expect("no failure")
            .expect("not stopped");
    };
    sweep_with(2, Format::Parquet);
    sweep_with(2, Format::Csv);
    let names = ["results.csv", "results.csv.toml", "results.parquet"];
    let exist = || names.map(|name| folder.0.join(name).exists());
    assert_eq!(exist(), [true; 3], "tables of the same seeds");
    let fewer_seeds = grid_with(1);
    let message = Sweep::open(&fewer_seeds, Shard::WHOLE, &folder.0)
        .expect_err("fewer")
        .to_string();
    assert!(message.contains("2 seeds a cell"), "{message}");
    assert_eq!(exist(), [true; 3], "nothing was raised");
    assert!(find_table(&folder.0).is_ok());
    drop(Sweep::open(&grid_with(3), Shard::WHOLE, &folder.0).expect("a folder"));
    assert_eq!(exist(), [false; 3], "the journal lacks runs");
    let message = find_table(&folder.0).expect_err("no table").to_string();
    assert!(message.contains("its sweep is not finished"), "{message}");
    sweep_with(3, Format::Csv);
    assert_eq!(exist(), [true, true, false]);
    assert_eq!(find_table(&folder.0).expect("a table"), folder.0.join("results.csv"));

    // A table with fewer seeds than the experiment next to it is refused.
    let path = folder.0.join("experiment.toml");
    let text = fs::read_to_string(&path).expect("there");
    fs::write(&path, text.replace("count = 3", "count = 4")).expect("written");
    let message = find_table(&folder.0).expect_err("other seeds").to_string();
    assert!(
        message.contains("asks for 4 seeds a cell, but results.csv holds 3"),
        "{message}"
    );
}

#[test]
fn shards_exclude_until_ci() {
    let folder = SweepTestFolder::new("ci-shard");
    let grid = parse_grid("until_ci = \"1%\"").expect("valid");
    let message = Sweep::open(&grid, "1/2".parse().expect("a shard"), &folder.0)
        .expect_err("both")
        .to_string();
    assert!(message.contains("shard = 1/2: excludes until_ci"), "{message}");
}
