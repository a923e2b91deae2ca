//! Q-learning (Sec. V-B): a table says who senses, another whom to wake after a report. Both may go on learning.
//!
//! # Factorisation
//! A joint action δ(k) of N devices has 2^N values. Devices are therefore considered one after the other, as
//! [`duty::Duty::choose`] says, and each has its own share of the paper's reward.
//!
//! A place is covered in TTI k if some device that detects an event there senses in k or did in one of the `window` − 1
//! TTIs before it: an event that ends there in k is then reported. With U(k) for the share of the area that is not
//! covered, the expectation of the paper's 1_0(I_i) is U(k), and
//!
//! ```text
//!   r(k)   = (1 − δ(k)·1/N) − α μ1 U(k)
//!   r_j(k) = (1 − δ_j(k))/N + α μ1 (c_j(k) − 1/N)
//! ```
//!
//! where c_j(k) is the share of the area whose first coverer in the window is device j: earlier TTIs come first, and
//! within a TTI those who were chosen earlier. Every covered place has one first coverer, so Σ_j c_j = 1 − U, and Σ_j
//! r_j = (1 − δ·1/N) + α μ1 (1 − U − 1) = r. A choice adds to c_j in its own TTI what it newly covers, and keeps that
//! for the whole window; so the table's target for δ_j = 1 has N α μ1 · (newly covered share) · (1 + ζ + … + ζ^(window
//! − 1)). With `window` = 1 that is N times the share's α μ1 c_j. With a longer one it is the part that is certain when
//! the choice is made: a place that somebody else had covered earlier falls to j as well once that has run out, and is
//! left out.
//!
//! With ages ([`learned::Lookback::Ages`]) places count by their ages a: U(k) is the mean of a(a + 1)/2 over all
//! places, 0 where somebody looks, and Ā that mean over all of them. Then r_j(k) = (1 − δ_j)/N + α μ1 (c_j − Ā/N), and
//! the sum of c_j over all devices is Ā − U.
//!
//! Wake-ups are decided one after the other too: the m-th of a TTI has the share μ2 (Î_m − Î_{m−1}) − 1/N. These
//! telescope to r*(k) = μ2 I_i − δ*·1/N, but for μ2 Î_0, the information that came without a wake-up.
//!
//! Tables hold N times these shares, and leave out α μ1, the part that is the same whatever a device does.

pub mod duty;
mod ground;
pub mod learned;
pub mod settings;
pub mod wake;

use std::sync::Arc;

use reveille_common::declare::{Reader, ScenarioError, Section};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::PolicyPurpose;
use reveille_common::scenario::{PolicyChoice, PolicyKind, PolicySettings, Site, WakeUpRanking};

use self::learned::Entry;
use self::settings::QLearningSettings;
use super::contract::{Opaque, Policy};
use super::kind::{Profile, Registered, own};
use super::mind::Mind;
use super::tally::Tally;
use crate::beliefs::candidates::Candidates;
use crate::beliefs::posterior::Belief;
use crate::knowledge::Knowledge;
use crate::observation::Observation;
use crate::policy::q_learning::duty::{Duty, Terms};
use crate::policy::q_learning::wake::{Wake, WakeState};

/// The `q-learning` policy.
pub struct QLearning {
    settings: QLearningSettings,
    ranking: WakeUpRanking,
    duty: Duty,
    wake: Wake,
    candidates: Candidates,
    /// E_Tx and what a TTI asleep costs, by device.
    needed: Vec<reveille_common::units::Energy>,
    reports: usize,
    is_exploring: bool,
    tally: Tally,
    /// The sum of r(k), and over how many TTIs.
    rewards: (f64, u64),
}

impl QLearning {
    /// The policy for the devices in `known`, with the tables that it starts from.
    pub fn new(known: &Knowledge, settings: &QLearningSettings) -> Self {
        let start = &settings.start;
        let terms = Terms {
            weights: settings.weights,
            schedule: settings.schedule,
            alpha: known.alpha,
            lookback: settings.lookback,
            lost: known.radio.silence(),
        };
        let wake_table = match known.bs.ranking {
            WakeUpRanking::P42 => start.wake_p42.clone(),
            WakeUpRanking::Posterior => start.wake_posterior.clone(),
        };
        let needed = known.devices.iter().map(|d| d.energy.e_tx + d.energy.e_wur);
        Self {
            ranking: known.bs.ranking,
            duty: Duty::new(
                start.duty.clone(),
                terms,
                &known.positions(),
                known.devices.iter().map(|device| device.energy).collect(),
                known.area,
                &known.sensing,
            ),
            wake: Wake::new(
                wake_table,
                &settings.weights,
                &settings.schedule,
                known.n() as u32,
                known.sensing.psi,
            ),
            candidates: Candidates::new(known),
            needed: needed.collect(),
            reports: 0,
            is_exploring: false,
            tally: Tally::default(),
            rewards: (0.0, 0),
            settings: settings.clone(),
        }
    }

    /// The next candidate that can afford a report, with its state.
    fn candidate(&mut self, seen: &Observation<'_>) -> Option<(DeviceId, WakeState)> {
        let needed = &self.needed;
        let can_report = |device: DeviceId| seen.batteries[device.index()] >= needed[device.index()];
        let (device, score) = self.candidates.next(seen, can_report)?;
        Some((device, self.wake.state(score, seen.information, self.reports)))
    }

    /// ε in this TTI.
    fn epsilon(&self, seen: &Observation<'_>) -> f64 {
        let (first, last) = self.settings.epsilon;
        first + (last - first) * (seen.now.0 as f64 / seen.known.ttis.saturating_sub(1).max(1) as f64)
    }

    fn learn_duty(&mut self, seen: &Observation<'_>) {
        if let Some((reward, shares)) = self.duty.rewards() {
            debug_assert!(
                (shares.sum::<f64>() - reward).abs() < 1e-6 * (1.0 + reward.abs()),
                "the shares add up to r(k)"
            );
            self.rewards.0 += reward;
            self.rewards.1 += 1;
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
        self.tally.plan(seen.known.n(), &chosen)
    }

    /// Decides in every TTI: batteries change, and so does who should sense.
    fn next_decision(&self, now: Tti) -> Tti {
        now + 1
    }

    fn looks_at_batteries(&self) -> bool {
        true
    }

    fn reported(&mut self, seen: &Observation<'_>, reports: &[Report]) {
        self.reports = reports.len();
        // An event in which everyone is woken: what comes after a stop is learned only if it is not always made.
        self.is_exploring = self.settings.learn
            && seen
                .known
                .streams
                .unit_for_pair(PolicyPurpose::Exploration, seen.now.0, 1)
                < self.epsilon(seen);
        self.duty.found();
        let Self { duty, candidates, .. } = self;
        candidates.start_with(seen, reports, |place| duty.prior(place));
    }

    fn next_wake_up(&mut self, seen: &Observation<'_>) -> Option<DeviceId> {
        let candidate = self.candidate(seen);
        if self.settings.learn {
            self.wake.learn(candidate.map(|(_, state)| state));
        }
        let (device, state) = candidate?;
        if !self.is_exploring && !self.wake.is_worth_it(state) {
            return None;
        }
        self.wake.wake(state, seen.information);
        Some(device)
    }

    fn belief(&self) -> Option<&Belief> {
        self.candidates.belief()
    }

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.wake.answered(seen.information);
        if let Some(report) = report {
            self.reports += 1;
            let Self { duty, candidates, .. } = self;
            candidates.add_with(seen, report, |place| duty.prior(place));
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        let mut facts = vec![
            ("learned_for_devices", f64::from(self.settings.start.devices)),
            self.tally.fact(),
        ];
        let (sum, ttis) = self.rewards;
        if ttis > 0 {
            facts.push(("reward_per_tti", sum / ttis as f64));
        }
        facts
    }

    fn learned(&self) -> Option<Opaque> {
        if !self.settings.learn {
            return None;
        }
        let mut entry = Entry::clone(&self.settings.start);
        entry.duty = self.duty.table().clone();
        let wake = self.wake.table().clone();
        match self.ranking {
            WakeUpRanking::P42 => entry.wake_p42 = wake,
            WakeUpRanking::Posterior => entry.wake_posterior = wake,
        }
        Some(Opaque::new(entry))
    }
}

/// The policy `q-learning`.
#[derive(Clone, Copy, Debug)]
pub struct QLearningKind;

impl PolicyKind for QLearningKind {
    fn name(&self) -> &'static str {
        "q-learning"
    }

    fn about(&self) -> &'static str {
        "Chooses who senses, from battery and what is newly looked at, and whom to wake, from expected \
         gain, with trained tables."
    }

    fn section(&self) -> Option<&'static Section> {
        Some(QLearningSettings::SECTION)
    }

    fn settle(&self, reader: &Reader<'_>, site: &Site<'_>) -> Result<Arc<dyn PolicySettings>, ScenarioError> {
        Ok(Arc::new(QLearningSettings::settle(reader, site)?))
    }
}

impl Registered for QLearningKind {
    fn profile(&self) -> Profile {
        Profile {
            learns: true,
            runtime: "O(N²)",
            wakes: true,
            heeds_ranking: true,
            ..Profile::plain(3)
        }
    }

    fn build(&self, choice: &PolicyChoice, known: &Knowledge, _: Option<&Opaque>) -> Mind {
        Mind::of(QLearning::new(known, own(choice)))
    }
}
