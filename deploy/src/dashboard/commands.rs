//! Commands of the dashboard page to the run: its clock, and actions on devices. Every request has passed
//! [`check_request`](super::api::check_request). `page/clock.js` and `page/device_actions.js` send them. The base
//! station refuses them unless the bus of [`ApiState`] has the run's key.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use reveille_common::bus::BusError;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{ActRequest, Change, ClockCommand, DeviceRange, Pace, Query as BusQuery};
use reveille_common::units::Energy;
use serde::Deserialize;
use serde_json::json;

use super::api::ApiState;
use super::http::{ApiError, ApiResult, Params, PathPart};

/// Longest wait for an answer of the base station.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

pub(super) async fn clock(State(served): State<ApiState>) -> ApiResult {
    command_clock(&served, ClockCommand::Status).await
}

/// The number of a command: TTIs for `step`, a TTI for `run-to`, µs per TTI for `pace`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CountParam {
    n: Option<u64>,
}

/// Sends a command to the clock. The page and `tests/program/dashboard.rs` use the names.
pub(super) async fn command(
    State(served): State<ApiState>,
    PathPart(command): PathPart<String>,
    Params(count): Params<CountParam>,
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
    command_clock(&served, command).await
}

/// The device of an action, and the energy for it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ActQuery {
    device: u32,
    units: Option<f64>,
}

/// Fails or revives a device, or adds energy to it, in the first TTI that is not granted yet.
pub(super) async fn act(
    State(served): State<ApiState>,
    PathPart(action): PathPart<String>,
    Params(query): Params<ActQuery>,
) -> ApiResult {
    let device = DeviceRange {
        first: DeviceId(query.device),
        count: 1,
    };
    let change = match (action.as_str(), query.units.and_then(Energy::from_units)) {
        ("fail", _) => Change::Fail(device),
        ("revive", _) => Change::Revive(device),
        ("energy", Some(energy)) => Change::AddEnergy(device, energy),
        _ => {
            let why = "unknown action, or no units; use fail?device=7, revive?device=7 or energy?device=7&units=2.5";
            return Err(ApiError(StatusCode::BAD_REQUEST, why.to_owned()));
        }
    };
    let request = ActRequest {
        at: None,
        changes: vec![change],
    };
    match query_bus(&served, &request).await? {
        Some(tti) => Ok(Json(json!({ "tti": tti, "text": change.to_string() }))),
        None => Err(ApiError(StatusCode::GONE, "the run has ended".to_owned())),
    }
}

/// Sends a query to the base station; `None` without an answer, which means that the run has ended.
async fn query_bus<Q: BusQuery<Address = ()>>(served: &ApiState, query: &Q) -> Result<Option<Q::Reply>, ApiError> {
    let Some(bus) = &served.bus else {
        return Err(ApiError(
            StatusCode::CONFLICT,
            "a recording has no clock to control".to_owned(),
        ));
    };
    let reply = bus.query(query, ANSWER_TIMEOUT).await;
    reply.map_err(|error| {
        let is_refused = matches!(error, BusError::Refused(_));
        let status = if is_refused {
            StatusCode::BAD_REQUEST
        } else {
            StatusCode::BAD_GATEWAY
        };
        ApiError(status, error.to_string())
    })
}

async fn command_clock(served: &ApiState, command: ClockCommand) -> ApiResult {
    match query_bus(served, &command).await? {
        // The clock ignores such a command; its status alone does not show that.
        Some(status) if matches!(command, ClockCommand::RunTo(k) if k < status.tti || k.0 > status.ttis) => {
            let (next, ttis) = (status.tti, status.ttis);
            let why = format!("run-to: must be from {next}, the next TTI, to {ttis}, the end of the run");
            Err(ApiError(StatusCode::BAD_REQUEST, why))
        }
        Some(status) => Ok(Json(json!({ "status": status, "text": status.to_string() }))),
        None => Err(ApiError(StatusCode::GONE, "the run has ended".to_owned())),
    }
}
