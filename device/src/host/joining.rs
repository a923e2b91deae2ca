//! How a host comes to its devices, and to others when it has room.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::{Bus, BusError, draw_nonce};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{Assignment, JoinReply, JoinRequest, Ready};
use reveille_common::secret::Secret;

use super::ear::{Ear, FEW};
use super::{HostError, Left, Shared};

/// The pause between two looks for a place, while there is none.
const STANDING_BY: Duration = Duration::from_millis(250);

/// What a host process offers.
#[derive(Clone, Debug)]
pub struct Offer {
    /// How many devices it would carry, at the most.
    pub count: u32,
    /// What it calls itself, for messages to people.
    pub name: String,
    /// The run's key, where only those may join who have it.
    pub key: Option<Secret>,
    /// How long it tries to join, and waits for a BS that is lost.
    pub patience: Duration,
    /// Whether it also takes up devices of hosts that are lost, as far as it has room.
    pub stands_by: bool,
    /// Whether another thread does what a host hears even where the one that delivers it could.
    pub hands_over: bool,
}

/// What a host process tells whoever started it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// It carries these devices, first and last, as this host.
    Joined(HostId, DeviceId, DeviceId),
    /// All devices are carried by others; it waits for some that are lost.
    StandsBy,
}

/// What carrying devices comes to.
type Carried<'a> = Pin<Box<dyn Future<Output = Result<(), HostError>> + Send + 'a>>;

/// Joins the run of `bus`, carries devices to the end of the run, and leaves. `say` is told what happens.
///
/// # Errors
/// If there is no such run within the offer's patience, the BS refuses, or it is lost on the way.
pub fn carry<'a>(bus: &'a Bus, offer: Offer, say: &'a (dyn Fn(News) + Sync)) -> Carried<'a> {
    Box::pin(async move {
        loop {
            let Some(assignment) = join(bus, &offer, say).await? else {
                return Ok(());
            };
            let room = offer.count.saturating_sub(assignment.devices.len() as u32);
            let own = tend(bus, assignment, &offer, say);
            let left = if room > 0 && offer.stands_by {
                let count = room;
                let hands_over = offer.hands_over || offer.count > FEW;
                let others = Offer {
                    count,
                    hands_over,
                    ..offer.clone()
                };
                let others = carry(bus, others, &|_| {});
                beside(own, others).await?
            } else {
                own.await?
            };
            match left {
                Left::Dismissed => return Ok(()),
                Left::Replaced => tracing::warn!("others carry the devices of this process now; asking for a place"),
            }
        }
    })
}

/// What `own` comes to; what `others` come to, devices of lost hosts, counts only if it is a failure.
async fn beside(own: impl Future<Output = Result<Left, HostError>>, others: Carried<'_>) -> Result<Left, HostError> {
    tokio::pin!(own);
    tokio::select! {
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

/// Asks for places until there are some; `None` if the run ended before.
async fn join(bus: &Bus, offer: &Offer, say: &(dyn Fn(News) + Sync)) -> Result<Option<Assignment>, HostError> {
    let request = JoinRequest {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        count: offer.count,
        nonce: draw_nonce()?,
        name: offer.name.clone(),
    };
    let mut stands_by = false;
    loop {
        match bus.ask_until(&request, offer.key, offer.patience).await {
            Ok(Some(JoinReply::Welcome(assignment))) => {
                assignment.check().map_err(HostError::Assignment)?;
                return Ok(Some(*assignment));
            }
            Ok(Some(JoinReply::Later(why))) if offer.stands_by => {
                if !stands_by {
                    tracing::info!("{why}");
                    say(News::StandsBy);
                }
                stands_by = true;
                tokio::time::sleep(STANDING_BY).await;
            }
            Ok(Some(JoinReply::Later(why) | JoinReply::Refused(why))) | Err(BusError::Refused(why)) => {
                return Err(HostError::Refused(why));
            }
            Ok(None) if stands_by => return Ok(None),
            Ok(None) => return Err(bus.no_run().await.into()),
            Err(error) => return Err(error.into()),
        }
    }
}

/// Carries the devices of `assignment` until there is nothing more to do for them.
async fn tend(
    bus: &Bus,
    assignment: Assignment,
    offer: &Offer,
    say: &(dyn Fn(News) + Sync),
) -> Result<Left, HostError> {
    let patience = offer.patience;
    let pass = assignment.membership.pass;
    let host = pass.host;
    let (first, count) = (assignment.devices[0].id, assignment.devices.len() as u32);
    let last = DeviceId(first.0 + count - 1);
    tracing::info!(%host, %first, %last, "joined");
    say(News::Joined(host, first, last));
    let bus = bus.with_secret(assignment.membership.secret);
    let shared = Arc::new(Shared::new(&bus, assignment)?);
    let this = Arc::clone(&shared);
    // All that the process may carry goes through the same queue.
    let ear = Ear::new(offer.count.max(count), offer.hands_over, move |heard| this.hear(heard));
    let _declared = shared.declare(&bus, ear)?;
    match bus.ask_until(&Ready { host }, Some(pass.token), patience).await? {
        Some(true) => shared.stay(&bus, patience).await,
        Some(false) => Ok(Left::Replaced),
        None => Err(bus.no_run().await.into()),
    }
}
