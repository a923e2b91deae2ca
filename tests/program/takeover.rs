//! Takeover of a killed process's devices by other hosts, and resumed base stations (`up --resume`, `bs --resume`): the
//! digest and tables equal an undisturbed run, and a changed folder is refused. The runs last several seconds, so that
//! kills and resume marks, a second apart, come before their end.

use reveille_tests::process::{
    PATIENCE, SummaryJson, TestFolder, assert_refused, free_endpoint, hosts_of, send_signal, unique_run, wait_until,
};
use rustix::process::Signal;

/// Kills `kill_count` device processes of `up`, each after the takeover of the one before, and checks the digest.
fn check_takeovers(scenario: &str, kill_count: usize) {
    let folder = TestFolder::new();
    let expected = folder.summary(&format!("run {scenario}"));
    let run = unique_run("takeover");
    let up = folder.start(&format!(
        "up -P 4 --out out --run {run} {scenario} --pace 4ms --audit on --json"
    ));
    for kill in 0..kill_count {
        let tti = folder.wait_for_tti(&run, 10);
        let hosts = wait_until("four device processes", PATIENCE, || {
            Some(hosts_of(&run)).filter(|hosts| hosts.len() == 4)
        });
        let killed = hosts[kill % 4];
        send_signal(killed, Signal::KILL);
        wait_until("another process", PATIENCE, || {
            let hosts = hosts_of(&run);
            (hosts.len() == 4 && !hosts.contains(&killed)).then_some(())
        });
        folder.wait_for_tti(&run, tti + 20);
    }
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    assert!(finished.stderr.contains("had no host for"), "{finished}");
    let summary = finished.summary();
    assert_eq!(summary.digest(), expected.digest());
    assert_eq!(summary.number("timing.losses"), kill_count as u64, "{finished}");
    assert_eq!(summary.text("audit"), "complete");
    assert!(hosts_of(&run).is_empty());
}

#[test]
fn devices_of_a_killed_process_are_taken_over_with_knn() {
    check_takeovers("-n 30 -k 1500 -p knn", 3);
}

#[test]
fn devices_of_a_killed_process_are_taken_over_with_learning() {
    check_takeovers("-n 30 -k 900 -p q-learning --learn", 2);
}

#[test]
fn a_process_with_spare_capacity_takes_over() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("room"), free_endpoint());
    let scenario = "-n 30 -k 1200";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs = folder.start(&format!(
        "bs {scenario} --pace 4ms --out out --run {run} --listen {endpoint}"
    ));
    bs.wait_for_stderr("waiting for 30 devices");
    let start_host = |count: u32| folder.start(&format!("device --connect {endpoint} --run {run} --count {count}"));
    let lost_host = start_host(10);
    lost_host.wait_for_stderr("joined");
    let large_host = start_host(40);
    large_host.wait_for_stderr("joined");
    folder.wait_for_tti(&run, 20);
    lost_host.signal(Signal::KILL);
    bs.wait_for_stderr("had no host for");
    let standby = start_host(5);
    standby.wait_for_stderr("standing by");
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(SummaryJson::read(&folder.join("out")).digest(), expected.digest());
    for process in [large_host, standby] {
        let finished = process.finish();
        assert!(finished.is_success(), "{finished}");
    }
}

/// Kills the base station midway, and resumes the run with the device processes that are still alive.
#[test]
fn a_killed_base_station_resumes_with_its_live_hosts() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("resume"), free_endpoint());
    let scenario = "-n 30 -k 1500 -p q-learning --learn";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs_options = format!("--pace 3ms --run {run} --listen {endpoint}");
    let bs = folder.start(&format!("bs {scenario} --out out {bs_options}"));
    bs.wait_for_stderr("waiting for 30 devices");
    let hosts = [10, 20].map(|count| {
        let host = folder.start(&format!("device --connect {endpoint} --run {run} --count {count}"));
        host.wait_for_stderr("joined");
        host
    });
    wait_until("a resume mark", PATIENCE, || {
        folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    folder.wait_for_tti(&run, 1);
    bs.signal(Signal::KILL);
    bs.finish();
    let hint = format!("reveille bs --resume {}`", folder.join("out").display());
    assert_refused(&folder.run("clock status"), 1, &[&hint]);
    // The folder has the name and the address of the run.
    let bs = folder.start("bs --resume out --pace 3ms");
    bs.wait_for_stderr("replaying the run up to TTI");
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!((summary.digest(), summary.status()), (expected.digest(), "complete"));
    for host in hosts {
        let finished = host.finish();
        assert!(finished.is_success(), "{finished}");
    }
    assert!(!folder.list("out").contains(&"address.json".to_owned()));
    let second_resume = folder.run("bs --resume out");
    assert!(
        second_resume.code() == Some(1) && second_resume.stderr.contains("has finished"),
        "{second_resume}"
    );
}

/// Ends a run of `command` with `signal`, and checks that the resumed run equals an undisturbed one in digest and
/// tables.
fn check_resumed_run(command: &str, signal: Signal) {
    let folder = TestFolder::new();
    let scenario = "-n 40 -k 60000 -p knn --window 7000";
    let expected = folder.summary(&format!("run {scenario} --out whole"));
    let process = folder.start(&format!("{command} {scenario} --no-lookahead --out out"));
    wait_until("a resume mark", PATIENCE, || {
        folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    process.signal(signal);
    // Returns once the device processes have ended too, since they share its standard error.
    process.finish();
    let finished = folder.run(&format!("{command} --resume out"));
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!((summary.digest(), summary.status()), (expected.digest(), "complete"));
    for table in ["events.csv", "windows.csv", "devices.csv"] {
        let read = |out: &str| std::fs::read(folder.join(out).join(table)).expect("readable");
        assert!(read("out") == read("whole"), "{table}");
    }
    assert!(!folder.list("out").contains(&"resume.json".to_owned()));
}

#[test]
fn a_killed_run_resumes() {
    check_resumed_run("up -P 2", Signal::KILL);
}

#[test]
fn an_interrupted_run_resumes() {
    check_resumed_run("up -P 2", Signal::TERM);
}

/// A run interrupted while it waits ends in the middle of a TTI. It is resumed from its state before that TTI.
#[test]
fn a_run_interrupted_while_waiting_resumes() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("held"), free_endpoint());
    // This policy sends a plan in each TTI, so that the open TTI already has a message.
    let scenario = "-n 20 -k 800 -p random";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs_options = format!("--pace 3ms --run {run} --listen {endpoint}");
    let start_host = || {
        let host = folder.start(&format!("device --connect {endpoint} --run {run} --count 20"));
        host.wait_for_stderr("joined");
        host
    };
    let bs = folder.start(&format!("bs {scenario} --out out {bs_options}"));
    bs.wait_for_stderr("waiting for 20 devices");
    let killed = start_host();
    folder.wait_for_tti(&run, 20);
    killed.signal(Signal::KILL);
    bs.wait_for_stderr("the run is waiting");
    bs.signal(Signal::TERM);
    let finished = bs.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    let bs = folder.start(&format!("bs --resume out {bs_options}"));
    bs.wait_for_stderr("waiting for 20 devices");
    let successor = start_host();
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(SummaryJson::read(&folder.join("out")).digest(), expected.digest());
    assert!(successor.finish().is_success());
}

#[test]
fn a_changed_or_unsuitable_folder_is_not_resumed() {
    let folder = TestFolder::new();
    let up = folder.start("up -P 2 -n 40 -k 60000 --no-lookahead --out out");
    wait_until("a resume mark", PATIENCE, || {
        folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    up.signal(Signal::KILL);
    up.finish();
    let path = folder.join("out/resume.json");
    let text = std::fs::read_to_string(&path).expect("readable");
    let (text_before, fingerprint) = text.rsplit_once("\"fingerprint\":\"").expect("a fingerprint");
    let changed_digit = if fingerprint.starts_with('0') { '1' } else { '0' };
    std::fs::write(
        &path,
        format!("{text_before}\"fingerprint\":\"{changed_digit}{}", &fingerprint[1..]),
    )
    .expect("writable");
    let finished = folder.run("up -P 2 --resume out");
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert!(finished.stderr.contains("the replay diverged"), "{finished}");
    for (args, why) in [
        ("--resume nothing", "the folder holds no run"),
        ("--resume out -n 5", "leave out all options"),
        ("--resume out --out other", "cannot be used with"),
    ] {
        let finished = folder.run(&format!("up {args}"));
        assert!(!finished.is_success() && finished.stderr.contains(why), "{finished}");
    }
}

#[test]
fn processes_without_a_count_share_the_devices() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("shares"), free_endpoint());
    let scenario = "-n 50 -k 900";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs = folder.start(&format!(
        "bs {scenario} --pace 4ms --out out --run {run} --listen {endpoint}"
    ));
    bs.wait_for_stderr("waiting for 50 devices");
    let hosts: Vec<_> = (0..4)
        .map(|_| folder.start(&format!("device --connect {endpoint} --run {run}")))
        .collect();
    folder.wait_for_tti(&run, 10);
    let status = folder.clock(&run, "status --hosts");
    for range in ["0 to 12", "13 to 25", "26 to 37", "38 to 49"] {
        assert!(status.contains(&format!("(devices {range}, ")), "no {range}: {status}");
    }
    let late_host = folder.start(&format!("device --connect {endpoint} --run {run}"));
    late_host.wait_for_stderr("standing by");
    // Any of the others may take over.
    hosts[1].signal(Signal::KILL);
    bs.wait_for_stderr("had no host for");
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(SummaryJson::read(&folder.join("out")).digest(), expected.digest());
}

#[test]
fn one_command_starts_resumes_and_confirms_a_run() {
    let (folder, run) = (TestFolder::new(), unique_run("continue"));
    let scenario = "-n 20 -k 1200 --seed 3";
    let expected = folder.summary(&format!("run {scenario}"));
    let command = format!("up {scenario} --pace 4ms --run {run} --out out --continue --quiet");
    let killed = folder.start(&command);
    folder.wait_for_tti(&run, 400);
    killed.signal(Signal::KILL);
    killed.finish();
    let other = folder.run(&command.replace("--seed 3", "--seed 4"));
    assert_refused(&other, 1, &["run of another scenario", "seed is 3 there and 4 here"]);
    let resumed = folder.run(&command);
    assert!(resumed.is_success(), "{resumed}");
    assert!(resumed.stderr.contains("replaying the run up to TTI"), "{resumed}");
    let digest_line = format!("digest {}\n", expected.digest());
    assert_eq!(resumed.stdout, digest_line);
    let again = folder.run(&command);
    assert!(again.is_success() && again.stderr.is_empty(), "{again}");
    assert_eq!(again.stdout, digest_line);
}

#[test]
fn a_loss_ends_the_run_after_its_limit_and_the_run_can_be_resumed() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("limit"), free_endpoint());
    let scenario = "-n 20 -k 1500";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs = folder.start(&format!(
        "bs {scenario} --pace 4ms --loss-timeout 1s --out out --run {run} --listen {endpoint}"
    ));
    bs.wait_for_stderr("waiting for 20 devices");
    let host = folder.start(&format!("device --connect {endpoint} --run {run}"));
    folder.wait_for_tti(&run, 400);
    host.signal(Signal::KILL);
    let finished = bs.finish();
    let parts = [
        "host 0 (devices 0 to 19, the process with pid ",
        "within 1s, the --loss-timeout",
        "--resume",
    ];
    assert_eq!(finished.code(), Some(1), "{finished}");
    for part in parts {
        assert!(finished.stderr.contains(part), "no {part:?}: {finished}");
    }
    let resumed = folder.run(&format!("up --resume out --run {run} --quiet"));
    assert_eq!(resumed.stdout, format!("digest {}\n", expected.digest()), "{resumed}");
}
