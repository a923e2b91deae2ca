//! The HTTP interface that the dashboard page uses.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, Query, Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use reveille_common::bus::Bus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ClockCommand, MessageKind, Pace, Plane};
use reveille_view::filter::{Filter, StateName};
use reveille_view::frame_line::{FrameLine, hex, owner};
use reveille_view::history::RunHistory;
use serde::Deserialize;
use serde_json::{Value, json};
use subtle::ConstantTimeEq;
use tokio::sync::{Semaphore, watch};

use super::feed::Feed;
use crate::metrics_server::is_allowed_host;

/// The header that holds the token.
const TOKEN: &str = "x-reveille-token";
/// Least time between two updates of the page.
const BEAT: Duration = Duration::from_millis(40);
/// Most messages in one answer.
const MOST: usize = 1_000;
/// Longest history of a device and longest search for states, TTIs.
const LONGEST: u64 = 5_000;
/// Most concurrent readers of the history.
const READERS: usize = 2;
/// Longest wait for an answer of the clock.
const PATIENCE: Duration = Duration::from_secs(5);

/// State shared by all request handlers.
#[derive(Clone)]
pub(super) struct ApiState {
    feed: Arc<Feed>,
    bus: Option<Bus>,
    token: Arc<str>,
    at: SocketAddr,
    /// The current state of the run, broadcast to all clients.
    now: Arc<watch::Sender<Arc<str>>>,
    /// Permits for concurrent readers of the history.
    readers: Arc<Semaphore>,
}

impl ApiState {
    /// Creates the state of a server at `at`. Call it within a runtime.
    pub(super) fn new(feed: Arc<Feed>, bus: Option<Bus>, token: String, at: SocketAddr) -> Self {
        let now = Arc::new(watch::Sender::new(Arc::from("{}")));
        let (own, send) = (Arc::clone(&feed), Arc::clone(&now));
        tokio::spawn(async move {
            loop {
                // `notify_waiters` keeps no permit: the timeout covers a notification that came while nothing waited.
                let rung = tokio::time::timeout(Duration::from_secs(1), own.changed.notified()).await;
                if rung.is_ok() {
                    tokio::time::sleep(BEAT).await;
                }
                // Without a listener the state is not computed.
                if send.receiver_count() > 0 {
                    let _gone = send.send(Arc::from(own.now().to_string())).is_err();
                }
            }
        });
        Self {
            feed,
            bus,
            token: token.into(),
            at,
            now,
            readers: Arc::new(Semaphore::new(READERS)),
        }
    }

    /// Runs `look` on a blocking thread. Few run at a time, so that the run's own thread is not delayed.
    async fn aside<T: Send + 'static>(&self, look: impl FnOnce(&Feed) -> T + Send + 'static) -> Result<T, ApiError> {
        let busy = || {
            ApiError(
                StatusCode::SERVICE_UNAVAILABLE,
                "the dashboard is shutting down".to_owned(),
            )
        };
        let permit = Arc::clone(&self.readers).acquire_owned().await.map_err(|_| busy())?;
        let feed = Arc::clone(&self.feed);
        let looked = tokio::task::spawn_blocking(move || {
            // Held by the thread itself: it can outlive a request that is given up.
            let _permit = permit;
            look(&feed)
        });
        looked.await.map_err(|_| busy())
    }
}

/// A JSON answer or an error.
type ApiResult = Result<Json<Value>, ApiError>;

/// The status and message of a failed request.
pub(super) struct ApiError(StatusCode, String);

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        (self.0, Json(json!({ "error": self.1 }))).into_response()
    }
}

/// Passes on allowed requests only.
pub(super) async fn guard(State(served): State<ApiState>, request: Request, next: Next) -> Response {
    match refused(&served, &request) {
        Some(refusal) => refusal.into_response(),
        None => next.run(request).await,
    }
}

/// The reason why a request is refused, if it is. Refused are requests under another host name, from a page of another
/// site, and without the token. Reading from a loopback address needs no token.
fn refused(served: &ApiState, request: &Request) -> Option<ApiError> {
    let get = |name: &str| request.headers().get(name).and_then(|value| value.to_str().ok());
    let host = get(header::HOST.as_str());
    // Against DNS rebinding: another site can make its own name resolve to this machine.
    if !is_allowed_host(host, served.at) {
        let why = "the request names another host; open the printed address".to_owned();
        return Some(ApiError(StatusCode::MISDIRECTED_REQUEST, why));
    }
    let own = host.map(|host| format!("http://{host}"));
    // Browsers name the page that sends the request; a page of another site must not drive the clock.
    if get(header::ORIGIN.as_str()).is_some_and(|origin| Some(origin) != own.as_deref()) {
        return Some(ApiError(
            StatusCode::FORBIDDEN,
            "the request comes from another site".to_owned(),
        ));
    }
    // A simple GET from another site has no Origin, but browsers mark it with this header.
    if get("sec-fetch-site") == Some("cross-site") && request.uri().path().starts_with("/api/") {
        return Some(ApiError(
            StatusCode::FORBIDDEN,
            "the request comes from a page of another site".to_owned(),
        ));
    }
    let is_reading = request.method() == Method::GET;
    let is_page = !request.uri().path().starts_with("/api/");
    let is_free = is_reading && (is_page || served.at.ip().is_loopback());
    // Compared in constant time, so that the response time reveals nothing about the token.
    let has_token = get(TOKEN).is_some_and(|token| token.as_bytes().ct_eq(served.token.as_bytes()).into());
    let why = || "the token is missing; open the address that the program printed".to_owned();
    (!is_free && !has_token).then(|| ApiError(StatusCode::UNAUTHORIZED, why()))
}

pub(super) async fn about(State(served): State<ApiState>) -> Json<Value> {
    let mut about = served.feed.about().clone();
    about["controls"] = json!(served.bus.is_some());
    Json(about)
}

pub(super) async fn now(State(served): State<ApiState>) -> Json<Value> {
    Json(served.feed.now())
}

/// Sends the state of the run after every change, as server-sent events. Slow readers skip some.
pub(super) async fn live(State(served): State<ApiState>) -> impl IntoResponse {
    // Sent without a wait: the next change of a paused run can be far away.
    let first = Some(served.feed.now().to_string());
    let events = futures::stream::unfold((served.now.subscribe(), first), |(mut now, first)| async move {
        let event = if let Some(first) = first {
            Event::default().data(first)
        } else {
            now.changed().await.ok()?;
            Event::default().data(&*now.borrow_and_update())
        };
        Some((Ok::<_, Infallible>(event), (now, None)))
    });
    ([(header::CACHE_CONTROL, "no-store")], Sse::new(events))
}

pub(super) async fn tti(State(served): State<ApiState>, Path(tti): Path<u64>) -> ApiResult {
    let found = served.aside(move |feed| feed.at(Tti(tti))).await?;
    found
        .map(Json)
        .ok_or_else(|| ApiError(StatusCode::NOT_FOUND, format!("TTI {tti} is not in memory any more")))
}

fn alone() -> ApiError {
    ApiError(
        StatusCode::NOT_FOUND,
        "the dashboard has no other run; start it with --compare".to_owned(),
    )
}

pub(super) async fn other_tti(State(served): State<ApiState>, Path(tti): Path<u64>) -> ApiResult {
    let found = served
        .aside(move |feed| feed.other().map(|other| other.at(Tti(tti))))
        .await?;
    found
        .ok_or_else(alone)?
        .map(Json)
        .ok_or_else(|| ApiError(StatusCode::NOT_FOUND, format!("TTI {tti} is not in the other run")))
}

pub(super) async fn other_curves(State(served): State<ApiState>) -> ApiResult {
    served.feed.other().map(|other| Json(other.curves())).ok_or_else(alone)
}

pub(super) async fn compared(State(served): State<ApiState>) -> ApiResult {
    served.feed.compared().map(Json).ok_or_else(alone)
}

pub(super) async fn curves(State(served): State<ApiState>) -> Json<Value> {
    Json(served.feed.curves())
}

/// The filters of the message list, with the names of `inspect tail`.
#[derive(Deserialize)]
pub(super) struct MessageQuery {
    plane: Option<String>,
    kind: Option<String>,
    device: Option<u32>,
    cluster: Option<u32>,
    state: Option<String>,
    since: Option<u64>,
    until: Option<u64>,
    limit: Option<usize>,
}

impl MessageQuery {
    fn filter(&self, feed: &Feed) -> Result<Filter, ApiError> {
        let refuse = |what: &str| ApiError(StatusCode::BAD_REQUEST, format!("no such {what}"));
        let plane = self.plane.as_deref().filter(|name| !name.is_empty());
        let plane = plane.map(|name| {
            Plane::ALL
                .into_iter()
                .find(|plane| plane.name() == name)
                .ok_or_else(|| refuse("plane; use air, emu or truth"))
        });
        let kinds = listed(self.kind.as_deref());
        let kind = |name| MessageKind::ALL.iter().copied().find(|kind| kind.name() == name);
        let kinds = kinds.map(|name| kind(name).ok_or_else(|| refuse("kind")));
        let state = |name| StateName::ALL.into_iter().find(|(own, _)| *own == name);
        let states = listed(self.state.as_deref()).map(|name| state(name).ok_or_else(|| refuse("state")));
        let own = self.device.map(DeviceId);
        let devices = match self.cluster {
            Some(number) => {
                let group = feed.group(number).ok_or_else(|| refuse("cluster"))?;
                Some(
                    group
                        .into_iter()
                        .filter(|id| own.is_none_or(|own| own == *id))
                        .collect(),
                )
            }
            None => own.map(|own| vec![own]),
        };
        let filter = Filter {
            plane: plane.transpose()?,
            kinds: kinds.collect::<Result<_, _>>()?,
            devices,
            ttis: Some(self.since.unwrap_or(0)..=self.until.unwrap_or(u64::MAX)),
            states: states
                .map(|found| found.map(|(_, state)| state))
                .collect::<Result<_, _>>()?,
        };
        let (first, last) = feed.history(RunHistory::span);
        let (from, end) = (
            first.0.max(self.since.unwrap_or(0)),
            last.0.min(self.until.unwrap_or(u64::MAX)),
        );
        if !filter.states.is_empty() && end.saturating_sub(from) > LONGEST {
            let why = format!("a state filter covers at most {LONGEST} TTIs; limit it with from and to");
            return Err(ApiError(StatusCode::BAD_REQUEST, why));
        }
        filter.check().map_err(|why| ApiError(StatusCode::BAD_REQUEST, why))?;
        Ok(filter)
    }
}

/// The names in a comma-separated list.
fn listed(names: Option<&str>) -> impl Iterator<Item = &str> {
    let names = names.unwrap_or_default().split(',').map(str::trim);
    names.filter(|name| !name.is_empty())
}

pub(super) async fn messages(State(served): State<ApiState>, Query(wanted): Query<MessageQuery>) -> ApiResult {
    let filter = wanted.filter(&served.feed)?;
    let most = wanted.limit.unwrap_or(MOST).min(MOST);
    let rows = served
        .aside(move |feed| {
            feed.history(|story| {
                let row = |(number, frame): (u64, &reveille_common::message::Frame)| {
                    let text = match frame.message() {
                        Ok(message) => message.to_string(),
                        Err(error) => format!("invalid message: {error}"),
                    };
                    json!({
                        "id": number,
                        "tti": frame.tti,
                        "plane": frame.kind.plane().name(),
                        "kind": frame.kind.name(),
                        "whose": owner(frame.kind, frame.number),
                        "bytes": frame.payload.len(),
                        "text": text,
                    })
                };
                story.frames(&filter, most).into_iter().map(row).collect::<Vec<Value>>()
            })
        })
        .await?;
    Ok(Json(json!(rows)))
}

pub(super) async fn message(State(served): State<ApiState>, Path(number): Path<u64>) -> ApiResult {
    let found = served.feed.history(|story| {
        let frame = story.frame(number)?;
        let line: Value = serde_json::from_str(&FrameLine::new(frame).to_json()).ok()?;
        Some(json!({ "message": line, "hex": hex(&frame.payload) }))
    });
    found.map(Json).ok_or_else(|| {
        ApiError(
            StatusCode::NOT_FOUND,
            format!("message {number} is not in memory any more"),
        )
    })
}

/// The requested TTIs of a history.
#[derive(Deserialize)]
pub(super) struct TtiRange {
    from: Option<u64>,
    end: Option<u64>,
    /// The TTI up to which sums are requested.
    at: Option<u64>,
}

pub(super) async fn device(
    State(served): State<ApiState>,
    Path(device): Path<u32>,
    Query(span): Query<TtiRange>,
) -> ApiResult {
    let (from, end) = (span.from.unwrap_or(0), span.end.unwrap_or(u64::MAX));
    let look = move |story: &RunHistory| {
        let (first, last) = story.span();
        // A request can name any TTIs, so the length of the history is bounded.
        let (from, end) = (Tti(from).max(first).min(last), Tti(end).min(last));
        let end = end.min(from + LONGEST);
        let totals = span.at.and_then(|at| story.totals(DeviceId(device), Tti(at)));
        (story.history(DeviceId(device), from, end), totals)
    };
    let (history, totals) = served.aside(move |feed| feed.history(look)).await?;
    if history.is_empty() {
        return Err(ApiError(
            StatusCode::NOT_FOUND,
            format!("device {device} has no history in these TTIs"),
        ));
    }
    Ok(Json(json!({
        "device": device,
        "from": history[0].0,
        "states": super::feed::states(&history.iter().map(|(_, view)| *view).collect::<Vec<_>>()),
        "batteries": history.iter().map(|(_, view)| view.battery.units()).collect::<Vec<_>>(),
        "totals": totals.map(|totals| json!({
            "initial": totals.initial.units(),
            "harvested": totals.harvested.units(),
            "sensing": totals.spent.sensing.units(),
            "sleep": totals.spent.sleep.units(),
            "report": totals.spent.report.units(),
            "overflow": totals.overflow.units(),
            "battery": totals.battery.units(),
            "sensing_ttis": totals.sensing_ttis,
            "failed_ttis": totals.failed_ttis,
            "unpowered_ttis": totals.unpowered_ttis,
        })),
    })))
}

pub(super) async fn clock(State(served): State<ApiState>) -> ApiResult {
    ask(&served, ClockCommand::Status).await
}

/// The number of a command.
#[derive(Deserialize)]
pub(super) struct CountParam {
    n: Option<u64>,
}

pub(super) async fn command(
    State(served): State<ApiState>,
    Path(command): Path<String>,
    Query(count): Query<CountParam>,
) -> ApiResult {
    let command = match (command.as_str(), count.n) {
        ("pause", _) => ClockCommand::Pause,
        ("resume", _) => ClockCommand::Resume,
        ("step", n) => ClockCommand::Step(n.unwrap_or(1).max(1)),
        ("run-to", Some(n)) => ClockCommand::RunTo(Tti(n)),
        ("pace", Some(0)) => ClockCommand::Pace(Pace::Max),
        ("pace", Some(n)) => ClockCommand::Pace(Pace::RealTime(n)),
        _ => {
            let why = "unknown clock command; use pause, resume, step?n=1, run-to?n=4000, or pace?n=5000 (µs per TTI, \
                 0: no limit)";
            let why = why.to_owned();
            return Err(ApiError(StatusCode::BAD_REQUEST, why));
        }
    };
    ask(&served, command).await
}

async fn ask(served: &ApiState, command: ClockCommand) -> ApiResult {
    let Some(bus) = &served.bus else {
        return Err(ApiError(
            StatusCode::CONFLICT,
            "a recording has no clock to control".to_owned(),
        ));
    };
    match bus.query(&command, PATIENCE).await {
        // The clock ignores such a command; its status alone does not show that.
        Ok(Some(status)) if matches!(command, ClockCommand::RunTo(k) if k < status.tti || k.0 > status.ttis) => {
            let (next, ttis) = (status.tti, status.ttis);
            let why = format!("run-to: must be from {next}, the next TTI, to {ttis}, the end of the run");
            Err(ApiError(StatusCode::BAD_REQUEST, why))
        }
        Ok(Some(status)) => Ok(Json(json!({ "status": status, "text": status.to_string() }))),
        Ok(None) => Err(ApiError(StatusCode::GONE, "the run has ended".to_owned())),
        Err(error) => Err(ApiError(StatusCode::BAD_GATEWAY, error.to_string())),
    }
}
