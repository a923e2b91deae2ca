//! Many processes, and processes with many devices: the digest of a run in memory, a clean end, and no process left
//! behind.

use std::fs;

use reveille_tests::process::{PATIENCE, Process, TestFolder, free_endpoint, hosts_of, unique_run, wait_until};

/// More processes than are started at a time on any machine with fewer than eight cores.
const MANY: u32 = 120;
/// Number of devices whose ledgers, from two processes, exceed the queue of a link.
const HEAVY: u32 = 3000;

/// Compares a run of `scenario` over the bus in `processes` processes, without warnings, with a run in memory.
fn clean(scenario: &str, processes: u32) {
    let folder = TestFolder::new();
    let expected = folder.summary(&format!("run {scenario}"));
    let run = unique_run("many");
    let end = folder.run(&format!("up {scenario} -P {processes} --run {run} --json --out out"));
    assert!(end.is_success() && end.stderr.is_empty(), "{end}");
    let summary = end.summary();
    assert_eq!(summary.digest(), expected.digest());
    for (field, value) in [
        ("hosts", u64::from(processes)),
        ("losses", 0),
        ("unexpected_messages", 0),
        ("malformed_messages", 0),
    ] {
        assert_eq!(summary.number(&format!("timing.{field}")), value, "{field}: {end}");
    }
    assert!(hosts_of(&run).is_empty());
}

#[test]
fn many_processes_with_a_device_each() {
    clean(&format!("-n {MANY} -k 150"), MANY);
}

#[test]
fn processes_with_many_devices_each() {
    clean(&format!("-n {HEAVY} -k 60 -p random"), 2);
}

/// Many devices report an event in the same TTI.
#[test]
fn many_simultaneous_reports_from_one_process() {
    clean(
        &format!("-n {HEAVY} -k 60 -p age-index --set bs.battery_knowledge=reported"),
        1,
    );
}

/// Returns the zenoh thread setting in the environment of a process.
fn threads_said(pid: u32) -> Option<String> {
    let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    let variables = environment.split(|&byte| byte == 0).map(String::from_utf8_lossy);
    let mut said = variables.filter_map(|variable| Some(variable.strip_prefix("ZENOH_RUNTIME=")?.to_owned()));
    said.next()
}

/// Starts a run with two device processes, which continues until dropped, and returns their thread settings.
fn threads_of_hosts(folder: &TestFolder, said: Option<&str>, args: &str) -> (Process, Vec<Option<String>>) {
    let run = unique_run("threads");
    let mut command = folder.command(&format!(
        "up -n 4 -P 2 -k 100000 --pace 5ms --run {run} --out {run} {args}"
    ));
    command.env_remove("ZENOH_RUNTIME");
    if let Some(said) = said {
        command.env("ZENOH_RUNTIME", said);
    }
    let up = Process::start(&mut command);
    folder.wait_for_tti(&run, 2);
    let hosts = hosts_of(&run);
    assert_eq!(hosts.len(), 2);
    (up, hosts.into_iter().map(threads_said).collect())
}

#[test]
fn zenoh_has_one_thread_in_device_processes_by_default() {
    let folder = TestFolder::new();
    let (_up, threads) = threads_of_hosts(&folder, None, "");
    for said in threads {
        let said = said.expect("one thread");
        assert!(
            said.contains("app:(worker_threads:1)") && said.contains("rx:(handover:app)"),
            "{said}"
        );
    }
    let own = "(rx:(worker_threads:3))";
    let (_up, threads) = threads_of_hosts(&folder, Some(own), "");
    assert_eq!(threads, [Some(own.to_owned()), Some(own.to_owned())]);
    let (_up, threads) = threads_of_hosts(&folder, None, "--untuned");
    assert_eq!(threads, [None, None]);
}

#[test]
fn a_device_process_by_hand_has_one_thread_for_zenoh_too() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("hand"), free_endpoint());
    let mut command = folder.command(&format!("device --run={run} --connect {endpoint}"));
    command.env_remove("ZENOH_RUNTIME");
    let device = Process::start(&mut command);
    let said = wait_until("the process to restart", PATIENCE, || threads_said(device.pid()));
    assert!(said.contains("rx:(handover:app)"), "{said}");
    assert_eq!(hosts_of(&run), [device.pid()]);
}
