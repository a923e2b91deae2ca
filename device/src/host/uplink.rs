//! A host's way to the BS.

use reveille_common::bus::{Bus, BusError, Topic};
use reveille_common::message::{Answer, Report};
use reveille_common::secret::HostPass;

/// The topics that a host publishes on: reports on the air plane, answers on the emulation plane.
pub struct Uplink {
    reports: Topic<Report>,
    answers: Topic<Answer>,
}

impl Uplink {
    /// The uplink of the host with this pass.
    ///
    /// # Errors
    /// If the bus refuses.
    pub fn new(bus: &Bus, pass: HostPass) -> Result<Self, BusError> {
        Ok(Self {
            reports: bus.uplink(pass)?,
            answers: bus.uplink(pass)?,
        })
    }

    /// Sends a device's report.
    pub fn report(&self, report: &Report) {
        complain(self.reports.put(report));
    }

    /// Sends the host's answer.
    pub fn answer(&self, answer: &Answer) {
        complain(self.answers.put(answer));
    }
}

/// A session that is closed under a device has lost its BS, which the host notices by itself.
fn complain(sent: Result<(), BusError>) {
    if let Err(error) = sent {
        tracing::debug!(%error, "a message was not sent");
    }
}
