//! A run over the bus, from the first host that joins to the word that sends all of them home.

use std::sync::Arc;

use reveille_common::bus::Bus;
use reveille_common::ids::Tti;
use reveille_common::message::Clock;

use super::drive::{Decisions, Progress, Served, Settings};
use super::error::BsError;
use super::losses::Replay;
use super::port::Port;
use super::running::Crew;
use super::shared::Shared;
use super::told::Told;
use super::{joining, running, wall};
use crate::observe::Observer;
use crate::prepared::Prepared;
use crate::taken::Taken;

/// A run to be served.
pub struct Course<'a> {
    /// What is known before it.
    pub prepared: &'a Prepared,
    /// Where it is taken up, if not before TTI 0.
    pub taken: Option<Taken>,
    /// What knows the devices of lost hosts, and keeps what was decided from outside; without it hosts are lost for
    /// good.
    pub replay: Option<Arc<dyn Replay>>,
    /// Who decides, where the policy does not.
    pub decisions: Decisions,
}

/// Runs `course` over `bus`: waits for hosts to carry all devices, plays every TTI, collects the ledgers.
///
/// # Errors
/// If the bus fails, too few devices join, or a host is lost for good.
pub async fn serve(
    bus: &Bus,
    course: Course<'_>,
    settings: &Settings,
    progress: &Arc<Progress>,
    observer: &mut impl Observer,
) -> Result<Served, BsError> {
    let Course {
        prepared,
        taken,
        replay,
        decisions,
    } = course;
    let Prepared {
        scenario, deployment, ..
    } = prepared;
    let start = taken.as_ref().map(|taken| Arc::clone(&taken.start));
    let next = start.as_ref().map_or(Tti::ZERO, |start| start.next);
    let shared = Shared::new(scenario, deployment, settings, next);
    let _declared = joining::declare(bus, scenario, deployment, settings, start, &shared)?;
    let started = wall::now();
    joining::wait_for_all(&shared, scenario, settings, progress).await?;
    let joining = started.elapsed();
    let mut observers = (observer, Told::new(bus, settings.states_every));
    let crew = Crew {
        bus,
        settings,
        progress,
        shared: &shared,
        replay,
        port: Port::new(bus, settings.key, decisions),
    };
    running::run(crew, prepared, taken, &mut observers, joining).await
}

/// Tells all hosts that the run is over and its results are written, or that it has failed and why: they leave.
///
/// # Errors
/// If the bus fails.
pub fn dismiss(bus: &Bus, failure: Option<String>) -> Result<(), BsError> {
    let message = failure.map_or(Clock::Dismiss, Clock::Fail);
    bus.publisher::<Clock>()?.put(&message)?;
    Ok(())
}
