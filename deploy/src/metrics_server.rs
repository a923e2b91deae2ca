//! The HTTP server for the metrics of a run.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use reveille_view::metrics::{ProcessStats, PrometheusMetrics};
use tokio::net::TcpListener;

use crate::display::note;

const OPEN: &str = "application/openmetrics-text";

/// Returns the statistics of the run's processes.
type Ask = dyn Fn() -> ProcessStats + Send + Sync;

/// State shared by the request handlers.
#[derive(Clone)]
struct MetricsState {
    metrics: Arc<PrometheusMetrics>,
    process: Arc<Ask>,
    /// The address of the listener.
    at: SocketAddr,
}

/// Checks that this process can listen at `address`, which was given by `option`.
///
/// # Errors
/// If it cannot.
pub(crate) fn can_listen(option: &str, address: &str) -> anyhow::Result<()> {
    let bound = std::net::TcpListener::bind(address);
    let hint = "must be ADDRESS:PORT of this machine, such as 127.0.0.1:9464, with a free port or port 0";
    bound.map(drop).with_context(|| format!("{option} {address}: {hint}"))
}

/// Serves `metrics` at `address` until the program ends. `process` returns the statistics of the processes.
///
/// # Errors
/// If it cannot listen there.
pub(crate) async fn serve(address: &str, metrics: Arc<PrometheusMetrics>, process: Arc<Ask>) -> anyhow::Result<()> {
    let named = || format!("--metrics {address}");
    let listener = TcpListener::bind(address).await.with_context(named)?;
    let at = listener.local_addr().with_context(named)?;
    note!("metrics at http://{at}/metrics");
    let served = MetricsState { metrics, process, at };
    let router = Router::new()
        .route("/", get(|| async { Redirect::temporary("/metrics") }))
        .route("/metrics", get(serve_metrics))
        .layer(middleware::from_fn_with_state(served.clone(), guard))
        .with_state(served);
    tokio::spawn(async move {
        if let Err(error) = axum::serve(listener, router).await {
            tracing::warn!(%error, "the metrics server has stopped");
        }
    });
    Ok(())
}

/// Refuses requests from pages of other sites whose name resolves to this machine.
async fn guard(State(served): State<MetricsState>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    if is_allowed_host(host, served.at) {
        next.run(request).await
    } else {
        (
            StatusCode::MISDIRECTED_REQUEST,
            "the request names another host; use the printed address\n",
        )
            .into_response()
    }
}

/// Whether a request for `host` is meant for the listener `at`. On other than loopback addresses any name is allowed.
pub(crate) fn is_allowed_host(host: Option<&str>, at: SocketAddr) -> bool {
    let Some(host) = host else { return false };
    if !at.ip().is_loopback() {
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
    matches!(name, "localhost" | "127.0.0.1" | "[::1]") || name == at.ip().to_string()
}

async fn serve_metrics(State(served): State<MetricsState>, request: Request) -> impl IntoResponse {
    let accept = request
        .headers()
        .get(header::ACCEPT)
        .and_then(|accept| accept.to_str().ok());
    let is_open = accept.is_some_and(|accept| accept.contains(OPEN));
    let form = if is_open {
        "application/openmetrics-text; version=1.0.0; charset=utf-8"
    } else {
        "text/plain; version=0.0.4; charset=utf-8"
    };
    let text = served.metrics.encode((served.process)(), is_open);
    ([(header::CONTENT_TYPE, form)], text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_name_for_this_machine_is_refused() {
        let at: SocketAddr = "127.0.0.1:9464".parse().expect("an address");
        for host in ["localhost", "localhost:9464", "127.0.0.1:9464", "[::1]:9464"] {
            assert!(is_allowed_host(Some(host), at), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:9464",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example:80",
        ] {
            assert!(!is_allowed_host(Some(host), at), "{host}");
        }
        assert!(!is_allowed_host(None, at));
        let open: SocketAddr = "0.0.0.0:9464".parse().expect("an address");
        assert!(is_allowed_host(Some("testbed:9464"), open));
    }
}
