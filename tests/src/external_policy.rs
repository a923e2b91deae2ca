//! Runs whose policy process is the test itself, either correct or misbehaving, for `policy_port.rs` and
//! `misbehaving_policy.rs` in `tests/program/`.

use std::time::Duration;

use reveille_bs::policy::external::wire::{DecisionRequest, RequestKind};
use reveille_bs::policy::external::{Decision, DecisionStage};
use reveille_bs::server::policy_port::client::{self, ClientIdentity};
use reveille_common::bus::{Bus, PortRequest};
use reveille_common::encoding::Encoding;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::secret::Secret;
use serde_json::{Value, json};

use crate::process::{FinishedProcess, PATIENCE, Process, TestFolder, free_endpoint, unique_run, wait_until};
use crate::scenarios::paper;
use crate::transcript::CommandTranscript;

/// Options of a short run with 30 devices and 400 TTIs. [`run_built_in`], [`TestFolder::start_waiting_bs`] and the
/// tests repeat these numbers.
pub const SHORT_RUN: &str = "-n 30 -k 400";

/// Runs `policy` in memory, on the scenario of [`SHORT_RUN`] with `fields` overridden, and returns its transcript and
/// digest.
///
/// # Panics
/// If the scenario is invalid.
pub fn run_built_in(policy: &str, fields: &[&str]) -> (CommandTranscript, String) {
    let policy = format!("policy.name={policy}");
    let fields = [&[policy.as_str(), "devices=30", "ttis=400"], fields].concat();
    let (transcript, digest) = CommandTranscript::of(&paper(&fields));
    (transcript, digest.to_string())
}

/// Entry of an action mask for a device that can still be woken, as `write_mask` in
/// `bs/src/policy/external/features.rs` writes it; other devices have 0.
pub const MAY_WAKE: u8 = 2;

/// Looks up the decision that `request` asks for in `transcript`.
///
/// # Panics
/// If the transcript has no plan for the TTI, or more devices than the request.
pub fn answer_from(transcript: &CommandTranscript, request: &DecisionRequest) -> Decision {
    let stage = match request.head.stage {
        RequestKind::Wake => DecisionStage::Wake,
        RequestKind::Plan | RequestKind::Hello | RequestKind::Bye => DecisionStage::Plan,
    };
    transcript.answer(stage, Tti(request.head.tti), |DeviceId(j)| {
        // The transcript holds all wake-ups of the TTI, also of devices that earlier answers have woken.
        request.action_mask.0[j as usize] == MAY_WAKE
    })
}

/// A run that waits for an external policy process.
pub struct ExternallyDecidedRun {
    /// Working folder of the run.
    pub folder: TestFolder,
    /// Run name.
    pub name: String,
    /// Endpoint of the base station.
    pub endpoint: String,
    /// Process of the command, such as `up`, that runs the base station.
    pub process: Process,
}

impl ExternallyDecidedRun {
    /// Starts `up` in a new folder with the scenario of [`SHORT_RUN`], policy `external`, the run folder `out` and
    /// `args`.
    pub fn start(args: &str) -> Self {
        Self::start_in(
            TestFolder::new(),
            &format!("up {SHORT_RUN} -p external --out out {args}"),
        )
    }

    /// Starts a command that runs a base station in the given folder: `command` has no `--run`, `--listen` and
    /// `--json`.
    pub fn start_in(folder: TestFolder, command: &str) -> Self {
        let (name, endpoint) = (unique_run("port"), free_endpoint());
        let process = folder.start(&format!("{command} --run {name} --listen {endpoint} --json"));
        Self {
            folder,
            name,
            endpoint,
            process,
        }
    }

    /// Returns the run's key from the registry of runs.
    ///
    /// # Panics
    /// If the run is not found.
    pub fn key(&self) -> Secret {
        wait_until("the run to be found", PATIENCE, || {
            let file_name = self
                .folder
                .list("runtime/reveille")
                .into_iter()
                .find(|file_name| file_name.starts_with(&self.name))?;
            let entry = self.folder.bytes(&format!("runtime/reveille/{file_name}"));
            let entry: Value = serde_json::from_slice(&entry).ok()?;
            entry["key"].as_str()?.parse().ok()
        })
    }

    /// Opens a separate session on the run's bus.
    ///
    /// # Panics
    /// If no base station listens.
    pub async fn bus(&self) -> Bus {
        let name = self.name.parse().expect("a run name");
        Bus::connect(&self.endpoint, name, PATIENCE).await.expect("it listens")
    }

    /// Answers decision requests with `policy` until the run ends or its base station is lost; returns the number of
    /// answers.
    ///
    /// # Panics
    /// If the bus fails, or the run has no key.
    pub async fn decide(&self, encoding: Encoding, mut policy: impl FnMut(&DecisionRequest) -> Decision) -> u64 {
        let identity = ClientIdentity {
            name: "the test".to_owned(),
            run_key: Some(self.key()),
            encoding,
        };
        let answer_count = client::serve_decisions(&self.bus().await, &identity, &mut policy).await;
        answer_count.expect("the bus is open")
    }

    /// Waits for the end of the process. Returns the working folder, which is removed on drop, and the ended process.
    pub fn finish(self) -> (TestFolder, FinishedProcess) {
        (self.folder, self.process.finish())
    }
}

/// Version of the protocol that a [`MisbehavingPolicy`] speaks, `OLDEST_PROTOCOL` in `bs/src/policy/external/wire.rs`.
const PROTOCOL: u32 = 1;
/// Process id of every [`MisbehavingPolicy`] at the policy port.
const ROGUE_ID: &str = "rogue";

/// A policy process that misbehaves. It writes its replies as JSON, with the field names of
/// `bs/src/policy/external/wire.rs`.
pub struct MisbehavingPolicy {
    bus: Bus,
    /// The run's key, as hexadecimal text.
    key: String,
}

impl MisbehavingPolicy {
    /// Connects to `run` with its key.
    pub async fn connect(run: &ExternallyDecidedRun) -> Self {
        Self {
            bus: run.bus().await,
            key: run.key().to_string(),
        }
    }

    /// Answers the hello request and passes other requests to `handle_request`, which replies itself, until it returns
    /// false or no request arrives for 3 s. The end of the run is such a request too, with the stage `bye`.
    ///
    /// # Panics
    /// If a request is not JSON, or the session is closed.
    pub async fn serve(&self, mut handle_request: impl FnMut(&PortRequest, &Value) -> bool) {
        let requests = self.bus.serve_policy_port().expect("a queryable");
        while let Ok(Some(port_request)) = tokio::time::timeout(Duration::from_secs(3), requests.next()).await {
            let request: Value = serde_json::from_slice(&port_request.payload).expect("JSON");
            if request["stage"] == "hello" {
                let hello_reply = json!({
                    "protocol": PROTOCOL, "seq": request["seq"], "tti": request["tti"], "stage": "hello",
                    "id": ROGUE_ID, "name": "a rogue", "key": self.key,
                });
                send_reply(&port_request, &hello_reply);
            } else if !handle_request(&port_request, &request) {
                return;
            }
        }
    }

    /// Returns the answer in which no device senses and none is woken.
    pub fn idle_answer(&self, request: &Value) -> Value {
        let decision_field = if request["stage"] == "plan" { "sense" } else { "wake" };
        let mut answer = json!({
            "protocol": PROTOCOL, "seq": request["seq"], "tti": request["tti"], "stage": request["stage"],
            "id": ROGUE_ID, "key": self.key,
        });
        answer[decision_field] = json!([]);
        answer
    }
}

/// Replies to `request` in JSON.
///
/// # Panics
/// If the session is closed.
pub fn send_reply(request: &PortRequest, reply: &Value) {
    request
        .reply(reply.to_string().into_bytes(), Encoding::Json)
        .expect("an open session");
}
