//! One request of the base station to a host, answered when the last of the devices concerned has added its part.
//! Actors add their parts in any order; the host keeps the round, so that it can retransmit the answer.
//! Reports are sent before the answer, which states their number to `bs/src/server/barrier/`.

use std::sync::{Mutex, MutexGuard, PoisonError};

use reveille_common::bus::{Bus, BusError, TopicPublisher};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{FailedTransmission, HostAnswer, Report, UnableDetectors};
use reveille_common::secret::HostCredential;
use reveille_common::state::DeviceView;
use reveille_common::totals::{DeviceTotals, Ledger};

use crate::grant_follower::HostRequest;

/// An answer that is being assembled.
pub struct AnswerRound {
    host: HostId,
    request: HostRequest,
    parts: Mutex<Parts>,
}

/// The parts that the devices have added so far.
#[derive(Default)]
struct Parts {
    /// The number of missing parts of devices, plus one for the host while it distributes the request.
    missing: usize,
    reports: Vec<Report>,
    failures: Vec<FailedTransmission>,
    unable: UnableDetectors,
    totals: Option<DeviceTotals>,
    views: Vec<(DeviceId, DeviceView)>,
    ledgers: Vec<(DeviceId, Ledger)>,
}

/// One device's part of the answer.
pub enum DeviceAnswer {
    /// The device sent a report.
    Reported(Report),
    /// The device could not transmit.
    Failed(FailedTransmission),
    /// The device would have detected the event, but could not sense.
    Unable(UnableDetectors),
    /// A device with its state and battery.
    View(DeviceId, DeviceView),
    /// A device with its ledger. A grant's answer contains only the sum of the ledgers.
    Ledger(DeviceId, Box<Ledger>),
    /// An empty part, of a device or of the host itself.
    Nothing,
}

impl Parts {
    /// Returns the views in the order of device ids, if the request asked for them.
    fn sorted_views(&self) -> Option<Vec<DeviceView>> {
        let mut views = self.views.clone();
        // Actors add their parts in any order.
        views.sort_unstable_by_key(|(device, _)| *device);
        (!views.is_empty()).then(|| views.into_iter().map(|(_, view)| view).collect())
    }
}

impl AnswerRound {
    /// Creates the answer to a request with exactly `device_parts` parts of devices, which `host/mod.rs` counts: a
    /// device can add several. The host adds one further part once it has distributed the request.
    pub fn new(host: HostId, request: HostRequest, device_parts: usize) -> Self {
        Self {
            host,
            request,
            parts: Mutex::new(Parts {
                missing: device_parts + 1,
                ..Parts::default()
            }),
        }
    }

    /// Adds one device's part, or the host's own. The last part sends the answer. The caller sends a report before it
    /// adds the part.
    ///
    /// # Panics
    /// May panic if more parts are added than [`Self::new`] has announced.
    pub fn add(&self, part: &DeviceAnswer, uplink: &Uplink) {
        if let Some(answer) = self.add_part(part) {
            uplink.send_answer(&answer);
        }
    }

    /// Retransmits all reports and the answer, for a base station that repeats its request. Does nothing while parts
    /// are missing.
    pub fn retransmit(&self, uplink: &Uplink) {
        if let Some((reports, answer)) = self.completed() {
            // Reports come first, since the answer states how many precede it.
            for report in &reports {
                uplink.send_report(report);
            }
            uplink.send_answer(&answer);
        }
    }

    /// Adds a part and returns the answer if it was the last one. Reports, failures and ledgers stay in the order of
    /// arrival; the base station sorts them.
    fn add_part(&self, part: &DeviceAnswer) -> Option<HostAnswer> {
        let mut parts = self.lock();
        match part {
            DeviceAnswer::Reported(report) => parts.reports.push(*report),
            DeviceAnswer::Failed(failure) => parts.failures.push(*failure),
            DeviceAnswer::Unable(unable) => parts.unable += *unable,
            DeviceAnswer::View(device, view) => parts.views.push((*device, *view)),
            DeviceAnswer::Ledger(device, ledger) => match self.request {
                HostRequest::Grant(_) => parts.totals = Some(parts.totals.unwrap_or_default() + ledger.whole),
                HostRequest::Ledgers => parts.ledgers.push((*device, **ledger)),
            },
            DeviceAnswer::Nothing => {}
        }
        // The last part builds the answer under the lock, so it is sent exactly once.
        parts.missing -= 1;
        (parts.missing == 0).then(|| self.build_answer(&parts))
    }

    /// Returns all reports and the answer, once the last part is in.
    fn completed(&self) -> Option<(Vec<Report>, HostAnswer)> {
        let parts = self.lock();
        (parts.missing == 0).then(|| (parts.reports.clone(), self.build_answer(&parts)))
    }

    fn build_answer(&self, parts: &Parts) -> HostAnswer {
        match self.request {
            HostRequest::Grant(tti) => HostAnswer::GrantDone {
                host: self.host,
                tti,
                reports: parts.reports.len() as u32,
                failures: parts.failures.clone(),
                unable: parts.unable,
                totals: parts.totals,
                views: parts.sorted_views(),
            },
            HostRequest::Ledgers => HostAnswer::Ledgers {
                host: self.host,
                ledgers: parts.ledgers.clone(),
            },
        }
    }

    fn lock(&self) -> MutexGuard<'_, Parts> {
        self.parts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The topics that a host publishes to: reports on the air plane, answers on the emulation plane.
pub struct Uplink {
    reports: TopicPublisher<Report>,
    answers: TopicPublisher<HostAnswer>,
}

impl Uplink {
    /// Creates the uplink of the host with this credential.
    ///
    /// # Errors
    /// If the bus fails.
    pub fn new(bus: &Bus, credential: HostCredential) -> Result<Self, BusError> {
        Ok(Self {
            reports: bus.uplink(credential)?,
            answers: bus.uplink(credential)?,
        })
    }

    /// Sends a device's report.
    pub fn send_report(&self, report: &Report) {
        log_send_failure(self.reports.publish(report));
    }

    /// Sends the host's answer.
    pub fn send_answer(&self, answer: &HostAnswer) {
        log_send_failure(self.answers.publish(answer));
    }
}

/// Logs a failed send, at debug level only: if the session is closed, the host itself detects that the base station
/// is lost.
fn log_send_failure(sent: Result<(), BusError>) {
    if let Err(error) = sent {
        tracing::debug!(%error, "a message was not sent");
    }
}

#[cfg(test)]
mod tests;
