//! Opening and configuration of sessions: `Bus::listen` for the BS, `Bus::connect` for all other processes except
//! routers, which are in `router`. Timeouts grow with the number of processes that share the machine. No digest depends
//! on these settings.

use std::io::ErrorKind;
use std::time::Duration;

use zenoh::Wait;

use super::{Bus, BusError, Endpoint, Tap, access};
use crate::keys::{KeyExprs, RunName};
use crate::secret::Secret;

/// Time without traffic after which the peer of a link counts as lost, with at most [`UNSCALED_PROCESSES`] processes on
/// a machine. The BS then loses the liveliness tokens of the peer.
const LEASE: Duration = Duration::from_secs(2);
/// The number of processes up to which timeouts are not scaled.
const UNSCALED_PROCESSES: u32 = 100;

/// Scales the timeout `base` for `processes` that share a machine: in proportion to their number above
/// `UNSCALED_PROCESSES`, because they run in turns.
pub fn scaled_timeout(base: Duration, processes: u32) -> Duration {
    base * processes.max(UNSCALED_PROCESSES) / UNSCALED_PROCESSES
}

/// Maximum number of ports tried for an endpoint with port 0: another process can take a port before zenoh listens on
/// it.
const MAX_PORT_ATTEMPTS: u32 = 10;

/// Interval between checks of why this machine may be unable to connect. The first check follows one interval after
/// the start.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

/// zenoh settings of every session. The last one bounds the number of processes of a run.
const COMMON_SETTINGS: [(&str, &str); 6] = [
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("scouting/delay", "0"),
    ("timestamping/enabled", "false"),
    ("adminspace/enabled", "false"),
    ("transport/unicast/max_sessions", "10000"),
];

/// Intervals between attempts to connect. Set as a whole, because zenoh refuses single fields of `connect/retry`.
pub(super) const CONNECT_RETRY: &str = "{period_init_ms: 50, period_max_ms: 500, period_increase_factor: 2}";

impl Bus {
    /// Opens the BS's session, listening on `endpoint`; port 0 stands for any free one. Peers have only the rights
    /// that observers, hosts and operators need.
    ///
    /// # Errors
    /// If the endpoint is invalid or in use.
    pub async fn listen(endpoint: impl Into<Endpoint<'_>>, run: RunName) -> Result<Self, BusError> {
        Self::listen_for_hosts(1, endpoint, run).await
    }

    /// Opens the BS's session like [`Self::listen`], on a machine shared with `processes` host processes.
    ///
    /// # Errors
    /// As [`Self::listen`].
    pub async fn listen_for_hosts(
        processes: u32,
        endpoint: impl Into<Endpoint<'_>>,
        run: RunName,
    ) -> Result<Self, BusError> {
        let (endpoint, keys) = (endpoint.into(), KeyExprs::for_members(run, draw_secret()?));
        let rules = access::access_config(&keys, endpoint.tls.is_some(), None);
        Self::listen_as(processes, endpoint, keys, &[("access_control", &rules)]).await
    }

    /// Opens a session like [`Self::listen`], without access control, for the bare barrier of the benchmark.
    ///
    /// # Errors
    /// As [`Self::listen`].
    pub async fn listen_open(endpoint: &str, run: RunName) -> Result<Self, BusError> {
        Self::listen_as(1, endpoint.into(), KeyExprs::new(run), &[]).await
    }

    /// Opens a router with the settings `extra` in addition to the common ones, and starts its tap.
    async fn listen_as(
        processes: u32,
        endpoint: Endpoint<'_>,
        keys: KeyExprs,
        extra: &[(&str, &str)],
    ) -> Result<Self, BusError> {
        let mut config = session_config("router", processes)?;
        set_option(&mut config, "listen/exit_on_failure", "true")?;
        for (key, value) in access::PEER_LIMITS.iter().chain(extra) {
            set_option(&mut config, key, value)?;
        }
        set_tls(&mut config, endpoint, true)?;
        let (endpoint, session) = open_listening(config, endpoint).await?;
        let mut bus = Self::new(session, keys, &endpoint);
        bus.tap = Some(Tap::start(&bus.session, bus.key_exprs.tap())?);
        Ok(bus)
    }

    /// Connects to the BS at `endpoint`, trying for at most `patience`.
    ///
    /// # Errors
    /// If the endpoint is invalid, no BS answers there in time, or this machine cannot connect at all.
    pub async fn connect(
        endpoint: impl Into<Endpoint<'_>>,
        run: RunName,
        patience: Duration,
    ) -> Result<Self, BusError> {
        Self::connect_with_hosts(1, endpoint, run, patience).await
    }

    /// Connects like [`Self::connect`], for one of `processes` processes that share a machine.
    ///
    /// # Errors
    /// As [`Self::connect`].
    pub async fn connect_with_hosts(
        processes: u32,
        endpoint: impl Into<Endpoint<'_>>,
        run: RunName,
        patience: Duration,
    ) -> Result<Self, BusError> {
        Self::connect_as(processes, endpoint.into(), run, patience).await
    }

    /// Connects like [`Self::connect_with_hosts`]. Not generic, so it is compiled only in this crate.
    async fn connect_as(
        processes: u32,
        endpoint: Endpoint<'_>,
        run: RunName,
        patience: Duration,
    ) -> Result<Self, BusError> {
        let (protocol, hostname, port) = endpoint.parse()?;
        let address = endpoint.address;
        let mut config = session_config("client", processes)?;
        set_tls(&mut config, endpoint, false)?;
        set_option(&mut config, "connect/endpoints", &format!("[{address:?}]"))?;
        set_option(&mut config, "connect/timeout_ms", &patience.as_millis().to_string())?;
        set_option(&mut config, "connect/exit_on_failure", "true")?;
        set_option(&mut config, "connect/retry", CONNECT_RETRY)?;
        // zenoh retries every failure until `patience` ends, even one that this machine cannot overcome.
        let opened = tokio::select! {
            opened = open(config) => opened?,
            // The standard library takes an IPv6 address without the brackets of an endpoint.
            // Not with TLS, where the base station would log the connection as a refused one.
            why = find_connect_obstacle(hostname.trim_matches(['[', ']']), port), if protocol == "tcp" => {
                return Err(BusError::ConnectFailed(address.to_owned(), why));
            }
        };
        let session = opened.map_err(|error| {
            tracing::debug!(%error, address, "cannot connect");
            let endpoint = address.to_owned();
            if protocol == "tls" {
                BusError::ConnectTls { endpoint, patience }
            } else {
                BusError::Connect { endpoint, patience }
            }
        })?;
        Ok(Self::new(session, KeyExprs::new(run), address))
    }
}

/// Draws a secret from the operating system's randomness, so that it cannot be guessed.
///
/// # Errors
/// If the operating system provides no randomness.
pub fn draw_secret() -> Result<Secret, BusError> {
    let mut random = [0; 16];
    getrandom::fill(&mut random).map_err(no_randomness)?;
    Ok(Secret::new(random))
}

/// Draws a number that distinguishes one client from others.
///
/// # Errors
/// If the operating system provides no randomness.
pub fn draw_nonce() -> Result<u64, BusError> {
    getrandom::u64().map_err(no_randomness)
}

fn no_randomness(error: getrandom::Error) -> BusError {
    BusError::Zenoh(format!("the operating system provides no randomness: {error}"))
}

/// Returns the configuration of sessions of `mode`, on a machine shared by `processes` processes.
pub(super) fn session_config(mode: &str, processes: u32) -> Result<zenoh::Config, BusError> {
    let mut config = zenoh::Config::default();
    let lease = scaled_timeout(LEASE, processes).as_millis().to_string();
    let role_settings = [("mode", &*format!("{mode:?}")), ("transport/link/tx/lease", &*lease)];
    for (key, value) in COMMON_SETTINGS.iter().chain(&role_settings) {
        set_option(&mut config, key, value)?;
    }
    Ok(config)
}

pub(super) fn set_option(config: &mut zenoh::Config, key: &str, value: &str) -> Result<(), BusError> {
    config
        .insert_json5(key, value)
        .map_err(|e| BusError::Zenoh(format!("{key} = {value}: {e}")))
}

/// Adds the certificates of `endpoint`, if any, for a session that listens or one that connects.
pub(super) fn set_tls(config: &mut zenoh::Config, endpoint: Endpoint<'_>, listens: bool) -> Result<(), BusError> {
    let Some(files) = endpoint.tls else { return Ok(()) };
    for (name, value) in files.settings(listens)? {
        set_option(config, &format!("transport/link/tls/{name}"), &value)?;
    }
    Ok(())
}

/// Returns the reason why this machine cannot connect to `hostname`, once it is known. A BS that does not listen yet is
/// not such a reason. Once a connection succeeds, the future never completes.
async fn find_connect_obstacle(hostname: &str, port: u16) -> String {
    loop {
        tokio::time::sleep(CHECK_INTERVAL).await;
        // The machine can connect, so the session's own attempt decides from here on.
        let Err(error) = tokio::net::TcpStream::connect((hostname, port)).await else {
            return std::future::pending().await;
        };
        let hint = if error.kind() == ErrorKind::AddrNotAvailable {
            "this machine has no free port, or no address of this kind; closed connections free their ports after a \
             minute, and net.ipv4.ip_local_port_range sets the number of ports"
        } else if error.kind() == ErrorKind::PermissionDenied {
            "check the firewall of this machine"
        } else {
            // For example a refused connection: the BS may not listen yet.
            continue;
        };
        return format!("{error}; {hint}");
    }
}

/// Opens a session that listens on `endpoint` and returns it with the endpoint in use. Another process may take a free
/// port between its choice and zenoh's use of it, in which case another port is chosen.
pub(super) async fn open_listening(
    mut config: zenoh::Config,
    endpoint: Endpoint<'_>,
) -> Result<(String, zenoh::Session), BusError> {
    let is_any_port = endpoint.parse()?.2 == 0;
    let mut attempts = 0;
    loop {
        attempts += 1;
        let resolved = resolve_listen_endpoint(endpoint)?;
        set_option(&mut config, "listen/endpoints", &format!("[{resolved:?}]"))?;
        match open(config.clone()).await? {
            Ok(session) => return Ok((resolved, session)),
            Err(error) if is_any_port && attempts < MAX_PORT_ATTEMPTS => {
                tracing::debug!(resolved, %error, "cannot listen on this port; trying another");
            }
            Err(error) => {
                // The standard library names a taken port more clearly. zenoh ends its errors with a full stop.
                let address = &*resolved;
                resolve_listen_endpoint(Endpoint { address, ..endpoint })?;
                let cause = error.to_string();
                return Err(BusError::Listen(resolved, cause.trim_end_matches('.').to_owned()));
            }
        }
    }
}

/// Opens a session on a separate thread: zenoh blocks the calling thread, which would stop the timers and signals of
/// its task.
async fn open(config: zenoh::Config) -> Result<zenoh::Result<zenoh::Session>, BusError> {
    let (send, opened) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name("open".to_owned())
        .spawn(move || {
            // If the caller no longer waits, the session is dropped here, which closes it.
            let _unwanted = send.send(open_now(config)).is_err();
        })
        .map_err(|e| BusError::Zenoh(format!("cannot start a thread: {e}")))?;
    opened
        .await
        .map_err(|_| BusError::Zenoh("the thread that opens the session has ended".to_owned()))
}

/// Opens a session. Separate, so zenoh's code is compiled only here and not with each task that opens a session.
fn open_now(config: zenoh::Config) -> zenoh::Result<zenoh::Session> {
    zenoh::open(config).wait()
}

/// Checks that `endpoint` can be listened on and replaces port 0 by a free port. zenoh would choose a port without
/// reporting it.
///
/// # Errors
/// If the endpoint is invalid or in use.
pub fn resolve_listen_endpoint<'a>(endpoint: impl Into<Endpoint<'a>>) -> Result<String, BusError> {
    let endpoint: Endpoint<'_> = endpoint.into();
    let (protocol, hostname, port) = endpoint.parse()?;
    // The listener is dropped on return. If another process takes the port before zenoh, opening the session fails.
    let bound = std::net::TcpListener::bind((hostname.trim_matches(['[', ']']), port))
        .and_then(|listener| listener.local_addr())
        .map_err(|e| BusError::Listen(endpoint.address.to_owned(), e.to_string()))?;
    Ok(format!("{protocol}/{hostname}:{}", bound.port()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_grow_with_the_number_of_processes() {
        for (processes, seconds) in [(0, 2), (1, 2), (100, 2), (250, 5), (1000, 20)] {
            assert_eq!(
                scaled_timeout(LEASE, processes),
                Duration::from_secs(seconds),
                "{processes} processes"
            );
        }
        assert!(scaled_timeout(LEASE, u32::MAX) > Duration::from_hours(1));
    }

    #[test]
    fn port_zero_becomes_a_free_port_and_a_port_in_use_is_refused() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let endpoint = format!("tcp/{}", taken.local_addr().expect("bound"));
        assert!(matches!(resolve_listen_endpoint(&endpoint), Err(BusError::Listen(..))));
        let free = resolve_listen_endpoint("tcp/127.0.0.1:0").expect("a free port");
        assert!(free.starts_with("tcp/127.0.0.1:") && !free.ends_with(":0"), "{free}");
    }
}
