//! What users and the network get wrong: one paragraph that says what, where and what is allowed, a failing exit code, and
//! no run folder that looks like a run.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, HostId, Tti};
use reveille_common::keys::{Keys, Kind};
use reveille_common::message::{Answer, Clock, Failure, JoinReply, JoinRequest, PlanUpdate, Report, Tick, WakeUp};
use reveille_common::metrics::DeviceTotals;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::units::Energy;
use reveille_tests::process::{
    Finished, Folder, PATIENCE, Process, Summary, ask, free_endpoint, unique_run, wait_until,
};
use rustix::process::Signal;

/// Checks a refusal: its exit code, one paragraph with all of `parts`.
fn assert_refused(end: &Finished, code: i32, parts: &[&str]) {
    assert_eq!(end.code(), Some(code), "{end}");
    for part in parts {
        assert!(end.stderr.contains(part), "no {part:?}: {end}");
    }
    assert!(!end.stderr.contains("panicked"), "{end}");
    let own: Vec<&str> = end
        .stderr
        .lines()
        .filter(|line| line.starts_with("reveille: "))
        .collect();
    if code == 1 {
        assert_eq!(
            (own.len(), end.stderr.trim().lines().count()),
            (1, 1),
            "one paragraph: {end}"
        );
    }
}

/// Nothing in the folder but what the test put there.
fn assert_untouched(folder: &Folder, before: &[&str]) {
    let now: Vec<String> = folder.list(".").into_iter().filter(|name| name != "runtime").collect();
    assert_eq!(now, before);
}

/// Runs `reveille ARGS` for each command that takes a scenario; all refuse it alike and leave nothing.
fn refused(folder: &Folder, scenario: &str, before: &[&str], parts: &[&str]) {
    for command in ["run", "up", "up -P 0 --out out", "bs --run x --listen tcp/127.0.0.1:0"] {
        assert_refused(&folder.run(&format!("{command} {scenario}")), 1, parts);
        assert_untouched(folder, before);
    }
}

#[test]
fn an_unknown_field_is_named_with_its_line() {
    let folder = Folder::new();
    folder.write("my.toml", "devices = 30\n[sensing]\ndmax = 5\n");
    let parts = ["sensing.dmax", "my.toml, line 3", "did you mean `d_max`"];
    refused(&folder, "--scenario my.toml", &["my.toml"], &parts);
}

#[test]
fn a_file_that_is_not_toml_is_named_with_its_line() {
    let folder = Folder::new();
    folder.write("my.toml", "devices = 30\n\n[sensing\n");
    refused(&folder, "--scenario my.toml", &["my.toml"], &["my.toml, line 3"]);
}

#[test]
fn a_negative_energy_is_refused() {
    let folder = Folder::new();
    folder.write("my.toml", "[energy]\ne_tx = -1.0\n");
    refused(
        &folder,
        "-s my.toml",
        &["my.toml"],
        &["energy.e_tx = -1", "at least 0", "my.toml, line 2"],
    );
    refused(
        &folder,
        "--set energy.e_idle=-2",
        &["my.toml"],
        &["energy.e_idle = -2", "--set energy.e_idle=-2"],
    );
}

#[test]
fn no_devices_are_refused() {
    refused(&Folder::new(), "-n 0", &[], &["devices = 0", "at least 1", "--devices"]);
}

#[test]
fn a_reach_beyond_the_area_is_refused() {
    refused(
        &Folder::new(),
        "--set sensing.d_max=1000",
        &[],
        &["sensing.d_max = 1000", "at most", "--set sensing.d_max=1000"],
    );
}

#[test]
fn a_missing_trace_file_is_named() {
    let folder = Folder::new();
    folder.write(
        "my.toml",
        "[harvest]\nkind = \"trace\"\n[harvest.trace]\nfile = \"sun.csv\"\ncolumn = \"w\"\n",
    );
    refused(
        &folder,
        "-s my.toml",
        &["my.toml"],
        &["harvest.trace.file", "sun.csv", "No such file", "my.toml, line 4"],
    );
}

#[test]
fn a_broken_row_of_a_trace_is_named() {
    let folder = Folder::new();
    folder.write(
        "my.toml",
        "[harvest]\nkind = \"trace\"\n[harvest.trace]\nfile = \"sun.csv\"\ncolumn = \"w\"\n",
    );
    for (rows, reason) in [
        ("1.5\ndark\n", "row 2"),
        ("1.5\n2.5,7\n", "row 2"),
        ("1\n2\n-3\n", "row 3"),
        ("", "no rows"),
    ] {
        folder.write("sun.csv", &format!("w\n{rows}"));
        refused(
            &folder,
            "-s my.toml",
            &["my.toml", "sun.csv"],
            &["harvest.trace.file", "sun.csv", reason, "my.toml, line 4"],
        );
    }
}

#[test]
fn an_unknown_scenario_or_policy_is_answered_with_those_there_are() {
    refused(
        &Folder::new(),
        "-s papr",
        &[],
        &["papr", "did you mean `paper`", "quick"],
    );
    refused(
        &Folder::new(),
        "-p nearest",
        &[],
        &["nearest", "knn", "genie", "--policy"],
    );
}

#[test]
fn nonsense_overrides_are_refused() {
    refused(
        &Folder::new(),
        "--set nonsense",
        &[],
        &["--set nonsense", "path.to.field=value"],
    );
    refused(
        &Folder::new(),
        "--set nonsense=1",
        &[],
        &["unknown field `nonsense`", "devices"],
    );
    refused(
        &Folder::new(),
        "--set devices=many",
        &[],
        &["devices", "many", "--set devices=many"],
    );
}

#[test]
fn too_many_processes_are_refused() {
    let folder = Folder::new();
    assert_refused(
        &folder.run("up -n 10 -P 11"),
        1,
        &["--processes 11", "10 devices", "0 to 10"],
    );
    assert_untouched(&folder, &[]);
}

#[test]
fn wrong_usage_is_code_2() {
    let folder = Folder::new();
    for (args, part) in [
        ("up --pace soon", "--pace"),
        ("up --pace 0ms", "--pace"),
        ("up --run a/b", "--run"),
        ("up --window 0", "--window"),
        ("up --force", "--out"),
        ("device --connect tcp/127.0.0.1:1", "--run"),
        ("device --connect tcp/127.0.0.1:1 --run x --count 0", "--count"),
        ("inspect tail --kind gossip", "--kind"),
        ("clock backwards", "backwards"),
        ("nonsense", "nonsense"),
    ] {
        assert_refused(&folder.run(args), 2, &[part]);
    }
    assert_untouched(&folder, &[]);
}

#[test]
fn a_port_in_use_is_said() {
    let folder = Folder::new();
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let endpoint = format!("tcp/{}", taken.local_addr().expect("bound"));
    for command in ["up", "up --out out", "bs --run x"] {
        let end = folder.run(&format!("{command} -n 30 --listen {endpoint}"));
        assert_refused(&end, 1, &["cannot listen on", &endpoint, "in use", "--listen"]);
        assert!(folder.list("runs").is_empty() && folder.list("out").is_empty(), "{end}");
    }
}

#[test]
fn an_endpoint_that_is_none_is_refused() {
    let folder = Folder::new();
    for endpoint in [
        "127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "udp/127.0.0.1:7447",
        "tcp/127.0.0.1:99999",
        "tcp/nowhere.invalid:7447",
    ] {
        for command in ["up -n 30", "bs -n 30 --run x"] {
            let end = folder.run(&format!("{command} --listen {endpoint}"));
            assert_refused(&end, 1, &[endpoint]);
            assert!(folder.list("runs").is_empty(), "{endpoint}: {end}");
        }
    }
    for endpoint in ["127.0.0.1:7447", "tcp/", "tcp/127.0.0.1"] {
        let end = folder.run(&format!("device --connect {endpoint} --run x --patience 2s"));
        assert_refused(&end, 1, &[endpoint, "tcp/HOST:PORT"]);
    }
}

#[test]
fn an_endpoint_where_nobody_listens_is_said() {
    let (folder, endpoint) = (Folder::new(), free_endpoint());
    let end = folder.run(&format!("device --connect {endpoint} --run x --patience 2s"));
    assert_refused(&end, 1, &["no base station answers at", &endpoint, "within 2s"]);
}

/// A base station that waits for thirty devices.
fn waiting_bs(folder: &Folder, run: &str, endpoint: &str, args: &str) -> Process {
    let bs = folder.start(&format!("bs -n 30 -k 400 --run {run} --listen {endpoint} {args}"));
    bs.wait_for_stderr("waiting for 30 devices");
    bs
}

#[test]
fn a_wrong_run_name_is_answered_with_the_runs_there_are() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("right"), free_endpoint());
    let _bs = waiting_bs(&folder, &run, &endpoint, "");
    let hint = format!("Runs there: {run}");
    let end = folder.run(&format!("device --connect {endpoint} --run wrong --patience 2s"));
    assert_refused(&end, 1, &["run wrong", &endpoint, &hint]);
    let end = folder.run(&format!("inspect tail --connect {endpoint} --run wrong"));
    assert_refused(&end, 1, &["run wrong", &endpoint, &hint]);
    let end = folder.run(&format!("clock --connect {endpoint} --run wrong status"));
    assert_refused(&end, 1, &["run wrong", &endpoint, &hint]);
    let end = folder.run("clock --run wrong status");
    assert_refused(&end, 1, &["no run wrong on this machine"]);
}

#[test]
fn inspecting_nothing_is_said() {
    let folder = Folder::new();
    for command in ["inspect tail", "clock status"] {
        assert_refused(&folder.run(command), 1, &["no run on this machine", "reveille up"]);
    }
}

#[test]
fn two_runs_on_this_machine_must_be_told_apart() {
    let (folder, runs) = (Folder::new(), [unique_run("one"), unique_run("two")]);
    let _bs = runs
        .each_ref()
        .map(|run| waiting_bs(&folder, run, &free_endpoint(), ""));
    folder.wait_for_tti(&runs[0], 0);
    folder.wait_for_tti(&runs[1], 0);
    assert_refused(&folder.run("clock status"), 1, &["2 runs", "--run", &runs[0], &runs[1]]);
}

#[test]
fn too_few_devices_end_the_wait() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("few"), free_endpoint());
    let bs = waiting_bs(&folder, &run, &endpoint, "--join-timeout 1s --out out");
    assert_refused_after_hint(&bs.finish(), "only 0 of 30 devices joined within 1 s");
    assert!(folder.list("out").contains(&"FAILED".to_owned()));
    assert!(!folder.list("out").contains(&"RUNNING".to_owned()));
}

fn assert_refused_after_hint(end: &Finished, part: &str) {
    assert_eq!(end.code(), Some(1), "{end}");
    assert!(end.stderr.contains(part), "{end}");
}

#[test]
fn one_device_too_many_is_refused() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("full"), free_endpoint());
    let _bs = waiting_bs(&folder, &run, &endpoint, "--paused");
    let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count 30"));
    host.wait_for_stderr("joined");
    let end = folder.run(&format!("device --connect {endpoint} --run {run}"));
    assert_refused(&end, 1, &["refused", "all 30 devices"]);
}

/// Opens a session of a peer that plays by its own rules.
async fn peer(endpoint: &str, run: &str) -> Bus {
    let run = run.parse().expect("a run name");
    Bus::connect(endpoint, run, PATIENCE)
        .await
        .expect("the base station listens")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn another_version_is_refused_in_words() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("version"), free_endpoint());
    let _bs = waiting_bs(&folder, &run, &endpoint, "");
    let bus = peer(&endpoint, &run).await;
    let request = JoinRequest {
        version: "0.0.9".to_owned(),
        count: 1,
        nonce: 1,
    };
    let reply = ask(&bus, Kind::Join, &request).await.expect("a reply");
    let JoinReply::Refused(why) = reply else {
        panic!("{reply:?}")
    };
    assert!(
        why.contains("0.0.9") && why.contains(env!("CARGO_PKG_VERSION")),
        "{why}"
    );
    let reply: Result<JoinReply, _> = ask(&bus, Kind::Join, &"not a request at all, but a text").await;
    let why = reply.expect_err("refused").to_string();
    assert!(why.contains("malformed") || why.contains("bytes follow"), "{why}");
    bus.close().await;
}

/// Payloads that are no message of any kind: nothing, another wire version, too little, too much, endless lengths, noise.
fn garbage() -> Vec<Vec<u8>> {
    let noise: Vec<u8> = (0..4096_u32)
        .map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8)
        .collect();
    vec![
        vec![],
        vec![0],
        vec![2, 0, 0],
        vec![255; 64],
        vec![1],
        vec![1, 255, 255, 255, 255],
        [&[1, 0, 0, 253][..], &[255; 8]].concat(),
        [&[1][..], &[0; 200]].concat(),
        [&[1][..], &noise].concat(),
        vec![1; 1 << 16],
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn garbage_on_every_key_changes_nothing() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("garbage"), free_endpoint());
    let expected = folder.summary("run -n 30 -k 1200");
    let args = format!("up -P 4 -n 30 -k 1200 --pace 5ms --paused --run {run} --listen {endpoint} --out out");
    let up = folder.start(&args);
    folder.wait_for_tti(&run, 0);
    let tail = folder.start(&format!("inspect tail --run {run}"));
    let bus = peer(&endpoint, &run).await;
    let keys = bus.keys();
    let mut all: Vec<String> = Kind::ALL.iter().map(|&kind| keys.of(kind)).collect();
    all.extend([0, 7, 29, 30, u32::MAX].into_iter().flat_map(|j| {
        let answer = format!("{}/{j}", keys.of(Kind::Answer));
        [keys.wake(DeviceId(j)), keys.report(DeviceId(j)), answer]
    }));
    all.extend([format!("{}/x", keys.of(Kind::Answer)), keys.tap()]);
    folder.clock(&run, "resume");
    for payload in garbage() {
        for key in &all {
            bus.put_raw(key, payload.clone()).expect("sent");
        }
        for kind in [Kind::Join, Kind::Ready, Kind::Control] {
            let reply = bus
                .ask::<_, bool>(keys.of(kind), &(&payload, "and more"), Duration::from_secs(5))
                .await;
            assert!(reply.is_err(), "{kind:?}");
        }
    }
    bus.close().await;
    let end = up.finish();
    assert!(end.is_success(), "{end}");
    assert!(!end.stderr.contains("panicked"), "{end}");
    let summary = Summary::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    assert!(summary.number("timing.malformed") > 0, "{summary:?}");
    let tail = tail.finish();
    assert!(tail.is_success() && !tail.stderr.contains("panicked"), "{tail}");
}

/// Messages that decode well and cannot be true, each with its key.
fn forgeries(keys: &Keys, tti: u64) -> Vec<(String, Vec<u8>)> {
    let tick = |first, last| {
        let stimulus = Some(Stimulus {
            event: EventId(1),
            epicentre: Point::new(5.0, 5.0),
        });
        let (first, last, plan) = (Tti(first), Tti(last), Tti(0));
        Clock::Grant(Tick {
            first,
            last,
            stimulus,
            account: true,
            plan,
        })
    };
    let clock = [
        tick(0, 0),
        tick(u64::MAX / 2, u64::MAX),
        tick(tti, 5),
        Clock::Finish(Tti(3)),
        Clock::Finish(Tti(u64::MAX)),
    ];
    let endless = DutyCycle {
        t_on: u32::MAX,
        t_drx: u32::MAX,
        offset: 0,
    };
    let plan = PlanUpdate {
        from: Tti(0),
        plan: Plan::Periodic(vec![endless; 30]),
    };
    let report = |device, information| Report {
        device: DeviceId(device),
        tti: Tti(tti),
        information,
        battery: Energy::ZERO,
    };
    let done = |host, reports, drained| Answer::Done {
        host: HostId(host),
        tti: Tti(tti),
        reports,
        failures: vec![Failure {
            device: DeviceId(0),
            drained: Energy::from_micro(drained),
        }],
        totals: Some(DeviceTotals::default()),
    };
    let ledgers = vec![(DeviceId(0), DeviceTotals::default())];
    let last = Answer::Final {
        host: HostId(0),
        ledgers,
    };
    let mut all: Vec<(String, Vec<u8>)> = clock.iter().map(|c| (keys.of(Kind::Clock), codec::encode(c))).collect();
    all.push((keys.of(Kind::Plan), codec::encode(&plan)));
    all.push((keys.wake(DeviceId(0)), codec::encode(&WakeUp { tti: Tti(u64::MAX) })));
    for (key, report) in [
        (9999, report(9999, 0.5)),
        (3, report(4, 0.5)),
        (3, report(3, f64::NAN)),
        (3, report(3, 7.0)),
    ] {
        all.push((keys.report(DeviceId(key)), codec::encode(&report)));
    }
    for (key, answer) in [
        (0, done(0, 1000, 1)),
        (0, done(1, 0, 1)),
        (9, done(9, 0, 1)),
        (0, done(0, 0, u64::MAX)),
        (0, last),
    ] {
        all.push((keys.answer(HostId(key)), codec::encode(&answer)));
    }
    all
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn messages_that_cannot_be_true_change_nothing() {
    let (folder, run, endpoint) = (Folder::new(), unique_run("forged"), free_endpoint());
    let expected = folder.summary("run -n 30 -k 600");
    let args = format!("up -P 4 -n 30 -k 600 --pace 3ms --paused --run {run} --listen {endpoint} --out out");
    let up = folder.start(&args);
    folder.wait_for_tti(&run, 0);
    let bus = peer(&endpoint, &run).await;
    folder.clock(&run, "resume");
    for tti in 0..600 {
        for (key, payload) in forgeries(bus.keys(), tti) {
            bus.put_raw(&key, payload).expect("sent");
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    bus.close().await;
    let end = up.finish();
    assert!(end.is_success(), "{end}");
    assert!(!end.stderr.contains("panicked"), "{end}");
    let summary = Summary::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    assert!(summary.number("timing.strays") > 0, "{summary:?}");
}

#[test]
fn a_folder_that_holds_something_is_left_alone() {
    let folder = Folder::new();
    fs::create_dir(folder.join("mine")).expect("writable");
    folder.write("mine/thesis.tex", "precious");
    let end = folder.run("run -s quick --out mine");
    assert_refused(&end, 1, &["--out mine", "not empty", "not a run"]);
    let end = folder.run("run -s quick --out mine --force");
    assert_refused(&end, 1, &["--out mine", "not empty", "not a run"]);
    assert_eq!(folder.list("mine"), ["thesis.tex"]);
    assert!(folder.run("run -s quick --out run").is_success());
    let end = folder.run("up -s quick --out run");
    assert_refused(&end, 1, &["--out run", "not empty", "--force"]);
    assert_eq!(
        Summary::read(&folder.join("run")).status(),
        "complete",
        "the run there is as it was"
    );
    assert!(folder.run("up -s quick --out run --force --seed 3").is_success());
    assert_eq!(Summary::read(&folder.join("run")).number("seed"), 3);
}

#[test]
fn a_place_that_cannot_be_written_is_named() {
    let folder = Folder::new();
    folder.write("file", "");
    let end = folder.run("run -s quick --out file");
    assert_refused(&end, 1, &["file"]);
    let end = folder.run("up -s quick --out file/below");
    assert_refused(&end, 1, &["file/below"]);
    // The administrator writes everywhere but in a place like this one.
    let end = folder.run("bs -s quick --run x --listen tcp/127.0.0.1:0 --out /proc/reveille/run");
    assert_refused(&end, 1, &["/proc/reveille/run"]);
    fs::create_dir(folder.join("closed")).expect("writable");
    fs::set_permissions(folder.join("closed"), fs::Permissions::from_mode(0o555)).expect("ours");
    if fs::write(folder.join("closed/probe"), "").is_err() {
        let end = folder.run("up -s quick --out closed/run");
        assert_refused(&end, 1, &["closed/run", "denied"]);
    }
    assert_eq!(fs::read_to_string(folder.join("file")).expect("there"), "");
}

#[test]
fn a_place_whose_parents_are_missing_is_made() {
    let folder = Folder::new();
    assert!(folder.run("run -s quick --out a/b/c").is_success());
    assert_eq!(Summary::read(&folder.join("a/b/c")).status(), "complete");
}

#[test]
fn a_device_process_that_tries_to_connect_can_be_interrupted() {
    let folder = Folder::new();
    for signal in [Signal::INT, Signal::TERM] {
        let device = folder.start(&format!(
            "device --connect {} --run x --patience 10min",
            free_endpoint()
        ));
        // Signals before the handlers are in place end the process too, but by themselves.
        wait_until("the device process to take a signal", PATIENCE, || {
            let status = fs::read_to_string(format!("/proc/{}/status", device.pid())).ok()?;
            let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
            let caught = u64::from_str_radix(caught.trim(), 16).ok()?;
            (caught & 1 << 14 != 0).then_some(())
        });
        device.signal(signal);
        assert_eq!(device.finish().code(), Some(130));
    }
}

#[test]
fn a_setting_without_effect_is_refused() {
    let folder = Folder::new();
    for (setting, counts_with) in [
        ("harvest.off_mean=3", "harvest.kind = \"mpp\""),
        ("harvest.trace.file=\"sun.csv\"", "harvest.kind = \"trace\""),
        ("layout.file=\"spots.csv\"", "layout.kind = \"file\""),
    ] {
        let field = setting.split('=').next().expect("a field");
        let end = folder.run(&format!("run --set {setting} --quiet"));
        assert_refused(&end, 1, &[field, counts_with, "--set"]);
    }
}

#[test]
fn the_clock_cannot_be_run_to_the_past_or_beyond_the_end() {
    let (folder, run) = (Folder::new(), unique_run("past"));
    let _up = folder.start(&format!("up -P 1 -n 3 -k 100 --run {run} --paused --out out"));
    folder.wait_for_tti(&run, 0);
    folder.clock(&run, "step 20");
    folder.wait_for_tti(&run, 20);
    for k in [19, 101] {
        let end = folder.run(&format!("clock --run {run} run-to {k}"));
        assert_refused(&end, 1, &[&format!("TTI {k} cannot be run to"), "TTI 20", "TTI 100"]);
    }
    assert_refused(&folder.run(&format!("clock --run {run} step 0")), 2, &["1.."]);
    folder.clock(&run, "resume");
}
