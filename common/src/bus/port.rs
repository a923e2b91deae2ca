//! The policy port: the BS asks, and a program of any language answers. Nothing of it is a message of ours: payloads
//! are in a [`Form`] that others read, and zenoh's encoding says in which.

use std::pin::Pin;
use std::time::Duration;

use tokio::sync::mpsc::{Receiver, channel};
use zenoh::Wait;
use zenoh::bytes::Encoding;
use zenoh::handlers::FifoChannelHandler;
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable, Reply};

use super::{Bus, BusError};
use crate::forms::Form;

/// What has come of a question.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heard {
    /// An answer.
    Answer(Vec<u8>, Form),
    /// Somebody was asked and says why not.
    Refusal(String),
}

/// Replies to a question that are kept until somebody looks at them. Who floods the port loses what is beyond.
const KEPT: usize = 64;
/// Characters of a refusal that are kept.
const WORDS: usize = 300;

/// Answers to a question on the policy port.
pub struct Replies(Receiver<Heard>);

impl Replies {
    /// What comes next; nothing once nobody is there who has not answered, or the time is up.
    pub async fn next(&mut self) -> Option<Heard> {
        self.0.recv().await
    }

    /// What has come already and was not taken.
    pub fn rest(mut self) -> impl Iterator<Item = Heard> {
        self.0.close();
        std::iter::from_fn(move || self.0.try_recv().ok())
    }
}

/// What `reply` says, unless it is longer than `most` bytes.
fn read(reply: &Reply, most: usize) -> Option<Heard> {
    match reply.result() {
        Ok(sample) if sample.payload().len() > most => {
            let length = sample.payload().len();
            let why = format!("an answer of {length} bytes came, and {most} are the most that one can have");
            Some(Heard::Refusal(why))
        }
        Ok(sample) => Some(Heard::Answer(
            sample.payload().to_bytes().into_owned(),
            form(sample.encoding()),
        )),
        // What zenoh says by itself, that the time is up, has no text of anybody.
        Err(error) if *error.encoding() == Encoding::TEXT_PLAIN && error.payload().len() <= most => {
            let text = error.payload().try_to_string().unwrap_or_default();
            Some(Heard::Refusal(text.chars().take(WORDS).collect()))
        }
        Err(_) => None,
    }
}

/// Bytes of an encoding that is none of ours are looked at as JSON: most programs do not say.
fn form(encoding: &Encoding) -> Form {
    if *encoding == Encoding::APPLICATION_CBOR {
        Form::Cbor
    } else {
        Form::Json
    }
}

const fn encoding(form: Form) -> Encoding {
    match form {
        Form::Json => Encoding::APPLICATION_JSON,
        Form::Cbor => Encoding::APPLICATION_CBOR,
    }
}

/// A question that a policy process was asked.
pub struct PolicyQuestion {
    /// What was asked.
    pub payload: Vec<u8>,
    /// In which form.
    pub form: Form,
    query: Query,
}

impl PolicyQuestion {
    /// Answers it.
    ///
    /// # Errors
    /// If zenoh refuses, as where the session is closed.
    pub fn answer(&self, payload: Vec<u8>, form: Form) -> Result<(), BusError> {
        let reply = self.query.reply(self.query.key_expr().clone(), payload);
        Ok(reply.encoding(encoding(form)).wait()?)
    }

    /// Says why it is not answered.
    ///
    /// # Errors
    /// As of [`Self::answer`].
    pub fn refuse(&self, why: &str) -> Result<(), BusError> {
        Ok(self.query.reply_err(why).encoding(Encoding::TEXT_PLAIN).wait()?)
    }
}

/// The questions that a policy process is asked, in the order in which they came.
pub struct PolicyQuestions(Queryable<FifoChannelHandler<Query>>);

impl PolicyQuestions {
    /// The next; nothing once the session is closed.
    pub async fn next(&self) -> Option<PolicyQuestion> {
        let query = self.0.recv_async().await.ok()?;
        Some(PolicyQuestion {
            payload: query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default(),
            form: query.encoding().map_or(Form::Json, form),
            query,
        })
    }
}

/// Replies that are on their way.
type Asking<'b> = Pin<Box<dyn Future<Output = Result<Replies, BusError>> + Send + 'b>>;

impl Bus {
    /// Asks whoever is at the policy port; what comes within `patience`, of `most` bytes each, is in the replies.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn ask_policy(&self, (payload, form): (Vec<u8>, Form), most: usize, patience: Duration) -> Asking<'_> {
        // Boxed so that zenoh's part of it is compiled here and once.
        Box::pin(async move {
            let (send, replies) = channel(KEPT);
            let question = self.session.get(self.keys.policy()).payload(payload);
            question
                .encoding(encoding(form))
                .target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .timeout(patience)
                // zenoh lets go of it, and so of the sender, when no more can come.
                .callback(move |reply| {
                    let _no_room = read(&reply, most).is_some_and(|heard| send.try_send(heard).is_err());
                })
                .await?;
            Ok(Replies(replies))
        })
    }

    /// Stands at the policy port: what the BS asks from now on comes here.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn stand_at_policy_port(&self) -> Result<PolicyQuestions, BusError> {
        Ok(PolicyQuestions(
            self.session.declare_queryable(self.keys.policy()).wait()?,
        ))
    }
}
