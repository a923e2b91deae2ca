//! The commands `sweep` and `merge`: the same bytes with any threads, shards, kills and full disks; rows equal single
//! runs; refusals before the first run. `sweep_seeds.rs` tests the number of seeds.

use std::fs;
use std::io::Read as _;
use std::path::Path;
use std::time::Duration;

use reveille_common::score::Metrics;
use reveille_tests::machine::{Mount, print_skipped};
use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, now, wait_until};
use rustix::process::Signal;
use serde_json::Value;

/// Options of a sweep of about two hundred short runs over four policies. Two tests below repeat them, as options of a
/// single run and in an experiment file.
const GRID: &str = "--policies knn,random,adjusted,genie --devices 8,20 --ttis 600 --seeds 12 --first-seed 5 \
    --grid harvest.lambda=0.05,0.1 --set policy.adjusted.pilot_ttis=100 --set policy.adjusted.t_on=[1,2] \
    --set policy.adjusted.t_drx=[2,8]";
/// Number of runs of [`GRID`].
const RUNS: usize = 4 * 2 * 12 * 2;

/// Runs `reveille sweep ARGS --out OUT` and returns the bytes of its Parquet table.
fn sweep_table(folder: &TestFolder, args: &str, out: &str) -> Vec<u8> {
    let finished = folder.run(&format!("sweep {args} --out {out} --quiet"));
    assert!(finished.is_success(), "{finished}");
    fs::read(folder.join(&format!("{out}/results.parquet"))).expect("a table")
}

/// Reads the rows of a CSV file as pairs of a column name and a value.
fn read_rows(path: &Path) -> Vec<Vec<(String, String)>> {
    let text = fs::read_to_string(path).expect("a table");
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let row = |line: &str| {
        let values = line.split(',');
        names
            .iter()
            .map(|name| (*name).to_owned())
            .zip(values.map(str::to_owned))
            .collect()
    };
    lines.map(row).collect()
}

#[test]
fn threads_and_shards_do_not_change_the_table() {
    let folder = TestFolder::new();
    let expected = sweep_table(&folder, &format!("{GRID} --threads 1"), "one");
    assert!(
        sweep_table(&folder, &format!("{GRID} --threads 2"), "two") == expected,
        "2 threads"
    );
    for (index, threads) in [(1, 2), (2, 1), (3, 2)] {
        sweep_table(
            &folder,
            &format!("{GRID} --threads {threads} --shard {index}/3"),
            &format!("s{index}"),
        );
    }
    let merged = folder.run("merge s3 s1/results.parquet s2 --out merged.parquet");
    assert!(merged.is_success(), "{merged}");
    assert!(merged.stdout.starts_with(&format!("{RUNS} runs")), "{merged}");
    assert!(
        fs::read(folder.join("merged.parquet")).expect("a table") == expected,
        "3 shards"
    );

    let incomplete = folder.run("merge s1 s3 --out incomplete.parquet");
    assert_refused(&incomplete, 1, &["1 of 3 shards are missing: 2/3", "--partial"]);
    assert!(!folder.join("incomplete.parquet").exists());
    let partial = folder.run("merge s1 s3 --partial --out partial.parquet");
    assert!(partial.stdout.contains("from shards 1,3/3 only"), "{partial}");
    for out in ["s2/results.parquet", "s1/../s2/results.parquet"] {
        let onto_input = folder.run(&format!("merge s1 s2 s3 --out {out}"));
        assert_refused(&onto_input, 1, &[out, "is one of the tables to merge"]);
    }
    folder.write("taken.csv", "a text");
    let taken = folder.run("merge s1 s2 s3 --out taken.csv");
    assert_refused(&taken, 1, &["taken.csv: file exists", "--force"]);
    let scenario = folder.run("merge s1 s2 s3 --force --out my.toml");
    assert_refused(&scenario, 1, &["--out my.toml", ".parquet or .csv"]);
    assert!(!folder.join("my.toml").exists() && folder.bytes("taken.csv") == b"a text");
    assert!(folder.run("merge s1 s2 s3 --force --out taken.csv").is_success());
    assert!(folder.bytes("taken.csv").starts_with(b"scenario_hash"));
    let duplicate = folder.run("merge s1 s1 --out twice.parquet");
    assert_refused(&duplicate, 1, &["s1/results.parquet", "name each shard once"]);
}

#[test]
fn rows_of_the_table_equal_single_runs() {
    let folder = TestFolder::new();
    let finished = folder.run(&format!("sweep {GRID} --format csv --quiet --out s"));
    assert!(finished.is_success(), "{finished}");
    let rows = read_rows(&folder.join("s/results.csv"));
    assert_eq!(rows.len(), RUNS);
    // The first row, the last and some between them.
    for row in [0, 17, 60, 101, 133, RUNS - 1] {
        let get = |name: &str| {
            let field = rows[row].iter().find(|(known, _)| known == name);
            &field.unwrap_or_else(|| panic!("no column {name}")).1
        };
        let command = format!(
            "run --policy {} --devices {} --ttis {} --seed {} --set harvest.lambda={} \
             --set policy.adjusted.pilot_ttis=100 --set policy.adjusted.t_on=[1,2] \
             --set policy.adjusted.t_drx=[2,8] --quiet --json --out run{row}",
            get("policy"),
            get("n"),
            get("ttis"),
            get("seed"),
            get("harvest.lambda")
        );
        let single = folder.run(&command);
        let summary: Value = serde_json::from_str(&single.stdout).expect("JSON");
        assert_eq!(summary["digest"], *get("digest"), "{command}");
        assert_eq!(summary["scenario_hash"], *get("scenario_hash"), "{command}");
        let metrics = summary["metrics"].as_object().expect("metrics");
        assert_eq!(metrics.len(), Metrics::ALL.len());
        for (name, value) in metrics {
            // serde_json may read the last digit of a number differently.
            let is_same = match (value.as_f64(), get(name).parse::<f64>().ok()) {
                (Some(a), Some(b)) => (a - b).abs() <= 2.0 * f64::EPSILON * a.abs(),
                (a, b) => a == b,
            };
            assert!(
                is_same,
                "{name} of {command}: {value} in the summary, {} in the table",
                get(name)
            );
        }
    }
}

/// Returns a random number below `bound`.
fn random(bound: u64) -> u64 {
    let mut bytes = [0; 8];
    let mut source = fs::File::open("/dev/urandom").expect("Linux has it");
    source.read_exact(&mut bytes).expect("endless");
    u64::from_ne_bytes(bytes) % bound
}

#[test]
fn a_killed_sweep_resumes_with_the_same_table() {
    let folder = TestFolder::new();
    let grid = &GRID.replace("--ttis 600", "--ttis 60000");
    let expected = sweep_table(&folder, grid, "undisturbed");
    // Random moments, counted in runs after the last kill, so that the machine's speed does not matter, plus a random
    // delay.
    let mut kept_runs = 0;
    for kill in 1..=10 {
        let (more_runs, delay) = (random(12) as usize, Duration::from_micros(random(30_000)));
        let sweep = folder.start(&format!("sweep {grid} --threads 2 --out killed"));
        wait_until("the sweep to finish runs", PATIENCE, || {
            let is_there = folder.join("killed/runs.journal").exists();
            (is_there && folder.count_finished_runs("killed") >= (kept_runs + more_runs).min(RUNS)).then_some(())
        });
        std::thread::sleep(delay);
        sweep.signal(Signal::KILL);
        sweep.finish();
        let finished_runs = folder.count_finished_runs("killed");
        println!("kill {kill}: {delay:?} after {more_runs} more runs than {kept_runs}, at {finished_runs}");
        assert!(finished_runs >= kept_runs, "finished runs were lost");
        kept_runs = finished_runs;
    }
    let finished = folder.run(&format!("sweep {grid} --out killed"));
    assert!(finished.is_success(), "{finished}");
    assert!(finished.stderr.contains(" finished runs found in killed"), "{finished}");
    let table = fs::read(folder.join("killed/results.parquet")).expect("a table");
    assert!(table == expected, "the table of a killed sweep differs");
    // A repeated command finds nothing left to do.
    let finished = folder.run(&format!("sweep {grid} --out killed --json"));
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    assert_eq!(
        (&report["found"], &report["runs"]),
        (&Value::from(RUNS), &Value::from(RUNS))
    );
    assert_eq!(report["device_ttis"], 0);
}

#[test]
fn a_killed_writer_leaves_a_complete_table_or_none() {
    let folder = TestFolder::new();
    let options = "--devices 2 --ttis 20 --seeds 5000";
    let expected = sweep_table(&folder, options, "s");
    let (table, part_file) = (folder.join("s/results.parquet"), folder.join("s/results.parquet.part"));
    let mut missing_tables = 0;
    for kill in 1..=10 {
        fs::remove_file(&table).expect("there");
        // All runs are finished; only the table is missing.
        let writer = folder.start(&format!("sweep {options} --out s"));
        // About the time that writing the table takes, so that kills come before and after its end.
        let delay = Duration::from_micros(random(1500));
        let deadline = now() + PATIENCE;
        while !part_file.exists() && !table.exists() {
            assert!(now() < deadline, "no table is written");
            std::hint::spin_loop();
        }
        std::thread::sleep(delay);
        writer.signal(Signal::KILL);
        writer.finish();
        let is_missing = !table.exists();
        println!(
            "kill {kill}: {delay:?} into the writing, table {}",
            if is_missing { "missing" } else { "written" }
        );
        missing_tables += u32::from(is_missing);
        if is_missing {
            assert!(sweep_table(&folder, options, "s") == expected, "the repeated sweep");
        }
        assert!(fs::read(&table).expect("there") == expected, "an incomplete table");
    }
    println!("{missing_tables} of 10 kills came before the end of the writing");
}

#[test]
fn runs_of_damaged_journal_rows_are_repeated() {
    let folder = TestFolder::new();
    let expected = sweep_table(&folder, GRID, "s");
    let journal = folder.join("s/runs.journal");
    let mut bytes = fs::read(&journal).expect("there");
    let length = bytes.len();
    // One flipped bit in the middle, and an incomplete last row: a row has more than 37 bytes.
    bytes[length / 2] ^= 4;
    bytes.truncate(length - 37);
    fs::write(&journal, bytes).expect("written");
    fs::remove_file(folder.join("s/results.parquet")).expect("there");
    let finished = folder.run(&format!("sweep {GRID} --out s"));
    assert!(
        finished
            .stderr
            .contains("s/runs.journal: 2 rows were damaged and have been removed"),
        "{finished}"
    );
    assert!(
        finished.stderr.contains(&format!("{} finished runs found", RUNS - 2)),
        "{finished}"
    );
    let table = fs::read(folder.join("s/results.parquet")).expect("a table");
    assert!(table == expected);
    let finished = folder.run(&format!("sweep {GRID} --out s"));
    assert!(
        finished.is_success() && !finished.stderr.contains("damaged"),
        "the warning is not repeated: {finished}"
    );

    fs::create_dir_all(folder.join("notes")).expect("writable");
    folder.write("notes/runs.journal", "a text");
    assert_refused(
        &folder.run(&format!("sweep {GRID} --out notes")),
        1,
        &["--out notes", "runs.journal with a damaged first line"],
    );
    let notes = fs::read_to_string(folder.join("notes/runs.journal")).expect("there");
    assert_eq!(notes, "a text");
}

#[test]
fn two_sweeps_cannot_use_one_folder() {
    let folder = TestFolder::new();
    let endless = "sweep --devices 100 --ttis 1000000000 --seeds 2 --out s";
    let first = folder.start(endless);
    wait_until("the sweep to begin", PATIENCE, || {
        folder.join("s/experiment.toml").exists().then_some(())
    });
    assert_refused(
        &folder.run(endless),
        1,
        &["--out s", "another `reveille sweep` uses this folder"],
    );
    first.signal(Signal::KILL);
    first.finish();
    let other = folder.run("sweep --devices 5 --ttis 50 --seeds 2 --out s");
    assert_refused(&other, 1, &["--out s", "another experiment, shard or version"]);
}

#[test]
fn tables_of_another_version_or_format_are_not_merged() {
    let folder = TestFolder::new();
    for index in 1..=2 {
        let finished = folder.run(&format!(
            "sweep --devices 5 --ttis 50 --seeds 4 --shard {index}/2 --format csv -q --out s{index}"
        ));
        assert!(finished.is_success(), "{finished}");
    }
    let side_car = folder.join("s2/results.csv.toml");
    let text = fs::read_to_string(&side_car).expect("there");
    // The version after `TABLE_VERSION` in `lab/src/table/error.rs`.
    fs::write(
        &side_car,
        text.replace("\"reveille.table\" = \"5\"", "\"reveille.table\" = \"6\""),
    )
    .expect("written");
    let finished = folder.run("merge s1 s2 --out m.csv");
    assert_refused(&finished, 1, &["s2/results.csv", "version 6", "reads versions 1 to 5"]);
    fs::write(&side_car, text.replace(env!("CARGO_PKG_VERSION"), "0.0.9")).expect("written");
    assert_refused(&folder.run("merge s1 s2 --out m.csv"), 1, &["reveille 0.0.9"]);
    fs::write(&side_car, text).expect("written");
    assert!(folder.run("merge s1 s2 --out m.csv").is_success());

    // Parquet: a truncated file and a foreign file.
    let table = sweep_table(&folder, "--devices 5 --ttis 50 --seeds 4 --shard 1/2", "p1");
    folder.write("p2.parquet", "not a table");
    assert_refused(
        &folder.run("merge p1 p2.parquet --out m.parquet"),
        1,
        &["p2.parquet", "cut off or corrupt"],
    );
    fs::write(folder.join("p2.parquet"), &table[..table.len() - 9]).expect("written");
    assert_refused(
        &folder.run("merge p1 p2.parquet --out m.parquet"),
        1,
        &["p2.parquet", "cut off or corrupt"],
    );
}

#[test]
fn invalid_experiments_are_refused_before_the_first_run() {
    let folder = TestFolder::new();
    folder.write("typo.toml", "devices = [10]\npolicees = [\"knn\"]\n");
    folder.write("empty.toml", "devices = []\n");
    folder.write("scenario.toml", "devices = 10\n[sensing]\nd_max = 5\n");
    for (args, parts) in [
        ("typo.toml", &["typo.toml, line 2", "unknown field `policees`"][..]),
        (
            "scenario.toml",
            &[
                "scenario.toml, line 2",
                "unknown field `sensing`",
                "--scenario scenario.toml",
            ],
        ),
        ("empty.toml", &["devices = []", "no runs"]),
        ("none.toml", &["none.toml: no such file", "name an experiment file"]),
        ("--grid harvest.lambda=", &["harvest.lambda = []", "no runs"]),
        (
            "--grid harvest.lamda=1,2",
            &["harvest.lamda", "did you mean `harvest.lambda`", "--grid harvest.lamda"],
        ),
        ("--devices 10,20,0", &["devices = 0", "at least 1", "--devices"]),
        ("--policies knn,kmm", &["policy.name", "kmm"]),
        ("--until-ci 200%", &["until_ci = 200%", "at most 100 %"]),
        ("--until-ci 1% --shard 1/2", &["shard = 1/2", "until_ci"]),
        ("--until-ci 1% --shard 1/2 --dry-run", &["shard = 1/2", "until_ci"]),
        ("--until-ci 1", &["until_ci = 1:", "1% or 0.01"]),
        (
            "--until-ci 1% --seeds 20 --min-seeds 21",
            &["min_seeds = 21", "20 seeds", "--seeds"],
        ),
        (
            "--seeds 10000000 --grid harvest.e_b=1,2,3,4,5,6,7,8,9,10,11",
            &[
                "runs = 110000000",
                "11 cells × 10000000 seeds",
                "at most 100000000",
                "--seeds",
            ],
        ),
        ("--devices -5", &["devices = -5", "not negative", "--devices"]),
        ("-k -7", &["ttis = -7", "not negative", "--ttis"]),
        ("--devices -5,10", &["devices = -5", "not negative", "--devices"]),
        ("--devices 10,-5", &["devices = -5", "not negative", "--devices"]),
        ("-k -7,8", &["ttis = -7", "not negative", "--ttis"]),
        (
            "--devices=",
            &["devices = []", "empty list leaves no runs", "--devices"],
        ),
        (
            "--policies ,",
            &["policy.name = []", "empty list leaves no runs", "--policies"],
        ),
        ("--set seed=4", &["--first-seed"]),
        ("--set devices", &["--set devices: must be FIELD=VALUE"]),
    ] {
        assert_refused(&folder.run(&format!("sweep {args} --out s")), 1, parts);
        assert!(!folder.join("s").exists(), "{args}");
    }
    for (flag, least) in [("--seeds", 1), ("--first-seed", 0), ("--min-seeds", 2)] {
        let finished = folder.run(&format!("sweep {flag} -5 --out s"));
        assert_refused(&finished, 2, &[flag, "-5", &format!("whole number from {least}")]);
    }
    let finished = folder.run("sweep --until-ci 1% --ci-metrics events,colour --out s");
    assert_refused(&finished, 2, &["'colour' for '--ci-metrics", "info_per_event"]);
    for shard in ["5/4", "0/3", "x/y", "2", "1/0"] {
        assert_refused(
            &folder.run(&format!("sweep --shard {shard} --out s")),
            2,
            &["1 ≤ i ≤ n", shard],
        );
    }
    assert!(!folder.join("s").exists());
}

#[test]
fn a_dry_run_shows_the_grid_and_runs_nothing() {
    let folder = TestFolder::new();
    let finished = folder.run(&format!("sweep {GRID} --dry-run --out s"));
    assert!(finished.is_success(), "{finished}");
    for part in [
        "genie, devices = 20, ttis = 600, harvest.lambda = 0.1",
        "16 cells × 12 seeds from 5: 192 runs",
    ] {
        assert!(finished.stdout.contains(part), "{finished}");
    }
    let finished = folder.run("sweep --devices 5 --ttis 50 --seeds 1 --dry-run");
    assert!(
        finished.stdout.contains("1 cell × 1 seed from 1: 1 run, "),
        "{finished}"
    );
    assert!(!folder.join("s").exists());
}

#[test]
fn an_experiment_file_and_options_give_the_same_table() {
    let folder = TestFolder::new();
    folder.write(
        "e.toml",
        "policies = [\"knn\", \"random\", \"adjusted\", \"genie\"]\ndevices = [8]\nttis = 600\n\
         seeds = { first = 5, count = 3 }\n[set]\n\
         policy.adjusted = { pilot_ttis = 100, t_on = [1, 2], t_drx = [2, 8] }\n[grid]\nharvest.lambda = [0.05, 0.1]\n",
    );
    let from_file = sweep_table(&folder, "e.toml --devices 8,20 --seeds 12", "file");
    assert!(from_file == sweep_table(&folder, GRID, "options"));
    assert!(
        from_file == sweep_table(&folder, "options/experiment.toml", "again"),
        "its own experiment.toml"
    );
}

#[test]
fn a_sweep_folder_runs_again_without_the_original_files() {
    let folder = TestFolder::new();
    fs::create_dir_all(folder.join("mine/traces")).expect("writable");
    folder.write("mine/traces/t.csv", "a,b\n1,2\n3,1\n");
    folder.write(
        "mine/s.toml",
        "devices = 6\nttis = 200\npolicy.adjusted = { pilot_ttis = 50, t_on = [1, 2], t_drx = [2] }\n\
         [harvest]\nkind = \"trace\"\ntrace = { file = \"traces/t.csv\", column = \"a\" }\n",
    );
    folder.write(
        "mine/e.toml",
        "scenario = \"s.toml\"\npolicies = [\"knn\", \"adjusted\"]\nseeds = 3\n",
    );
    let expected = sweep_table(&folder, "mine/e.toml", "first");
    fs::rename(folder.join("mine/s.toml"), folder.join("mine/gone.toml")).expect("there");
    fs::rename(folder.join("mine/e.toml"), folder.join("e.toml")).expect("there");
    for (from, out) in [("first", "second"), ("second", "third"), ("first", "first")] {
        let again = sweep_table(&folder, &format!("{from}/experiment.toml"), out);
        assert!(again == expected, "{from} to {out}");
    }
    let from_option = sweep_table(
        &folder,
        "--scenario mine/gone.toml --policies adjusted --seeds 2",
        "flag",
    );
    assert!(sweep_table(&folder, "flag/experiment.toml", "flag2") == from_option);
}

#[test]
fn a_full_disk_loses_no_finished_run() {
    let folder = TestFolder::new();
    let expected = sweep_table(&folder, GRID, "elsewhere");
    let path = folder.join("disk");
    let Some(_disk) = Mount::small(&path) else {
        print_skipped("cannot mount a small tmpfs here (root is needed)");
        return;
    };
    let ballast = path.join("ballast");
    // Leaves about 36 of the disk's 256 kB, enough for some runs only.
    fs::write(&ballast, vec![0; 220 * 1024]).expect("there is room for it");
    let finished = folder.run(&format!("sweep {GRID} --out disk/s"));
    assert_refused(
        &finished,
        1,
        &[
            "disk/s/runs.journal",
            "No space left on device",
            "are kept",
            "give the same command again",
        ],
    );
    let kept_runs = folder.count_finished_runs("disk/s");
    assert!(kept_runs > 20 && kept_runs < RUNS, "{kept_runs} runs fit on the disk");
    fs::remove_file(&ballast).expect("there");
    let finished = folder.run(&format!("sweep {GRID} --out disk/s"));
    assert!(
        finished.is_success() && finished.stderr.contains(&format!("{kept_runs} finished runs found")),
        "{finished}"
    );
    assert!(fs::read(path.join("s/results.parquet")).expect("a table") == expected);

    // Space for the journal, but not for the table: the runs are kept until there is space.
    fs::remove_file(path.join("s/results.parquet")).expect("there");
    let written = fs::write(&ballast, vec![0; 256 * 1024]);
    assert!(written.is_err(), "the disk has more space than requested");
    let finished = folder.run(&format!("sweep {GRID} --out disk/s --quiet"));
    assert_refused(
        &finished,
        1,
        &[
            "disk/s/results.parquet",
            "No space left on device",
            &format!("the {RUNS} finished runs are kept in disk/s"),
            "give the same command again",
        ],
    );
    fs::remove_file(ballast).expect("there");
    let finished = folder.run(&format!("sweep {GRID} --out disk/s --json"));
    assert!(
        finished.is_success() && finished.stdout.contains("\"device_ttis\": 0"),
        "{finished}"
    );
    assert!(fs::read(path.join("s/results.parquet")).expect("a table") == expected);
}
