//! `reveille testbed` with a program in place of the engine. It answers the commands of this file, and prints others.

use std::fs::{self, File, Permissions};
use std::os::unix::fs::PermissionsExt;

use reveille_tests::process::{FinishedProcess, Process, TestFolder, assert_refused};

/// A program that answers as `docker` does. The file `status` has the status of the base station, and the file `limit`
/// the processor limit of a device container.
const ENGINE: &str = r#"#!/bin/sh
case "$*" in
  "compose version" | "version "*) echo 29 ;;
  *" down "*) rm status ;;
  *" up --detach bs") printf 'dependency failed to start: container bs is unhealthy\n' >&2; exit 1 ;;
  "run --rm "*) echo "reveille $(cat version)" ;;
  "cp b5:"*) cp -r run "$3" ;;
  "logs --tail "*) echo "reveille: field run.ttis: too long" >&2 ;;
  "ps "*--quiet*) [ ! -e status ] || echo b5 ;;
  "ps "*Networks*) printf 'b5\tbs\t%s\tnet\nd1\tdevice-1\tUp 5 seconds\tnet\n' "$(cat status)" ;;
  "ps "* | "network "* | "volume "*) ;;
  "inspect --format {{.HostConfig.NanoCpus}} b5 d1") printf '0\n%s\n' "$(cat limit)" ;;
  "exec b5 reveille clock status") echo "running at TTI 1 of 400" ;;
  "stats "* | "port "* | "logs "*) ;;
  *) echo "$*" ;;
esac
"#;

/// A folder with a testbed `my` of one container, and the engine.
struct Fixture(TestFolder);

impl Fixture {
    /// Makes the testbed with these options of `testbed init`.
    fn new(options: &str) -> Self {
        let folder = TestFolder::new();
        folder.write("docker", ENGINE);
        fs::set_permissions(folder.join("docker"), Permissions::from_mode(0o755)).expect("ours");
        folder.write("status", "Up 5 seconds");
        folder.write("limit", "0");
        let init = folder.run(&format!("testbed init -n 5 -k 400 --containers 1 --out my {options}"));
        assert!(init.is_success(), "{init}");
        Self(folder)
    }

    /// Runs `reveille testbed ARGS`.
    fn run(&self, args: &str) -> FinishedProcess {
        let path = std::env::var("PATH").expect("set");
        let path = format!("{}:{path}", self.0.path().display());
        let mut command = self.0.command(&format!("testbed {args}"));
        Process::start(command.env("PATH", path)).finish()
    }
}

#[test]
fn logs_in_a_pipe_have_no_colours() {
    let logs = Fixture::new("").run("logs my bs --follow");
    assert!(logs.stdout.ends_with("logs --no-color --follow bs\n"), "{logs}");
}

#[test]
fn a_container_at_its_declared_limit_is_not_slow() {
    for (options, limit, is_slow) in [
        ("--cpus 0.05", "50000000", false),
        ("--cpus 0.5", "50000000", true),
        ("", "50000000", true),
        ("", "0", false),
    ] {
        let fixture = Fixture::new(options);
        fixture.0.write("limit", limit);
        let status = fixture.run("status my");
        assert!(status.is_success(), "{status}");
        let line = status.stdout.lines().find(|line| line.contains("device-1"));
        let line = line.expect("a line of the container");
        assert_eq!(line.contains(", slow"), is_slow, "{options} {limit}: {line}");
    }
}

#[test]
fn the_clock_of_an_ended_testbed_is_refused_with_the_fix() {
    let fixture = Fixture::new("");
    assert!(fixture.run("clock my status").stdout.contains("TTI 1 of 400"));
    fixture.0.write("status", "Exited (0) 3 seconds ago");
    let refused = fixture.run("clock my pause");
    assert_refused(&refused, 1, &["bs: the run is over", "reveille testbed results my"]);
    fixture.0.write("status", "Exited (130) 3 seconds ago");
    let refused = fixture.run("clock my pause");
    assert_refused(
        &refused,
        1,
        &["bs: the container does not run", "reveille testbed up my"],
    );
}

#[test]
fn a_testbed_is_not_removed_under_a_running_up() {
    let fixture = Fixture::new("");
    // `testbed up` locks its folder in this way.
    let up = File::open(fixture.0.join("my")).expect("there");
    up.lock().expect("free");
    let refused = fixture.run("down my");
    assert_refused(
        &refused,
        1,
        &["another `reveille testbed up`", "end it with Ctrl-C", "down my"],
    );
    drop(up);
    let down = fixture.run("down my");
    assert!(down.stderr.contains("removed the containers"), "{down}");
    let again = fixture.run("down my");
    assert!(
        again.is_success() && again.stderr.contains("my: nothing to remove"),
        "{again}"
    );
}

#[test]
fn a_copy_of_an_unfinished_run_is_reported() {
    let fixture = Fixture::new("");
    assert!(fixture.0.run("run -s my/scenario.toml --out run").is_success());
    let complete = fixture.run("results my");
    assert!(
        complete.stdout == "results in my/results\n" && complete.stderr.is_empty(),
        "{complete}"
    );
    fs::remove_file(fixture.0.join("run/summary.json")).expect("there");
    let partial = fixture.run("results my");
    assert!(
        partial.is_success() && partial.stderr.contains("the run is not complete"),
        "{partial}"
    );
}

#[test]
fn a_failed_start_shows_the_log_of_the_failed_container() {
    let fixture = Fixture::new("");
    fixture.0.write("version", env!("CARGO_PKG_VERSION"));
    fixture.0.write("status", "Restarting (2) 1 second ago");
    let failed = fixture.run("up my");
    let expected = "reveille: docker up: dependency failed to start: container bs is unhealthy\n\
                    bs: Restarting (2) 1 second ago; its last log lines:\n\
                    reveille: field run.ttis: too long\n";
    assert_eq!((failed.code(), failed.stderr.as_str()), (Some(1), expected), "{failed}");
}
