//! The bus: zenoh sessions and typed topics. The only file tree that opens a session.
//!
//! The BS listens as a zenoh router, everything else connects to it as a client over TCP. Links are reliable and blocking:
//! losses and delays of the modelled radio never come from here. See [`crate::message`] for what travels.

mod alive;
mod bare;
mod error;
mod query;
mod session;
mod tap;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use serde::de::DeserializeOwned;
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use crate::codec::{self, CodecError};
use crate::ids::Tti;
use crate::keys::{Keys, RunName};

pub use bare::{BareBarrier, bare_host};
pub use error::BusError;
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

/// Undone when dropped.
pub struct Declared {
    _entity: Box<dyn std::any::Any + Send + Sync>,
}

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

    /// A topic to publish on.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher(&self, key: String) -> Result<Topic, BusError> {
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .congestion_control(CongestionControl::Block)
            .wait()?;
        Ok(Topic {
            publisher,
            key,
            tap: self.tap.clone(),
        })
    }

    /// Publishes `payload` on `key` as it is, message or not. For tests and tools that play a broken peer.
    ///
    /// # Errors
    /// If the key is not one, or the session is closed.
    pub fn put_raw(&self, key: &str, payload: Vec<u8>) -> Result<(), BusError> {
        let put = self.session.put(key, payload);
        Ok(put.congestion_control(CongestionControl::Block).wait()?)
    }

    /// Calls `handle` with the key and the message of everything published on `key`. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe<T, F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        T: DeserializeOwned,
        F: Fn(&str, T) + Send + Sync + 'static,
    {
        let bus = self.clone();
        let on_sample = move |sample: Sample| {
            let (key, payload) = (sample.key_expr().as_str(), sample.payload().to_bytes());
            bus.see(key, &payload);
            if let Some(message) = bus.read(key, &payload) {
                handle(key, message);
            }
        };
        Ok(Declared::new(
            self.session.declare_subscriber(key).callback(on_sample).wait()?,
        ))
    }

    /// Ends the session; everything declared on it goes.
    pub async fn close(self) {
        if let Err(error) = self.session.close().await {
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

/// A key to publish on.
pub struct Topic {
    publisher: Publisher<'static>,
    key: String,
    tap: Option<Arc<Tap>>,
}

impl Topic {
    /// Publishes `message`. Waits while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn put<T: Serialize>(&self, message: &T) -> Result<(), BusError> {
        let payload = codec::encode(message);
        if let Some(tap) = &self.tap {
            tap.see(&self.key, &payload);
        }
        Ok(self.publisher.put(payload).wait()?)
    }
}
