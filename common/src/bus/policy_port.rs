//! The policy port: the BS sends decision requests, and a program in any language answers. Payloads are not messages of
//! this crate; they use an [`Encoding`] that other programs read, and zenoh's encoding field names it. Policy processes
//! rely on this: `docs/policy-port.md` is the protocol. `bs/src/server/policy_port/` uses both sides.

use std::pin::Pin;
use std::time::Duration;

use tokio::sync::mpsc::{Receiver, channel};
use zenoh::Wait;
use zenoh::bytes::Encoding as ZenohEncoding;
use zenoh::handlers::FifoChannelHandler;
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable, Reply};

use super::{Bus, BusError};
use crate::encoding::Encoding;

/// A reply to a decision request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortReply {
    /// An answer.
    Answer(Vec<u8>, Encoding),
    /// An error message of the policy process, or the complaint that its answer is too long.
    Refusal(String),
}

/// Replies to one request that are buffered until they are read. Further ones are dropped.
const MAX_BUFFERED_REPLIES: usize = 64;
/// Characters kept of an error message.
const MAX_ERROR_CHARS: usize = 300;

/// The replies to a decision request.
pub struct Replies(Receiver<PortReply>);

impl Replies {
    /// Returns the next reply, or `None` once no more replies can come or the time is up.
    pub async fn next(&mut self) -> Option<PortReply> {
        self.0.recv().await
    }

    /// Returns the buffered replies that were not read.
    pub fn drain(mut self) -> impl Iterator<Item = PortReply> {
        // Closed first, so that a peer that keeps answering cannot keep the caller busy.
        self.0.close();
        std::iter::from_fn(move || self.0.try_recv().ok())
    }
}

/// Decodes `reply`. An answer longer than `max_bytes` bytes becomes a refusal; `None` for zenoh's own errors and for
/// error messages that are too long.
fn decode_reply(reply: &Reply, max_bytes: usize) -> Option<PortReply> {
    match reply.result() {
        Ok(sample) if sample.payload().len() > max_bytes => {
            let length = sample.payload().len();
            let why = format!("an answer has {length} bytes, and the limit is {max_bytes}");
            Some(PortReply::Refusal(why))
        }
        Ok(sample) => Some(PortReply::Answer(
            sample.payload().to_bytes().into_owned(),
            from_zenoh(sample.encoding()),
        )),
        // Errors of a policy process are plain text; zenoh's own errors, such as a timeout, have another encoding.
        Err(error) if *error.encoding() == ZenohEncoding::TEXT_PLAIN && error.payload().len() <= max_bytes => {
            let text = error.payload().try_to_string().unwrap_or_default();
            Some(PortReply::Refusal(text.chars().take(MAX_ERROR_CHARS).collect()))
        }
        Err(_) => None,
    }
}

/// Maps zenoh's encoding. An unknown one counts as JSON, because most programs do not set it.
fn from_zenoh(encoding: &ZenohEncoding) -> Encoding {
    if *encoding == ZenohEncoding::APPLICATION_CBOR {
        Encoding::Cbor
    } else {
        Encoding::Json
    }
}

const fn to_zenoh(encoding: Encoding) -> ZenohEncoding {
    match encoding {
        Encoding::Json => ZenohEncoding::APPLICATION_JSON,
        Encoding::Cbor => ZenohEncoding::APPLICATION_CBOR,
    }
}

/// A request of the BS that a policy process received.
pub struct PortRequest {
    /// The payload of the request.
    pub payload: Vec<u8>,
    /// The encoding of the payload.
    pub encoding: Encoding,
    query: Query,
}

impl PortRequest {
    /// Replies to the request.
    ///
    /// # Errors
    /// If zenoh refuses, for example because the session is closed.
    pub fn reply(&self, payload: Vec<u8>, encoding: Encoding) -> Result<(), BusError> {
        let reply = self.query.reply(self.query.key_expr().clone(), payload);
        Ok(reply.encoding(to_zenoh(encoding)).wait()?)
    }

    /// Replies to the request with an error message.
    ///
    /// # Errors
    /// The errors of [`Self::reply`].
    pub fn reply_error(&self, why: &str) -> Result<(), BusError> {
        Ok(self.query.reply_err(why).encoding(ZenohEncoding::TEXT_PLAIN).wait()?)
    }
}

/// The requests that a policy process receives, in order of arrival.
pub struct PortRequests(Queryable<FifoChannelHandler<Query>>);

impl PortRequests {
    /// Returns the next request, or `None` once the session is closed.
    pub async fn next(&self) -> Option<PortRequest> {
        let query = self.0.recv_async().await.ok()?;
        Some(PortRequest {
            payload: query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default(),
            encoding: query.encoding().map_or(Encoding::Json, from_zenoh),
            query,
        })
    }
}

/// A future of the replies to a decision request.
type PortQueryFuture<'b> = Pin<Box<dyn Future<Output = Result<Replies, BusError>> + Send + 'b>>;

impl Bus {
    /// Sends a decision request to the policy port. The replies that arrive within `patience`, of at most `max_bytes`
    /// bytes each, follow in [`Replies`].
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn query_policy(
        &self,
        (payload, encoding): (Vec<u8>, Encoding),
        max_bytes: usize,
        patience: Duration,
    ) -> PortQueryFuture<'_> {
        // Boxed, so that zenoh's generic code is compiled only once, in this crate.
        Box::pin(async move {
            let (send, replies) = channel(MAX_BUFFERED_REPLIES);
            let query = self.session.get(self.key_exprs.policy_port()).payload(payload);
            query
                .encoding(to_zenoh(encoding))
                // Every reply is needed: any client may answer, and only an answer with the run's key counts.
                .target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .timeout(patience)
                // zenoh drops the callback, and with it the sender, when no more replies can come.
                .callback(move |reply| {
                    // Never blocks, because this is zenoh's thread: a peer that floods the port loses its replies.
                    let _no_room = decode_reply(&reply, max_bytes).is_some_and(|reply| send.try_send(reply).is_err());
                })
                .await?;
            Ok(Replies(replies))
        })
    }

    /// Serves the policy port: requests of the BS arrive at this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn serve_policy_port(&self) -> Result<PortRequests, BusError> {
        Ok(PortRequests(
            self.session.declare_queryable(self.key_exprs.policy_port()).wait()?,
        ))
    }
}
