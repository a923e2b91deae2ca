//! Closed terminals and unread output: the command ends cleanly or continues, and leaves no process behind.

use std::fs;
use std::process::{Command, ExitStatus};
use std::time::Duration;

use reveille_tests::process::{
    PATIENCE, Process, SummaryJson, TestFolder, free_endpoint, hosts_of, send_signal, unique_run, wait_until,
};
use reveille_tests::terminal::PtyCommand;
use rustix::process::Signal;

/// Options of a run that would take a minute.
const LONG: &str = "-n 30 -k 12000 --pace 5ms";
/// Time limit for the end of a command on a busy machine.
const SOON: Duration = Duration::from_secs(20);

/// Waits until no device process of `run` is left.
fn assert_no_process_left(run: &str) {
    wait_until("the device processes to end", PATIENCE, || {
        hosts_of(run).is_empty().then_some(())
    });
}

/// Closes the window of a command, as a terminal and its shell do, and waits for its end.
fn closed(window: &mut PtyCommand) -> ExitStatus {
    let pid = window.pid();
    window.close();
    // Both the shell and the kernel send SIGHUP to the commands.
    for _ in 0..3 {
        send_signal(pid, Signal::HUP);
        std::thread::sleep(Duration::from_millis(5));
    }
    window.finish_within(SOON)
}

/// Checks the summary of a run that a closed terminal has ended.
fn assert_interrupted(folder: &TestFolder, end: ExitStatus) {
    assert_eq!(end.code(), Some(130), "{end}");
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
fn a_closed_terminal_ends_up_with_partial_results() {
    let (folder, run) = (TestFolder::new(), unique_run("window"));
    let mut up = PtyCommand::start(&folder.command(&format!("up -P 4 {LONG} --out out --run {run}")), true);
    up.wait_for("TTIs/s");
    assert_eq!(hosts_of(&run).len(), 4);
    let end = closed(&mut up);
    assert_interrupted(&folder, end);
    assert_no_process_left(&run);
}

#[test]
fn a_closed_terminal_ends_bs_and_device_with_partial_results() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("windows"), free_endpoint());
    let bs = format!("bs {LONG} --out out --run {run} --listen {endpoint}");
    let mut bs = PtyCommand::start(&folder.command(&bs), true);
    bs.wait_for("waiting for 30 devices");
    let device = format!("device --connect {endpoint} --run {run} --count 30");
    let mut device = PtyCommand::start(&folder.command(&device), true);
    bs.wait_for("TTIs/s");
    let end = closed(&mut bs);
    assert_interrupted(&folder, end);
    assert!(device.finish_within(SOON).success(), "{}", device.shown());

    // A device process alone: it has nothing to save.
    let device = format!("device --connect {} --run {run} --count 30", free_endpoint());
    let mut device = PtyCommand::start(&folder.command(&device), true);
    wait_for_hang_up(device.pid());
    assert_eq!(closed(&mut device).code(), Some(130));
}

/// Waits until a process has a SIGHUP handler.
fn wait_for_hang_up(pid: u32) {
    wait_until("the process to take a signal", PATIENCE, || {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
        let caught = u64::from_str_radix(caught.trim(), 16).ok()?;
        (caught >> (Signal::HUP.as_raw() - 1) & 1 == 1).then_some(())
    });
}

#[test]
fn a_closed_terminal_ends_a_run_in_memory_with_partial_results() {
    let folder = TestFolder::new();
    let run = "run -n 50 -k 1000000000 --window 10000 --out out";
    let mut run = PtyCommand::start(&folder.command(run), true);
    run.wait_for("TTIs/s");
    let end = closed(&mut run);
    assert_interrupted(&folder, end);
}

#[test]
fn a_closed_terminal_ends_a_sweep_and_a_recording() {
    let folder = TestFolder::new();
    let sweep = "sweep --devices 20 --ttis 5000 --seeds 900000 --out s";
    let mut sweep = PtyCommand::start(&folder.command(sweep), true);
    sweep.wait_for("runs");
    assert_eq!(closed(&mut sweep).code(), Some(130));
    assert!(folder.join("s/runs.journal").exists());
    let record = "train record -p knn -n 20 -k 5000 --seeds 900000 --chunk 12 --stride 40 --out c.parquet";
    let mut record = PtyCommand::start(&folder.command(record), true);
    record.wait_for("runs");
    assert_eq!(closed(&mut record).code(), Some(130));
    assert!(!folder.join("c.parquet").exists());
}

#[test]
fn a_run_without_a_signal_continues_without_its_terminal() {
    let (folder, run) = (TestFolder::new(), unique_run("untold"));
    let expected = folder.summary("run -n 30 -k 900");
    // With messages, so that it writes to the terminal after the terminal has closed.
    let up = format!("-vv up -P 2 -n 30 -k 900 --pace 3ms --out out --run {run}");
    let mut up = PtyCommand::start(&folder.command(&up), false);
    up.wait_for("TTIs/s");
    up.close();
    let end = up.finish_within(PATIENCE);
    assert!(end.success(), "{end}");
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
    assert!(sh(&folder, &line).finish().is_success());
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
fn nohup_is_respected() {
    let (folder, run) = (TestFolder::new(), unique_run("nohup"));
    let program = reveille_tests::process::reveille().display();
    let line = format!("trap '' HUP; exec {program} up -P 2 {LONG} --out out --run {run}");
    let up = sh(&folder, &line);
    let at = folder.wait_for_tti(&run, 10);
    up.signal(Signal::HUP);
    folder.wait_for_tti(&run, at + 50);
    up.signal(Signal::TERM);
    let end = up.finish();
    assert_eq!(end.code(), Some(130), "{end}");
    assert_eq!(SummaryJson::read(&folder.join("out")).status(), "interrupted");
}

#[test]
fn a_stopped_run_continues_unchanged() {
    let folder = TestFolder::new();
    let args = "-n 50 -k 400000 --window 1000";
    let expected = folder.summary(&format!("run {args}"));
    let run = folder.start(&format!("run {args} --out out --json"));
    wait_until("the run to begin", PATIENCE, || {
        folder.join("out/windows.csv").exists().then_some(())
    });
    for _ in 0..3 {
        run.signal(Signal::STOP);
        std::thread::sleep(Duration::from_millis(100));
        run.signal(Signal::CONT);
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(run.finish().summary().digest(), expected.digest());
}

/// Starts a shell in `folder`.
fn sh(folder: &TestFolder, line: &str) -> Process {
    let mut command = Command::new("sh");
    command
        .args(["-c", line])
        .current_dir(folder.path())
        .env("XDG_RUNTIME_DIR", folder.join("runtime"))
        .env_remove("RUST_LOG");
    Process::start(&mut command)
}
