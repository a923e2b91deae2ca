//! The commands `inspect tail` and `clock` on a running base station: each message is shown once, `--wait` waits, and a
//! refusal states its reason. Also the reports of lost hosts, the lists in help texts, and options without effect.
//! `recording.rs` tests recordings. Statuses of the clock are whole lines of `deploy/src/commands/clock.rs`.

use std::time::Duration;

use reveille_tests::process::{
    PATIENCE, Process, TestFolder, assert_refused, free_endpoint, hosts_of, send_signal, unique_run, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// Starts `up` with a run of 60 TTIs, and waits until its devices have joined. It is paused before TTI 0.
fn start_paused_run(folder: &TestFolder, run: &str, args: &str) -> Process {
    let up = folder.start(&format!("up -k 60 --paused --run {run} --quiet --out out {args}"));
    folder.wait_for_tti(run, 0);
    up
}

/// Starts an observer of `run` and waits until it has connected.
fn start_tail(folder: &TestFolder, run: &str, args: &str) -> Process {
    let tail = folder.start(&format!("inspect tail --run {run} {args}"));
    tail.wait_for_stderr("connected to run");
    tail
}

/// Parses the output of an observer with `--json`, without messages of kind `control`, whose number varies.
fn parse_messages(stdout: &str) -> Vec<Value> {
    let lines = stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("a line is JSON"));
    lines.filter(|message: &Value| message["kind"] != "control").collect()
}

/// Returns the messages that an observer shows for TTIs 20 to 49 of a run with this many processes. The observer can
/// miss messages of the first TTIs, so it has to show one before TTI 20.
fn shown_messages(processes: u32) -> Vec<Value> {
    let (folder, run) = (TestFolder::new(), unique_run("shown"));
    let up = start_paused_run(
        &folder,
        &run,
        &format!("-P {processes} -n 30 --set bs.sync_interval=5 --pace 5ms --set events.alpha=0.3"),
    );
    let tail = start_tail(&folder, &run, "--json");
    let mut step_count = 0;
    wait_until("the observer to show a clock message", PATIENCE, || {
        step_count += 1;
        folder.clock(&run, "step --wait");
        tail.stdout().contains("\"clock\"").then_some(())
    });
    folder.clock(&run, "resume");
    assert!(up.finish().is_success());
    let tail = tail.finish();
    assert!(tail.is_success(), "{tail}");
    assert!(tail.stderr.contains(" 0 dropped"), "{tail}");
    let is_in_range = |message: &Value| message["tti"].as_u64().is_some_and(|tti| (20..50).contains(&tti));
    assert!(step_count < 20, "the observer showed nothing before TTI {step_count}");
    parse_messages(&tail.stdout).into_iter().filter(is_in_range).collect()
}

#[test]
fn messages_in_the_base_stations_process_are_shown_once() {
    let message_counts = |processes| {
        let messages = shown_messages(processes);
        let count = |kind: &str| messages.iter().filter(|message| message["kind"] == kind).count();
        ["plan", "wake", "report", "clock", "answer"].map(count)
    };
    let with_one_process = message_counts(1);
    let [plans, wake_ups, reports, ..] = with_one_process;
    assert!(
        reports > 0 && plans > 0,
        "{plans} plans, {wake_ups} wake-ups, {reports} reports"
    );
    assert_eq!(message_counts(0), with_one_process, "as with one device process");
}

#[test]
fn an_observer_prints_the_position_of_a_paused_run_with_devices_and_hosts() {
    let (folder, run) = (TestFolder::new(), unique_run("greet"));
    let up = start_paused_run(
        &folder,
        &run,
        "-P 1 -n 30 --set bs.sync_interval=5 --set events.alpha=0.3",
    );
    let tail = start_tail(&folder, &run, "");
    let greeting = format!("connected to run {run}: paused before TTI 0 of 60\n");
    assert!(tail.stderr().contains(&greeting), "{}", tail.stderr());
    wait_until("a report and an answer", PATIENCE, || {
        folder.run(&format!("clock --run {run} step --wait"));
        let text = tail.stdout();
        let has_line = |kind: &str, part: &str| text.lines().any(|line| line.contains(kind) && line.contains(part));
        (has_line(" report ", " device ") && has_line(" answer ", " host 0 ") && has_line(" plan ", " devices sense"))
            .then_some(())
    });
    folder.run(&format!("clock --run {run} resume"));
    assert!(up.finish().is_success());
}

#[test]
fn filters_without_matches_are_refused() {
    let (folder, run) = (TestFolder::new(), unique_run("filters"));
    let up = start_paused_run(&folder, &run, "-P 1 -n 5");
    let finished = folder.run(&format!("inspect tail --run {run} --device 99"));
    assert_refused(&finished, 1, &["--device 99", "5 devices", "0 to 4"]);
    let finished = folder.run(&format!("inspect tail --run {run} --plane air --kind plan,clock"));
    assert_refused(&finished, 1, &["--plane air", "--kind clock", "emu"]);
    let finished = folder.run(&format!("inspect tail --run {run} --kind plans"));
    assert_refused(&finished, 2, &["plans", "wake", "control"]);
    folder.clock(&run, "resume");
    assert!(up.finish().is_success());
}

#[test]
fn help_lists_the_kinds_with_their_direction_and_the_exit_codes() {
    let folder = TestFolder::new();
    let help = folder.run("inspect tail --help").stdout;
    for part in ["wake:", "BS → one device", "answer:", "host → BS"] {
        assert!(help.contains(part), "no {part:?}: {help}");
    }
    let help = folder.run("--help").stdout;
    for part in ["Exit codes:", "  0  ", "  1  ", "  2  ", "130  "] {
        assert!(help.contains(part), "no {part:?}: {help}");
    }
    let help = folder.run("up --help").stdout;
    assert!(help.contains("takes over"), "{help}");
}

#[test]
fn a_clock_command_with_wait_returns_when_it_is_done() {
    let (folder, run) = (TestFolder::new(), unique_run("wait"));
    let up = start_paused_run(&folder, &run, "-P 1 -n 5 --pace 20ms");
    assert_eq!(
        folder.clock(&run, "step 3 --wait"),
        "paused before TTI 3 of 60, a TTI every 20ms\n"
    );
    assert_eq!(
        folder.clock(&run, "run-to 9 --wait"),
        "paused before TTI 9 of 60, a TTI every 20ms\n"
    );
    let status = folder.clock(&run, "step 3");
    assert_eq!(
        status,
        "running at TTI 9 of 60, to stop before TTI 12, a TTI every 20ms\n"
    );
    // The pause takes effect within the remaining 51 TTIs, at 20 ms each.
    folder.clock(&run, "resume");
    let status = folder.clock(&run, "pause");
    assert!(status.starts_with("paused before TTI "), "{status}");
    let status = folder.clock(&run, "step 1000 --wait");
    // The base station can exit between two queries of its status.
    let has_ended = status.starts_with("finished") || status.starts_with("the run has ended; last seen at TTI ");
    assert!(has_ended, "{status}");
    assert!(up.finish().is_success());
}

#[test]
fn a_clock_command_with_wait_reports_an_early_end() {
    let (folder, run) = (TestFolder::new(), unique_run("cut"));
    let up = start_paused_run(&folder, &run, "-P 1 -n 5 --pace 200ms");
    let clock = folder.start(&format!("clock --run {run} run-to 59 --wait"));
    folder.wait_for_tti(&run, 2);
    up.signal(Signal::INT);
    assert_refused(&clock.finish(), 1, &["failed before TTI 59", "of 60"]);
    assert_eq!(up.finish().code(), Some(130));
}

#[test]
fn the_status_of_a_waiting_run_names_the_lost_hosts() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("held"), free_endpoint());
    let options = "-n 50 -k 6000 --pace 5ms --on-loss wait --quiet --out out";
    let bs = folder.start(&format!("bs {options} --run {run} --listen {endpoint}"));
    let [_host_0, host_1] = [0, 1].map(|_| {
        let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count 25"));
        host.wait_for_stderr("joined");
        host
    });
    folder.wait_for_tti(&run, 10);
    host_1.signal(Signal::KILL);
    bs.wait_for_stderr("the run is waiting");
    let status = folder.clock(&run, "status");
    assert!(status.starts_with("waiting at TTI "), "{status}");
    assert!(
        status.contains(": lost host 1 (devices 25 to 49, the process with pid "),
        "{status}"
    );
    let hosts = folder.clock(&run, "status --hosts");
    let lines: Vec<&str> = hosts.lines().collect();
    assert!(
        lines.len() == 3 && lines[1].contains("(devices 0 to 24, ") && lines[2].ends_with(" (lost)"),
        "{hosts}"
    );
    let small_host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count 24"));
    small_host.wait_for_stderr("lost hosts left 25 devices");
    bs.signal(Signal::INT);
    assert_eq!(bs.finish().code(), Some(130));
}

#[test]
fn the_device_processes_of_a_failed_run_report_the_cause() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("failed"), free_endpoint());
    let bs = folder.start(&format!(
        "bs -n 5 -k 6000 --pace 5ms --on-loss end --quiet --out out --run {run} --listen {endpoint}"
    ));
    let [host_0, host_1] = [2, 3].map(|count| {
        let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count {count}"));
        host.wait_for_stderr("joined");
        host
    });
    folder.wait_for_tti(&run, 10);
    host_0.signal(Signal::KILL);
    assert_eq!(bs.finish().code(), Some(1));
    let finished = host_1.finish();
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert!(
        finished.stderr.contains("reveille: the run has failed: lost host 0"),
        "{finished}"
    );
}

#[test]
fn only_the_base_station_of_up_reports_the_cause() {
    let (folder, run) = (TestFolder::new(), unique_run("alone"));
    let up = folder.start(&format!(
        "up -P 2 -n 5 -k 6000 --pace 5ms --on-loss end --quiet --out out --run {run}"
    ));
    folder.wait_for_tti(&run, 10);
    send_signal(hosts_of(&run)[0], Signal::KILL);
    let finished = up.finish_within(PATIENCE);
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert_eq!(finished.stderr.matches("lost host").count(), 1, "{finished}");
}

#[test]
fn options_without_effect_are_refused_or_reported() {
    let folder = TestFolder::new();
    let finished = folder.run("run -n 5 -k 60 --set devices=7 --quiet");
    assert_refused(&finished, 1, &["--devices and --set devices=7", "leave one"]);
    let finished = folder.run("run -p random --set policy.name=knn --quiet");
    assert_refused(&finished, 1, &["--policy and --set policy.name=knn"]);
    let finished = folder.run("up -P 0 -n 5 -k 60 --quiet --on-loss end");
    assert!(
        finished.is_success() && finished.stderr.contains("--on-loss has no effect"),
        "{finished}"
    );
    let finished = folder.run("up -P 0 -n 5 -k 60 --quiet --pace 1ms --no-lookahead");
    assert!(
        finished.is_success() && finished.stderr.contains("--no-lookahead has no effect"),
        "{finished}"
    );
    let finished = folder
        .start("up -P 0 -n 5 -k 60 --quiet")
        .finish_within(Duration::from_mins(1));
    assert!(finished.is_success() && finished.stderr.is_empty(), "{finished}");
}
