//! Joins a host to a run, and again for lost devices if it has spare capacity. [`run_host`] is the entry point of a
//! host process (`deploy/src/commands/device.rs`), and of `up` without one; `host/mod.rs` runs the assignment.
//! `bs/src/server/join.rs` answers join requests, and `subscriptions.rs` there the query [`Ready`], with which a host
//! with all its subscriptions begins.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, draw_nonce};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{HostOffer, HostSetup, JoinReply, JoinRequest, Ready};
use reveille_common::secret::Secret;

use super::dispatch::{Dispatcher, MAX_INLINE_DEVICES};
use super::{HostError, HostExit, HostShared};

/// The pause between two join requests while the host waits for an assignment.
const RETRY_PAUSE: Duration = Duration::from_millis(250);

/// The settings of a host process.
#[derive(Clone, Debug)]
pub struct HostConfig {
    /// The devices that the process offers to run. The number in `AtMost` includes lost devices.
    pub offer: HostOffer,
    /// The host's name in messages to the operator.
    pub name: String,
    /// The run's key, for runs that only admit hosts with the key.
    pub key: Option<Secret>,
    /// The time limit for joining the run, and for waiting for a lost base station.
    pub patience: Duration,
    /// Whether the host also takes over devices of lost hosts, up to its spare capacity, and waits for them if all
    /// devices have a host.
    pub stands_by: bool,
    /// Whether a separate thread processes the host's messages, even if the delivering thread could do it (`dispatch`).
    pub forces_worker: bool,
}

/// An event that a host process reports to its caller. A takeover of lost devices reports none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostEvent {
    /// The host has joined.
    Joined {
        /// The host's id.
        host: HostId,
        /// The first device of its assignment.
        first: DeviceId,
        /// The last device of its assignment.
        last: DeviceId,
    },
    /// All devices are assigned to other hosts; the host waits for lost ones.
    StandsBy,
}

/// The future of [`run_host`], boxed because the function is recursive.
type HostFuture<'a> = Pin<Box<dyn Future<Output = Result<(), HostError>> + Send + 'a>>;

/// Joins the run of `bus`, runs devices to the end of the run, and leaves. `on_event` receives the events on the way.
/// After the loss of its devices to another host, it requests others. Its future needs a tokio runtime.
///
/// # Errors
/// If the run is not found within the patience of `config`, the base station refuses, sends an invalid assignment or is
/// lost, the run or the bus fails, or a device task panics.
pub fn run_host<'a>(bus: &'a Bus, config: HostConfig, on_event: &'a (dyn Fn(HostEvent) + Sync)) -> HostFuture<'a> {
    Box::pin(async move {
        loop {
            let Some(assignment) = request_assignment(bus, &config, on_event).await? else {
                return Ok(());
            };
            let max_devices = config.offer.max_devices();
            let spare_devices = max_devices.saturating_sub(assignment.devices.len() as u32);
            let own_assignment = run_assignment(bus, assignment, &config, on_event);
            let exit = if spare_devices > 0 && config.stands_by {
                // Devices taken over later share this process's link. The total capacity therefore decides, not the
                // remaining capacity.
                let forces_worker = config.forces_worker || max_devices > MAX_INLINE_DEVICES;
                let takeover_config = HostConfig {
                    offer: match config.offer {
                        HostOffer::AtMost(_) => HostOffer::AtMost(spare_devices),
                        HostOffer::Share | HostOffer::Lost | HostOffer::Nothing | HostOffer::Exactly(_) => {
                            HostOffer::Lost
                        }
                    },
                    forces_worker,
                    ..config.clone()
                };
                let takeovers = run_host(bus, takeover_config, &|_| {});
                run_with_takeovers(own_assignment, takeovers).await?
            } else {
                own_assignment.await?
            };
            match exit {
                HostExit::Dismissed => return Ok(()),
                HostExit::Replaced => {
                    tracing::warn!(
                        "this process lost its devices, to other processes or in a resumed run; requesting others"
                    );
                }
            }
        }
    })
}

/// Returns the result of `own_assignment`. `takeovers`, which runs devices of lost hosts, only logs its failures.
async fn run_with_takeovers(
    own_assignment: impl Future<Output = Result<HostExit, HostError>>,
    takeovers: HostFuture<'_>,
) -> Result<HostExit, HostError> {
    tokio::pin!(own_assignment);
    tokio::select! {
        // `own_assignment` is polled first: if both have ended, its outcome counts.
        biased;
        exit = &mut own_assignment => exit,
        result = takeovers => {
            if let Err(error) = result {
                tracing::debug!(%error, "no more devices for this process");
            }
            own_assignment.await
        }
    }
}

/// Asks for an assignment until it gets one, which is valid. Returns `None` if the run ends first.
async fn request_assignment(
    bus: &Bus,
    config: &HostConfig,
    on_event: &(dyn Fn(HostEvent) + Sync),
) -> Result<Option<HostSetup>, HostError> {
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        offer: config.offer,
        nonce: draw_nonce()?,
        name: config.name.clone(),
    };
    let mut is_standing_by = false;
    loop {
        match bus.query_until(&request, config.key, config.patience).await {
            Ok(Some(JoinReply::Welcome(assignment))) => {
                assignment.validate().map_err(HostError::Assignment)?;
                return Ok(Some(*assignment));
            }
            Ok(Some(JoinReply::AwaitShare)) => tokio::time::sleep(RETRY_PAUSE).await,
            Ok(Some(JoinReply::Retry(reason))) if config.stands_by => {
                if !is_standing_by {
                    tracing::info!("{reason}");
                    on_event(HostEvent::StandsBy);
                }
                is_standing_by = true;
                tokio::time::sleep(RETRY_PAUSE).await;
            }
            Ok(Some(JoinReply::Retry(reason) | JoinReply::Refused(reason))) | Err(BusError::Refused(reason)) => {
                return Err(HostError::Refused(reason));
            }
            Ok(Some(JoinReply::Routes(_))) => {
                return Err(HostError::Assignment("it is for a router".to_owned()));
            }
            // The base station has answered before, so its run is over.
            Ok(None) if is_standing_by => return Ok(None),
            Ok(None) => return Err(bus.no_run_error().await.into()),
            Err(error) => return Err(error.into()),
        }
    }
}

/// Runs the devices of `assignment` until the run ends or they belong to another host.
async fn run_assignment(
    bus: &Bus,
    assignment: HostSetup,
    config: &HostConfig,
    on_event: &(dyn Fn(HostEvent) + Sync),
) -> Result<HostExit, HostError> {
    let patience = config.patience;
    let credential = assignment.credentials.credential;
    let host = credential.host;
    // `HostSetup::validate` has refused an empty list and ids with gaps.
    let (first, count) = (assignment.devices[0].id, assignment.devices.len() as u32);
    let last = DeviceId(first.0 + count - 1);
    tracing::info!(%host, %first, %last, "joined");
    on_event(HostEvent::Joined { host, first, last });
    let bus = bus.with_secret(assignment.credentials.secret);
    let shared = Arc::new(HostShared::new(&bus, assignment)?);
    let message_handler = Arc::clone(&shared);
    // The link's queue has to hold the traffic of all devices that the process may run, not only of these.
    let max_devices = config.offer.max_devices().max(count);
    let dispatcher = Dispatcher::new(max_devices, config.forces_worker, move |message| {
        message_handler.dispatch(message);
    });
    let _declared = shared.declare(&bus, dispatcher)?;
    match bus
        .query_until(&Ready { host }, Some(credential.token), patience)
        .await?
    {
        Some(true) => shared.wait_for_exit(&bus, patience).await,
        Some(false) => Ok(HostExit::Replaced),
        None => Err(bus.no_run_error().await.into()),
    }
}
