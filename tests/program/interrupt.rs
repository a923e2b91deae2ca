//! SIGINT and SIGTERM during the preparation of `run`, `up`, `bs` and `sweep`, and during a sweep: a prompt end with
//! exit code 130, and no finished work is lost. `signals.rs` sends signals at drawn moments of more commands,
//! `process_faults.rs` to the processes of a run.

use std::fs;
use std::time::Duration;

use reveille_tests::process::{PATIENCE, TestFolder, assert_refused, hosts_of, unique_run, wait_until};
use rustix::process::Signal;

/// Options of a scenario whose search before the run takes hours under policy `adjusted`. `signals.rs` repeats them.
const HOURS_LONG_SEARCH: &str = "--devices 200 --set policy.adjusted.pilot_ttis=900000000";
/// Time limit for the end of a command. `GRACE` in `deploy/src/signals.rs` ends a command without results after a
/// second; the rest is a margin for a busy machine.
const PROMPT_END_LIMIT: Duration = Duration::from_secs(10);

#[test]
fn an_interrupted_sweep_states_how_to_resume() {
    let folder = TestFolder::new();
    // One run takes hours.
    let endless = "sweep --devices 100 --ttis 1000000000 --seeds 2 --out";
    for (out, signal) in [("a", Signal::INT), ("b", Signal::TERM)] {
        let sweep = folder.start(&format!("{endless} {out}"));
        wait_until("the sweep to begin", PATIENCE, || {
            folder.join(&format!("{out}/experiment.toml")).exists().then_some(())
        });
        sweep.wait_for_work();
        sweep.signal(signal);
        let finished = sweep.finish_within(PROMPT_END_LIMIT);
        let kept = format!("0 finished runs are kept in {out}");
        assert_refused(&finished, 130, &[&kept, "give the same command again"]);
        assert!(!folder.join(&format!("{out}/results.parquet")).exists());
    }
}

#[test]
fn a_run_in_preparation_ends_promptly() {
    let folder = TestFolder::new();
    for (out, signal) in [("a", Signal::INT), ("b", Signal::TERM)] {
        let run = folder.start(&format!("run --policy adjusted {HOURS_LONG_SEARCH} --out {out}"));
        // The run creates its folder before the search, with its tables and without rows.
        wait_until("the run to begin", PATIENCE, || {
            folder.join(&format!("{out}/windows.csv")).exists().then_some(())
        });
        run.wait_for_work();
        run.signal(signal);
        let finished = run.finish_within(PROMPT_END_LIMIT);
        assert_eq!(finished.code(), Some(130), "{finished}");
        assert!(
            finished.stderr.contains("reveille: interrupted before the first TTI"),
            "{finished}"
        );
        let files = folder.list(out);
        assert!(!files.iter().any(|name| name == "RUNNING"), "{files:?}");
        let why = fs::read_to_string(folder.join(&format!("{out}/FAILED"))).expect("a reason");
        assert!(why.contains("interrupted"), "{why}");
    }
}

#[test]
fn a_base_station_in_preparation_ends_promptly_with_its_device_processes() {
    let folder = TestFolder::new();
    for (command, host_count) in [
        ("up --processes 2", 2),
        ("up --processes 0", 0),
        ("bs --listen tcp/127.0.0.1:0", 0),
    ] {
        for signal in [Signal::INT, Signal::TERM] {
            let run = unique_run("setup");
            let bs = folder.start(&format!(
                "{command} --run {run} --policy adjusted {HOURS_LONG_SEARCH} --out {run}"
            ));
            wait_until("the base station to listen", PATIENCE, || {
                let is_registered = folder
                    .list("runtime/reveille")
                    .iter()
                    .any(|name| name.starts_with(&run));
                (is_registered && hosts_of(&run).len() == host_count).then_some(())
            });
            bs.wait_for_work();
            bs.signal(signal);
            let finished = bs.finish_within(PROMPT_END_LIMIT);
            assert_eq!(finished.code(), Some(130), "{command}: {finished}");
            assert!(
                finished.stderr.contains("reveille: interrupted before the first TTI"),
                "{command}: {finished}"
            );
            assert_eq!(hosts_of(&run), [0_u32; 0], "{command}: device processes remain");
            let files = folder.list(&run);
            assert!(!files.iter().any(|name| name == "RUNNING"), "{command}: {files:?}");
            let why = fs::read_to_string(folder.join(&format!("{run}/FAILED"))).expect("a reason");
            assert!(why.contains("interrupted"), "{command}: {why}");
        }
    }
}

#[test]
fn a_sweep_in_preparation_ends_promptly_and_keeps_finished_runs() {
    let folder = TestFolder::new();
    let args = format!("sweep --policies genie,adjusted --ttis 200 --seeds 3 --threads 2 {HOURS_LONG_SEARCH} --out s");
    let sweep = folder.start(&args);
    wait_until("the three runs of genie", PATIENCE, || {
        (folder.count_finished_runs("s") == 3).then_some(())
    });
    sweep.wait_for_work();
    sweep.signal(Signal::INT);
    let finished = sweep.finish_within(PROMPT_END_LIMIT);
    assert_eq!(finished.code(), Some(130), "{finished}");
    let message = "reveille: interrupted; the 3 finished runs are kept in s: give the same command again";
    assert!(finished.stderr.contains(message), "{finished}");
    let resumed = folder.start(&args);
    resumed.wait_for_stderr("3 finished runs found in s");
    // The end of the test kills the sweep: only its start matters.
}
