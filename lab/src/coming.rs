//! What is to come in a run that does not follow from its scenario: outages, and decisions from outside.

use std::collections::VecDeque;

use reveille_bs::policy::external::{Answer, Answered, Decision};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Outage;

use crate::inputs::{Input, Inputs};

/// What has not come yet, in the order in which it does.
#[derive(Clone, Debug, Default)]
pub struct Coming {
    outages: VecDeque<Outage>,
    decisions: VecDeque<Answered>,
}

impl Coming {
    /// One more, after all of its kind that were added before.
    pub fn add(&mut self, input: Input) {
        match input {
            Input::Outage(outage) => self.outages.push_back(outage),
            Input::Decision(decision) => self.decisions.push_back(decision),
        }
    }

    /// These, after all that were added before.
    pub fn add_all(&mut self, inputs: &Inputs) {
        self.outages.extend(&inputs.outages);
        self.decisions.extend(inputs.decisions.iter().cloned());
    }

    /// The TTI in which the next outage comes, [`Tti::NEVER`] after the last.
    pub fn next_outage(&self) -> Tti {
        self.outages.front().map_or(Tti::NEVER, |outage| outage.tti)
    }

    /// Whether all outages have come.
    pub fn has_no_outage(&self) -> bool {
        self.outages.is_empty()
    }

    /// The decisions that have not come; they will not.
    pub fn take_decisions(&mut self) -> Vec<Answered> {
        std::mem::take(&mut self.decisions).into()
    }

    /// The next outage, if it comes in TTI `k` before anybody senses, or before the wake-up with this number in it.
    pub fn outage(&mut self, k: Tti, wake_up: Option<u32>) -> Option<Outage> {
        let is_due = |next: &&Outage| next.tti == k && next.wake_ups == wake_up;
        self.outages.front().filter(is_due)?;
        self.outages.pop_front()
    }

    /// The next decision, if it is the plan of TTI `k`.
    pub fn plan(&mut self, k: Tti) -> Option<Decision> {
        let next = self
            .decisions
            .pop_front_if(|next| next.tti == k && matches!(next.answer, Answer::Plan(_)))?;
        match next.answer {
            Answer::Plan(decision) => Some(decision),
            Answer::Wake(_) => None,
        }
    }

    /// The next decision, if it says whom to wake in TTI `k`.
    pub fn whom(&mut self, k: Tti) -> Option<Vec<DeviceId>> {
        let next = self
            .decisions
            .pop_front_if(|next| next.tti == k && matches!(next.answer, Answer::Wake(_)))?;
        match next.answer {
            Answer::Wake(devices) => Some(devices),
            Answer::Plan(_) => None,
        }
    }
}
