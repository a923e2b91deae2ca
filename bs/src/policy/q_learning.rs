//! Q-learning (Sec. V-B): a table says who senses, another whom to wake after a report. Both may go on learning.

use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::learned::Entry;
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::rng::{Purpose, Stream, unit_for_pair};
use reveille_common::scenario::{QLearningSettings, Scenario, WakeUpRanking};

use super::Policy;
use crate::candidates::Candidates;
use crate::learn::duty::{Duty, Terms};
use crate::learn::wake::{State, Wake};
use crate::observation::Observation;

/// The `q-learning` policy.
pub struct QLearning {
    settings: QLearningSettings,
    ranking: WakeUpRanking,
    seed: u64,
    /// Length of the run.
    ttis: u64,
    duty: Duty,
    wake: Wake,
    candidates: Candidates,
    /// E_Tx and what a TTI asleep costs, by device.
    needed: Vec<reveille_common::units::Energy>,
    reports: usize,
    is_exploring: bool,
    tally: Tally,
}

/// What the summary shows.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    decisions: u64,
    sensing: u64,
    reward: f64,
    rewarded: u64,
}

impl QLearning {
    /// The policy for the devices of `deployment`, with the tables that it starts from.
    pub fn new(scenario: &Scenario, settings: &QLearningSettings, deployment: &Deployment) -> Self {
        let positions = deployment.positions();
        let (sensing, start) = (&scenario.sensing, &settings.start);
        let terms = Terms {
            weights: settings.weights,
            schedule: settings.schedule,
            alpha: scenario.events.alpha,
            window: settings.window,
        };
        let energies = deployment.devices.iter().map(|d| d.energy).collect();
        let wake_table = match scenario.bs.ranking {
            WakeUpRanking::P42 => start.wake_p42.clone(),
            WakeUpRanking::Posterior => start.wake_posterior.clone(),
        };
        Self {
            ranking: scenario.bs.ranking,
            seed: scenario.seed,
            ttis: scenario.ttis,
            duty: Duty::new(start.duty.clone(), terms, &positions, energies, scenario.area, sensing),
            wake: Wake::new(
                wake_table,
                &settings.weights,
                &settings.schedule,
                scenario.devices,
                sensing.psi,
            ),
            candidates: Candidates::new(scenario, &positions),
            needed: deployment
                .devices
                .iter()
                .map(|d| d.energy.e_tx + d.energy.e_wur)
                .collect(),
            reports: 0,
            is_exploring: false,
            tally: Tally::default(),
            settings: settings.clone(),
        }
    }

    /// The next candidate that can afford a report, with its state.
    fn candidate(&mut self, seen: &Observation<'_>) -> Option<(DeviceId, State)> {
        let needed = &self.needed;
        let can_report = |device: DeviceId| seen.batteries[device.index()] >= needed[device.index()];
        let (device, score) = self.candidates.next(seen, can_report)?;
        Some((device, self.wake.state(score, seen.information, self.reports)))
    }

    /// ε in TTI `now`.
    fn epsilon(&self, now: Tti) -> f64 {
        let (first, last) = self.settings.epsilon;
        first + (last - first) * (now.0 as f64 / self.ttis.saturating_sub(1).max(1) as f64)
    }

    fn learn_duty(&mut self, seen: &Observation<'_>) {
        if let Some((reward, shares)) = self.duty.rewards() {
            debug_assert!((shares.sum::<f64>() - reward).abs() < 1e-9, "the shares add up to r(k)");
            self.tally.reward += reward;
            self.tally.rewarded += 1;
        }
        self.duty.learn(seen.batteries);
    }
}

impl Policy for QLearning {
    fn decide(&mut self, seen: &Observation<'_>) -> Plan {
        let chosen = if self.settings.learn {
            self.learn_duty(seen);
            let mut stream = Stream::new(self.seed, Purpose::Exploration, seen.now.0);
            self.duty.explore(seen.batteries, self.epsilon(seen.now), &mut stream)
        } else {
            self.duty.choose(seen.batteries)
        };
        self.tally.decisions += 1;
        self.tally.sensing += chosen.len() as u64;
        Plan::from_chosen(seen.positions.len(), &chosen)
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
            && unit_for_pair(self.seed, Purpose::Exploration, seen.now.0, 1) < self.epsilon(seen.now);
        self.candidates.start(seen, reports);
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

    fn answered(&mut self, seen: &Observation<'_>, report: Option<&Report>) {
        self.wake.answered(seen.information);
        if let Some(report) = report {
            self.reports += 1;
            self.candidates.add(seen, report);
        }
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        let Tally {
            decisions,
            sensing,
            reward,
            rewarded,
        } = self.tally;
        let mut facts = vec![
            ("learned_for_devices", f64::from(self.settings.start.devices)),
            ("sensing_per_tti", sensing as f64 / decisions.max(1) as f64),
        ];
        if rewarded > 0 {
            facts.push(("reward_per_tti", reward / rewarded as f64));
        }
        facts
    }

    fn learned(&self) -> Option<Entry> {
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
        Some(entry)
    }
}
