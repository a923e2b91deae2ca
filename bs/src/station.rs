//! The base station as a machine without I/O: what it knows, the plan in force, and the policy that decides.
//!
//! It hears reports and silence, never the world.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Likely, PlanUpdate, Report};
use reveille_common::plan::Plan;
use reveille_common::units::Energy;

use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::levels::Levels;
use crate::observation::Observation;
use crate::policy::external::{Decision, External, Question, Stage};
use crate::policy::mind::{Bound, Mind};

/// The base station of one run.
pub struct Station {
    view: View,
    mind: Mind,
    next_decision: Tti,
    /// Whether a report has come in this TTI.
    has_heard: bool,
}

/// What the policy is shown.
#[derive(Clone)]
struct View {
    known: Knowledge,
    plan: Plan,
    /// The battery levels as the BS knows them, for a policy that looks at batteries or wakes devices.
    levels: Option<Levels>,
    /// Whether the policy looks at batteries, so that levels are brought up to date in each TTI.
    shows_levels: bool,
    /// Î of this TTI.
    information: f64,
}

impl View {
    fn at(&self, now: Tti) -> Observation<'_> {
        Observation {
            now,
            known: &self.known,
            plan: &self.plan,
            information: self.information,
            batteries: self
                .levels
                .as_ref()
                .filter(|_| self.shows_levels)
                .map_or(&[], Levels::all),
            levels: self.levels.as_ref(),
        }
    }

    /// One more report about the event.
    fn fuse(&mut self, report: &Report) {
        self.information = self.known.sensing.fuse(self.information, report.information);
    }
}

impl Station {
    /// A base station that knows `known` and decides by `mind`, before TTI 0.
    pub fn new(known: Knowledge, mind: Mind) -> Self {
        let view = View {
            plan: Plan::from_bits(known.devices.iter().map(|_| false)),
            levels: if mind.looks_at_batteries() {
                Some(Levels::new(&known))
            } else {
                mind.wakes().then(|| Levels::reckoned(&known))
            },
            shows_levels: mind.looks_at_batteries(),
            known,
            information: 0.0,
        };
        Self {
            view,
            mind,
            next_decision: Tti::ZERO,
            has_heard: false,
        }
    }

    /// The plan in force.
    pub const fn plan(&self) -> &Plan {
        &self.view.plan
    }

    /// Î of the TTI that is open or was closed last: the information gathered about the event, `[0, Ψ]`.
    pub const fn information(&self) -> f64 {
        self.view.information
    }

    /// The mind of the policy, which decides.
    pub const fn mind(&self) -> &Mind {
        &self.mind
    }

    /// Where the policy believes the event of this TTI to be; nowhere if it has no such belief, or nothing was heard.
    pub fn belief(&self) -> Vec<Likely> {
        match &self.mind {
            Mind::Policy(policy) if self.has_heard => policy.belief().map_or_else(Vec::new, Belief::shares),
            Mind::Policy(_) | Mind::Genie(_) | Mind::External(_) => Vec::new(),
        }
    }

    /// Whether somebody outside is to tell a plan before TTI `k` begins.
    pub fn asks_for_plan(&self, k: Tti) -> bool {
        self.mind.external().is_some_and(|external| external.asks_for_plan(k))
    }

    /// Whether somebody outside is to tell whom to wake in TTI `tti`.
    pub fn asks_whom(&self, tti: Tti) -> bool {
        let asked = self.mind.external().filter(|_| self.has_heard);
        asked.is_some_and(|external| external.asks_whom(&self.view.at(tti)))
    }

    /// What somebody outside is asked in TTI `k`, if it is for them to decide.
    pub fn question(&self, k: Tti, stage: Stage) -> Option<Question<'_>> {
        let seen = self.view.at(k);
        let seen = match stage {
            // Nothing has been gathered in a TTI that has not begun.
            Stage::Plan => Observation {
                information: 0.0,
                ..seen
            },
            Stage::Wake => seen,
        };
        self.mind.external().map(|external| external.question(stage, seen))
    }

    /// TTI `tti` is closed.
    pub fn closed(&mut self, tti: Tti) {
        if let Mind::External(external) = &mut self.mind {
            external.closed(tti + 1, &self.view.plan);
        }
    }

    /// What somebody outside has decided for the TTI that begins next.
    pub fn tell_plan(&mut self, decision: Decision) {
        self.asked().0.tell_plan(decision);
    }

    /// Whom somebody outside wakes in TTI `tti`.
    pub fn tell_whom(&mut self, tti: Tti, devices: &[DeviceId]) {
        let (external, view) = self.asked();
        external.tell_whom(&view.at(tti), devices);
    }

    fn asked(&mut self) -> (&mut External, &View) {
        match &mut self.mind {
            Mind::External(external) => (external, &self.view),
            Mind::Policy(_) | Mind::Genie(_) => panic!("a policy that decides itself is told nothing"),
        }
    }

    /// A copy that goes on from here, where somebody outside decides: no policy can be copied.
    pub fn branch(&self) -> Option<Self> {
        let external = self.mind.external()?;
        Some(Self {
            view: self.view.clone(),
            mind: Mind::External(Box::new(external.clone())),
            next_decision: self.next_decision,
            has_heard: self.has_heard,
        })
    }

    /// The plan in force, and the genie, which is told of events.
    pub fn commands(&mut self) -> (&Plan, Option<&mut dyn Bound>) {
        (&self.view.plan, self.mind.genie())
    }

    /// Whether the true batteries are to be told before the decision of TTI `k`.
    pub fn wants_batteries(&self, k: Tti) -> bool {
        k >= self.next_decision && k > Tti::ZERO && self.is_told_batteries()
    }

    /// Whether the policy is told the true batteries at all.
    pub fn is_told_batteries(&self) -> bool {
        self.view.levels.as_ref().is_some_and(Levels::are_told)
    }

    /// The battery levels as they are known, in the order of ids; empty where nobody looks at them.
    pub fn batteries(&self) -> &[Energy] {
        self.view.levels.as_ref().map_or(&[], Levels::all)
    }

    /// The battery levels of all devices, in the order of ids, at the end of the last TTI.
    pub fn tell_batteries(&mut self, levels: impl IntoIterator<Item = Energy>) {
        if let Some(known) = &mut self.view.levels {
            known.tell(levels);
        }
    }

    /// Begins TTI `k`: decides if it is time to, and gives what must go out on the air, a new plan (`true`) or the plan
    /// in force once more for synchronisation.
    pub fn announce(&mut self, k: Tti) -> Option<(PlanUpdate, bool)> {
        let mut is_new = k == Tti::ZERO;
        self.view.information = 0.0;
        self.has_heard = false;
        if k >= self.next_decision {
            let decided = self.mind.decide(&self.view.at(k));
            self.next_decision = self.mind.next_decision(k);
            assert!(self.next_decision > k, "a policy decides at most once per TTI");
            is_new |= decided != self.view.plan;
            let View {
                plan,
                levels,
                shows_levels,
                ..
            } = &mut self.view;
            if let Some(levels) = levels.as_mut().filter(|_| !*shows_levels) {
                levels.pass(k, plan);
            }
            *plan = decided;
        }
        if !is_new && !k.0.is_multiple_of(self.view.known.bs.sync_interval) {
            return None;
        }
        let plan = self.view.plan.clone();
        Some((PlanUpdate { from: k, plan }, is_new))
    }

    /// The TTI after `k` at which the station has something to say or to decide.
    pub fn next_announcement(&self, k: Tti) -> Tti {
        let sync = self.view.known.bs.sync_interval;
        Tti((k.0 / sync + 1) * sync).min(self.next_decision)
    }

    /// TTI `tti` has brought these reports, in the order of ids.
    pub fn gathered(&mut self, tti: Tti, reports: &[Report]) {
        let Self {
            view, mind, has_heard, ..
        } = self;
        (view.information, *has_heard) = (0.0, !reports.is_empty());
        if let Some(levels) = &mut view.levels {
            if view.shows_levels {
                // A policy that looks at batteries decides every TTI.
                levels.pass(tti + 1, &view.plan);
            }
            levels.gathered(tti, &view.plan, reports);
        }
        for report in reports {
            view.fuse(report);
        }
        match mind {
            Mind::Policy(policy) if *has_heard => policy.reported(&view.at(tti), reports),
            Mind::External(external) if *has_heard => external.reported(&view.at(tti), reports),
            Mind::Policy(_) | Mind::Genie(_) | Mind::External(_) => {}
        }
    }

    /// The next device to wake in `tti`, or none.
    pub fn next_wake_up(&mut self, tti: Tti) -> Option<DeviceId> {
        match &mut self.mind {
            Mind::Policy(policy) if self.has_heard => policy.next_wake_up(&self.view.at(tti)),
            Mind::Policy(_) => None,
            Mind::Genie(genie) => genie.next_wake_up(),
            Mind::External(external) => external.next_wake_up(),
        }
    }

    /// The wake-up of `device` has brought this report, or nothing.
    pub fn woken(&mut self, tti: Tti, device: DeviceId, report: Option<&Report>) {
        let view = &mut self.view;
        if let Some(levels) = &mut view.levels {
            match report {
                Some(report) => levels.heard(device, tti, report.battery),
                None => levels.silent(device, tti, &view.plan),
            }
        }
        if let Some(report) = report {
            view.fuse(report);
        }
        match &mut self.mind {
            Mind::Policy(policy) => policy.answered(&view.at(tti), report),
            Mind::Genie(genie) => genie.answered(report),
            Mind::External(external) => external.answered(report),
        }
    }
}
