//! The other side of the policy port: a process that decides for a run.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, PolicyQuestion, draw_nonce};
use reveille_common::forms::Form;
use reveille_common::secret::Secret;

use crate::host::wall::now;
use crate::policy::external::Answer;
use crate::policy::external::wire::{Asked, Head, Hello, OLDEST, PROTOCOL, Reply, Said, Welcome};

/// How often it is looked whether the base station is still there.
const LOOK: Duration = Duration::from_millis(100);
/// How long a base station that does not say that the run is over may be gone: this process may have been stopped for a
/// while, and its link be made anew, or the base station be taken up at the same place.
const GONE: Duration = Duration::from_secs(30);

/// Who decides.
pub trait Decider {
    /// A run greets, before its first question or after a break.
    fn greeted(&mut self, _hello: &Hello) {}

    /// Decides. The same question is not handed on twice.
    fn decide(&mut self, asked: &Asked) -> Answer;
}

impl<F: FnMut(&Asked) -> Answer> Decider for F {
    fn decide(&mut self, asked: &Asked) -> Answer {
        self(asked)
    }
}

/// By what a process is known.
#[derive(Clone, Debug)]
pub struct Introduction {
    /// What it is called, for people.
    pub name: String,
    /// The run's key, which it must show.
    pub key: Option<Secret>,
    /// The form in which it wants its questions.
    pub form: Form,
}

/// Decides for the run on `bus` until it is over, or its base station gone for good. Gives how often it has decided.
///
/// # Errors
/// If the bus fails, or the base station does not let this process decide.
pub async fn decide(bus: &Bus, introduction: &Introduction, decider: &mut impl Decider) -> Result<u64, BusError> {
    let is_there = Arc::new(AtomicBool::new(false));
    let there = Arc::clone(&is_there);
    let _watched = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        there.store(alive, Ordering::Relaxed);
    })?;
    let questions = bus.stand_at_policy_port()?;
    let mut desk = Desk {
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
                Err(bus.no_run().await)
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

/// A process that has been asked so far.
struct Desk<'a> {
    id: String,
    introduction: &'a Introduction,
    /// The last question, and its answer in the form in which it was asked.
    last: Option<(Head, Vec<u8>)>,
    decided: u64,
    /// Whether the run is.
    is_over: bool,
}

impl Desk<'_> {
    fn serve(&mut self, question: &PolicyQuestion, decider: &mut impl Decider) -> Result<(), BusError> {
        let form = question.form;
        let head: Head = match form.decode(&question.payload) {
            Ok(head) => head,
            Err(why) => return question.refuse(&format!("the question cannot be read: {why}")),
        };
        if head.stage == Said::Bye {
            self.is_over = true;
            return Ok(());
        }
        if head.stage == Said::Hello {
            return match form.decode::<Hello>(&question.payload) {
                Ok(hello) => self.welcome(question, &hello, decider),
                Err(why) => question.refuse(&format!("the greeting cannot be read: {why}")),
            };
        }
        let asked: Asked = match form.decode(&question.payload) {
            Ok(asked) => asked,
            Err(why) => return question.refuse(&format!("the question cannot be read: {why}")),
        };
        if asked.to != self.id {
            // Somebody else is asked.
            return Ok(());
        }
        match &self.last {
            // It is asked again: its answer was lost, or came too late.
            Some((last, answer)) if *last == head && asked.refused.is_none() => question.answer(answer.clone(), form),
            _ => {
                let reply = Reply::to(&head, &self.id, &self.key()).with(&decider.decide(&asked));
                let answer = form.encode(&reply);
                self.last = Some((head, answer.clone()));
                self.decided += 1;
                question.answer(answer, form)
            }
        }
    }

    fn key(&self) -> String {
        self.introduction.key.map_or_else(String::new, |key| key.to_string())
    }

    fn welcome(&self, question: &PolicyQuestion, hello: &Hello, decider: &mut impl Decider) -> Result<(), BusError> {
        if hello.min > PROTOCOL || hello.max < OLDEST {
            let (min, max) = (hello.min, hello.max);
            return question.refuse(&format!(
                "it speaks protocol {OLDEST} to {PROTOCOL}, the base station {min} to {max}"
            ));
        }
        if let Some(refused) = hello.refused.as_ref().filter(|refused| refused.id == self.id) {
            return Err(BusError::Refused(refused.why.clone()));
        }
        decider.greeted(hello);
        let welcome = Welcome {
            head: Head {
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
