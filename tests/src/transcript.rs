//! Records the plans and wake-ups of a base station, so that an external policy can repeat them: over the bus in
//! `external_policy.rs`, in memory in `tests/tests/external.rs`.

use std::collections::BTreeMap;

use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::external::{Decision, DecisionStage, PlanDecision};
use reveille_bs::scenario::Scenario;
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::score::Digest;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

/// Plans and wake-ups of a base station, and events of one run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CommandTranscript {
    /// Plans sent, by the first TTI in which they apply. The latest one applies in any TTI.
    pub plans: BTreeMap<u64, Plan>,
    /// Devices woken, in order, by TTI; TTIs without a wake-up are missing.
    pub wake_ups: BTreeMap<u64, Vec<DeviceId>>,
    /// Ended events.
    pub events: Vec<EventRecord>,
}

impl Observer for CommandTranscript {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => {
                self.plans.insert(update.from.0, update.plan.clone());
            }
            Notification::WakeUpSent { tti, device, .. } => self.wake_ups.entry(tti.0).or_default().push(*device),
            Notification::EventEnded(event) => self.events.push(**event),
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportReceived(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::BeliefUpdated { .. }
            | Notification::TtiClosed(_)
            | Notification::DeviceStates(_) => {}
        }
    }
}

impl CommandTranscript {
    /// Runs `scenario` in memory, after its pilot runs if the policy has any, and returns its transcript and digest.
    pub fn record(scenario: &Scenario) -> (Self, Digest) {
        let mut transcript = Self::default();
        let outcome = Run::new(&prepare(scenario), RunOptions::default()).finish(&mut transcript);
        (transcript, outcome.digest)
    }

    /// Returns the plan in effect in TTI `k`.
    ///
    /// # Panics
    /// If no plan was sent up to TTI `k`.
    pub fn plan_at(&self, k: Tti) -> Plan {
        let (_, plan) = self.plans.range(..=k.0).next_back().expect("a plan in TTI 0");
        plan.clone()
    }

    /// Returns the devices woken in TTI `k`, in order.
    pub fn wake_ups_in(&self, k: Tti) -> &[DeviceId] {
        self.wake_ups.get(&k.0).map_or(&[], Vec::as_slice)
    }

    /// Returns the recorded decision of TTI `k`: its plan, for this TTI only, or its wake-ups of devices for which
    /// `may_wake` holds. `may_wake` must exclude the devices already woken in TTI `k`, which would be repeated.
    ///
    /// # Panics
    /// At the plan stage, if no plan was sent up to TTI `k`.
    pub fn decision(&self, stage: DecisionStage, k: Tti, may_wake: impl Fn(DeviceId) -> bool) -> Decision {
        match stage {
            DecisionStage::Plan => Decision::Plan(PlanDecision {
                plan: self.plan_at(k),
                next: k + 1,
            }),
            DecisionStage::Wake => {
                let devices = self.wake_ups_in(k).iter().copied();
                Decision::Wake(devices.filter(|device| may_wake(*device)).collect())
            }
        }
    }
}
