//! The HTTP server for the metrics of a run (`--metrics`), in the Prometheus and OpenMetrics text formats. The metrics
//! are in `view/src/metrics.rs`; `run_watchers` starts the server. The dashboard uses the checks of address and host
//! too. `cli` and `docs/command-line.md` repeat the address in the error text, which is the default of `--metrics`.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use reveille_view::metrics::{ProcessStats, PrometheusMetrics};
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::display::note;
use crate::runtime;

/// Longest wait of a request for a new count of the devices by state ([`PrometheusMetrics::request_device_count`]).
const COUNT_PATIENCE: Duration = Duration::from_millis(250);
/// Longest wait of a shutdown for the current requests.
const SHUTDOWN_PATIENCE: Duration = Duration::from_secs(1);
/// Time between two checks of a request for the new count of the devices.
const COUNT_POLL: Duration = Duration::from_millis(2);
const OPENMETRICS_TYPE: &str = "application/openmetrics-text";

/// Returns the statistics of the run's processes.
type ProcessProbe = dyn Fn() -> ProcessStats + Send + Sync;

/// State shared by the request handlers.
#[derive(Clone)]
struct MetricsState {
    metrics: Arc<PrometheusMetrics>,
    process_stats: Arc<ProcessProbe>,
    /// The address of the listener.
    address: SocketAddr,
}

/// Checks that this process can listen at `address`, which was given by `option`.
///
/// # Errors
/// If it cannot.
pub(crate) fn check_can_listen(option: &str, address: &str) -> anyhow::Result<()> {
    let bound = std::net::TcpListener::bind(address);
    bound.map(drop).map_err(|error| listen_error(option, address, &error))
}

/// The error of a server that cannot listen at `address`, which was given by `option`.
pub(crate) fn listen_error(option: &str, address: &str, error: &std::io::Error) -> anyhow::Error {
    if error.kind() == std::io::ErrorKind::AddrInUse {
        // An address in use has been resolved, so it has a port.
        let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
        anyhow!("{option} {address}: the port is in use; choose another port, or {option} {host}:0 for any free port")
    } else {
        let port = if option == "--metrics" { 9464 } else { 8464 };
        anyhow!("{option} {address}: {error}; give ADDRESS:PORT of this machine, such as 127.0.0.1:{port}")
    }
}

/// A running server.
pub(crate) struct MetricsServer {
    shutdown: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl MetricsServer {
    /// Refuses new requests, and returns once the current ones have their responses.
    pub(crate) async fn shut_down(self) {
        let has_stopped = self.shutdown.send(()).is_err();
        if !has_stopped {
            let _exceeded = tokio::time::timeout(SHUTDOWN_PATIENCE, self.task).await.is_err();
        }
    }
}

/// Serves `metrics` at `address` until the server is shut down or the program ends. `process_stats` returns the
/// statistics of the processes.
///
/// # Errors
/// If it cannot listen there.
pub(crate) async fn serve(
    address: &str,
    metrics: Arc<PrometheusMetrics>,
    process_stats: Arc<ProcessProbe>,
) -> anyhow::Result<MetricsServer> {
    let to_listen_error = |error| listen_error("--metrics", address, &error);
    let listener = TcpListener::bind(address).await.map_err(to_listen_error)?;
    let local_address = listener.local_addr().map_err(to_listen_error)?;
    note!("metrics at http://{}/metrics", local_target(local_address));
    let state = MetricsState {
        metrics,
        process_stats,
        address: local_address,
    };
    let router = Router::new()
        .route("/", get(|| async { Redirect::temporary("/metrics") }))
        .route("/metrics", get(serve_metrics))
        .layer(middleware::from_fn_with_state(state.clone(), check_host))
        .with_state(state);
    let (shutdown, is_shut_down) = oneshot::channel();
    let server = axum::serve(listener, router).with_graceful_shutdown(async {
        if is_shut_down.await.is_err() {
            // Dropped without a shutdown: the server stays until the program ends.
            std::future::pending::<()>().await;
        }
    });
    let task = tokio::spawn(async move {
        if let Err(error) = server.await {
            tracing::warn!(%error, "the metrics server has stopped");
        }
    });
    Ok(MetricsServer { shutdown, task })
}

/// Refuses requests from pages of other sites whose name resolves to this machine.
async fn check_host(State(state): State<MetricsState>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    if is_allowed_host(host, state.address) {
        next.run(request).await
    } else {
        (
            StatusCode::MISDIRECTED_REQUEST,
            "the request names another host; use the printed address\n",
        )
            .into_response()
    }
}

/// Returns the address under which a program on this machine reaches the listener at `address`: one that listens on all
/// addresses is reached at the loopback address.
pub(crate) fn local_target(mut address: SocketAddr) -> SocketAddr {
    match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => address.set_ip(Ipv4Addr::LOCALHOST.into()),
        IpAddr::V6(ip) if ip.is_unspecified() => address.set_ip(Ipv6Addr::LOCALHOST.into()),
        IpAddr::V4(_) | IpAddr::V6(_) => {}
    }
    address
}

/// Whether a request for `host`, the value of its Host header, is meant for the listener at `address`. Any name is
/// allowed unless that is a loopback address.
pub(crate) fn is_allowed_host(host: Option<&str>, address: SocketAddr) -> bool {
    let Some(host) = host else { return false };
    if !address.ip().is_loopback() {
        return true;
    }
    // An IPv6 address has colons too: only digits after the last one are a port.
    let name = host.rsplit_once(':').map_or(host, |(name, port)| {
        if port.bytes().all(|digit| digit.is_ascii_digit()) {
            name
        } else {
            host
        }
    });
    matches!(name, "localhost" | "127.0.0.1" | "[::1]") || name == address.ip().to_string()
}

/// Waits until the devices are counted, so that the response describes the TTI of the request. While the clock is
/// paused or slow, the previous count must do.
async fn wait_for_device_count(metrics: &PrometheusMetrics) {
    metrics.request_device_count();
    let requested = runtime::now();
    while metrics.is_count_pending() && requested.elapsed() < COUNT_PATIENCE {
        tokio::time::sleep(COUNT_POLL).await;
    }
}

async fn serve_metrics(State(state): State<MetricsState>, request: Request) -> impl IntoResponse {
    let accept = request
        .headers()
        .get(header::ACCEPT)
        .and_then(|accept| accept.to_str().ok());
    let is_openmetrics = accept.is_some_and(|accept| accept.contains(OPENMETRICS_TYPE));
    let content_type = if is_openmetrics {
        "application/openmetrics-text; version=1.0.0; charset=utf-8"
    } else {
        "text/plain; version=0.0.4; charset=utf-8"
    };
    wait_for_device_count(&state.metrics).await;
    let text = state.metrics.encode((state.process_stats)(), is_openmetrics);
    ([(header::CONTENT_TYPE, content_type)], text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_in_use_has_alternatives() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = taken.local_addr().expect("bound").to_string();
        let refusal = check_can_listen("--metrics", &address).expect_err("in use").to_string();
        let start = format!("--metrics {address}: the port is in use; ");
        assert!(refusal.starts_with(&start), "{refusal}");
        assert!(refusal.contains("--metrics 127.0.0.1:0 for any free port"), "{refusal}");
        for address in ["127.0.0.1", "nowhere.invalid:0"] {
            let refusal = check_can_listen("--metrics", address)
                .expect_err("no address")
                .to_string();
            assert!(
                refusal.ends_with("; give ADDRESS:PORT of this machine, such as 127.0.0.1:9464"),
                "{refusal}"
            );
        }
    }

    #[test]
    fn a_foreign_host_name_is_refused_on_a_local_address() {
        let local: SocketAddr = "127.0.0.1:9464".parse().expect("an address");
        for host in ["localhost", "localhost:9464", "127.0.0.1:9464", "[::1]:9464"] {
            assert!(is_allowed_host(Some(host), local), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:9464",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example:80",
        ] {
            assert!(!is_allowed_host(Some(host), local), "{host}");
        }
        assert!(!is_allowed_host(None, local));
        let public: SocketAddr = "0.0.0.0:9464".parse().expect("an address");
        assert!(is_allowed_host(Some("testbed:9464"), public));
    }
}
