//! Prometheus metrics (`--metrics`) of `run` and `up`: they do not change the digest, are served to this machine only,
//! and an unusable address is refused before the run. `tests/monitoring/` reads them with Prometheus.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};

use reveille_tests::process::{TestFolder, assert_refused, unique_run};

/// Requests `path` from `address` with header `host`, and returns the answer.
fn get(address: &str, path: &str, host: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("a link");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
    )
    .expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    answer
}

#[test]
fn metrics_and_recording_do_not_change_the_digest() {
    let folder = TestFolder::new();
    let plain = folder.run("run -p knn -n 30 -k 600 --quiet --out a");
    assert!(plain.is_success(), "{plain}");
    for (index, command) in ["run", "up -P 2", "up -P 0 --no-lookahead"].into_iter().enumerate() {
        let observers = format!("--record {index}.mcap --record-states 7 --metrics 127.0.0.1:0");
        let end = folder.run(&format!(
            "{command} -p knn -n 30 -k 600 --quiet --out w{index} {observers}"
        ));
        assert!(end.is_success() && end.stdout == plain.stdout, "{end}");
    }
}

#[test]
fn metrics_are_served_only_to_this_machine() {
    let (folder, run) = (TestFolder::new(), unique_run("metrics"));
    let up = folder.start(&format!(
        "up -P 1 -n 10 -k 60 --paused --run {run} --quiet --out o --metrics 127.0.0.1:0"
    ));
    up.wait_for_stderr("/metrics");
    let stderr = up.stderr();
    let address = stderr
        .split("http://")
        .nth(1)
        .and_then(|rest| rest.split('/').next())
        .expect("an address");
    let answer = get(address, "/metrics", address);
    assert!(
        answer.starts_with("HTTP/1.1 200") && answer.contains("reveille_run_info{"),
        "{answer}"
    );
    assert!(answer.contains("reveille_ttis_total 0\n"), "{answer}");
    assert!(get(address, "/metrics", "evil.example").starts_with("HTTP/1.1 421"));
    assert!(get(address, "/", "localhost").starts_with("HTTP/1.1 307"));
    folder.wait_for_tti(&run, 0);
    folder.clock(&run, "resume");
    assert!(up.finish().is_success());
}

#[test]
fn an_unusable_address_is_refused_before_the_run() {
    let folder = TestFolder::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("bound");
    for command in ["run", "up -P 1"] {
        let end = folder.run(&format!("{command} -n 5 -k 60 --quiet --metrics {address}"));
        assert_refused(&end, 1, &[&format!("--metrics {address}"), "in use"]);
        assert_refused(
            &folder.run(&format!("{command} -n 5 -k 60 --quiet --metrics nowhere")),
            1,
            &["--metrics nowhere"],
        );
    }
}
