//! The HTTP interface that the dashboard page uses: a handler for each route of `mod.rs` that is not in `commands` or
//! `files`. Every request passes [`check_request`] first. `page/*.js` uses the paths, query names, JSON keys and status
//! codes; `tests/program/dashboard.rs`, `tests/browser/check.py` and `bench/watch.rs` use some. `feed` makes most of
//! the JSON.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use reveille_common::bus::Bus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, Plane};
use reveille_view::filter::{Filter, StateName};
use reveille_view::frame_line::{FrameLine, key_owner, to_hex};
use reveille_view::history::RunHistory;
use serde::Deserialize;
use serde_json::{Value, json};
use subtle::ConstantTimeEq;
use tokio::sync::{Semaphore, watch};

use super::curves::CurvePoint;
use super::feed::Feed;
use super::http::{ApiError, ApiResult, Params, PathPart};
use super::timeline::{MAX_COLUMNS, MAX_DEVICE_TTIS, TimelineRequest, parse_rows};
use crate::metrics_server::is_allowed_host;

/// The header that holds the token. `page/api.js` and `tests/program/dashboard.rs` repeat the name.
const TOKEN_HEADER: &str = "x-reveille-token";
/// Least time between two updates of the page.
const UPDATE_INTERVAL: Duration = Duration::from_millis(45);
/// Most messages in one answer.
const MAX_MESSAGES: usize = 1_000;
/// Longest history of a device and longest search for states, TTIs.
const MAX_HISTORY_TTIS: u64 = 5_000;
/// Most concurrent readers of the history.
const MAX_READERS: usize = 2;

/// The start of each path whose requests have parameters; their handlers refuse unknown ones.
const PARAMETERISED: [&str; 7] = [
    "/api/messages",
    "/api/device/",
    "/api/timeline",
    "/api/events",
    "/api/miss",
    "/api/clock/",
    "/api/act/",
];

/// State shared by all request handlers.
#[derive(Clone)]
pub(super) struct ApiState {
    pub(super) feed: Arc<Feed>,
    /// The bus of a live run; commands need one with the run's key. `None` for a recording.
    pub(super) bus: Option<Bus>,
    token: Arc<str>,
    address: SocketAddr,
    /// The current state of the run as JSON, broadcast to all clients of [`live`].
    live_state: Arc<watch::Sender<Arc<str>>>,
    /// Permits for concurrent readers of the history.
    readers: Arc<Semaphore>,
}

impl ApiState {
    /// Creates the state of a server at `address`. Call it within a runtime.
    pub(super) fn new(feed: Arc<Feed>, bus: Option<Bus>, token: String, address: SocketAddr) -> Self {
        let live_state = Arc::new(watch::Sender::new(Arc::from("{}")));
        let (task_feed, sender) = (Arc::clone(&feed), Arc::clone(&live_state));
        tokio::spawn(async move {
            let mut next_update = tokio::time::Instant::now();
            loop {
                // `notify_waiters` keeps no permit: the timeout covers a notification that came while nothing waited.
                let notified = tokio::time::timeout(Duration::from_secs(1), task_feed.changed.notified()).await;
                if notified.is_ok() {
                    tokio::time::sleep_until(next_update).await;
                }
                next_update = tokio::time::Instant::now() + UPDATE_INTERVAL;
                // Without a listener the state is not computed.
                if sender.receiver_count() > 0 {
                    let _gone = sender.send(Arc::from(task_feed.current_json().to_string())).is_err();
                }
            }
        });
        Self {
            feed,
            bus,
            token: token.into(),
            address,
            live_state,
            readers: Arc::new(Semaphore::new(MAX_READERS)),
        }
    }

    /// Calls `read` on a blocking thread. Few run at a time, so that the run's own thread is not delayed.
    pub(super) async fn read_feed<T: Send + 'static>(
        &self,
        read: impl FnOnce(&Feed) -> T + Send + 'static,
    ) -> Result<T, ApiError> {
        let unavailable = || {
            ApiError(
                StatusCode::SERVICE_UNAVAILABLE,
                "the dashboard is shutting down".to_owned(),
            )
        };
        let permit = Arc::clone(&self.readers)
            .acquire_owned()
            .await
            .map_err(|_| unavailable())?;
        let feed = Arc::clone(&self.feed);
        let result = tokio::task::spawn_blocking(move || {
            // Held by the thread itself: it can outlive a request that is given up.
            let _permit = permit;
            read(&feed)
        });
        result.await.map_err(|_| unavailable())
    }
}

/// Passes on allowed requests only.
pub(super) async fn check_request(State(served): State<ApiState>, request: Request, next: Next) -> Response {
    match refusal_of(&served, &request) {
        Some(refusal) => refusal.into_response(),
        None => next.run(request).await,
    }
}

/// The reason why a request is refused, if it is: another host name, a page of another site, no token, or parameters
/// on a path without any. Reading from a loopback address needs no token, and neither do the page's files.
fn refusal_of(served: &ApiState, request: &Request) -> Option<ApiError> {
    let header_text = |name: &str| request.headers().get(name).and_then(|value| value.to_str().ok());
    let host = header_text(header::HOST.as_str());
    // Against DNS rebinding: another site can make its own name resolve to this machine.
    if !is_allowed_host(host, served.address) {
        let why = "the request names another host; open the printed address".to_owned();
        return Some(ApiError(StatusCode::MISDIRECTED_REQUEST, why));
    }
    let own_origin = host.map(|host| format!("http://{host}"));
    // Browsers name the page that sends the request; a page of another site must not drive the clock.
    if header_text(header::ORIGIN.as_str()).is_some_and(|origin| Some(origin) != own_origin.as_deref()) {
        return Some(ApiError(
            StatusCode::FORBIDDEN,
            "the request comes from another site".to_owned(),
        ));
    }
    // A simple GET from another site has no Origin, but browsers mark it with this header.
    if header_text("sec-fetch-site") == Some("cross-site") && request.uri().path().starts_with("/api/") {
        return Some(ApiError(
            StatusCode::FORBIDDEN,
            "the request comes from a page of another site".to_owned(),
        ));
    }
    let is_reading = request.method() == Method::GET;
    let is_page = !request.uri().path().starts_with("/api/");
    let needs_no_token = is_reading && (is_page || served.address.ip().is_loopback());
    // Compared in constant time, so that the response time reveals nothing about the token.
    let has_token =
        header_text(TOKEN_HEADER).is_some_and(|token| token.as_bytes().ct_eq(served.token.as_bytes()).into());
    let why = || {
        "the token is missing or wrong; open the address that the program printed, or send its part after `#` in the \
         header x-reveille-token"
            .to_owned()
    };
    if !needs_no_token && !has_token {
        return Some(ApiError(StatusCode::UNAUTHORIZED, why()));
    }
    // An ignored parameter would return another TTI than the requested one.
    let path = request.uri().path();
    let has_parameters = request.uri().query().is_some_and(|query| !query.is_empty());
    let is_parameterless = !is_page && !PARAMETERISED.iter().any(|start| path.starts_with(start));
    (has_parameters && is_parameterless).then(|| ApiError(StatusCode::BAD_REQUEST, format!("{path} has no parameters")))
}

pub(super) async fn about(State(served): State<ApiState>) -> Json<Value> {
    let mut about = served.feed.about().clone();
    about["controls"] = json!(served.bus.is_some());
    // A browser sends no token when it follows a link.
    about["needs_token"] = json!(!served.address.ip().is_loopback());
    Json(about)
}

pub(super) async fn now(State(served): State<ApiState>) -> Json<Value> {
    Json(served.feed.current_json())
}

/// Sends the state of the run after every change, as server-sent events. Slow readers skip some.
pub(super) async fn live(State(served): State<ApiState>) -> impl IntoResponse {
    // Sent without a wait: the next change of a paused run can be far away.
    let first = Some(served.feed.current_json().to_string());
    let events = futures::stream::unfold(
        (served.live_state.subscribe(), first),
        |(mut updates, first)| async move {
            let event = if let Some(first) = first {
                Event::default().data(first)
            } else {
                updates.changed().await.ok()?;
                Event::default().data(&*updates.borrow_and_update())
            };
            Some((Ok::<_, Infallible>(event), (updates, None)))
        },
    );
    ([(header::CACHE_CONTROL, "no-store")], Sse::new(events))
}

/// Data of a TTI, if it is available.
type ReadTti = fn(&Feed, Tti) -> Option<Value>;

/// Serves the data of TTI `tti`.
async fn serve_tti(served: &ApiState, tti: u64, read: ReadTti) -> ApiResult {
    let value = served.read_feed(move |feed| read(feed, Tti(tti))).await?;
    value
        .map(Json)
        .ok_or_else(|| ApiError(StatusCode::NOT_FOUND, format!("TTI {tti} is not in memory")))
}

/// Serves the data of TTI `tti` of the run that `--compare` names.
async fn serve_compared_tti(served: &ApiState, tti: u64, read: ReadTti) -> ApiResult {
    let read_compared = move |feed: &Feed| feed.compared_feed().map(|other| read(other, Tti(tti)));
    let value = served.read_feed(read_compared).await?.ok_or_else(no_compared_run)?;
    value
        .map(Json)
        .ok_or_else(|| ApiError(StatusCode::NOT_FOUND, format!("TTI {tti} is not in the other run")))
}

pub(super) async fn tti(State(served): State<ApiState>, PathPart(tti): PathPart<u64>) -> ApiResult {
    serve_tti(&served, tti, Feed::tti_json).await
}

pub(super) async fn compared_tti(State(served): State<ApiState>, PathPart(tti): PathPart<u64>) -> ApiResult {
    serve_compared_tti(&served, tti, Feed::tti_json).await
}

/// Serves the sums of each device up to a TTI.
pub(super) async fn heat(State(served): State<ApiState>, PathPart(tti): PathPart<u64>) -> ApiResult {
    serve_tti(&served, tti, Feed::heat_json).await
}

pub(super) async fn compared_heat(State(served): State<ApiState>, PathPart(tti): PathPart<u64>) -> ApiResult {
    serve_compared_tti(&served, tti, Feed::heat_json).await
}

fn no_compared_run() -> ApiError {
    ApiError(
        StatusCode::NOT_FOUND,
        "the dashboard has no other run; start it with --compare".to_owned(),
    )
}

/// Serves the curves of the run that `--compare` names.
pub(super) async fn compared_curves(State(served): State<ApiState>) -> Result<Json<Vec<CurvePoint>>, ApiError> {
    let curves = served.read_feed(|feed| feed.compared_feed().map(Feed::curves)).await?;
    curves.map(Json).ok_or_else(no_compared_run)
}

pub(super) async fn compared(State(served): State<ApiState>) -> ApiResult {
    served.feed.comparison_json().map(Json).ok_or_else(no_compared_run)
}

pub(super) async fn curves(State(served): State<ApiState>) -> Result<Json<Vec<CurvePoint>>, ApiError> {
    Ok(Json(served.read_feed(Feed::curves).await?))
}

/// The filters of the message list, with the names of `inspect tail` except `limit`. `until` is included.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MessageQuery {
    plane: Option<String>,
    /// Leaves out the messages of the emulation plane.
    hide_emu: Option<bool>,
    /// Leaves out messages without news: grants of TTIs without an event, and recorded states.
    hide_quiet: Option<bool>,
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
        let unknown_value = |what: &str| ApiError(StatusCode::BAD_REQUEST, format!("no such {what}"));
        let plane = self.plane.as_deref().filter(|name| !name.is_empty());
        let plane = plane.map(|name| {
            Plane::ALL
                .into_iter()
                .find(|plane| plane.name() == name)
                .ok_or_else(|| unknown_value("plane; use air, emu or truth"))
        });
        let kind_names = self.kind.as_deref().filter(|names| !names.is_empty());
        let kinds = split_names(kind_names);
        let kind = |name| MessageKind::ALL.iter().copied().find(|kind| kind.name() == name);
        let kinds = kinds.map(|name| kind(name).ok_or_else(|| unknown_value("kind")));
        let mut kinds: Vec<MessageKind> = kinds.collect::<Result<_, _>>()?;
        // Kinds and planes that the reader names take precedence.
        if self.hide_emu == Some(true) && plane.is_none() && kinds.is_empty() {
            let all = MessageKind::ALL.iter().copied();
            kinds.extend(all.filter(|kind| kind.plane() != Plane::Emu));
        }
        let state = |name| StateName::ALL.into_iter().find(|(state_name, _)| *state_name == name);
        let states = split_names(self.state.as_deref()).map(|name| state(name).ok_or_else(|| unknown_value("state")));
        let only_device = self.device.map(DeviceId);
        let devices = match self.cluster {
            Some(number) => {
                let group = feed.group(number).ok_or_else(|| unknown_value("cluster"))?;
                Some(
                    group
                        .into_iter()
                        .filter(|id| only_device.is_none_or(|only| only == *id))
                        .collect(),
                )
            }
            None => only_device.map(|only| vec![only]),
        };
        let filter = Filter {
            plane: plane.transpose()?,
            kinds,
            devices,
            ttis: Some(self.since.unwrap_or(0)..=self.until.unwrap_or(u64::MAX)),
            states: states
                .map(|state| state.map(|(_, state)| state))
                .collect::<Result<_, _>>()?,
        };
        let (first, last) = feed.history(RunHistory::available_ttis);
        let (from, end) = (
            first.0.max(self.since.unwrap_or(0)),
            last.0.min(self.until.unwrap_or(u64::MAX)),
        );
        if !filter.states.is_empty() && end.saturating_sub(from) > MAX_HISTORY_TTIS {
            // With the labels of the page, not the names of the query.
            let why = format!("a state filter covers at most {MAX_HISTORY_TTIS} TTIs; limit it with from and to");
            return Err(ApiError(StatusCode::BAD_REQUEST, why));
        }
        filter
            .check_kinds()
            .map_err(|why| ApiError(StatusCode::BAD_REQUEST, why))?;
        Ok(filter)
    }
}

/// Whether a message has no news for a reader: a grant of TTIs without an event, or recorded states. The map shows the
/// states.
fn is_quiet(frame: &Frame) -> bool {
    let has_no_event = || matches!(frame.message(), Ok(Message::World(world)) if world.stimulus.is_none());
    frame.kind == MessageKind::States || (frame.kind == MessageKind::World && has_no_event())
}

/// The names in a comma-separated list.
fn split_names(names: Option<&str>) -> impl Iterator<Item = &str> {
    let names = names.unwrap_or_default().split(',').map(str::trim);
    names.filter(|name| !name.is_empty())
}

pub(super) async fn messages(State(served): State<ApiState>, Params(query): Params<MessageQuery>) -> ApiResult {
    let filter = query.filter(&served.feed)?;
    let limit = query.limit.unwrap_or(MAX_MESSAGES).min(MAX_MESSAGES);
    // Kinds that the reader names take precedence.
    let hides_quiet = query.hide_quiet == Some(true) && split_names(query.kind.as_deref()).next().is_none();
    let rows = served
        .read_feed(move |feed| {
            feed.history(|history| {
                let row = |(number, frame): (u64, &Frame)| {
                    let text = match frame.message() {
                        Ok(message) => message.to_string(),
                        Err(error) => format!("invalid message: {error}"),
                    };
                    json!({
                        "id": number,
                        "tti": frame.tti,
                        "plane": frame.kind.plane().name(),
                        "kind": frame.kind.name(),
                        "whose": key_owner(frame.kind, frame.number),
                        "bytes": frame.payload.len(),
                        "text": text,
                    })
                };
                let frames = history.frames(&filter);
                let shown = frames.filter(|(_, frame)| !hides_quiet || !is_quiet(frame));
                shown.take(limit).map(row).collect::<Vec<Value>>()
            })
        })
        .await?;
    Ok(Json(json!(rows)))
}

pub(super) async fn message(State(served): State<ApiState>, PathPart(number): PathPart<u64>) -> ApiResult {
    let value = served.feed.history(|history| {
        let frame = history.frame(number)?;
        let line: Value = serde_json::from_str(&FrameLine::new(frame).to_json()).ok()?;
        Some(json!({ "message": line, "hex": to_hex(&frame.payload) }))
    });
    value.map(Json).ok_or_else(|| {
        ApiError(
            StatusCode::NOT_FOUND,
            format!("message {number} is not in memory any more"),
        )
    })
}

/// The requested TTIs of a history, from `from` up to but excluding `end`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TtiRange {
    from: Option<u64>,
    end: Option<u64>,
    /// The last TTI of the requested sums, which begin with TTI 0.
    at: Option<u64>,
}

pub(super) async fn device(
    State(served): State<ApiState>,
    PathPart(device): PathPart<u32>,
    Params(span): Params<TtiRange>,
) -> ApiResult {
    let (from, end) = (span.from.unwrap_or(0), span.end.unwrap_or(u64::MAX));
    let read = move |history: &RunHistory| {
        let (first, last) = history.available_ttis();
        // A request can name any TTIs, so the length of the history is bounded.
        let (from, end) = (Tti(from).max(first).min(last), Tti(end).min(last));
        let end = end.min(from + MAX_HISTORY_TTIS);
        let totals = span.at.and_then(|at| history.totals(DeviceId(device), Tti(at)));
        (history.device_views(DeviceId(device), from, end), totals)
    };
    let (history, totals) = served.read_feed(move |feed| feed.history(read)).await?;
    if history.is_empty() {
        return Err(ApiError(
            StatusCode::NOT_FOUND,
            format!("device {device} has no history in these TTIs"),
        ));
    }
    Ok(Json(json!({
        "device": device,
        "from": history[0].0,
        "states": super::feed::state_codes(&history.iter().map(|(_, view)| *view).collect::<Vec<_>>()),
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

/// A part of the timeline: TTIs from `from` up to but excluding `end`, TTIs in a column, and a list of devices such as
/// `0-31,40`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TimelineQuery {
    from: u64,
    end: u64,
    step: Option<u64>,
    rows: String,
}

/// Serves states and batteries of many devices in the binary form of `timeline`.
pub(super) async fn timeline(
    State(served): State<ApiState>,
    Params(query): Params<TimelineQuery>,
) -> Result<impl IntoResponse, ApiError> {
    let refused = |why: String| ApiError(StatusCode::BAD_REQUEST, why);
    let devices = parse_rows(&query.rows, served.feed.devices())
        // 256 is `timeline::MAX_ROWS`.
        .ok_or_else(|| refused("rows: use at most 256 devices of the run, such as 0-31,40".to_owned()))?;
    let step = query.step.unwrap_or(1).max(1);
    let ttis = query.end.saturating_sub(query.from);
    if ttis.div_ceil(step) > MAX_COLUMNS || ttis.saturating_mul(devices.len() as u64) > MAX_DEVICE_TTIS {
        let why = format!("at most {MAX_COLUMNS} columns and {MAX_DEVICE_TTIS} states; ask for fewer TTIs or rows");
        return Err(refused(why));
    }
    let request = TimelineRequest {
        from: Tti(query.from),
        end: Tti(query.end),
        step,
        devices,
    };
    let bytes = served.read_feed(move |feed| feed.timeline(&request)).await?;
    let unavailable = || ApiError(StatusCode::NOT_FOUND, "none of these TTIs is in memory".to_owned());
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    Ok((headers, bytes.ok_or_else(unavailable)?))
}

/// Serves the ended events of some TTIs.
pub(super) async fn events(State(served): State<ApiState>, Params(span): Params<TtiRange>) -> Json<Value> {
    let (from, end) = (Tti(span.from.unwrap_or(0)), Tti(span.end.unwrap_or(u64::MAX)));
    Json(served.feed.events_json(from, end))
}

/// The TTI after or before which a misdetection is requested.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MissQuery {
    after: Option<u64>,
    before: Option<u64>,
}

pub(super) async fn miss(State(served): State<ApiState>, Params(query): Params<MissQuery>) -> ApiResult {
    match (query.after, query.before) {
        (Some(tti), None) => Ok(Json(served.feed.miss_json(Tti(tti), true))),
        (None, Some(tti)) => Ok(Json(served.feed.miss_json(Tti(tti), false))),
        _ => Err(ApiError(
            StatusCode::BAD_REQUEST,
            "use after=TTI or before=TTI".to_owned(),
        )),
    }
}
