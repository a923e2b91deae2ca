//! Messages from the base station to hosts, kept until the next grant so that the run loop can retransmit them.
//!
//! A host that missed a message, or takes over devices as before the grant, receives all of them again, in order. A
//! host that already has them ignores the repetition (`device/src/grant_follower/`). Hosts rely on the order: plans and
//! changes, their grant, then the wake-ups of that grant. `dismiss_hosts` in `serve` sends without this file.

use reveille_common::bus::{Bus, BusError, TopicPublisher};
use reveille_common::ids::{DeviceId, HostId};
use reveille_common::message::{ClockMessage, PlanUpdate, WakeUp};

/// Sender of the base station's messages.
pub(super) struct Downlink<'a> {
    bus: &'a Bus,
    clock_topic: TopicPublisher<ClockMessage>,
    plan_topic: TopicPublisher<PlanUpdate>,
    /// The plans of the open grant.
    plans: Vec<PlanUpdate>,
    /// The changes of the open grant, a [`ClockMessage::Act`], if it has any.
    changes: Option<ClockMessage>,
    /// The open grant.
    grant: Option<ClockMessage>,
    /// The wake-ups of the open grant, with the host to which each was sent.
    wake_ups: Vec<(HostId, DeviceId, WakeUp)>,
    /// The message that ended the run; kept until the hosts leave.
    end_message: Option<ClockMessage>,
}

impl<'a> Downlink<'a> {
    /// Creates a downlink without messages.
    pub(super) fn new(bus: &'a Bus) -> Result<Self, BusError> {
        Ok(Self {
            bus,
            clock_topic: bus.publisher()?,
            plan_topic: bus.publisher()?,
            plans: Vec::new(),
            changes: None,
            grant: None,
            wake_ups: Vec::new(),
            end_message: None,
        })
    }

    /// Drops the messages of the last grant, before the next one. The caller has the answers of all hosts to it.
    pub(super) fn drop_grant_messages(&mut self) {
        (self.grant, self.changes) = (None, None);
        self.plans.clear();
        self.wake_ups.clear();
    }

    /// Sends a plan of the next grant.
    pub(super) fn send_plan(&mut self, update: PlanUpdate) -> Result<(), BusError> {
        self.plan_topic.publish(&update)?;
        self.plans.push(update);
        Ok(())
    }

    /// Sends changes, a grant, or the end of the run.
    pub(super) fn send_clock(&mut self, message: ClockMessage) -> Result<(), BusError> {
        self.clock_topic.publish(&message)?;
        match message {
            ClockMessage::Act(..) => self.changes = Some(message),
            ClockMessage::Grant(_) => self.grant = Some(message),
            ClockMessage::CollectLedgers(_) | ClockMessage::Dismiss | ClockMessage::RunFailed(_) => {
                self.end_message = Some(message);
            }
        }
        Ok(())
    }

    /// Sends a wake-up of the open grant.
    pub(super) fn send_wake_up(&mut self, host: HostId, device: DeviceId, wake: WakeUp) -> Result<(), BusError> {
        self.wake_ups.push((host, device, wake));
        self.bus.send_wake_up(host, device, &wake)
    }

    /// Redirects the kept wake-ups to the current owners of their devices.
    pub(super) fn redirect_wake_ups(&mut self, owner_of: impl Fn(DeviceId) -> Option<HostId>) {
        // A wake-up to a removed device keeps its address; the barrier does not wait for it.
        for (host, device, _) in &mut self.wake_ups {
            *host = owner_of(*device).unwrap_or(*host);
        }
    }

    /// Resends every kept message.
    pub(super) fn retransmit(&self) -> Result<(), BusError> {
        // A host applies a grant only with its plans and changes, and a wake-up only after its grant.
        for plan in &self.plans {
            self.plan_topic.publish(plan)?;
        }
        for message in self.changes.iter().chain(&self.grant) {
            self.clock_topic.publish(message)?;
        }
        for (host, device, wake) in &self.wake_ups {
            self.bus.send_wake_up(*host, *device, wake)?;
        }
        match &self.end_message {
            Some(end) => self.clock_topic.publish(end),
            None => Ok(()),
        }
    }
}
