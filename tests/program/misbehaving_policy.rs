//! Policy processes that reply twice, late, with invalid decisions, too much, or for another process. The run reports
//! it, and ends or keeps the plan as configured. A replay of its logged decisions has its digest. The limits that these
//! tests exceed are constants of `bs/src/server/policy_port/mod.rs`. `policy_port.rs` tests correct processes.

use std::time::Duration;

use reveille_bs::policy::external::Decision;
use reveille_bs::policy::external::wire::{DecisionReply, DecisionRequest};
use reveille_bs::server::policy_port::client::{self, ClientIdentity};
use reveille_common::bus::{Bus, PortRequest};
use reveille_common::encoding::Encoding;
use reveille_common::secret::Secret;
use reveille_tests::external_policy::{ExternallyDecidedRun, MisbehavingPolicy, answer_from, run_built_in, send_reply};
use reveille_tests::process::PATIENCE;
use serde_json::{Value, json};

/// Last TTI of every run here: [`ExternallyDecidedRun::start`] adds `-n 30 -k 400`. At least one answer, the plan,
/// belongs to each TTI.
const LAST_TTI: u64 = 399;

/// Makes a valid answer invalid.
type CorruptAnswer = fn(&mut Value);
/// Replies to a decision request in another way than with the given valid answer.
type ReplyOtherwise = fn(&PortRequest, Value);

/// An untrusted client answers every request a hundred times, with more bytes than are accepted or invalid JSON.
#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_answers_changes_no_result() {
    let (transcript, digest) = run_built_in("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 2");
    let flood = run.bus().await;
    let requests = flood.serve_policy_port().expect("a queryable");
    let flooding = tokio::spawn(async move {
        // The first is longer than an accepted answer for 30 devices, which has about 6 kB; the second is invalid JSON.
        let (long, short) = (vec![b'['; 300_000], vec![b'['; 500]);
        while let Some(request) = requests.next().await {
            for payload in [&long, &short].into_iter().cycle().take(100) {
                let _run_ended = request.reply(payload.clone(), Encoding::Json).is_err();
            }
            let _run_ended = request.reply_error("flooded").is_err();
        }
    });
    let answer_count = run
        .decide(Encoding::Cbor, |request| answer_from(&transcript, request))
        .await;
    flooding.abort();
    let (_, finished) = run.finish();
    assert!(
        finished.is_success() && answer_count >= 400,
        "{answer_count}: {finished}"
    );
    assert_eq!(finished.summary().digest(), digest);
    // At most `MAX_WARNINGS` of 20, and the usual notes.
    assert!(finished.stderr.lines().count() < 40, "{finished}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_repeated_answer_counts_once() {
    let run = ExternallyDecidedRun::start("-P 2");
    let rogue = MisbehavingPolicy::connect(&run).await;
    rogue
        .serve(|port_request, request| {
            for _ in 0..2 {
                send_reply(port_request, &rogue.idle_answer(request));
            }
            request["tti"] != LAST_TTI
        })
        .await;
    let (_, finished) = run.finish();
    assert!(
        finished.is_success() && finished.stderr.contains("answered twice"),
        "{finished}"
    );
    assert!(finished.summary().number("timing.decisions_refused") > 0, "{finished}");
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_answers_end_the_run_or_are_dropped() {
    let invalid_answers: [(&str, CorruptAnswer); 6] = [
        ("no device 30", |answer| answer["sense"] = json!([30])),
        ("one of", |answer| answer["action"] = json!([0])),
        ("unknown field", |answer| answer["senses"] = json!([1])),
        ("(seq, tti, stage)", |answer| answer["seq"] = json!(7)),
        ("(seq, tti, stage)", |answer| answer["tti"] = json!(7)),
        ("(seq, tti, stage)", |answer| answer["stage"] = json!("wake")),
    ];
    for (why, corrupt) in invalid_answers {
        let run = ExternallyDecidedRun::start("-P 0");
        let rogue = MisbehavingPolicy::connect(&run).await;
        let mut refusals_received = 0;
        rogue
            .serve(|port_request, request| {
                let mut answer = rogue.idle_answer(request);
                corrupt(&mut answer);
                send_reply(port_request, &answer);
                refusals_received += u32::from(request["refused"].is_string());
                true
            })
            .await;
        let (_, finished) = run.finish();
        assert_eq!(finished.code(), Some(1), "{finished}");
        // `MAX_INVALID_ANSWERS`.
        assert!(
            finished.stderr.contains("3 invalid answers") && finished.stderr.contains(why),
            "{finished}"
        );
        // The third invalid answer ends the run, without another request.
        assert_eq!(refusals_received, 2, "reasons that the policy received");
    }
    // Any client could have sent these answers, so they must not count as invalid and end the run.
    let unattributed: [(&str, ReplyOtherwise); 3] = [
        ("dropped an answer", |port_request, _| {
            port_request.reply(b"{".to_vec(), Encoding::Json).expect("answered");
        }),
        ("dropped an answer", |port_request, mut answer| {
            answer["id"] = json!("another");
            send_reply(port_request, &answer);
        }),
        ("returned an error: no time", |port_request, _| {
            port_request.reply_error("no time").expect("answered");
        }),
    ];
    for (why, reply_otherwise) in unattributed {
        let run = ExternallyDecidedRun::start("-P 0 --decision-timeout 1s");
        let rogue = MisbehavingPolicy::connect(&run).await;
        rogue
            .serve(|port_request, request| {
                reply_otherwise(port_request, rogue.idle_answer(request));
                true
            })
            .await;
        let (_, finished) = run.finish();
        assert!(
            finished.code() == Some(1) && finished.stderr.contains("no decision for TTI 0"),
            "{finished}"
        );
        assert_eq!(
            finished.stderr.matches(why).count(),
            1,
            "the warning appears once: {finished}"
        );
    }
    let run = ExternallyDecidedRun::start("-P 2 --on-undecided hold");
    let rogue = MisbehavingPolicy::connect(&run).await;
    rogue
        .serve(|port_request, request| {
            let mut answer = rogue.idle_answer(request);
            if request["tti"] == 50 {
                // The next plan must begin after this TTI.
                answer["next"] = json!(3);
            }
            send_reply(port_request, &answer);
            request["tti"] != LAST_TTI
        })
        .await;
    let (folder, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = finished.summary();
    let count = |name: &str| summary.number(&format!("timing.{name}"));
    assert!(
        count("decisions_held") >= 1 && count("decisions_refused") >= 3,
        "{finished}"
    );
    let replayed = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(replayed.digest(), summary.digest());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_late_answer_does_not_count_for_another_request() {
    let run = ExternallyDecidedRun::start("-P 2 --decision-timeout 300ms --on-undecided hold");
    let rogue = MisbehavingPolicy::connect(&run).await;
    let mut has_slept = false;
    rogue
        .serve(|port_request, request| {
            if request["tti"] == 60 && !has_slept {
                has_slept = true;
                // Three times the decision timeout.
                std::thread::sleep(Duration::from_millis(900));
            }
            // The query of a late answer has timed out, so its reply may fail.
            let _timed_out = port_request
                .reply(rogue.idle_answer(request).to_string().into_bytes(), Encoding::Json)
                .is_err();
            request["tti"] != LAST_TTI
        })
        .await;
    let (folder, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = finished.summary();
    assert!(summary.number("timing.decisions_held") >= 1, "{finished}");
    let replayed = folder.summary("run --policy replay=out/inputs.log");
    assert_eq!(replayed.digest(), summary.digest());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_policy_process_with_a_wrong_key_cannot_decide() {
    let (transcript, digest) = run_built_in("age-index", &[]);
    let run = ExternallyDecidedRun::start("-P 2 --pace 2ms");
    let bus = run.bus().await;
    let wrong_key_identity = ClientIdentity {
        name: "a stranger".to_owned(),
        run_key: Some(Secret::new([7; 16])),
        encoding: Encoding::Json,
    };
    let mut wrong_key_policy = |_: &DecisionRequest| Decision::Wake(Vec::new());
    let wrong_key_client = client::serve_decisions(&bus, &wrong_key_identity, &mut wrong_key_policy);
    let warning_logged = async {
        while !run.process.stderr().contains("does not show the run's key") {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let refusal_and_warning = async { tokio::join!(wrong_key_client, warning_logged) };
    let (refused, ()) = tokio::time::timeout(PATIENCE, refusal_and_warning)
        .await
        .expect("a refusal and a warning");
    let refused = refused.expect_err("the client gets an error").to_string();
    assert!(refused.contains("does not show the run's key"), "{refused}");
    // A forger answers requests to another process. They contain the id of that process.
    let forged_id = std::sync::Mutex::new(String::new());
    let forger = Bus::connect(&run.endpoint, run.name.parse().expect("a name"), PATIENCE)
        .await
        .expect("it listens");
    let requests = forger.serve_policy_port().expect("a queryable");
    let forging = async {
        while let Some(request) = requests.next().await {
            let Ok(decision_request) = request.encoding.decode::<DecisionRequest>(&request.payload) else {
                continue;
            };
            forged_id.lock().expect("one thread").clone_from(&decision_request.to);
            let forged = DecisionReply {
                wake: Some(Vec::new()),
                ..DecisionReply::for_request(&decision_request.head, &decision_request.to, "")
            };
            let _run_ended = request
                .reply(request.encoding.encode(&forged), request.encoding)
                .is_err();
        }
    };
    tokio::select! {
        answer_count = run.decide(Encoding::Json, |request| answer_from(&transcript, request)) => {
            assert!(answer_count >= 400);
        }
        () = forging => panic!("the forger's session has ended"),
    }
    assert!(
        !forged_id.lock().expect("one thread").is_empty(),
        "the forger received no request"
    );
    let (_, finished) = run.finish();
    assert!(finished.is_success(), "{finished}");
    assert_eq!(finished.summary().digest(), digest);
}
