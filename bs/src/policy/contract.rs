//! What a policy answers, and what it may ask to be found out before a run.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;

use super::adjusted::search::DutyChoice;
use super::q_learning::learned::Entry;
use crate::observation::Observation;

/// A policy that knows what a BS can know.
pub trait Policy: Send {
    /// δ from this TTI on; called in TTI 0 and whenever [`Self::next_decision`] is reached.
    fn decide(&mut self, seen: &Observation<'_>) -> Plan;

    /// The first TTI after `now` in which the policy wants to decide again; [`Tti::NEVER`] where its plan holds for
    /// good. Until then the clock may grant many TTIs at once.
    fn next_decision(&self, now: Tti) -> Tti;

    /// The first `reports` of an event have come, at least one, in the order of device ids.
    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]);

    /// The next device to wake in this TTI, or none.
    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId>;

    /// Figures of the deployment that the policy found out, by name, for the summary.
    fn facts(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }

    /// Whether [`Observation::batteries`] is to be filled.
    fn looks_at_batteries(&self) -> bool {
        false
    }

    /// The tables as the run has left them, of a policy that has learned in it.
    fn learned(&self) -> Option<Entry> {
        None
    }

    /// What the last wake-up brought.
    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>);
}

/// What pilot runs have found for a deployment, for a policy that asks for them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Findings {
    /// The duty cycle of the `adjusted` policy.
    pub duty: Option<DutyChoice>,
}
