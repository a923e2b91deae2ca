//! The policy `q-learning` (Sec. V-B): one table chooses the sensing devices ([`duty`]), another the devices to wake
//! after a report ([`wake`]). Both can continue to learn in a run; `lab/src/training/` trains the tables that
//! [`settings`] reads ([`learned`]).
//!
//! # Factorisation
//! A joint action δ(k) of N devices has 2^N values. Devices are therefore considered one by one
//! ([`duty::DutyLearner::choose`]), and each has its own share of the paper's reward.
//!
//! A place is covered in TTI k if a device that detects an event there senses in k or sensed in one of the `window` − 1
//! TTIs before. An event that ends there in k is then reported. With U(k) for the uncovered share of the area, the
//! expectation of the paper's 1_0(I_i) is U(k), and
//!
//! ```text
//!   r(k)   = (1 − δ(k)·1/N) − α μ1 U(k)
//!   r_j(k) = (1 − δ_j(k))/N + α μ1 (c_j(k) − 1/N)
//! ```
//!
//! where c_j(k) is the share of the area that device j covers first in the window: earlier TTIs come first, and within
//! a TTI earlier choices. Every covered place has one first coverer, so Σ_j c_j = 1 − U, and Σ_j r_j = (1 − δ·1/N) + α
//! μ1 (1 − U − 1) = r. A choice adds its newly covered share to c_j in its own TTI and keeps it for the whole window.
//! The table's target for δ_j = 1 therefore has N α μ1 · (newly covered share) · (1 + ζ + … + ζ^(window − 1)). With
//! `window` = 1 that is N times the share's α μ1 c_j. With a longer window it is the part that is certain at the time
//! of the choice. It leaves out the places that fall to j later, when the coverage by an earlier device has expired.
//!
//! With ages ([`learned::Lookback::Ages`]) places count by their ages a: U(k) is the mean of a(a + 1)/2 over all
//! places, 0 for covered ones, and Ā the mean of a(a + 1)/2 without any coverage. Then r_j(k) = (1 − δ_j)/N + α μ1 (c_j
//! − Ā/N), and the sum of c_j over all devices is Ā − U.
//!
//! Wake-ups are also decided one by one: the m-th of a TTI has the share μ2 (Î_m − Î_{m−1}) − 1/N. These telescope to
//! r*(k) = μ2 I_i − δ*·1/N, except for μ2 Î_0, the information that came without a wake-up.
//!
//! Tables hold N times these shares, without the term −α μ1, or −α μ1 Ā with ages, which is the same for every action.
//! Other shares need new tables. Digests depend on the draws of exploration and on the tables; names of facts are part
//! of `summary.json`.

mod area_state;
pub mod duty;
pub mod learned;
pub mod settings;
pub mod wake;

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::WakeUpRanking;
use reveille_common::units::Energy;

use self::duty::{DutyLearner, DutyParameters};
use self::learned::{Lookback, TableSet};
use self::settings::QLearningSettings;
use self::wake::{WakeLearner, WakeState};
use super::SensingCount;
use super::factory::{PolicyEntry, PolicyFactory};
use super::interface::{LearnedState, Policy};
use crate::beliefs::candidates::WakeUpCandidates;
use crate::beliefs::posterior::EpicentreBelief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;

/// The `q-learning` policy.
pub struct QLearning {
    settings: QLearningSettings,
    ranking: WakeUpRanking,
    duty: DutyLearner,
    wake: WakeLearner,
    candidates: WakeUpCandidates,
    /// By device, the level from which it can answer a wake-up: E_Tx plus the cost of a TTI asleep.
    min_wake_levels: Vec<Energy>,
    /// Reports of the current event so far.
    report_count: usize,
    /// Whether all candidates of the current event are woken, to learn.
    explores_event: bool,
    sensing_count: SensingCount,
    /// Sum of r(k) and the number of TTIs in it, while the policy learns.
    reward_total: (f64, u64),
}

impl QLearning {
    /// Creates the policy for the devices in `known`, with its initial tables.
    pub fn new(known: &Knowledge, settings: &QLearningSettings) -> Self {
        let tables = &settings.initial_tables;
        let duty_parameters = DutyParameters {
            weights: settings.weights,
            schedule: settings.schedule,
            alpha: known.alpha,
            lookback: settings.lookback,
            loss_probability: known.radio.no_report_probability(),
        };
        let wake_table = match known.bs.ranking {
            WakeUpRanking::P42 => tables.wake_p42.clone(),
            WakeUpRanking::Posterior => tables.wake_posterior.clone(),
        };
        let min_wake_levels = known.devices.iter().map(|d| d.energy.e_tx + d.energy.e_wur);
        Self {
            ranking: known.bs.ranking,
            duty: DutyLearner::new(
                tables.duty.clone(),
                duty_parameters,
                &known.positions(),
                known.devices.iter().map(|device| device.energy).collect(),
                known.area,
                &known.sensing,
            ),
            wake: WakeLearner::new(
                wake_table,
                &settings.weights,
                &settings.schedule,
                known.n() as u32,
                known.sensing.psi,
            ),
            candidates: WakeUpCandidates::new(known),
            min_wake_levels: min_wake_levels.collect(),
            report_count: 0,
            explores_event: false,
            sensing_count: SensingCount::default(),
            reward_total: (0.0, 0),
            settings: settings.clone(),
        }
    }

    /// Returns the next candidate that can pay for a report, with its state.
    fn next_candidate(&mut self, seen: &Observation<'_>) -> Option<(DeviceId, WakeState)> {
        let min_wake_levels = &self.min_wake_levels;
        let can_report = |device: DeviceId| seen.batteries[device.index()] >= min_wake_levels[device.index()];
        let (device, score) = self.candidates.next_candidate(seen, can_report)?;
        Some((device, self.wake.state(score, seen.information, self.report_count)))
    }

    /// Returns ε in this TTI.
    fn epsilon(&self, seen: &Observation<'_>) -> f64 {
        let (first, last) = self.settings.epsilon;
        first + (last - first) * (seen.now.0 as f64 / seen.known.ttis.saturating_sub(1).max(1) as f64)
    }

    /// Adds the reward of the last TTI to the total, then lets the table learn from it. The order matters: learning
    /// consumes the decision.
    fn learn_duty(&mut self, seen: &Observation<'_>) {
        if let Some((reward, shares)) = self.duty.rewards() {
            debug_assert!(
                (shares.sum::<f64>() - reward).abs() < 1e-6 * (1.0 + reward.abs()),
                "the shares add up to r(k)"
            );
            self.reward_total.0 += reward;
            self.reward_total.1 += 1;
        }
        self.duty.learn(seen.batteries);
    }
}

impl Policy for QLearning {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let chosen = if self.settings.learn {
            self.learn_duty(seen);
            let mut stream = seen.known.streams.stream(PolicyPurpose::Exploration, seen.now.0);
            self.duty.explore(seen.batteries, self.epsilon(seen), &mut stream)
        } else {
            self.duty.choose(seen.batteries)
        };
        self.sensing_count.count_and_plan(seen.known.n(), &chosen)
    }

    fn needs_batteries(&self) -> bool {
        true
    }

    /// Starts the wake-ups of an event with its first reports, and draws whether this event is explored.
    fn reports_received(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.report_count = reports.len();
        // Exploring wakes all candidates of an event: values beyond a stop are learned only by continuing there. The
        // draw for a pair is not in the stream of `decide`, which has the same purpose and TTI.
        self.explores_event = self.settings.learn
            && seen
                .known
                .streams
                .unit_for_pair(PolicyPurpose::Exploration, seen.now.0, 1)
                < self.epsilon(seen);
        self.duty.record_event();
        let Self { duty, candidates, .. } = self;
        candidates.start_event_with_prior(seen, reports, &|place| duty.prior(place));
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let candidate = self.next_candidate(seen);
        // The value of the last wake-up includes the next possible one, so learning waits for the next candidate.
        if self.settings.learn {
            self.wake.learn(candidate.map(|(_, state)| state));
        }
        let (device, state) = candidate?;
        if !self.explores_event && !self.wake.is_worth_it(state) {
            return None;
        }
        self.wake.record_wake_up(state, seen.information);
        Some(device)
    }

    fn epicentre_belief(&self) -> Option<&EpicentreBelief> {
        self.candidates.belief()
    }

    fn take_wake_up_answer(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.wake.record_answer(seen.information);
        if let Some(report) = report {
            self.report_count += 1;
            let Self { duty, candidates, .. } = self;
            candidates.add_report_with_prior(seen, report, &|place| duty.prior(place));
        }
    }

    fn summary_facts(&self) -> Vec<(&'static str, f64)> {
        let mut facts = vec![
            ("learned_for_devices", f64::from(self.settings.initial_tables.devices)),
            self.sensing_count.summary_fact(),
        ];
        let (sum, ttis) = self.reward_total;
        if ttis > 0 {
            facts.push(("reward_per_tti", sum / ttis as f64));
        }
        facts
    }

    fn learned_state(&self) -> Option<LearnedState> {
        if !self.settings.learn {
            return None;
        }
        let mut tables = TableSet::clone(&self.settings.initial_tables);
        tables.duty = self.duty.table().clone();
        let wake = self.wake.table().clone();
        match self.ranking {
            WakeUpRanking::P42 => tables.wake_p42 = wake,
            WakeUpRanking::Posterior => tables.wake_posterior = wake,
        }
        Some(LearnedState::new(tables))
    }
}

/// The policy `q-learning`. The text is part of docs/scenario.md.
pub(crate) const Q_LEARNING: PolicyEntry = PolicyEntry {
    about: "Selects sensing devices by battery and newly covered area, with trained tables. Wakes devices by \
            expected gain.",
    learns: true,
    heeds_ranking: true,
    runtime: "O(N²)",
    ..PolicyEntry::new(QLearningSettings::SECTION, |reader, site| {
        Ok(Arc::new(QLearningSettings::from_fields(reader, site)?))
    })
};

impl PolicyFactory for QLearningSettings {
    fn build(&self, known: &Knowledge) -> Box<dyn Policy> {
        Box::new(QLearning::new(known, self))
    }

    fn delay_budget(&self) -> Option<(&'static str, u64)> {
        // Ages grant no delay budget: the time that a place waits depends on the price of sensing.
        match self.lookback {
            Lookback::Window(window) => Some(("policy.q-learning.window", u64::from(window))),
            Lookback::Ages => None,
        }
    }
}
