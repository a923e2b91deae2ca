//! Decisions of another program over the bus: those of a policy of this program give its digest, and programs that die,
//! are late, answer twice, answer nonsense or are none of ours are told so, and bring no run to hang.

use std::time::Duration;

use reveille_bs::host::port::client::{self, Introduction};
use reveille_bs::policy::external::wire::{Asked, Reply, Said};
use reveille_bs::policy::external::{Answer, Stage};
use reveille_bs::scenario::{Override, load};
use reveille_common::bus::{Bus, PolicyQuestion};
use reveille_common::forms::Form;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::secret::Secret;
use reveille_tests::process::{
    Finished, Folder, PATIENCE, Process, Summary, free_endpoint, hosts_of, send_signal, unique_run, wait_until,
};
use reveille_tests::transcript::Transcript;
use rustix::process::Signal;
use serde_json::{Value, json};

const SMALL: &str = "-n 30 -k 400";

/// What `policy` decides in the scenario of [`SMALL`], and its digest.
fn own(policy: &str, set: &[&str]) -> (Transcript, String) {
    let policy = format!("policy.name={policy}");
    let always = [policy.as_str(), "devices=30", "ttis=400"];
    let all = always
        .iter()
        .chain(set)
        .map(|set| Override::parse(set).expect("an override"));
    let (transcript, digest) = Transcript::of(&load("paper", &all.collect::<Vec<_>>()).expect("a scenario"));
    (transcript, digest.to_string())
}

/// What `transcript` has for a question.
fn answer(transcript: &Transcript, asked: &Asked) -> Answer {
    let stage = match asked.head.stage {
        Said::Wake => Stage::Wake,
        Said::Plan | Said::Hello | Said::Bye => Stage::Plan,
    };
    transcript.answer(stage, Tti(asked.head.tti), |DeviceId(j)| {
        asked.action_mask.0[j as usize] == 2
    })
}

/// A run that another program decides for.
struct Decided {
    folder: Folder,
    run: String,
    endpoint: String,
    process: Process,
}

impl Decided {
    fn start(args: &str) -> Self {
        Self::start_in(Folder::new(), &format!("up {SMALL} -p external --out out {args}"))
    }

    fn start_in(folder: Folder, command: &str) -> Self {
        let (run, endpoint) = (unique_run("port"), free_endpoint());
        let process = folder.start(&format!("{command} --run {run} --listen {endpoint} --json"));
        Self {
            folder,
            run,
            endpoint,
            process,
        }
    }

    /// The run's key, as its user finds it.
    fn key(&self) -> Secret {
        wait_until("the run to be found", PATIENCE, || {
            let name = self
                .folder
                .list("runtime/reveille")
                .into_iter()
                .find(|name| name.starts_with(&self.run))?;
            let entry = self.folder.bytes(&format!("runtime/reveille/{name}"));
            let entry: Value = serde_json::from_slice(&entry).ok()?;
            entry["key"].as_str()?.parse().ok()
        })
    }

    async fn bus(&self) -> Bus {
        let run = self.run.parse().expect("a run name");
        Bus::connect(&self.endpoint, run, PATIENCE).await.expect("it listens")
    }

    /// Has `decide` answer until the run is over.
    async fn decide(&self, form: Form, mut decide: impl FnMut(&Asked) -> Answer) -> u64 {
        let introduction = Introduction {
            name: "the test".to_owned(),
            key: Some(self.key()),
            form,
        };
        let decided = client::decide(&self.bus().await, &introduction, &mut decide).await;
        decided.expect("the bus goes on")
    }

    fn finish(self) -> (Folder, Finished) {
        (self.folder, self.process.finish())
    }
}

/// Makes nonsense of an answer.
type Spoil = fn(&mut Value);
/// Answers a question otherwise than by this answer.
type Act = fn(&PolicyQuestion, Value);

/// A program at the port that does as it likes.
struct Rogue {
    bus: Bus,
    key: String,
    id: &'static str,
}

impl Rogue {
    async fn at(run: &Decided) -> Self {
        Self {
            bus: run.bus().await,
            key: run.key().to_string(),
            id: "rogue",
        }
    }

    /// Greets as is expected, and has `act` answer all else, until that says stop or the run is over.
    async fn serve(&self, mut act: impl FnMut(&PolicyQuestion, &Value) -> bool) {
        let questions = self.bus.stand_at_policy_port().expect("a queryable");
        while let Ok(Some(question)) = tokio::time::timeout(Duration::from_secs(3), questions.next()).await {
            let asked: Value = serde_json::from_slice(&question.payload).expect("JSON");
            if asked["stage"] == "hello" {
                let welcome = json!({
                    "protocol": 1, "seq": asked["seq"], "tti": asked["tti"], "stage": "hello",
                    "id": self.id, "name": "a rogue", "key": self.key,
                });
                question
                    .answer(welcome.to_string().into_bytes(), Form::Json)
                    .expect("answered");
            } else if !act(&question, &asked) {
                return;
            }
        }
    }

    /// The answer in which nobody senses and nobody is woken.
    fn idle(&self, asked: &Value) -> Value {
        let decision = if asked["stage"] == "plan" { "sense" } else { "wake" };
        let mut answer = json!({
            "protocol": 1, "seq": asked["seq"], "tti": asked["tti"], "stage": asked["stage"],
            "id": self.id, "key": self.key,
        });
        answer[decision] = json!([]);
        answer
    }
}

fn say(question: &PolicyQuestion, answer: &Value) {
    question
        .answer(answer.to_string().into_bytes(), Form::Json)
        .expect("answered");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_decisions_of_a_policy_give_its_digest() {
    let reported = ["bs.battery_knowledge=reported", "bs.ranking=posterior"];
    let lossy = ["radio.uplink_loss=0.2", "radio.plan_loss=0.1", "radio.wake_latency=1"];
    let cases: [(&str, &[&str], Form, &str); 5] = [
        ("age-index", &[], Form::Json, "-P 3"),
        ("q-learning", &reported, Form::Cbor, "-P 3"),
        ("knn", &lossy, Form::Cbor, "-P 1 --no-lookahead"),
        ("random", &[], Form::Json, "-P 0 --on-loss end"),
        ("dt", &reported, Form::Cbor, "-P 30 --window 7"),
    ];
    for (policy, set, form, way) in cases {
        let (transcript, digest) = own(policy, set);
        let set: Vec<String> = set.iter().map(|set| format!(" --set {set}")).collect();
        let set = set.concat();
        let run = Decided::start(&format!("{way} --audit on{set}"));
        let decided = run.decide(form, |asked| answer(&transcript, asked)).await;
        let (folder, end) = run.finish();
        assert!(end.is_success(), "{policy}: {end}");
        let summary = end.summary();
        assert_eq!(
            (summary.digest(), summary.text("audit")),
            (&*digest, "whole"),
            "{policy}: {end}"
        );
        assert!(
            (summary.number("timing.decisions"), decided) >= (400, 400),
            "{policy}: {decided}"
        );

        // Without anybody to ask, in memory and on the bus, by the folder or by the scenario.
        let kept = "--policy replay=out/inputs.log";
        for command in [
            format!("run {kept}"),
            format!("run {kept} --no-lookahead"),
            format!("run {SMALL}{set} {kept}"),
            format!("up -P 2 {kept}"),
        ] {
            let again = folder.summary(&command);
            assert_eq!(
                (again.digest(), again.status()),
                (&*digest, "complete"),
                "{policy}: {command}"
            );
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_processes_cost_time_and_no_result() {
    let (transcript, digest) = own("age-index", &[]);
    let run = Decided::start("-P 4 --pace 4ms --audit on");
    let key = run.key();
    let introduction = |name: &str| Introduction {
        name: name.to_owned(),
        key: Some(key),
        form: Form::Cbor,
    };
    // The first one is gone in the middle, wherever that is.
    let (bus, own_name) = (run.bus().await, introduction("the first"));
    let mut first = |asked: &Asked| answer(&transcript, asked);
    let first = client::decide(&bus, &own_name, &mut first);
    let gone = tokio::time::timeout(Duration::from_millis(700), first).await;
    assert!(gone.is_err(), "the run is to be longer than that");
    bus.close().await;
    let victim = hosts_of(&run.run)[1];
    let decider = run.decide(Form::Json, |asked| {
        if asked.head.tti == 350 {
            send_signal(victim, Signal::KILL);
        }
        answer(&transcript, asked)
    });
    decider.await;
    let (_, end) = run.finish();
    assert!(end.is_success(), "{end}");
    assert_eq!(
        (end.summary().digest(), end.summary().text("audit")),
        (&*digest, "whole")
    );
    assert!(end.stderr.contains("the first has not answered"), "{end}");
    assert!(end.stderr.contains("are carried again"), "{end}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_base_station_is_taken_up_and_asks_only_for_what_is_new() {
    let (transcript, digest) = own("q-learning", &[]);
    let run = Decided::start("-P 2 --pace 8ms");
    let asked_before = {
        let (folder, name) = (run.folder.path().to_owned(), run.run.clone());
        let decider = run.decide(Form::Cbor, |asked| {
            if asked.head.tti == 300 {
                send_signal(run.process.pid(), Signal::KILL);
            }
            answer(&transcript, asked)
        });
        let asked = decider.await;
        assert!(folder.join("out/mark.json").is_file(), "{name}: a mark");
        asked
    };
    let (folder, _) = run.finish();
    let lines = String::from_utf8(folder.bytes("out/inputs.log"))
        .expect("text")
        .lines()
        .count() as u64;
    assert!(lines >= asked_before, "{lines} lines of {asked_before} decisions");
    let again = Decided::start_in(folder, "up --resume out -P 3 --audit on");
    let mut first = None;
    again
        .decide(Form::Cbor, |asked| {
            first.get_or_insert(asked.head.seq);
            answer(&transcript, asked)
        })
        .await;
    let (folder, end) = again.finish();
    assert!(end.is_success(), "{end}");
    assert_eq!(Summary::read(&folder.join("out")).digest(), digest);
    // The one over which it was killed may not have come.
    assert!(
        first.is_some_and(|first| first + 3 >= asked_before),
        "{first:?} after {asked_before}"
    );
    let kept = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(kept.digest(), digest);
}

/// A recording that begins late, and one of the run itself, have all of it.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_is_joined_late_is_whole() {
    let (transcript, digest) = own("age-index", &["bs.sync_interval=1000"]);
    let run = Decided::start("-P 2 --pace 3ms --record whole.mcap --set bs.sync_interval=1000");
    let mut late = None;
    run.decide(Form::Json, |asked| {
        if asked.head.tti == 150 && late.is_none() {
            late = Some(run.folder.start(&format!("inspect record late.mcap --run {}", run.run)));
        }
        answer(&transcript, asked)
    })
    .await;
    let recorded = late.expect("it was asked").finish();
    assert!(recorded.is_success(), "{recorded}");
    let (folder, end) = run.finish();
    assert!(end.is_success(), "{end}");
    assert_eq!(end.summary().digest(), digest);
    let same = folder.run("inspect compare whole.mcap late.mcap");
    assert!(same.is_success(), "{same}");
    let verified = folder.run("inspect verify whole.mcap");
    assert!(verified.is_success() && verified.stdout.contains(&digest), "{verified}");
}

/// The base station is killed over a TTI in which devices were lost and whose wake-ups are not all decided.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_was_killed_within_a_ttis_wake_ups_goes_on_before_it() {
    let (transcript, _) = own("age-index", &[]);
    let run = Decided::start("-P 3 --pace 4ms --on-loss continue");
    run.key();
    let (bs, mut lost_in) = (run.process.pid(), None);
    let name = run.run.clone();
    run.decide(Form::Cbor, |asked| {
        let (tti, is_wake) = (asked.head.tti, asked.head.stage == Said::Wake);
        if is_wake && tti > 100 && lost_in.is_none() {
            lost_in = Some(tti);
            send_signal(hosts_of(&name)[0], Signal::KILL);
            wait_until("one process less", PATIENCE, || {
                (hosts_of(&name).len() == 2).then_some(())
            });
            std::thread::sleep(Duration::from_millis(300));
            // Devices of the others, so that it is asked once more.
            let own = asked
                .action_mask
                .0
                .iter()
                .rposition(|bit| *bit == 2)
                .expect("somebody sleeps");
            return Answer::Wake(vec![DeviceId(own as u32)]);
        }
        if lost_in.is_some() {
            send_signal(bs, Signal::KILL);
        }
        answer(&transcript, asked)
    })
    .await;
    let (folder, _) = run.finish();
    let again = Decided::start_in(folder, "up --resume out -P 3 --audit on --on-loss continue");
    again.decide(Form::Cbor, |asked| answer(&transcript, asked)).await;
    let (folder, end) = again.finish();
    assert!(end.is_success(), "{end}");
    let summary = Summary::read(&folder.join("out"));
    let kept = folder.summary("run --policy replay=out");
    assert_eq!((summary.digest(), summary.status()), (kept.digest(), "complete"));

    // Logs that end too early: nothing is made up.
    let log = String::from_utf8(folder.bytes("out/inputs.log")).expect("text");
    for lines in [2, 60, 101] {
        let torn: Vec<&str> = log.lines().take(lines).chain([""]).collect();
        folder.write("torn.log", &torn.join("\n"));
        for command in ["run", "up -P 1"] {
            let scenario = "--scenario out/scenario.toml --policy replay=torn.log";
            let end = folder.run(&format!("{command} {scenario} --out torn --force"));
            assert!(
                end.code() == Some(1) && end.stderr.contains("for TTI"),
                "{command}: {end}"
            );
        }
    }
}

/// Strangers answer every question with more than anybody can read.
#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_answers_costs_time_and_no_result() {
    let (transcript, digest) = own("age-index", &[]);
    let run = Decided::start("-P 2");
    let flood = run.bus().await;
    let questions = flood.stand_at_policy_port().expect("a queryable");
    let flooding = tokio::spawn(async move {
        let (long, short) = (vec![b'['; 300_000], vec![b'['; 500]);
        while let Some(question) = questions.next().await {
            for payload in [&long, &short].into_iter().cycle().take(100) {
                let _gone = question.answer(payload.clone(), Form::Json).is_err();
            }
            let _gone = question.refuse("flooded").is_err();
        }
    });
    let decided = run.decide(Form::Cbor, |asked| answer(&transcript, asked)).await;
    flooding.abort();
    let (_, end) = run.finish();
    assert!(end.is_success() && decided >= 400, "{decided}: {end}");
    assert_eq!(end.summary().digest(), digest);
    assert!(end.stderr.lines().count() < 40, "{end}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_that_comes_twice_counts_once() {
    let run = Decided::start("-P 2");
    let rogue = Rogue::at(&run).await;
    rogue
        .serve(|question, asked| {
            for _ in 0..2 {
                say(question, &rogue.idle(asked));
            }
            asked["tti"] != 399
        })
        .await;
    let (_, end) = run.finish();
    assert!(end.is_success() && end.stderr.contains("answered twice"), "{end}");
    assert!(end.summary().number("timing.decisions_refused") > 0, "{end}");
}

#[tokio::test(flavor = "multi_thread")]
async fn nonsense_is_told_of_and_ends_the_run_or_is_left_out() {
    let nonsense: [(&str, Spoil); 6] = [
        ("no device 30", |answer| answer["sense"] = json!([30])),
        ("one of", |answer| answer["action"] = json!([0])),
        ("unknown field", |answer| answer["senses"] = json!([1])),
        ("was asked (seq, tti, stage)", |answer| answer["seq"] = json!(7)),
        ("was asked (seq, tti, stage)", |answer| answer["tti"] = json!(7)),
        ("was asked (seq, tti, stage)", |answer| answer["stage"] = json!("wake")),
    ];
    for (why, spoil) in nonsense {
        let run = Decided::start("-P 0");
        let rogue = Rogue::at(&run).await;
        let mut told = 0;
        rogue
            .serve(|question, asked| {
                let mut answer = rogue.idle(asked);
                spoil(&mut answer);
                say(question, &answer);
                told += u32::from(asked["refused"].is_string());
                true
            })
            .await;
        let (_, end) = run.finish();
        assert_eq!(end.code(), Some(1), "{end}");
        assert!(
            end.stderr.contains("3 answers decided nothing") && end.stderr.contains(why),
            "{end}"
        );
        assert_eq!(told, 2, "it is told what was wrong");
    }
    // Whose these are nobody can tell: a stranger could end the run with them.
    let strange: [(&str, Act); 3] = [
        ("an answer was dropped", |question, _| {
            question.answer(b"{".to_vec(), Form::Json).expect("answered");
        }),
        ("an answer was dropped", |question, mut answer| {
            answer["id"] = json!("another");
            say(question, &answer);
        }),
        ("does not answer: no time", |question, _| {
            question.refuse("no time").expect("answered");
        }),
    ];
    for (why, act) in strange {
        let run = Decided::start("-P 0 --decision-timeout 1s");
        let rogue = Rogue::at(&run).await;
        rogue
            .serve(|question, asked| {
                act(question, rogue.idle(asked));
                true
            })
            .await;
        let (_, end) = run.finish();
        assert!(
            end.code() == Some(1) && end.stderr.contains("no decision for TTI 0"),
            "{end}"
        );
        assert_eq!(end.stderr.matches(why).count(), 1, "it is said once: {end}");
    }
    let run = Decided::start("-P 2 --on-undecided hold");
    let rogue = Rogue::at(&run).await;
    rogue
        .serve(|question, asked| {
            let mut answer = rogue.idle(asked);
            if asked["tti"] == 50 {
                answer["id"] = json!("rogue");
                answer["next"] = json!(3);
            }
            say(question, &answer);
            asked["tti"] != 399
        })
        .await;
    let (folder, end) = run.finish();
    assert!(end.is_success(), "{end}");
    let summary = end.summary();
    let counted = |name: &str| summary.number(&format!("timing.{name}"));
    assert!(
        counted("decisions_held") >= 1 && counted("decisions_refused") >= 3,
        "{end}"
    );
    let kept = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(kept.digest(), summary.digest());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_late_answer_is_not_taken_for_another_question() {
    let run = Decided::start("-P 2 --decision-timeout 300ms --on-undecided hold");
    let rogue = Rogue::at(&run).await;
    let mut slept = 0;
    rogue
        .serve(|question, asked| {
            if asked["tti"] == 60 && slept < 1 {
                slept += 1;
                std::thread::sleep(Duration::from_millis(900));
            }
            // What comes too late has nobody who waits for it.
            let late = question.answer(rogue.idle(asked).to_string().into_bytes(), Form::Json);
            let _nobody_waits = late.is_err();
            asked["tti"] != 399
        })
        .await;
    let (folder, end) = run.finish();
    assert!(end.is_success(), "{end}");
    let summary = end.summary();
    assert!(summary.number("timing.decisions_held") >= 1, "{end}");
    let kept = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(kept.digest(), summary.digest());
}

#[tokio::test(flavor = "multi_thread")]
async fn who_has_not_the_key_decides_nothing() {
    let (transcript, digest) = own("age-index", &[]);
    let run = Decided::start("-P 2 --pace 2ms");
    let bus = run.bus().await;
    let stranger = Introduction {
        name: "a stranger".to_owned(),
        key: Some(Secret::new([7; 16])),
        form: Form::Json,
    };
    let mut strange = |_: &Asked| Answer::Wake(Vec::new());
    let greeting = client::decide(&bus, &stranger, &mut strange);
    let said = async {
        while !run.process.stderr().contains("does not show the run's key") {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let (refused, ()) = tokio::join!(greeting, said);
    let refused = refused.expect_err("he is told").to_string();
    assert!(refused.contains("does not show the run's key"), "{refused}");
    // He stays, and answers what others are asked.
    let id = std::sync::Mutex::new(String::new());
    let forger = Bus::connect(&run.endpoint, run.run.parse().expect("a name"), PATIENCE)
        .await
        .expect("it listens");
    let questions = forger.stand_at_policy_port().expect("a queryable");
    let forging = async {
        while let Some(question) = questions.next().await {
            let Ok(asked) = question.form.decode::<Asked>(&question.payload) else {
                continue;
            };
            id.lock().expect("one thread").clone_from(&asked.to);
            let forged = Reply {
                wake: Some(Vec::new()),
                ..Reply::to(&asked.head, &asked.to, "")
            };
            let _gone = question.answer(question.form.encode(&forged), question.form).is_err();
        }
    };
    tokio::select! {
        decided = run.decide(Form::Json, |asked| answer(&transcript, asked)) => assert!(decided >= 400),
        () = forging => panic!("the forger's session has ended"),
    }
    assert!(!id.lock().expect("one thread").is_empty(), "he heard questions");
    let (_, end) = run.finish();
    assert!(end.is_success(), "{end}");
    assert_eq!(end.summary().digest(), digest);
}

#[test]
fn nobody_who_decides_is_named_and_waited_for_as_told() {
    let run = Decided::start("-P 1 --decision-timeout 1s");
    let (_, end) = run.finish();
    assert!(
        end.code() == Some(1) && end.stderr.contains("nobody decides at reveille/"),
        "{end}"
    );

    let two = "up -n 30 -k 2 -p external --out out -P 1 --decision-timeout 1s --on-undecided hold";
    let run = Decided::start_in(Folder::new(), two);
    let (_, end) = run.finish();
    assert!(
        end.is_success() && end.summary().number("timing.decisions_held") >= 2,
        "{end}"
    );

    let run = Decided::start("-P 1");
    run.process
        .wait_for_stderr("no decision for 5 s: nobody decides at reveille/");
    run.process.signal(Signal::INT);
    let (folder, end) = run.finish();
    assert_eq!(end.code(), Some(130), "{end}");
    // It can be gone on with, and told how long to wait.
    let end = folder.run("up --resume out -P 1 --decision-timeout 200ms");
    assert!(
        end.code() == Some(1) && end.stderr.contains("no decision for TTI 0"),
        "{end}"
    );
}

#[test]
fn a_command_that_decides_ends_with_the_run_and_the_run_with_it() {
    let folder = Folder::new();
    let script = folder.write(
        "policy.sh",
        "echo told \"$REVEILLE_RUN\" >&2\ntest -n \"$REVEILLE_KEY\" || exit 3\nexit 4\n",
    );
    let command = |name: &str, policy: &str| {
        let mut command = folder.command(&format!("up {SMALL} -p external -P 2 --out {name} --run {name}"));
        command.args(["--policy-command", policy]);
        Process::start(&mut command)
    };
    let end = command("ends", &format!("sh {}", script.display())).finish();
    assert!(end.code() == Some(1) && end.stderr.contains("told ends"), "{end}");
    assert!(
        end.stderr.contains("the policy process") && end.stderr.contains("exit status: 4"),
        "{end}"
    );
    // One that says nothing is ended with the run.
    let run = command("sleeps", "echo $$ > pid; exec sleep 1000");
    let pid: u32 = wait_until("the command to run", PATIENCE, || {
        std::fs::read_to_string(folder.join("pid")).ok()?.trim().parse().ok()
    });
    run.wait_for_handlers();
    run.signal(Signal::INT);
    assert_eq!(run.finish().code(), Some(130));
    assert!(
        !std::path::Path::new(&format!("/proc/{pid}")).exists(),
        "{pid} lives on"
    );
}

#[test]
fn what_cannot_be_is_refused_before_there_is_a_folder() {
    let folder = Folder::new();
    folder.write("empty.log", "");
    let refused = [
        (format!("run {SMALL} -p external"), "reveille up"),
        (
            format!("up {SMALL} -p knn --policy-command true"),
            "add --policy external",
        ),
        (
            format!("up {SMALL} -p knn --decision-timeout 3s"),
            "add --policy external",
        ),
        (format!("run {SMALL} --policy replay=missing.log"), "missing.log"),
        (
            format!("up {SMALL} --policy replay=missing.log --on-undecided hold"),
            "missing.log",
        ),
        ("sweep --policies external --seeds 1".to_owned(), "external"),
        (
            format!("figures timeline {SMALL} -p external"),
            "external decides nothing itself",
        ),
        (format!("run {SMALL} --policy replay="), "name the inputs.log of a run"),
        (format!("run {SMALL} --policy replay=runtime"), "runtime/inputs.log"),
        (format!("run {SMALL} --policy replay=empty.log"), "nothing is in it"),
    ];
    for (command, why) in refused {
        let end = folder.run(&format!("{command} --out out"));
        assert!(
            matches!(end.code(), Some(1 | 2)) && end.stderr.contains(why),
            "{command}: {end}"
        );
        assert!(folder.list("out").is_empty(), "{command}");
    }
}
