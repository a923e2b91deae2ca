//! External inputs that a run has not reached yet: device removals, decisions of an external policy, and actions of
//! operators. A resumed or replayed run fills the queue from an input log, and operators add actions. The
//! [`Session`](super::Session) takes each input when it is due. `lab/src/external_inputs/mod.rs` has the format of the
//! log.

use std::collections::VecDeque;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRemoval, OperatorAction};

use crate::policy::external::{Decision, PlanDecision, RecordedDecision};

/// External inputs that are still to come, each kind in the order in which it takes effect. A removal or decision whose
/// TTI passes without use stays and blocks the later ones; shells compare the counts after the run.
#[derive(Clone, Debug, Default)]
pub struct InputQueue {
    removals: VecDeque<DeviceRemoval>,
    decisions: VecDeque<RecordedDecision>,
    /// Actions in the order of their TTIs; actions of the same TTI in the order in which they were added.
    actions: VecDeque<OperatorAction>,
}

impl InputQueue {
    /// Appends a removal that takes effect after all others in the queue.
    pub fn push_removal(&mut self, removal: DeviceRemoval) {
        self.removals.push_back(removal);
    }

    /// Appends a decision that takes effect after all others in the queue.
    pub fn push_decision(&mut self, decision: RecordedDecision) {
        self.decisions.push_back(decision);
    }

    /// Adds an action, after the others of its TTI. If that TTI has begun, the action takes effect in the next grant.
    pub fn add_action(&mut self, action: OperatorAction) {
        let index = self.actions.partition_point(|other| other.tti <= action.tti);
        self.actions.insert(index, action);
    }

    /// Number of removals that have not taken effect.
    pub fn removal_count(&self) -> usize {
        self.removals.len()
    }

    /// Number of decisions that no request has used.
    pub fn decision_count(&self) -> usize {
        self.decisions.len()
    }

    /// The TTI of the next decision.
    pub fn next_decision_tti(&self) -> Option<Tti> {
        self.decisions.front().map(|next| next.tti)
    }

    /// The TTI of the next removal, [`Tti::NEVER`] after the last.
    pub(super) fn next_removal_tti(&self) -> Tti {
        self.removals.front().map_or(Tti::NEVER, |removal| removal.tti)
    }

    /// The TTI of the next action, [`Tti::NEVER`] after the last.
    pub(super) fn next_operator_action_tti(&self) -> Tti {
        self.actions.front().map_or(Tti::NEVER, |action| action.tti)
    }

    /// Takes the changes that are due at the start of TTI `k`, or were due before.
    pub(super) fn take_changes(&mut self, k: Tti) -> Vec<Change> {
        let due = std::iter::from_fn(|| self.actions.pop_front_if(|next| next.tti <= k));
        due.map(|action| action.change).collect()
    }

    /// Takes the next removal if it is due in TTI `k`: before sensing, or before the wake-up with this number.
    pub(super) fn take_removal(&mut self, k: Tti, wake_up: Option<u32>) -> Option<DeviceRemoval> {
        self.removals
            .pop_front_if(|next| next.tti == k && next.wake_ups == wake_up)
    }

    /// Takes the next decision if it is the plan of TTI `k`.
    pub(super) fn take_plan(&mut self, k: Tti) -> Option<PlanDecision> {
        let is_due = |next: &mut RecordedDecision| next.tti == k && matches!(next.decision, Decision::Plan(_));
        match self.decisions.pop_front_if(is_due)?.decision {
            Decision::Plan(plan_decision) => Some(plan_decision),
            Decision::Wake(_) => None,
        }
    }

    /// Takes the next decision if it lists devices to wake in TTI `k`.
    pub(super) fn take_wake_ups(&mut self, k: Tti) -> Option<Vec<DeviceId>> {
        let is_due = |next: &mut RecordedDecision| next.tti == k && matches!(next.decision, Decision::Wake(_));
        match self.decisions.pop_front_if(is_due)?.decision {
            Decision::Wake(devices) => Some(devices),
            Decision::Plan(_) => None,
        }
    }
}
