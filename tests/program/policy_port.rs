//! External decisions over the bus: a run whose policy process repeats the decisions of a built-in policy has the
//! digest of that policy, also with killed processes, a resume and late observers. Runs without a policy process,
//! policy commands, and refused options. `misbehaving_policy.rs` tests invalid replies. Runs have the 30 devices and
//! 400 TTIs of [`SHORT_RUN`], unless a test states others.

use std::time::Duration;

use reveille_bs::policy::external::wire::{DecisionRequest, RequestKind};
use reveille_bs::policy::external::{Decision, PlanDecision, RecordedDecision};
use reveille_bs::policy::outside;
use reveille_bs::server::policy_port::client::{self, ClientIdentity};
use reveille_common::encoding::Encoding;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::io::Disk;
use reveille_common::message::InputLogPart;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::scenario::{Override, load};
use reveille_lab::external_inputs::{ExternalInput, first_line, input_line};
use reveille_tests::external_policy::{ExternallyDecidedRun, MAY_WAKE, SHORT_RUN, answer_from, run_built_in};
use reveille_tests::process::{
    PATIENCE, Process, SummaryJson, TestFolder, hosts_of, is_alive, send_signal, unique_run, wait_until,
};
use rustix::process::Signal;

#[tokio::test(flavor = "multi_thread")]
async fn external_decisions_of_a_policy_give_its_digest() {
    let reported = ["bs.battery_knowledge=reported", "bs.ranking=posterior"];
    let lossy = ["radio.uplink_loss=0.2", "radio.plan_loss=0.1", "radio.wake_latency=1"];
    let cases: [(&str, &[&str], Encoding, &str); 5] = [
        ("age-index", &[], Encoding::Json, "-P 3"),
        ("q-learning", &reported, Encoding::Cbor, "-P 3"),
        ("knn", &lossy, Encoding::Cbor, "-P 1 --no-lookahead"),
        ("random", &[], Encoding::Json, "-P 0 --on-loss end"),
        ("dt", &reported, Encoding::Cbor, "-P 30 --window 7"),
    ];
    for (policy, fields, encoding, mode) in cases {
        let (transcript, digest) = run_built_in(policy, fields);
        let set_options: Vec<String> = fields.iter().map(|field| format!(" --set {field}")).collect();
        let set_options = set_options.concat();
        let run = ExternallyDecidedRun::start(&format!("{mode} --audit on{set_options}"));
        let answer_count = run.decide(encoding, |request| answer_from(&transcript, request)).await;
        let (folder, finished) = run.finish();
        assert!(finished.is_success(), "{policy}: {finished}");
        let summary = finished.summary();
        assert_eq!(
            (summary.digest(), summary.text("audit")),
            (&*digest, "complete"),
            "{policy}: {finished}"
        );
        // At least a plan in each of the 400 TTIs of `SHORT_RUN`.
        let decision_count = summary.number("timing.decisions");
        assert!(
            decision_count >= 400 && answer_count >= 400,
            "{policy}: {decision_count} decisions, {answer_count} answers"
        );

        // Replays in memory and on the bus, with the scenario of the folder or of the options.
        let replay = "--policy replay=out/inputs.log";
        for command in [
            format!("run {replay}"),
            format!("run {replay} --no-lookahead"),
            format!("run {SHORT_RUN}{set_options} {replay}"),
            format!("up -P 2 {replay}"),
        ] {
            let replayed = folder.summary(&command);
            assert_eq!(
                (replayed.digest(), replayed.status()),
                (&*digest, "complete"),
                "{policy}: {command}"
            );
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_policy_and_device_processes_do_not_change_the_digest() {
    let (transcript, digest) = run_built_in("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 4 --pace 4ms --audit on");
    let key = run.key();
    let identity = |name: &str| ClientIdentity {
        name: name.to_owned(),
        run_key: Some(key),
        encoding: Encoding::Cbor,
    };
    // The first policy process stops at an arbitrary point midway: the run takes at least 1.6 s.
    let (bus, first_identity) = (run.bus().await, identity("the first"));
    let mut first_policy = |request: &DecisionRequest| answer_from(&transcript, request);
    let first_client = client::serve_decisions(&bus, &first_identity, &mut first_policy);
    let stopped = tokio::time::timeout(Duration::from_millis(700), first_client).await;
    assert!(stopped.is_err(), "the run ended within 700 ms");
    bus.close().await;
    let killed_host = hosts_of(&run.name)[1];
    run.decide(Encoding::Json, |request| {
        if request.head.tti == 350 {
            send_signal(killed_host, Signal::KILL);
        }
        answer_from(&transcript, request)
    })
    .await;
    let (_, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(
        (finished.summary().digest(), finished.summary().text("audit")),
        (&*digest, "complete")
    );
    assert!(finished.stderr.contains("the first has not answered"), "{finished}");
    assert!(finished.stderr.contains(" had no host for "), "{finished}");
}

/// A policy process that is restarted after every third decision: the base station repeats each request that the end of
/// a process, or zenoh right after its start, leaves without a reply.
#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_restarts_of_the_policy_process_do_not_change_the_digest() {
    const RESTARTS: u32 = 100;
    const DECISIONS_BETWEEN_RESTARTS: u32 = 3;
    let (transcript, digest) = run_built_in("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 2 --decision-timeout 30s -v");
    let run_key = Some(run.key());
    for process in 0..=RESTARTS {
        let bus = run.bus().await;
        let identity = ClientIdentity {
            name: format!("process {process}"),
            run_key,
            encoding: Encoding::Cbor,
        };
        let (mut decision_count, restart) = (0, tokio::sync::Notify::new());
        let mut policy = |request: &DecisionRequest| {
            decision_count += 1;
            if decision_count == DECISIONS_BETWEEN_RESTARTS && process < RESTARTS {
                restart.notify_one();
            }
            answer_from(&transcript, request)
        };
        tokio::select! {
            answer_count = client::serve_decisions(&bus, &identity, &mut policy) => {
                assert_eq!(process, RESTARTS, "the run ended after {answer_count:?}");
            }
            () = restart.notified() => {}
        }
        bus.close().await;
    }
    let (_, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(finished.summary().digest(), digest, "{finished}");
    for process in 0..=RESTARTS {
        assert!(
            finished.stderr.contains(&format!("process {process} decides")),
            "{finished}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_resumed_base_station_requests_only_new_decisions() {
    let (transcript, digest) = run_built_in("q-learning", &[]);
    // The kill comes after more than 2 s, and resume marks are a second apart.
    let run = ExternallyDecidedRun::start("-P 2 --pace 8ms");
    let answers_before = run
        .decide(Encoding::Cbor, |request| {
            if request.head.tti == 300 {
                send_signal(run.process.pid(), Signal::KILL);
            }
            answer_from(&transcript, request)
        })
        .await;
    let (folder, _) = run.finish();
    assert!(folder.join("out/resume.json").is_file(), "no resume mark");
    let line_count = String::from_utf8(folder.bytes("out/inputs.log"))
        .expect("text")
        .lines()
        .count() as u64;
    assert!(
        line_count >= answers_before,
        "{line_count} lines after {answers_before} answers"
    );
    let resumed = ExternallyDecidedRun::start_in(folder, "up --resume out -P 3 --audit on");
    let mut first_seq = None;
    resumed
        .decide(Encoding::Cbor, |request| {
            first_seq.get_or_insert(request.head.seq);
            answer_from(&transcript, request)
        })
        .await;
    let (folder, finished) = resumed.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(SummaryJson::read(&folder.join("out")).digest(), digest);
    // The last answers before the kill may not have arrived.
    assert!(
        first_seq.is_some_and(|seq| seq + 3 >= answers_before),
        "resumed at request {first_seq:?} after {answers_before} answers"
    );
    let replayed = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(replayed.digest(), digest);
}

/// A recording that another process begins late equals the recording of the run itself.
#[tokio::test(flavor = "multi_thread")]
async fn a_late_recording_is_complete() {
    let (transcript, digest) = run_built_in("age-index", &["bs.sync_interval=1000"]);
    let run = ExternallyDecidedRun::start("-P 2 --pace 3ms --record whole.mcap --set bs.sync_interval=1000");
    let mut late_recorder = None;
    run.decide(Encoding::Json, |request| {
        if request.head.tti == 150 && late_recorder.is_none() {
            let recorder = run
                .folder
                .start(&format!("inspect record late.mcap --run {}", run.name));
            // Virtual time stops until the request is answered.
            recorder.wait_for_stderr("connected to run");
            late_recorder = Some(recorder);
        }
        answer_from(&transcript, request)
    })
    .await;
    let recorded = late_recorder.expect("a request in TTI 150").finish();
    assert!(recorded.is_success(), "{recorded}");
    let (folder, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(finished.summary().digest(), digest);
    let compared = folder.run("compare --exit-code whole.mcap late.mcap");
    assert!(compared.is_success(), "{compared}");
    let verified = folder.run("inspect verify whole.mcap");
    assert!(verified.is_success() && verified.stdout.contains(&digest), "{verified}");
}

/// An observer that joins late receives an input log longer than one transfer.
#[test]
fn a_late_recording_of_a_run_with_a_long_input_log_is_complete() {
    let (folder, run) = (TestFolder::new(), unique_run("long"));
    let fields = ["policy.name=external", "devices=1000", "ttis=240"];
    let overrides = fields.map(|field| Override::parse(field).expect("an override"));
    let scenario = load("paper", &overrides, &outside::kinds_with_external(), &Disk)
        .expect("a scenario")
        .scenario;
    // No device ever senses, and the different offsets make the log long: the factor is an arbitrary large number.
    let sleeping = |offset: u64| DutyCycle {
        t_on: 0,
        t_drx: DutyCycle::MAX_T_DRX,
        offset: (offset % u64::from(DutyCycle::MAX_T_DRX)) as u32,
    };
    let plans = (0..scenario.run.ttis).map(|k| {
        let cycles = (0..1000).map(|j| sleeping((k * 1000 + j) * 7_919_777)).collect();
        let (plan, next) = (Plan::Periodic(cycles), Tti(k + 1));
        let decision = Decision::Plan(PlanDecision { plan, next });
        input_line(&ExternalInput::Decision(RecordedDecision { tti: Tti(k), decision }))
    });
    let log = first_line(&scenario) + &plans.collect::<String>();
    assert!(log.len() as u64 > InputLogPart::MAX_BYTES, "{} bytes", log.len());
    folder.write("long.log", &log);
    // The options repeat `fields`: the first line of the log names the scenario.
    let up = folder.start(&format!(
        "up -n 1000 -k 240 -P 1 -p replay=long.log --paused --record whole.mcap --run {run} --quiet --out out"
    ));
    folder.wait_for_tti(&run, 0);
    folder.clock(&run, "step 200");
    folder.wait_for_tti(&run, 200);
    let late_recorder = folder.start(&format!("inspect record late.mcap --run {run}"));
    late_recorder.wait_for_stderr("connected to run");
    folder.clock(&run, "resume");
    let (up, late_recorder) = (up.finish(), late_recorder.finish());
    assert!(up.is_success() && late_recorder.is_success(), "{up}\n{late_recorder}");
    let compared = folder.run("compare --exit-code whole.mcap late.mcap");
    assert!(compared.is_success(), "{compared}");
}

/// The base station is killed in a TTI with lost devices and undecided wake-ups.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_killed_with_undecided_wake_ups_resumes_before_them() {
    let (transcript, _) = run_built_in("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 3 --pace 4ms --on-loss continue");
    let (bs_pid, mut kill_tti) = (run.process.pid(), None);
    let run_name = run.name.clone();
    run.decide(Encoding::Cbor, |request| {
        let (tti, is_wake) = (request.head.tti, request.head.stage == RequestKind::Wake);
        if is_wake && tti > 100 && kill_tti.is_none() {
            kill_tti = Some(tti);
            send_signal(hosts_of(&run_name)[0], Signal::KILL);
            wait_until("the process to end", PATIENCE, || {
                (hosts_of(&run_name).len() == 2).then_some(())
            });
            // The base station needs a moment to notice the loss, which must precede the decision.
            std::thread::sleep(Duration::from_millis(300));
            // The last device belongs to another host, so that another request follows.
            let last_sleeper = request
                .action_mask
                .0
                .iter()
                .rposition(|&entry| entry == MAY_WAKE)
                .expect("a device sleeps");
            return Decision::Wake(vec![DeviceId(last_sleeper as u32)]);
        }
        if kill_tti.is_some() {
            send_signal(bs_pid, Signal::KILL);
        }
        answer_from(&transcript, request)
    })
    .await;
    let (folder, _) = run.finish();
    let resumed = ExternallyDecidedRun::start_in(folder, "up --resume out -P 3 --audit on --on-loss continue");
    resumed
        .decide(Encoding::Cbor, |request| answer_from(&transcript, request))
        .await;
    let (folder, finished) = resumed.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    let replayed = folder.summary("run --policy replay=out");
    assert_eq!((summary.digest(), summary.status()), (replayed.digest(), "complete"));

    // A replay of a truncated log ends with an error. Each number of lines ends the log before the lost devices, since
    // every TTI up to 100 has a plan. The first line names the scenario, so 2 lines leave a single decision.
    let log = String::from_utf8(folder.bytes("out/inputs.log")).expect("text");
    for line_count in [2, 60, 101] {
        let cut_lines: Vec<&str> = log.lines().take(line_count).chain([""]).collect();
        folder.write("cut.log", &cut_lines.join("\n"));
        for command in ["run", "up -P 1"] {
            let scenario = "--scenario out/scenario.toml --policy replay=cut.log";
            let finished = folder.run(&format!("{command} {scenario} --out cut --force"));
            assert!(
                finished.code() == Some(1) && finished.stderr.contains("for TTI"),
                "{command}: {finished}"
            );
        }
    }
}

#[test]
fn a_missing_policy_process_is_reported_and_waited_for() {
    let run = ExternallyDecidedRun::start("-P 1 --decision-timeout 1s");
    let (_, finished) = run.finish();
    assert!(
        finished.code() == Some(1)
            && finished.stderr.contains("no policy process answers at reveille/")
            && finished.stderr.contains("--policy-command"),
        "{finished}"
    );

    let two_ttis = "up -n 30 -k 2 -p external --out out -P 1 --decision-timeout 1s --on-undecided hold";
    let run = ExternallyDecidedRun::start_in(TestFolder::new(), two_ttis);
    let (_, finished) = run.finish();
    assert!(
        finished.is_success() && finished.summary().number("timing.decisions_held") >= 2,
        "{finished}"
    );

    let run = ExternallyDecidedRun::start("-P 1");
    run.process
        .wait_for_stderr("no decision for 5 s: no policy process answers at reveille/");
    run.process.signal(Signal::INT);
    let (folder, finished) = run.finish();
    assert_eq!(finished.code(), Some(130), "{finished}");
    // The run can be resumed with a decision timeout.
    let finished = folder.run("up --resume out -P 1 --decision-timeout 200ms");
    assert!(
        finished.code() == Some(1) && finished.stderr.contains("no decision for TTI 0"),
        "{finished}"
    );
}

#[test]
fn a_policy_command_and_its_run_end_together() {
    let folder = TestFolder::new();
    let script = folder.write(
        "policy.sh",
        "echo policy of \"$REVEILLE_RUN\" >&2\ntest -n \"$REVEILLE_KEY\" || exit 3\nexit 4\n",
    );
    let mut up = folder.command(&format!("up {SHORT_RUN} -p external -P 2 --out ends --run ends"));
    up.args(["--policy-command", &format!("sh {}", script.display())]);
    let finished = Process::start(&mut up).finish();
    assert!(
        finished.code() == Some(1) && finished.stderr.contains("policy of ends"),
        "{finished}"
    );
    assert!(
        finished.stderr.contains("the policy process") && finished.stderr.contains("exit status: 4"),
        "{finished}"
    );
    // A silent policy command ends with the run.
    let (up, policy_pid) = start_with_silent_policy(&folder, "sleeps", "exec sleep 1000");
    up.signal(Signal::INT);
    assert_eq!(up.finish().code(), Some(130));
    assert!(!is_alive(policy_pid), "process {policy_pid} is still alive");
}

/// Neither a policy command that ignores signals nor its children outlive a killed base station.
#[test]
fn a_policy_command_does_not_outlive_its_base_station() {
    let folder = TestFolder::new();
    let stubborn = "trap '' TERM INT HUP; sleep 1000 & echo $! > child; wait";
    for (name, signal) in [("killed", Signal::KILL), ("interrupted", Signal::INT)] {
        let (up, policy_pid) = start_with_silent_policy(&folder, name, stubborn);
        let child_pid = read_pid(&folder, "child");
        assert!(is_alive(policy_pid) && is_alive(child_pid));
        up.signal(signal);
        if signal == Signal::INT {
            // The second signal ends `up` immediately.
            up.wait_for_stderr("interrupted");
            up.signal(signal);
        }
        assert!(!up.finish().is_success());
        wait_until("the command and its child to end", PATIENCE, || {
            (!is_alive(policy_pid) && !is_alive(child_pid)).then_some(())
        });
    }
}

/// Children of a policy command get time for cleanup, even if the command itself has ended.
#[test]
fn processes_of_a_policy_command_get_sigterm_before_sigkill() {
    let folder = TestFolder::new();
    let script = folder.write(
        "policy.sh",
        "trap 'sleep 0.4; echo done > saved; exit' TERM\necho $$ > child\nwhile :; do sleep 0.05; done\n",
    );
    let command = format!("sh {} | cat", script.display());
    let (up, policy_pid) = start_with_silent_policy(&folder, "piped", &command);
    let child_pid = read_pid(&folder, "child");
    up.signal(Signal::KILL);
    up.finish();
    wait_until("the command and its child to end", PATIENCE, || {
        (!is_alive(policy_pid) && !is_alive(child_pid)).then_some(())
    });
    assert!(folder.list("").contains(&"saved".to_owned()));
}

/// Starts the run `name` with a policy command that never decides, and waits for the handlers of `up`. Returns `up` and
/// the pid of the command's shell, which the command writes to the file `pid`.
fn start_with_silent_policy(folder: &TestFolder, name: &str, command: &str) -> (Process, u32) {
    // A file of an earlier run would be read before the new one is written.
    for file in ["pid", "child"] {
        let _missing = std::fs::remove_file(folder.join(file)).is_err();
    }
    let mut command_line = folder.command(&format!("up {SHORT_RUN} -p external -P 2 --out {name} --run {name}"));
    command_line.args(["--policy-command", &format!("echo $$ > pid; {command}")]);
    let up = Process::start(&mut command_line);
    let policy_pid = read_pid(folder, "pid");
    up.wait_for_handlers();
    (up, policy_pid)
}

/// Reads the pid that a command has written to a file.
fn read_pid(folder: &TestFolder, file: &str) -> u32 {
    wait_until("the command to run", PATIENCE, || {
        std::fs::read_to_string(folder.join(file)).ok()?.trim().parse().ok()
    })
}

#[test]
fn invalid_policy_options_are_refused_before_a_folder_exists() {
    let folder = TestFolder::new();
    folder.write("empty.log", "");
    let cases = [
        (format!("run {SHORT_RUN} -p external"), "reveille up"),
        (
            format!("up {SHORT_RUN} -p knn --policy-command true"),
            "add --policy external",
        ),
        (
            format!("up {SHORT_RUN} -p knn --decision-timeout 3s"),
            "add --policy external",
        ),
        (format!("run {SHORT_RUN} --policy replay=missing.log"), "missing.log"),
        (
            format!("up {SHORT_RUN} --policy replay=missing.log --on-undecided hold"),
            "missing.log",
        ),
        (
            "sweep --policies knn,external --seeds 1".to_owned(),
            "--policies: policy external needs a policy process, and runs in memory have none; start each run with \
             `reveille up --policy external",
        ),
        (
            "train record --set policy.name=external --seeds 1".to_owned(),
            "--set policy.name=external: policy external needs a policy process",
        ),
        (
            "sweep --policies replay=empty.log --seeds 1".to_owned(),
            "use `reveille run --policy replay=empty.log`",
        ),
        (
            format!("figures timeline {SHORT_RUN} -p external"),
            "policy external: only",
        ),
        (
            format!("run {SHORT_RUN} --policy replay="),
            "name the inputs.log of a run",
        ),
        (
            format!("run {SHORT_RUN} --policy replay=runtime"),
            "the folder holds no run",
        ),
        (
            format!("run {SHORT_RUN} --policy replay=empty.log"),
            "the input log holds no inputs",
        ),
    ];
    for (command, why) in cases {
        let finished = folder.run(&format!("{command} --out out"));
        assert!(
            matches!(finished.code(), Some(1 | 2)) && finished.stderr.contains(why),
            "{command}: {finished}"
        );
        assert!(folder.list("out").is_empty(), "{command}");
    }
}
