//! Typed queries and replies between sessions ([`crate::message::Query`]): joining, readiness, clock control, actions,
//! the run's description and input log. Decision requests have their own form, in `policy_port`. A refusal is an
//! encoded text, and the attachment of a query is the text of a secret: client and BS must agree on both.

use std::pin::Pin;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::Duration;

use zenoh::Wait;
use zenoh::query::{ConsolidationMode, Query as ZenohQuery, QueryTarget};

use super::{Bus, BusError, DeclarationGuard};
use crate::codec;
use crate::message::Query;
use crate::secret::Secret;

/// Timeout of one attempt of a repeated query.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause between two attempts of a repeated query.
const ATTEMPT_PAUSE: Duration = Duration::from_millis(200);

/// Replies that can wait for clients that read slowly.
const MAX_QUEUED_REPLIES: usize = 1_024;

/// Start of the refusal of a request that cannot be decoded.
const MALFORMED: &str = "the request cannot be decoded";

/// Encodes the reply to an encoded request and the secret sent with it; `Err` holds the reason of a refusal.
type QueryHandler = dyn Fn(&[u8], Option<Secret>) -> Result<Vec<u8>, String> + Send + Sync;
/// A future of an encoded reply, or of `None` without one.
type ReplyFuture<'b> = Pin<Box<dyn Future<Output = Result<Option<Vec<u8>>, BusError>> + Send + 'b>>;

/// A query and its reply; `Err` holds the reason of a refusal.
type QueuedReply = (ZenohQuery, Result<Vec<u8>, String>);

/// Starts a thread that sends replies until the sender is dropped. A reply blocks while its link is congested, and a
/// process with TLS has a single zenoh thread, which could then not write to the link.
fn start_replies() -> Result<SyncSender<QueuedReply>, BusError> {
    let (queue, replies) = sync_channel::<QueuedReply>(MAX_QUEUED_REPLIES);
    std::thread::Builder::new()
        .name("replies".to_owned())
        .spawn(move || {
            for (query, reply) in replies {
                let key = query.key_expr().as_str();
                let sent = match reply {
                    Ok(reply) => query.reply(key, reply).wait(),
                    Err(why) => query.reply_err(codec::encode(&why)).wait(),
                };
                if let Err(error) = sent {
                    tracing::debug!(key, %error, "the client that sent the query has disconnected");
                }
            }
        })
        .map_err(|e| BusError::Zenoh(format!("cannot start the thread of replies: {e}")))?;
    Ok(queue)
}

impl Bus {
    /// Serves queries of type `Q`: `answer` maps each request to its reply. zenoh's threads call `answer`, so it must
    /// not block. `access` must allow the kind, or no query arrives.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve<Q, F>(&self, answer: F) -> Result<DeclarationGuard, BusError>
    where
        Q: Query<Address = ()>,
        F: Fn(Q) -> Q::Reply + Send + Sync + 'static,
    {
        self.serve_with_secret(move |request, _| Ok(answer(request)))
    }

    /// Serves queries that need authorisation: `answer` also receives the secret sent with the request, and may refuse
    /// with a reason.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve_with_secret<Q, F>(&self, answer: F) -> Result<DeclarationGuard, BusError>
    where
        Q: Query<Address = ()>,
        F: Fn(Q, Option<Secret>) -> Result<Q::Reply, String> + Send + Sync + 'static,
    {
        let bus = self.clone();
        let reply_to = move |request: &[u8], secret: Option<Secret>| {
            let request = codec::decode(request).map_err(|error| {
                bus.count_malformed(Q::KIND.name(), &error);
                format!("{MALFORMED}: {error}")
            })?;
            Ok(codec::encode(&answer(request, secret)?))
        };
        self.serve_bytes(self.key_exprs.base_key(Q::KIND), Box::new(reply_to))
    }

    /// Serves like [`Self::serve_with_secret`], in bytes. Not generic, so zenoh's code is compiled only here, once.
    fn serve_bytes(&self, key: String, answer: Box<QueryHandler>) -> Result<DeclarationGuard, BusError> {
        let bus = self.clone();
        let reply_queue = start_replies()?;
        let on_query = move |query: ZenohQuery| {
            let payload = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            // An attachment that is not a valid secret counts as absent.
            let secret = query.attachment().and_then(|a| a.try_to_string().ok()?.parse().ok());
            let key = query.key_expr().as_str();
            bus.copy_emulation(key, &payload);
            let reply = answer(&payload, secret);
            if reply_queue.try_send((query, reply)).is_err() {
                // The client repeats its query.
                tracing::debug!("too many replies wait for clients that do not read; dropped one");
            }
        };
        Ok(DeclarationGuard::new(
            self.session
                .declare_queryable(key)
                .complete(true)
                .callback(on_query)
                .wait()?,
        ))
    }

    /// Repeats a query of type `Q` until it is answered, with `secret` instead of the run's key; `None` without an
    /// answer. After `patience` no further attempt starts, but the last one may still end. While hundreds of sessions
    /// open together, a query can get lost or arrive before zenoh knows the route to its server.
    ///
    /// # Errors
    /// The errors of [`Self::query`].
    pub async fn query_until<Q>(
        &self,
        request: &Q,
        secret: Option<Secret>,
        patience: Duration,
    ) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Query<Address = ()>,
    {
        let deadline = tokio::time::Instant::now() + patience;
        while tokio::time::Instant::now() < deadline {
            // A refusal ends the attempts; only a missing answer is worth another one.
            let reply = self.query_with_secret(request, secret, ATTEMPT_TIMEOUT).await?;
            if reply.is_some() {
                return Ok(reply);
            }
            tokio::time::sleep(ATTEMPT_PAUSE).await;
        }
        Ok(None)
    }

    /// Sends a query of type `Q`; `None` if there is no answer within `patience`.
    ///
    /// # Errors
    /// If the answer is not a valid reply, or zenoh refuses; [`BusError::Refused`] if the other side refuses.
    pub async fn query<Q>(&self, request: &Q, patience: Duration) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Query<Address = ()>,
    {
        self.query_with_secret(request, self.run_key, patience).await
    }

    /// Sends a query like [`Self::query`], with `secret` instead of the run's key.
    ///
    /// # Errors
    /// The errors of [`Self::query`].
    pub(crate) async fn query_with_secret<Q>(
        &self,
        request: &Q,
        secret: Option<Secret>,
        patience: Duration,
    ) -> Result<Option<Q::Reply>, BusError>
    where
        Q: Query<Address = ()>,
    {
        let reply = self
            .query_raw(
                self.key_exprs.base_key(Q::KIND),
                codec::encode(request),
                secret,
                patience,
            )
            .await?;
        Ok(reply.map(|payload| codec::decode(&payload)).transpose()?)
    }

    /// Queries in bytes. Boxed, so zenoh's code is compiled only here and not in each program that uses it.
    pub(super) fn query_raw(
        &self,
        key: String,
        payload: Vec<u8>,
        secret: Option<Secret>,
        patience: Duration,
    ) -> ReplyFuture<'_> {
        Box::pin(async move {
            let query = self.session.get(key).payload(payload);
            let replies = query
                .attachment(secret.map(|secret| secret.to_string()))
                .target(QueryTarget::BestMatching)
                // Consolidation could hold the reply back until zenoh knows that no other one follows.
                .consolidation(ConsolidationMode::None)
                .timeout(patience)
                .await?;
            while let Ok(reply) = replies.recv_async().await {
                match reply.into_result() {
                    Ok(sample) => return Ok(Some(sample.payload().to_bytes().into_owned())),
                    Err(error) => {
                        // A refusal by the BS is encoded; any other error is zenoh's timeout.
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
