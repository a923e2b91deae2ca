//! The random benchmark (Sec. VI): every device draws its own duty cycle once; nobody is woken.

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::{NoSettings, PolicyChoice, PolicyKind, PolicySettings, Site};

use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered};
use super::mind::Mind;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// Lengths of t_on that a device draws from, TTIs.
const T_ON: [u32; 2] = [1, 2];
/// Lengths of t_DRX that a device draws from, TTIs.
const T_DRX: [u32; 3] = [2, 4, 8];

/// The `random` policy.
#[derive(Clone, Debug)]
pub struct Random {
    cycles: Vec<DutyCycle>,
}

impl Random {
    /// Draws the duty cycles of all devices.
    pub fn new(known: &Knowledge) -> Self {
        let draw = |j: u32| {
            let mut stream = known.streams.stream(PolicyPurpose::DutyCycle, u64::from(j));
            let t_on = T_ON[stream.below(T_ON.len() as u64) as usize];
            let t_drx = T_DRX[stream.below(T_DRX.len() as u64) as usize];
            DutyCycle {
                t_on,
                t_drx,
                offset: stream.below(u64::from(t_drx)) as u32,
            }
        };
        Self {
            cycles: (0..known.n() as u32).map(draw).collect(),
        }
    }
}

impl Policy for Random {
    fn decide(&mut self, _: &Observation<'_>) -> Plan {
        Plan::Periodic(self.cycles.clone())
    }

    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    fn wakes(&self) -> bool {
        false
    }

    fn reported(&mut self, _: &Observation<'_>, _: &[Report]) {}

    fn next_wake_up(&mut self, _: &Observation<'_>) -> Option<DeviceId> {
        None
    }

    fn answered(&mut self, _: &Observation<'_>, _: Option<&Report>) {}
}

/// The policy `random`.
#[derive(Clone, Copy, Debug)]
pub struct RandomKind;

impl PolicyKind for RandomKind {
    fn name(&self) -> &'static str {
        "random"
    }

    fn about(&self) -> &'static str {
        "Each device draws its own duty cycle once; nobody is woken (Sec. VI)."
    }

    fn settle(&self, _: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(NoSettings))
    }
}

impl Registered for RandomKind {
    fn profile(&self) -> Profile {
        Profile::plain(2)
    }

    fn build(&self, _: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(Random::new(known))
    }
}
