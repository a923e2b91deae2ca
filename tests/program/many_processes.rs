//! Runs in many processes, and in processes with many devices: the digest equals the digest of `reveille run`, and no
//! process is left. Also the number of zenoh threads in device processes: `deploy/src/child_process.rs` writes the
//! setting that these tests read from the environment of a process.

use std::fs;

use reveille_tests::process::{PATIENCE, Process, TestFolder, free_endpoint, hosts_of, unique_run, wait_until};

/// More processes than are started at a time on any machine with fewer than eight cores (16 per core,
/// `deploy/src/start_limiter.rs`).
const MANY_PROCESSES: u32 = 120;
/// Number of devices whose ledgers, from two processes, exceed the queue of a link of zenoh.
const MANY_DEVICES: u32 = 3000;

/// Checks that `up` with this many processes has the digest of `run`, without warnings or rejected messages.
fn assert_clean_run(scenario: &str, processes: u32) {
    let folder = TestFolder::new();
    let expected = folder.summary(&format!("run {scenario}"));
    let run = unique_run("many");
    let finished = folder.run(&format!("up {scenario} -P {processes} --run {run} --json --out out"));
    assert!(finished.is_success() && finished.stderr.is_empty(), "{finished}");
    let summary = finished.summary();
    assert_eq!(summary.digest(), expected.digest());
    for (field, value) in [
        ("hosts", u64::from(processes)),
        ("losses", 0),
        ("unexpected_messages", 0),
        ("malformed_messages", 0),
    ] {
        assert_eq!(summary.number(&format!("timing.{field}")), value, "{field}: {finished}");
    }
    assert!(hosts_of(&run).is_empty());
}

#[test]
fn many_processes_run_one_device_each() {
    assert_clean_run(&format!("-n {MANY_PROCESSES} -k 150"), MANY_PROCESSES);
}

#[test]
fn two_processes_run_many_devices_each() {
    assert_clean_run(&format!("-n {MANY_DEVICES} -k 60 -p random"), 2);
}

/// Under `age-index` many devices report an event in the same TTI.
#[test]
fn one_process_sends_many_simultaneous_reports() {
    assert_clean_run(
        &format!("-n {MANY_DEVICES} -k 60 -p age-index --set bs.battery_knowledge=reported"),
        1,
    );
}

/// Returns the zenoh thread setting in the environment with which a process was started.
fn zenoh_setting(pid: u32) -> Option<String> {
    let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    let variables = environment.split(|&byte| byte == 0).map(String::from_utf8_lossy);
    let mut settings = variables.filter_map(|variable| Some(variable.strip_prefix("ZENOH_RUNTIME=")?.to_owned()));
    settings.next()
}

/// Starts a run with two device processes and this setting in its own environment. Returns the run, which continues
/// until dropped, and the settings of the device processes.
fn zenoh_settings_of_hosts(folder: &TestFolder, setting: Option<&str>, args: &str) -> (Process, Vec<Option<String>>) {
    let run = unique_run("threads");
    let mut command = folder.command(&format!(
        "up -n 4 -P 2 -k 100000 --pace 5ms --run {run} --out {run} {args}"
    ));
    command.env_remove("ZENOH_RUNTIME");
    if let Some(setting) = setting {
        command.env("ZENOH_RUNTIME", setting);
    }
    let up = Process::start(&mut command);
    folder.wait_for_tti(&run, 2);
    let hosts = hosts_of(&run);
    assert_eq!(hosts.len(), 2);
    (up, hosts.into_iter().map(zenoh_setting).collect())
}

#[test]
fn device_processes_have_one_zenoh_thread_by_default() {
    let folder = TestFolder::new();
    let (_up, settings) = zenoh_settings_of_hosts(&folder, None, "");
    for setting in settings {
        let setting = setting.expect("one thread");
        assert!(
            setting.contains("app:(worker_threads:1)") && setting.contains("rx:(handover:app)"),
            "{setting}"
        );
    }
    let user_setting = "(rx:(worker_threads:3))";
    let (_up, settings) = zenoh_settings_of_hosts(&folder, Some(user_setting), "");
    assert_eq!(settings, [Some(user_setting.to_owned()), Some(user_setting.to_owned())]);
    let (_up, settings) = zenoh_settings_of_hosts(&folder, None, "--untuned");
    assert_eq!(settings, [None, None]);
}

#[test]
fn a_manually_started_device_process_has_one_zenoh_thread() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("hand"), free_endpoint());
    // `hosts_of` finds the process only by `--run=RUN` in one argument.
    let mut command = folder.command(&format!("device --run={run} --connect {endpoint}"));
    command.env_remove("ZENOH_RUNTIME");
    let device = Process::start(&mut command);
    // The program replaces itself by one with the setting in its environment.
    let setting = wait_until("the process to restart", PATIENCE, || zenoh_setting(device.pid()));
    assert!(setting.contains("rx:(handover:app)"), "{setting}");
    assert_eq!(hosts_of(&run), [device.pid()]);
}
