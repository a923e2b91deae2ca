//! Killed, frozen and interrupted base stations and device processes under `--on-loss end` and `wait`: the error names
//! the lost host, partial results are kept, a thawed process continues with the digest of `reveille run`, and no
//! process is left.

use std::time::{Duration, Instant};

use reveille_common::bus::Bus;
use reveille_common::message::{ClockMessage, HostOffer, JoinReply, JoinRequest, PlanUpdate, Ready};
use reveille_tests::process::{
    FinishedProcess, PATIENCE, Process, SummaryJson, TestFolder, ask, free_endpoint, hosts_of, now, send_signal,
    unique_run, wait_until,
};
use rustix::process::Signal;

/// Options of a run that would take a minute, so that faults occur midway. Base stations and hosts of the tests need
/// its 30 devices.
const LONG: &str = "-n 30 -k 12000 --pace 5ms";

/// Time limit to detect a killed device process: its link closes immediately, and the rest is a margin for a busy
/// machine.
const DETECTION_LIMIT: Duration = Duration::from_secs(4);

/// Time limit to detect a frozen device process: the lease of a link, two seconds (`common/src/bus/session.rs`), and a
/// margin for a busy machine.
const FREEZE_LIMIT: Duration = Duration::from_secs(8);

/// Checks the end of a run whose process was killed or frozen at `since`, less than `limit` ago.
fn assert_lost(finished: &FinishedProcess, since: Instant, limit: Duration) {
    let elapsed = since.elapsed();
    assert_eq!(finished.code(), Some(1), "{finished}");
    for part in ["lost host", "(devices ", " at TTI "] {
        assert!(finished.stderr.contains(part), "no {part:?}: {finished}");
    }
    assert_eq!(
        finished
            .stderr
            .trim()
            .lines()
            .filter(|line| line.starts_with("reveille: "))
            .count(),
        1,
        "{finished}"
    );
    assert!(elapsed < limit, "detected only after {elapsed:?}");
}

/// Checks that all device processes of `run` end, and waits for it.
fn assert_no_process_left(run: &str) {
    wait_until("the device processes to end", PATIENCE, || {
        hosts_of(run).is_empty().then_some(())
    });
}

/// Starts `up` with four device processes, and waits past its first TTIs. Returns the process and the ids of the device
/// processes.
fn start_up_mid_run(folder: &TestFolder, run: &str, args: &str) -> (Process, Vec<u32>) {
    let up = folder.start(&format!("up -P 4 --out out --run {run} {args}"));
    folder.wait_for_tti(run, 10);
    let hosts = hosts_of(run);
    assert_eq!(hosts.len(), 4);
    (up, hosts)
}

#[test]
fn a_killed_device_process_ends_up() {
    let (folder, run) = (TestFolder::new(), unique_run("kill"));
    let (up, hosts) = start_up_mid_run(&folder, &run, &format!("{LONG} --on-loss end"));
    let since = now();
    send_signal(hosts[2], Signal::KILL);
    let finished = up.finish();
    assert_lost(&finished, since, DETECTION_LIMIT);
    assert_no_process_left(&run);
    assert_eq!(
        folder.list("out"),
        [
            "FAILED",
            "address.json",
            "events.csv",
            "resume.json",
            "scenario.toml",
            "windows.csv"
        ]
    );
    let why = std::fs::read_to_string(folder.join("out/FAILED")).expect("readable");
    for message in [&why, &finished.stderr] {
        let pid_text = format!("with pid {} ended with signal: 9 (SIGKILL): lost host ", hosts[2]);
        assert!(
            message.contains(&pid_text) && !message.contains("--on-loss"),
            "{message}"
        );
    }
}

/// Starts a base station and two device processes separately, and waits past the first TTIs. They run devices 0 to 9
/// and 10 to 29, so `args` must state 30 devices.
fn start_bs_mid_run(folder: &TestFolder, run: &str, args: &str) -> (Process, [Process; 2]) {
    let endpoint = free_endpoint();
    let bs = folder.start(&format!("bs --out out --run {run} --listen {endpoint} {args}"));
    bs.wait_for_stderr("waiting for 30 devices");
    let hosts = [10, 20].map(|count| {
        let host = folder.start(&format!(
            "-v device --connect-timeout 3s --connect {endpoint} --run {run} --count {count}"
        ));
        host.wait_for_stderr("joined");
        host
    });
    folder.wait_for_tti(run, 10);
    (bs, hosts)
}

#[test]
fn a_killed_device_process_ends_bs_and_is_named() {
    let (folder, run) = (TestFolder::new(), unique_run("killbs"));
    let (bs, [host_0, host_1]) = start_bs_mid_run(&folder, &run, &format!("{LONG} --on-loss end"));
    let since = now();
    host_0.signal(Signal::KILL);
    let finished = bs.finish();
    assert_lost(&finished, since, DETECTION_LIMIT);
    assert!(finished.stderr.contains("host 0 (devices 0 to 9, "), "{finished}");
    let host_1 = host_1.finish();
    assert_eq!(host_1.code(), Some(1), "the other hosts fail too: {host_1}");
    assert!(host_1.stderr.contains("the run has failed: lost host 0"), "{host_1}");
}

#[test]
fn a_frozen_device_process_is_lost_after_its_lease() {
    let (folder, run) = (TestFolder::new(), unique_run("freeze"));
    let (up, hosts) = start_up_mid_run(&folder, &run, &format!("{LONG} --on-loss end"));
    let since = now();
    send_signal(hosts[1], Signal::STOP);
    let finished = up.finish();
    assert_lost(&finished, since, FREEZE_LIMIT);
    assert!(finished.stderr.contains("froze"), "{finished}");
    assert_no_process_left(&run);
}

/// Freezes a device process for longer than its lease, lets it continue, and checks the digest. `scenario` holds
/// options of a run that takes at least some seconds at 5 ms per TTI.
fn check_thawed_process(scenario: &str) {
    let folder = TestFolder::new();
    let expected = folder.summary(&format!("run {scenario}"));
    let run = unique_run("thaw");
    let (up, hosts) = start_up_mid_run(&folder, &run, &format!("{scenario} --pace 5ms --on-loss wait --json"));
    send_signal(hosts[1], Signal::STOP);
    up.wait_for_stderr("the run is waiting");
    let waiting_tti = folder.wait_for_tti(&run, 0);
    // The warning came after the lease, so the process is frozen for about twice the lease.
    std::thread::sleep(Duration::from_secs(2));
    assert_eq!(
        folder.wait_for_tti(&run, 0),
        waiting_tti,
        "the clock of the waiting run"
    );
    send_signal(hosts[1], Signal::CONT);
    let finished = up.finish();
    assert!(finished.stderr.contains("is back"), "{finished}");
    let summary = finished.summary();
    assert_eq!(summary.digest(), expected.digest());
    // The summary reports the delay against the pace.
    assert!(summary.number("timing.late_ttis") > 0, "{finished}");
}

#[test]
fn a_thawed_device_process_continues_with_knn() {
    check_thawed_process("-n 30 -k 800 -p knn");
}

#[test]
fn a_thawed_device_process_continues_with_random() {
    check_thawed_process("-n 30 -k 800 -p random");
}

/// Kills the remaining device processes of a run on drop, in case the test fails.
struct ProcessReaper(String);

impl Drop for ProcessReaper {
    fn drop(&mut self) {
        for host in hosts_of(&self.0) {
            send_signal(host, Signal::KILL);
        }
    }
}

#[test]
fn no_device_process_outlives_a_killed_up() {
    let (folder, run) = (TestFolder::new(), unique_run("orphans"));
    let (up, hosts) = start_up_mid_run(&folder, &run, LONG);
    let _reaper = ProcessReaper(run.clone());
    // A frozen process cannot exit: the kernel has to kill it.
    send_signal(hosts[0], Signal::STOP);
    up.signal(Signal::KILL);
    let finished = up.finish();
    assert_eq!(finished.code(), None, "{finished}");
    assert_no_process_left(&run);
    assert!(
        folder.list("out").contains(&"RUNNING".to_owned()),
        "the file RUNNING of the killed run"
    );
    assert!(!folder.list("out").contains(&"summary.json".to_owned()));
}

/// Interrupts `command`, which is `up` or `bs`, midway with `signal` and checks its partial results.
fn check_interrupted_run(command: &str, signal: Signal) {
    let (folder, run) = (TestFolder::new(), unique_run("interrupt"));
    let (process, hosts) = if command == "bs" {
        let (bs, hosts) = start_bs_mid_run(&folder, &run, LONG);
        (bs, hosts.into_iter().collect())
    } else {
        (start_up_mid_run(&folder, &run, LONG).0, Vec::new())
    };
    process.signal(signal);
    let finished = process.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.status(), "interrupted");
    assert!((10..12_000).contains(&summary.number("ttis_done")), "{summary:?}");
    assert_eq!(
        folder.list("out"),
        [
            "address.json",
            "devices.csv",
            "events.csv",
            "resume.json",
            "scenario.toml",
            "summary.json",
            "windows.csv"
        ]
    );
    for host in hosts {
        let host = host.finish();
        assert!(host.is_success(), "{host}");
    }
    assert_no_process_left(&run);
    assert_eq!(folder.list("runtime/reveille"), [""; 0], "registered runs");
}

#[test]
fn sigint_ends_up_with_partial_results() {
    check_interrupted_run("up", Signal::INT);
}

#[test]
fn sigterm_ends_up_with_partial_results() {
    check_interrupted_run("up", Signal::TERM);
}

#[test]
fn sigint_ends_bs_with_partial_results() {
    check_interrupted_run("bs", Signal::INT);
}

#[test]
fn a_paused_run_can_be_interrupted() {
    let (folder, run) = (TestFolder::new(), unique_run("partial"));
    let (up, _) = start_up_mid_run(&folder, &run, LONG);
    folder.clock(&run, "pause");
    let tti = folder.wait_for_tti(&run, 10);
    up.signal(Signal::INT);
    assert_eq!(up.finish().code(), Some(130));
    let summary = SummaryJson::read(&folder.join("out"));
    assert!(summary.number("ttis_done").abs_diff(tti) <= 1, "{summary:?}");
}

#[test]
fn a_base_station_that_waits_for_devices_can_be_interrupted() {
    let (folder, run) = (TestFolder::new(), unique_run("waiting"));
    let bs = folder.start(&format!("bs --out out -n 30 --run {run} --listen {}", free_endpoint()));
    // The clock answers as soon as the run is prepared.
    folder.wait_for_clock(&run);
    bs.signal(Signal::INT);
    let finished = bs.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    assert!(
        finished.stderr.contains("interrupted before all devices had joined"),
        "{finished}"
    );
    assert!(!folder.list("out").contains(&"RUNNING".to_owned()));
}

#[test]
fn device_processes_of_a_killed_base_station_end() {
    let (folder, run) = (TestFolder::new(), unique_run("headless"));
    let (bs, hosts) = start_bs_mid_run(&folder, &run, LONG);
    bs.signal(Signal::KILL);
    bs.finish();
    for host in hosts {
        let finished = host.finish();
        assert_eq!(finished.code(), Some(1), "{finished}");
        assert!(
            finished.stderr.contains(&format!("lost the base station of run {run}")),
            "{finished}"
        );
    }
}

/// A broken link can lose a grant and the plan before it, so both are retransmitted in order. This test is the host,
/// and never answers.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_unanswered_grant_is_repeated_with_its_plan() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("silent"), free_endpoint());
    let bs = folder.start(&format!("bs -n 30 -p random --out out --run {run} --listen {endpoint}"));
    let bus = Bus::connect(&endpoint, run.parse().expect("a run name"), PATIENCE)
        .await
        .expect("the BS listens");
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        offer: HostOffer::AtMost(30),
        nonce: 7,
        name: "a test".to_owned(),
    };
    let reply = ask(&bus, &request).await.expect("a reply");
    let JoinReply::Welcome(assignment) = reply else {
        panic!("{reply:?}")
    };
    let credentials = assignment.credentials;
    let credential = credentials.credential;
    let bus = bus.with_secret(credentials.secret);
    let (grant_sender, received_kinds) = std::sync::mpsc::channel();
    let plan_sender = grant_sender.clone();
    let _plan = bus
        .subscribe(credential.host, move |_: PlanUpdate| {
            let _closed = plan_sender.send("plan");
        })
        .expect("subscribed");
    let _clock = bus
        .subscribe(credential.host, move |_: ClockMessage| {
            let _closed = grant_sender.send("grant");
        })
        .expect("subscribed");
    let _alive = bus
        .declare_alive(bus.key_exprs().host_liveliness(credential))
        .expect("declared");
    let ready = Ready { host: credential.host };
    let is_accepted = bus
        .query_until(&ready, Some(credential.token), PATIENCE)
        .await
        .expect("a reply");
    assert_eq!(is_accepted, Some(true));
    let order: Vec<&str> = (0..4)
        .map(|_| received_kinds.recv_timeout(PATIENCE).expect("the BS retransmits"))
        .collect();
    assert_eq!(order, ["plan", "grant", "plan", "grant"]);
    drop(bs);
}
