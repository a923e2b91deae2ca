//! Hostile peers: garbage and forged messages of a host that was admitted and knows the run's secret, and requests of
//! another version or without the run's key. The digest equals the digest of `reveille run`.
//!
//! The base station drops forged messages to it because of their revoked credential and counts them
//! (`bs/src/server/subscriptions.rs`), so it never checks their values: `bs/src/server/roster.rs` tests these checks.
//! The access rules of `common/src/bus/access.rs` stop forged messages to hosts. `tests/untrusted_clients/` tests
//! clients without the secret. A new kind of message needs an entry in [`forged_messages`].

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, EventId, HostId, Tti};
use reveille_common::keys::KeyExprs;
use reveille_common::message::{
    ActRequest, BusCredentials, Change, ClockCommand, ClockMessage, DeviceRange, FailedTransmission, GrantMessage,
    HostAnswer, HostOffer, JoinReply, JoinRequest, MessageKind, PlanUpdate, Report, UnableDetectors, WakeUp,
};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::secret::{HostCredential, Secret};
use reveille_common::totals::{DeviceTotals, Ledger};
use reveille_common::units::Energy;
use reveille_tests::process::{PATIENCE, Process, SummaryJson, TestFolder, ask, free_endpoint, unique_run};

use crate::router::Router;

/// Opens a bus session for a hostile peer.
async fn connect_peer(endpoint: &str, run: &str) -> Bus {
    let run = run.parse().expect("a run name");
    Bus::connect(endpoint, run, PATIENCE)
        .await
        .expect("the base station listens")
}

/// Creates a peer that was admitted as host 0, received the run's secret, and left before the run began. It knows all
/// keys, but its credential is no longer valid. Call it before any other host joins.
async fn revoked_host(endpoint: &str, run: &str) -> (Bus, HostCredential) {
    let bus = connect_peer(endpoint, run).await;
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        offer: HostOffer::AtMost(1),
        nonce: 99,
        name: "a revoked host".to_owned(),
    };
    let reply = ask(&bus, &request).await.expect("a reply");
    let JoinReply::Welcome(assignment) = reply else {
        panic!("{reply:?}")
    };
    let BusCredentials { credential, secret } = assignment.credentials;
    let bus = bus.with_secret(secret);
    drop(
        bus.declare_alive(bus.key_exprs().host_liveliness(credential))
            .expect("declared"),
    );
    (bus, credential)
}

/// A run with a [`revoked_host`].
struct AttackedRun {
    bs: Process,
    /// Two device processes, hosts 1 and 2.
    hosts: [Process; 2],
    /// Session and credential of the revoked host.
    bus: Bus,
    credential: HostCredential,
    /// The router to which the hosts and the revoked host connect, if any.
    router: Option<Router>,
}

/// Starts a paused run of 30 devices, with a TTI every 3 ms and the run folder `out`; hosts connect to the base station
/// or to a router.
async fn start_attacked_run(folder: &TestFolder, run: &str, ttis: u32, has_router: bool) -> AttackedRun {
    let endpoint = free_endpoint();
    let pace = "--pace 3ms --paused --out out";
    let bs = folder.start(&format!("bs -n 30 -k {ttis} {pace} --run {run} --listen {endpoint}"));
    bs.wait_for_stderr("waiting for 30 devices");
    let router = has_router.then(|| Router::start(folder, run, &endpoint));
    let endpoint = router.as_ref().map_or(endpoint, |router| router.endpoint.clone());
    let (bus, credential) = revoked_host(&endpoint, run).await;
    bs.wait_for_stderr("left before the run began");
    let hosts = [15, 15].map(|count| {
        let host = folder.start(&format!("device --connect {endpoint} --run {run} --count {count}"));
        host.wait_for_stderr("joined");
        host
    });
    folder.wait_for_tti(run, 0);
    AttackedRun {
        bs,
        hosts,
        bus,
        credential,
        router,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_join_request_of_another_version_or_format_is_refused() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("version"), free_endpoint());
    let _bs = folder.start_waiting_bs(&run, &endpoint, "");
    let bus = connect_peer(&endpoint, &run).await;
    let request = JoinRequest {
        version: "0.0.9".to_owned(),
        offer: HostOffer::AtMost(1),
        nonce: 1,
        name: String::new(),
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
    let reply = bus
        .query_raw_without_secret(bus.key_exprs().base_key(MessageKind::Join), text, PATIENCE)
        .await;
    let why = reply.expect_err("refused").to_string();
    assert!(why.contains("malformed") || why.contains("bytes follow"), "{why}");
    bus.close().await;
}

/// Returns payloads that are not valid messages: empty, of another wire version, truncated, too long, with a length
/// beyond the end, and noise.
fn invalid_payloads() -> Vec<Vec<u8>> {
    // The high bytes of multiples of Knuth's hash constant look random.
    let noise: Vec<u8> = (0..4096_u32)
        .map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8)
        .collect();
    let with_version = |body: &[u8]| [&[codec::WIRE_VERSION][..], body].concat();
    vec![
        vec![],
        vec![0],
        vec![2, 0, 0],
        vec![255; 64],
        vec![codec::WIRE_VERSION],
        with_version(&[255; 4]),
        // In the codec, 253 announces an integer of eight bytes, such as the length of a list: here 2^64 - 1.
        with_version(&[&[0, 0, 253][..], &[255; 8]].concat()),
        with_version(&[0; 200]),
        with_version(&noise),
        with_version(&vec![1; 1 << 16]),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn invalid_payloads_on_every_key_change_nothing() {
    let (folder, run) = (TestFolder::new(), unique_run("invalid"));
    let expected = folder.summary("run -n 30 -k 1200");
    let attacked = start_attacked_run(&folder, &run, 1200, false).await;
    let AttackedRun {
        bs,
        hosts,
        bus,
        credential,
        ..
    } = attacked;
    let tail = folder.start(&format!("inspect tail --run {run}"));
    let keys = bus.key_exprs();
    let mut all_keys: Vec<String> = MessageKind::ALL.iter().map(|&kind| keys.base_key(kind)).collect();
    // Devices and hosts that exist and that do not.
    for number in [0, 7, 29, 30, u32::MAX] {
        let other_host = HostCredential {
            host: HostId(number),
            ..credential
        };
        all_keys.push(keys.wake(HostId(1), DeviceId(number)));
        all_keys.extend([MessageKind::Report, MessageKind::Answer].map(|kind| keys.uplink(kind, other_host)));
    }
    all_keys.extend([MessageKind::Clock, MessageKind::Plan].map(|kind| keys.to_all_hosts(kind)));
    all_keys.extend([format!("{}/x/y", keys.base_key(MessageKind::Answer)), keys.tap()]);
    folder.clock(&run, "resume");
    for payload in invalid_payloads() {
        for key in &all_keys {
            bus.put_raw(key, payload.clone()).expect("sent");
        }
        for kind in [
            MessageKind::Join,
            MessageKind::Ready,
            MessageKind::Control,
            MessageKind::Act,
        ] {
            let request = codec::encode(&(&payload, "and more"));
            let reply = bus
                .query_raw_without_secret(keys.base_key(kind), request, Duration::from_secs(5))
                .await;
            assert!(reply.is_err(), "{kind:?}");
        }
    }
    bus.close().await;
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    assert!(!finished.stderr.contains("panicked"), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    assert!(summary.number("timing.malformed_messages") > 0, "{summary:?}");
    let tail = tail.finish();
    assert!(tail.is_success() && !tail.stderr.contains("panicked"), "{tail}");
    for host in hosts {
        let host = host.finish();
        assert!(
            host.is_success() && !host.stderr.contains("dropped a malformed payload"),
            "{host}"
        );
    }
}

/// Returns clock messages that decode. While TTI `tti` is open, hosts expect none of them, except the first in TTI 0.
fn forged_clock(tti: u64) -> [ClockMessage; 5] {
    let grant = |first, last| {
        let stimulus = Some(Stimulus {
            event: EventId(1),
            epicentre: Point::new(5.0, 5.0),
        });
        let (first, last) = (Tti(first), Tti(last));
        ClockMessage::Grant(GrantMessage {
            first,
            last,
            stimulus,
            stimulus_last: last,
            wants_totals: true,
            wants_views: false,
            plan_from: Tti(0),
            plan_count: 0,
            change_count: 0,
        })
    };
    [
        grant(0, 0),
        grant(u64::MAX / 2, u64::MAX),
        grant(tti, 5),
        ClockMessage::CollectLedgers(Tti(3)),
        ClockMessage::CollectLedgers(Tti(u64::MAX)),
    ]
}

/// Returns messages that decode, each with its key: to all hosts or single ones, and from hosts that exist or not, with
/// possible and impossible values for TTI `tti`.
fn forged_messages(keys: &KeyExprs, credential: HostCredential, tti: u64) -> Vec<(String, Vec<u8>)> {
    let overlong_cycle = DutyCycle {
        t_on: u32::MAX,
        t_drx: u32::MAX,
        offset: 0,
    };
    let plan = PlanUpdate {
        from: Tti(0),
        plan: Plan::Periodic(vec![overlong_cycle; 30]),
    };
    let report = |device, information| Report {
        device: DeviceId(device),
        tti: Tti(tti),
        information,
        battery: Energy::ZERO,
    };
    let grant_done = |host, report_count, drained_micro| HostAnswer::GrantDone {
        host: HostId(host),
        tti: Tti(tti),
        reports: report_count,
        failures: vec![FailedTransmission {
            device: DeviceId(0),
            drained_energy: Energy::from_micro(drained_micro),
        }],
        unable: UnableDetectors::default(),
        totals: Some(DeviceTotals::default()),
        views: None,
    };
    let ledgers = vec![(DeviceId(0), Ledger::default())];
    let final_ledgers = HostAnswer::Ledgers {
        host: HostId(0),
        ledgers,
    };
    let downlink_keys = |kind| {
        [
            keys.to_all_hosts(kind),
            keys.to_all_hosts_at(kind, HostId(1)),
            keys.base_key(kind),
        ]
    };
    let mut messages: Vec<(String, Vec<u8>)> = Vec::new();
    for key in downlink_keys(MessageKind::Clock) {
        messages.extend(forged_clock(tti).map(|clock| (key.clone(), codec::encode(&clock))));
    }
    messages.extend(downlink_keys(MessageKind::Plan).map(|key| (key, codec::encode(&plan))));
    for wake_tti in [tti, u64::MAX] {
        let wake_up = codec::encode(&WakeUp { tti: Tti(wake_tti) });
        messages.extend([1, 2].map(|host| (keys.wake(HostId(host), DeviceId(0)), wake_up.clone())));
    }
    let credential_of = |host| HostCredential {
        host: HostId(host),
        ..credential
    };
    for (host, report) in [
        (1, report(9999, 0.5)),
        (1, report(4, 0.5)),
        (2, report(3, f64::NAN)),
        (0, report(3, 0.7)),
    ] {
        messages.push((
            keys.uplink(MessageKind::Report, credential_of(host)),
            codec::encode(&report),
        ));
    }
    for (host, answer) in [
        (1, grant_done(1, 1000, 1)),
        (1, grant_done(1, 0, 0)),
        (9, grant_done(9, 0, 1)),
        (0, grant_done(0, 0, u64::MAX)),
        (0, final_ledgers),
    ] {
        messages.push((
            keys.uplink(MessageKind::Answer, credential_of(host)),
            codec::encode(&answer),
        ));
    }
    messages
}

/// Messages for the open TTI from a peer that knows all keys but has no valid credential change nothing, and the peer
/// receives no reports, whose keys have the tokens of hosts.
async fn check_forged_messages(has_router: bool) {
    let (folder, run) = (TestFolder::new(), unique_run("forged"));
    let expected = folder.summary("run -n 30 -k 600");
    let attacked = start_attacked_run(&folder, &run, 600, has_router).await;
    let AttackedRun {
        bs,
        hosts,
        bus,
        credential,
        router,
    } = attacked;
    let received_reports = Arc::new(AtomicU32::new(0));
    let report_counter = Arc::clone(&received_reports);
    // A separate session: a session receives its own messages.
    let spy = connect_peer(bus.endpoint(), &run).await;
    let _spied = spy
        .subscribe_raw(bus.key_exprs().uplinks(MessageKind::Report), move |_| {
            report_counter.fetch_add(1, Ordering::Relaxed);
        })
        .expect("subscribed");
    // Replies to operators, which show the key of the run.
    let _served = bus
        .serve_with_secret(|_: ClockCommand, _| Err("forged".to_owned()))
        .expect("served");
    let _alive = bus.declare_alive(bus.key_exprs().bs_liveliness()).expect("declared");
    if let Some(router) = &router {
        let status = folder.run(&format!("clock status --run {run} --connect {}", router.endpoint));
        assert!(status.is_success(), "{status}");
    }
    folder.clock(&run, "resume");
    for tti in 0..600 {
        for (key, payload) in forged_messages(bus.key_exprs(), credential, tti) {
            bus.put_raw(&key, payload).expect("sent");
        }
        // Close to the pace of 3 ms, so that the forged messages stay near the open TTI.
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    bus.close().await;
    let finished = bs.finish();
    assert!(finished.is_success(), "{finished}");
    assert!(!finished.stderr.contains("panicked"), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    assert!(summary.number("timing.unexpected_messages") > 0, "{summary:?}");
    assert!(hosts.into_iter().all(|host| host.finish().is_success()));
    assert_eq!(received_reports.load(Ordering::Relaxed), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn forged_messages_change_nothing() {
    check_forged_messages(false).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn forged_messages_behind_a_router_change_nothing() {
    check_forged_messages(true).await;
}

/// A client without the run's key can neither stop its clock nor act on its devices nor run them.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_without_the_key_cannot_command_or_join() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("keyless"), free_endpoint());
    let up = folder.start(&format!(
        "up -P 2 -n 30 -k 300 --pace 3ms --paused --run {run} --listen {endpoint} --out out"
    ));
    folder.wait_for_tti(&run, 0);
    let bus = connect_peer(&endpoint, &run).await;
    let status = ask(&bus, &ClockCommand::Status)
        .await
        .expect("any client may read the status");
    assert!(status.paused);
    for key in [None, Some(Secret::new([0; 16]))] {
        let reply = ask(&bus.with_key(key), &ClockCommand::Resume).await;
        let why = reply.expect_err("a command without the run's key").to_string();
        assert!(why.contains("needs the run's key"), "{why}");
        let device = DeviceRange {
            first: DeviceId(3),
            count: 1,
        };
        let action = ActRequest {
            at: None,
            changes: vec![Change::Fail(device)],
        };
        let why = ask(&bus.with_key(key), &action)
            .await
            .expect_err("an action without the run's key");
        assert!(why.to_string().contains("needs the run's key"), "{why}");
    }
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        offer: HostOffer::AtMost(30),
        nonce: 5,
        name: String::new(),
    };
    let reply = ask(&bus, &request).await.expect("a reply");
    assert!(
        matches!(&reply, JoinReply::Refused(why) if why.contains("key")),
        "{reply:?}"
    );
    bus.close().await;
    folder.clock(&run, "resume");
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
}
