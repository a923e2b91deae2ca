//! The bus: zenoh sessions and typed topics. The only file tree that opens a session.
//!
//! The BS listens as a zenoh router, everything else connects to it as a client over TCP. Links are reliable and
//! blocking: losses and delays of the modelled radio never come from here. See [`crate::message`] for what travels: a
//! payload's type names its kind, and with it the key, so that no type travels on another's key. What a peer may do on
//! a run's bus is in `access`.

mod access;
mod alive;
mod error;
mod port;
mod query;
mod raw;
mod session;
mod tap;

use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde::de::DeserializeOwned;
use zenoh::Wait;
use zenoh::key_expr::KeyExpr;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use crate::codec::{self, CodecError};
use crate::ids::{DeviceId, HostId, Tti};
use crate::keys::{self, Keys};
use crate::message::{Frame, MessageKind, Payload, Plane, TapBatch, WakeUp};
use crate::secret::{HostPass, Secret};

pub use error::BusError;
pub use port::{Heard, PolicyQuestion, PolicyQuestions, Replies};
pub use raw::RawTopic;
pub use session::{allowed, draw_nonce, draw_secret, free_to_listen};
pub use tap::{Sink, Tap};

/// Time between two looks at what is to be sent to observers.
const DRAINING: Duration = Duration::from_millis(2);

/// One session on one run.
#[derive(Clone)]
pub struct Bus {
    session: zenoh::Session,
    keys: Arc<Keys>,
    endpoint: Arc<str>,
    /// What is shown with questions that not everybody may ask.
    key: Option<Secret>,
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
    fn new(session: zenoh::Session, keys: Keys, endpoint: &str) -> Self {
        let malformed = Arc::default();
        Self {
            session,
            keys: Arc::new(keys),
            endpoint: endpoint.into(),
            key: None,
            malformed,
            tap: None,
        }
    }

    /// The keys of the run.
    pub fn keys(&self) -> &Keys {
        &self.keys
    }

    /// This session with what a member of the run is told: the keys of all hosts.
    #[must_use]
    pub fn with_secret(&self, secret: Secret) -> Self {
        Self {
            keys: Arc::new(Keys::of_members(self.keys.run().clone(), secret)),
            ..self.clone()
        }
    }

    /// This session of somebody who has the run's key, and shows it with every question.
    #[must_use]
    pub fn with_key(&self, key: Option<Secret>) -> Self {
        Self { key, ..self.clone() }
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

    /// Hands every copy of the BS's traffic to `sink`, in the order in which it is sent or heard; the run waits for it.
    /// There is one such place. False if it is taken, or this is no BS's session.
    pub fn copy_to(&self, sink: Box<Sink>) -> bool {
        self.tap.as_ref().is_some_and(|tap| tap.copy_to(sink))
    }

    /// Copies that observers were not sent, because they could not keep up.
    pub fn left_out(&self) -> u64 {
        self.tap.as_ref().map_or(0, |tap| tap.left_out())
    }

    /// Waits until observers have been sent all copies so far, `patience` at most.
    pub async fn drain(&self, patience: Duration) {
        let Some(tap) = &self.tap else { return };
        let sent = async {
            while !tap.is_empty() {
                tokio::time::sleep(DRAINING).await;
            }
        };
        // Who cannot keep up is not waited for any longer.
        let _in_time = tokio::time::timeout(patience, sent).await.is_ok();
    }

    /// Whether somebody wants copies of the BS's traffic.
    pub fn is_observed(&self) -> bool {
        self.tap.as_ref().is_some_and(|tap| tap.is_observed())
    }

    /// Tells observers of what is on the air and of what the world does.
    pub fn tell(&self, frame: Frame) {
        if let Some(tap) = &self.tap {
            tap.tell(frame);
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

    /// The topic of messages of type `P` to all hosts.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher<P: Payload<Address = ()>>(&self) -> Result<Topic<P>, BusError> {
        let publisher = self.session.declare_publisher(self.keys.to_all(P::KIND));
        let way = Way::Published(publisher.congestion_control(CongestionControl::Block).wait()?);
        Ok(Topic::new(way, None, self.tap.clone()))
    }

    /// Wakes `device`, which `host` carries. Waits while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn wake(&self, host: HostId, device: DeviceId, wake: &WakeUp) -> Result<(), BusError> {
        let payload = codec::encode(wake);
        if let Some(tap) = &self.tap {
            tap.see(MessageKind::Wake, Some(device.0), &payload);
        }
        // Thousands of keys, each of which is hardly ever used: declared, zenoh would look through all that there are
        // for each new one.
        let put = self.session.put(self.keys.wake(host, device), payload);
        Ok(put.congestion_control(CongestionControl::Block).wait()?)
    }

    /// The topic of messages of type `P` from the host with this pass.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn uplink<P: Payload>(&self, pass: HostPass) -> Result<Topic<P>, BusError> {
        let key = self.session.declare_keyexpr(self.keys.uplink(P::KIND, pass)).wait()?;
        let way = Way::Named(self.session.clone(), key);
        Ok(Topic::new(way, Some(pass.host.0), self.tap.clone()))
    }

    /// Calls `handle` with each message of type `P` to all hosts, of which this is `host`. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe<P, F>(&self, host: HostId, handle: F) -> Result<Declared, BusError>
    where
        P: Payload<Address = ()>,
        F: Fn(P) + Send + Sync + 'static,
    {
        self.listen_on(self.keys.to_one_of_all(P::KIND, host), move |_, message| {
            handle(message);
            true
        })
    }

    /// Calls `handle` with each wake-up for a device that `host` carries. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_wakes<F>(&self, host: HostId, handle: F) -> Result<Declared, BusError>
    where
        F: Fn(DeviceId, WakeUp) + Send + Sync + 'static,
    {
        self.listen_on(self.keys.wakes_of(host), move |key, wake| {
            let device = keys::last_number(key).map(DeviceId);
            device.map(|device| handle(device, wake)).is_some()
        })
    }

    /// Calls `handle` with each message of type `P` from any host, and with the pass that its key shows. It must not
    /// block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_uplinks<P, F>(&self, handle: F) -> Result<Declared, BusError>
    where
        P: Payload,
        F: Fn(HostPass, P) + Send + Sync + 'static,
    {
        self.listen_on(self.keys.uplinks(P::KIND), move |key, message| {
            HostPass::at_end_of(key).map(|pass| handle(pass, message)).is_some()
        })
    }

    /// Calls `handle` with the copies of the BS's traffic. It must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn observe(&self, handle: impl Fn(TapBatch) + Send + Sync + 'static) -> Result<Declared, BusError> {
        self.listen_on(self.keys.tap(), move |_, batch| {
            handle(batch);
            true
        })
    }

    /// Calls `handle` with the key and the message of each sample; it says whether the key can be one of such messages.
    fn listen_on<T, F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        T: DeserializeOwned,
        F: Fn(&str, T) -> bool + Send + Sync + 'static,
    {
        let bus = self.clone();
        let take = move |key: &str, payload: &[u8]| {
            bus.see(key, payload);
            if !bus.read(key, payload).is_some_and(|message| handle(key, message)) {
                bus.see_malformed(key, payload);
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
        if let Some(tap) = self.tap.as_ref().filter(|tap| tap.is_observed())
            && let Some((kind, number)) = keys::classify(key)
        {
            tap.see(kind, number, payload);
        }
    }

    /// Copies what was heard on the air plane and is no message: the run tells nothing of it.
    fn see_malformed(&self, key: &str, payload: &[u8]) {
        if let Some(tap) = self.tap.as_ref().filter(|tap| tap.is_observed())
            && let Some((kind, _)) = keys::classify(key)
            && kind.plane() != Plane::Emu
        {
            // Whose it is nobody knows: the key names a host.
            tap.tell_bytes(kind, None, payload);
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

/// How messages get on their way.
enum Way {
    /// By a publisher, to which zenoh tells all that are interested.
    Published(Publisher<'static>),
    /// On a key that has a short name on the link, to the BS whether it is interested or not. A publisher of each host
    /// would have to be told of all that the other hosts hear.
    Named(zenoh::Session, KeyExpr<'static>),
}

/// Where messages of type `P` are published, on one key.
pub struct Topic<P> {
    way: Way,
    number: Option<u32>,
    tap: Option<Arc<Tap>>,
    _payload: PhantomData<fn(&P)>,
}

impl<P: Payload> Topic<P> {
    const fn new(way: Way, number: Option<u32>, tap: Option<Arc<Tap>>) -> Self {
        Self {
            way,
            number,
            tap,
            _payload: PhantomData,
        }
    }

    /// Publishes `message`. Waits while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn put(&self, message: &P) -> Result<(), BusError> {
        let payload = codec::encode(message);
        if let Some(tap) = &self.tap {
            tap.see(P::KIND, self.number, &payload);
        }
        match &self.way {
            Way::Published(publisher) => publisher.put(payload).wait()?,
            Way::Named(session, key) => {
                let put = session.put(key, payload);
                put.congestion_control(CongestionControl::Block).wait()?;
            }
        }
        Ok(())
    }
}
