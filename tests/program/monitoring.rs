//! Prometheus metrics (`--metrics`) of `run` and `up`: neither metrics nor a recording change the digest. Batteries
//! have their values at the time of the request. On a loopback address, requests under another host name are refused
//! (421, against DNS rebinding), and `/` redirects to `/metrics` (307). An unusable address is refused before the run.
//!
//! The tests take the address from the note `http://ADDRESS/metrics` on standard error, and read metrics by their names
//! in `view/src/metrics.rs`. `tests/monitoring/` reads the metrics with Prometheus.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};

use reveille_tests::process::{PATIENCE, Process, TestFolder, assert_refused, free_endpoint, unique_run, wait_until};
use rustix::process::Signal;

/// Requests `path` from `address` with `Host: host_header`, and returns the answer, from its status line to its body.
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
    // Under `--quiet`, the digest is the whole output.
    let plain = folder.run("run -p knn -n 30 -k 600 --quiet --out a");
    assert!(plain.is_success(), "{plain}");
    for (index, command) in ["run", "up -P 2", "up -P 0 --no-lookahead"].into_iter().enumerate() {
        let observers = format!("--record {index}.mcap --record-states 7 --metrics 127.0.0.1:0");
        let finished = folder.run(&format!(
            "{command} -p knn -n 30 -k 600 --quiet --out w{index} {observers}"
        ));
        assert!(finished.is_success() && finished.stdout == plain.stdout, "{finished}");
    }
}

#[test]
fn a_loopback_address_refuses_requests_under_other_host_names() {
    let (folder, run) = (TestFolder::new(), unique_run("metrics"));
    let up = folder.start(&format!(
        "up -P 1 -n 10 -k 60 --paused --run {run} --quiet --out o --metrics 127.0.0.1:0"
    ));
    let address = &metrics_address(&up);
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

/// Returns the address of the metrics server of `process`.
fn metrics_address(process: &Process) -> String {
    process.wait_for_stderr("/metrics");
    let stderr = process.stderr();
    let from_address = stderr.split("http://").nth(1).expect("an address");
    from_address.split('/').next().expect("a first part").to_owned()
}

/// Requests the metrics, and returns the next TTI and the mean battery level.
fn next_tti_and_battery(address: &str) -> (f64, f64) {
    let answer = get(address, "/metrics", address);
    let value = |name: &str| {
        let line = answer
            .lines()
            .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.and_then(|text| text.parse::<f64>().ok())
            .unwrap_or_else(|| panic!("{name}: {answer}"))
    };
    (value("reveille_next_tti"), value("reveille_battery_mean_units"))
}

#[test]
fn a_run_that_waits_for_a_lost_host_does_not_count_it_as_alive() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("lost"), free_endpoint());
    let bs = folder.start(&format!(
        "bs -n 20 -k 6000 --pace 5ms --quiet --out o --run {run} --listen {endpoint} --metrics 127.0.0.1:0"
    ));
    let hosts = [0, 1].map(|_| {
        let host = folder.start(&format!("-v device --connect {endpoint} --run {run} --count 10"));
        host.wait_for_stderr("joined");
        host
    });
    folder.wait_for_tti(&run, 10);
    let address = metrics_address(&bs);
    let wait_for_alive = |number: u32| {
        let line = format!("reveille_hosts_alive {number}\n");
        wait_until(&line, PATIENCE, || {
            get(&address, "/metrics", &address).contains(&line).then_some(())
        });
    };
    wait_for_alive(2);
    hosts[1].signal(Signal::KILL);
    bs.wait_for_stderr("the run is waiting");
    wait_for_alive(1);
    bs.signal(Signal::INT);
    bs.finish();
}

/// Without harvest and almost without events, a device that is always sensing spends one unit in each TTI.
#[test]
fn batteries_are_those_at_the_time_of_the_request() {
    let (folder, run, e_max) = (TestFolder::new(), unique_run("batteries"), 500_000.0);
    let always_sensing = "-p random --set policy.random.t_on=[10] --set policy.random.t_drx=[10]";
    let up = folder.start(&format!(
        "up -P 1 -n 10 -k 400000 --run {run} --pace 1ms {always_sensing} --set events.alpha=1e-9 \
         --set harvest.lambda=0 --set energy.e_max={e_max} --set energy.initial={e_max} --quiet --out o \
         --metrics 127.0.0.1:0"
    ));
    let address = metrics_address(&up);
    // A TTI that the run has reached.
    let mut reached = 1;
    for _ in 0..3 {
        folder.wait_for_tti(&run, reached);
        // The devices were counted between the request and the encoding of its response.
        let (next_tti, battery) = next_tti_and_battery(&address);
        // A unit per TTI since the start.
        let ttis = e_max - battery;
        assert!(
            reached as f64 <= ttis && ttis <= next_tti,
            "a battery after {ttis} TTIs, requested after {reached} and answered after {next_tti}"
        );
        reached = next_tti as u64 + 100;
    }
    up.signal(Signal::INT);
    up.finish();
}

#[test]
fn an_unusable_address_is_refused_before_the_run() {
    let folder = TestFolder::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("bound");
    for command in ["run", "up -P 1"] {
        let finished = folder.run(&format!("{command} -n 5 -k 60 --quiet --metrics {address}"));
        assert_refused(&finished, 1, &[&format!("--metrics {address}"), "in use"]);
        assert_refused(
            &folder.run(&format!("{command} -n 5 -k 60 --quiet --metrics nowhere")),
            1,
            &["--metrics nowhere"],
        );
    }
}
