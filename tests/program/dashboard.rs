//! The dashboard as programs see it: what it tells, and whom it refuses.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use reveille_tests::process::{Folder, PATIENCE, Process, assert_refused, unique_run, wait_until};
use rustix::process::Signal;
use serde_json::Value;

/// A dashboard that is served: its address and its token.
struct Page {
    address: String,
    token: String,
}

impl Page {
    /// That of `process`, once it says where it is.
    fn of(process: &Process) -> Self {
        process.wait_for_stderr("http://");
        let said = process.stderr();
        let url = said
            .split("http://")
            .nth(1)
            .and_then(|rest| rest.split([';', '\n']).next())
            .expect("an address");
        let (address, token) = url.trim().split_once("/#").expect("a token");
        Self {
            address: address.to_owned(),
            token: token.to_owned(),
        }
    }

    /// Sends a request, with these headers besides; gives the status and the body.
    fn ask(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> (u16, String) {
        let mut stream = TcpStream::connect(&self.address).expect("a link");
        let host = headers
            .iter()
            .find(|(name, _)| *name == "Host")
            .map_or(&self.address[..], |(_, host)| host);
        let others = headers.iter().filter(|(name, _)| *name != "Host");
        let others: Vec<String> = others.map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let others = others.concat();
        write!(
            stream,
            "{method} {path} HTTP/1.0\r\nHost: {host}\r\nContent-Length: 0\r\n{others}\r\n"
        )
        .expect("sent");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        let (head, body) = answer.split_once("\r\n\r\n").expect("a body");
        let status = head
            .split(' ')
            .nth(1)
            .and_then(|status| status.parse().ok())
            .expect("a status");
        (status, body.to_owned())
    }

    /// What it tells of `path`.
    fn get(&self, path: &str) -> Value {
        let (status, body) = self.ask("GET", path, &[]);
        assert_eq!(status, 200, "{path}: {body}");
        serde_json::from_str(&body).expect("JSON")
    }

    /// Drives the clock.
    fn drive(&self, command: &str) -> Value {
        let (status, body) = self.ask(
            "POST",
            &format!("/api/clock/{command}"),
            &[("x-reveille-token", &self.token)],
        );
        assert_eq!(status, 200, "{command}: {body}");
        serde_json::from_str(&body).expect("JSON")
    }
}

#[test]
fn a_run_is_followed_paused_and_stepped() {
    let (folder, run) = (Folder::new(), unique_run("dash"));
    let up = folder.start(&format!(
        "up -p knn -n 20 -k 400 -P 2 --paused --run {run} --quiet --out o --dashboard 127.0.0.1:0 --set \
         events.alpha=0.4"
    ));
    let page = Page::of(&up);
    folder.wait_for_tti(&run, 0);
    let about = page.get("/api/run");
    assert_eq!((&about["devices"], &about["policy"]), (&20.into(), &"knn".into()));
    assert_eq!(about["cells"].as_array().map(Vec::len), Some(20));
    assert_eq!(about["controls"], true);
    wait_until("all devices to join", PATIENCE, || {
        page.get("/api/clock")["text"]
            .as_str()?
            .starts_with("paused")
            .then_some(())
    });
    let status = page.drive("run-to?n=150");
    assert_eq!(status["status"]["until"], 150);
    wait_until("TTI 150", PATIENCE, || {
        (page.get("/api/now")["next"] == 150).then_some(())
    });
    page.drive("step?n=1");
    wait_until("TTI 151", PATIENCE, || {
        (page.get("/api/now")["next"] == 151).then_some(())
    });
    let moment = page.get("/api/tti/100");
    assert_eq!(moment["states"].as_str().map(str::len), Some(20));
    assert_eq!(page.ask("GET", "/api/tti/151", &[]).0, 404);
    let reports = page.get("/api/messages?kind=report&until=150");
    let first = &reports[0];
    let shown = page.get(&format!("/api/tti/{}", first["tti"]));
    let whose = format!("device {}", shown["reported"][0]);
    assert_eq!(first["whose"], whose.as_str());
    let message = page.get(&format!("/api/message/{}", first["id"]));
    assert_eq!(message["message"]["kind"], "report");
    assert_eq!(
        message["hex"].as_str().map(str::len),
        first["bytes"].as_u64().map(|bytes| 2 * bytes as usize)
    );
    let history = page.get("/api/device/3?from=20&end=120");
    assert_eq!(history["batteries"].as_array().map(Vec::len), Some(100));
    page.drive("resume");
    assert!(up.finish().is_success());
}

#[test]
fn strangers_are_refused() {
    let folder = Folder::new();
    let run = unique_run("strange");
    let up = folder.start(&format!(
        "up -n 5 -k 60 -P 1 --paused --run {run} --quiet --out o --dashboard 127.0.0.1:0"
    ));
    let page = Page::of(&up);
    folder.wait_for_tti(&run, 0);
    let token = ("x-reveille-token", &page.token[..]);
    let mut wrong = page.token.clone();
    wrong.replace_range(0..1, if wrong.starts_with('0') { "1" } else { "0" });
    for (headers, status) in [
        (vec![], 401),
        (vec![("x-reveille-token", &wrong[..])], 401),
        (vec![token, ("Origin", "http://evil.example")], 403),
        (vec![token, ("Origin", "null")], 403),
        (vec![token, ("Host", "evil.example")], 421),
    ] {
        let (found, body) = page.ask("POST", "/api/clock/resume", &headers);
        assert_eq!(found, status, "{headers:?}: {body}");
    }
    assert_eq!(page.ask("GET", "/api/clock/resume", &[token]).0, 405);
    assert_eq!(page.ask("POST", "/api/clock/leap", &[token]).0, 400);
    assert_eq!(page.ask("GET", "/api/now", &[("Host", "evil.example")]).0, 421);
    assert_eq!(page.ask("GET", "/api/messages?kind=nothing", &[]).0, 400);
    assert_eq!(page.ask("GET", "/../Cargo.toml", &[]).0, 404);
    assert!(
        page.get("/api/clock")["text"]
            .as_str()
            .is_some_and(|text| text.starts_with("paused before TTI 0"))
    );
    let own = format!("http://{}", page.address);
    assert_eq!(page.ask("POST", "/api/clock/resume", &[token, ("Origin", &own)]).0, 200);
    assert!(up.finish().is_success());
}

#[test]
fn a_browser_that_never_reads_holds_nobody_up() {
    let folder = Folder::new();
    let up = folder.start("up -p random -n 20 -k 20000 -P 1 --quiet --out o --dashboard 127.0.0.1:0");
    let page = Page::of(&up);
    // They ask, and some of them never read.
    let silent: Vec<TcpStream> = (0..50)
        .map(|_| {
            let mut stream = TcpStream::connect(&page.address).expect("a link");
            write!(stream, "GET /api/live HTTP/1.1\r\nHost: {}\r\n\r\n", page.address).expect("sent");
            stream
        })
        .collect();
    let mut lines = BufReader::new(&silent[0]).lines();
    let told = lines.find_map(|line| line.ok()?.strip_prefix("data: ").map(str::to_owned));
    assert!(told.is_some_and(|told| told.contains("\"states\"")));
    assert!(up.finish_within(Duration::from_mins(2)).is_success());
}

#[test]
fn a_recording_is_shown_without_a_clock() {
    let folder = Folder::new();
    assert!(
        folder
            .run("run -p knn -n 20 -k 300 --record r.mcap --quiet --out o")
            .is_success()
    );
    let shown = folder.start("dashboard --from r.mcap --listen 127.0.0.1:0");
    let page = Page::of(&shown);
    let about = page.get("/api/run");
    assert_eq!((&about["live"], &about["controls"]), (&false.into(), &false.into()));
    assert!(about["groups"].as_array().is_some_and(|groups| groups.len() == 20));
    let now = page.get("/api/now");
    assert_eq!((&now["next"], &now["over"]), (&300.into(), &true.into()));
    assert!(
        page.get("/api/curves")
            .as_array()
            .is_some_and(|points| points.len() > 100)
    );
    let (status, body) = page.ask("POST", "/api/clock/pause", &[("x-reveille-token", &page.token)]);
    assert!(status == 409 && body.contains("no clock"), "{status}: {body}");
    shown.signal(Signal::INT);
    assert!(shown.finish().is_success());
    assert_refused(
        &folder.run("dashboard --from o --listen 127.0.0.1:0"),
        1,
        &["o: is not a file"],
    );
    assert_refused(&folder.run("dashboard --from r.mcap --listen nowhere"), 1, &["nowhere"]);
}
