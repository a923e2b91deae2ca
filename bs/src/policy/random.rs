//! The policy `random`, the benchmark of Sec. VI: every device draws its own duty cycle once, and no device is woken.
//! Digests depend on the stream of each device and on the order of its draws.

use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{FieldReader, ScenarioError, wholes};
use reveille_common::ids::Tti;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;

use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `random` policy.
#[derive(Clone, Debug)]
pub struct Random {
    cycles: Vec<DutyCycle>,
}

impl Random {
    /// Draws the duty cycles of all devices. `settings` must have passed the checks of [`RandomSettings::from_fields`].
    pub fn new(known: &Knowledge, settings: &RandomSettings) -> Self {
        let draw = |j: u32| {
            // A stream per device, so that a device's cycle does not depend on the number of devices.
            let mut stream = known.streams.stream(PolicyPurpose::DutyCycle, u64::from(j));
            let t_on = settings.t_on[stream.below(settings.t_on.len() as u64) as usize];
            let t_drx = settings.t_drx[stream.below(settings.t_drx.len() as u64) as usize];
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
    fn decide(&mut self, _seen: &Observation<'_>) -> Plan {
        Plan::Periodic(self.cycles.clone())
    }

    fn next_decision(&self, _now: Tti) -> Tti {
        Tti::NEVER
    }

    fn needs_battery_estimates(&self) -> bool {
        false
    }
}

/// The policy `random`.
pub const RANDOM: PolicyEntry = PolicyEntry {
    about: "Each device draws its own duty cycle once; no device is woken (Sec. VI).",
    wakes: false,
    ..PolicyEntry::new(RandomSettings::SECTION, |reader, _| {
        Ok(Arc::new(RandomSettings::from_fields(reader)?))
    })
};

impl PolicyFactory for RandomSettings {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(Random::new(known, self))
    }
}

/// Longest list of t_on or t_DRX to draw from.
const MAX_LIST_LENGTH: usize = 64;

// The fields, in this order, are part of scenario files and their hashes. docs/scenario.md has the doc comments too.
declare! {
    /// Settings of the policy `random` (Sec. VI). The paper does not state the values that devices draw from.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct RandomSettings in "policy.random" {
        /// Values of t_on that a device draws from, each equally likely. None may exceed the shortest of `t_drx`.
        pub t_on: Vec<u32> = wholes(1, DutyCycle::MAX_T_DRX, MAX_LIST_LENGTH, &[1, 2])
            .unit("TTIs")
            .source("by calibration"),
        /// Values of t_DRX that a device draws from, each equally likely.
        pub t_drx: Vec<u32> = wholes(1, DutyCycle::MAX_T_DRX, MAX_LIST_LENGTH, &[2, 4, 8])
            .unit("TTIs")
            .source("by calibration"),
    }
}

impl RandomSettings {
    /// Reads the settings. A test of `bs/src/scenario/tests/messages.rs` compares the second error.
    ///
    /// # Errors
    /// A value is out of range, or a t_on is longer than a t_DRX.
    pub fn from_fields(reader: &FieldReader<'_>) -> Result<Self, ScenarioError> {
        let settings = Self::read(reader)?;
        let shortest = settings.t_drx.iter().min().copied().unwrap_or(1);
        if settings.t_on.iter().any(|&t_on| t_on > shortest) {
            let allowed = format!("must not exceed {shortest}, the shortest of policy.random.t_drx");
            return Err(reader.invalid_value("policy.random.t_on", format!("{:?}", settings.t_on), allowed));
        }
        Ok(settings)
    }
}
