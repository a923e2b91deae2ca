//! Questions and answers between sessions.

use std::pin::Pin;
use std::time::Duration;

use zenoh::Wait;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};

use super::{Bus, BusError, Declared};
use crate::codec::{self, CodecError};
use crate::message::Question;

/// How long one try of a repeated question may take.
const ONE_TRY: Duration = Duration::from_secs(2);
/// The pause between two tries.
const BETWEEN_TRIES: Duration = Duration::from_millis(200);

/// Makes an encoded reply of an encoded request.
type Answer = dyn Fn(&[u8]) -> Result<Vec<u8>, CodecError> + Send + Sync;
/// An encoded reply, if there comes one.
type Reply<'b> = Pin<Box<dyn Future<Output = Result<Option<Vec<u8>>, BusError>> + Send + 'b>>;

impl Bus {
    /// Answers queries of type `Q`: `answer` gets the request, says how to reply, and is called on zenoh's threads.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve<Q, F>(&self, answer: F) -> Result<Declared, BusError>
    where
        Q: Question<Address = ()>,
        F: Fn(Q) -> Q::Reply + Send + Sync + 'static,
    {
        let reply = move |request: &[u8]| Ok(codec::encode(&answer(codec::decode(request)?)));
        self.serve_bytes(self.keys.of(Q::KIND), Box::new(reply))
    }

    /// As [`Self::serve`], in bytes. It stands apart so that zenoh's generic code is compiled here and once.
    fn serve_bytes(&self, key: String, answer: Box<Answer>) -> Result<Declared, BusError> {
        let bus = self.clone();
        let on_query = move |query: Query| {
            let payload = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            let key = query.key_expr().as_str();
            bus.see(key, &payload);
            let reply = match answer(&payload) {
                Ok(reply) => query.reply(key, reply).wait(),
                Err(error) => {
                    bus.count_malformed(key, &error);
                    query.reply_err(codec::encode(&error.to_string())).wait()
                }
            };
            if let Err(error) = reply {
                tracing::debug!(key, %error, "the asker has gone");
            }
        };
        Ok(Declared::new(
            self.session
                .declare_queryable(key)
                .complete(true)
                .callback(on_query)
                .wait()?,
        ))
    }

    /// Asks whoever serves queries of type `Q` again and again; `None` if nobody answers within `patience`. Where
    /// hundreds of sessions open at once, a question can come before the way to the one who serves is known, or get
    /// lost.
    ///
    /// # Errors
    /// As [`Self::ask`].
    pub async fn ask_until<Q>(&self, request: &Q, patience: Duration) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Question<Address = ()>,
    {
        let deadline = tokio::time::Instant::now() + patience;
        while tokio::time::Instant::now() < deadline {
            let reply = self.ask(request, ONE_TRY).await?;
            if reply.is_some() {
                return Ok(reply);
            }
            tokio::time::sleep(BETWEEN_TRIES).await;
        }
        Ok(None)
    }

    /// Asks whoever serves queries of type `Q`; `None` if nobody does within `patience`.
    ///
    /// # Errors
    /// If the answer is not a reply, or zenoh refuses.
    pub async fn ask<Q>(&self, request: &Q, patience: Duration) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Question<Address = ()>,
    {
        let reply = self
            .question(self.keys.of(Q::KIND), codec::encode(request), patience)
            .await?;
        Ok(reply.map(|payload| codec::decode(&payload)).transpose()?)
    }

    /// Asks in bytes; boxed so that zenoh's part of it is compiled here and once, not in each program that asks.
    pub(super) fn question(&self, key: String, payload: Vec<u8>, patience: Duration) -> Reply<'_> {
        Box::pin(async move {
            let replies = self
                .session
                .get(key)
                .payload(payload)
                .target(QueryTarget::BestMatching)
                .consolidation(ConsolidationMode::None)
                .timeout(patience)
                .await?;
            while let Ok(reply) = replies.recv_async().await {
                match reply.into_result() {
                    Ok(sample) => return Ok(Some(sample.payload().to_bytes().into_owned())),
                    Err(error) => {
                        // An answer of ours is encoded; anything else is zenoh saying that none came in time.
                        if let Ok(text) = codec::decode::<String>(&error.payload().to_bytes()) {
                            return Err(BusError::Refused(text));
                        }
                    }
                }
            }
            Ok(None)
        })
    }
}
