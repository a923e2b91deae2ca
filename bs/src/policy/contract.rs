//! What a policy answers.

use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;

use crate::beliefs::posterior::Belief;
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

    /// Whether it may wake devices, so that [`Observation::can_report`] is worth finding out.
    fn wakes(&self) -> bool {
        true
    }

    /// What the run has taught a policy that learns in it.
    fn learned(&self) -> Option<Opaque> {
        None
    }

    /// The group that each device is in, in the order of ids, of a policy that groups them by place.
    fn groups(&self) -> Option<&[u32]> {
        None
    }

    /// Where it believes the event to be that was reported last, where it has such a belief.
    fn belief(&self) -> Option<&Belief> {
        None
    }

    /// What the last wake-up brought.
    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>);
}

/// Something that only the policy it belongs to can read: what pilot runs have found for it, or what it has learned.
#[derive(Clone, Debug)]
pub struct Opaque(Arc<dyn Content>);

/// What can be put into an [`Opaque`].
trait Content: Any + Debug + Send + Sync {
    /// Whether `other` is of the same type and equal.
    fn is_same(&self, other: &dyn Any) -> bool;
}

impl<T: Any + Debug + PartialEq + Send + Sync> Content for T {
    fn is_same(&self, other: &dyn Any) -> bool {
        other.downcast_ref::<T>() == Some(self)
    }
}

impl Opaque {
    /// `value`, to be read by those who know its type.
    pub fn new(value: impl Any + Debug + PartialEq + Send + Sync) -> Self {
        Self(Arc::new(value))
    }

    /// The value if it is a `T`.
    pub fn get<T: Any>(&self) -> Option<&T> {
        let any: &dyn Any = &*self.0;
        any.downcast_ref()
    }
}

impl PartialEq for Opaque {
    fn eq(&self, other: &Self) -> bool {
        self.0.is_same(&*other.0)
    }
}
