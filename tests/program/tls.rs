//! Mutual TLS: a run over TLS, and clients that it must refuse. Each refused client has a counterpart with a right to
//! do the same, so that no test passes because a link is missing. `docs/security.md` lists the promises; these
//! tests and `hostile_peer.rs` check them.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, SystemTime};

use rcgen::{CertificateParams, DnType, ExtendedKeyUsagePurpose, Issuer, KeyPair};
use reveille_common::bus::{Bus, BusError, DeclarationGuard, Endpoint, Role, TlsFiles};
use reveille_common::codec;
use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{BusCredentials, HostOffer, JoinReply, JoinRequest, MessageKind, Report, WakeUp};
use reveille_common::secret::{HostCredential, Secret};
use reveille_common::units::Energy;
use reveille_tests::process::{PATIENCE, Process, SummaryJson, TestFolder, ask, free_endpoint, unique_run, wait_until};

/// Time for a message to arrive that a rule should stop.
const SETTLING_TIME: Duration = Duration::from_millis(500);
/// Time limit of a connection that must fail. zenoh repeats it meanwhile.
const REFUSAL_PATIENCE: Duration = Duration::from_secs(2);

fn free_tls_endpoint() -> String {
    free_endpoint().replace("tcp/", "tls/")
}

/// Makes certificates in the subfolder `name`.
fn make_certificates(folder: &TestFolder, name: &str) {
    let made = folder.run(&format!("tls init {name}"));
    assert!(made.is_success(), "{made}");
}

fn files(folder: &TestFolder, role: Role) -> TlsFiles {
    TlsFiles::new(&folder.join(&format!("certs/{}", role.name())))
}

/// Connects with `files`.
async fn connect(endpoint: &str, run: &str, files: &TlsFiles, patience: Duration) -> Result<Bus, BusError> {
    let endpoint = Endpoint {
        address: endpoint,
        tls: Some(files),
    };
    Bus::connect(endpoint, run.parse().expect("a run name"), patience).await
}

async fn connect_as(folder: &TestFolder, endpoint: &str, run: &str, role: Role) -> Bus {
    connect(endpoint, run, &files(folder, role), PATIENCE)
        .await
        .expect("a connection with a certificate of the role")
}

/// Starts the base station of a paused run of 30 devices and `ttis` TTIs, with a TTI every 3 ms and the run folder
/// `out`.
fn start_bs(folder: &TestFolder, run: &str, endpoint: &str, ttis: u32) -> Process {
    let pace = "--pace 3ms --paused --out out --tls certs";
    let bs = folder.start(&format!("bs -n 30 -k {ttis} {pace} --run {run} --listen {endpoint}"));
    bs.wait_for_stderr("waiting for 30 devices");
    bs
}

fn start_device(folder: &TestFolder, run: &str, endpoint: &str) -> Process {
    let host = folder.start(&format!(
        "device --connect {endpoint} --run {run} --count 15 --tls certs"
    ));
    host.wait_for_stderr("joined");
    host
}

/// Resumes the paused run and checks that it ends with the digest of `reveille run`, without a lost host. Returns its
/// summary and the log of the base station.
fn finish(folder: &TestFolder, run: &str, ttis: u32, bs: Process, hosts: [Process; 2]) -> (SummaryJson, String) {
    folder.clock(run, "resume");
    let finished = bs.finish();
    assert!(
        finished.is_success() && !finished.stderr.contains("panicked"),
        "{finished}"
    );
    let summary = SummaryJson::read(&folder.join("out"));
    let expected = folder.summary(&format!("run -n 30 -k {ttis}"));
    assert_eq!(summary.digest(), expected.digest());
    assert_eq!(summary.number("timing.losses"), 0, "{summary:?}");
    for host in hosts {
        let host = host.finish();
        assert!(
            host.is_success() && !host.stderr.contains("dropped a malformed payload"),
            "{host}"
        );
    }
    (summary, finished.stderr)
}

#[test]
fn a_run_over_tls_has_the_digest_of_a_run_in_memory() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("tls"), free_tls_endpoint());
    make_certificates(&folder, "certs");
    let bs = start_bs(&folder, &run, &endpoint, 600);
    let first = start_device(&folder, &run, &endpoint);
    // A renewal during the run: later processes have certificates of the same CA.
    let renewed = folder.run("tls init certs --renew");
    assert!(renewed.is_success(), "{renewed}");
    let second = start_device(&folder, &run, &endpoint);
    // Found through the registry, with the folder of the base station.
    let tail = folder.start(&format!("inspect tail --run {run}"));
    tail.wait_for_stderr("connected to run");
    let (_, log) = finish(&folder, &run, 600, bs, [first, second]);
    let tail = tail.finish();
    assert!(tail.is_success() && tail.stdout.lines().count() > 600, "{tail}");
    assert!(!log.contains("refused"), "{log}");
}

/// A TLS client without a certificate, which prints the reason of the refusal. Its handshake ends before the base
/// station's, so only reading shows the refusal.
const WITHOUT_CERTIFICATE: &str = r#"
import socket, ssl, sys
context = ssl.create_default_context(cafile=sys.argv[1])
link = socket.create_connection(("127.0.0.1", int(sys.argv[2])))
with context.wrap_socket(link, server_hostname="localhost") as tls:
    try:
        print("received", tls.recv(1))
    except ssl.SSLError as error:
        print(error.reason)
"#;

/// Writes a certificate of the role `device` that the CA in `certs` signed and that has expired.
fn write_expired_certificate(folder: &TestFolder) -> TlsFiles {
    let ca = TlsFiles::new(&folder.join("certs/ca"));
    let read = |path: &Path| fs::read_to_string(path).expect("a file of `tls init`");
    let ca_key = KeyPair::from_pem(&read(&ca.key)).expect("a key");
    let issuer = Issuer::from_ca_cert_pem(&read(&ca.certificate), ca_key).expect("a CA");
    let mut params = CertificateParams::new(Vec::new()).expect("no names");
    params.distinguished_name.push(DnType::CommonName, Role::Device.name());
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
    params.not_before = (SystemTime::UNIX_EPOCH + Duration::from_hours(24)).into();
    params.not_after = (SystemTime::UNIX_EPOCH + Duration::from_hours(48)).into();
    let key = KeyPair::generate().expect("a key");
    let certificate = params.signed_by(&key, &issuer).expect("signed");
    fs::create_dir_all(folder.join("expired/device")).expect("created");
    let files = TlsFiles::new(&folder.join("expired/device"));
    fs::copy(&ca.certificate, &files.ca).expect("copied");
    fs::write(&files.certificate, certificate.pem()).expect("written");
    fs::write(&files.key, key.serialize_pem()).expect("written");
    fs::set_permissions(&files.key, fs::Permissions::from_mode(0o600)).expect("restricted");
    files
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn clients_without_a_valid_certificate_are_refused() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("strangers"), free_tls_endpoint());
    make_certificates(&folder, "certs");
    make_certificates(&folder, "other");
    let bs = start_bs(&folder, &run, &endpoint, 600);
    let hosts = [(); 2].map(|()| start_device(&folder, &run, &endpoint));
    // Without TLS.
    let plain = endpoint.replace("tls/", "tcp/");
    let refused = folder.run(&format!("device --connect {plain} --run {run} --connect-timeout 2s"));
    assert_eq!(refused.code(), Some(1), "{refused}");
    bs.wait_for_stderr("refused a TLS connection: received corrupt message");
    let mut python = Command::new("python3");
    let port = endpoint.rsplit(':').next().expect("a port");
    python
        .args(["-c", WITHOUT_CERTIFICATE])
        .arg(files(&folder, Role::Bs).ca)
        .arg(port);
    let refused = Process::start(&mut python).finish();
    assert!(refused.stdout.contains("CERTIFICATE_REQUIRED"), "{refused}");
    bs.wait_for_stderr("refused a TLS connection: peer sent no certificates");
    // Expired, of another CA, and of a role of a base station, which may only listen.
    let expired = write_expired_certificate(&folder);
    let foreign = TlsFiles {
        ca: files(&folder, Role::Device).ca,
        ..TlsFiles::new(&folder.join("other/device"))
    };
    for (files, cause) in [
        (expired, "invalid peer certificate: certificate expired"),
        (foreign, "invalid peer certificate: "),
        (files(&folder, Role::Bs), "invalid peer certificate: "),
    ] {
        let refused = connect(&endpoint, &run, &files, REFUSAL_PATIENCE).await;
        assert!(matches!(refused, Err(BusError::ConnectTls { .. })), "{files:?}");
        bs.wait_for_stderr(cause);
    }
    // The command names the cause itself.
    let refused = folder.run(&format!("device --connect {endpoint} --run {run} --tls expired"));
    assert!(refused.stderr.contains("cert.pem: expired on"), "{refused}");
    finish(&folder, &run, 600, bs, hosts);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_refuses_a_base_station_of_another_ca_or_name() {
    let (folder, run) = (TestFolder::new(), unique_run("impostor"));
    make_certificates(&folder, "certs");
    make_certificates(&folder, "other");
    let port = free_tls_endpoint().rsplit_once(':').expect("a port").1.to_owned();
    let listen = format!("tls/0.0.0.0:{port}");
    let _bs = folder.start_waiting_bs(&run, &listen, "--tls certs");
    for (name, ca, is_admitted) in [
        ("localhost", "certs", true),
        ("localhost", "other", false),
        ("127.0.0.2", "certs", false),
    ] {
        let files = TlsFiles {
            ca: folder.join(&format!("{ca}/ca/cert.pem")),
            ..files(&folder, Role::Observer)
        };
        let endpoint = format!("tls/{name}:{port}");
        let patience = if is_admitted { PATIENCE } else { REFUSAL_PATIENCE };
        let connected = connect(&endpoint, &run, &files, patience).await;
        assert_eq!(connected.is_ok(), is_admitted, "{name}, {ca}");
    }
    let renewed = folder.run("tls init certs --renew --name 127.0.0.2");
    assert!(
        renewed.is_success() && renewed.stdout.contains("127.0.0.2"),
        "{renewed}"
    );
}

/// Joins as a host that leaves, and returns its session and credential.
async fn revoked_host(bus: Bus) -> (Bus, HostCredential) {
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        offer: HostOffer::AtMost(1),
        nonce: 99,
        name: "a revoked host".to_owned(),
    };
    let JoinReply::Welcome(assignment) = ask(&bus, &request).await.expect("a reply") else {
        panic!("refused")
    };
    let BusCredentials { credential, secret } = assignment.credentials;
    let bus = bus.with_secret(secret);
    let token = bus.declare_alive(bus.key_exprs().host_liveliness(credential));
    drop(token.expect("declared"));
    (bus, credential)
}

/// Counts the forged messages that arrive at `key` while the guard lives.
fn count_forged(bus: &Bus, key: String) -> (DeclarationGuard, Arc<AtomicU32>) {
    let count = Arc::new(AtomicU32::new(0));
    let counter = Arc::clone(&count);
    let guard = bus.subscribe_raw(key, move |payload| {
        counter.fetch_add(u32::from(payload == b"forged"), Ordering::Relaxed);
    });
    (guard.expect("subscribed"), count)
}

/// A device certificate allows no message of the base station, and no host can send for another. An observer
/// certificate allows no message at all.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn no_role_can_publish_for_another() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("roles"), free_tls_endpoint());
    make_certificates(&folder, "certs");
    let bs = start_bs(&folder, &run, &endpoint, 600);
    let (device, credential) = revoked_host(connect_as(&folder, &endpoint, &run, Role::Device).await).await;
    bs.wait_for_stderr("left before the run began");
    let hosts = [(); 2].map(|()| start_device(&folder, &run, &endpoint));
    let secret = device.key_exprs().member_secret().expect("a member");
    // An observer that knows the secret of the run.
    let observer = connect_as(&folder, &endpoint, &run, Role::Observer)
        .await
        .with_secret(secret);
    // Another device and another observer, which receive what passes.
    let victim = connect_as(&folder, &endpoint, &run, Role::Device)
        .await
        .with_secret(secret);
    let watcher = connect_as(&folder, &endpoint, &run, Role::Observer).await;
    let keys = device.key_exprs().clone();
    let forged_keys = [
        keys.to_all_hosts_at(MessageKind::Plan, HostId(1)),
        keys.to_all_hosts_at(MessageKind::Clock, HostId(1)),
        keys.wake(HostId(1), DeviceId(0)),
    ];
    let received: Vec<_> = forged_keys
        .iter()
        .map(|key| count_forged(&victim, key.clone()))
        .collect();
    let (_tap, tapped) = count_forged(&watcher, keys.tap());
    tokio::time::sleep(SETTLING_TIME).await;
    let wake_up = codec::encode(&WakeUp { tti: Tti(0) });
    for attacker in [&device, &observer] {
        for key in forged_keys.iter().chain([&keys.tap()]) {
            attacker.put_raw(key, b"forged".to_vec()).expect("sent");
        }
        attacker
            .put_raw(&keys.wake(HostId(1), DeviceId(0)), wake_up.clone())
            .expect("sent");
    }
    // Reports for a device of host 1: with the credential of the revoked host, and with an invented one.
    let report = codec::encode(&Report {
        device: DeviceId(4),
        tti: Tti(0),
        information: 0.5,
        battery: Energy::ZERO,
    });
    let invented = HostCredential {
        host: HostId(1),
        token: Secret::new([7; 16]),
    };
    for _ in 0..5 {
        observer
            .put_raw(&keys.uplink(MessageKind::Report, invented), report.clone())
            .expect("sent");
    }
    for sender in [credential, invented] {
        device
            .put_raw(&keys.uplink(MessageKind::Report, sender), report.clone())
            .expect("sent");
    }
    tokio::time::sleep(SETTLING_TIME).await;
    for (key, (_, count)) in forged_keys.iter().zip(&received) {
        assert_eq!(count.load(Ordering::Relaxed), 0, "{key}");
    }
    assert_eq!(tapped.load(Ordering::Relaxed), 0, "the tap");
    for kind in ["plan", "clock", "wake", "report"] {
        bs.wait_for_stderr(&format!("refused by the access rules: Put for messages of kind {kind}"));
    }
    let (summary, log) = finish(&folder, &run, 600, bs, hosts);
    // The base station received the two messages of the device and refused their credentials. The rules stopped the
    // messages of the observer before.
    assert_eq!(summary.number("timing.unexpected_messages"), 2, "{summary:?}");
    assert!(!log.contains(&secret.to_string()), "the log has no secret: {log}");
}

/// Returns whether the base station answers a query of `kind` from a client with a certificate of `role`.
async fn is_answered(bus: &Bus, kind: MessageKind) -> bool {
    // Not a valid request: the base station answers with a refusal.
    let reply = bus
        .query_raw_without_secret(bus.key_exprs().base_key(kind), vec![0], Duration::from_secs(5))
        .await;
    match reply {
        Err(BusError::Refused(_)) => true,
        Ok(None) => false,
        other => panic!("{kind:?}: {other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn each_role_can_only_send_its_own_queries() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("queries"), free_tls_endpoint());
    make_certificates(&folder, "certs");
    let bs = folder.start_waiting_bs(&run, &endpoint, "--tls certs");
    let watching = [MessageKind::Control, MessageKind::Describe, MessageKind::Log];
    for (role, allowed) in [
        (Role::Device, vec![MessageKind::Join]),
        (Role::Observer, watching.to_vec()),
        (Role::Operator, [&watching[..], &[MessageKind::Act]].concat()),
        (Role::Policy, vec![]),
    ] {
        let bus = connect_as(&folder, &endpoint, &run, role).await;
        assert_eq!(bus.list_runs(PATIENCE).await.expect("the link works"), [run.as_str()]);
        for kind in [&watching[..], &[MessageKind::Join, MessageKind::Act]].concat() {
            assert_eq!(
                is_answered(&bus, kind).await,
                allowed.contains(&kind),
                "{role:?}, {kind:?}"
            );
        }
    }
    drop(bs);
}

#[test]
fn certificates_are_private_and_renewable() {
    let folder = TestFolder::new();
    let made = folder.run("tls init certs --name bs.example.org --days 30");
    assert!(made.is_success(), "{made}");
    let mode = |path: &str| {
        let metadata = fs::metadata(folder.join(path)).expect(path);
        metadata.permissions().mode() & 0o777
    };
    for folder in ["certs", "certs/ca", "certs/bs", "certs/device"] {
        assert_eq!(mode(folder), 0o700, "{folder}");
    }
    for key in ["certs/ca/key.pem", "certs/bs/key.pem", "certs/operator/key.pem"] {
        assert_eq!(mode(key), 0o600, "{key}");
    }
    let again = folder.run("tls init certs");
    assert!(
        again.stderr.contains("certs/ca/key.pem: file exists; use --renew"),
        "{again}"
    );
    let [ca, device] = ["certs/ca/cert.pem", "certs/device/cert.pem"].map(|path| folder.bytes(path));
    let renewed = folder.run("tls init certs --renew --days 2 --name router-a");
    assert!(renewed.is_success(), "{renewed}");
    assert_eq!(folder.bytes("certs/ca/cert.pem"), ca);
    assert_ne!(folder.bytes("certs/device/cert.pem"), device);
    fs::set_permissions(folder.join("certs/device/key.pem"), fs::Permissions::from_mode(0o644)).expect("changed");
    let shown = folder.run("tls show certs");
    for text in [
        "localhost, 127.0.0.1, ::1, bs.example.org, router-a",
        "issuer  Reveille CA",
        "name    operator",
    ] {
        assert!(shown.stdout.contains(text), "{text}: {shown}");
    }
    for text in [
        "expires in 1 day;",
        "certs/device/key.pem: open to other users (mode 644)",
    ] {
        assert!(shown.stderr.contains(text), "{text}: {shown}");
    }
    // A machine of devices has no key of the CA: a new CA would exclude it from the run.
    fs::remove_dir_all(folder.join("certs/ca")).expect("there");
    let device = folder.bytes("certs/device/cert.pem");
    let refused = folder.run("tls init certs --renew");
    assert!(
        refused.stderr.contains("certs/ca/key.pem: file is missing"),
        "{refused}"
    );
    assert_eq!(folder.bytes("certs/device/cert.pem"), device);
    for (line, cause) in [
        ("tls show nowhere", "nowhere: no certificates"),
        (
            "tls init other --name host:7447",
            "--name host:7447: must be a host name",
        ),
    ] {
        let refused = folder.run(line);
        assert!(refused.code() == Some(1) && refused.stderr.contains(cause), "{refused}");
    }
}

#[test]
fn wrong_files_and_endpoints_are_named() {
    let folder = TestFolder::new();
    make_certificates(&folder, "certs");
    fs::remove_file(folder.join("certs/device/cert.pem")).expect("removed");
    fs::set_permissions(folder.join("certs/bs/key.pem"), fs::Permissions::from_mode(0o644)).expect("changed");
    let tls = "--connect tls/127.0.0.1:1 --run x";
    for (line, cause) in [
        (
            format!("device {tls}"),
            "give `bs`, `device` and other commands --tls FOLDER",
        ),
        (format!("device {tls} --tls certs"), "certs/device/cert.pem is missing"),
        (
            format!("device {tls} --tls nowhere"),
            "nowhere/device/ca.pem is missing",
        ),
        (
            "bs --run x --listen tls/127.0.0.1:0 --tls certs".to_owned(),
            "bs/key.pem: other users may read it",
        ),
        (
            "clock status --connect tcp/127.0.0.1:1 --run x --tls certs".to_owned(),
            "use tls/HOST:PORT, or omit --tls",
        ),
        (
            "up --listen tls/127.0.0.1:0".to_owned(),
            "or use tcp/HOST:PORT without encryption",
        ),
    ] {
        let refused = folder.run(&line);
        assert!(
            refused.code() == Some(1) && refused.stderr.contains(cause),
            "{line}: {refused}"
        );
    }
    wait_until("no run folder", PATIENCE, || {
        folder.list("runs").is_empty().then_some(())
    });
}
