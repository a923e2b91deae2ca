//! The dashboard: a live or recorded run in the browser.
//!
//! It is a single page that loads nothing from other sites (`page/`), an HTTP interface (`api`), and a copy of the run
//! (`feed`). The page itself needs no token. On a loopback address reading the run needs none either. Changes need one,
//! and so does every request under `/api/` if other machines can connect (`api::check_request`). `page/*.js`,
//! `tests/program/dashboard.rs`, `tests/browser/check.py` and `bench/watch.rs` use the routes.

mod api;
mod commands;
mod curves;
mod events;
pub(crate) mod feed;
mod files;
mod http;
mod page;
mod timeline;

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::http::{HeaderName, StatusCode, header};
use axum::middleware;
use axum::response::IntoResponse;
use axum::routing::{get, post};
use reveille_common::bus::{Bus, draw_secret};
use tokio::net::TcpListener;

use self::api::{ApiState, check_request};
use self::feed::Feed;
use self::http::ApiError;
use self::page::PAGE;
use crate::metrics_server::{listen_error, local_target};

/// The content security policy: the browser loads content from this server only.
const CONTENT_POLICY: &str = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; \
                              base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A running dashboard.
pub(crate) struct Dashboard {
    /// Its address for the browser, with the token.
    pub url: String,
}

/// Serves `feed` at `address` until the program ends. With a `bus` that has the run's key, the page can control the
/// clock of that run and act on its devices.
///
/// # Errors
/// If it cannot listen there.
pub(crate) async fn serve(address: &str, feed: Arc<Feed>, bus: Option<Bus>) -> anyhow::Result<Dashboard> {
    let to_listen_error = |error| listen_error("--dashboard", address, &error);
    let listener = TcpListener::bind(address).await.map_err(to_listen_error)?;
    let local_address: SocketAddr = listener.local_addr().map_err(to_listen_error)?;
    let token = draw_secret()?.to_string();
    // Browsers send no fragment to a server, so the token stays out of logs.
    let url = format!("http://{}/#{token}", local_target(local_address));
    let state = ApiState::new(feed, bus, token, local_address);
    // `check_request` asks no token for paths outside `/api/`, nor for GET on a loopback address: a route that shows
    // the run belongs under `/api/`, and one that changes it is a POST.
    let mut router = Router::new()
        .route("/api/run", get(api::about))
        .route("/api/now", get(api::now))
        .route("/api/live", get(api::live))
        .route("/api/tti/{tti}", get(api::tti))
        .route("/api/curves", get(api::curves))
        .route("/api/compare", get(api::compared))
        .route("/api/other/tti/{tti}", get(api::compared_tti))
        .route("/api/other/curves", get(api::compared_curves))
        .route("/api/messages", get(api::messages))
        .route("/api/message/{number}", get(api::message))
        .route("/api/device/{device}", get(api::device))
        .route("/api/timeline", get(api::timeline))
        .route("/api/events", get(api::events))
        .route("/api/miss", get(api::miss))
        .route("/api/heat/{tti}", get(api::heat))
        .route("/api/other/heat/{tti}", get(api::compared_heat))
        .route("/api/files", get(files::files))
        .route("/api/files/{*name}", get(files::file))
        .route("/api/clock", get(commands::clock))
        .route("/api/clock/{command}", post(commands::command))
        .route("/api/act/{action}", post(commands::act));
    for &(path, content_type, text) in PAGE {
        let path = if path == "/index.html" { "/" } else { path };
        let serve_file = move || async move {
            let headers = [
                (header::CONTENT_TYPE, content_type),
                (header::CACHE_CONTROL, "no-store"),
                (header::CONTENT_SECURITY_POLICY, CONTENT_POLICY),
                (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
                (HeaderName::from_static("referrer-policy"), "no-referrer"),
            ];
            (headers, text).into_response()
        };
        router = router.route(path, get(serve_file));
    }
    let no_page = || async {
        ApiError(
            StatusCode::NOT_FOUND,
            "no such page; docs/watching.md lists the main ones".to_owned(),
        )
    };
    let no_method = || async {
        ApiError(
            StatusCode::METHOD_NOT_ALLOWED,
            "use POST for commands and GET for everything else".to_owned(),
        )
    };
    router = router.fallback(no_page).method_not_allowed_fallback(no_method);
    // A layer covers the routes added before it: all of them, the pages included.
    let router = router
        .layer(middleware::from_fn_with_state(state.clone(), check_request))
        .with_state(state);
    tokio::spawn(async move {
        if let Err(error) = axum::serve(listener, router).await {
            tracing::warn!(%error, "the dashboard server has stopped");
        }
    });
    Ok(Dashboard { url })
}
