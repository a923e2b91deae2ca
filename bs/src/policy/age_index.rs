//! The `age-index` policy: covers the places that have been uncovered for long, as long as that is worth the energy. It
//! needs no learning, has no periodic duty cycle and a single parameter.
//!
//! Each place of the area has an age ([`crate::beliefs::ages`]): the TTIs in which an event may have started there
//! unnoticed. The gain of a device is the sum of the index a(a + 1)/2 over its places, as far as no chosen device
//! covers them already ([`ages::selector`]). A TTI in S1 has a price, the only parameter. The price is higher for a
//! device whose battery is low ([`ages::price`]), or with foresight, will be low (`ages::foresight`).
//!
//! Wake-ups use the belief over the place of the event, regardless of `bs.ranking`. The prior of the belief is the age
//! of a place. A newly reported event can have started in any TTI of that age, so a place of twice the age is twice as
//! likely. The best candidate is woken while its expected gain is large enough.
//!
//! `tests/src/reference/age_index.rs` repeats the calculation. An untrained `dt` with `miss_cost = 0` must decide the
//! same: `dt/mod.rs` repeats the order of calls, and `dt/settings.rs` the default price.

use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{FieldReader, NOT_NEGATIVE, ScenarioError, number, whole};
use reveille_common::ids::{DeviceId, MAX_TTIS, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::{Site, WakeUpRanking};

use super::SensingCount;
use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::beliefs::ages;
use crate::beliefs::ages::Ages;
use crate::beliefs::ages::foresight::Foresight;
use crate::beliefs::ages::price::Prices;
use crate::beliefs::ages::selector::DeviceSelector;
use crate::beliefs::candidates::{MIN_GAIN_SHARE, WakeUpCandidates};
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `age-index` policy.
pub struct AgeIndex {
    ages: Ages,
    prices: Prices,
    /// Worth at age 1 of a reach, the area that one device alone covers, in the unit of [`Ages::gain`]: the unit of θ.
    worth_of_reach: f64,
    foresight: Option<Foresight>,
    selector: DeviceSelector,
    candidates: WakeUpCandidates,
    /// Whether an event was reported in the TTI of the last decision.
    is_event_reported: bool,
    sensing_count: SensingCount,
}

impl AgeIndex {
    /// Creates the policy for the devices in `known`.
    pub fn new(known: &Knowledge, settings: &AgeIndexSettings) -> Self {
        let positions = known.positions();
        let ages = Ages::with_loss(
            known.radio.no_report_probability(),
            &positions,
            known.area,
            &known.sensing,
        );
        let worth_of_reach = ages::effective_area(&known.sensing) / ages.cell_surface();
        Self {
            prices: Prices::new(known, settings.price * worth_of_reach),
            foresight: settings.foresight.map(|ttis| Foresight::new(known, ttis)),
            selector: DeviceSelector::new(&positions, known.area, known.sensing.d_max),
            candidates: WakeUpCandidates::with_ranking(WakeUpRanking::Posterior, known),
            worth_of_reach,
            ages,
            is_event_reported: false,
            sensing_count: SensingCount::default(),
        }
    }
}

impl Policy for AgeIndex {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        // Called in every TTI, as `next_decision` defaults to the next. `choose` has added the last choice to the ages.
        if seen.now > Tti::ZERO {
            self.ages.advance(std::mem::take(&mut self.is_event_reported));
        }
        let prices = match &mut self.foresight {
            None => self.prices.for_levels(seen.batteries),
            Some(foresight) => self
                .prices
                .for_expected_levels(seen.batteries, foresight.expected_levels(seen)),
        };
        let mut chosen = self.selector.choose(&mut self.ages, prices);
        chosen.sort_unstable();
        self.sensing_count.count_and_plan(seen.known.n(), &chosen)
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    fn set_price(&mut self, known: &Knowledge, price: f64) {
        self.prices = Prices::new(known, price * self.worth_of_reach);
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.is_event_reported = true;
        let Self { ages, candidates, .. } = self;
        candidates.start_event_with_prior(seen, reports, &*ages);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let (device, gain) = self.candidates.next_candidate(seen, |_| true)?;
        (gain >= MIN_GAIN_SHARE * seen.known.sensing.psi).then_some(device)
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.candidates.belief()
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            let Self { ages, candidates, .. } = self;
            candidates.add_report_with_prior(seen, report, &*ages);
        }
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![self.sensing_count.summary_fact()]
    }
}

/// The policy `age-index`. The text is part of docs/scenario.md.
pub(crate) const AGE_INDEX: PolicyEntry = PolicyEntry {
    about: "Covers the places left uncovered for longest, while the gain is worth the energy. Wakes by expected gain; \
            needs no training.",
    ..PolicyEntry::new(AgeIndexSettings::SECTION, |reader, site| {
        Ok(Arc::new(AgeIndexSettings::from_fields(reader, site)?))
    })
};

impl PolicyFactory for AgeIndexSettings {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(AgeIndex::new(known, self))
    }
}

// The fields, in this order, are part of scenario files, their hashes and docs/scenario.md. `price` has the default of
// `dt`.
declare! {
    /// Settings of the policy `age-index`.
    #[derive(Clone, Debug, PartialEq)]
    pub struct AgeIndexSettings in "policy.age-index" {
        /// Price θ of a TTI in S1, in reaches (areas that one device alone covers). With 0, every place in reach is
        /// covered in every TTI; a higher price leaves places uncovered for longer.
        pub price: f64 = number(NOT_NEGATIVE, 0.35),
        /// Time ahead for which the battery level is predicted, from the expected harvest and the cost of sleep. The
        /// price follows the predicted level.
        pub foresight: Option<u64> = whole(1, MAX_TTIS, 1)
            .unit("TTIs")
            .derived("none: the price follows the current level"),
    }
}

impl AgeIndexSettings {
    /// Reads the settings for a base station that knows `site`.
    ///
    /// # Errors
    /// The price is out of range, or the area has too many cells.
    pub fn from_fields(reader: &FieldReader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        let settings = Self::read(reader)?;
        ages::check_price("age-index", Some(settings.price), reader, site)?;
        Ok(settings)
    }
}
