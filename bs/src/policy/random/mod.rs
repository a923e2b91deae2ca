//! The random benchmark (Sec. VI): every device draws its own duty cycle once; nobody is woken.

pub mod settings;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site};

use self::settings::RandomSettings;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `random` policy.
#[derive(Clone, Debug)]
pub struct Random {
    cycles: Vec<DutyCycle>,
}

impl Random {
    /// Draws the duty cycles of all devices.
    pub fn new(known: &Knowledge, settings: &RandomSettings) -> Self {
        let RandomSettings { t_on, t_drx } = settings;
        let draw = |j: u32| {
            let mut stream = known.streams.stream(PolicyPurpose::DutyCycle, u64::from(j));
            let t_on = t_on[stream.below(t_on.len() as u64) as usize];
            let t_drx = t_drx[stream.below(t_drx.len() as u64) as usize];
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

    fn section(&self) -> Option<&'static Section> {
        Some(RandomSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(RandomSettings::settle(reader)?))
    }
}

impl Registered for RandomKind {
    fn profile(&self) -> Profile {
        Profile::plain(2)
    }

    fn build(&self, choice: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(Random::new(known, own(choice)))
    }
}
