//! Runs the commands of docs/tutorial.md in order, in one folder, and compares their output with the page.
//!
//! On the page, the language of a block states its purpose: `sh` holds commands that this test runs, `text` their
//! output. `python` and `toml` hold files, named in their first line. `console` holds the commands of [`NOT_RUN`]. A
//! `text` block follows each `sh` block; `…` in it means any text.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;
use std::thread;

use reveille_bs::policy::external::wire::{DecisionReply, DecisionRequest, RequestKind};
use reveille_bs::policy::external::{Decision, DecisionStage};
use reveille_bs::server::policy_port::client::{self, ClientIdentity};
use reveille_common::bus::Bus;
use reveille_common::encoding::Encoding;
use reveille_common::ids::Tti;
use reveille_tests::machine::skip_except_in_ci;
use reveille_tests::process::{PATIENCE, Process, TestFolder, reveille};
use serde_json::{Value, json};

/// Commands of the page, in order, that need a network, a second build, the reader's own terminal or more than a
/// minute.
const NOT_RUN: [&str; 10] = [
    "git clone ADDRESS reveille",
    "cd reveille",
    "cargo build --release",
    "export PATH=\"$PWD/target/release:$PATH\"",
    "mkdir ../first-hour",
    "cd ../first-hour",
    "reveille up --policy age-index --ttis 1000 --pace 100ms --dashboard --out slow",
    "python3 -m venv python",
    ". python/bin/activate",
    "pip install '../reveille/python[port]'",
];

/// A Python module in place of the package `reveille`, which needs a build and a zenoh client. It calls the page's
/// policy. The test speaks with the base station in [`decide`], and passes each request to this module and each answer
/// back.
const STAND_IN: &str = r#"
import json, os, socket

def decide(policy):
    link = socket.create_connection(("127.0.0.1", int(os.environ["TUTORIAL_PORT"])))
    lines, answers = link.makefile("r"), link.makefile("w")
    def send(message):
        print(json.dumps(message), file=answers, flush=True)
    send([os.environ["REVEILLE_CONNECT"], os.environ["REVEILLE_RUN"], os.environ["REVEILLE_KEY"]])
    for line in lines:
        send(policy(json.loads(line)))
"#;

/// A block of the page.
struct Block<'p> {
    language: &'p str,
    text: &'p str,
}

/// Returns the blocks of a page.
fn blocks(page: &str) -> Vec<Block<'_>> {
    let fenced = page.split("\n```").skip(1).step_by(2);
    let split = |block| -> (&str, &str) { str::split_once(block, '\n').expect("a block has lines") };
    fenced
        .map(split)
        .map(|(language, text)| Block { language, text })
        .collect()
}

/// Whether `line` matches `expected`, a line of the page, in which `…` means any text.
fn matches(line: &str, expected: &str) -> bool {
    let mut parts = expected.split('…');
    let Some(mut unmatched) = line.strip_prefix(parts.next().unwrap_or_default()) else {
        return false;
    };
    let Some(last) = parts.next_back() else {
        return unmatched.is_empty();
    };
    for part in parts {
        let Some(start) = unmatched.find(part) else {
            return false;
        };
        unmatched = &unmatched[start + part.len()..];
    }
    // The last part can also occur in the text that the last gap stands for.
    unmatched.ends_with(last)
}

/// Checks that the lines of a `text` block occur in `output`, in their order.
fn check_shown_lines(command: &str, shown: &str, output: &str) {
    let mut lines = output.lines();
    for expected in shown.lines().filter(|line| *line != "…") {
        let found = lines.any(|line| matches(line.trim_end(), expected));
        assert!(
            found,
            "docs/tutorial.md shows `{expected}` after `{command}`, which printed:\n{output}"
        );
    }
}

/// Answers the decision requests of a run with the policy behind `link`, until the run ends. Requests have the form in
/// which `python/reveille/policy_client.py` passes them to a policy: the stage is 0 for a plan and 1 for wake-ups.
fn decide(link: &TcpStream) {
    let mut lines = BufReader::new(link).lines();
    let mut receive = || -> Value {
        let line = lines.next().expect("the policy answers").expect("a line");
        serde_json::from_str(&line).expect("JSON")
    };
    let target: [String; 3] = serde_json::from_value(receive()).expect("a target");
    let [endpoint, run, key] = target;
    let identity = ClientIdentity {
        name: "the tutorial".to_owned(),
        run_key: Some(key.parse().expect("a key")),
        encoding: Encoding::Json,
    };
    let mut policy = |request: &DecisionRequest| -> Decision {
        let (stage_number, stage) = match request.head.stage {
            RequestKind::Wake => (1, DecisionStage::Wake),
            RequestKind::Plan | RequestKind::Hello | RequestKind::Bye => (0, DecisionStage::Plan),
        };
        let mut request_json = serde_json::to_value(request).expect("JSON");
        request_json["stage"] = json!(stage_number);
        // One write: many small ones would each wait for the acknowledgement of the one before.
        let mut link = link;
        link.write_all(format!("{request_json}\n").as_bytes())
            .expect("the policy reads");
        let answer = receive();
        let devices = |name: &str| serde_json::from_value(answer[name].clone()).expect("devices");
        let mut reply = DecisionReply::for_request(&request.head, "", "");
        (reply.sense, reply.wake) = (devices("sense"), devices("wake"));
        let n = u32::try_from(request.action_mask.0.len()).expect("few devices");
        reply
            .decision(stage, Tti(request.head.tti), n)
            .expect("a valid decision")
    };
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let decision_count = runtime.block_on(async {
        let bus = Bus::connect(&endpoint, run.parse().expect("a run name"), PATIENCE).await;
        client::serve_decisions(&bus.expect("it listens"), &identity, &mut policy).await
    });
    decision_count.expect("the bus is open");
}

/// The reader's terminal: a folder with the program and the stand-in on its search paths.
struct Terminal {
    folder: TestFolder,
    /// Policies connect here, with [`STAND_IN`].
    policy_listener: TcpListener,
}

impl Terminal {
    fn open() -> Self {
        let folder = TestFolder::new();
        for name in ["bin", "stand-in"] {
            fs::create_dir(folder.join(name)).expect("a folder");
        }
        symlink(reveille(), folder.join("bin/reveille")).expect("a link");
        folder.write("stand-in/reveille.py", STAND_IN);
        let policy_listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        Self {
            folder,
            policy_listener,
        }
    }

    /// Runs a command and returns its standard error and output.
    fn run(&self, line: &str) -> String {
        let policy_thread = line.contains("--policy-command").then(|| {
            let listener = self.policy_listener.try_clone().expect("a listener");
            thread::spawn(move || decide(&listener.accept().expect("the policy connects").0))
        });
        let port = self.policy_listener.local_addr().expect("an address").port();
        let search_path = std::env::var("PATH").unwrap_or_default();
        let mut shell = Command::new("sh");
        shell
            .args(["-c", line])
            .current_dir(self.folder.path())
            .env("PATH", format!("{}:{search_path}", self.folder.join("bin").display()))
            .env("XDG_RUNTIME_DIR", self.folder.join("runtime"))
            .env("PYTHONPATH", self.folder.join("stand-in"))
            .env("TUTORIAL_PORT", port.to_string())
            .env_remove("RUST_LOG");
        let finished = Process::start(&mut shell).finish();
        assert!(finished.is_success(), "{line}: {finished}");
        if let Some(policy_thread) = policy_thread {
            policy_thread.join().expect("the policy decides");
        }
        finished.stderr + &finished.stdout
    }
}

#[test]
fn every_command_of_the_tutorial_works_as_shown() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/tutorial.md");
    let page = fs::read_to_string(page).expect("the page");
    let page_blocks = blocks(&page);
    let fences = page.lines().filter(|line| line.trim_start().starts_with("```"));
    assert_eq!(fences.count(), 2 * page_blocks.len(), "a block is indented or open");
    let not_run = page_blocks.iter().filter(|block| block.language == "console");
    let not_run: Vec<&str> = not_run.flat_map(|block| block.text.lines()).collect();
    assert_eq!(not_run, NOT_RUN, "commands that this test leaves out");
    let python_version = Command::new("python3").arg("--version").output();
    if !python_version.is_ok_and(|output| output.status.success()) {
        return skip_except_in_ci("the tutorial is not run: there is no python3 here");
    }

    let terminal = Terminal::open();
    let (mut command_count, mut digest_count) = (0, 0);
    let mut remaining_blocks = page_blocks.iter().peekable();
    while let Some(Block { language, text }) = remaining_blocks.next() {
        match *language {
            "sh" => {
                let output: String = text.lines().map(|line| terminal.run(line)).collect();
                let output_block = remaining_blocks.next_if(|next| next.language == "text");
                let shown = output_block
                    .unwrap_or_else(|| panic!("no output is shown after {text}"))
                    .text;
                check_shown_lines(text, shown, &output);
                command_count += text.lines().count();
                digest_count += shown.matches("digest ").count();
            }
            "toml" | "python" => {
                let name = text.lines().next().and_then(|line| line.strip_prefix("# "));
                terminal
                    .folder
                    .write(name.expect("the first line names the file"), text);
            }
            "console" => {}
            unknown => panic!("a block in {unknown:?} has no purpose here: {text}"),
        }
    }
    // Fewer would mean that the page is read wrongly.
    assert!(
        command_count > 10 && digest_count > 6,
        "{command_count} commands, {digest_count} digests"
    );
    // No step leaves a run behind.
    assert_eq!(terminal.folder.list("runtime/reveille"), Vec::<String>::new());
}

#[test]
fn a_shown_line_matches_only_its_text() {
    assert!(matches("60 runs in 4.1 s", "60 runs in …") && matches("a b c", "a … c") && matches("abc", "…"));
    assert!(matches("1 s of 2 s", "1… s") && matches("a b c b c", "a … b…c"));
    assert!(!matches("61 runs in 4.1 s", "60 runs in …") && !matches("a b c d", "a … c") && !matches("ab", "a"));
    assert!(!matches("1 s of 2", "1… s") && !matches("ab", "ab…b"));
}
