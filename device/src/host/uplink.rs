//! A host's way to the BS.

use reveille_common::bus::{Bus, BusError, Topic};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{Answer, Report};

/// The topics that a host publishes on: reports on the air plane, answers on the emulation plane.
pub struct Uplink {
    first: DeviceId,
    reports: Vec<Topic<Report>>,
    answers: Topic<Answer>,
}

impl Uplink {
    /// The uplink of `host`, which carries `count` devices from `first` on.
    ///
    /// # Errors
    /// If the bus refuses.
    pub fn new(bus: &Bus, host: HostId, first: DeviceId, count: u32) -> Result<Self, BusError> {
        let reports = (first.0..first.0 + count)
            .map(|j| bus.publisher(DeviceId(j)))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            first,
            reports,
            answers: bus.publisher(host)?,
        })
    }

    /// Sends a device's report.
    pub fn report(&self, report: &Report) {
        let topic = &self.reports[(report.device.0 - self.first.0) as usize];
        complain(topic.put(report));
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
