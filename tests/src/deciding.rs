//! Runs that a test decides for over the bus, as it ought to or as it likes.

use std::time::Duration;

use reveille_bs::host::port::client::{self, Introduction};
use reveille_bs::policy::external::wire::{Asked, Said};
use reveille_bs::policy::external::{Answer, Stage};
use reveille_bs::scenario::{Override, load};
use reveille_common::bus::{Bus, PolicyQuestion};
use reveille_common::forms::Form;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::secret::Secret;
use serde_json::{Value, json};

use crate::process::{Finished, Folder, PATIENCE, Process, free_endpoint, unique_run, wait_until};
use crate::transcript::Transcript;

/// A scenario of which a run takes a moment.
pub const SMALL: &str = "-n 30 -k 400";

/// What `policy` decides in the scenario of [`SMALL`], and its digest.
///
/// # Panics
/// If there is no such scenario.
pub fn own(policy: &str, set: &[&str]) -> (Transcript, String) {
    let policy = format!("policy.name={policy}");
    let always = [policy.as_str(), "devices=30", "ttis=400"];
    let all = always
        .iter()
        .chain(set)
        .map(|set| Override::parse(set).expect("an override"));
    let (transcript, digest) = Transcript::of(&load("paper", &all.collect::<Vec<_>>()).expect("a scenario"));
    (transcript, digest.to_string())
}

/// What `transcript` has for a question.
pub fn answer(transcript: &Transcript, asked: &Asked) -> Answer {
    let stage = match asked.head.stage {
        Said::Wake => Stage::Wake,
        Said::Plan | Said::Hello | Said::Bye => Stage::Plan,
    };
    transcript.answer(stage, Tti(asked.head.tti), |DeviceId(j)| {
        asked.action_mask.0[j as usize] == 2
    })
}

/// A run that another program decides for.
pub struct Decided {
    /// Where it runs.
    pub folder: Folder,
    /// Its name.
    pub run: String,
    /// Where its base station listens.
    pub endpoint: String,
    /// The process of `up`.
    pub process: Process,
}

impl Decided {
    /// `up` with the scenario of [`SMALL`] and `args`.
    pub fn start(args: &str) -> Self {
        Self::start_in(Folder::new(), &format!("up {SMALL} -p external --out out {args}"))
    }

    /// A command in a folder.
    pub fn start_in(folder: Folder, command: &str) -> Self {
        let (run, endpoint) = (unique_run("port"), free_endpoint());
        let process = folder.start(&format!("{command} --run {run} --listen {endpoint} --json"));
        Self {
            folder,
            run,
            endpoint,
            process,
        }
    }

    /// The run's key, as its user finds it.
    ///
    /// # Panics
    /// If the run is not found.
    pub fn key(&self) -> Secret {
        wait_until("the run to be found", PATIENCE, || {
            let name = self
                .folder
                .list("runtime/reveille")
                .into_iter()
                .find(|name| name.starts_with(&self.run))?;
            let entry = self.folder.bytes(&format!("runtime/reveille/{name}"));
            let entry: Value = serde_json::from_slice(&entry).ok()?;
            entry["key"].as_str()?.parse().ok()
        })
    }

    /// A session of its own on the run's bus.
    ///
    /// # Panics
    /// If nobody listens.
    pub async fn bus(&self) -> Bus {
        let run = self.run.parse().expect("a run name");
        Bus::connect(&self.endpoint, run, PATIENCE).await.expect("it listens")
    }

    /// Has `decide` answer until the run is over.
    ///
    /// # Panics
    /// If the bus fails.
    pub async fn decide(&self, form: Form, mut decide: impl FnMut(&Asked) -> Answer) -> u64 {
        let introduction = Introduction {
            name: "the test".to_owned(),
            key: Some(self.key()),
            form,
        };
        let decided = client::decide(&self.bus().await, &introduction, &mut decide).await;
        decided.expect("the bus goes on")
    }

    /// Waits for its end.
    pub fn finish(self) -> (Folder, Finished) {
        (self.folder, self.process.finish())
    }
}

/// A program at the port that does as it likes.
pub struct Rogue {
    bus: Bus,
    key: String,
    id: &'static str,
}

impl Rogue {
    /// One that has the key of `run`.
    pub async fn at(run: &Decided) -> Self {
        Self {
            bus: run.bus().await,
            key: run.key().to_string(),
            id: "rogue",
        }
    }

    /// Greets as is expected, and has `act` answer all else, until that says stop or the run is over.
    ///
    /// # Panics
    /// If it is asked what is no JSON.
    pub async fn serve(&self, mut act: impl FnMut(&PolicyQuestion, &Value) -> bool) {
        let questions = self.bus.stand_at_policy_port().expect("a queryable");
        while let Ok(Some(question)) = tokio::time::timeout(Duration::from_secs(3), questions.next()).await {
            let asked: Value = serde_json::from_slice(&question.payload).expect("JSON");
            if asked["stage"] == "hello" {
                let welcome = json!({
                    "protocol": 1, "seq": asked["seq"], "tti": asked["tti"], "stage": "hello",
                    "id": self.id, "name": "a rogue", "key": self.key,
                });
                question
                    .answer(welcome.to_string().into_bytes(), Form::Json)
                    .expect("answered");
            } else if !act(&question, &asked) {
                return;
            }
        }
    }

    /// The answer in which nobody senses and nobody is woken.
    pub fn idle(&self, asked: &Value) -> Value {
        let decision = if asked["stage"] == "plan" { "sense" } else { "wake" };
        let mut answer = json!({
            "protocol": 1, "seq": asked["seq"], "tti": asked["tti"], "stage": asked["stage"],
            "id": self.id, "key": self.key,
        });
        answer[decision] = json!([]);
        answer
    }
}

/// Answers `question` in JSON.
///
/// # Panics
/// If the session is closed.
pub fn say(question: &PolicyQuestion, answer: &Value) {
    question
        .answer(answer.to_string().into_bytes(), Form::Json)
        .expect("answered");
}
