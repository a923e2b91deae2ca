//! What a base station commands in a run, to be commanded once more from outside.

use std::collections::BTreeMap;

use reveille_bs::observe::{Happening, Observer};
use reveille_bs::policy::external::{Answer, Decision, Stage};
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::scenario::Scenario;
use reveille_common::score::Digest;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run};

/// What a base station commands in a run, and the events of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Transcript {
    /// By TTI, the plan that goes out in it.
    pub plans: BTreeMap<u64, Plan>,
    /// By TTI, who is woken in it.
    pub wake_ups: BTreeMap<u64, Vec<DeviceId>>,
    /// The events that have ended.
    pub events: Vec<EventRecord>,
}

impl Observer for Transcript {
    fn see(&mut self, happening: &Happening<'_>) {
        match happening {
            Happening::Plan { update, .. } => {
                self.plans.insert(update.from.0, update.plan.clone());
            }
            Happening::WakeUp { tti, device, .. } => self.wake_ups.entry(tti.0).or_default().push(*device),
            Happening::EventEnded(event) => self.events.push(**event),
            Happening::Granted(_)
            | Happening::EventStarted(_)
            | Happening::Reported(_)
            | Happening::Lost(_)
            | Happening::Gone(_)
            | Happening::Failed { .. }
            | Happening::Woken { .. }
            | Happening::Believed { .. }
            | Happening::Closed(_)
            | Happening::States(_) => {}
        }
    }
}

impl Transcript {
    /// That of a run of `scenario` in memory, with its digest.
    pub fn of(scenario: &Scenario) -> (Self, Digest) {
        let mut transcript = Self::default();
        let outcome = Run::new(&prepare(scenario), Options::default()).finish(&mut transcript);
        (transcript, outcome.digest)
    }

    /// The plan that was in force in TTI `k`.
    ///
    /// # Panics
    /// If there was none.
    pub fn plan_at(&self, k: Tti) -> Plan {
        let (_, plan) = self.plans.range(..=k.0).next_back().expect("a plan in TTI 0");
        plan.clone()
    }

    /// What was decided in TTI `k`: a plan for it alone, or all wake-ups that are `left`.
    pub fn answer(&self, stage: Stage, k: Tti, left: impl Fn(DeviceId) -> bool) -> Answer {
        match stage {
            Stage::Plan => Answer::Plan(Decision {
                plan: self.plan_at(k),
                next: k + 1,
            }),
            Stage::Wake => {
                let all = self.wake_ups.get(&k.0).map_or(&[][..], Vec::as_slice);
                Answer::Wake(all.iter().copied().filter(|device| left(*device)).collect())
            }
        }
    }
}
