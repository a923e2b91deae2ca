//! The decision transformer (Sec. V-C, Algorithm 2): learned offline from recorded trajectories, run online at the BS.
//!
//! In each TTI every device has a token with the base station's knowledge of it ([`tokens`]). The [`model`] attends
//! over the last Z TTIs of each device and then over the devices. It returns, for each device, the ratio of expected
//! events to the expectation without history. Devices are then chosen as under `age-index`, while their gain is worth
//! its price. The price falls with the ratio; where energy is scarce, with the ratio to the device's average
//! (`baseline`). The price is given, or the model names the price for a target return.

mod baseline;
pub mod model;
pub mod record;
pub mod settings;
pub mod tokens;

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::WakeUpRanking;

use self::baseline::ExpectationBaseline;
use self::model::infer::Forward;
use self::model::{HEADS, ModelObjective};
use self::settings::DtSettings;
use self::tokens::TokenBuilder;
use super::SensingCount;
use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::beliefs::ages;
use crate::beliefs::ages::price::{Prices, min_level};
use crate::beliefs::ages::selector::DeviceSelector;
use crate::beliefs::candidates::{Candidates, LEAST_GAIN};
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `dt` policy.
pub struct Dt {
    senses: TokenBuilder,
    forward: Forward,
    objective: ModelObjective,
    target: f64,
    prices: Prices,
    choice: DeviceSelector,
    candidates: Candidates,
    /// By device, factor by which history changes the expected information of a wake-up.
    wake_factors: Vec<f64>,
    /// By device, factor of its price.
    factors: Vec<f64>,
    usual: ExpectationBaseline,
    tally: SensingCount,
}

impl Dt {
    /// Creates the policy for the devices in `known`.
    pub fn new(known: &Knowledge, settings: &DtSettings) -> Self {
        let positions = known.positions();
        let senses = TokenBuilder::new(known, |j| min_level(&known.devices[j].energy));
        let reach = ages::reach(&known.sensing) / senses.ages().cell_surface();
        // With a target the model names the price in each TTI, as a factor of this one.
        let price = settings.fixed_price().unwrap_or(1.0);
        Self {
            forward: Forward::new(Arc::clone(&settings.weights), known.n()),
            objective: settings.weights.shape().objective,
            target: settings.target,
            prices: Prices::new(known, price * reach),
            choice: DeviceSelector::new(&positions, known.area, known.sensing.d_max),
            candidates: Candidates::by(WakeUpRanking::Posterior, known)
                .with_miss_cost(settings.miss_cost * known.sensing.psi),
            wake_factors: vec![1.0; known.n()],
            factors: vec![1.0; known.n()],
            usual: ExpectationBaseline::new(known.n()),
            tally: SensingCount::default(),
            senses,
        }
    }
}

impl Dt {
    /// Returns the devices that the teacher would let sense: log-odds above 0.
    fn imitated(&mut self) -> Vec<DeviceId> {
        let said = self.forward.step(self.senses.tokens()).as_chunks::<HEADS>().0;
        let would = |(j, log_odds): (usize, &[f32; HEADS])| {
            let is_on = log_odds[0] > 0.0 && self.senses.can_sense(j);
            is_on.then_some(DeviceId(j as u32))
        };
        said.iter().enumerate().filter_map(would).collect()
    }

    /// Returns the devices whose gain is worth their price.
    fn worthwhile(&mut self, seen: &Observation<'_>) -> Vec<DeviceId> {
        let expected = self.forward.step(self.senses.tokens());
        for (j, logarithms) in expected.as_chunks::<HEADS>().0.iter().enumerate() {
            // `libm` returns the same bits on every machine, so the same model makes the same decisions.
            let [events, information] = logarithms.map(|log| f64::from(libm::expf(log)));
            let (level, e_max) = (seen.batteries[j], seen.known.devices[j].energy.e_max);
            self.factors[j] = self.usual.factor(j, events, level, e_max);
            self.wake_factors[j] = information;
        }
        if self.target > 0.0 {
            let price = f64::from(libm::expf(self.forward.price(self.target as f32)));
            self.factors.iter_mut().for_each(|factor| *factor *= price);
        }
        let prices = self.prices.scaled(seen.batteries, |j| self.factors[j]);
        let mut chosen = self.choice.choose(self.senses.ages_mut(), prices);
        chosen.sort_unstable();
        chosen
    }
}

impl Policy for Dt {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        self.senses.begin(seen);
        let chosen = match self.objective {
            ModelObjective::Events => self.worthwhile(seen),
            ModelObjective::Actions => self.imitated(),
        };
        let plan = self.tally.plan(seen.known.n(), &chosen);
        // The choice has added its devices to the ages already; imitation has not.
        self.senses
            .mark_sensing(seen.now, &plan, self.objective == ModelObjective::Events);
        plan
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.senses.add_report(seen, report);
        }
        let ages = self.senses.ages();
        self.candidates.start_with(seen, reports, |place| ages.age_at(place));
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let (device, gain) = self.candidates.next(seen, |_| true)?;
        (gain * self.wake_factors[device.index()] >= LEAST_GAIN * seen.known.sensing.psi).then_some(device)
    }

    fn belief(&self) -> Option<&EpicentreBelief> {
        self.candidates.belief()
    }

    fn wake_up_answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            self.senses.add_report(seen, report);
            let ages = self.senses.ages();
            self.candidates.add_with(seen, report, |place| ages.age_at(place));
        }
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![self.tally.fact()]
    }
}

/// The policy `dt`.
pub(crate) const DT: PolicyEntry = PolicyEntry {
    about: "Decision transformer (Algorithm 2), trained offline. Predicts events from past detections.",
    runtime: "O(N²)",
    ..PolicyEntry::new(DtSettings::SECTION, |reader, site| {
        Ok(Arc::new(DtSettings::from_fields(reader, site)?))
    })
};

impl PolicyFactory for DtSettings {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(Dt::new(known, self))
    }
}
