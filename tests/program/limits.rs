//! Limits of open files, ports and disk space: a run works within the limit that an error suggests, and reports an
//! insufficient one before it begins or with its cause. The expected numbers of files follow from the constants in
//! `deploy/src/file_limits.rs`: 48 of a base station, one more for each device process, 32 of a device process. Tests
//! with special disks and networks are skipped without root.

use std::fs;
use std::process::Command;
use std::time::Duration;

use reveille_tests::machine::{FewPorts, Mount, print_skipped};
use reveille_tests::process::{
    FinishedProcess, Process, SummaryJson, TestFolder, assert_refused, free_endpoint, reveille, unique_run,
};

/// Time limit for a refusal on a busy machine, well below the default of `--connect-timeout`, thirty seconds.
const REFUSAL_LIMIT: Duration = Duration::from_secs(10);

/// Time limit for the restarts of device processes that end immediately, with a margin for a busy machine.
const RESTART_LIMIT: Duration = Duration::from_secs(20);

/// Starts `reveille ARGS` with these hard and soft limits of open files. Apart from the limits, its environment is as
/// in [`TestFolder::command`].
fn start_limited(folder: &TestFolder, hard_limit: u32, soft_limit: u32, args: &str) -> Process {
    let line = format!(
        "ulimit -Sn {soft_limit}; ulimit -Hn {hard_limit}; exec {} {args}",
        reveille().display()
    );
    let mut command = Command::new("sh");
    command
        .args(["-c", &line])
        .current_dir(folder.path())
        .env("XDG_RUNTIME_DIR", folder.join("runtime"))
        .env_remove("RUST_LOG");
    Process::start(&mut command)
}

/// Checks that a command is refused under a limit of `file_limit` open files, before it creates a run folder.
fn assert_refused_at_limit(folder: &TestFolder, file_limit: u32, args: &str, parts: &[&str]) {
    let finished = start_limited(folder, file_limit, file_limit, args).finish_within(REFUSAL_LIMIT);
    assert_refused(&finished, 1, parts);
    let new_files: Vec<String> = folder.list(".").into_iter().filter(|name| name != "runtime").collect();
    assert_eq!(new_files, [""; 0], "files of a refused run");
}

#[test]
fn too_few_files_are_refused_before_the_run() {
    let folder = TestFolder::new();
    let limit_message = |file_limit: u32| format!("may have {file_limit} files open");
    assert_refused_at_limit(
        &folder,
        64,
        "up -n 50 -P 50",
        &[
            &limit_message(64),
            "50 device processes needs 98",
            "ulimit -n 98",
            "at most 16 device processes",
        ],
    );
    assert_refused_at_limit(&folder, 24, "up -P 4", &[&limit_message(24), "ulimit -n 52"]);
    let bs = format!("bs --run x --listen {}", free_endpoint());
    assert_refused_at_limit(&folder, 24, &bs, &[&limit_message(24), "ulimit -n 49"]);
    let device = format!("device --run x --count 1 --connect {}", free_endpoint());
    assert_refused_at_limit(&folder, 24, &device, &[&limit_message(24), "a device process needs 32"]);
}

#[test]
fn the_suggested_file_limit_is_enough() {
    let folder = TestFolder::new();
    let expected = folder.summary("run -n 50 -k 200");
    // The hard limit is as needed and the soft limit is half of it: the run raises its soft limit.
    for (processes, file_limit) in [(16, 64), (4, 52), (0, 48)] {
        let run = unique_run("few");
        let up = start_limited(
            &folder,
            file_limit,
            file_limit / 2,
            &format!("up -n 50 -k 200 -P {processes} --json --run {run} --out {run} --record {run}.mcap"),
        );
        assert_eq!(up.finish().summary().digest(), expected.digest());
    }
    let (run, endpoint) = (unique_run("hand"), free_endpoint());
    let bs = start_limited(
        &folder,
        49,
        24,
        &format!("bs -n 50 -k 200 --json --run {run} --listen {endpoint} --out hand"),
    );
    bs.wait_for_stderr("at most 1 device processes can join;");
    let device = format!("device --run {run} --count 50 --connect {endpoint}");
    let device = start_limited(&folder, 32, 16, &device).finish();
    assert!(device.is_success(), "{device}");
    assert_eq!(bs.finish().summary().digest(), expected.digest());
}

/// Checks a refusal that leaves no run folder `disk/out`, or one that is neither active nor finished.
fn assert_refused_without_run(folder: &TestFolder, finished: &FinishedProcess, parts: &[&str]) {
    assert_refused(finished, 1, parts);
    let files = folder.list("disk/out");
    assert!(
        !files.iter().any(|name| name == "RUNNING" || name == "summary.json"),
        "{files:?}"
    );
}

#[test]
fn a_lack_of_ports_is_reported_promptly() {
    let folder = TestFolder::new();
    // Four ports: one for the base station, the others for connections of the first device processes.
    let Some(network) = FewPorts::make(&unique_run("ports"), 4) else {
        print_skipped("cannot create a separate network here (root is needed)");
        return;
    };
    let mut up = network.command(reveille());
    up.args("up -n 40 -k 200 -P 10 --out out".split(' '))
        .current_dir(folder.path())
        .env("XDG_RUNTIME_DIR", folder.join("runtime"))
        .env_remove("RUST_LOG");
    let finished = Process::start(&mut up).finish_within(RESTART_LIMIT);
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert!(
        finished.stderr.contains("cannot connect to tcp/127.0.0.1:") && finished.stderr.contains("no free port"),
        "{finished}"
    );
    assert!(!finished.stderr.contains("no base station answers"), "{finished}");
    assert!(folder.list("out").contains(&"FAILED".to_owned()));
}

#[test]
fn a_read_only_folder_is_named() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join("disk")).expect("possible");
    let path = folder.join("disk");
    let Some(_disk) = Mount::read_only(&path) else {
        print_skipped("cannot mount a folder read-only here (root is needed)");
        return;
    };
    for command in ["run", "up -P 1", "bs --run x --listen tcp/127.0.0.1:0"] {
        let finished = folder.run(&format!("{command} -n 5 -k 50 --out disk/out"));
        assert_refused_without_run(&folder, &finished, &["disk/out", "Read-only file system"]);
    }
}

#[test]
fn a_run_on_a_full_disk_reports_it_and_can_be_replaced() {
    let folder = TestFolder::new();
    let path = folder.join("disk");
    let Some(_disk) = Mount::small(&path) else {
        print_skipped("cannot mount a small tmpfs here (root is needed)");
        return;
    };
    let expected = folder.summary("run -n 20 -k 400");
    for command in ["run", "up -P 2"] {
        // The rows do not fit on the disk of 256 kB.
        let too_long = format!("{command} -n 20 -k 400000 --window 10 --out disk/out --force");
        let finished = folder.run(&too_long);
        assert_refused(&finished, 1, &["disk/out", "No space left on device"]);
        let files = folder.list("disk/out");
        assert!(
            files.contains(&"FAILED".to_owned()) && !files.contains(&"RUNNING".to_owned()),
            "{files:?}"
        );
        assert!(!files.contains(&"summary.json".to_owned()), "{files:?}");
        let rows = String::from_utf8(folder.bytes("disk/out/windows.csv")).expect("text");
        // The rows up to the full disk are kept.
        assert!(rows.lines().count() > 100, "{rows}");
        let replacement = folder.summary(&format!("{command} -n 20 -k 400 --out disk/out --force"));
        assert_eq!(replacement.digest(), expected.digest());
        assert_eq!(SummaryJson::read(&folder.join("disk/out")).digest(), expected.digest());
    }
    // Without space for the first files, the run leaves nothing that blocks the next run.
    fs::remove_dir_all(folder.join("disk/out")).expect("removable");
    // More than the 256 kB of the disk.
    let written = fs::write(folder.join("disk/ballast"), vec![0; 300 * 1024]);
    assert!(written.is_err(), "the disk has more space than requested");
    let finished = folder.run("run -n 20 -k 400 --out disk/out");
    assert_refused_without_run(&folder, &finished, &["disk/out", "No space left on device"]);
    fs::remove_file(folder.join("disk/ballast")).expect("removable");
    let next_run = folder.summary("run -n 20 -k 400 --out disk/out");
    assert_eq!(next_run.digest(), expected.digest());
}
