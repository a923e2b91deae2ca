//! Messages from the base station to hosts, kept until the next grant so that they can be resent.
//!
//! A host that missed a message, or takes over devices as before the grant, receives all of them again, in order. A
//! host that already has them ignores the repetition.

use reveille_common::bus::{Bus, BusError, Topic};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{ClockMessage, PlanUpdate, WakeUp};

/// Sender of the base station's messages.
pub(super) struct Downlink<'a> {
    bus: &'a Bus,
    to_clocks: Topic<ClockMessage>,
    to_plans: Topic<PlanUpdate>,
    plans: Vec<PlanUpdate>,
    grant: Option<ClockMessage>,
    woken: Vec<(HostId, DeviceId, WakeUp)>,
    end: Option<ClockMessage>,
}

impl<'a> Downlink<'a> {
    /// Creates a downlink without messages.
    pub(super) fn new(bus: &'a Bus) -> Result<Self, BusError> {
        Ok(Self {
            bus,
            to_clocks: bus.publisher()?,
            to_plans: bus.publisher()?,
            plans: Vec::new(),
            grant: None,
            woken: Vec::new(),
            end: None,
        })
    }

    /// Drops the messages of the last grant, which all hosts have completed.
    pub(super) fn clear(&mut self) {
        self.grant = None;
        self.plans.clear();
        self.woken.clear();
    }

    /// Sends a plan.
    pub(super) fn send_plan(&mut self, update: PlanUpdate) -> Result<(), BusError> {
        self.to_plans.publish(&update)?;
        self.plans.push(update);
        Ok(())
    }

    /// Sends a grant, or the end of the run.
    pub(super) fn send_clock(&mut self, clock: ClockMessage) -> Result<(), BusError> {
        self.to_clocks.publish(&clock)?;
        match clock {
            ClockMessage::Grant(_) => self.grant = Some(clock),
            ClockMessage::CollectLedgers(_) | ClockMessage::Dismiss | ClockMessage::RunFailed(_) => {
                self.end = Some(clock);
            }
        }
        Ok(())
    }

    /// Sends a wake-up to `device`, which `host` runs.
    pub(super) fn send_wake_up(&mut self, host: HostId, device: DeviceId, wake: WakeUp) -> Result<(), BusError> {
        self.woken.push((host, device, wake));
        self.bus.wake(host, device, &wake)
    }

    /// Redirects the kept wake-ups to the current owners of their devices.
    pub(super) fn redirect(&mut self, carrier: impl Fn(DeviceId) -> Option<HostId>) {
        // A wake-up to a removed device keeps its address; the barrier does not wait for it.
        for (host, device, _) in &mut self.woken {
            *host = carrier(*device).unwrap_or(*host);
        }
    }

    /// Resends every message of the open grant.
    pub(super) fn retransmit(&self) -> Result<(), BusError> {
        // In the order of the first sending: a host applies a grant only with its plan, and a wake-up only after its
        // grant.
        for plan in &self.plans {
            self.to_plans.publish(plan)?;
        }
        if let Some(grant) = &self.grant {
            self.to_clocks.publish(grant)?;
        }
        for (host, device, wake) in &self.woken {
            self.bus.wake(*host, *device, wake)?;
        }
        match &self.end {
            Some(end) => self.to_clocks.publish(end),
            None => Ok(()),
        }
    }
}
