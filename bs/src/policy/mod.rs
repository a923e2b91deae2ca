//! Who senses, and whom to wake.
//!
//! A policy answers with a δ plan and says when it next wants to decide; when a report has come it names one sleeping
//! device after another to be woken. To add one: a file here, a variant of
//! [`reveille_common::scenario::PolicyConfig`], and an arm in [`PolicyEngine::new`].

mod adjusted;
mod genie;
mod knn;
mod q_learning;
mod random;

use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::learned::Entry;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::{PolicyConfig, Scenario};

use crate::observation::Observation;

pub use adjusted::Adjusted;
pub use genie::Genie;
pub use knn::Knn;
pub use q_learning::QLearning;
pub use random::Random;

/// A policy that knows what a BS can know.
pub trait Policy: Send {
    /// δ from this TTI on; called in TTI 0 and whenever [`Self::next_decision`] is reached.
    fn decide(&mut self, seen: &Observation<'_>) -> Plan;

    /// The first TTI after `now` in which the policy wants to decide again; [`Tti::NEVER`] where its plan holds for good.
    /// Until then the clock may grant many TTIs at once.
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

/// A policy as the cycle drives it. Ground truth reaches the genie alone, by construction.
pub enum PolicyEngine {
    /// Any policy that could run in a real BS.
    Blind(Box<dyn Policy>),
    /// The upper bound.
    Genie(Genie),
}

impl PolicyEngine {
    /// The policy that `scenario` names, for the devices of `deployment`.
    pub fn new(scenario: &Scenario, deployment: &Deployment) -> Self {
        let positions = &deployment.positions();
        match &scenario.policy {
            PolicyConfig::Knn(settings) => Self::Blind(Box::new(Knn::new(scenario, settings, positions))),
            PolicyConfig::Adjusted(settings) => Self::Blind(Box::new(Adjusted::new(scenario, settings, positions))),
            PolicyConfig::QLearning(settings) => Self::Blind(Box::new(QLearning::new(scenario, settings, deployment))),
            PolicyConfig::Random => Self::Blind(Box::new(Random::new(scenario))),
            PolicyConfig::Genie => Self::Genie(Genie::new(scenario, positions)),
        }
    }

    /// δ from this TTI on.
    pub fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        match self {
            Self::Blind(policy) => policy.decide(seen),
            Self::Genie(genie) => genie.plan(),
        }
    }

    /// See [`Policy::facts`].
    pub fn facts(&self) -> Vec<(&'static str, f64)> {
        match self {
            Self::Blind(policy) => policy.facts(),
            Self::Genie(_) => Vec::new(),
        }
    }

    /// See [`Policy::looks_at_batteries`].
    pub fn looks_at_batteries(&self) -> bool {
        match self {
            Self::Blind(policy) => policy.looks_at_batteries(),
            Self::Genie(_) => false,
        }
    }

    /// See [`Policy::learned`].
    pub fn learned(&self) -> Option<Entry> {
        match self {
            Self::Blind(policy) => policy.learned(),
            Self::Genie(_) => None,
        }
    }

    /// See [`Policy::next_decision`].
    pub fn next_decision(&self, now: Tti) -> Tti {
        match self {
            Self::Blind(policy) => policy.next_decision(now),
            Self::Genie(_) => Tti::NEVER,
        }
    }
}
