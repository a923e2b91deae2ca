//! The bus: zenoh sessions and typed topics. The only file tree that opens a session.
//!
//! The BS listens as a zenoh router, everything else connects to it as a client over TCP. Links are reliable and
//! blocking: losses and delays of the modelled radio never come from here. See [`crate::message`] for what travels: a
//! payload's type names its kind, and with it the key, so that no type travels on another's key.

mod alive;
mod error;
mod query;
mod raw;
mod session;
mod tap;

use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::de::DeserializeOwned;
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use crate::codec::{self, CodecError};
use crate::ids::Tti;
use crate::keys::{Keys, RunName, last_number};
use crate::message::{Payload, TapBatch};

pub use error::BusError;
pub use raw::RawTopic;
pub use session::{LEASE_MS, free_to_listen};
pub use tap::Tap;

/// One session on one run.
#[derive(Clone)]
pub struct Bus {
    session: zenoh::Session,
    keys: Arc<Keys>,
    endpoint: Arc<str>,
    malformed: Arc<AtomicU64>,
    tap: Option<Arc<Tap>>,
}

/// A declaration on the session, which is undone when this is dropped.
pub struct Declared {
    _entity: Box<dyn std::any::Any + Send + Sync>,
}

/// Takes in the key and the bytes of a message.
type Take = dyn Fn(&str, &[u8]) + Send + Sync;

impl Bus {
    fn new(session: zenoh::Session, run: RunName, endpoint: &str) -> Self {
        let malformed = Arc::default();
        Self {
            session,
            keys: Arc::new(Keys::new(run)),
            endpoint: endpoint.into(),
            malformed,
            tap: None,
        }
    }

    /// The keys of the run.
    pub fn keys(&self) -> &Keys {
        &self.keys
    }

    /// Where the BS listens.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// How many payloads were dropped because they were not messages.
    pub fn malformed(&self) -> u64 {
        self.malformed.load(Ordering::Relaxed)
    }

    /// Tells the tap which TTI it is.
    pub fn set_tti(&self, tti: Tti) {
        if let Some(tap) = &self.tap {
            tap.set_tti(tti);
        }
    }

    /// This session for devices in the BS's own process: what they send and hear is not copied to observers, as the BS
    /// hears and sends it all.
    #[must_use]
    pub fn untapped(&self) -> Self {
        Self {
            malformed: Arc::default(),
            tap: None,
            ..self.clone()
        }
    }

    /// The topic of messages of type `P`, from or to `address`.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher<P: Payload>(&self, address: P::Address) -> Result<Topic<P>, BusError> {
        let key = self.keys.typed::<P>(address);
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .congestion_control(CongestionControl::Block)
            .wait()?;
        Ok(Topic {
            publisher,
            key,
            tap: self.tap.clone(),
            _payload: PhantomData,
        })
    }

    /// Calls `handle` with each message of type `P` from or to `address`. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe<P, F>(&self, address: P::Address, handle: F) -> Result<Declared, BusError>
    where
        P: Payload,
        F: Fn(P) + Send + Sync + 'static,
    {
        self.listen_on(self.keys.typed::<P>(address), move |_, message| handle(message))
    }

    /// Calls `handle` with each message of type `P`, whosever it is, and with the number at the end of its key. It must
    /// not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_all<P, F>(&self, handle: F) -> Result<Declared, BusError>
    where
        P: Payload,
        F: Fn(Option<u32>, P) + Send + Sync + 'static,
    {
        self.listen_on(self.keys.all(P::KIND), move |key, message| {
            handle(last_number(key), message);
        })
    }

    /// Calls `handle` with the copies of the BS's traffic. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn observe(&self, handle: impl Fn(TapBatch) + Send + Sync + 'static) -> Result<Declared, BusError> {
        self.listen_on(self.keys.tap(), move |_, batch| handle(batch))
    }

    fn listen_on<T, F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        T: DeserializeOwned,
        F: Fn(&str, T) + Send + Sync + 'static,
    {
        let bus = self.clone();
        let take = move |key: &str, payload: &[u8]| {
            bus.see(key, payload);
            if let Some(message) = bus.read(key, payload) {
                handle(key, message);
            }
        };
        self.listen_for_bytes(key, Box::new(take))
    }

    /// As [`Self::listen_on`], in bytes. It stands apart so that zenoh's generic code is compiled here and once.
    fn listen_for_bytes(&self, key: String, take: Box<Take>) -> Result<Declared, BusError> {
        let on_sample = move |sample: Sample| take(sample.key_expr().as_str(), &sample.payload().to_bytes());
        Ok(Declared::new(
            self.session.declare_subscriber(key).callback(on_sample).wait()?,
        ))
    }

    /// Ends the session; everything declared on it goes.
    pub async fn close(self) {
        // Boxed so that zenoh's part of it is compiled here and once.
        let closing: Pin<Box<dyn Future<Output = zenoh::Result<()>> + Send>> =
            Box::pin(async move { self.session.close().await });
        if let Err(error) = closing.await {
            tracing::debug!(%error, "closing the session");
        }
    }

    fn see(&self, key: &str, payload: &[u8]) {
        if let Some(tap) = &self.tap {
            tap.see(key, payload);
        }
    }

    fn read<T: DeserializeOwned>(&self, key: &str, payload: &[u8]) -> Option<T> {
        codec::decode(payload)
            .inspect_err(|error| self.count_malformed(key, error))
            .ok()
    }

    fn count_malformed(&self, key: &str, error: &CodecError) {
        if self.malformed.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::warn!(key, %error, "dropped a payload that is no message; further ones are only counted");
        }
    }
}

impl Declared {
    fn new(entity: impl Send + Sync + 'static) -> Self {
        Self {
            _entity: Box::new(entity),
        }
    }
}

/// Where messages of type `P` are published, on one key.
pub struct Topic<P> {
    publisher: Publisher<'static>,
    key: String,
    tap: Option<Arc<Tap>>,
    _payload: PhantomData<fn(&P)>,
}

impl<P: Payload> Topic<P> {
    /// Publishes `message`. Waits while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn put(&self, message: &P) -> Result<(), BusError> {
        let payload = codec::encode(message);
        if let Some(tap) = &self.tap {
            tap.see(&self.key, &payload);
        }
        Ok(self.publisher.put(payload).wait()?)
    }
}
