//! Who decides for a base station: a policy, the genie, or somebody outside.

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::world::Oracle;

use super::contract::{Opaque, Policy};
use super::external::External;
use crate::observation::Observation;

/// What no base station could run, since it is told where events are: a bound on what policies reach.
pub trait Bound: Oracle + Send {
    /// δ for the whole run.
    fn plan(&self) -> Plan;

    /// Whom to wake in this TTI, or nobody else.
    fn next_wake_up(&mut self) -> Option<DeviceId>;

    /// What the last wake-up brought.
    fn answered(&mut self, report: Option<&Report>);
}

/// Who decides for a base station. Ground truth reaches the genie alone, by construction.
pub enum Mind {
    /// Any policy that could run in a real BS.
    Policy(Box<dyn Policy>),
    /// An upper bound.
    Genie(Box<dyn Bound>),
    /// Somebody outside, who is asked.
    External(Box<External>),
}

impl Mind {
    /// The mind of a policy.
    pub fn of(policy: impl Policy + 'static) -> Self {
        Self::Policy(Box::new(policy))
    }

    /// The genie, if it is one.
    pub fn genie(&mut self) -> Option<&mut dyn Bound> {
        match self {
            Self::Policy(_) | Self::External(_) => None,
            Self::Genie(genie) => Some(&mut **genie),
        }
    }

    /// Somebody outside, if it is one.
    pub const fn external(&self) -> Option<&External> {
        match self {
            Self::External(external) => Some(external),
            Self::Policy(_) | Self::Genie(_) => None,
        }
    }

    /// δ from this TTI on.
    pub fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        match self {
            Self::Policy(policy) => policy.decide(seen),
            Self::Genie(genie) => genie.plan(),
            Self::External(external) => external.decide(seen),
        }
    }

    /// See [`Policy::facts`].
    pub fn facts(&self) -> Vec<(&'static str, f64)> {
        match self {
            Self::Policy(policy) => policy.facts(),
            Self::Genie(_) | Self::External(_) => Vec::new(),
        }
    }

    /// See [`Policy::looks_at_batteries`].
    pub fn looks_at_batteries(&self) -> bool {
        match self {
            Self::Policy(policy) => policy.looks_at_batteries(),
            Self::Genie(_) => false,
            Self::External(_) => true,
        }
    }

    /// See [`Policy::wakes`]. The genie knows whom it wakes.
    pub fn wakes(&self) -> bool {
        match self {
            Self::Policy(policy) => policy.wakes(),
            Self::Genie(_) => false,
            Self::External(_) => true,
        }
    }

    /// See [`Policy::learned`].
    pub fn learned(&self) -> Option<Opaque> {
        match self {
            Self::Policy(policy) => policy.learned(),
            Self::Genie(_) | Self::External(_) => None,
        }
    }

    /// See [`Policy::groups`].
    pub fn groups(&self) -> Option<&[u32]> {
        match self {
            Self::Policy(policy) => policy.groups(),
            Self::Genie(_) | Self::External(_) => None,
        }
    }

    /// See [`Policy::next_decision`].
    pub fn next_decision(&self, now: Tti) -> Tti {
        match self {
            Self::Policy(policy) => policy.next_decision(now),
            Self::Genie(_) => Tti::NEVER,
            Self::External(external) => external.next_decision(),
        }
    }
}
