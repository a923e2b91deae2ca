//! Actions of operators in runs over the bus: scripted and live actions, killed device processes and base stations. The
//! digest equals the replay in memory. `hostile_peer` tests that a stranger cannot act, `tests/tests/actions.rs` tests
//! the effects of actions. Texts of actions come from `common/src/message/action.rs`, the grammar of scripts
//! from docs/actions.md. The lines of `inputs.log` are a file format.

use reveille_bs::observer::{Notification, Observer};
use reveille_common::message::{Change, OperatorAction};
use reveille_common::totals::MissCause;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_tests::process::{
    PATIENCE, SummaryJson, TestFolder, assert_refused, hosts_of, send_signal, unique_run, wait_until,
};
use reveille_tests::scenarios::{draw_actions, paper};
use rustix::process::Signal;

/// Returns the actions as a script, by the grammar in docs/actions.md.
fn to_script(actions: &[OperatorAction]) -> String {
    let line = |OperatorAction { tti, change }: &OperatorAction| {
        let devices = change.devices().map_or_else(String::new, |range| {
            format!("{}-{}", range.first, range.first.0 + range.count - 1)
        });
        match change {
            Change::Fail(_) => format!("{tti} fail {devices}\n"),
            Change::Revive(_) => format!("{tti} revive {devices}\n"),
            Change::AddEnergy(_, energy) => format!("{tti} energy {devices} {}\n", energy.units()),
            Change::Set(setting, value) => format!("{tti} set {} {value}\n", setting.field()),
        }
    };
    actions.iter().map(line).collect()
}

/// Counts the actions that take effect.
#[derive(Default)]
struct ActionCounter(usize);

impl Observer for ActionCounter {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.0 += usize::from(matches!(notification, Notification::ActionTaken(_)));
    }
}

#[test]
fn fifty_random_scripts_have_the_same_digest_over_the_bus_and_in_memory() {
    let folder = TestFolder::new();
    let mut missed_by_failed_devices = 0;
    for seed in 0..50_u64 {
        let policy = ["age-index", "knn", "q-learning", "random", "adjusted"][seed as usize % 5];
        let (devices, ttis) = (8 + seed % 7, 120 + 10 * seed);
        let scenario = paper(&[
            &format!("devices={devices}"),
            &format!("ttis={ttis}"),
            &format!("seed={seed}"),
            &format!("policy.name={policy}"),
        ]);
        let drawn = draw_actions(&scenario, seed);
        let script = to_script(&drawn);
        folder.write("script", &script);
        let (mut run, mut counter) = (start(&scenario, RunOptions::default()), ActionCounter::default());
        run.schedule_inputs(&ExternalInputs::from_actions(&drawn));
        let in_memory = run.finish(&mut counter);
        assert_eq!(counter.0, drawn.len(), "{script}");
        let summary = folder.summary(&format!(
            "up -n {devices} -k {ttis} --seed {seed} -p {policy} -P {} --actions script --audit on --out out{seed}",
            seed % 3
        ));
        assert_eq!(
            summary.digest(),
            in_memory.digest.to_string(),
            "{policy}, seed {seed}\n{script}"
        );
        assert_eq!(summary.text("audit"), "complete");
        // The digest does not cover the causes of missed events.
        for cause in MissCause::ALL {
            assert_eq!(
                summary.number(&format!("totals.missed.{}", cause.name())),
                in_memory.totals.missed.by_cause(cause),
                "{policy}, seed {seed}, {cause:?}\n{script}"
            );
        }
        missed_by_failed_devices += in_memory.totals.missed.failed;
    }
    // Not a requirement: the case occurs.
    assert!(missed_by_failed_devices > 50, "{missed_by_failed_devices}");
}

#[test]
fn actions_survive_killed_device_processes() {
    let (folder, run) = (TestFolder::new(), unique_run("act"));
    folder.write(
        "script",
        "from 20 every 40 fail 0-9 for 15 at random\n200 set events.alpha 0.5\n700 set policy.age-index.price 0.1\n",
    );
    let scenario = "-n 20 -k 900 -p age-index";
    let up = folder.start(&format!(
        "up {scenario} -P 4 --pace 4ms --audit on --actions script --record out.mcap --out out --run {run} --json"
    ));
    for kill_index in 0..3 {
        folder.wait_for_tti(&run, 10);
        let acted = folder.clock(&run, "act fail 3,10-14");
        // The script or an earlier action can have failed some of them.
        assert!(
            acted.contains(": device 3 ") && acted.contains(", devices 10 to 14 fail"),
            "{acted}"
        );
        let killed = hosts_of(&run)[kill_index];
        send_signal(killed, Signal::KILL);
        wait_until("another process", PATIENCE, || {
            let hosts = hosts_of(&run);
            (hosts.len() == 4 && !hosts.contains(&killed)).then_some(())
        });
        folder.clock(&run, "act energy 0-19 1.5");
        // Counted from here: the run keeps its pace during the commands above.
        let revival_tti = folder.wait_for_tti(&run, 0) + 60;
        folder.clock(&run, &format!("act revive 3,12 --at {revival_tti}"));
        folder.wait_for_tti(&run, revival_tti + 10);
    }
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = finished.summary();
    assert_eq!(
        (summary.number("timing.losses"), summary.text("audit")),
        (3, "complete")
    );
    let replayed = folder.summary(&format!("run {scenario} --input-log out/inputs.log --out again"));
    assert_eq!(replayed.digest(), summary.digest());
    let scripted = folder.summary(&format!("run {scenario} --actions script"));
    assert_ne!(scripted.digest(), summary.digest(), "live actions change the run");
    let verified = folder.run("inspect verify out.mcap");
    assert!(verified.is_success(), "{verified}");
    let tail = folder.run("inspect tail out.mcap --kind action --until 250");
    assert!(
        tail.is_success() && tail.stdout.contains("events.alpha is set to 0.5"),
        "{tail}"
    );
}

#[test]
fn actions_survive_a_killed_base_station() {
    let (folder, run) = (TestFolder::new(), unique_run("act"));
    folder.write(
        "script",
        "from 0 every 50 fail 0-9 for 20 at random\n1000 set events.alpha 0.5\n",
    );
    let scenario = "-n 20 -k 1200 -p knn";
    let up = folder.start(&format!(
        "up {scenario} -P 2 --pace 3ms --on-loss end --actions script --out out --run {run}"
    ));
    folder.wait_for_tti(&run, 10);
    folder.clock(&run, "act fail 19");
    folder.clock(&run, "act revive 19 --at 1100");
    wait_until("a resume mark", PATIENCE, || {
        folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    folder.clock(&run, "act energy 0-19 3");
    up.signal(Signal::KILL);
    up.finish();
    let refused = folder.run("up --resume out --actions script");
    assert!(
        !refused.is_success() && refused.stderr.contains("cannot be used with"),
        "{refused}"
    );
    let run = unique_run("act");
    let up = folder.start(&format!("up --resume out -P 3 --pace 2ms --audit on --run {run}"));
    folder.wait_for_tti(&run, 10);
    folder.clock(&run, "act fail 18");
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    let replayed = folder.summary("run --input-log out/inputs.log");
    assert_eq!(
        (replayed.digest(), summary.text("audit")),
        (summary.digest(), "complete")
    );
    let log = String::from_utf8(folder.bytes("out/inputs.log")).expect("text");
    let is_live_fail = |line: &str| line.starts_with("{\"fail\":") && line.ends_with("\"first\":19,\"count\":1}}");
    assert!(log.lines().any(is_live_fail), "{log}");
    for part in [
        "\"count\":20,\"micro\":3000000}}",
        "{\"revive\":{\"tti\":1100,\"first\":19,\"count\":1}}",
        "{\"set\":{\"tti\":1000,\"field\":\"events.alpha\",\"value\":0.5}}",
    ] {
        assert!(log.contains(part), "{part}\n{log}");
    }
}

#[test]
fn an_impossible_action_is_refused() {
    let (folder, run) = (TestFolder::new(), unique_run("act"));
    let up = folder.start(&format!(
        "up -n 20 -k 400 -p knn -P 2 --on-loss continue --paused --out out --run {run}"
    ));
    folder.wait_for_clock(&run);
    folder.clock(&run, "run-to 100 --wait");
    let assert_action_refused = |action: &str, cause: &str| {
        let finished = folder.run(&format!("clock act {action} --run {run}"));
        assert!(
            !finished.is_success() && finished.stderr.contains(cause),
            "{action}: {finished}"
        );
    };
    assert_action_refused(
        "fail 20",
        "device 20: not in the run; use `all`, or devices from 0 to 19",
    );
    assert_action_refused("fail 7-2", "`7-2`: 7 is larger than 2; use 2-7");
    assert_action_refused("energy 7 0", "above 0");
    assert_action_refused("energy 7 0.0000004", "multiples of 0.000001");
    assert_action_refused("set policy.age-index.price 1", "policy knn does not use it");
    assert_action_refused("set devices 3", "cannot change during a run");
    assert_action_refused("fail 7 --at 99", "TTI 99: must be from 100, the next TTI, to 399");
    assert_action_refused("fail 7 --at 400", "TTI 400: must be from 100");
    assert_eq!(
        folder.clock(&run, "act fail 7 --at 399").trim(),
        "TTI 399: device 7 fails"
    );
    assert_eq!(folder.clock(&run, "act fail 7").trim(), "TTI 100: device 7 fails");
    let all = folder.clock(&run, "act fail all --at 398");
    assert_eq!(all.trim(), "TTI 398: all devices fail (1 of them had already failed)");
    let again = folder.clock(&run, "act fail 7,8 --at 300");
    assert_eq!(again.trim(), "TTI 300: device 7 had already failed, device 8 fails");
    let healthy = folder.clock(&run, "act revive 9 --at 200");
    assert_eq!(healthy.trim(), "TTI 200: device 9 had not failed");
    let timed = folder.clock(&run, "act fail 9 --at 250 --for 50");
    assert_eq!(timed.trim(), "TTI 250: device 9 fails\nTTI 300: device 9 is revived");
    let log = || String::from_utf8(folder.bytes("out/inputs.log")).expect("text");
    assert!(
        log().contains("{\"fail\":{\"tti\":398,\"first\":0,\"count\":20}}"),
        "{}",
        log()
    );
    send_signal(hosts_of(&run)[0], Signal::KILL);
    wait_until("the process to end", PATIENCE, || {
        (hosts_of(&run).len() == 1).then_some(())
    });
    folder.clock(&run, "step 1 --wait");
    let removed = ["revive 0", "revive 19"].map(|action| {
        let finished = folder.run(&format!("clock act {action} --run {run}"));
        finished.stderr.contains("was removed from the run with its process")
    });
    assert!(
        removed[0] != removed[1],
        "one half of the devices is removed: {removed:?}"
    );
    // All devices are those that are still in the run.
    folder.clock(&run, "act energy all 1 --at 300");
    let first = if removed[0] { 10 } else { 0 };
    let entry = format!("{{\"energy\":{{\"tti\":300,\"first\":{first},\"count\":10,\"micro\":1000000}}}}");
    assert!(log().contains(&entry), "{entry}\n{}", log());
    folder.clock(&run, "resume");
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    let replayed = folder.summary("run -n 20 -k 400 -p knn --input-log out/inputs.log");
    assert_eq!(replayed.digest(), SummaryJson::read(&folder.join("out")).digest());
}

#[test]
fn actions_after_the_end_of_an_interrupted_run_are_not_listed() {
    let (folder, run) = (TestFolder::new(), unique_run("script"));
    folder.write("script", "50 fail 3\n300 fail 0-9\n");
    let up = folder.start(&format!(
        "up -P 1 -n 20 -k 400 -p random --run {run} --paused --actions script --quiet --out out"
    ));
    folder.wait_for_clock(&run);
    folder.clock(&run, "run-to 300 --wait");
    up.signal(Signal::INT);
    assert_eq!(up.finish().code(), Some(130));
    assert_eq!(SummaryJson::read(&folder.join("out")).number("ttis_done"), 300);
    for command in ["compare out out", "inspect misses out"] {
        let finished = folder.run(command);
        let listed = finished.stdout.replace("\n  ", " ");
        assert!(
            listed.contains("1 action: TTI 50 device 3 fails") && !listed.contains("TTI 300 devices"),
            "{finished}"
        );
    }
}

#[test]
fn an_invalid_script_is_refused_with_the_line() {
    let folder = TestFolder::new();
    folder.write("script", "5 fail 3\n6 explode 4\n");
    for command in ["run", "up", "bs --run demo"] {
        let finished = folder.run(&format!("{command} -n 10 -k 50 --actions script --out out"));
        assert_refused(
            &finished,
            1,
            &["--actions script: line 2: `explode 4` is not an action; use"],
        );
        let finished = folder.run(&format!("{command} -n 10 -k 50 --actions missing --out out"));
        assert_refused(&finished, 1, &["--actions missing: no such file", "docs/actions.md"]);
    }
    assert!(!folder.join("out").exists(), "no folder is left behind");
}

#[test]
fn commands_warn_of_actions_in_the_warm_up() {
    let folder = TestFolder::new();
    folder.write("early", "20 fail 3\n30 revive 3\n100 fail 4\n");
    folder.write("late", "40 fail 3\n");
    let scenario = "-n 10 -k 400 --actions";
    let warned = [
        format!("run {scenario} early --out r"),
        format!("up -P 1 {scenario} early"),
        "sweep --policies knn --devices 10 --ttis 400 --actions early --dry-run".to_owned(),
        "sweep --policies knn --devices 10 --ttis 400 --actions early --set warm_up=0.06 --dry-run".to_owned(),
        "inspect misses r".to_owned(),
    ];
    for command in warned {
        let finished = folder.run(&command);
        let text = format!("{}{}", finished.stdout, finished.stderr).replace('\n', " ");
        let start = if command.contains("warm_up=0.06") {
            "1 of 3 actions (TTI 20) are"
        } else {
            "2 of 3 actions (TTIs 20 to 30) are"
        };
        let expected = format!("{start} in the warm-up, which no metric counts; use TTIs from ");
        let is_warned = text.contains(&expected) && text.contains("--set warm_up=0.05 to count");
        assert!(finished.is_success() && is_warned, "{command}: {finished}");
    }
    for command in [
        format!("run {scenario} late"),
        format!("run {scenario} early --set warm_up=0.05"),
    ] {
        let finished = folder.run(&command);
        assert!(
            finished.is_success() && !finished.stderr.contains("warm-up"),
            "{finished}"
        );
    }
}

#[test]
fn the_summary_has_the_mean_of_a_changed_event_rate() {
    let folder = TestFolder::new();
    folder.write("a.txt", "600 set events.alpha 0.4\n");
    let run = "run -s quick -p knn -n 10 -k 1000 --set events.alpha=0.1 --set warm_up=0.2 --actions a.txt --out r";
    assert!(folder.run(run).is_success());
    let summary: serde_json::Value = serde_json::from_slice(&folder.bytes("r/summary.json")).expect("a summary");
    // 400 measured TTIs with 0.1, and as many with 0.4.
    let alpha = summary["start_probability"].as_f64().expect("a number");
    assert!((alpha - 0.25).abs() < 1e-12, "{alpha}");
}
