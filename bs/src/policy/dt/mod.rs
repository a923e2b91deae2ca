//! The policy `dt`, the decision transformer (Sec. V-C, Algorithm 2): learned offline from recorded trajectories, run
//! online at the BS. Start at [`Dt`] and its `decide`.
//!
//! In each TTI every device has a token with the base station's knowledge of it ([`tokens`]). The [`model`] may attend
//! over the last Z TTIs of each device, then over the devices. It returns the ratio of each device's expected events to
//! the expectation without history. Devices are then chosen as under `age-index`. Their prices fall with the ratio or,
//! where energy is scarce, with the ratio to the device's average (`baseline`). The base price is given, or the model
//! names it for a target return. An untrained model with `miss_cost = 0` must decide as `age-index`
//! (`tests/tests/dt.rs`). [`record`] records trajectories, on which `lab/src/transformer/` trains the model.

mod baseline;
pub mod model;
pub mod record;
pub mod settings;
pub mod tokens;
mod vector_math;

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::scenario::WakeUpRanking;

use self::baseline::ExpectationBaseline;
use self::model::infer::ForwardPass;
use self::model::{ModelObjective, OUTPUTS};
use self::settings::DtSettings;
use self::tokens::{BATTERY, FEATURE_COUNT, TokenBuilder};
use super::SensingCount;
use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::Policy;
use crate::beliefs::ages;
use crate::beliefs::ages::price::{Prices, min_sensing_level};
use crate::beliefs::ages::selector::DeviceSelector;
use crate::beliefs::candidates::{MIN_GAIN_SHARE, WakeUpCandidates};
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `dt` policy.
pub struct Dt {
    token_builder: TokenBuilder,
    forward_pass: ForwardPass,
    objective: ModelObjective,
    /// Share of new events to detect in their first TTI; 0 for no target. Only under [`ModelObjective::Events`].
    target: f64,
    prices: Prices,
    selector: DeviceSelector,
    candidates: WakeUpCandidates,
    /// By device, its first output in this TTI.
    log_ratios: Vec<f32>,
    /// By device, its battery level in this TTI as a share of E_max.
    levels: Vec<f32>,
    /// By device, factor of its price in this TTI.
    price_factors: Vec<f64>,
    baseline: ExpectationBaseline,
    sensing_count: SensingCount,
}

impl Dt {
    /// Creates the policy for the devices in `known`.
    pub fn new(known: &Knowledge, settings: &DtSettings) -> Self {
        let positions = known.positions();
        let token_builder = TokenBuilder::new(known, |j| min_sensing_level(&known.devices[j].energy));
        // Worth at age 1 of the area that one device alone covers, as in `AgeIndex`: the unit of θ.
        let worth_of_reach = ages::effective_area(&known.sensing) / token_builder.ages().cell_surface();
        // With a target the model names the price in each TTI, as a factor of this one.
        let base_price = settings.fixed_price().unwrap_or(1.0);
        Self {
            forward_pass: ForwardPass::new(Arc::clone(&settings.weights), known.n()),
            objective: settings.weights.shape().objective,
            target: settings.target,
            prices: Prices::new(known, base_price * worth_of_reach),
            selector: DeviceSelector::new(&positions, known.area, known.sensing.d_max),
            candidates: WakeUpCandidates::with_ranking(WakeUpRanking::Posterior, known)
                .with_miss_cost(settings.miss_cost * known.sensing.psi),
            log_ratios: vec![0.0; known.n()],
            levels: vec![0.0; known.n()],
            price_factors: vec![1.0; known.n()],
            baseline: ExpectationBaseline::new(known.n()),
            sensing_count: SensingCount::default(),
            token_builder,
        }
    }

    /// Returns the devices that the recorded policy (the teacher) would let sense: log-odds above 0. Price and target
    /// have no effect.
    fn imitate_teacher(&mut self) -> Vec<DeviceId> {
        let outputs = self
            .forward_pass
            .step(self.token_builder.tokens())
            .as_chunks::<OUTPUTS>()
            .0;
        let imitated = |(j, log_odds): (usize, &[f32; OUTPUTS])| {
            let is_on = log_odds[0] > 0.0 && self.token_builder.can_sense(j);
            is_on.then_some(DeviceId(j as u32))
        };
        outputs.iter().enumerate().filter_map(imitated).collect()
    }

    /// Returns the factor by which history changes the expected information of a wake-up of `device`.
    fn wake_factor(&self, device: DeviceId) -> f64 {
        match self.objective {
            ModelObjective::Events => {
                // `libm` returns the same bits on every machine, so the same model makes the same decisions.
                f64::from(libm::expf(self.forward_pass.outputs()[device.index() * OUTPUTS + 1]))
            }
            ModelObjective::Actions => 1.0,
        }
    }

    /// Returns the devices whose gain is worth their price.
    fn choose_worthwhile(&mut self, seen: &Observation<'_>) -> Vec<DeviceId> {
        let tokens = self.token_builder.tokens();
        let outputs = self.forward_pass.step(tokens).as_chunks::<OUTPUTS>().0;
        for (log_ratio, [event_log, _]) in self.log_ratios.iter_mut().zip(outputs) {
            *log_ratio = *event_log;
        }
        for (level, token) in self.levels.iter_mut().zip(tokens.as_chunks::<FEATURE_COUNT>().0) {
            *level = token[BATTERY];
        }
        self.baseline
            .update_factors(&self.log_ratios, &self.levels, &mut self.price_factors);
        if self.target > 0.0 {
            let target_price = f64::from(libm::expf(self.forward_pass.log_price(self.target as f32)));
            self.price_factors.iter_mut().for_each(|factor| *factor *= target_price);
        }
        let prices = self.prices.scaled_for_levels(seen.batteries, |j| self.price_factors[j]);
        let (ages, gains) = self.token_builder.ages_and_gains();
        let mut chosen = self.selector.choose_with_gains(ages, prices, gains);
        chosen.sort_unstable();
        chosen
    }
}

impl Policy for Dt {
    // The builder, the forward pass and the baseline need a call in every TTI: the default of `next_decision`.
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        self.token_builder.begin_tti(seen);
        let chosen = match self.objective {
            ModelObjective::Events => self.choose_worthwhile(seen),
            ModelObjective::Actions => self.imitate_teacher(),
        };
        let plan = self.sensing_count.count_and_plan(seen.known.n(), &chosen);
        // The choice has added its devices to the ages already; imitation has not.
        self.token_builder
            .mark_sensing(seen.now, &plan, self.objective == ModelObjective::Events);
        plan
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        for report in reports {
            self.token_builder.add_report(seen, report);
        }
        let ages = self.token_builder.ages();
        self.candidates.start_event_with_prior(seen, reports, ages);
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let (device, gain) = self.candidates.next_candidate(seen, |_| true)?;
        (gain * self.wake_factor(device) >= MIN_GAIN_SHARE * seen.known.sensing.psi).then_some(device)
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.candidates.belief()
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        if let Some(report) = report {
            self.token_builder.add_report(seen, report);
            let ages = self.token_builder.ages();
            self.candidates.add_report_with_prior(seen, report, ages);
        }
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        vec![self.sensing_count.summary_fact()]
    }
}

/// The policy `dt`. The text is part of docs/scenario.md.
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
