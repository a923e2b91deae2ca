//! Decisions of a policy process, and the context that it receives for them: the types between the `external` policy,
//! the messages ([`super::wire`]), environments in memory (`lab/src/gym/`) and logged decisions
//! (`lab/src/external_inputs/mod.rs`). The types are not serialised.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;

use super::history::ReportHistory;
use crate::observation::Observation;

/// Stage of a decision. Environments and the texts of features call the stages 0 and 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DecisionStage {
    /// Stage 0: the δ plan from the coming TTI on.
    Plan,
    /// Stage 1: the devices to wake in a TTI with reports.
    Wake,
}

/// A requested decision, with everything that a base station knows for it.
#[derive(Clone, Copy, Debug)]
pub struct DecisionContext<'a> {
    /// Stage of the decision.
    pub stage: DecisionStage,
    /// Observation of a policy. At [`DecisionStage::Plan`], [`Observation::now`] is the coming TTI and
    /// [`Observation::plan`] the plan of the previous one.
    pub observation: Observation<'a>,
    /// Reports of the last TTI with reports: the first ones by device id, then the answers to wake-ups in their order.
    /// At [`DecisionStage::Wake`] that is this TTI.
    pub reports: &'a [Report],
    /// By device, whether it was woken in the TTI of [`Self::reports`], with or without an answer. Its length is N.
    pub woken: &'a [bool],
    /// History of the run before this decision.
    pub history: &'a ReportHistory,
}

impl DecisionContext<'_> {
    /// Returns N.
    pub const fn device_count(&self) -> usize {
        self.woken.len()
    }

    /// Returns whether a decision can wake `device`: at [`DecisionStage::Wake`], if the device exists, sleeps in this
    /// TTI and has not been woken in it yet.
    pub fn may_wake(&self, device: DeviceId) -> bool {
        match self.stage {
            DecisionStage::Plan => false,
            DecisionStage::Wake => may_wake(&self.observation, self.woken, device),
        }
    }
}

/// Returns whether `device` exists, sleeps in the TTI of `seen` and is not among the `woken`.
pub(super) fn may_wake(seen: &Observation<'_>, woken: &[bool], device: DeviceId) -> bool {
    woken.get(device.index()).is_some_and(|woken| !woken) && seen.is_asleep(device)
}

/// A decision at [`DecisionStage::Plan`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanDecision {
    /// The plan. It is fitted to the N devices: entries beyond the last device are dropped. Devices without an entry,
    /// or with a duty cycle out of range, sleep.
    pub plan: Plan,
    /// TTI of the next plan request. A TTI that has passed stands for the next one; on the bus such a reply is refused.
    pub next: Tti,
}

/// A decision of a policy process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// The decision at [`DecisionStage::Plan`].
    Plan(PlanDecision),
    /// At [`DecisionStage::Wake`], the devices to wake, in this order. An empty list ends the wake-ups of the TTI.
    Wake(Vec<DeviceId>),
}

impl Decision {
    /// Returns the stage of the decision.
    pub const fn stage(&self) -> DecisionStage {
        match self {
            Self::Plan(_) => DecisionStage::Plan,
            Self::Wake(_) => DecisionStage::Wake,
        }
    }
}

/// A decision of a policy process, as recorded in the input log of a run: not yet projected on the allowed actions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordedDecision {
    /// TTI of the decision request.
    pub tti: Tti,
    /// The decision.
    pub decision: Decision,
}
