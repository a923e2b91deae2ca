//! A run folder or recording has one writer: no command replaces the output of an active run, `--force` replaces the
//! output of a killed one, and a folder without a run stays unchanged. A killed run keeps its rows.
//! `deploy/src/folder_lock.rs` and `run_folder.rs` hold the rules and texts.

use std::fs;

use reveille_tests::process::{
    FinishedProcess, PATIENCE, Process, SummaryJson, TestFolder, assert_refused, hosts_of, now, unique_run, wait_until,
};
use rustix::process::Signal;

/// Starts `up` with two device processes, 30 devices and the run folder `out`, and waits past its first TTIs. The run
/// takes at least a minute.
fn start_run(folder: &TestFolder, run: &str, args: &str) -> Process {
    let up = folder.start(&format!(
        "up -P 2 -n 30 -k 12000 --pace 5ms --out out --run {run} {args}"
    ));
    folder.wait_for_tti(run, 10);
    up
}

/// Checks that all device processes of `run` end, and waits for it.
fn assert_no_process_left(run: &str) {
    wait_until("the device processes to end", PATIENCE, || {
        hosts_of(run).is_empty().then_some(())
    });
}

#[test]
fn an_active_run_is_never_replaced() {
    let (folder, run) = (TestFolder::new(), unique_run("writer"));
    let up = start_run(&folder, &run, "");
    let scenario = folder.bytes("out/scenario.toml");
    let pid = format!("(pid {})", up.pid());
    for command in ["run", "up -P 0", "bs --run other --listen tcp/127.0.0.1:0"] {
        for force in ["", "--force"] {
            let finished = folder.run(&format!("{command} -n 7 -k 50 --out out {force}"));
            assert_refused(
                &finished,
                1,
                &["--out out", "a run is running in this folder", &pid, "--force never"],
            );
        }
    }
    let finished = folder.run("train record --from out --chunk 12 --stride 40 --out c.parquet");
    assert_refused(&finished, 1, &["out", "still running"]);
    up.signal(Signal::INT);
    let finished = up.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    assert!(folder.bytes("out/scenario.toml") == scenario);
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!((summary.number("n"), summary.status()), (30, "interrupted"));
    assert!(folder.run("run -n 7 -k 50 --quiet --out out --force").is_success());
}

#[test]
fn a_killed_run_is_replaced_only_with_force() {
    let (folder, run) = (TestFolder::new(), unique_run("stale"));
    let expected = folder.summary("run -n 7 -k 50");
    let up = start_run(&folder, &run, "");
    up.signal(Signal::KILL);
    up.finish();
    assert_no_process_left(&run);
    assert!(folder.list("out").contains(&"RUNNING".to_owned()));
    let finished = folder.run("run -n 7 -k 50 --out out");
    assert_refused(&finished, 1, &["--out out", "killed run", "--force"]);
    let record = folder.run("train record --from out --chunk 12 --stride 40 --out c.parquet");
    assert_refused(&record, 1, &["out", "killed"]);
    assert!(
        folder.list("out").contains(&"RUNNING".to_owned()),
        "the refused commands left the folder unchanged"
    );
    let replaced = folder.summary("up -P 2 -n 7 -k 50 --out out --force");
    assert_eq!(replaced.digest(), expected.digest());
    assert_eq!(
        folder.list("out"),
        [
            "devices.csv",
            "events.csv",
            "scenario.toml",
            "summary.json",
            "windows.csv"
        ]
    );
}

#[test]
fn of_simultaneous_runs_one_writes_the_folder() {
    let folder = TestFolder::new();
    for force in [false, true] {
        let args = |seed: u64| {
            format!(
                "run -n 20 -k 200000 --seed {seed} --out new --json {}",
                if force { "--force" } else { "" }
            )
        };
        let runs: Vec<Process> = (1..=6).map(|seed| folder.start(&args(seed))).collect();
        let all_finished: Vec<FinishedProcess> = runs.into_iter().map(Process::finish).collect();
        let (winners, losers): (Vec<&FinishedProcess>, Vec<&FinishedProcess>) =
            all_finished.iter().partition(|finished| finished.is_success());
        for finished in losers {
            assert_refused(finished, 1, &["--out new"]);
        }
        // With --force a later run may replace one that has ended.
        assert!(
            if force { !winners.is_empty() } else { winners.len() == 1 },
            "{all_finished:?}"
        );
        let kept = SummaryJson::read(&folder.join("new"));
        assert!(
            winners
                .iter()
                .any(|finished| finished.summary().digest() == kept.digest())
        );
        assert!(!folder.list("new").contains(&"RUNNING".to_owned()));
        let text = String::from_utf8(folder.bytes("new/scenario.toml")).expect("text");
        let seed = kept.number("seed");
        assert!(
            text.contains(&format!("seed = {seed}")),
            "the summary has seed {seed}, the scenario another: {text}"
        );
        fs::remove_dir_all(folder.join("new")).expect("removable");
        fs::create_dir(folder.join("new")).expect("possible");
    }
}

#[test]
fn a_folder_without_a_run_stays_unchanged() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join("mine")).expect("possible");
    folder.write("mine/letter.txt", "a text");
    for running_text in [None, Some("a text")] {
        // A file of this name that no run wrote.
        if let Some(text) = running_text {
            folder.write("mine/RUNNING", text);
        }
        let before = folder.list("mine");
        for force in ["", "--force"] {
            let finished = folder.run(&format!("run -n 7 -k 50 --out mine {force}"));
            assert_refused(&finished, 1, &["--out mine", "holds no run"]);
            assert_eq!(folder.list("mine"), before);
        }
    }
    assert_eq!(folder.bytes("mine/RUNNING"), b"a text");
}

#[test]
fn an_active_recording_is_never_replaced() {
    let (folder, run) = (TestFolder::new(), unique_run("recording"));
    let up = start_run(&folder, &run, "--record r.mcap");
    let finished = folder.run("run -n 7 -k 50 --out other --record r.mcap --force");
    assert_refused(&finished, 1, &["--record r.mcap", "is recording", "--force never"]);
    assert!(!folder.join("other").exists());
    // The start of a recording may not be written yet.
    wait_until("the recording to be readable", PATIENCE, || {
        let finished = folder.run("inspect tail r.mcap --count 1");
        finished.stderr.contains("r.mcap: still being written").then_some(())
    });
    up.signal(Signal::INT);
    assert_eq!(up.finish().code(), Some(130));
    let finished = folder.run("inspect tail r.mcap --count 1");
    assert!(
        finished.is_success() && !finished.stderr.contains("still being written"),
        "{finished}"
    );
    assert!(
        folder
            .run("run -n 7 -k 50 --quiet --out other --record r.mcap --force")
            .is_success()
    );
}

#[test]
fn a_killed_run_keeps_complete_rows_up_to_its_last_seconds() {
    let (folder, run) = (TestFolder::new(), unique_run("rows"));
    let up = folder.start(&format!(
        "up -P 2 -n 30 -k 12000 --pace 5ms --window 10 --set events.alpha=0.2 --out out --run {run}"
    ));
    folder.wait_for_tti(&run, 10);
    let started = now();
    let reached = folder.wait_for_tti(&run, 400);
    let count_complete_rows = |name: &str| {
        let text = String::from_utf8(folder.bytes(&format!("out/{name}"))).expect("text");
        assert!(text.ends_with('\n'), "incomplete row: {text}");
        let columns = text.lines().next().expect("a header").split(',').count();
        assert!(text.lines().all(|line| line.split(',').count() == columns), "{text}");
        text.lines().count() - 1
    };
    // Rows are flushed once a second (`WRITE_INTERVAL` in `deploy/src/table_writer.rs`), and the machine may be busy.
    wait_until("the rows to be written during the run", PATIENCE, || {
        (count_complete_rows("windows.csv") as u64 >= reached / 10).then_some(())
    });
    let tti = folder.wait_for_tti(&run, 0);
    // The run has 12 000 TTIs.
    assert!(
        tti < 11_000,
        "rows were written only near the end, {:?} after the start",
        started.elapsed()
    );
    up.signal(Signal::KILL);
    up.finish();
    assert!(count_complete_rows("windows.csv") as u64 >= reached / 10);
    assert!(count_complete_rows("events.csv") > 5);
    assert_no_process_left(&run);
}
