//! Joins a host to a run, and again for lost devices if it has spare capacity.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, draw_nonce};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{HostSetup, JoinReply, JoinRequest, Ready};
use reveille_common::secret::Secret;

use super::dispatch::{Dispatcher, FEW};
use super::{HostError, HostExit, Shared};

/// The pause between two join requests while no assignment is free.
const STANDING_BY: Duration = Duration::from_millis(250);

/// The settings of a host process.
#[derive(Clone, Debug)]
pub struct HostConfig {
    /// The largest number of devices that the host runs.
    pub count: u32,
    /// The host's name in messages to the operator.
    pub name: String,
    /// The run's key, for runs that only admit hosts with the key.
    pub key: Option<Secret>,
    /// The time limit for joining the run, and for waiting for a lost base station.
    pub patience: Duration,
    /// Whether the host also takes over devices of lost hosts, up to its spare capacity.
    pub stands_by: bool,
    /// Whether a separate thread processes the host's messages, even if the delivering thread could do it.
    pub hands_over: bool,
}

/// An event that a host process reports to its caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostEvent {
    /// The host has joined with this id; its assignment runs from the first device to the last one.
    Joined(HostId, DeviceId, DeviceId),
    /// All devices are assigned to other hosts; the host waits for lost ones.
    StandsBy,
}

/// The future of [`run_host`], boxed because the function is recursive.
type HostFuture<'a> = Pin<Box<dyn Future<Output = Result<(), HostError>> + Send + 'a>>;

/// Joins the run of `bus`, runs devices to the end of the run, and leaves. `say` receives the events on the way.
///
/// # Errors
/// If the run is not found within the patience of `offer`, or the base station refuses or is lost.
pub fn run_host<'a>(bus: &'a Bus, offer: HostConfig, say: &'a (dyn Fn(HostEvent) + Sync)) -> HostFuture<'a> {
    Box::pin(async move {
        loop {
            let Some(assignment) = join(bus, &offer, say).await? else {
                return Ok(());
            };
            let room = offer.count.saturating_sub(assignment.devices.len() as u32);
            let own = tend(bus, assignment, &offer, say);
            let left = if room > 0 && offer.stands_by {
                let count = room;
                // Devices taken over later share this process's link. The whole offer therefore decides, not the
                // remaining capacity.
                let hands_over = offer.hands_over || offer.count > FEW;
                let others = HostConfig {
                    count,
                    hands_over,
                    ..offer.clone()
                };
                let others = run_host(bus, others, &|_| {});
                run_with_takeovers(own, others).await?
            } else {
                own.await?
            };
            match left {
                HostExit::Dismissed => return Ok(()),
                HostExit::Replaced => {
                    tracing::warn!(
                        "other processes run the devices of this process now; requesting another assignment"
                    );
                }
            }
        }
    })
}

/// Returns the result of `own`. `others`, which takes over devices of lost hosts, only logs its failures.
async fn run_with_takeovers(
    own: impl Future<Output = Result<HostExit, HostError>>,
    others: HostFuture<'_>,
) -> Result<HostExit, HostError> {
    tokio::pin!(own);
    tokio::select! {
        // `own` is polled first: if both have ended, its outcome counts.
        biased;
        left = &mut own => left,
        ended = others => {
            if let Err(error) = ended {
                tracing::debug!(%error, "no more devices for this process");
            }
            own.await
        }
    }
}

/// Asks for an assignment until it gets one. Returns `None` if the run ends first.
async fn join(bus: &Bus, offer: &HostConfig, say: &(dyn Fn(HostEvent) + Sync)) -> Result<Option<HostSetup>, HostError> {
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        count: offer.count,
        nonce: draw_nonce()?,
        name: offer.name.clone(),
    };
    let mut stands_by = false;
    loop {
        match bus.query_until(&request, offer.key, offer.patience).await {
            Ok(Some(JoinReply::Welcome(assignment))) => {
                assignment.validate().map_err(HostError::Assignment)?;
                return Ok(Some(*assignment));
            }
            Ok(Some(JoinReply::Retry(why))) if offer.stands_by => {
                if !stands_by {
                    tracing::info!("{why}");
                    say(HostEvent::StandsBy);
                }
                stands_by = true;
                tokio::time::sleep(STANDING_BY).await;
            }
            Ok(Some(JoinReply::Retry(why) | JoinReply::Refused(why))) | Err(BusError::Refused(why)) => {
                return Err(HostError::Refused(why));
            }
            // The base station has answered before, so its run is over.
            Ok(None) if stands_by => return Ok(None),
            Ok(None) => return Err(bus.no_run_error().await.into()),
            Err(error) => return Err(error.into()),
        }
    }
}

/// Runs the devices of `assignment` until the run ends or they belong to another host.
async fn tend(
    bus: &Bus,
    assignment: HostSetup,
    offer: &HostConfig,
    say: &(dyn Fn(HostEvent) + Sync),
) -> Result<HostExit, HostError> {
    let patience = offer.patience;
    let pass = assignment.membership.pass;
    let host = pass.host;
    // `HostSetup::validate` has refused an empty list.
    let (first, count) = (assignment.devices[0].id, assignment.devices.len() as u32);
    let last = DeviceId(first.0 + count - 1);
    tracing::info!(%host, %first, %last, "joined");
    say(HostEvent::Joined(host, first, last));
    let bus = bus.with_secret(assignment.membership.secret);
    let shared = Arc::new(Shared::new(&bus, assignment)?);
    let this = Arc::clone(&shared);
    // The link's queue has to hold the traffic of all devices that the process may run, not only of these.
    let ear = Dispatcher::new(offer.count.max(count), offer.hands_over, move |heard| {
        this.dispatch(heard);
    });
    let _declared = shared.declare(&bus, ear)?;
    match bus.query_until(&Ready { host }, Some(pass.token), patience).await? {
        Some(true) => shared.stay(&bus, patience).await,
        Some(false) => Ok(HostExit::Replaced),
        None => Err(bus.no_run_error().await.into()),
    }
}
