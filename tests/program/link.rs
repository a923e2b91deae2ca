//! `reveille link`: the delay that an echo through the relay shows, and a run over it.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use reveille_tests::process::{SummaryJson, TestFolder, free_endpoint, unique_run};
use rustix::process::Signal;

/// Answers one connection with its own data.
fn start_echo() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let endpoint = format!("tcp/{}", listener.local_addr().expect("an address"));
    std::thread::spawn(move || {
        let (mut connection, _) = listener.accept().expect("a connection");
        connection.set_nodelay(true).expect("an option of TCP");
        let mut buffer = [0; 64];
        while let Ok(length @ 1..) = connection.read(&mut buffer) {
            connection.write_all(&buffer[..length]).expect("an open connection");
        }
    });
    endpoint
}

#[test]
#[expect(clippy::disallowed_methods, reason = "the test measures a delay")]
fn an_echo_returns_after_twice_the_delay() {
    let (folder, echo, endpoint) = (TestFolder::new(), start_echo(), free_endpoint());
    let link = folder.start(&format!("link --listen {endpoint} --connect {echo} --delay 30ms"));
    link.wait_for_stderr("relaying");
    let address = endpoint.strip_prefix("tcp/").expect("an endpoint");
    let mut client = TcpStream::connect(address).expect("the relay listens");
    client.set_nodelay(true).expect("an option of TCP");
    let mut round_trip = |byte: u8| {
        let (started, mut answer) = (Instant::now(), [0]);
        client.write_all(&[byte]).expect("an open connection");
        client.read_exact(&mut answer).expect("an answer");
        assert_eq!(answer, [byte]);
        started.elapsed()
    };
    // A busy machine delays some of them; the shortest has only the delay of the link.
    let shortest = (0..20).map(&mut round_trip).min().expect("a round trip");
    let expected = Duration::from_millis(60);
    assert!(
        shortest >= expected && shortest < expected + Duration::from_millis(15),
        "{shortest:?}"
    );
    link.signal(Signal::TERM);
    assert!(link.finish().is_success());
}

#[test]
fn a_run_over_a_slow_link_has_the_same_digest() {
    let (folder, run) = (TestFolder::new(), unique_run("link"));
    let [bs_endpoint, link_endpoint] = [free_endpoint(), free_endpoint()];
    let scenario = "-n 20 -k 400";
    let expected = folder.summary(&format!("run {scenario}"));
    let link = folder.start(&format!(
        "link --listen {link_endpoint} --connect {bs_endpoint} --delay 5ms --loss 2%"
    ));
    link.wait_for_stderr("relaying");
    let bs = folder.start(&format!("bs {scenario} --out out --run {run} --listen {bs_endpoint}"));
    bs.wait_for_stderr("waiting for 20 devices");
    let far = folder.start(&format!("device --connect {link_endpoint} --run {run} --range 0-9"));
    let near = folder.start(&format!("device --connect {bs_endpoint} --run {run} --range 10-19"));
    for process in [bs, far, near] {
        let finished = process.finish();
        assert!(finished.is_success(), "{finished}");
    }
    let summary = SummaryJson::read(&folder.join("out"));
    assert_eq!(summary.digest(), expected.digest());
    // Without lookahead a barrier takes at least a round trip; lookahead saves most of them, but not all.
    let json: serde_json::Value = serde_json::from_slice(&folder.bytes("out/summary.json")).expect("JSON");
    let seconds = json["timing"]["run_s"].as_f64().expect("a time");
    assert!(seconds >= 0.01 * summary.number("timing.grants") as f64, "{seconds} s");
}
