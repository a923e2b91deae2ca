//! The BS's voice on the bus: what it asks of the hosts, kept until the next grant to be asked again.
//!
//! A host that has missed something, or that takes over devices as they were before the grant, is told all of it once
//! more, in order. To one that has heard it, it changes nothing.

use reveille_common::bus::{Bus, BusError, Topic};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{Clock, PlanUpdate, WakeUp};

/// The BS's voice.
pub(super) struct Voice<'a> {
    bus: &'a Bus,
    to_clocks: Topic<Clock>,
    to_plans: Topic<PlanUpdate>,
    plans: Vec<PlanUpdate>,
    grant: Option<Clock>,
    woken: Vec<(HostId, DeviceId, WakeUp)>,
    end: Option<Clock>,
}

impl<'a> Voice<'a> {
    /// A voice that has said nothing.
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

    /// What was said before is over: all hosts have done it.
    pub(super) fn begin(&mut self) {
        self.grant = None;
        self.plans.clear();
        self.woken.clear();
    }

    /// Tells a plan.
    pub(super) fn plan(&mut self, update: PlanUpdate) -> Result<(), BusError> {
        self.to_plans.put(&update)?;
        self.plans.push(update);
        Ok(())
    }

    /// Grants TTIs, or ends the run.
    pub(super) fn clock(&mut self, clock: Clock) -> Result<(), BusError> {
        self.to_clocks.put(&clock)?;
        match clock {
            Clock::Grant(_) => self.grant = Some(clock),
            Clock::Finish(_) | Clock::Dismiss | Clock::Fail(_) => self.end = Some(clock),
        }
        Ok(())
    }

    /// Wakes `device`, which `host` carries.
    pub(super) fn wake_up(&mut self, host: HostId, device: DeviceId, wake: WakeUp) -> Result<(), BusError> {
        self.woken.push((host, device, wake));
        self.bus.wake(host, device, &wake)
    }

    /// Wake-ups that are said again go to the hosts that carry the devices now.
    pub(super) fn redirect(&mut self, carrier: impl Fn(DeviceId) -> Option<HostId>) {
        for (host, device, _) in &mut self.woken {
            *host = carrier(*device).unwrap_or(*host);
        }
    }

    /// Says all of it once more.
    pub(super) fn say_again(&self) -> Result<(), BusError> {
        for plan in &self.plans {
            self.to_plans.put(plan)?;
        }
        if let Some(grant) = &self.grant {
            self.to_clocks.put(grant)?;
        }
        for (host, device, wake) in &self.woken {
            self.bus.wake(*host, *device, wake)?;
        }
        match &self.end {
            Some(end) => self.to_clocks.put(end),
            None => Ok(()),
        }
    }
}
