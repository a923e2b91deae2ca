//! The bus: zenoh sessions and typed topics. The only file tree that opens a session.
//!
//! The BS listens as a zenoh router, everything else connects to it as a client over TCP. Links are reliable and blocking:
//! losses and delays of the modelled radio never come from here. See [`crate::message`] for what travels.

mod bare;
mod tap;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde::Serialize;
use serde::de::DeserializeOwned;
use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};
use zenoh::sample::{Sample, SampleKind};

use crate::codec::{self, CodecError};
use crate::ids::Tti;
use crate::keys::{Keys, RunName};

pub use bare::{BareBarrier, bare_host};
pub use tap::Tap;

/// How long a link may be silent before its peer counts as lost, milliseconds.
pub const LEASE_MS: u64 = 2_000;

/// What can go wrong on the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A text that is not an endpoint.
    #[error("endpoint {0:?}: {1}; it must look like tcp/HOST:PORT, for example tcp/127.0.0.1:7447")]
    Endpoint(String, &'static str),
    /// The BS cannot listen.
    #[error(
        "cannot listen on {0}: {1}. Is the port in use? Choose another with --listen, or tcp/127.0.0.1:0 for any free one"
    )]
    Listen(String, String),
    /// No BS answers.
    #[error("no base station answers at {endpoint} within {patience:?}. Is it running, and is the address right?")]
    Connect {
        /// Where.
        endpoint: String,
        /// How long it was tried.
        patience: Duration,
    },
    /// The BS is there, but does not answer for this run.
    #[error("nobody answers for run {run} at {endpoint}. {hint}")]
    NoRun {
        /// Where.
        endpoint: String,
        /// The run asked for.
        run: RunName,
        /// Which runs there are.
        hint: String,
    },
    /// A reply that cannot be read.
    #[error("the reply cannot be read: {0}")]
    Reply(#[from] CodecError),
    /// Anything else that zenoh reports.
    #[error("zenoh: {0}")]
    Zenoh(String),
}

impl From<zenoh::Error> for BusError {
    fn from(error: zenoh::Error) -> Self {
        Self::Zenoh(error.to_string())
    }
}

/// Settings that only the tests and the benchmarks change.
const COMMON: [(&str, &str); 6] = [
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("scouting/delay", "0"),
    ("timestamping/enabled", "false"),
    ("adminspace/enabled", "false"),
    ("transport/unicast/max_sessions", "10000"),
];

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
    /// Opens the BS's session, listening on `endpoint`; the port 0 stands for any free one.
    ///
    /// # Errors
    /// If the endpoint is not one, or is in use.
    pub async fn listen(endpoint: &str, run: RunName) -> Result<Self, BusError> {
        let endpoint = free_to_listen(endpoint)?;
        let mut config = config(&[("mode", "\"router\"")])?;
        set(&mut config, "listen/endpoints", &format!("[{endpoint:?}]"))?;
        set(&mut config, "listen/exit_on_failure", "true")?;
        let session = open(config)
            .await?
            .map_err(|e| BusError::Listen(endpoint.clone(), e.to_string()))?;
        let mut bus = Self::new(session, run, &endpoint);
        bus.tap = Some(Tap::start(&bus)?);
        Ok(bus)
    }

    /// Connects to the BS at `endpoint`, trying for `patience`.
    ///
    /// # Errors
    /// If the endpoint is not one, or nobody answers there in time.
    pub async fn connect(endpoint: &str, run: RunName, patience: Duration) -> Result<Self, BusError> {
        address(endpoint)?;
        let mut config = config(&[("mode", "\"client\"")])?;
        set(&mut config, "connect/endpoints", &format!("[{endpoint:?}]"))?;
        set(&mut config, "connect/timeout_ms", &patience.as_millis().to_string())?;
        set(&mut config, "connect/exit_on_failure", "true")?;
        set(
            &mut config,
            "connect/retry",
            "{period_init_ms: 50, period_max_ms: 500, period_increase_factor: 2}",
        )?;
        let session = open(config).await?.map_err(|error| {
            tracing::debug!(%error, endpoint, "cannot connect");
            BusError::Connect {
                endpoint: endpoint.to_owned(),
                patience,
            }
        })?;
        Ok(Self::new(session, run, endpoint))
    }

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
                    query.reply_err(error.to_string()).wait()
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
                    let text = String::from_utf8_lossy(&error.payload().to_bytes()).into_owned();
                    if text != "Timeout" {
                        return Err(BusError::Zenoh(text));
                    }
                }
            }
        }
        Ok(None)
    }

    /// Shows others that this session lives, until dropped or lost.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn declare_alive(&self, key: String) -> Result<Declared, BusError> {
        let token: LivelinessToken = self.session.liveliness().declare_token(key).wait()?;
        Ok(Declared::new(token))
    }

    /// Calls `handle` with the key of each token that matches `key`, and whether it came or went.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn watch_alive<F>(&self, key: String, handle: F) -> Result<Declared, BusError>
    where
        F: Fn(&str, bool) + Send + Sync + 'static,
    {
        let on_sample = move |sample: Sample| handle(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
        Ok(Declared::new(
            self.session
                .liveliness()
                .declare_subscriber(key)
                .history(true)
                .callback(on_sample)
                .wait()?,
        ))
    }

    /// The names of the runs whose BS lives behind this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn runs(&self, patience: Duration) -> Result<Vec<String>, BusError> {
        let replies = self.session.liveliness().get(Keys::any_bs()).timeout(patience).await?;
        let mut runs = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            if let Ok(sample) = reply.result() {
                runs.extend(sample.key_expr().as_str().split('/').nth(1).map(str::to_owned));
            }
        }
        runs.sort();
        Ok(runs)
    }

    /// How many hosts of this run live behind this session.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn alive_hosts(&self) -> Result<u32, BusError> {
        let replies = self.session.liveliness().get(self.keys.all_alive()).await?;
        let mut hosts = 0;
        while replies.recv_async().await.is_ok() {
            hosts += 1;
        }
        Ok(hosts)
    }

    /// That nobody serves this run here, with the names of those that are served.
    pub async fn no_run(&self) -> BusError {
        let runs = self.runs(Duration::from_secs(1)).await.unwrap_or_default();
        let hint = if runs.is_empty() {
            "No base station of any run lives there".to_owned()
        } else {
            format!("Runs there: {}", runs.join(", "))
        };
        BusError::NoRun {
            endpoint: self.endpoint.to_string(),
            run: self.keys.run().clone(),
            hint,
        }
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

fn config(extra: &[(&str, &str)]) -> Result<zenoh::Config, BusError> {
    let mut config = zenoh::Config::default();
    for (key, value) in COMMON.iter().chain(extra) {
        set(&mut config, key, value)?;
    }
    set(&mut config, "transport/link/tx/lease", &LEASE_MS.to_string())?;
    Ok(config)
}

fn set(config: &mut zenoh::Config, key: &str, value: &str) -> Result<(), BusError> {
    config
        .insert_json5(key, value)
        .map_err(|e| BusError::Zenoh(format!("{key} = {value}: {e}")))
}

/// Opens a session on a thread of its own: zenoh blocks the thread that waits for one, and with it every timer and signal
/// that its task waits for besides.
async fn open(config: zenoh::Config) -> Result<zenoh::Result<zenoh::Session>, BusError> {
    let (send, opened) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name("open".to_owned())
        .spawn(move || {
            // Nobody waits any more: the session is closed at once.
            let _unwanted = send.send(zenoh::open(config).wait()).is_err();
        })
        .map_err(|e| BusError::Zenoh(format!("cannot start a thread: {e}")))?;
    opened
        .await
        .map_err(|_| BusError::Zenoh("the thread that opens the session has ended".to_owned()))
}

/// The host and port of `endpoint`.
fn address(endpoint: &str) -> Result<(&str, u16), BusError> {
    let refuse = |why| BusError::Endpoint(endpoint.to_owned(), why);
    let (protocol, address) = endpoint.split_once('/').ok_or_else(|| refuse("no protocol"))?;
    if protocol != "tcp" {
        return Err(refuse("only the protocol tcp is spoken here"));
    }
    let (host, port) = address.rsplit_once(':').ok_or_else(|| refuse("no port"))?;
    if host.is_empty() || host.contains(['/', '?', '#', ',']) {
        return Err(refuse("no host"));
    }
    let port = port
        .parse()
        .map_err(|_| refuse("the port is not a number up to 65535"))?;
    Ok((host, port))
}

/// `endpoint`, if it can be listened on, with a free port in the place of port 0, which zenoh would choose without telling.
///
/// # Errors
/// If it is no endpoint, or is in use.
pub fn free_to_listen(endpoint: &str) -> Result<String, BusError> {
    let (host, port) = address(endpoint)?;
    let bound = std::net::TcpListener::bind((host.trim_matches(['[', ']']), port))
        .and_then(|listener| listener.local_addr())
        .map_err(|e| BusError::Listen(endpoint.to_owned(), e.to_string()))?;
    Ok(format!("tcp/{host}:{}", bound.port()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_checked() {
        assert_eq!(address("tcp/127.0.0.1:7447").expect("valid"), ("127.0.0.1", 7447));
        assert_eq!(address("tcp/[::1]:0").expect("valid"), ("[::1]", 0));
        for bad in [
            "",
            "tcp",
            "tcp/",
            "tcp/host",
            "tcp/:1",
            "tcp/host:",
            "tcp/host:65536",
            "udp/host:1",
            "host:1",
            "tcp/a/b:1",
            "tcp/a:1,tcp/b:1",
        ] {
            assert!(matches!(address(bad), Err(BusError::Endpoint(..))), "{bad}");
        }
    }

    #[test]
    fn a_free_port_is_found_and_a_taken_one_refused() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let endpoint = format!("tcp/{}", taken.local_addr().expect("bound"));
        assert!(matches!(free_to_listen(&endpoint), Err(BusError::Listen(..))));
        let free = free_to_listen("tcp/127.0.0.1:0").expect("a free port");
        assert!(free.starts_with("tcp/127.0.0.1:") && !free.ends_with(":0"), "{free}");
    }
}
