//! Invalid input: one paragraph with the fault, the place and the allowed values, a failing exit code, and no run
//! folder unless the run had begun. Also unusual input that is valid. `limits`, `misbehaving_policy` and `hostile_peer`
//! test other faults. The texts are parts of messages, which the crates word.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::process::Stdio;

use reveille_tests::process::{Process, SummaryJson, TestFolder, assert_refused, free_endpoint, unique_run};
use rustix::process::Signal;

/// Checks that the folder contains only the test's own `files`, apart from the runtime folder in which commands
/// register their runs.
fn assert_untouched(folder: &TestFolder, files: &[&str]) {
    let found: Vec<String> = folder.list(".").into_iter().filter(|name| name != "runtime").collect();
    assert_eq!(found, files, "files in the folder");
}

/// Checks that every command that executes one run refuses the scenario that `options` select, with all of `parts` in
/// the message, and leaves only `files`.
fn assert_scenario_refused(folder: &TestFolder, options: &str, files: &[&str], parts: &[&str]) {
    for command in ["run", "up", "up -P 0 --out out", "bs --run x --listen tcp/127.0.0.1:0"] {
        assert_refused(&folder.run(&format!("{command} {options}")), 1, parts);
        assert_untouched(folder, files);
    }
}

#[test]
fn an_unknown_field_is_named_with_its_line() {
    let folder = TestFolder::new();
    folder.write("my.toml", "devices = 30\n[sensing]\ndmax = 5\n");
    let parts = ["sensing.dmax", "my.toml, line 3", "did you mean `sensing.d_max`"];
    assert_scenario_refused(&folder, "--scenario my.toml", &["my.toml"], &parts);
}

#[test]
fn a_file_that_is_not_toml_is_named_with_its_line() {
    let folder = TestFolder::new();
    folder.write("my.toml", "devices = 30\n\n[sensing\n");
    assert_scenario_refused(&folder, "--scenario my.toml", &["my.toml"], &["my.toml, line 3"]);
}

#[test]
fn a_negative_energy_is_refused() {
    let folder = TestFolder::new();
    folder.write("my.toml", "[energy]\ne_tx = -1.0\n");
    assert_scenario_refused(
        &folder,
        "-s my.toml",
        &["my.toml"],
        &["energy.e_tx = -1", "at least 0", "my.toml, line 2"],
    );
    assert_scenario_refused(
        &folder,
        "--set energy.e_idle=-2",
        &["my.toml"],
        &["energy.e_idle = -2", "--set energy.e_idle=-2"],
    );
}

#[test]
fn a_negative_number_is_refused_with_the_allowed_range() {
    let folder = TestFolder::new();
    assert_scenario_refused(
        &folder,
        "--devices -5",
        &[],
        &["devices = -5", "not negative", "--devices"],
    );
    assert_scenario_refused(&folder, "-k -7", &[], &["ttis = -7", "not negative", "--ttis"]);
    assert_scenario_refused(&folder, "--seed -1", &[], &["seed = -1", "not negative", "--seed"]);
}

#[test]
fn zero_devices_are_refused() {
    assert_scenario_refused(
        &TestFolder::new(),
        "-n 0",
        &[],
        &["devices = 0", "at least 1", "--devices"],
    );
}

#[test]
fn a_d_max_beyond_the_area_is_refused() {
    assert_scenario_refused(
        &TestFolder::new(),
        "--set sensing.d_max=1000",
        &[],
        &["sensing.d_max = 1000", "at most", "--set sensing.d_max=1000"],
    );
}

#[test]
fn a_missing_trace_file_is_named() {
    let folder = TestFolder::new();
    folder.write(
        "my.toml",
        "[harvest]\nkind = \"trace\"\n[harvest.trace]\nfile = \"sun.csv\"\ncolumn = \"w\"\n",
    );
    assert_scenario_refused(
        &folder,
        "-s my.toml",
        &["my.toml"],
        &["harvest.trace.file", "sun.csv", "no such file", "my.toml, line 4"],
    );
}

#[test]
fn an_invalid_row_of_a_trace_is_named() {
    let folder = TestFolder::new();
    folder.write(
        "my.toml",
        "[harvest]\nkind = \"trace\"\n[harvest.trace]\nfile = \"sun.csv\"\ncolumn = \"w\"\n",
    );
    for (rows, reason) in [
        ("1.5\ndark\n", "line 3"),
        ("1.5\n2.5,7\n", "line 3"),
        ("1\n2\n-3\n", "line 4"),
        ("", "no rows"),
    ] {
        folder.write("sun.csv", &format!("w\n{rows}"));
        assert_scenario_refused(
            &folder,
            "-s my.toml",
            &["my.toml", "sun.csv"],
            &["harvest.trace.file", "sun.csv", reason, "my.toml, line 4"],
        );
    }
}

#[test]
fn an_unknown_scenario_or_policy_lists_the_available_ones() {
    assert_scenario_refused(
        &TestFolder::new(),
        "-s papr",
        &[],
        &["papr", "did you mean `paper`", "quick"],
    );
    assert_scenario_refused(
        &TestFolder::new(),
        "-p nearest",
        &[],
        &["nearest", "knn", "genie", "--policy"],
    );
}

#[test]
fn invalid_overrides_are_refused() {
    assert_scenario_refused(
        &TestFolder::new(),
        "--set nonsense",
        &[],
        &["--set nonsense", "path.to.field=value"],
    );
    assert_scenario_refused(
        &TestFolder::new(),
        "--set nonsense=1",
        &[],
        &["unknown field `nonsense`", "devices"],
    );
    assert_scenario_refused(
        &TestFolder::new(),
        "--set devices=many",
        &[],
        &["devices", "many", "--set devices=many"],
    );
}

#[test]
fn too_many_processes_are_refused() {
    let folder = TestFolder::new();
    assert_refused(
        &folder.run("up -n 10 -P 11"),
        1,
        &["--processes 11", "0 to 10", "number of devices"],
    );
    assert_untouched(&folder, &[]);
}

#[test]
fn a_usage_error_has_exit_code_2() {
    let folder = TestFolder::new();
    for (args, part) in [
        ("up --pace soon", "--pace"),
        ("up --pace 0ms", "--pace"),
        ("up --pace -1ms", "a time from 1us"),
        ("up --run a/b", "--run"),
        ("up --run=-x", "must not begin with '-'"),
        ("up --window 0", "--window"),
        ("up --processes many", "must be a whole number from 0 to 4294967295"),
        ("up -P -1", "must be a whole number from 0 to 4294967295"),
        ("up --force", "--out"),
        ("device --connect tcp/127.0.0.1:1", "--run"),
        ("device --connect tcp/127.0.0.1:1 --run x --count 0", "--count"),
        ("inspect tail --kind gossip", "--kind"),
        (
            "inspect tail --since 10 --until 5",
            "--since 10 is larger than --until 5",
        ),
        (
            "inspect stats --since 10 --until 5",
            "--since 10 is larger than --until 5",
        ),
        (
            "inspect export run.mcap --to csv --since 1 --until 0",
            "--since 1 is larger than --until 0",
        ),
        ("tune --mu1 20,0.5", "20 is larger than 0.5"),
        (
            "run --pace 10ms",
            "`--pace` is an option of `up` and `bs`; `run` runs without a clock",
        ),
        (
            "bs --run x --processes 3",
            "`--processes` is an option of `up`; `bs` waits for processes",
        ),
        (
            "figures sweep a --x devices --y info",
            "a similar value exists: 'info_p1'",
        ),
        ("figures a --only energi", "a similar value exists: 'energy'"),
        (
            "sweep --until-ci 1% --ci-metrics info_p",
            "a similar value exists: 'info_p1'",
        ),
        ("clock backwards", "backwards"),
        ("nonsense", "nonsense"),
    ] {
        assert_refused(&folder.run(args), 2, &[part]);
    }
    assert_untouched(&folder, &[]);
}

#[test]
fn a_port_in_use_is_reported() {
    let folder = TestFolder::new();
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let endpoint = format!("tcp/{}", taken.local_addr().expect("bound"));
    for command in ["up", "up --out out", "bs --run x"] {
        let finished = folder.run(&format!("{command} -n 30 --listen {endpoint}"));
        assert_refused(&finished, 1, &["cannot listen on", &endpoint, "in use", "--listen"]);
        assert!(
            folder.list("runs").is_empty() && !folder.join("out").exists(),
            "{finished}"
        );
    }
}

#[test]
fn a_port_in_use_of_a_watcher_has_alternatives() {
    let folder = TestFolder::new();
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("bound");
    for (command, option) in [
        ("run", "--metrics"),
        ("up", "--metrics"),
        ("up", "--dashboard"),
        ("dashboard", "--listen"),
    ] {
        let cause = format!("{option} {address}: the port is in use; choose another port");
        let free = format!("{option} 127.0.0.1:0");
        assert_refused(
            &folder.run(&format!("{command} {option} {address}")),
            1,
            &[&cause, &free],
        );
    }
    assert_untouched(&folder, &[]);
}

#[test]
fn an_invalid_endpoint_is_refused() {
    let folder = TestFolder::new();
    for endpoint in [
        "127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "udp/127.0.0.1:7447",
        "tcp/127.0.0.1:99999",
        "tcp/nowhere.invalid:7447",
    ] {
        for command in ["up -n 30", "bs -n 30 --run x"] {
            let finished = folder.run(&format!("{command} --listen {endpoint}"));
            assert_refused(&finished, 1, &[endpoint]);
            assert!(folder.list("runs").is_empty(), "{endpoint}: {finished}");
        }
    }
    for endpoint in ["127.0.0.1:7447", "tcp/", "tcp/127.0.0.1"] {
        let finished = folder.run(&format!("device --connect {endpoint} --run x --connect-timeout 2s"));
        assert_refused(&finished, 1, &[endpoint, "tcp/HOST:PORT"]);
    }
}

#[test]
fn an_endpoint_without_a_listener_is_reported() {
    let (folder, endpoint) = (TestFolder::new(), free_endpoint());
    let finished = folder.run(&format!("device --connect {endpoint} --run x --connect-timeout 2s"));
    assert_refused(&finished, 1, &["no base station answers at", &endpoint, "within 2s"]);
}

#[test]
fn a_wrong_run_name_lists_the_runs() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("right"), free_endpoint());
    let _bs = folder.start_waiting_bs(&run, &endpoint, "");
    let hint = format!("runs there: {run}");
    let finished = folder.run(&format!("device --connect {endpoint} --run wrong --connect-timeout 2s"));
    assert_refused(&finished, 1, &["run wrong", &endpoint, &hint]);
    let finished = folder.run(&format!("inspect tail --connect {endpoint} --run wrong"));
    assert_refused(&finished, 1, &["run wrong", &endpoint, &hint]);
    let finished = folder.run(&format!("clock --connect {endpoint} --run wrong status"));
    assert_refused(&finished, 1, &["run wrong", &endpoint, &hint]);
    let finished = folder.run("clock --run wrong status");
    assert_refused(&finished, 1, &["no run wrong on this machine"]);
}

#[test]
fn inspecting_without_a_run_is_an_error() {
    let folder = TestFolder::new();
    for command in ["inspect tail", "clock status"] {
        assert_refused(&folder.run(command), 1, &["no run on this machine", "reveille up"]);
    }
}

#[test]
fn two_runs_on_this_machine_need_a_name() {
    let (folder, runs) = (TestFolder::new(), [unique_run("one"), unique_run("two")]);
    let _bs = runs
        .each_ref()
        .map(|run| folder.start_waiting_bs(run, &free_endpoint(), ""));
    for run in &runs {
        folder.wait_for_clock(run);
    }
    assert_refused(&folder.run("clock status"), 1, &["2 runs", "--run", &runs[0], &runs[1]]);
}

#[test]
fn too_few_joined_devices_end_the_run() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("few"), free_endpoint());
    let bs = folder.start_waiting_bs(&run, &endpoint, "--join-timeout 1s --out out");
    let finished = bs.finish();
    assert_eq!(finished.code(), Some(1), "{finished}");
    assert!(
        // `start_waiting_bs` starts a run of 30 devices.
        finished.stderr.contains("only 0 of 30 devices joined within 1 s"),
        "{finished}"
    );
    assert!(folder.list("out").contains(&"FAILED".to_owned()));
    assert!(!folder.list("out").contains(&"RUNNING".to_owned()));
}

#[test]
fn a_surplus_device_is_refused_under_on_loss_end() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("full"), free_endpoint());
    let _bs = folder.start_waiting_bs(&run, &endpoint, "--paused --on-loss end");
    let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count 30"));
    host.wait_for_stderr("joined");
    let finished = folder.run(&format!("device --connect {endpoint} --run {run}"));
    assert_refused(&finished, 1, &["refused"]);
}

#[test]
fn a_folder_that_holds_no_run_is_never_replaced() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join("mine")).expect("writable");
    folder.write("mine/thesis.tex", "precious");
    let finished = folder.run("run -s quick --out mine");
    assert_refused(&finished, 1, &["--out mine", "not empty", "holds no run"]);
    let finished = folder.run("run -s quick --out mine --force");
    assert_refused(&finished, 1, &["--out mine", "not empty", "holds no run"]);
    assert_eq!(folder.list("mine"), ["thesis.tex"]);
    assert!(folder.run("run -s quick --out run").is_success());
    let finished = folder.run("up -s quick --out run");
    assert_refused(&finished, 1, &["--out run", "not empty", "--force"]);
    assert_eq!(
        SummaryJson::read(&folder.join("run")).status(),
        "complete",
        "the run there is as it was"
    );
    assert!(folder.run("up -s quick --out run --force --seed 3").is_success());
    assert_eq!(SummaryJson::read(&folder.join("run")).number("seed"), 3);
}

#[test]
fn an_unusable_run_folder_is_named() {
    let folder = TestFolder::new();
    folder.write("file", "");
    for command in [
        "run -s quick",
        "run -s quick --force",
        "up -s quick",
        "sweep --seeds 1 -k 100",
    ] {
        let finished = folder.run(&format!("{command} --out file"));
        assert_refused(&finished, 1, &["--out file: is a file, not a folder; name a folder"]);
    }
    let finished = folder.run("up -s quick --out file/below");
    assert_refused(&finished, 1, &["file/below"]);
    // Root can write everywhere except in a place like this one.
    let finished = folder.run("bs -s quick --run x --listen tcp/127.0.0.1:0 --out /proc/reveille/run");
    assert_refused(&finished, 1, &["/proc/reveille/run"]);
    fs::create_dir(folder.join("closed")).expect("writable");
    fs::set_permissions(folder.join("closed"), fs::Permissions::from_mode(0o555)).expect("ours");
    if fs::write(folder.join("closed/probe"), "").is_err() {
        let finished = folder.run("up -s quick --out closed/run");
        assert_refused(&finished, 1, &["closed/run", "denied"]);
    }
    assert_eq!(fs::read_to_string(folder.join("file")).expect("there"), "");
}

#[test]
fn missing_parent_folders_are_created() {
    let folder = TestFolder::new();
    assert!(folder.run("run -s quick --out a/b/c").is_success());
    assert_eq!(SummaryJson::read(&folder.join("a/b/c")).status(), "complete");
}

#[test]
fn a_device_process_that_tries_to_connect_can_be_interrupted() {
    let folder = TestFolder::new();
    for signal in [Signal::INT, Signal::TERM] {
        let device = folder.start(&format!(
            "device --connect {} --run x --connect-timeout 10min",
            free_endpoint()
        ));
        device.wait_for_handlers();
        device.signal(signal);
        assert_eq!(device.finish().code(), Some(130));
    }
}

#[test]
fn a_setting_without_effect_is_refused() {
    let folder = TestFolder::new();
    for (setting, needed_setting) in [
        ("harvest.off_mean=3", "harvest.kind = \"mpp\""),
        ("harvest.trace.file=\"sun.csv\"", "harvest.kind = \"trace\""),
        ("layout.file=\"spots.csv\"", "layout.kind = \"file\""),
    ] {
        let field = setting.split('=').next().expect("a field");
        let finished = folder.run(&format!("run --set {setting} --quiet"));
        assert_refused(&finished, 1, &[field, needed_setting, "--set"]);
    }
}

#[test]
fn run_to_refuses_ttis_in_the_past_or_beyond_the_end() {
    let (folder, run) = (TestFolder::new(), unique_run("past"));
    let _up = folder.start(&format!("up -P 1 -n 3 -k 100 --run {run} --paused --out out"));
    folder.wait_for_tti(&run, 0);
    folder.clock(&run, "step 20");
    folder.wait_for_tti(&run, 20);
    for k in [19, 101] {
        let finished = folder.run(&format!("clock --run {run} run-to {k}"));
        assert_refused(&finished, 1, &[&format!("run-to {k}: must be from 20,"), "to 100,"]);
    }
    assert_refused(
        &folder.run(&format!("clock --run {run} step 0")),
        2,
        &["a whole number from 1 to"],
    );
    folder.clock(&run, "resume");
}

#[test]
fn an_invalid_input_log_is_refused() {
    let folder = TestFolder::new();
    // Version 2 of the log, which must still be read (`lab/src/external_inputs/`).
    for (content, reason) in [
        ("garbage", "line 1, column 1: invalid input log entry"),
        ("garbage\n", "line 1, column 1: invalid input log entry"),
        (
            "{\"inputs\":{\"version\":2}}",
            "line 1, column 23: invalid input log entry",
        ),
        // The start of a first line, as a kill can leave it.
        ("{\"inputs\":{\"version\":2", "the input log holds no inputs"),
        (
            "{\"inputs\":{\"version\":2,\"scenario_hash\":\"00\"}}",
            "another scenario or seed",
        ),
        ("", "the input log holds no inputs"),
    ] {
        folder.write("some.log", content);
        for option in ["--input-log some.log", "--policy replay=some.log"] {
            let finished = folder.run(&format!("run -s quick {option} --out out"));
            assert_refused(&finished, 1, &["some.log", reason]);
            assert_untouched(&folder, &["some.log"]);
        }
    }
}

#[test]
fn an_input_log_with_decisions_names_the_option_that_repeats_them() {
    let folder = TestFolder::new();
    let lines = "{\"inputs\":{\"version\":2,\"scenario_hash\":\"00\"}}\n{\"wake\":{\"tti\":0,\"devices\":[]}}\n";
    folder.write("some.log", lines);
    let finished = folder.run("run -s quick --input-log some.log --out out");
    assert_refused(
        &finished,
        1,
        &[
            "--input-log some.log",
            "holds decisions",
            "--policy replay=some.log",
            "built-in policy",
        ],
    );
    assert_untouched(&folder, &["some.log"]);
}

#[test]
fn a_folder_without_decisions_is_refused_with_the_cause() {
    let folder = TestFolder::new();
    assert!(folder.run("run -s quick -q --out built-in").is_success());
    let finished = folder.run("up -s quick -p external --policy-command false -P 1 --out failed");
    assert_eq!(finished.code(), Some(1), "{finished}");
    fs::create_dir(folder.join("empty")).expect("writable");
    for (path, cause) in [
        ("nowhere", "no such file or folder"),
        ("empty", "the folder holds no run"),
        ("built-in", "the folder holds no inputs.log"),
        (
            "failed",
            "the folder holds no inputs.log: the run failed (the policy process `false` ended with",
        ),
    ] {
        let finished = folder.run(&format!("run --policy replay={path} --out out"));
        let cause = format!("reveille: --policy replay={path}: {cause}");
        assert_refused(
            &finished,
            1,
            &[&cause, "; name the inputs.log of a run with --policy external"],
        );
        assert!(folder.list("out").is_empty(), "{path}");
    }
}

#[test]
fn a_run_folder_can_have_any_name() {
    let folder = TestFolder::new();
    for out in [".hidden", "./-x", "äpfel", "…"] {
        let finished = folder.run(&format!("up -q -n 5 -k 50 -P 1 --out {out}"));
        assert!(finished.is_success(), "{out}: {finished}");
    }
}

#[test]
fn an_unusable_key_file_is_refused() {
    let (folder, run) = (TestFolder::new(), unique_run("key"));
    let bs = format!("bs -n 5 -k 60 --run {run} --listen tcp/127.0.0.1:0 --key-file");
    let finished = folder.run(&format!("{bs} missing/key"));
    assert_refused(&finished, 1, &["--key-file missing/key", "folder does not exist"]);
    folder.write("key", "0123");
    fs::set_permissions(folder.join("key"), fs::Permissions::from_mode(0o644)).expect("ours");
    let finished = folder.run(&format!("{bs} key"));
    assert_refused(
        &finished,
        1,
        &["--key-file key", "other users may read it", "chmod 600"],
    );
    // A new key is complete, and only its owner may read it.
    let process = folder.start(&format!("{bs} new --out out"));
    process.wait_for_stderr("waiting for 5 devices");
    let mode = fs::metadata(folder.join("new")).expect("a key").permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    assert!(!folder.list(".").iter().any(|name| name.contains("draft")));
    process.signal(Signal::INT);
    process.finish();
}

#[test]
fn an_unregistered_run_continues() {
    let folder = TestFolder::new();
    let mut up = folder.command("up -q -n 5 -k 50 -P 1 --out out");
    let finished = Process::start(up.env("XDG_RUNTIME_DIR", "/proc/1/nope")).finish();
    assert!(finished.is_success(), "{finished}");
    for part in ["/proc/1/nope/reveille", "XDG_RUNTIME_DIR", "clock"] {
        assert!(finished.stderr.contains(part), "no {part:?}: {finished}");
    }
}

#[test]
fn an_unread_message_leaves_the_exit_code() {
    let folder = TestFolder::new();
    folder.write("spots.csv", "x,y\n1,1\n2,2\n");
    for (args, code) in [
        // Prints an error itself.
        ("run -s nosuch", 1),
        // Prints a warning through the log.
        ("run -n 1 -k 9 --set layout.kind=file --set layout.file=spots.csv -q", 0),
    ] {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        drop(reader);
        let status = folder
            .command(args)
            .stdout(Stdio::null())
            .stderr(writer)
            .status()
            .expect("the program starts");
        assert_eq!(status.code(), Some(code), "{args}");
    }
}

#[cfg(not(feature = "tls"))]
#[test]
fn a_build_without_tls_names_the_feature() {
    let folder = TestFolder::new();
    for (line, code) in [
        ("tls init certs", 2),
        ("tls show certs", 2),
        ("device --run x --connect tls/127.0.0.1:1 --tls certs", 2),
        ("bs --run x --listen tls/127.0.0.1:0", 1),
    ] {
        let refused = folder.run(line);
        assert_eq!(refused.code(), Some(code), "{line}: {refused}");
        assert!(refused.stderr.contains("--features tls"), "{line}: {refused}");
    }
    assert_untouched(&folder, &[]);
}
