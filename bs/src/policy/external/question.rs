//! What somebody outside is asked, and what is answered.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;

use super::memory::Memory;
use crate::observation::Observation;

/// What is to be decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The δ plan from the coming TTI on.
    Plan,
    /// Whom to wake in a TTI in which something was heard.
    Wake,
}

/// A decision that is asked for, with all that a base station knows for it.
#[derive(Clone, Copy, Debug)]
pub struct Question<'a> {
    /// What is to be decided.
    pub stage: Stage,
    /// What a policy would see. At [`Stage::Plan`], [`Observation::now`] is the coming TTI and [`Observation::plan`]
    /// the plan of the one before.
    pub seen: Observation<'a>,
    /// The reports of the TTI in which something was heard last, in the order in which they came. At [`Stage::Wake`]
    /// that is this TTI.
    pub heard: &'a [Report],
    /// By device, whether it was woken in the TTI of [`Self::heard`], with a report or without.
    pub woken: &'a [bool],
    /// What was noticed before.
    pub memory: &'a Memory,
}

impl Question<'_> {
    /// Whether a wake-up of `device` can be answered with: at [`Stage::Wake`], if there is such a device, it was told
    /// to sleep in this TTI, and it was not woken in it yet.
    pub fn may_wake(&self, device: DeviceId) -> bool {
        match self.stage {
            Stage::Plan => false,
            Stage::Wake => may_wake(&self.seen, self.woken, device),
        }
    }
}

pub(super) fn may_wake(seen: &Observation<'_>, woken: &[bool], device: DeviceId) -> bool {
    woken.get(device.index()).is_some_and(|woken| !woken) && seen.is_asleep(device)
}

/// An answer at [`Stage::Plan`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Decision {
    /// The plan. It is fitted to the devices: those beyond the last are left out, and those that it does not reach, or
    /// whose duty cycle is out of range, sleep.
    pub plan: Plan,
    /// The first TTI in which to be asked again; one that has passed stands for the next.
    pub next: Tti,
}

/// What somebody outside has answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// At [`Stage::Plan`].
    Plan(Decision),
    /// At [`Stage::Wake`]: whom to wake, one after the other in this order; nobody ends the wake-ups of the TTI.
    Wake(Vec<DeviceId>),
}

impl Answer {
    /// What it answers.
    pub const fn stage(&self) -> Stage {
        match self {
            Self::Plan(_) => Stage::Plan,
            Self::Wake(_) => Stage::Wake,
        }
    }
}

/// A decision that somebody outside has made in a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answered {
    /// The TTI of the question.
    pub tti: Tti,
    /// What was answered.
    pub answer: Answer,
}
