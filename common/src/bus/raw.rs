//! A door for bytes that are no messages: for the benchmark, and for tests and tools that play a broken peer. Nothing
//! of it is copied to observers.

use std::time::Duration;

use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use super::{Bus, BusError, Declared};

/// A key to publish bytes on.
pub struct RawTopic(Publisher<'static>);

impl RawTopic {
    /// Publishes `payload`. Waits while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn put(&self, payload: &[u8]) -> Result<(), BusError> {
        Ok(self.0.put(payload).wait()?)
    }
}

impl Bus {
    /// A key to publish bytes on again and again.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher_raw(&self, key: String) -> Result<RawTopic, BusError> {
        let publisher = self.session.declare_publisher(key);
        Ok(RawTopic(publisher.congestion_control(CongestionControl::Block).wait()?))
    }

    /// Calls `handle` with the bytes of everything published on `key`. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_raw<F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        F: Fn(&[u8]) + Send + Sync + 'static,
    {
        let on_sample = move |sample: Sample| handle(&sample.payload().to_bytes());
        Ok(Declared::new(
            self.session.declare_subscriber(key).callback(on_sample).wait()?,
        ))
    }

    /// Publishes `payload` on `key` as it is, message or not.
    ///
    /// # Errors
    /// If the key is not one, or the session is closed.
    pub fn put_raw(&self, key: &str, payload: Vec<u8>) -> Result<(), BusError> {
        let put = self.session.put(key, payload);
        Ok(put.congestion_control(CongestionControl::Block).wait()?)
    }

    /// Asks whoever serves `key` with `payload` as it is, message or not; `None` if nobody answers within `patience`.
    ///
    /// # Errors
    /// If the other side could not read the question, or zenoh refuses.
    pub async fn ask_raw(
        &self,
        key: String,
        payload: Vec<u8>,
        patience: Duration,
    ) -> Result<Option<Vec<u8>>, BusError> {
        self.question(key, payload, None, patience).await
    }
}
