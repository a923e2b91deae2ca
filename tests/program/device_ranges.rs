//! `device --range`: processes that run exactly these devices, also after a restart, and the refusal of other ranges.
//! `testbed init`, whose files need no engine, and signals to `testbed up`.

use std::os::unix::fs::PermissionsExt;

use reveille_tests::process::{PATIENCE, Process, SummaryJson, TestFolder, free_endpoint, unique_run, wait_until};
use rustix::process::Signal;

#[test]
fn a_killed_process_gets_its_own_devices_back() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("range"), free_endpoint());
    let scenario = "-n 30 -k 1500";
    let expected = folder.summary(&format!("run {scenario}"));
    let bs = folder.start(&format!(
        "bs {scenario} --pace 4ms --out out --run {run} --listen {endpoint}"
    ));
    bs.wait_for_stderr("waiting for 30 devices");
    let start = |range: &str| folder.start(&format!("device --connect {endpoint} --run {run} --range {range}"));
    let killed = start("0-4,10-19");
    for devices in ["devices 0 to 4", "devices 10 to 19"] {
        killed.wait_for_stderr(devices);
    }
    let assert_refused = |range: &str, cause: String| {
        let refused = start(range).finish();
        assert!(
            refused.code() == Some(1) && refused.stderr.contains(&cause),
            "{range}: {refused}"
        );
    };
    assert_refused(
        "20-30",
        "devices 20 to 30: the run has 30 devices, from 0 to 29; correct --range".to_owned(),
    );
    let pid = killed.pid();
    assert_refused(
        "18-22",
        format!("devices 18 to 22: the process with pid {pid} has devices 10 to 19; give each process other devices"),
    );
    let other = start("5-9,20-29");
    folder.wait_for_tti(&run, 20);
    killed.signal(Signal::KILL);
    bs.wait_for_stderr("lost");
    // The other process has the capacity, but takes over no device outside its own ranges.
    let restarted = start("0-4,10-19");
    for devices in ["devices 0 to 4", "devices 10 to 19"] {
        restarted.wait_for_stderr(devices);
    }
    let pids = [restarted.pid(), other.pid(), restarted.pid(), other.pid()];
    let ranges = ["0 to 4", "5 to 9", "10 to 19", "20 to 29"];
    wait_until("the takeover of both ranges", PATIENCE, || {
        let status = folder.clock(&run, "status --hosts");
        let lines: Vec<&str> = status.lines().skip(1).collect();
        let is_own = |((line, range), pid): ((&&str, &&str), &u32)| {
            line.ends_with(&format!("(devices {range}, the process with pid {pid})"))
        };
        (lines.len() == 4 && lines.iter().zip(&ranges).zip(&pids).all(is_own)).then_some(())
    });
    assert_refused("0-9", "devices 0 to 9: the process with pid ".to_owned());
    let spare = start("5-9");
    spare.wait_for_stderr("another process has devices of --range");
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    let counts = ["losses", "hosts"].map(|name| summary.number(&format!("timing.{name}")));
    assert_eq!(counts, [1, 2], "the loss of one of two processes: {finished}");
    for process in [other, restarted, spare] {
        let finished = process.finish();
        assert!(finished.is_success(), "{finished}");
    }
}

#[test]
fn a_testbed_has_the_scenario_with_its_files() {
    let folder = TestFolder::new();
    folder.write("barn.csv", "x,y\n4,4\n12,3\n20,4\n27,5\n8,10\n16,11\n24,11\n");
    folder.write("light.csv", "roof\n0\n0.4\n1.2\n0.8\n");
    let scenario = "preset = \"paper\"\ndevices = 7\nttis = 700\n[area]\nwidth = 30.0\nheight = 14.0\n\
        [layout]\nkind = \"file\"\nfile = \"barn.csv\"\n\
        [harvest]\nkind = \"trace\"\n[harvest.trace]\nfile = \"light.csv\"\ncolumn = \"roof\"\nttis_per_row = 90\n";
    folder.write("barn.toml", scenario);
    folder.write(
        "faults.txt",
        "# two faults\n100 kill device-1\n\n200 pause device-2 for 2s\n",
    );
    let options = "-p age-index --set events.alpha=0.1 --seed 5";
    let init = format!("testbed init -s barn.toml {options} --containers 2 --faults faults.txt --out Demo_1");
    let written = folder.run(&init);
    assert!(written.is_success(), "{written}");
    let names = [".", "scenario-files"].map(|name| folder.list(&format!("Demo_1/{name}")));
    assert_eq!(
        names[0],
        ["compose.yml", "scenario-files", "scenario.toml", "testbed.toml"]
    );
    assert_eq!(names[1], ["barn.csv", "light.csv"]);
    let compose = String::from_utf8(folder.bytes("Demo_1/compose.yml")).expect("text");
    for line in [
        "--range=0-3\n",
        "--range=4-6\n",
        "--run=demo_1\n",
        "image: reveille:local\n",
    ] {
        assert!(compose.contains(line), "{line}: {compose}");
    }
    let testbed = String::from_utf8(folder.bytes("Demo_1/testbed.toml")).expect("text");
    assert!(
        testbed.contains("    \"100 kill device-1\",\n    \"200 pause device-2 for 2s\",\n"),
        "{testbed}"
    );
    // The copies give the same run without the originals.
    let expected = folder.summary(&format!("run -s barn.toml {options}"));
    for name in ["barn.csv", "light.csv"] {
        std::fs::remove_file(folder.join(name)).expect("the file exists");
    }
    assert_eq!(
        folder.summary("run -s Demo_1/scenario.toml").digest(),
        expected.digest()
    );
    let repeated = folder.run("testbed init --out Demo_1");
    assert!(
        repeated.stderr.contains("testbed.toml: file exists; edit it"),
        "{repeated}"
    );
    let missing = folder.run("testbed up nowhere");
    assert!(
        missing.code() == Some(1) && missing.stderr.contains("`reveille testbed init` writes"),
        "{missing}"
    );
    let detached = folder.run("testbed up Demo_1 --detach");
    assert!(detached.stderr.contains("leave out --detach"), "{detached}");
}

#[test]
fn a_machine_without_docker_is_told_how_to_install_it() {
    let folder = TestFolder::new();
    assert!(folder.run("testbed init -n 10 --out demo").is_success());
    // An empty folder in place of all programs.
    let mut command = folder.command("testbed status demo");
    command.env("PATH", folder.join("runtime"));
    let refused = Process::start(&mut command).finish();
    assert!(refused.code() == Some(1), "{refused}");
    assert!(
        refused.stderr.contains("docker: command not found; install Docker"),
        "{refused}"
    );
}

#[test]
fn a_second_signal_ends_a_testbed_immediately() {
    let folder = TestFolder::new();
    assert!(folder.run("testbed init -n 10 --out demo").is_success());
    // An engine without containers, whose `compose up` takes long.
    std::fs::create_dir(folder.join("bin")).expect("a writable folder");
    let version = format!("reveille {}", env!("CARGO_PKG_VERSION"));
    let script = format!(
        "#!/bin/sh\ncase \"$*\" in \"run \"*) echo {version} ;; *\" up \"*) echo >starting; exec sleep 20 ;; esac\n"
    );
    let docker = folder.write("bin/docker", &script);
    std::fs::set_permissions(docker, std::fs::Permissions::from_mode(0o755)).expect("the file exists");
    let path = std::env::var("PATH").unwrap_or_default();
    let mut command = folder.command("testbed up demo");
    command.env("PATH", format!("{}:{path}", folder.join("bin").display()));
    let up = Process::start(&mut command);
    wait_until("the start of containers", PATIENCE, || {
        folder.join("starting").exists().then_some(())
    });
    up.signal(Signal::INT);
    up.wait_for_stderr("interrupted; stopping the containers");
    up.signal(Signal::INT);
    let ended = up.finish();
    assert!(ended.code() == Some(130), "{ended}");
    assert!(ended.stderr.contains("ended; containers may still run"), "{ended}");
}
