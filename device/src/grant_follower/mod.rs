//! The rules by which a host follows the virtual clock, without I/O: which grants it can execute, which δ change, and
//! which devices sense.
//!
//! Messages may be lost, repeated or stale. A host executes a grant once, when all messages that belong to it are
//! present. It answers a repeated request again. `host` drives this file. `bs/src/server/downlink.rs` relies on these
//! rules when it retransmits; `tests/fuzz/fuzz_targets/grants.rs` checks them against a model.

use std::collections::BTreeMap;

use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, GrantMessage, PlanUpdate, ResumePoint, WakeUp};
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::radio::{Air, RadioSettings};

/// A request of the base station to the devices of a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostRequest {
    /// A grant that ends with this TTI.
    Grant(Tti),
    /// The final ledgers.
    Ledgers,
}

/// The decision of a host about a request.
#[derive(Clone, Debug, PartialEq)]
pub enum Disposition<T> {
    /// The host has this request already: it retransmits the answer as soon as the answer is complete.
    Retransmit,
    /// The host cannot follow, because a message is missing or this one is stale. It waits for the base station to
    /// retransmit the request.
    NotReady,
    /// The host executes this task.
    Execute(T),
}

/// A grant to execute. Plain device indices count from 0 within the host's assignment; `changes` contain device ids.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GrantTask {
    /// The changes that operators make at the start of the grant's first TTI, also to devices of other hosts.
    pub changes: Vec<Change>,
    /// The changes of δ, in the order of TTIs: device index, first TTI, and the new duty cycle.
    pub duty_changes: Vec<(usize, Tti, DutyCycle)>,
    /// The indices of the devices with δ = 1 in the grant's last TTI that are within d_max of its stimulus.
    pub sensing_devices: Vec<usize>,
}

/// A wake-up signal to deliver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WakeUpTask {
    /// The index of the device in the host's assignment, from 0.
    pub device: usize,
    /// The TTI in which the ledger counts the wake-up: the grant's last, also for a later wake-up of the same event.
    pub tti: Tti,
    /// The stimulus when the device is awake; `None` if the event is over by then.
    pub stimulus: Option<Stimulus>,
}

/// A host's view of the clock and of its devices' δ.
#[derive(Clone, Debug)]
pub struct GrantFollower {
    first_device: DeviceId,
    positions: Vec<Point>,
    d_max: f64,
    /// The first TTI after the run.
    end: Tti,
    /// The duty cycle of each device after the last grant.
    duties: Vec<DutyCycle>,
    radio: RadioSettings,
    /// Draws the losses of plans, in the order of TTIs.
    air: Air,
    /// The first TTI of the current plan of this host.
    plan_from: Option<Tti>,
    /// Plans for TTIs that are not granted yet, by first TTI.
    pending_plans: BTreeMap<Tti, Plan>,
    /// Changes at the start of a TTI that is not granted yet. The base station sends changes only for the next grant
    /// ([`ClockMessage::Act`](reveille_common::message::ClockMessage::Act)); [`Self::receive_grant`] relies on that.
    pending_changes: Option<(Tti, Vec<Change>)>,
    /// The first TTI that is not granted yet.
    next: Tti,
    /// The last executed grant.
    grant: Option<GrantMessage>,
    last_request: Option<HostRequest>,
}

/// The start of a follower: its assignment, and the progress of the devices, which is not 0 after a takeover or resume.
#[derive(Clone, Debug)]
pub struct FollowerStart {
    /// The first device of the assignment.
    pub first: DeviceId,
    /// The device positions in the order of ids, m.
    pub positions: Vec<Point>,
    /// The duty cycle of each device.
    pub duties: Vec<DutyCycle>,
    /// The progress of the devices.
    pub resume_point: ResumePoint,
}

impl GrantFollower {
    /// Creates the follower of a host in a run that ends before TTI `end`. Its devices sense events within `d_max`, m;
    /// `seed` and `radio` are the run's.
    ///
    /// # Panics
    /// If `start` has not one duty cycle for each position.
    pub fn new(start: FollowerStart, d_max: f64, end: Tti, seed: u64, radio: &RadioSettings) -> Self {
        let FollowerStart {
            first: first_device,
            positions,
            duties,
            resume_point: ResumePoint { next, plan_from },
        } = start;
        assert_eq!(positions.len(), duties.len(), "a δ for each device");
        Self {
            first_device,
            positions,
            d_max,
            end,
            duties,
            radio: *radio,
            air: Air::new(seed, radio),
            plan_from,
            pending_plans: BTreeMap::new(),
            pending_changes: None,
            next,
            grant: None,
            last_request: None,
        }
    }

    /// The last TTI granted to this host; 0 before its first grant.
    pub fn last_granted(&self) -> Tti {
        self.grant.map_or(Tti::ZERO, |grant| grant.last)
    }

    /// The first TTI that is not granted yet.
    pub const fn next(&self) -> Tti {
        self.next
    }

    /// Stores a plan for the grant that it belongs to. Returns `false` for a plan of granted TTIs, usually a repeated
    /// one, and for a TTI after the end of the run.
    pub fn receive_plan(&mut self, update: PlanUpdate) -> bool {
        let PlanUpdate { from, plan } = update;
        let is_due = from >= self.next && from < self.end;
        if is_due {
            self.pending_plans.insert(from, plan);
        }
        is_due
    }

    /// Stores the changes at the start of TTI `tti` for the grant that they belong to, in place of changes stored
    /// before. Returns `false` for a granted TTI and for a TTI after the end of the run.
    pub fn receive_changes(&mut self, tti: Tti, changes: Vec<Change>) -> bool {
        let is_due = tti >= self.next && tti < self.end;
        if is_due {
            self.pending_changes = Some((tti, changes));
        }
        is_due
    }

    /// Processes a grant. Only the last request is known as a repetition; an older one is [`Disposition::NotReady`].
    pub fn receive_grant(&mut self, grant: GrantMessage) -> Disposition<GrantTask> {
        let request = HostRequest::Grant(grant.last);
        if self.last_request == Some(request) {
            return Disposition::Retransmit;
        }
        let due_plans = || self.pending_plans.range(..=grant.last).map(|(from, _)| *from);
        let due_changes = self.pending_changes.as_ref().filter(|(tti, _)| *tti == grant.first);
        let last_plan = due_plans().next_back().or(self.plan_from);
        // The first TTI shows a lost grant; the last plan and the number of plans show a lost plan, and the number of
        // changes shows lost changes. The base station then retransmits everything.
        if grant.first != self.next
            || grant.last < grant.first
            || grant.last >= self.end
            || last_plan != Some(grant.plan_from)
            || due_plans().count() != grant.plan_count as usize
            || due_changes.map_or(0, |(_, changes)| changes.len()) != grant.change_count as usize
        {
            return Disposition::NotReady;
        }
        let changes = self
            .pending_changes
            .take()
            .map_or_else(Vec::new, |(_, changes)| changes);
        // Before `find_sensing_devices`, which uses δ of the grant's last TTI.
        let duty_changes = self.apply_plans(grant.last);
        let sensing_devices = match &grant.stimulus {
            Some(stimulus) => self.find_sensing_devices(grant.last, stimulus),
            None => Vec::new(),
        };
        self.next = grant.last.saturating_add(1);
        (self.grant, self.last_request) = (Some(grant), Some(request));
        Disposition::Execute(GrantTask {
            changes,
            duty_changes,
            sensing_devices,
        })
    }

    /// Processes the end of the run before TTI `end`, which requests the ledgers.
    pub fn receive_collect_ledgers(&mut self, end: Tti) -> Disposition<()> {
        if self.last_request == Some(HostRequest::Ledgers) {
            return Disposition::Retransmit;
        }
        if end != self.next {
            return Disposition::NotReady;
        }
        self.last_request = Some(HostRequest::Ledgers);
        Disposition::Execute(())
    }

    /// Processes a wake-up for `device`. Returns `None` without a granted event, if the device belongs to another host,
    /// or if the wake-up is outside its TTI. A repeated wake-up is returned again.
    pub fn receive_wake_up(&self, device: DeviceId, wake: WakeUp) -> Option<WakeUpTask> {
        let index = device.index().checked_sub(self.first_device.index())?;
        let grant = self.grant.filter(|_| index < self.duties.len())?;
        let stimulus = grant.stimulus?;
        // With a wake-up delay, later wake-ups of this TTI are sent in TTIs after it.
        let is_in_grant = self.radio.is_valid_send_tti(wake.tti, grant.last);
        is_in_grant.then(|| WakeUpTask {
            device: index,
            tti: grant.last,
            stimulus: (!self.radio.is_late(wake.tti, grant.stimulus_last)).then_some(stimulus),
        })
    }

    /// Applies the plans that belong to a grant up to TTI `last`. Returns the changes of δ.
    fn apply_plans(&mut self, last: Tti) -> Vec<(usize, Tti, DutyCycle)> {
        let mut duty_changes = Vec::new();
        let later_plans = self.pending_plans.split_off(&last.saturating_add(1));
        // In the order of TTIs, because `Air` never goes back.
        for (from, plan) in std::mem::replace(&mut self.pending_plans, later_plans) {
            self.plan_from = Some(from);
            let Self {
                air,
                duties,
                first_device,
                ..
            } = self;
            air.deliver_plan(from, &plan, *first_device, duties.len(), |j, duty| {
                if duties[j] != duty {
                    duties[j] = duty;
                    duty_changes.push((j, from, duty));
                }
            });
        }
        duty_changes
    }

    /// The indices of the devices that can detect `stimulus` in TTI `tti`.
    /// [`Machine::can_detect`](crate::machine::Machine::can_detect) and `common/src/world.rs` have the same rule.
    fn find_sensing_devices(&self, tti: Tti, stimulus: &Stimulus) -> Vec<usize> {
        let is_in_range = |j: &usize| self.positions[*j].distance(stimulus.epicentre) <= self.d_max;
        (0..self.duties.len())
            .filter(|&j| self.duties[j].is_on(tti))
            .filter(is_in_range)
            .collect()
    }
}

#[cfg(test)]
mod tests;
