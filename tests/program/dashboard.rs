//! The HTTP interface of `reveille dashboard` and `--dashboard`: answers about live and recorded runs, clock commands,
//! actions, access checks, a side-by-side comparison, `--hold`; also the message comparison of `compare`. Paths, JSON
//! keys and status codes are from `deploy/src/dashboard/`. Timelines and search have tests there; `tests/browser/`
//! tests the page itself.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use reveille_tests::process::{
    PATIENCE, Process, SummaryJson, TestFolder, assert_refused, free_endpoint, now, unique_run, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// Most messages in one answer: the comparisons of counts below need fewer. It repeats `MAX_MESSAGES` in
/// `deploy/src/dashboard/api.rs`.
const PAGE_LIMIT: usize = 1000;

/// Address and token of a running dashboard.
struct DashboardPage {
    /// IP address and port.
    address: String,
    token: String,
}

impl DashboardPage {
    /// Reads the dashboard's address and token from the note `http://ADDRESS/#TOKEN` of `process`, once it is printed.
    fn from_output_of(process: &Process) -> Self {
        process.wait_for_stderr("http://");
        let stderr = process.stderr();
        let url = stderr
            .split("http://")
            .nth(1)
            .and_then(|rest| rest.split('\n').next())
            .expect("an address");
        let (address, token) = url.trim().split_once("/#").expect("a token");
        Self {
            address: address.to_owned(),
            token: token.to_owned(),
        }
    }

    /// Sends a request with these additional headers; returns the status and the body. A header `Host` replaces the
    /// default one.
    fn request(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> (u16, String) {
        let mut stream = TcpStream::connect(&self.address).expect("a link");
        let host = headers
            .iter()
            .find(|(name, _)| *name == "Host")
            .map_or(&self.address[..], |(_, host)| host);
        let other_headers = headers.iter().filter(|(name, _)| *name != "Host");
        let header_lines: Vec<String> = other_headers
            .map(|(name, value)| format!("{name}: {value}\r\n"))
            .collect();
        let header_lines = header_lines.concat();
        write!(
            stream,
            "{method} {path} HTTP/1.0\r\nHost: {host}\r\nContent-Length: 0\r\n{header_lines}\r\n"
        )
        .expect("sent");
        let mut response = String::new();
        stream.read_to_string(&mut response).expect("a response");
        let (head, body) = response.split_once("\r\n\r\n").expect("a body");
        let status = head
            .split(' ')
            .nth(1)
            .and_then(|status| status.parse().ok())
            .expect("a status");
        (status, body.to_owned())
    }

    /// Requests `path` without the token and returns its JSON. Fails unless the status is 200.
    fn get(&self, path: &str) -> Value {
        let (status, body) = self.request("GET", path, &[]);
        assert_eq!(status, 200, "{path}: {body}");
        serde_json::from_str(&body).expect("JSON")
    }

    /// Sends a clock command, such as `step?n=1`, and returns the answer.
    fn clock(&self, command: &str) -> Value {
        self.post(&format!("/api/clock/{command}"))
    }

    /// Posts to `path` with the token and returns the answer. Fails unless the status is 200.
    fn post(&self, path: &str) -> Value {
        let (status, body) = self.request("POST", path, &[("x-reveille-token", &self.token)]);
        assert_eq!(status, 200, "{path}: {body}");
        serde_json::from_str(&body).expect("JSON")
    }
}

#[test]
fn the_dashboard_acts_on_a_device() {
    let (folder, run) = (TestFolder::new(), unique_run("dash"));
    let options = "-p knn -n 20 -k 200";
    let up = folder.start(&format!(
        "up {options} -P 2 --paused --run {run} --quiet --out o --dashboard 127.0.0.1:0"
    ));
    let page = DashboardPage::from_output_of(&up);
    folder.wait_for_tti(&run, 0);
    let wait_for_next_tti = |next: u64| {
        wait_until("a TTI", PATIENCE, || {
            (page.get("/api/now")["next"] == next).then_some(())
        });
    };
    page.clock("run-to?n=50");
    wait_for_next_tti(50);
    // Device 3, whose code is `x` while it is failed (`state_codes` in `deploy/src/dashboard/feed/mod.rs`).
    let state_code = |tti: u64| {
        page.get(&format!("/api/tti/{tti}"))["states"]
            .as_str()
            .map(|states| states.as_bytes()[3])
    };
    let battery = || {
        page.get("/api/device/3?from=0")["batteries"]
            .as_array()
            .and_then(|levels| levels.last()?.as_f64())
    };
    assert_eq!(page.post("/api/act/fail?device=3")["text"], "device 3 fails");
    assert_eq!(page.post("/api/act/energy?device=3&units=7.5")["tti"], 50);
    let before = battery().expect("a level");
    page.clock("step?n=1");
    wait_for_next_tti(51);
    assert_eq!((state_code(49) != Some(b'x'), state_code(50)), (true, Some(b'x')));
    let gained = battery().expect("a level") - before;
    // An arrival of the paper's scenario has 5 units.
    assert!(
        (gained - 7.5).abs() < 1e-9 || (gained - 12.5).abs() < 1e-9,
        "{gained} units more"
    );
    assert_eq!(page.post("/api/act/revive?device=3")["tti"], 51);
    let token = ("x-reveille-token", &page.token[..]);
    assert_eq!(page.request("POST", "/api/act/fail?device=3", &[]).0, 401);
    for (action, why) in [
        ("explode?device=3", "unknown action"),
        ("energy?device=3", "unknown action"),
        ("fail?device=20", "or devices from 0 to 19"),
    ] {
        let (status, body) = page.request("POST", &format!("/api/act/{action}"), &[token]);
        assert!(status == 400 && body.contains(why), "{action}: {status} {body}");
    }
    page.clock("resume");
    assert!(up.finish().is_success());
    let repeated = folder.summary(&format!("run {options} --input-log o/inputs.log"));
    assert_eq!(repeated.digest(), SummaryJson::read(&folder.join("o")).digest());
}

#[test]
fn the_dashboard_follows_pauses_and_steps_a_run() {
    let (folder, run) = (TestFolder::new(), unique_run("dash"));
    let up = folder.start(&format!(
        "up -p knn -n 20 -k 400 -P 2 --paused --run {run} --quiet --out o --dashboard 127.0.0.1:0 --set \
         events.alpha=0.4"
    ));
    let page = DashboardPage::from_output_of(&up);
    folder.wait_for_tti(&run, 0);
    let run_info = page.get("/api/run");
    assert_eq!((&run_info["devices"], &run_info["policy"]), (&20.into(), &"knn".into()));
    assert_eq!(run_info["cells"].as_array().map(Vec::len), Some(20));
    assert_eq!(run_info["controls"], true);
    let status = page.clock("run-to?n=150");
    assert_eq!(status["status"]["until"], 150);
    wait_until("TTI 150", PATIENCE, || {
        (page.get("/api/now")["next"] == 150).then_some(())
    });
    let token = ("x-reveille-token", &page.token[..]);
    for tti in ["149", "401"] {
        let (status, body) = page.request("POST", &format!("/api/clock/run-to?n={tti}"), &[token]);
        assert!(status == 400 && body.contains("150"), "{status}: {body}");
    }
    page.clock("step?n=1");
    wait_until("TTI 151", PATIENCE, || {
        (page.get("/api/now")["next"] == 151).then_some(())
    });
    // The header, the curves and the tables of the run folder have the same events, also of the last TTI.
    wait_until("equal counts", PATIENCE, || {
        let (current, curves) = (page.get("/api/now"), page.get("/api/curves"));
        let finished = folder.run("inspect misses o --json");
        let misses: Value = serde_json::from_str(&finished.stdout).expect("a report");
        let counts = ["events", "missed"].map(|name| current[name].as_u64());
        let [Some(events), Some(missed)] = counts else {
            return None;
        };
        let last_point = curves.as_array()?.last()?;
        // `misdetection_pct` is the second entry of `CURVE_METRICS`.
        let missed_pct = last_point["metrics"][1].as_f64()?;
        (events > 10
            && counts == ["events", "missed"].map(|name| misses[name].as_u64())
            && (missed_pct - 100.0 * missed as f64 / events as f64).abs() < 1e-9
            && last_point["tti"] == 150)
            .then_some(())
    });
    let tti_state = page.get("/api/tti/100");
    assert_eq!(tti_state["states"].as_str().map(str::len), Some(20));
    assert_eq!(page.request("GET", "/api/tti/151", &[]).0, 404);
    let reports = page.get("/api/messages?kind=report&until=150");
    let first_report = &reports[0];
    let report_tti_state = page.get(&format!("/api/tti/{}", first_report["tti"]));
    let reporter = format!("device {}", report_tti_state["reported"][0]);
    assert_eq!(first_report["whose"], reporter.as_str());
    let message = page.get(&format!("/api/message/{}", first_report["id"]));
    assert_eq!(message["message"]["kind"], "report");
    assert_eq!(
        message["hex"].as_str().map(str::len),
        first_report["bytes"].as_u64().map(|bytes| 2 * bytes as usize)
    );
    let heat = page.get("/api/heat/100");
    assert_eq!(
        (&heat["tti"], heat["looks"].as_array().map(Vec::len)),
        (&100.into(), Some(20))
    );
    let history = page.get("/api/device/3?from=20&end=120");
    assert_eq!(history["batteries"].as_array().map(Vec::len), Some(100));
    // At 10 ms per TTI, 20 TTIs take at least 200 ms; the margin covers the TTI that was due already.
    let paced = page.clock("pace?n=10000");
    assert_eq!(paced["status"]["pace"]["RealTime"], 10_000, "{paced}");
    let start = now();
    page.clock("step?n=20");
    wait_until("TTI 171", PATIENCE, || {
        (page.get("/api/now")["next"] == 171).then_some(())
    });
    assert!(start.elapsed() > Duration::from_millis(180), "{:?}", start.elapsed());
    assert!(folder.clock(&run, "status").contains("a TTI every 10ms"));
    // A pause does not wait for a TTI that is due in a minute: less than half of it is enough on a busy machine.
    page.clock("pace?n=60000000");
    page.clock("resume");
    wait_until("TTI 172", PATIENCE, || {
        (page.get("/api/now")["next"] == 172).then_some(())
    });
    let start = now();
    assert!(folder.clock(&run, "pause").starts_with("paused before TTI 172 "));
    assert!(start.elapsed() < Duration::from_secs(30), "{:?}", start.elapsed());
    assert!(!folder.clock(&run, "pace max").contains("every"));
    page.clock("resume");
    assert!(up.finish().is_success());
}

#[test]
fn device_ledgers_balance_and_filters_equal_those_of_tail() {
    let folder = TestFolder::new();
    let run = "run -p knn -n 60 -k 700 --set events.alpha=0.5 --set harvest.e_b=3 --record r.mcap --quiet --out o";
    assert!(folder.run(run).is_success());
    let dashboard = folder.start("dashboard r.mcap --listen 127.0.0.1:0");
    let page = DashboardPage::from_output_of(&dashboard);
    for tti in [0, 1, 137, 500, 699] {
        let device = page.get(&format!("/api/device/4?from={tti}&end={}&at={tti}", tti + 1));
        let total = |name: &str| device["totals"][name].as_f64().expect(name);
        let spent = total("sensing") + total("sleep") + total("report");
        let balance = total("initial") + total("harvested") - spent - total("overflow");
        assert!((balance - total("battery")).abs() < 1e-6, "TTI {tti}: {device}");
        assert_eq!(device["batteries"][0], device["totals"]["battery"], "TTI {tti}");
    }
    let count_in_tail = |args: &str| {
        let finished = folder.run(&format!("inspect tail r.mcap --json {args}"));
        assert!(finished.is_success(), "{finished}");
        finished.stdout.lines().count()
    };
    let count_on_page = |query: &str| {
        page.get(&format!("/api/messages?{query}"))
            .as_array()
            .expect("a list")
            .len()
    };
    for (args, query) in [
        ("--kind wake --state unpowered", "kind=wake&state=unpowered"),
        (
            "--kind wake --state S4 --since 300 --until 500",
            "kind=wake&state=S4&since=300&until=500",
        ),
        ("--kind report --cluster 0", "kind=report&cluster=0"),
        ("--plane truth --device 4 --until 600", "plane=truth&device=4&until=600"),
    ] {
        let count = count_in_tail(args);
        assert!(count > 0 && count < PAGE_LIMIT, "{args}: {count} messages");
        assert_eq!(count_on_page(query), count, "{args}");
    }
    for query in ["cluster=99", "state=S9", "plane=air&kind=clock"] {
        assert_eq!(
            page.request("GET", &format!("/api/messages?{query}"), &[]).0,
            400,
            "{query}"
        );
    }
}

#[test]
fn a_dashboard_waits_for_a_killed_base_station_and_shows_its_resumed_run() {
    let (folder, run, endpoint) = (TestFolder::new(), unique_run("dies"), free_endpoint());
    let up = |options: &str| folder.start(&format!("up {options} -P 1 --quiet --pace 5ms"));
    let killed_up = up(&format!(
        "-p knn -n 10 -k 1000000 --out o --run {run} --listen {endpoint}"
    ));
    folder.wait_for_tti(&run, 1);
    let dashboard = folder.start(&format!("dashboard --run {run} --listen 127.0.0.1:0"));
    let page = DashboardPage::from_output_of(&dashboard);
    // A second dashboard at the same port is refused; at another port it is not.
    let same_port = folder.run(&format!("dashboard --run {run} --listen {}", page.address));
    assert_refused(&same_port, 1, &["--listen", &page.address, "free port"]);
    let second_dashboard = folder.start(&format!("dashboard --run {run} --listen 127.0.0.1:0"));
    let second_page = DashboardPage::from_output_of(&second_dashboard);
    let tti_before = wait_until("some TTIs", PATIENCE, || {
        page.get("/api/now")["next"].as_u64().filter(|next| *next > 50)
    });
    killed_up.signal(Signal::KILL);
    for (page, dashboard) in [(&page, &dashboard), (&second_page, &second_dashboard)] {
        dashboard.wait_for_stderr("has left the bus; waiting for its return");
        let now = wait_until("the loss", PATIENCE, || {
            Some(page.get("/api/now")).filter(|now| now["reachable"] == false)
        });
        assert_eq!(now["over"], false);
        let next = now["next"].as_u64().expect("a TTI");
        assert!(next >= tti_before, "{next}");
        let (status, body) = page.request("POST", "/api/clock/pause", &[("x-reveille-token", &page.token)]);
        assert!(status == 410 || status == 502, "{status}: {body}");
    }
    second_dashboard.signal(Signal::INT);
    assert!(second_dashboard.finish().is_success());
    let tti_at_loss = page.get("/api/now")["next"].as_u64().expect("a TTI");
    // Another name of the folder, and no option: the folder has the name and the address of the run.
    std::fs::rename(folder.join("o"), folder.join("moved")).expect("ours");
    let resumed_up = up("--resume moved");
    dashboard.wait_for_stderr("the base station is back");
    wait_until("later TTIs", PATIENCE, || {
        page.get("/api/now")["next"]
            .as_u64()
            .filter(|next| *next > tti_at_loss + 50)
    });
    let now = page.get("/api/now");
    assert_eq!((&now["reachable"], &now["broken"]), (&true.into(), &Value::Null));
    resumed_up.signal(Signal::INT);
    dashboard.wait_for_stderr("; its messages are shown until");
    wait_until("the end", PATIENCE, || {
        (page.get("/api/now")["over"] == true).then_some(())
    });
}

#[test]
fn two_runs_are_compared_side_by_side() {
    let folder = TestFolder::new();
    let record = |name: &str, args: &str| {
        let finished = folder.run(&format!(
            "{args} -n 25 -k 400 --record {name}.mcap --quiet --out {name}"
        ));
        assert!(finished.is_success(), "{finished}");
    };
    record("one", "run -p age-index");
    record("two", "run -p age-index --set seed=2");
    record("bus", "up -p age-index -P 2");
    let of_equal_runs = folder.run("compare --exit-code one.mcap bus.mcap");
    assert!(
        of_equal_runs.is_success()
            && of_equal_runs
                .stdout
                .ends_with("run 1 and run 2: no difference in the messages\n"),
        "{of_equal_runs}"
    );
    // The former name has the same exit code.
    let of_different_runs = folder.run("inspect compare one.mcap two.mcap");
    assert_eq!(of_different_runs.code(), Some(1), "{of_different_runs}");
    for part in ["\n  seed = 1 | 2\n", "run 1 and run 2: first difference: plan in TTI 0"] {
        assert!(
            of_different_runs.stdout.contains(part),
            "no {part:?}: {of_different_runs}"
        );
    }
    assert!(
        of_different_runs
            .stderr
            .contains("`inspect compare` is now called `compare --exit-code`"),
        "{of_different_runs}"
    );
    let bytes = folder.bytes("one.mcap");
    std::fs::write(folder.join("cut.mcap"), &bytes[..bytes.len() / 2]).expect("written");
    assert_refused(
        &folder.run("compare --exit-code one.mcap cut.mcap"),
        1,
        &["cut.mcap", "truncated", "up to this point"],
    );
    assert_refused(&folder.run("compare --exit-code one.mcap none.mcap"), 1, &["none.mcap"]);
    assert_refused(
        &folder.run("dashboard one.mcap --compare one/summary.json --listen 127.0.0.1:0"),
        1,
        &["--compare one/summary.json", "not a recording"],
    );

    let dashboard = folder.start("dashboard one.mcap --compare two.mcap --listen 127.0.0.1:0");
    let page = DashboardPage::from_output_of(&dashboard);
    let comparison = page.get("/api/compare");
    assert_eq!(comparison["fields"], serde_json::json!([["seed", "1", "2"]]));
    assert_eq!(
        (
            &comparison["differences"][0]["kind"],
            &comparison["differences"][0]["tti"]
        ),
        (&"plan".into(), &0.into())
    );
    assert_eq!(comparison["compared"], 400);
    assert_eq!(
        page.get("/api/other/tti/399")["states"].as_str().map(str::len),
        Some(25)
    );
    assert_eq!(page.request("GET", "/api/other/tti/400", &[]).0, 404);
    assert!(
        page.get("/api/other/curves")
            .as_array()
            .is_some_and(|points| points.len() > 100)
    );

    // A live run, next to its expected final state.
    let run = unique_run("compared");
    let up = folder.start(&format!(
        "up -p age-index -n 25 -k 400 -P 2 --paused --run {run} --quiet --out live"
    ));
    folder.wait_for_tti(&run, 0);
    let dashboard = folder.start(&format!(
        "dashboard --run {run} --compare one.mcap --listen 127.0.0.1:0"
    ));
    let page = DashboardPage::from_output_of(&dashboard);
    folder.clock(&run, "resume");
    assert!(up.finish().is_success());
    wait_until("the end", PATIENCE, || {
        (page.get("/api/now")["over"] == true).then_some(())
    });
    let comparison = page.get("/api/compare");
    assert_eq!(
        (&comparison["differences"], &comparison["compared"]),
        (&serde_json::json!([]), &400.into())
    );
}

#[test]
fn untrusted_clients_are_refused() {
    let folder = TestFolder::new();
    let run = unique_run("strange");
    let up = folder.start(&format!(
        "up -n 5 -k 60 -P 1 --paused --run {run} --quiet --out o --dashboard 127.0.0.1:0"
    ));
    let page = DashboardPage::from_output_of(&up);
    folder.wait_for_tti(&run, 0);
    let token = ("x-reveille-token", &page.token[..]);
    let mut wrong_token = page.token.clone();
    wrong_token.replace_range(0..1, if wrong_token.starts_with('0') { "1" } else { "0" });
    for (headers, expected_status) in [
        (vec![], 401),
        (vec![("x-reveille-token", &wrong_token[..])], 401),
        (vec![token, ("Origin", "http://evil.example")], 403),
        (vec![token, ("Origin", "null")], 403),
        (vec![token, ("Host", "evil.example")], 421),
        (vec![token, ("Sec-Fetch-Site", "cross-site")], 403),
    ] {
        let (actual_status, body) = page.request("POST", "/api/clock/resume", &headers);
        assert_eq!(actual_status, expected_status, "{headers:?}: {body}");
    }
    for (method, path, expected_status, error) in [
        ("GET", "/api/clock/resume", 405, "use POST for commands"),
        ("POST", "/api/clock/leap", 400, "unknown clock command"),
        ("POST", "/api/clock/step?m=5", 400, "unknown field `m`"),
        ("POST", "/api/clock/step?n=x", 400, "parameters: n: invalid digit"),
        ("GET", "/api/now?tti=5", 400, "/api/now has no parameters"),
        ("GET", "/api/tti/x", 400, "annot parse `x`"),
        ("GET", "/api/heat/5", 404, "TTI 5 is not in memory"),
        ("GET", "/api/other/heat/5", 404, "no other run"),
        ("GET", "/api/messages?kind=nothing", 400, "no such kind"),
    ] {
        let (status, body) = page.request(method, path, &[token]);
        let body: serde_json::Value = serde_json::from_str(&body).expect(&body);
        let is_named = body["error"].as_str().is_some_and(|text| text.contains(error));
        assert!(status == expected_status && is_named, "{path}: {status}, {body}");
    }
    assert_eq!(page.request("GET", "/api/now", &[("Host", "evil.example")]).0, 421);
    assert_eq!(page.request("GET", "/../Cargo.toml", &[]).0, 404);
    assert!(
        page.get("/api/clock")["text"]
            .as_str()
            .is_some_and(|text| text.starts_with("paused before TTI 0"))
    );
    let own_origin = format!("http://{}", page.address);
    assert_eq!(
        page.request("POST", "/api/clock/resume", &[token, ("Origin", &own_origin)])
            .0,
        200
    );
    assert!(up.finish().is_success());
}

#[test]
fn the_dashboard_serves_the_files_of_its_run_only() {
    let folder = TestFolder::new();
    let up = folder.start("up -n 20 -k 300 -P 1 --dashboard 127.0.0.1:0 --hold --record o/r.mcap --out o");
    let page = DashboardPage::from_output_of(&up);
    up.wait_for_stderr("the dashboard is served until Ctrl-C");
    std::fs::write(folder.join("secret.mcap"), "secret").expect("written");
    std::os::unix::fs::symlink(folder.join("secret.mcap"), folder.join("o/linked.mcap")).expect("a link");
    let listed = page.get("/api/files");
    let names: Vec<&str> = listed
        .as_array()
        .expect("a list")
        .iter()
        .map(|file| file["name"].as_str().expect("a name"))
        .collect();
    assert!(
        ["events.csv", "r.mcap", "scenario.toml", "summary.json"]
            .iter()
            .all(|name| names.contains(name)),
        "{names:?}"
    );
    assert!(!names.contains(&"linked.mcap"), "{names:?}");
    let (status, body) = page.request("GET", "/api/files/events.csv", &[]);
    assert_eq!((status, body.as_bytes()), (200, &folder.bytes("o/events.csv")[..]));
    let absolute = folder.join("secret.mcap").to_string_lossy().into_owned();
    for name in [
        "../secret.mcap",
        "%2e%2e/secret.mcap",
        "%2e%2e%2fsecret.mcap",
        "..%2Fsecret.mcap",
        "scenario-files/../../secret.mcap",
        "linked.mcap",
        &absolute,
        &absolute.replace('/', "%2F"),
    ] {
        let (status, body) = page.request("GET", &format!("/api/files/{name}"), &[]);
        assert!(status == 404, "{name}: {status} {body}");
    }
    let elsewhere = [("Sec-Fetch-Site", "cross-site")];
    assert_eq!(page.request("GET", "/api/files/events.csv", &elsewhere).0, 403);
    up.signal(Signal::INT);
    assert!(up.finish().is_success());
}

#[test]
fn a_client_that_never_reads_does_not_delay_the_run() {
    let folder = TestFolder::new();
    let up = folder.start("up -p random -n 20 -k 20000 -P 1 --quiet --out o --dashboard 127.0.0.1:0");
    let page = DashboardPage::from_output_of(&up);
    // All clients request the endless stream of states. The first reads up to one state, the others read nothing.
    let clients: Vec<TcpStream> = (0..50)
        .map(|_| {
            let mut stream = TcpStream::connect(&page.address).expect("a link");
            write!(stream, "GET /api/live HTTP/1.1\r\nHost: {}\r\n\r\n", page.address).expect("sent");
            stream
        })
        .collect();
    let mut lines = BufReader::new(&clients[0]).lines();
    let update = lines.find_map(|line| line.ok()?.strip_prefix("data: ").map(str::to_owned));
    assert!(update.is_some_and(|update| update.contains("\"states\"")));
    assert!(up.finish_within(PATIENCE).is_success());
}

#[test]
fn a_recording_is_shown_without_a_clock() {
    let folder = TestFolder::new();
    assert!(
        folder
            .run("run -p knn -n 20 -k 300 --record r.mcap --quiet --out o")
            .is_success()
    );
    let dashboard = folder.start("dashboard r.mcap --listen 127.0.0.1:0");
    let page = DashboardPage::from_output_of(&dashboard);
    let run_info = page.get("/api/run");
    assert_eq!(
        (&run_info["live"], &run_info["controls"]),
        (&false.into(), &false.into())
    );
    assert!(run_info["groups"].as_array().is_some_and(|groups| groups.len() == 20));
    let current = page.get("/api/now");
    assert_eq!((&current["next"], &current["over"]), (&300.into(), &true.into()));
    assert!(
        page.get("/api/curves")
            .as_array()
            .is_some_and(|points| points.len() > 100)
    );
    let (status, body) = page.request("POST", "/api/clock/pause", &[("x-reveille-token", &page.token)]);
    assert!(status == 409 && body.contains("no clock"), "{status}: {body}");
    dashboard.signal(Signal::INT);
    assert!(dashboard.finish().is_success());
    assert_refused(
        &folder.run("dashboard o --listen 127.0.0.1:0"),
        1,
        &["o: the folder holds no recording", "--record o/run.mcap"],
    );
    assert_refused(&folder.run("dashboard r.mcap --listen nowhere"), 1, &["nowhere"]);
    // The longest start of the recording without a message.
    let bytes = folder.bytes("r.mcap");
    let cut = |length: usize| std::fs::write(folder.join("cut.mcap"), &bytes[..length]).expect("written");
    let (mut without, mut with) = (0, bytes.len());
    while without + 1 < with {
        let middle = usize::midpoint(without, with);
        cut(middle);
        let has_message = folder.run("inspect tail cut.mcap --json").stdout.contains("\"tti\"");
        (without, with) = if has_message { (without, middle) } else { (middle, with) };
    }
    assert!(
        without > 1000,
        "the scenario comes before the first message, in byte {without}"
    );
    for length in [without, without / 2, 0] {
        cut(length);
        assert_refused(&folder.run("dashboard cut.mcap --listen 127.0.0.1:0"), 1, &["cut.mcap"]);
    }
}

#[test]
fn a_held_dashboard_shows_the_run_after_its_end() {
    let folder = TestFolder::new();
    let up = folder.start("up -n 20 -k 300 -P 1 --dashboard 127.0.0.1:0 --hold --out o");
    let page = DashboardPage::from_output_of(&up);
    up.wait_for_stderr("the dashboard is served until Ctrl-C");
    assert!(up.stdout().contains("results in o"), "{}", up.stdout());
    let current = page.get("/api/now");
    assert_eq!(
        (&current["over"], &current["next"]),
        (&Value::from(true), &Value::from(300))
    );
    assert_eq!(page.get("/api/tti/150")["tti"], 150);
    up.signal(Signal::INT);
    let finished = up.finish();
    assert!(
        finished.is_success() && !finished.stderr.contains("interrupted"),
        "{finished}"
    );
    assert_refused(&folder.run("up --hold --quiet --out p"), 2, &["--dashboard"]);
}
