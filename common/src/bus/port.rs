//! The policy port: the BS asks, and a program of any language answers. Nothing of it is a message of ours: payloads
//! are in a [`Form`] that others read, and zenoh's encoding says in which.

use std::pin::Pin;
use std::time::Duration;

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

/// Answers to a question on the policy port.
pub struct Replies(FifoChannelHandler<Reply>);

impl Replies {
    /// What comes next; nothing once nobody is there who has not answered, or the time is up.
    pub async fn next(&self) -> Option<Heard> {
        loop {
            if let Some(heard) = read(&self.0.recv_async().await.ok()?) {
                return Some(heard);
            }
        }
    }

    /// What has come already and was not taken.
    pub fn rest(&self) -> impl Iterator<Item = Heard> {
        std::iter::from_fn(|| self.0.try_recv().ok().flatten()).filter_map(|reply| read(&reply))
    }
}

fn read(reply: &Reply) -> Option<Heard> {
    match reply.result() {
        Ok(sample) => Some(Heard::Answer(
            sample.payload().to_bytes().into_owned(),
            form(sample.encoding()),
        )),
        // What zenoh says by itself, that the time is up, has no text of anybody.
        Err(error) if *error.encoding() == Encoding::TEXT_PLAIN => {
            let text = error.payload().try_to_string().unwrap_or_default().into_owned();
            Some(Heard::Refusal(text))
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
    /// Asks whoever is at the policy port; what comes within `patience` is in the replies.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn ask_policy(&self, payload: Vec<u8>, form: Form, patience: Duration) -> Asking<'_> {
        // Boxed so that zenoh's part of it is compiled here and once.
        Box::pin(async move {
            let question = self.session.get(self.keys.policy()).payload(payload);
            let replies = question
                .encoding(encoding(form))
                .target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .timeout(patience)
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
