//! The tokio shell of the base station: it lets hosts join, plays the virtual clock over the bus, and notices who is
//! lost.

pub mod admission;
pub mod barrier;
pub mod clock;
mod drive;
mod error;
mod joining;
pub mod roster;
mod running;
mod shared;
mod told;

use std::sync::Arc;

use reveille_common::bus::Bus;
use reveille_common::message::Clock;

pub use self::drive::{OnLoss, Progress, Served, Settings};
pub use self::error::BsError;

use self::shared::Shared;
use self::told::Told;
use crate::observe::Observer;
use crate::prepared::Prepared;

/// Runs what is `prepared` over `bus`: waits for hosts to carry all devices, plays every TTI, collects the ledgers.
///
/// # Errors
/// If the bus fails, too few devices join, or a host is lost.
pub async fn serve(
    bus: &Bus,
    prepared: &Prepared,
    settings: &Settings,
    progress: &Arc<Progress>,
    observer: &mut impl Observer,
) -> Result<Served, BsError> {
    let Prepared {
        scenario, deployment, ..
    } = prepared;
    let shared = Shared::new(scenario, deployment, settings.pace, settings.paused);
    let _declared = joining::declare(bus, scenario, deployment, &shared)?;
    #[expect(clippy::disallowed_methods, reason = "the shell reports how long things took")]
    let started = std::time::Instant::now();
    joining::wait_for_all(&shared, scenario, settings, progress).await?;
    let joining = started.elapsed();
    let mut observers = (observer, Told::new(bus, settings.states_every));
    running::run(bus, prepared, settings, progress, &mut observers, &shared, joining).await
}

/// Tells all hosts that the run is over and its results are written, or that it has failed and why: they leave.
///
/// # Errors
/// If the bus fails.
pub fn dismiss(bus: &Bus, failure: Option<String>) -> Result<(), BsError> {
    let message = failure.map_or(Clock::Dismiss, Clock::Fail);
    bus.publisher::<Clock>(())?.put(&message)?;
    Ok(())
}
