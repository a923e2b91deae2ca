//! Access to the bus in raw bytes, for the benchmark and for tests and tools that act as a broken peer. Observers
//! receive no copies of this traffic. No run uses this module.

use std::time::Duration;

use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use super::{Bus, BusError, DeclarationGuard};

/// A key on which bytes are published.
pub struct RawTopic(Publisher<'static>);

impl RawTopic {
    /// Publishes `payload`. Blocks while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn put(&self, payload: &[u8]) -> Result<(), BusError> {
        Ok(self.0.put(payload).wait()?)
    }
}

impl Bus {
    /// Declares a key for repeated publishing of bytes.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher_raw(&self, key: String) -> Result<RawTopic, BusError> {
        let publisher = self.session.declare_publisher(key);
        Ok(RawTopic(publisher.congestion_control(CongestionControl::Block).wait()?))
    }

    /// Calls `handle` with the bytes of everything published on `key`. The callback must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_raw<F>(&self, key: String, handle: F) -> Result<DeclarationGuard, BusError>
    where
        F: Fn(&[u8]) + Send + Sync + 'static,
    {
        let on_sample = move |sample: Sample| handle(&sample.payload().to_bytes());
        Ok(DeclarationGuard::new(
            self.session.declare_subscriber(key).callback(on_sample).wait()?,
        ))
    }

    /// Publishes `payload` on `key` unchanged, whether it is a message or not.
    ///
    /// # Errors
    /// If the key is invalid, or the session is closed.
    pub fn put_raw(&self, key: &str, payload: Vec<u8>) -> Result<(), BusError> {
        let put = self.session.put(key, payload);
        Ok(put.congestion_control(CongestionControl::Block).wait()?)
    }

    /// Sends `payload` unchanged as a query to `key`, message or not; `None` without an answer within `patience`.
    ///
    /// # Errors
    /// If the other side cannot decode the query, or zenoh refuses.
    pub async fn query_raw_without_secret(
        &self,
        key: String,
        payload: Vec<u8>,
        patience: Duration,
    ) -> Result<Option<Vec<u8>>, BusError> {
        self.query_raw(key, payload, None, patience).await
    }
}
