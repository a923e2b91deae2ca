//! Adjusted duty cycling (Sec. V-A, first approach): one (t_on, t_DRX) for all devices, found by exhaustive search for
//! the deployment, with offsets that are staggered in an order drawn once; after a report any sleeping device may be
//! woken, most correlated first, until Î ≥ I_min.
//!
//! The search runs the devices too, so whoever drives both sides makes the pilot runs; what they bring is judged in
//! [`search`], and the policy is handed what was found.

pub mod search;
pub mod settings;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site};

use self::search::{DutyChoice, Search};
use self::settings::AdjustedSettings;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use super::pilots::Pilots;
use crate::beliefs::aim::Aim;
use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `adjusted` policy.
pub struct Adjusted {
    choice: DutyChoice,
    /// The turn of each device, `0 .. N`. In the order of numbers neighbours on a regular layout would take theirs
    /// together, and leave the rest of the area blind meanwhile.
    turns: Vec<u32>,
    aim: Aim,
}

impl Adjusted {
    /// The policy with the duty cycle that the search has found.
    pub fn new(known: &Knowledge, choice: DutyChoice) -> Self {
        let mut turns: Vec<u32> = (0..known.n() as u32).collect();
        known.streams.stream(PolicyPurpose::Offsets, 0).shuffle(&mut turns);
        Self {
            choice,
            turns,
            aim: Aim::new(known),
        }
    }
}

impl Policy for Adjusted {
    fn decide(&mut self, _: &Observation<'_>) -> Plan {
        let DutyChoice { t_on, t_drx, .. } = self.choice;
        let cycle = |turn: &u32| DutyCycle {
            t_on,
            t_drx,
            offset: turn % t_drx,
        };
        Plan::Periodic(self.turns.iter().map(cycle).collect())
    }

    fn next_decision(&self, _: Tti) -> Tti {
        Tti::NEVER
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.aim.start(seen, reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        self.aim.next(seen, |_| true)
    }

    fn belief(&self) -> Option<&Belief> {
        self.aim.belief()
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.aim.answered(seen, report);
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        let DutyChoice {
            t_on,
            t_drx,
            reaches_i_min,
            pairs,
            pilot_events,
            pilot_ttis,
            device_ttis,
        } = self.choice;
        vec![
            ("t_on", f64::from(t_on)),
            ("t_drx", f64::from(t_drx)),
            ("i_min", self.aim.i_min()),
            ("reaches_i_min", f64::from(u8::from(reaches_i_min))),
            ("searched_pairs", f64::from(pairs)),
            ("pilot_events", pilot_events as f64),
            ("pilot_ttis", pilot_ttis as f64),
            ("searched_device_ttis", device_ttis as f64),
        ]
    }
}

/// The policy `adjusted`.
#[derive(Clone, Copy, Debug)]
pub struct AdjustedKind;

impl PolicyKind for AdjustedKind {
    fn name(&self) -> &'static str {
        "adjusted"
    }

    fn about(&self) -> &'static str {
        "One duty cycle for all devices, found by exhaustive search in pilot runs; wakes any \
         device, most correlated first."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(AdjustedSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, _: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(AdjustedSettings::settle(reader)?))
    }
}

impl Registered for AdjustedKind {
    fn profile(&self) -> Profile {
        Profile {
            runtime: "O(ϱ^N)",
            wakes: true,
            heeds_ranking: true,
            ..Profile::plain(1)
        }
    }

    fn pilots(&self, choice: &PolicyChoice) -> Option<Box<dyn Pilots>> {
        Some(Box::new(Search(own::<AdjustedSettings>(choice).clone())))
    }

    fn build(&self, _: &PolicyChoice, known: &Knowledge, findings: Option<&Opaque>) -> Mind {
        let choice = findings.and_then(Opaque::get).copied();
        Mind::of(Adjusted::new(
            known,
            choice.expect("the duty cycle is searched before a run"),
        ))
    }
}
