//! Peers that do not keep to the rules: what they send is refused or counted, and changes nothing.

use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, HostId, Tti};
use reveille_common::keys::Keys;
use reveille_common::message::{
    Answer, Clock, Failure, JoinReply, JoinRequest, MessageKind, PlanUpdate, Report, Tick, WakeUp,
};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;
use reveille_tests::process::{Folder, PATIENCE, Summary, ask, free_endpoint, unique_run};

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
    let _bs = folder.waiting_bs(&run, &endpoint, "");
    let bus = peer(&endpoint, &run).await;
    let request = JoinRequest {
        version: "0.0.9".to_owned(),
        count: 1,
        nonce: 1,
    };
    let reply = ask(&bus, &request).await.expect("a reply");
    let JoinReply::Refused(why) = reply else {
        panic!("{reply:?}")
    };
    assert!(
        why.contains("0.0.9") && why.contains(env!("CARGO_PKG_VERSION")),
        "{why}"
    );
    let text = codec::encode(&"not a request at all, but a text");
    let reply = bus.ask_raw(bus.keys().of(MessageKind::Join), text, PATIENCE).await;
    let why = reply.expect_err("refused").to_string();
    assert!(why.contains("malformed") || why.contains("bytes follow"), "{why}");
    bus.close().await;
}

/// Payloads that are no message of any kind: nothing, another wire version, too little, too much, endless lengths,
/// noise.
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
    let mut all: Vec<String> = MessageKind::ALL.iter().map(|&kind| keys.of(kind)).collect();
    all.extend(
        [0, 7, 29, 30, u32::MAX]
            .into_iter()
            .flat_map(|j| [MessageKind::Wake, MessageKind::Report, MessageKind::Answer].map(|kind| keys.to(kind, j))),
    );
    all.extend([format!("{}/x", keys.of(MessageKind::Answer)), keys.tap()]);
    folder.clock(&run, "resume");
    for payload in garbage() {
        for key in &all {
            bus.put_raw(key, payload.clone()).expect("sent");
        }
        for kind in [MessageKind::Join, MessageKind::Ready, MessageKind::Control] {
            let question = codec::encode(&(&payload, "and more"));
            let reply = bus.ask_raw(keys.of(kind), question, Duration::from_secs(5)).await;
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
            views: false,
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
        views: None,
    };
    let ledgers = vec![(DeviceId(0), Ledger::default())];
    let last = Answer::Final {
        host: HostId(0),
        ledgers,
    };
    let mut all: Vec<(String, Vec<u8>)> = clock
        .iter()
        .map(|c| (keys.typed::<Clock>(()), codec::encode(c)))
        .collect();
    all.push((keys.typed::<PlanUpdate>(()), codec::encode(&plan)));
    all.push((
        keys.typed::<WakeUp>(DeviceId(0)),
        codec::encode(&WakeUp { tti: Tti(u64::MAX) }),
    ));
    for (key, report) in [
        (9999, report(9999, 0.5)),
        (3, report(4, 0.5)),
        (3, report(3, f64::NAN)),
        (3, report(3, 7.0)),
    ] {
        all.push((keys.typed::<Report>(DeviceId(key)), codec::encode(&report)));
    }
    for (key, answer) in [
        (0, done(0, 1000, 1)),
        (0, done(1, 0, 1)),
        (9, done(9, 0, 1)),
        (0, done(0, 0, u64::MAX)),
        (0, last),
    ] {
        all.push((keys.typed::<Answer>(HostId(key)), codec::encode(&answer)));
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
    // Past the TTIs that some of them name: at their time nobody could tell those from the base station's own.
    folder.clock(&run, "run-to 10");
    folder.wait_for_tti(&run, 10);
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
