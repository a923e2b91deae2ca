//! Environments for training policies: runs with external decisions, one step per decision, numeric observations, and
//! the rewards of Sec. V-B.
//!
//! The Python package wraps an [`EnvBatch`]; the shapes of its buffers and the numbers of stages are part of the
//! package's interface (`docs/python.md`). A step answers one decision request. At stage 0 the action is δ(k), a bit
//! for each device. At stage 1 it is the set of devices to wake; an empty set ends the wake-ups of the TTI. Devices of
//! one action are woken in the order of ids. Every action is valid: impossible parts are dropped
//! ([`reveille_bs::policy::external`]).

mod batch;
mod environment;

use std::collections::BTreeMap;

use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::external::DecisionStage;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::DeviceId;
use reveille_common::plan::Plan;

use crate::preparation::prepare;
use crate::run::{Run, RunOptions};

pub use batch::{BatchBuffers, EnvBatch, REWARD_TERMS};
pub use environment::{Environment, EpisodeTemplate, RewardTerms, RewardWeights};

/// A run of a policy, and the actions that reproduce it in an environment.
#[derive(Clone, Debug)]
pub struct RecordedActions {
    /// One action per step, 0 or 1 for each device, `[T, N]` for T steps. Devices are woken one at a time.
    pub rows: Vec<i8>,
    /// The stage of each step, 0 or 1, `[T]`.
    pub stages: Vec<i8>,
    /// The outcome of the policy's run.
    pub policy_outcome: RunOutcome,
    /// The outcome of the environment. It has the digest of [`Self::policy_outcome`] if the policy sends bits. For duty
    /// cycles the environment sends bits whenever they change, so the digests differ.
    pub environment_outcome: RunOutcome,
}

/// Records the plans and wake-ups of a base station by TTI.
#[derive(Default)]
struct CommandObserver {
    plans: BTreeMap<u64, Plan>,
    wake_ups: BTreeMap<u64, Vec<DeviceId>>,
}

impl Observer for CommandObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        // A plan that is resent for synchronisation repeats the last one.
        if let Notification::PlanSent { update, is_new: true } = notification {
            self.plans.insert(update.from.0, update.plan.clone());
        }
        if let Notification::WakeUpSent { tti, device, .. } = notification {
            self.wake_ups.entry(tti.0).or_default().push(*device);
        }
    }
}

/// Records the run of `scenario` as actions in the environment of `external_scenario`, the same scenario with the
/// policy `external`; in another one the actions mean nothing. Returns `None` for the genie, which wakes devices
/// without a report. `python/src/runs.rs` calls it.
///
/// # Panics
/// If `external_scenario` has another policy than `external`.
pub fn record(scenario: &Scenario, external_scenario: &Scenario) -> Option<RecordedActions> {
    let prepared = prepare(scenario);
    if prepared.policy(&prepared.knowledge()).oracle().is_some() {
        return None;
    }
    let mut commands = CommandObserver::default();
    let policy_outcome = Run::new(&prepared, RunOptions::default()).finish(&mut commands);
    let mut environment = Environment::new(EpisodeTemplate::new(external_scenario), RewardWeights::default());
    let (mut rows, mut stages) = (Vec::new(), Vec::new());
    // The position in the wake-ups of the open TTI.
    let mut next_wake_up = 0;
    while let Some(request) = environment.pending_decision() {
        let (now, n) = (request.observation.now, request.observation.known.n());
        let action: Vec<bool> = match request.stage {
            DecisionStage::Plan => {
                next_wake_up = 0;
                // A plan holds until the next one, and each run starts with a plan in TTI 0.
                let (_, plan) = commands.plans.range(..=now.0).next_back().expect("a plan in TTI 0");
                (0..n as u32).map(|j| plan.duty_cycle(DeviceId(j)).is_on(now)).collect()
            }
            DecisionStage::Wake => {
                // One device per step, because one action wakes its devices in the order of ids. After the last device
                // the action is empty, which ends the wake-ups of the TTI.
                let woken_device = commands
                    .wake_ups
                    .get(&now.0)
                    .and_then(|devices| devices.get(next_wake_up));
                next_wake_up += 1;
                (0..n)
                    .map(|j| woken_device.is_some_and(|device| device.index() == j))
                    .collect()
            }
        };
        stages.push(i8::from(request.stage == DecisionStage::Wake));
        rows.extend(action.iter().map(|on| i8::from(*on)));
        environment.step(|j| action[j]);
    }
    Some(RecordedActions {
        rows,
        stages,
        policy_outcome,
        environment_outcome: environment.outcome(),
    })
}

#[cfg(test)]
mod tests;
