//! The policy `adjusted` (Sec. V-A, first approach): one (t_on, t_DRX) for all devices, found by exhaustive search for
//! the deployment. Offsets are staggered in an order drawn once. After a report any sleeping device can be woken, most
//! correlated first, until Î ≥ I_min.
//!
//! `lab/src/preparation.rs` makes the pilot runs of the search, since they need devices; [`search`] judges them.
//! Digests depend on the drawn order; names of facts are part of `summary.json`. The field `about` of `ADJUSTED` is a
//! line of docs/scenario.md, which a test compares, and of the help.

pub mod search;
pub mod settings;

use std::sync::Arc;

use reveille_common::declare::{FieldSink, Visit};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::{DutyCycle, Plan};
use reveille_common::rng::PolicyPurpose;

use self::search::DutyCycleChoice;
use self::settings::AdjustedSettings;
use super::factory::{PilotSearch, PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::beliefs::information_target::InformationTarget;
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `adjusted` policy.
pub struct Adjusted {
    choice: DutyCycleChoice,
    /// Turn of each device, `0 .. N`, in random order. In the order of ids, neighbours on a regular layout would sense
    /// together and leave the rest of the area blind.
    turns: Vec<u32>,
    information_target: InformationTarget,
}

impl Adjusted {
    /// Creates the policy with the duty cycle that the search has found.
    pub fn new(known: &Knowledge, choice: DutyCycleChoice) -> Self {
        let mut turns: Vec<u32> = (0..known.n() as u32).collect();
        known.streams.stream(PolicyPurpose::Offsets, 0).shuffle(&mut turns);
        Self {
            choice,
            turns,
            information_target: InformationTarget::new(known),
        }
    }
}

impl Policy for Adjusted {
    fn decide(&mut self, _seen: &Observation<'_>) -> Plan {
        let DutyCycleChoice { t_on, t_drx, .. } = self.choice;
        let cycle = |turn: &u32| DutyCycle {
            t_on,
            t_drx,
            offset: turn % t_drx,
        };
        Plan::Periodic(self.turns.iter().map(cycle).collect())
    }

    fn next_decision(&self, _now: Tti) -> Tti {
        Tti::NEVER
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.information_target.start_event(seen, reports);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        self.information_target.next_device(seen, |_| true)
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.information_target.belief()
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.information_target.add_wake_up_answer(seen, report);
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        let DutyCycleChoice {
            t_on,
            t_drx,
            reaches_i_min,
            searched_pairs,
            fewest_pilot_events,
            pilot_ttis,
            device_ttis,
        } = self.choice;
        vec![
            ("t_on", f64::from(t_on)),
            ("t_drx", f64::from(t_drx)),
            ("i_min", self.information_target.i_min()),
            ("reaches_i_min", f64::from(u8::from(reaches_i_min))),
            ("searched_pairs", f64::from(searched_pairs)),
            ("pilot_events", fewest_pilot_events as f64),
            ("pilot_ttis", pilot_ttis as f64),
            ("searched_device_ttis", device_ttis as f64),
        ]
    }
}

/// The policy `adjusted`. The text is part of docs/scenario.md.
pub(crate) const ADJUSTED: PolicyEntry = PolicyEntry {
    about: "One duty cycle for all devices, found by exhaustive search in pilot runs. Wakes any \
            device, the most correlated first.",
    heeds_ranking: true,
    runtime: "O(ϱ^N)",
    ..PolicyEntry::new(AdjustedSettings::SECTION, |reader, _| {
        Ok(Arc::new(AdjustedSettings::from_fields(reader)?))
    })
};

impl PolicyFactory for AdjustedSettings {
    /// # Panics
    /// Always: the search in pilot runs returns the factory to build with.
    fn build(&self, _known: &Knowledge) -> Box<dyn Policy> {
        panic!("the duty cycle is searched before a run")
    }

    fn pilot_search(&self) -> Option<PilotSearch> {
        Some(search::pilot_search(self))
    }

    fn pilot_ttis(&self) -> Option<(&'static str, u64)> {
        // Only this length must fit the sums of energy: the extension up to `pilot_limit` stops where they would
        // overflow.
        Some(("policy.adjusted.pilot_ttis", self.pilot_ttis))
    }
}

impl Visit for DutyCycleChoice {
    /// Visits nothing: a result of the search is not a setting.
    fn visit(&self, _sink: &mut dyn FieldSink) {}
}

impl PolicyFactory for DutyCycleChoice {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(Adjusted::new(known, *self))
    }
}
