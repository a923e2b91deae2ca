//! Policy processes that answer twice, late, with nonsense, too much, or for another process. The run reports it and
//! waits or ends as configured, and nothing hangs.

use std::time::Duration;

use reveille_bs::policy::external::Decision;
use reveille_bs::policy::external::wire::{DecisionReply, DecisionRequest};
use reveille_bs::server::policy_port::client::{self, ClientIdentity};
use reveille_common::bus::{Bus, PortRequest};
use reveille_common::encoding::Encoding;
use reveille_common::secret::Secret;
use reveille_tests::external_policy::{ExternallyDecidedRun, MisbehavingPolicy, answer, own, say};
use reveille_tests::process::PATIENCE;
use serde_json::{Value, json};

/// Function that corrupts an answer.
type CorruptReply = fn(&mut Value);
/// Function that answers a decision request in some other way than with the given answer.
type ReplyAction = fn(&PortRequest, Value);

/// Strangers answer every query with more data than a client accepts.
#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_answers_changes_no_result() {
    let (transcript, digest) = own("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 2");
    let flood = run.bus().await;
    let questions = flood.serve_policy_port().expect("a queryable");
    let flooding = tokio::spawn(async move {
        let (long, short) = (vec![b'['; 300_000], vec![b'['; 500]);
        while let Some(question) = questions.next().await {
            for payload in [&long, &short].into_iter().cycle().take(100) {
                let _gone = question.reply(payload.clone(), Encoding::Json).is_err();
            }
            let _gone = question.reply_error("flooded").is_err();
        }
    });
    let decided = run.decide(Encoding::Cbor, |asked| answer(&transcript, asked)).await;
    flooding.abort();
    let (_, end) = run.finish();
    assert!(end.is_success() && decided >= 400, "{decided}: {end}");
    assert_eq!(end.summary().digest(), digest);
    assert!(end.stderr.lines().count() < 40, "{end}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_that_comes_twice_counts_once() {
    let run = ExternallyDecidedRun::start("-P 2");
    let rogue = MisbehavingPolicy::at(&run).await;
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
async fn invalid_decisions_are_reported_and_end_the_run_or_are_dropped() {
    let nonsense: [(&str, CorruptReply); 6] = [
        ("no device 30", |answer| answer["sense"] = json!([30])),
        ("one of", |answer| answer["action"] = json!([0])),
        ("unknown field", |answer| answer["senses"] = json!([1])),
        ("(seq, tti, stage)", |answer| answer["seq"] = json!(7)),
        ("(seq, tti, stage)", |answer| answer["tti"] = json!(7)),
        ("(seq, tti, stage)", |answer| answer["stage"] = json!("wake")),
    ];
    for (why, spoil) in nonsense {
        let run = ExternallyDecidedRun::start("-P 0");
        let rogue = MisbehavingPolicy::at(&run).await;
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
            end.stderr.contains("3 invalid answers") && end.stderr.contains(why),
            "{end}"
        );
        assert_eq!(told, 2, "the policy receives the errors");
    }
    // The sender of these answers is unknown: a stranger could otherwise end the run with them.
    let strange: [(&str, ReplyAction); 3] = [
        ("dropped an answer", |question, _| {
            question.reply(b"{".to_vec(), Encoding::Json).expect("answered");
        }),
        ("dropped an answer", |question, mut answer| {
            answer["id"] = json!("another");
            say(question, &answer);
        }),
        ("returned an error: no time", |question, _| {
            question.reply_error("no time").expect("answered");
        }),
    ];
    for (why, act) in strange {
        let run = ExternallyDecidedRun::start("-P 0 --decision-timeout 1s");
        let rogue = MisbehavingPolicy::at(&run).await;
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
        assert_eq!(end.stderr.matches(why).count(), 1, "the warning appears once: {end}");
    }
    let run = ExternallyDecidedRun::start("-P 2 --on-undecided hold");
    let rogue = MisbehavingPolicy::at(&run).await;
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
async fn a_late_answer_does_not_answer_another_request() {
    let run = ExternallyDecidedRun::start("-P 2 --decision-timeout 300ms --on-undecided hold");
    let rogue = MisbehavingPolicy::at(&run).await;
    let mut slept = 0;
    rogue
        .serve(|question, asked| {
            if asked["tti"] == 60 && slept < 1 {
                slept += 1;
                std::thread::sleep(Duration::from_millis(900));
            }
            // No query waits for a late answer.
            let late = question.reply(rogue.idle(asked).to_string().into_bytes(), Encoding::Json);
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
async fn a_policy_without_the_key_decides_nothing() {
    let (transcript, digest) = own("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 2 --pace 2ms");
    let bus = run.bus().await;
    let stranger = ClientIdentity {
        name: "a stranger".to_owned(),
        run_key: Some(Secret::new([7; 16])),
        encoding: Encoding::Json,
    };
    let mut strange = |_: &DecisionRequest| Decision::Wake(Vec::new());
    let greeting = client::serve_decisions(&bus, &stranger, &mut strange);
    let said = async {
        while !run.process.stderr().contains("does not show the run's key") {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let (refused, ()) = tokio::join!(greeting, said);
    let refused = refused.expect_err("the client gets an error").to_string();
    assert!(refused.contains("does not show the run's key"), "{refused}");
    // The forger stays, and answers requests that are for others.
    let id = std::sync::Mutex::new(String::new());
    let forger = Bus::connect(&run.endpoint, run.run.parse().expect("a name"), PATIENCE)
        .await
        .expect("it listens");
    let questions = forger.serve_policy_port().expect("a queryable");
    let forging = async {
        while let Some(question) = questions.next().await {
            let Ok(asked) = question.encoding.decode::<DecisionRequest>(&question.payload) else {
                continue;
            };
            id.lock().expect("one thread").clone_from(&asked.to);
            let forged = DecisionReply {
                wake: Some(Vec::new()),
                ..DecisionReply::for_request(&asked.head, &asked.to, "")
            };
            let _gone = question
                .reply(question.encoding.encode(&forged), question.encoding)
                .is_err();
        }
    };
    tokio::select! {
        decided = run.decide(Encoding::Json, |asked| answer(&transcript, asked)) => assert!(decided >= 400),
        () = forging => panic!("the forger's session has ended"),
    }
    assert!(!id.lock().expect("one thread").is_empty(), "he heard questions");
    let (_, end) = run.finish();
    assert!(end.is_success(), "{end}");
    assert_eq!(end.summary().digest(), digest);
}
