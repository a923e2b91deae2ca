//! Questions and answers between sessions.

use std::pin::Pin;
use std::time::Duration;

use zenoh::Wait;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};

use super::{Bus, BusError, Declared};
use crate::codec;
use crate::message::Question;
use crate::secret::Secret;

/// How long one try of a repeated question may take.
const ONE_TRY: Duration = Duration::from_secs(2);
/// The pause between two tries.
const BETWEEN_TRIES: Duration = Duration::from_millis(200);

/// What is said of a request that is no message, before it is counted.
const MALFORMED: &str = "the request is no message of its kind";

/// Makes an encoded reply of an encoded request and of what the asker shows with it; `Err` says why not.
type Answer = dyn Fn(&[u8], Option<Secret>) -> Result<Vec<u8>, String> + Send + Sync;
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
        self.serve_shown(move |request, _| Ok(answer(request)))
    }

    /// As [`Self::serve`], for questions that not everybody may ask: `answer` gets what the asker shows besides, or
    /// says why not.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve_shown<Q, F>(&self, answer: F) -> Result<Declared, BusError>
    where
        Q: Question<Address = ()>,
        F: Fn(Q, Option<Secret>) -> Result<Q::Reply, String> + Send + Sync + 'static,
    {
        let bus = self.clone();
        let reply = move |request: &[u8], shown: Option<Secret>| {
            let request = codec::decode(request).map_err(|error| {
                bus.count_malformed(Q::KIND.name(), &error);
                format!("{MALFORMED}: {error}")
            })?;
            Ok(codec::encode(&answer(request, shown)?))
        };
        self.serve_bytes(self.keys.of(Q::KIND), Box::new(reply))
    }

    /// As [`Self::serve_shown`], in bytes. It stands apart so that zenoh's generic code is compiled here and once.
    fn serve_bytes(&self, key: String, answer: Box<Answer>) -> Result<Declared, BusError> {
        let bus = self.clone();
        let on_query = move |query: Query| {
            let payload = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            let shown = query.attachment().and_then(|a| a.try_to_string().ok()?.parse().ok());
            let key = query.key_expr().as_str();
            bus.see(key, &payload);
            let reply = match answer(&payload, shown) {
                Ok(reply) => query.reply(key, reply).wait(),
                Err(why) => query.reply_err(codec::encode(&why)).wait(),
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
    pub async fn ask_until<Q>(
        &self,
        request: &Q,
        shown: Option<Secret>,
        patience: Duration,
    ) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Question<Address = ()>,
    {
        let deadline = tokio::time::Instant::now() + patience;
        while tokio::time::Instant::now() < deadline {
            let reply = self.ask_showing(request, shown, ONE_TRY).await?;
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
        self.ask_showing(request, self.key, patience).await
    }

    /// As [`Self::ask`], showing something else than the run's key.
    ///
    /// # Errors
    /// As [`Self::ask`]; [`BusError::Refused`] if the other side will not answer.
    pub async fn ask_showing<Q>(
        &self,
        request: &Q,
        shown: Option<Secret>,
        patience: Duration,
    ) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Question<Address = ()>,
    {
        let reply = self
            .question(self.keys.of(Q::KIND), codec::encode(request), shown, patience)
            .await?;
        Ok(reply.map(|payload| codec::decode(&payload)).transpose()?)
    }

    /// Asks in bytes; boxed so that zenoh's part of it is compiled here and once, not in each program that asks.
    pub(super) fn question(
        &self,
        key: String,
        payload: Vec<u8>,
        shown: Option<Secret>,
        patience: Duration,
    ) -> Reply<'_> {
        Box::pin(async move {
            let question = self.session.get(key).payload(payload);
            let replies = question
                .attachment(shown.map(|secret| secret.to_string()))
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
