//! The base station as a machine without I/O: what it knows, the plan in force, and the policy that decides.
//!
//! It hears reports and silence, never the world.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{PlanUpdate, Report};
use reveille_common::plan::Plan;
use reveille_common::units::Energy;

use crate::beliefs::levels::Levels;
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::policy::mind::{Bound, Mind};

/// The base station of one run.
pub struct Station {
    known: Knowledge,
    mind: Mind,
    plan: Plan,
    /// The battery levels as the BS knows them, for a policy that looks at batteries.
    levels: Option<Levels>,
    next_decision: Tti,
    /// Î of this TTI.
    information: f64,
    /// Whether a report has come in this TTI.
    has_heard: bool,
}

impl Station {
    /// A base station that knows `known` and decides by `mind`, before TTI 0.
    pub fn new(known: Knowledge, mind: Mind) -> Self {
        Self {
            plan: Plan::from_bits(known.devices.iter().map(|_| false)),
            levels: mind.looks_at_batteries().then(|| Levels::new(&known)),
            known,
            mind,
            next_decision: Tti::ZERO,
            information: 0.0,
            has_heard: false,
        }
    }

    /// The plan in force.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Î of the TTI that is open or was closed last: the information gathered about the event, `[0, Ψ]`.
    pub const fn information(&self) -> f64 {
        self.information
    }

    /// The mind of the policy, which decides.
    pub const fn mind(&self) -> &Mind {
        &self.mind
    }

    /// The plan in force, and the genie, which is told of events.
    pub fn commands(&mut self) -> (&Plan, Option<&mut dyn Bound>) {
        (&self.plan, self.mind.genie())
    }

    /// Whether the true batteries are to be told before the decision of TTI `k`.
    pub fn wants_batteries(&self, k: Tti) -> bool {
        k >= self.next_decision && k > Tti::ZERO && self.is_told_batteries()
    }

    /// Whether the policy is told the true batteries at all.
    pub fn is_told_batteries(&self) -> bool {
        self.levels.as_ref().is_some_and(Levels::are_told)
    }

    /// The battery levels of all devices, in the order of ids, at the end of the last TTI.
    pub fn tell_batteries(&mut self, levels: impl IntoIterator<Item = Energy>) {
        if let Some(known) = &mut self.levels {
            known.tell(levels);
        }
    }

    /// Begins TTI `k`: decides if it is time to, and gives what must go out on the air, a new plan (`true`) or the plan
    /// in force once more for synchronisation.
    pub fn announce(&mut self, k: Tti) -> Option<(PlanUpdate, bool)> {
        let mut is_new = k == Tti::ZERO;
        self.information = 0.0;
        self.has_heard = false;
        if k >= self.next_decision {
            let Self {
                known,
                mind,
                plan,
                levels,
                ..
            } = self;
            let decided = mind.decide(&observe(known, plan, levels.as_ref(), k, 0.0));
            self.next_decision = self.mind.next_decision(k);
            assert!(self.next_decision > k, "a policy decides at most once per TTI");
            is_new |= decided != self.plan;
            self.plan = decided;
        }
        if !is_new && !k.0.is_multiple_of(self.known.bs.sync_interval) {
            return None;
        }
        let plan = self.plan.clone();
        Some((PlanUpdate { from: k, plan }, is_new))
    }

    /// The TTI after `k` at which the station has something to say or to decide.
    pub fn next_announcement(&self, k: Tti) -> Tti {
        let sync = self.known.bs.sync_interval;
        Tti((k.0 / sync + 1) * sync).min(self.next_decision)
    }

    /// TTI `tti` has brought these reports, in the order of ids.
    pub fn gathered(&mut self, tti: Tti, reports: &[Report]) {
        let Self {
            known,
            mind,
            plan,
            levels,
            information,
            has_heard,
            ..
        } = self;
        (*information, *has_heard) = (0.0, !reports.is_empty());
        if let Some(levels) = levels {
            // A policy that looks at batteries decides every TTI.
            levels.pass(tti, plan);
            for report in reports {
                levels.heard(report.device, report.battery);
            }
        }
        for report in reports {
            *information = known.sensing.fuse(*information, report.information);
        }
        if let (Mind::Policy(policy), true) = (mind, *has_heard) {
            policy.reported(&observe(known, plan, levels.as_ref(), tti, *information), reports);
        }
    }

    /// The next device to wake in `tti`, or none.
    pub fn next_wake_up(&mut self, tti: Tti) -> Option<DeviceId> {
        let Self {
            known,
            mind,
            plan,
            levels,
            information,
            has_heard,
            ..
        } = self;
        match mind {
            Mind::Policy(policy) if *has_heard => {
                policy.next_wake_up(&observe(known, plan, levels.as_ref(), tti, *information))
            }
            Mind::Policy(_) => None,
            Mind::Genie(genie) => genie.next_wake_up(),
        }
    }

    /// The wake-up of `device` has brought this report, or nothing.
    pub fn woken(&mut self, tti: Tti, device: DeviceId, report: Option<&Report>) {
        let Self {
            known,
            mind,
            plan,
            levels,
            information,
            ..
        } = self;
        if let Some(levels) = levels {
            match report {
                Some(report) => levels.heard(device, report.battery),
                None => levels.silent(device),
            }
        }
        if let Some(report) = report {
            *information = known.sensing.fuse(*information, report.information);
        }
        if let Mind::Policy(policy) = mind {
            policy.answered(&observe(known, plan, levels.as_ref(), tti, *information), report);
        }
    }
}

fn observe<'a>(
    known: &'a Knowledge,
    plan: &'a Plan,
    levels: Option<&'a Levels>,
    now: Tti,
    information: f64,
) -> Observation<'a> {
    Observation {
        now,
        known,
        plan,
        information,
        batteries: levels.map_or(&[], Levels::all),
    }
}
