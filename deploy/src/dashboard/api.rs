//! What the page asks for.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::body::Body;
use axum::extract::{Path, Query, Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use reveille_common::bus::Bus;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ClockCommand, MessageKind, Pace, Plane};
use reveille_view::filter::{Filter, Named};
use reveille_view::line::{Line, hex, whose};
use reveille_view::story::Story;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::{Semaphore, watch};

use super::feed::Feed;
use crate::web::is_meant;

/// The header that holds the token.
const TOKEN: &str = "x-reveille-token";
/// Time between two updates of the page.
const BEAT: Duration = Duration::from_millis(40);
/// The most messages that are listed at a time.
const MOST: usize = 1_000;
/// The longest history of a device, and the most TTIs that are searched for states, TTIs.
const LONGEST: u64 = 5_000;
/// How many may look through the run at the same time.
const READERS: usize = 2;
/// How long the clock may take to answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// What answers need.
#[derive(Clone)]
pub(super) struct Served {
    feed: Arc<Feed>,
    bus: Option<Bus>,
    token: Arc<str>,
    at: SocketAddr,
    /// Where the run is, told to all at the same time.
    now: Arc<watch::Sender<Arc<str>>>,
    /// How many may look through the run at the same time.
    readers: Arc<Semaphore>,
}

impl Served {
    /// For what listens at `at`. To be called within a runtime.
    pub(super) fn new(feed: Arc<Feed>, bus: Option<Bus>, token: String, at: SocketAddr) -> Self {
        let now = Arc::new(watch::Sender::new(Arc::from("{}")));
        let (own, send) = (Arc::clone(&feed), Arc::clone(&now));
        tokio::spawn(async move {
            loop {
                let rung = tokio::time::timeout(Duration::from_secs(1), own.bell.notified()).await;
                if rung.is_ok() {
                    tokio::time::sleep(BEAT).await;
                }
                // Nobody looks: nothing has to be worked out.
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

    /// Does `look` on a thread that nobody else waits for; few at a time, so that the run's own is not kept waiting.
    async fn aside<T: Send + 'static>(&self, look: impl FnOnce(&Feed) -> T + Send + 'static) -> Result<T, Refusal> {
        let busy = || {
            Refusal(
                StatusCode::SERVICE_UNAVAILABLE,
                "the dashboard is being ended".to_owned(),
            )
        };
        let permit = Arc::clone(&self.readers).acquire_owned().await.map_err(|_| busy())?;
        let feed = Arc::clone(&self.feed);
        let looked = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            look(&feed)
        });
        looked.await.map_err(|_| busy())
    }
}

/// An answer, or why there is none.
type Answer = Result<Json<Value>, Refusal>;

/// Why there is no answer.
pub(super) struct Refusal(StatusCode, String);

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        (self.0, Json(json!({ "error": self.1 }))).into_response()
    }
}

/// Lets in who may come in.
pub(super) async fn guard(State(served): State<Served>, request: Request, next: Next) -> Response {
    match refused(&served, &request) {
        Some(refusal) => refusal.into_response(),
        None => next.run(request).await,
    }
}

/// Why a request is refused: under another name of this machine, from a page of another site, and without the token
/// unless it only looks, from this machine.
fn refused(served: &Served, request: &Request) -> Option<Refusal> {
    let get = |name: &str| request.headers().get(name).and_then(|value| value.to_str().ok());
    let host = get(header::HOST.as_str());
    if !is_meant(host, served.at) {
        let why = "this is served under its address alone".to_owned();
        return Some(Refusal(StatusCode::MISDIRECTED_REQUEST, why));
    }
    let own = host.map(|host| format!("http://{host}"));
    if get(header::ORIGIN.as_str()).is_some_and(|origin| Some(origin) != own.as_deref()) {
        return Some(Refusal(
            StatusCode::FORBIDDEN,
            "this comes from another site".to_owned(),
        ));
    }
    if get("sec-fetch-site") == Some("cross-site") && request.uri().path().starts_with("/api/") {
        return Some(Refusal(
            StatusCode::FORBIDDEN,
            "a page of another site asks for this".to_owned(),
        ));
    }
    let is_reading = request.method() == Method::GET;
    let is_page = !request.uri().path().starts_with("/api/");
    let is_free = is_reading && (is_page || served.at.ip().is_loopback());
    let has_token = get(TOKEN).is_some_and(|token| is_same(token, &served.token));
    let why = || "the token is missing: open the address that the program has printed".to_owned();
    (!is_free && !has_token).then(|| Refusal(StatusCode::UNAUTHORIZED, why()))
}

/// Whether two texts are the same, in a time that does not tell where they differ.
fn is_same(a: &str, b: &str) -> bool {
    let differs = a.bytes().zip(b.bytes()).fold(0, |differs, (a, b)| differs | (a ^ b));
    a.len() == b.len() && differs == 0
}

pub(super) async fn about(State(served): State<Served>) -> Json<Value> {
    let mut about = served.feed.about().clone();
    about["controls"] = json!(served.bus.is_some());
    Json(about)
}

pub(super) async fn now(State(served): State<Served>) -> Json<Value> {
    Json(served.feed.now())
}

/// Server-sent events: where the run is, whenever that has changed. Who reads slowly skips some.
pub(super) async fn live(State(served): State<Served>) -> Response {
    let first = Some(served.feed.now().to_string());
    let events = futures::stream::unfold((served.now.subscribe(), first), |(mut now, first)| async move {
        let told = if let Some(first) = first {
            first
        } else {
            now.changed().await.ok()?;
            now.borrow_and_update().to_string()
        };
        Some((Ok::<_, Infallible>(format!("data: {told}\n\n")), (now, None)))
    });
    let headers = [
        (header::CONTENT_TYPE, "text/event-stream"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (headers, Body::from_stream(events)).into_response()
}

pub(super) async fn tti(State(served): State<Served>, Path(tti): Path<u64>) -> Answer {
    let found = served.aside(move |feed| feed.at(Tti(tti))).await?;
    found
        .map(Json)
        .ok_or_else(|| Refusal(StatusCode::NOT_FOUND, format!("TTI {tti} is not kept")))
}

fn alone() -> Refusal {
    Refusal(StatusCode::NOT_FOUND, "there is no run to compare with".to_owned())
}

pub(super) async fn other_tti(State(served): State<Served>, Path(tti): Path<u64>) -> Answer {
    let found = served
        .aside(move |feed| feed.other().map(|other| other.at(Tti(tti))))
        .await?;
    found
        .ok_or_else(alone)?
        .map(Json)
        .ok_or_else(|| Refusal(StatusCode::NOT_FOUND, format!("the other run has no TTI {tti}")))
}

pub(super) async fn other_curves(State(served): State<Served>) -> Answer {
    served.feed.other().map(|other| Json(other.curves())).ok_or_else(alone)
}

pub(super) async fn compared(State(served): State<Served>) -> Answer {
    served.feed.compared().map(Json).ok_or_else(alone)
}

pub(super) async fn curves(State(served): State<Served>) -> Json<Value> {
    Json(served.feed.curves())
}

/// The filters of the list of messages, as those of `inspect tail`.
#[derive(Deserialize)]
pub(super) struct Wanted {
    plane: Option<String>,
    kind: Option<String>,
    device: Option<u32>,
    cluster: Option<u32>,
    state: Option<String>,
    since: Option<u64>,
    until: Option<u64>,
    limit: Option<usize>,
}

impl Wanted {
    fn filter(&self, feed: &Feed) -> Result<Filter, Refusal> {
        let refuse = |what: &str| Refusal(StatusCode::BAD_REQUEST, format!("there is no {what}"));
        let plane = self.plane.as_deref().filter(|name| !name.is_empty());
        let plane = plane.map(|name| {
            Plane::ALL
                .into_iter()
                .find(|plane| plane.name() == name)
                .ok_or_else(|| refuse("such plane"))
        });
        let kinds = listed(self.kind.as_deref());
        let kind = |name| MessageKind::ALL.iter().copied().find(|kind| kind.name() == name);
        let kinds = kinds.map(|name| kind(name).ok_or_else(|| refuse("such kind")));
        let state = |name| Named::ALL.into_iter().find(|(own, _)| *own == name);
        let states = listed(self.state.as_deref()).map(|name| state(name).ok_or_else(|| refuse("such state")));
        let own = self.device.map(DeviceId);
        let devices = match self.cluster {
            Some(number) => {
                let group = feed.group(number).ok_or_else(|| refuse("such cluster"))?;
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
        let (first, last) = feed.story(Story::span);
        let (from, end) = (
            first.0.max(self.since.unwrap_or(0)),
            last.0.min(self.until.unwrap_or(u64::MAX)),
        );
        if !filter.states.is_empty() && end.saturating_sub(from) > LONGEST {
            let why = format!("states are looked for in at most {LONGEST} TTIs: say from which TTI to which");
            return Err(Refusal(StatusCode::BAD_REQUEST, why));
        }
        filter.check().map_err(|why| Refusal(StatusCode::BAD_REQUEST, why))?;
        Ok(filter)
    }
}

/// The names in a list with commas.
fn listed(names: Option<&str>) -> impl Iterator<Item = &str> {
    let names = names.unwrap_or_default().split(',').map(str::trim);
    names.filter(|name| !name.is_empty())
}

pub(super) async fn messages(State(served): State<Served>, Query(wanted): Query<Wanted>) -> Answer {
    let filter = wanted.filter(&served.feed)?;
    let most = wanted.limit.unwrap_or(MOST).min(MOST);
    let rows = served
        .aside(move |feed| {
            feed.story(|story| {
                let row = |(number, frame): (u64, &reveille_common::message::Frame)| {
                    let text = match frame.message() {
                        Ok(message) => message.to_string(),
                        Err(error) => format!("not a message: {error}"),
                    };
                    json!({
                        "id": number,
                        "tti": frame.tti,
                        "plane": frame.kind.plane().name(),
                        "kind": frame.kind.name(),
                        "whose": whose(frame.kind, frame.number),
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

pub(super) async fn message(State(served): State<Served>, Path(number): Path<u64>) -> Answer {
    let found = served.feed.story(|story| {
        let frame = story.frame(number)?;
        let line: Value = serde_json::from_str(&Line::of(frame).to_json()).ok()?;
        Some(json!({ "message": line, "hex": hex(&frame.payload) }))
    });
    found
        .map(Json)
        .ok_or_else(|| Refusal(StatusCode::NOT_FOUND, format!("message {number} is not kept")))
}

/// The TTIs of a history.
#[derive(Deserialize)]
pub(super) struct Span {
    from: Option<u64>,
    end: Option<u64>,
    /// The TTI up to which sums are told.
    at: Option<u64>,
}

pub(super) async fn device(State(served): State<Served>, Path(device): Path<u32>, Query(span): Query<Span>) -> Answer {
    let (from, end) = (span.from.unwrap_or(0), span.end.unwrap_or(u64::MAX));
    let look = move |story: &Story| {
        let (first, last) = story.span();
        let (from, end) = (Tti(from).max(first).min(last), Tti(end).min(last));
        let end = end.min(from + LONGEST);
        let totals = span.at.and_then(|at| story.totals(DeviceId(device), Tti(at)));
        (story.history(DeviceId(device), from, end), totals)
    };
    let (history, totals) = served.aside(move |feed| feed.story(look)).await?;
    if history.is_empty() {
        return Err(Refusal(
            StatusCode::NOT_FOUND,
            format!("there is nothing of device {device} then"),
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
            "dark_ttis": totals.dark_ttis,
        })),
    })))
}

pub(super) async fn clock(State(served): State<Served>) -> Answer {
    ask(&served, ClockCommand::Status).await
}

/// A number for a command.
#[derive(Deserialize)]
pub(super) struct Count {
    n: Option<u64>,
}

pub(super) async fn command(
    State(served): State<Served>,
    Path(command): Path<String>,
    Query(count): Query<Count>,
) -> Answer {
    let command = match (command.as_str(), count.n) {
        ("pause", _) => ClockCommand::Pause,
        ("resume", _) => ClockCommand::Resume,
        ("step", n) => ClockCommand::Step(n.unwrap_or(1).max(1)),
        ("run-to", Some(n)) => ClockCommand::RunTo(Tti(n)),
        ("pace", Some(0)) => ClockCommand::Pace(Pace::Max),
        ("pace", Some(n)) => ClockCommand::Pace(Pace::RealTime(n)),
        _ => {
            let why =
                "the clock knows pause, resume, step?n=1, run-to?n=4000, and pace?n=5000 for 5000 µs a TTI, 0 for none";
            let why = why.to_owned();
            return Err(Refusal(StatusCode::BAD_REQUEST, why));
        }
    };
    ask(&served, command).await
}

async fn ask(served: &Served, command: ClockCommand) -> Answer {
    let Some(bus) = &served.bus else {
        return Err(Refusal(StatusCode::CONFLICT, "a recording has no clock".to_owned()));
    };
    match bus.ask(&command, PATIENCE).await {
        Ok(Some(status)) if matches!(command, ClockCommand::RunTo(k) if k < status.tti || k.0 > status.ttis) => {
            let (next, ttis) = (status.tti, status.ttis);
            let why = format!("the next TTI is {next}, and the run ends before TTI {ttis}: say one between");
            Err(Refusal(StatusCode::BAD_REQUEST, why))
        }
        Ok(Some(status)) => Ok(Json(json!({ "status": status, "text": status.to_string() }))),
        Ok(None) => Err(Refusal(StatusCode::GONE, "the run has ended".to_owned())),
        Err(error) => Err(Refusal(StatusCode::BAD_GATEWAY, error.to_string())),
    }
}
