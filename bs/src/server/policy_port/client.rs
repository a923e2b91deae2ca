//! Client side of the policy port, for a process that decides for a run.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, PolicyQuestion, draw_nonce};
use reveille_common::encoding::Encoding;
use reveille_common::secret::Secret;

use crate::policy::external::Decision;
use crate::policy::external::wire::{
    DecisionReply, DecisionRequest, Hello, HelloReply, OLDEST, PROTOCOL, RequestKind, WireHeader,
};
use crate::server::state::now;

/// Interval between checks of whether the base station is alive.
const LOOK: Duration = Duration::from_millis(100);
/// Longest absence of a base station that has not ended the run. Meanwhile this process may have been stopped, its link
/// re-established, or the run resumed at the same address.
const GONE: Duration = Duration::from_secs(30);

/// A rule that answers the decision requests of a run.
pub trait PolicyClient {
    /// Receives the greeting of a run, before its first request or after a break.
    fn hello_received(&mut self, _hello: &Hello) {}

    /// Decides. A repeated request is not passed on again, unless its answer was refused.
    fn decide(&mut self, asked: &DecisionRequest) -> Decision;
}

impl<F: FnMut(&DecisionRequest) -> Decision> PolicyClient for F {
    fn decide(&mut self, asked: &DecisionRequest) -> Decision {
        self(asked)
    }
}

/// Identity of a policy process at the port.
#[derive(Clone, Debug)]
pub struct ClientIdentity {
    /// Its name, for logs and the terminal.
    pub name: String,
    /// The run's key, if the run has one.
    pub key: Option<Secret>,
    /// Encoding in which it wants its requests.
    pub form: Encoding,
}

/// Decides for the run on `bus` until the run ends or its base station is absent for 30 s. Returns the number of
/// decisions.
///
/// # Errors
/// If the bus fails, no base station is found, or the base station refuses this process.
pub async fn decide(
    bus: &Bus,
    introduction: &ClientIdentity,
    decider: &mut impl PolicyClient,
) -> Result<u64, BusError> {
    let is_there = Arc::new(AtomicBool::new(false));
    let there = Arc::clone(&is_there);
    let _watched = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        there.store(alive, Ordering::Relaxed);
    })?;
    let questions = bus.serve_policy_port()?;
    let mut desk = ClientSession {
        id: format!("{:016x}", draw_nonce()?),
        introduction,
        last: None,
        decided: 0,
        is_over: false,
    };
    let mut seen = now();
    while !desk.is_over {
        if is_there.load(Ordering::Relaxed) {
            seen = now();
        } else if seen.elapsed() >= GONE {
            return if desk.last.is_some() {
                Ok(desk.decided)
            } else {
                Err(bus.no_run_error().await)
            };
        }
        match tokio::time::timeout(LOOK, questions.next()).await {
            Ok(Some(question)) => desk.serve(&question, decider)?,
            Ok(None) => break,
            Err(_) => {}
        }
    }
    Ok(desk.decided)
}

/// State of a policy process between requests.
struct ClientSession<'a> {
    id: String,
    introduction: &'a ClientIdentity,
    /// The header of the last request, and the answer in the encoding of that request.
    last: Option<(WireHeader, Vec<u8>)>,
    decided: u64,
    /// Whether the run has ended.
    is_over: bool,
}

impl ClientSession<'_> {
    fn serve(&mut self, question: &PolicyQuestion, decider: &mut impl PolicyClient) -> Result<(), BusError> {
        let form = question.form;
        let head: WireHeader = match form.decode(&question.payload) {
            Ok(head) => head,
            Err(why) => return question.reply_error(&format!("the question cannot be read: {why}")),
        };
        if head.stage == RequestKind::Bye {
            self.is_over = true;
            return Ok(());
        }
        if head.stage == RequestKind::Hello {
            return match form.decode::<Hello>(&question.payload) {
                Ok(hello) => self.welcome(question, &hello, decider),
                Err(why) => question.reply_error(&format!("the greeting cannot be decoded: {why}")),
            };
        }
        let asked: DecisionRequest = match form.decode(&question.payload) {
            Ok(asked) => asked,
            Err(why) => return question.reply_error(&format!("the question cannot be read: {why}")),
        };
        if asked.to != self.id {
            // The request is for another policy process.
            return Ok(());
        }
        match &self.last {
            // The request was repeated, since its answer was lost or late. A refused answer is decided again.
            Some((last, answer)) if *last == head && asked.refused.is_none() => question.answer(answer.clone(), form),
            _ => {
                let reply = DecisionReply::to(&head, &self.id, &self.key()).with(&decider.decide(&asked));
                let answer = form.encode(&reply);
                // Kept before sending, so that a repetition of the request gets the same bytes.
                self.last = Some((head, answer.clone()));
                self.decided += 1;
                question.answer(answer, form)
            }
        }
    }

    fn key(&self) -> String {
        self.introduction.key.map_or_else(String::new, |key| key.to_string())
    }

    fn welcome(
        &self,
        question: &PolicyQuestion,
        hello: &Hello,
        decider: &mut impl PolicyClient,
    ) -> Result<(), BusError> {
        if hello.min > PROTOCOL || hello.max < OLDEST {
            let (min, max) = (hello.min, hello.max);
            return question.reply_error(&format!(
                "it speaks protocol {OLDEST} to {PROTOCOL}, the base station {min} to {max}"
            ));
        }
        // The base station names the refused process in its next greeting, since it cannot reply to a reply.
        if let Some(refused) = hello.refused.as_ref().filter(|refused| refused.id == self.id) {
            return Err(BusError::Refused(refused.why.clone()));
        }
        decider.hello_received(hello);
        let welcome = HelloReply {
            head: WireHeader {
                protocol: PROTOCOL.min(hello.max),
                ..hello.head
            },
            id: self.id.clone(),
            name: self.introduction.name.clone(),
            key: self.key(),
            form: self.introduction.form,
        };
        question.answer(question.form.encode(&welcome), question.form)
    }
}
