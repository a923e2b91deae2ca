//! Prometheus metrics (`--metrics`) of `run` and `up`: neither they nor a recording change the digest, the only output
//! under `--quiet`. On a loopback address, requests under another host name are refused (421, against DNS rebinding),
//! and `/` leads to `/metrics` (307). An unusable address is refused before the run. The address comes from the note
//! `http://ADDRESS/metrics` on standard error. `tests/monitoring/` reads the metrics with Prometheus.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};

use reveille_tests::process::{TestFolder, assert_refused, unique_run};

/// Requests `path` from `address` with `Host: host_header`, and returns the answer.
fn get(address: &str, path: &str, host_header: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("a link");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {host_header}\r\nConnection: close\r\n\r\n"
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
fn a_loopback_address_refuses_requests_under_other_host_names() {
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
    // A paused run resumes only after its devices have joined.
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
