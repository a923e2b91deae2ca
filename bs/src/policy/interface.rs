//! The interface between a policy and the base station: [`Policy`]. The base station (`base_station.rs`) calls it;
//! every policy of [`POLICIES`](super::registry::POLICIES) implements it, and `docs/policy-interface.md` explains it.
//! `dt/record.rs` wraps a policy and must forward every call: a new method with a default compiles without a line there
//! and would be ignored in recordings.

use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::world::Oracle;

use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// A policy, which decides which devices sense and which to wake. It has the knowledge of a base station. Only
/// [`Self::decide`] is required.
///
/// Calls in a TTI: [`Self::decide`] and [`Self::next_decision`] if a decision is due; [`Self::reports_received`] if
/// reports arrive; then [`Self::next_wake_up`] and [`Self::take_wake_up_answer`] in turn until no device is named.
/// Without a report, only a policy with an [`Self::oracle`] is asked for wake-ups.
pub trait Policy: Any + Send {
    /// Decides δ from this TTI on. The base station calls it in TTI 0 and whenever [`Self::next_decision`] is reached.
    fn decide(&mut self, seen: &Observation<'_>) -> Plan;

    /// Returns the TTI of the next decision, after `now`; [`Tti::NEVER`] if the plan never changes. Until then the base
    /// station can grant many TTIs together.
    fn next_decision(&self, now: Tti) -> Tti {
        now + 1
    }

    /// Receives the first `reports` of an event, at least one, in the order of device ids.
    fn reports_received(&mut self, _seen: &Observation<'_>, _reports: &[Report]) {}

    /// Returns the next device to wake in this TTI, or `None`. A run panics if a policy names a device twice in a TTI,
    /// or a device that does not exist.
    fn next_wake_up(&mut self, _seen: &Observation<'_>) -> Option<DeviceId> {
        None
    }

    /// Receives the answer to the last wake-up: a report, or `None`. `seen` already includes its information.
    fn take_wake_up_answer(&mut self, _seen: &Observation<'_>, _report: Option<&Report>) {}

    /// Returns figures about the deployment or the run, by name. The names are keys of `summary.json`.
    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }

    /// Whether the policy needs [`Observation::batteries`].
    fn needs_batteries(&self) -> bool {
        false
    }

    /// Whether the policy calls [`Observation::can_report`], which needs a battery estimate of each device.
    fn needs_battery_estimates(&self) -> bool {
        true
    }

    /// Returns the state that a learning policy has reached in the run.
    fn learned_state(&self) -> Option<LearnedState> {
        None
    }

    /// Returns the group of each device, in the order of ids, if the policy groups devices by place; for display and
    /// the records of devices.
    fn device_groups(&self) -> Option<&[u32]> {
        None
    }

    /// Returns the belief over the place of the last reported event, if the policy has one.
    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        None
    }

    /// Changes the price θ from the next decision on. `bs/src/actions.rs` allows this under `age-index` alone, so all
    /// other policies may ignore it.
    fn set_price(&mut self, _known: &Knowledge, _price: f64) {}

    /// Gives access to ground truth, which makes the policy an upper bound that no base station could run. The plans of
    /// such a policy must let all devices sleep, because the world then simulates no detections.
    fn oracle(&mut self) -> Option<&mut dyn Oracle> {
        None
    }
}

/// The state of a learning policy, of a type that only the policy and its training (`lab/src/training/`) know.
#[derive(Clone, Debug)]
pub struct LearnedState(Arc<dyn StateValue>);

/// Value that a [`LearnedState`] can hold, comparable without knowing its type.
trait StateValue: Any + Debug + Send + Sync {
    /// Returns whether `other` is of the same type and equal.
    fn has_same_type_and_value(&self, other: &dyn Any) -> bool;
}

impl<T: Any + Debug + PartialEq + Send + Sync> StateValue for T {
    fn has_same_type_and_value(&self, other: &dyn Any) -> bool {
        other.downcast_ref::<T>() == Some(self)
    }
}

impl LearnedState {
    /// Wraps `value`, which can be read by its type.
    pub fn new(value: impl Any + Debug + PartialEq + Send + Sync) -> Self {
        Self(Arc::new(value))
    }

    /// Returns the value if it is a `T`.
    pub fn get<T: Any>(&self) -> Option<&T> {
        let any: &dyn Any = &*self.0;
        any.downcast_ref()
    }
}

impl PartialEq for LearnedState {
    fn eq(&self, other: &Self) -> bool {
        self.0.has_same_type_and_value(&*other.0)
    }
}
