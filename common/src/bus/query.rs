//! Questions and answers between sessions.

use std::time::Duration;

use serde::Serialize;
use serde::de::DeserializeOwned;
use zenoh::Wait;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};

use super::{Bus, BusError, Declared};
use crate::codec;

/// How long one try of a repeated question may take.
const ONE_TRY: Duration = Duration::from_secs(2);
/// The pause between two tries.
const BETWEEN_TRIES: Duration = Duration::from_millis(200);

impl Bus {
    /// Answers queries on `key`: `answer` gets the request, says how to reply, and is called on zenoh's threads.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve<Q, R, F>(&self, key: String, answer: F) -> Result<Declared, BusError>
    where
        Q: DeserializeOwned,
        R: Serialize,
        F: Fn(Q) -> R + Send + Sync + 'static,
    {
        let bus = self.clone();
        let on_query = move |query: Query| {
            let payload = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            let key = query.key_expr().as_str();
            bus.see(key, &payload);
            let reply = match codec::decode(&payload) {
                Ok(request) => query.reply(key, codec::encode(&answer(request))).wait(),
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

    /// Asks whoever serves `key` again and again; `None` if nobody answers within `patience`. Where hundreds of sessions
    /// open at once, a question can come before the way to the one who serves is known, or get lost.
    ///
    /// # Errors
    /// As [`Self::ask`].
    pub async fn ask_until<Q: Serialize, R: DeserializeOwned>(
        &self,
        key: String,
        request: &Q,
        patience: Duration,
    ) -> Result<Option<R>, BusError> {
        let deadline = tokio::time::Instant::now() + patience;
        while tokio::time::Instant::now() < deadline {
            let reply = self.ask(key.clone(), request, ONE_TRY).await?;
            if reply.is_some() {
                return Ok(reply);
            }
            tokio::time::sleep(BETWEEN_TRIES).await;
        }
        Ok(None)
    }

    /// Asks whoever serves `key`; `None` if nobody does within `patience`.
    ///
    /// # Errors
    /// If the answer is not a reply, or zenoh refuses.
    pub async fn ask<Q: Serialize, R: DeserializeOwned>(
        &self,
        key: String,
        request: &Q,
        patience: Duration,
    ) -> Result<Option<R>, BusError> {
        let replies = self
            .session
            .get(key)
            .payload(codec::encode(request))
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .timeout(patience)
            .await?;
        while let Ok(reply) = replies.recv_async().await {
            match reply.into_result() {
                Ok(sample) => return Ok(Some(codec::decode(&sample.payload().to_bytes())?)),
                Err(error) => {
                    // An answer of ours is encoded; anything else is zenoh saying that none came in time.
                    if let Ok(text) = codec::decode::<String>(&error.payload().to_bytes()) {
                        return Err(BusError::Refused(text));
                    }
                }
            }
        }
        Ok(None)
    }
}
