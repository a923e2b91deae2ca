//! The bus: zenoh sessions and typed topics. No other module opens a session; start at [`Bus::listen`] and
//! [`Bus::connect`] in `session`.
//!
//! The BS listens as a zenoh router. All other processes connect to it as clients, directly or through routers
//! (`router`), over TCP, or over TLS with a certificate for each role (`tls`). Links are reliable and blocking, so only
//! the modelled radio causes losses and delays. [`crate::message`] defines the messages: a payload's type determines
//! its kind and its key, so no two types share a key. All processes of a run must have the same version. A `key` is a
//! key expression of zenoh; the run's key is a secret that authorises queries. `access` defines the rights of a peer,
//! so a new kind needs an entry there. Callbacks run on zenoh's threads and must not block.
//!
//! In the BS's session a [`Tap`] copies the traffic of the emulation plane for observers, before it is sent and before
//! it is decoded. The run itself publishes frames of the air plane and the ground truth with [`Bus::publish_frame`].

mod access;
mod error;
mod liveliness;
mod policy_port;
mod query;
mod raw;
mod refusals;
mod router;
mod session;
mod tap;
mod tls;

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
use crate::keys::{self, KeyExprs};
use crate::message::{Frame, FrameBatch, MessageKind, Payload, Plane, WakeUp};
use crate::secret::{HostCredential, Secret};

pub use error::BusError;
pub use policy_port::{PortReply, PortRequest, PortRequests, Replies};
pub use raw::RawTopic;
pub use refusals::RefusalLog;
pub use router::Upstream;
pub use session::{draw_nonce, draw_secret, resolve_listen_endpoint, scaled_timeout};
pub use tap::{FrameSink, Tap};
pub use tls::{Endpoint, Role, TlsFiles};

/// Interval at which the queue of frames for observers is checked.
const FLUSH_CHECK_INTERVAL: Duration = Duration::from_millis(2);

/// A session on one run. Clones share the session.
#[derive(Clone)]
pub struct Bus {
    session: zenoh::Session,
    key_exprs: Arc<KeyExprs>,
    endpoint: Arc<str>,
    /// The run's key, sent with queries that name no other secret; `None` sends none.
    run_key: Option<Secret>,
    malformed_payloads: Arc<AtomicU64>,
    tap: Option<Arc<Tap>>,
}

/// A declaration on the session, undone when the guard is dropped.
pub struct DeclarationGuard {
    _declaration: Box<dyn std::any::Any + Send + Sync>,
}

/// A callback that receives the key and the bytes of a message.
type PayloadHandler = dyn Fn(&str, &[u8]) + Send + Sync;

impl Bus {
    fn new(session: zenoh::Session, key_exprs: KeyExprs, endpoint: &str) -> Self {
        Self {
            session,
            key_exprs: Arc::new(key_exprs),
            endpoint: endpoint.into(),
            run_key: None,
            malformed_payloads: Arc::default(),
            tap: None,
        }
    }

    /// The key expressions of the run.
    pub fn key_exprs(&self) -> &KeyExprs {
        &self.key_exprs
    }

    /// Returns this session with the secret of the run's members, which opens the keys of all hosts. The BS sends it to
    /// each host that it admits.
    #[must_use]
    pub fn with_secret(&self, secret: Secret) -> Self {
        Self {
            key_exprs: Arc::new(KeyExprs::for_members(self.key_exprs.run().clone(), secret)),
            ..self.clone()
        }
    }

    /// Returns this session with the run's key, which [`Self::query`] then sends. Other queries name their secret.
    #[must_use]
    pub fn with_key(&self, run_key: Option<Secret>) -> Self {
        Self {
            run_key,
            ..self.clone()
        }
    }

    /// The endpoint on which the BS listens.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// The number of payloads that could not be decoded. Valid payloads under an invalid key are dropped uncounted.
    pub fn malformed_payloads(&self) -> u64 {
        self.malformed_payloads.load(Ordering::Relaxed)
    }

    /// Sets the TTI with which the tap labels frames.
    pub fn set_tti(&self, tti: Tti) {
        if let Some(tap) = &self.tap {
            tap.set_tti(tti);
        }
    }

    /// Passes every copy of the BS's traffic to `sink`, in the order of sending and receiving; the run waits for the
    /// sink. Returns false if a sink exists already or if this session is not the BS's.
    pub fn set_local_sink(&self, sink: Box<FrameSink>) -> bool {
        self.tap.as_ref().is_some_and(|tap| tap.set_local_sink(sink))
    }

    /// The number of frames dropped because observers were too slow.
    pub fn dropped_frames(&self) -> u64 {
        self.tap.as_ref().map_or(0, |tap| tap.dropped_frames())
    }

    /// Waits until all frames so far have been sent to observers, for at most `patience`.
    pub async fn flush_observers(&self, patience: Duration) {
        let Some(tap) = &self.tap else { return };
        let all_sent = async {
            while !tap.is_empty() {
                tokio::time::sleep(FLUSH_CHECK_INTERVAL).await;
            }
        };
        // A slower observer misses the remaining frames; the run does not wait longer.
        let _in_time = tokio::time::timeout(patience, all_sent).await.is_ok();
    }

    /// Whether any observer is connected or a local sink is set.
    pub fn is_observed(&self) -> bool {
        self.tap.as_ref().is_some_and(|tap| tap.is_observed())
    }

    /// Sends observers a frame of the air plane or of the ground truth.
    pub fn publish_frame(&self, frame: Frame) {
        if let Some(tap) = &self.tap {
            tap.forward(frame);
        }
    }

    /// Returns this session for devices in the BS's own process. It copies nothing to observers, because the BS
    /// already copies its messages in both directions, and it counts malformed payloads separately.
    #[must_use]
    pub fn without_tap(&self) -> Self {
        Self {
            malformed_payloads: Arc::default(),
            tap: None,
            ..self.clone()
        }
    }

    /// Returns the topic of messages of type `P` to all hosts.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn publisher<P: Payload<Address = ()>>(&self) -> Result<TopicPublisher<P>, BusError> {
        let publisher = self.session.declare_publisher(self.key_exprs.to_all_hosts(P::KIND));
        // By default zenoh drops a message under congestion; only the modelled radio may lose messages.
        let delivery = Delivery::Publisher(publisher.congestion_control(CongestionControl::Block).wait()?);
        Ok(TopicPublisher::new(delivery, None, self.tap.clone()))
    }

    /// Sends a wake-up to `device`, which `host` runs. Blocks while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn send_wake_up(&self, host: HostId, device: DeviceId, wake: &WakeUp) -> Result<(), BusError> {
        let payload = codec::encode(wake);
        if let Some(tap) = &self.tap {
            tap.copy_emulation(MessageKind::Wake, Some(device.0), &payload);
        }
        // Thousands of these keys exist, each rarely used. If declared, zenoh would search all of them for each new
        // one.
        let put = self.session.put(self.key_exprs.wake(host, device), payload);
        Ok(put.congestion_control(CongestionControl::Block).wait()?)
    }

    /// Returns the topic of messages of type `P` from the host with this credential.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn uplink<P: Payload>(&self, credential: HostCredential) -> Result<TopicPublisher<P>, BusError> {
        let key = self
            .session
            .declare_keyexpr(self.key_exprs.uplink(P::KIND, credential))
            .wait()?;
        let delivery = Delivery::DeclaredKey(self.session.clone(), key);
        Ok(TopicPublisher::new(delivery, Some(credential.host.0), self.tap.clone()))
    }

    /// Calls `handle` with each message of type `P` that `host` receives on a topic for all hosts. The callback must
    /// not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe<P, F>(&self, host: HostId, handle: F) -> Result<DeclarationGuard, BusError>
    where
        P: Payload<Address = ()>,
        F: Fn(P) + Send + Sync + 'static,
    {
        self.subscribe_decoded(self.key_exprs.to_all_hosts_at(P::KIND, host), move |_, message| {
            handle(message);
            true
        })
    }

    /// Calls `handle` with each wake-up for a device that `host` runs. The callback must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_wake_ups<F>(&self, host: HostId, handle: F) -> Result<DeclarationGuard, BusError>
    where
        F: Fn(DeviceId, WakeUp) + Send + Sync + 'static,
    {
        self.subscribe_decoded(self.key_exprs.wake_ups_of(host), move |key, wake| {
            let device = keys::last_number(key).map(DeviceId);
            device.map(|device| handle(device, wake)).is_some()
        })
    }

    /// Calls `handle` with each message of type `P` from any host, and with the credential in its key, which the caller
    /// must check. The callback must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn subscribe_uplinks<P, F>(&self, handle: F) -> Result<DeclarationGuard, BusError>
    where
        P: Payload,
        F: Fn(HostCredential, P) + Send + Sync + 'static,
    {
        self.subscribe_decoded(self.key_exprs.uplinks(P::KIND), move |key, message| {
            HostCredential::from_key_expr(key)
                .map(|credential| handle(credential, message))
                .is_some()
        })
    }

    /// Calls `handle` with the copies of the BS's traffic. The callback must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn observe(&self, handle: impl Fn(FrameBatch) + Send + Sync + 'static) -> Result<DeclarationGuard, BusError> {
        self.subscribe_decoded(self.key_exprs.tap(), move |_, batch| {
            handle(batch);
            true
        })
    }

    /// Calls `handle` with the key and message of each sample; it returns false if the key is invalid for the message.
    fn subscribe_decoded<T, F>(&self, key: String, handle: F) -> Result<DeclarationGuard, BusError>
    where
        T: DeserializeOwned,
        F: Fn(&str, T) -> bool + Send + Sync + 'static,
    {
        let bus = self.clone();
        let receive = move |key: &str, payload: &[u8]| {
            // Copied before decoding, so that observers also see malformed messages of the emulation plane.
            bus.copy_emulation(key, payload);
            if !bus
                .decode_or_count(key, payload)
                .is_some_and(|message| handle(key, message))
            {
                bus.copy_malformed(key, payload);
            }
        };
        self.subscribe_bytes(key, Box::new(receive))
    }

    /// Subscribes like [`Self::subscribe_decoded`], in bytes. Not generic, so zenoh's code is compiled only here, once.
    fn subscribe_bytes(&self, key: String, receive: Box<PayloadHandler>) -> Result<DeclarationGuard, BusError> {
        let on_sample = move |sample: Sample| receive(sample.key_expr().as_str(), &sample.payload().to_bytes());
        Ok(DeclarationGuard::new(
            self.session.declare_subscriber(key).callback(on_sample).wait()?,
        ))
    }

    /// Closes the session, also for the clones of this value, and undoes all its declarations.
    pub async fn close(self) {
        // Boxed, so that zenoh's generic code is compiled only once, in this crate.
        let closing: Pin<Box<dyn Future<Output = zenoh::Result<()>> + Send>> =
            Box::pin(async move { self.session.close().await });
        if let Err(error) = closing.await {
            tracing::debug!(%error, "closing the session");
        }
    }

    fn copy_emulation(&self, key: &str, payload: &[u8]) {
        // Checked first, so that an unobserved run does not parse keys.
        if let Some(tap) = self.tap.as_ref().filter(|tap| tap.is_observed())
            && let Some((kind, number)) = keys::classify(key)
        {
            tap.copy_emulation(kind, number, payload);
        }
    }

    /// Copies malformed payloads of the air plane, for which the run publishes no frame.
    fn copy_malformed(&self, key: &str, payload: &[u8]) {
        // On the emulation plane `copy_emulation` has copied the payload already.
        if let Some(tap) = self.tap.as_ref().filter(|tap| tap.is_observed())
            && let Some((kind, _)) = keys::classify(key)
            && kind.plane() != Plane::Emu
        {
            // The device is unknown, as the key names only its host.
            tap.forward_bytes(kind, None, payload);
        }
    }

    fn decode_or_count<T: DeserializeOwned>(&self, key: &str, payload: &[u8]) -> Option<T> {
        codec::decode(payload)
            .inspect_err(|error| self.count_malformed(key, error))
            .ok()
    }

    fn count_malformed(&self, key: &str, error: &CodecError) {
        // Logged only once, because a broken peer could otherwise fill the log.
        if self.malformed_payloads.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::warn!(
                key, %error,
                "dropped a malformed payload; use the same version of reveille in all processes (later cases are not \
                 logged)"
            );
        }
    }
}

impl DeclarationGuard {
    fn new(declaration: impl Send + Sync + 'static) -> Self {
        Self {
            _declaration: Box::new(declaration),
        }
    }
}

/// The way in which a [`TopicPublisher`] sends.
enum Delivery {
    /// By a publisher. zenoh informs it of all subscribers.
    Publisher(Publisher<'static>),
    /// On a key with a short name on the link. The message reaches the BS whether it subscribes or not. With a
    /// publisher for each host, zenoh would inform each host of all subscriptions of the others.
    DeclaredKey(zenoh::Session, KeyExpr<'static>),
}

/// A publisher of messages of type `P` on one key.
pub struct TopicPublisher<P> {
    delivery: Delivery,
    /// The number of the sending host; `None` for the BS.
    source_host: Option<u32>,
    tap: Option<Arc<Tap>>,
    _payload: PhantomData<fn(&P)>,
}

impl<P: Payload> TopicPublisher<P> {
    const fn new(delivery: Delivery, source_host: Option<u32>, tap: Option<Arc<Tap>>) -> Self {
        Self {
            delivery,
            source_host,
            tap,
            _payload: PhantomData,
        }
    }

    /// Publishes `message`. Blocks while the link is congested.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn publish(&self, message: &P) -> Result<(), BusError> {
        let payload = codec::encode(message);
        if let Some(tap) = &self.tap {
            // Copied before sending: another thread may copy the answer as soon as the message is sent.
            tap.copy_emulation(P::KIND, self.source_host, &payload);
        }
        match &self.delivery {
            Delivery::Publisher(publisher) => publisher.put(payload).wait()?,
            Delivery::DeclaredKey(session, key) => {
                let put = session.put(key, payload);
                put.congestion_control(CongestionControl::Block).wait()?;
            }
        }
        Ok(())
    }
}
