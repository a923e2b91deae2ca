//! Looking where nobody has looked for long, while that is worth the energy: no learning, no beat, one knob.
//!
//! Each place of the area has an age ([`crate::beliefs::ages`]): the TTIs in which an event may have begun there and
//! gone unnoticed. What a device would look at is worth the sum over its places of their ages' index a(a + 1)/2, as far
//! as nobody who is chosen looks at them already ([`ages::choice`]). A TTI in S1 has a price, the only knob, dearer for
//! a device whose battery is low ([`ages::price`]), or will be, if it is to look ahead ([`ages::foresight`]).
//!
//! Wake-ups go by the belief over the event's place, whatever `bs.ranking` says, which begins with what the ages tell:
//! an event that is found at last may have begun in any TTI of the place's age, so a place of twice the age is twice as
//! likely. The best candidate is woken while it is expected to bring enough.

pub mod settings;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site, WakeUpRanking};

use self::settings::AgeIndexSettings;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use super::tally::Tally;
use crate::beliefs::ages::choice::Choice;
use crate::beliefs::ages::foresight::Foresight;
use crate::beliefs::ages::price::Prices;
use crate::beliefs::ages::{self, Ages};
use crate::beliefs::candidates::{Candidates, LEAST_GAIN};
use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `age-index` policy.
pub struct AgeIndex {
    ages: Ages,
    prices: Prices,
    foresight: Option<Foresight>,
    choice: Choice,
    candidates: Candidates,
    /// Whether an event was reported in the TTI that was decided on last.
    is_found: bool,
    tally: Tally,
}

impl AgeIndex {
    /// The policy for the devices in `known`.
    pub fn new(known: &Knowledge, settings: &AgeIndexSettings) -> Self {
        let positions = known.positions();
        let ages = Ages::losing(
            known.radio.silence(),
            &positions,
            known.area,
            &known.sensing,
            ages::worths(),
        );
        // What the device's own places are worth at age 1, in the unit of worths.
        let reach = ages::reach(&known.sensing) / ages.cell_surface();
        Self {
            prices: Prices::new(known, settings.price * reach),
            foresight: settings.foresight.map(|ttis| Foresight::new(known, ttis)),
            choice: Choice::new(&positions, known.area, known.sensing.d_max),
            candidates: Candidates::by(WakeUpRanking::Posterior, known),
            ages,
            is_found: false,
            tally: Tally::default(),
        }
    }
}

impl Policy for AgeIndex {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        if seen.now > Tti::ZERO {
            self.ages.pass(std::mem::take(&mut self.is_found));
        }
        let prices = match &mut self.foresight {
            None => self.prices.at(seen.batteries),
            Some(foresight) => self.prices.ahead(seen.batteries, foresight.of(seen)),
        };
        let mut chosen = self.choice.choose(&mut self.ages, prices);
        chosen.sort_unstable();
        self.tally.plan(seen.known.n(), &chosen)
    }

    /// Decides in every TTI: places get older.
    fn next_decision(&self, now: Tti) -> Tti {
        now + 1
    }

    fn looks_at_batteries(&self) -> bool {
        true
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.is_found = true;
        let Self { ages, candidates, .. } = self;
        candidates.start_with(seen, reports, |place| ages.at(place));
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let (device, gain) = self.candidates.next(seen, |_| true)?;
        (gain >= LEAST_GAIN * seen.known.sensing.psi).then_some(device)
    }

    fn belief(&self) -> Option<&Belief> {
        self.candidates.belief()
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            let Self { ages, candidates, .. } = self;
            candidates.add_with(seen, report, |place| ages.at(place));
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![self.tally.fact()]
    }
}

/// The policy `age-index`.
#[derive(Clone, Copy, Debug)]
pub struct AgeIndexKind;

impl PolicyKind for AgeIndexKind {
    fn name(&self) -> &'static str {
        "age-index"
    }

    fn about(&self) -> &'static str {
        "Looks where nobody has looked for long, while that is worth the energy; wakes by expected gain. No training."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(AgeIndexSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, site: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(AgeIndexSettings::settle(reader, site)?))
    }
}

impl Registered for AgeIndexKind {
    fn profile(&self) -> Profile {
        Profile {
            wakes: true,
            ..Profile::plain(6)
        }
    }

    fn build(&self, choice: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(AgeIndex::new(known, own(choice)))
    }
}
