//! What a run serves over HTTP: its metrics.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use reveille_view::metrics::{Metrics, Process};
use tokio::net::TcpListener;

use crate::display::note;

const OPEN: &str = "application/openmetrics-text";

/// Tells how the processes of the run are.
type Ask = dyn Fn() -> Process + Send + Sync;

/// What answers need.
#[derive(Clone)]
struct Served {
    metrics: Arc<Metrics>,
    process: Arc<Ask>,
    /// Where it listens.
    at: SocketAddr,
}

/// Looks whether this process can listen at `address`, which the command line gave by `option`.
///
/// # Errors
/// It cannot.
pub fn can_listen(option: &str, address: &str) -> anyhow::Result<()> {
    let bound = std::net::TcpListener::bind(address);
    let hint = "must be ADDRESS:PORT of this machine, such as 127.0.0.1:9464, with a free port or port 0";
    bound.map(drop).with_context(|| format!("{option} {address}: {hint}"))
}

/// Serves `metrics` at `address` until the program ends, where `process` tells how the processes are.
///
/// # Errors
/// If nothing can listen there.
pub async fn serve(address: &str, metrics: Arc<Metrics>, process: Arc<Ask>) -> anyhow::Result<()> {
    let named = || format!("--metrics {address}");
    let listener = TcpListener::bind(address).await.with_context(named)?;
    let at = listener.local_addr().with_context(named)?;
    note!("metrics at http://{at}/metrics");
    let served = Served { metrics, process, at };
    let router = Router::new()
        .route("/", get(|| async { Redirect::temporary("/metrics") }))
        .route("/metrics", get(tell))
        .layer(middleware::from_fn_with_state(served.clone(), guard))
        .with_state(served);
    tokio::spawn(async move {
        if let Err(error) = axum::serve(listener, router).await {
            tracing::warn!(%error, "metrics are not served any more");
        }
    });
    Ok(())
}

/// Refuses pages of other sites that have their name resolved to this machine.
async fn guard(State(served): State<Served>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    if is_meant(host, served.at) {
        next.run(request).await
    } else {
        (
            StatusCode::MISDIRECTED_REQUEST,
            "this is served under its address alone\n",
        )
            .into_response()
    }
}

/// Whether a request for `host` is one for what listens at `at`. Who listens on other than loopback addresses may be
/// called by any name.
pub fn is_meant(host: Option<&str>, at: SocketAddr) -> bool {
    let Some(host) = host else { return false };
    if !at.ip().is_loopback() {
        return true;
    }
    let name = host.rsplit_once(':').map_or(host, |(name, port)| {
        if port.bytes().all(|digit| digit.is_ascii_digit()) {
            name
        } else {
            host
        }
    });
    matches!(name, "localhost" | "127.0.0.1" | "[::1]") || name == at.ip().to_string()
}

async fn tell(State(served): State<Served>, request: Request) -> impl IntoResponse {
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
    let text = served.metrics.tell((served.process)(), is_open);
    ([(header::CONTENT_TYPE, form)], text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_name_for_this_machine_is_refused() {
        let at: SocketAddr = "127.0.0.1:9464".parse().expect("an address");
        for host in ["localhost", "localhost:9464", "127.0.0.1:9464", "[::1]:9464"] {
            assert!(is_meant(Some(host), at), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:9464",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example:80",
        ] {
            assert!(!is_meant(Some(host), at), "{host}");
        }
        assert!(!is_meant(None, at));
        let open: SocketAddr = "0.0.0.0:9464".parse().expect("an address");
        assert!(is_meant(Some("testbed:9464"), open));
    }
}
