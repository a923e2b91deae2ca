//! Closed terminals, unread output, ignored and stopping signals: `up`, `bs`, `device`, `run`, `sweep` and `train
//! record` end cleanly or continue with the digest of an undisturbed run, and leave no process behind. `interrupt.rs`
//! and `signals.rs` test SIGINT and SIGTERM. docs/command-line.md lists the exit codes.

use std::fs;
use std::process::{Command, ExitStatus};
use std::time::Duration;

use reveille_tests::process::{
    PATIENCE, Process, SummaryJson, TestFolder, free_endpoint, hosts_of, send_signal, unique_run, wait_for_handler,
    wait_until,
};
use reveille_tests::terminal::PtyCommand;
use rustix::process::Signal;

/// Options of a run that would take a minute.
const LONG_RUN: &str = "-n 30 -k 12000 --pace 5ms";
/// Time limit for the end of a command on a busy machine. Below [`PATIENCE`], and below the minute of [`LONG_RUN`].
const END_LIMIT: Duration = Duration::from_secs(20);

/// Waits until no device process of `run` is left.
fn assert_no_process_left(run: &str) {
    wait_until("the device processes to end", PATIENCE, || {
        hosts_of(run).is_empty().then_some(())
    });
}

/// Closes the terminal of a command, as a terminal emulator and its shell do, and waits for the command to end.
fn close_terminal(command: &mut PtyCommand) -> ExitStatus {
    let pid = command.pid();
    command.close();
    // Both the shell and the kernel send SIGHUP, so that a command can receive several.
    for _ in 0..3 {
        send_signal(pid, Signal::HUP);
        // Signals sent without a pause would merge into one.
        std::thread::sleep(Duration::from_millis(5));
    }
    command.finish_within(END_LIMIT)
}

/// Checks the exit code, the files in `out` and the summary of a run that a closed terminal has ended.
fn assert_interrupted(folder: &TestFolder, status: ExitStatus) {
    assert_eq!(status.code(), Some(130), "{status}");
    let files = folder.list("out");
    for name in ["devices.csv", "events.csv", "summary.json", "windows.csv"] {
        assert!(files.iter().any(|file| file == name), "{files:?}");
    }
    assert!(!files.iter().any(|file| file == "RUNNING"), "{files:?}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.status(), "interrupted");
    assert!(summary.number("ttis_done") > 0, "{summary:?}");
}

#[test]
fn up_in_a_closed_terminal_ends_with_partial_results() {
    let (folder, run) = (TestFolder::new(), unique_run("terminal"));
    let mut up = PtyCommand::start(&folder.command(&format!("up -P 4 {LONG_RUN} --out out --run {run}")));
    up.wait_for("TTIs/s");
    assert_eq!(hosts_of(&run).len(), 4);
    let shown = up.shown();
    assert!(
        !shown.contains(" 0 TTIs/s") && !shown.contains("joining: 0 of"),
        "{shown}"
    );
    let status = close_terminal(&mut up);
    assert_interrupted(&folder, status);
    assert_no_process_left(&run);
}

#[test]
fn bs_and_device_in_closed_terminals_end_with_partial_results() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("terminals"), free_endpoint());
    let bs = format!("bs {LONG_RUN} --out out --run {run} --listen {endpoint}");
    let mut bs = PtyCommand::start(&folder.command(&bs));
    bs.wait_for("waiting for 30 devices");
    let device = format!("device --connect {endpoint} --run {run} --count 30");
    let mut device = PtyCommand::start(&folder.command(&device));
    bs.wait_for("TTIs/s");
    let status = close_terminal(&mut bs);
    assert_interrupted(&folder, status);
    assert!(device.finish_within(END_LIMIT).success(), "{}", device.shown());

    // A device process alone: it has nothing to save.
    let device = format!("device --connect {} --run {run} --count 30", free_endpoint());
    let mut device = PtyCommand::start(&folder.command(&device));
    wait_for_handler(device.pid(), Signal::HUP);
    assert_eq!(close_terminal(&mut device).code(), Some(130));
}

#[test]
fn run_in_a_closed_terminal_ends_with_partial_results() {
    let folder = TestFolder::new();
    let run = "run -n 50 -k 1000000000 --window 10000 --out out";
    let mut run = PtyCommand::start(&folder.command(run));
    run.wait_for("TTIs/s");
    let status = close_terminal(&mut run);
    assert_interrupted(&folder, status);
}

#[test]
fn sweep_and_record_in_closed_terminals_are_interrupted() {
    let folder = TestFolder::new();
    let sweep = "sweep --devices 20 --ttis 5000 --seeds 900000 --out s";
    let mut sweep = PtyCommand::start(&folder.command(sweep));
    sweep.wait_for("runs");
    assert_eq!(close_terminal(&mut sweep).code(), Some(130));
    assert!(folder.join("s/runs.journal").exists());
    let record = "train record -p knn -n 20 -k 5000 --seeds 900000 --chunk 12 --stride 40 --out c.parquet";
    let mut record = PtyCommand::start(&folder.command(record));
    record.wait_for("runs");
    assert_eq!(close_terminal(&mut record).code(), Some(130));
    assert!(!folder.join("c.parquet").exists());
}

#[test]
fn a_run_that_receives_no_sighup_outlives_its_terminal() {
    let (folder, run) = (TestFolder::new(), unique_run("nosignal"));
    let expected = folder.summary("run -n 30 -k 900");
    // With messages, so that it writes to the terminal after the terminal has closed.
    let up = format!("-vv up -P 2 -n 30 -k 900 --pace 3ms --out out --run {run}");
    let mut up = PtyCommand::start_without_sighup(&folder.command(&up));
    up.wait_for("TTIs/s");
    up.close();
    let status = up.finish_within(PATIENCE);
    assert!(status.success(), "{status}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!((summary.status(), summary.digest()), ("complete", expected.digest()));
    assert_no_process_left(&run);
}

#[test]
fn a_run_with_unread_output_continues() {
    let (folder, run) = (TestFolder::new(), unique_run("unread"));
    let expected = folder.summary("run -n 30 -k 900");
    // Both pipes lead to a process that has ended.
    let line = format!(
        "{{ {{ {program} -vv up -P 2 -n 30 -k 900 --pace 3ms --out out --run {run} 2>&3; echo $? > code; }} | true; }} \
         3>&1 | true",
        program = reveille_tests::process::reveille().display()
    );
    assert!(start_shell(&folder, &line).finish().is_success());
    let code = wait_until("the run to end", PATIENCE, || {
        fs::read_to_string(folder.join("code"))
            .ok()
            .filter(|code| code.ends_with('\n'))
    });
    assert_eq!(code, "0\n");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!((summary.status(), summary.digest()), ("complete", expected.digest()));
}

#[test]
fn an_ignored_sighup_stays_ignored() {
    let (folder, run) = (TestFolder::new(), unique_run("nohup"));
    let program = reveille_tests::process::reveille().display();
    let line = format!("trap '' HUP; exec {program} up -P 2 {LONG_RUN} --out out --run {run}");
    let up = start_shell(&folder, &line);
    let tti = folder.wait_for_tti(&run, 10);
    up.signal(Signal::HUP);
    folder.wait_for_tti(&run, tti + 50);
    up.signal(Signal::TERM);
    let finished = up.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    assert_eq!(SummaryJson::read(&folder.join("out")).status(), "interrupted");
}

#[test]
fn a_run_continued_after_sigstop_has_the_same_digest() {
    let folder = TestFolder::new();
    // Long enough that the run is still active at the last stop.
    let args = "-n 50 -k 400000 --window 1000";
    let expected = folder.summary(&format!("run {args}"));
    let run = folder.start(&format!("run {args} --out out --json"));
    wait_until("the run to begin", PATIENCE, || {
        folder.join("out/windows.csv").exists().then_some(())
    });
    for _ in 0..3 {
        // Stopped and continued for far longer than a TTI takes.
        run.signal(Signal::STOP);
        std::thread::sleep(Duration::from_millis(100));
        run.signal(Signal::CONT);
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(run.finish().summary().digest(), expected.digest());
}

/// Runs a line of shell in `folder`.
fn start_shell(folder: &TestFolder, line: &str) -> Process {
    let mut command = Command::new("sh");
    command
        .args(["-c", line])
        .current_dir(folder.path())
        .env("XDG_RUNTIME_DIR", folder.join("runtime"))
        .env_remove("RUST_LOG");
    Process::start(&mut command)
}
