//! How sessions are opened and configured.

use std::io::ErrorKind;
use std::time::Duration;

use zenoh::Wait;

use super::{Bus, BusError, Tap, access};
use crate::keys::{Keys, RunName};
use crate::secret::Secret;

/// How long a link may be silent before its peer counts as lost, where few processes share a machine.
const LEASE: Duration = Duration::from_secs(2);
/// How many processes are few.
const FEW: u32 = 100;

/// What may take `base` where few processes share a machine, where `processes` do: one after another of them has its
/// turn.
pub fn allowed(base: Duration, processes: u32) -> Duration {
    base * processes.max(FEW) / FEW
}

/// How long a connection is tried before this machine is asked what may keep it from being made, and from then on the
/// time between two such looks.
const LOOK: Duration = Duration::from_millis(500);

/// What all sessions have in common.
const COMMON: [(&str, &str); 6] = [
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("scouting/delay", "0"),
    ("timestamping/enabled", "false"),
    ("adminspace/enabled", "false"),
    ("transport/unicast/max_sessions", "10000"),
];

impl Bus {
    /// Opens the BS's session, listening on `endpoint`; the port 0 stands for any free one. Others may do there what
    /// observers, hosts and operators need, and nothing else.
    ///
    /// # Errors
    /// If the endpoint is not one, or is in use.
    pub async fn listen(endpoint: &str, run: RunName) -> Result<Self, BusError> {
        Self::listen_to(1, endpoint, run).await
    }

    /// As [`Self::listen`], for a BS that shares its machine with the processes of `hosts`.
    ///
    /// # Errors
    /// As [`Self::listen`].
    pub async fn listen_to(hosts: u32, endpoint: &str, run: RunName) -> Result<Self, BusError> {
        let keys = Keys::of_members(run, draw_secret()?);
        let rules = access::rules(&keys);
        Self::listen_as(hosts, endpoint, keys, &[("access_control", &rules)]).await
    }

    /// As [`Self::listen`], on a bus where everybody may do everything: for a bare barrier to compare with.
    ///
    /// # Errors
    /// As [`Self::listen`].
    pub async fn listen_open(endpoint: &str, run: RunName) -> Result<Self, BusError> {
        Self::listen_as(1, endpoint, Keys::new(run), &[]).await
    }

    async fn listen_as(hosts: u32, endpoint: &str, keys: Keys, extra: &[(&str, &str)]) -> Result<Self, BusError> {
        let endpoint = free_to_listen(endpoint)?;
        let mut config = config("router", hosts)?;
        set(&mut config, "listen/endpoints", &format!("[{endpoint:?}]"))?;
        set(&mut config, "listen/exit_on_failure", "true")?;
        for (key, value) in access::LIMITS.iter().chain(extra) {
            set(&mut config, key, value)?;
        }
        let session = open(config)
            .await?
            .map_err(|e| BusError::Listen(endpoint.clone(), e.to_string()))?;
        let mut bus = Self::new(session, keys, &endpoint);
        bus.tap = Some(Tap::start(&bus.session, bus.keys.tap())?);
        Ok(bus)
    }

    /// Connects to the BS at `endpoint`, trying for `patience`.
    ///
    /// # Errors
    /// If the endpoint is not one, nobody answers there in time, or this machine cannot connect to anybody.
    pub async fn connect(endpoint: &str, run: RunName, patience: Duration) -> Result<Self, BusError> {
        Self::connect_among(1, endpoint, run, patience).await
    }

    /// As [`Self::connect`], for a host that shares its machine with others, `hosts` with it.
    ///
    /// # Errors
    /// As [`Self::connect`].
    pub async fn connect_among(hosts: u32, endpoint: &str, run: RunName, patience: Duration) -> Result<Self, BusError> {
        let (host, port) = address(endpoint)?;
        let mut config = config("client", hosts)?;
        set(&mut config, "connect/endpoints", &format!("[{endpoint:?}]"))?;
        set(&mut config, "connect/timeout_ms", &patience.as_millis().to_string())?;
        set(&mut config, "connect/exit_on_failure", "true")?;
        set(
            &mut config,
            "connect/retry",
            "{period_init_ms: 50, period_max_ms: 500, period_increase_factor: 2}",
        )?;
        let opened = tokio::select! {
            opened = open(config) => opened?,
            why = hindrance(host.trim_matches(['[', ']']), port) => {
                return Err(BusError::Hindered(endpoint.to_owned(), why));
            }
        };
        let session = opened.map_err(|error| {
            tracing::debug!(%error, endpoint, "cannot connect");
            BusError::Connect {
                endpoint: endpoint.to_owned(),
                patience,
            }
        })?;
        Ok(Self::new(session, Keys::new(run), endpoint))
    }
}

/// A secret that nobody can guess.
///
/// # Errors
/// If the operating system has no randomness to give.
pub fn draw_secret() -> Result<Secret, BusError> {
    let mut random = [0; 16];
    getrandom::fill(&mut random).map_err(|e| BusError::Zenoh(format!("no randomness to be had: {e}")))?;
    Ok(Secret::new(random))
}

/// A number that tells one asker from others.
///
/// # Errors
/// If the operating system has no randomness to give.
pub fn draw_nonce() -> Result<u64, BusError> {
    getrandom::u64().map_err(|e| BusError::Zenoh(format!("no randomness to be had: {e}")))
}

/// What sessions of any `mode` have in common, where `hosts` processes share a machine.
fn config(mode: &str, hosts: u32) -> Result<zenoh::Config, BusError> {
    let mut config = zenoh::Config::default();
    let lease = allowed(LEASE, hosts).as_millis().to_string();
    let own = [("mode", &*format!("{mode:?}")), ("transport/link/tx/lease", &*lease)];
    for (key, value) in COMMON.iter().chain(&own) {
        set(&mut config, key, value)?;
    }
    Ok(config)
}

fn set(config: &mut zenoh::Config, key: &str, value: &str) -> Result<(), BusError> {
    config
        .insert_json5(key, value)
        .map_err(|e| BusError::Zenoh(format!("{key} = {value}: {e}")))
}

/// Why this machine cannot connect to `host`, once that is known. A BS that is not there yet hinders nobody, and once a
/// connection can be made there is nothing more to look for.
async fn hindrance(host: &str, port: u16) -> String {
    loop {
        tokio::time::sleep(LOOK).await;
        let Err(error) = tokio::net::TcpStream::connect((host, port)).await else {
            return std::future::pending().await;
        };
        let hint = if error.kind() == ErrorKind::AddrNotAvailable {
            "This machine has no free port left for it, or no address of that kind; ports of connections that were \
             closed are free again after a minute, and net.ipv4.ip_local_port_range says how many there are"
        } else if error.kind() == ErrorKind::PermissionDenied {
            "Does a firewall of this machine forbid it?"
        } else {
            continue;
        };
        return format!("{error}. {hint}");
    }
}

/// Opens a session on a thread of its own: zenoh blocks the thread that waits for one, and with it every timer and
/// signal that its task waits for besides.
async fn open(config: zenoh::Config) -> Result<zenoh::Result<zenoh::Session>, BusError> {
    let (send, opened) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name("open".to_owned())
        .spawn(move || {
            // Nobody waits any more: the session is closed at once.
            let _unwanted = send.send(open_now(config)).is_err();
        })
        .map_err(|e| BusError::Zenoh(format!("cannot start a thread: {e}")))?;
    opened
        .await
        .map_err(|_| BusError::Zenoh("the thread that opens the session has ended".to_owned()))
}

/// Opens a session. Apart, so that all of zenoh behind it is compiled here and once, not with each task that opens one.
fn open_now(config: zenoh::Config) -> zenoh::Result<zenoh::Session> {
    zenoh::open(config).wait()
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

/// `endpoint`, if it can be listened on, with a free port in the place of port 0, which zenoh would choose without
/// telling.
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
    fn where_many_share_a_machine_all_takes_longer() {
        for (processes, seconds) in [(0, 2), (1, 2), (100, 2), (250, 5), (1000, 20)] {
            assert_eq!(allowed(LEASE, processes), Duration::from_secs(seconds), "{processes}");
        }
        assert!(allowed(LEASE, u32::MAX) > Duration::from_hours(1));
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
