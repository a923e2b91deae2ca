//! Compares the tables of [`Trainer`] with the exact optimum for a network of six devices: value iteration over all
//! battery vectors and all 2^6 actions. The learner's tables are evaluated exactly as well. [`super::three_devices`]
//! covers reports that cost energy and windows of two TTIs.

use std::sync::Arc;

use reveille_bs::policy::q_learning::duty::{DutyLearner, DutyParameters};
use reveille_bs::policy::q_learning::learned::{QTrainingConfig, TableSet, battery_bucket};
use reveille_bs::policy::q_learning::settings::QLearningSettings;
use reveille_bs::scenario::{EnergyModel, Override, Scenario, load};
use reveille_common::geometry::{Area, FileLayout, Layout, Point};
use reveille_common::units::Energy;

use crate::training::Trainer;

const N: usize = 6;
const ACTIONS: usize = 1 << N;
/// E_max in units; E_idle is 1, an arrival brings 1, everything else is free.
const E_MAX: usize = 4;
/// The number of battery levels, from 0 to E_max.
const LEVELS: usize = E_MAX + 1;
/// The number of battery vectors. A state is the index of one, with one digit of base `LEVELS` for each device.
const STATES: usize = LEVELS.pow(N as u32);
/// d_max of the preset `paper`, m.
const D_MAX: f64 = 4.0;
/// Cells along d_max, as in `bs/src/beliefs/coverage/` for detection by range.
const CELLS_PER_RANGE: f64 = 15.0;
/// α. Events are so rare that none changes the states of the network.
const ALPHA: f64 = 1e-5;
/// ζ, the discount of the learner.
const ZETA: f64 = 0.95;
/// The number of sweeps, enough for a discounted value to converge.
const SWEEPS: usize = 500;
/// The largest final distance between the least and the largest addition of a sweep.
const SPAN: f64 = 1e-5;

/// A network in which only sensing costs energy. Sets of devices and actions are numbers with a bit for each device.
struct SixDevices {
    /// The probability of an arrival of energy at a device in a TTI, λe^−λ.
    arrival_probability: f64,
    /// The weight α μ1 of the uncovered share in r(k).
    uncovered_weight: f64,
    /// Uncovered share of the area, by the set of sensing devices.
    uncovered_shares: [f64; ACTIONS],
    scenario: Scenario,
    points: Vec<Point>,
}

impl SixDevices {
    fn new(area: Area, points: &[(f64, f64)], lambda: f64, uncovered_weight: f64) -> Self {
        let points: Vec<Point> = points.iter().map(|&(x, y)| Point::new(x, y)).collect();
        assert_eq!(points.len(), N);
        let scenario = scenario_of(
            area,
            &points,
            &[
                "policy.q-learning.window=1",
                &format!("policy.q-learning.zeta={ZETA}"),
                &format!("policy.q-learning.mu1={}", uncovered_weight / ALPHA),
                &format!("events.alpha={ALPHA}"),
                &format!("energy.e_max={E_MAX}"),
                "energy.e_tx=0",
                &format!("harvest.lambda={lambda}"),
            ],
        );
        let mut network = Self {
            arrival_probability: lambda * libm::exp(-lambda),
            uncovered_weight,
            uncovered_shares: [0.0; ACTIONS],
            scenario,
            points,
        };
        network.uncovered_shares = std::array::from_fn(|set| {
            let sensing: Vec<Point> = (0..N)
                .filter(|j| set >> j & 1 == 1)
                .map(|j| network.points[j])
                .collect();
            uncovered_share(area, &sensing)
        });
        network
    }

    /// Returns the expectation of r(k) for `action` if the devices of `empty` have empty batteries: those sense only
    /// after an arrival.
    fn reward(&self, empty: usize, action: usize) -> f64 {
        let (charged, uncharged) = (action & !empty, action & empty);
        let mut uncovered = 0.0;
        for arrived in (0..ACTIONS).filter(|arrived| arrived & !uncharged == 0) {
            let (arrivals, failures) = (arrived.count_ones(), (uncharged & !arrived).count_ones());
            let probability = self.arrival_probability.powi(arrivals.cast_signed())
                * (1.0 - self.arrival_probability).powi(failures.cast_signed());
            uncovered += probability * self.uncovered_shares[charged | arrived];
        }
        1.0 - f64::from(action.count_ones()) / N as f64 - self.uncovered_weight * uncovered
    }

    /// Returns the expectation of r(k) by set of devices with empty batteries and action.
    fn rewards(&self) -> Vec<[f64; ACTIONS]> {
        (0..ACTIONS)
            .map(|empty| std::array::from_fn(|action| self.reward(empty, action)))
            .collect()
    }

    /// Returns the expectation of `values` one TTI later, by action and state. It is computed one device at a time,
    /// because harvests are independent.
    fn expected_next(&self, values: Vec<f64>) -> Vec<Vec<f64>> {
        let mut values_by_action = vec![values];
        for device in 0..N {
            let expectations = |is_on: bool| {
                values_by_action
                    .iter()
                    .map(move |values| self.expected_over_harvest(values, device, is_on))
            };
            values_by_action = expectations(false).chain(expectations(true)).collect();
        }
        values_by_action
    }

    /// Returns the expectation of `values` over the harvest of one device, which pays for sensing if it is on.
    fn expected_over_harvest(&self, values: &[f64], device: usize, is_on: bool) -> Vec<f64> {
        let stride = LEVELS.pow(device as u32);
        let next_offset =
            |level: usize, harvest: usize| (level + harvest).min(E_MAX).saturating_sub(usize::from(is_on)) * stride;
        let mut expectation = vec![0.0; STATES];
        for block in (0..STATES).step_by(stride * LEVELS) {
            for level in 0..LEVELS {
                let [with_arrival, without_arrival] =
                    [1, 0].map(|harvest| &values[block + next_offset(level, harvest)..][..stride]);
                let target = &mut expectation[block + level * stride..][..stride];
                for ((target, with_arrival), without_arrival) in
                    target.iter_mut().zip(with_arrival).zip(without_arrival)
                {
                    *target =
                        self.arrival_probability * with_arrival + (1.0 - self.arrival_probability) * without_arrival;
                }
            }
        }
        expectation
    }

    /// Returns the mean over all battery vectors of the discounted sum of rewards, times 1 − `discount`; with
    /// `discount` 1, the long-run mean r(k). `policy` holds the action of each state; without it the best action is
    /// taken.
    fn value_of(&self, discount: f64, policy: Option<&[usize]>) -> f64 {
        let rewards = self.rewards();
        let (mut values, mut mean_addition) = (vec![0.0; STATES], 0.0);
        for _ in 0..SWEEPS {
            let next = self.expected_next(values.clone());
            let new_values: Vec<f64> = (0..STATES)
                .map(|state| {
                    let rewards = &rewards[empty_devices(state)];
                    let value = |action: usize| rewards[action] + discount * next[action][state];
                    match policy {
                        Some(policy) => value(policy[state]),
                        None => (0..ACTIONS).map(value).fold(f64::NEG_INFINITY, f64::max),
                    }
                })
                .collect();
            let additions = new_values.iter().zip(&values).map(|(new, old)| new - old);
            mean_addition = additions.clone().sum::<f64>() / STATES as f64;
            let (least, most) = additions.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
            values = new_values;
            // The sum of all further additions lies within discount/(1 − discount) times these two.
            if most - least < SPAN {
                let mean_value = values.iter().sum::<f64>() / STATES as f64;
                return (1.0 - discount) * mean_value + discount * 0.5 * (least + most);
            }
        }
        assert!(discount >= 1.0, "discounted values did not converge");
        // The policy's long-run value depends on the start: the mean over all starts.
        mean_addition
    }

    fn discounted_reward(&self, policy: Option<&[usize]>) -> f64 {
        self.value_of(ZETA, policy)
    }

    fn mean_reward(&self, policy: Option<&[usize]>) -> f64 {
        self.value_of(1.0, policy)
    }

    /// Returns the actions of a policy that only maximises the next r(k).
    fn greedy_actions(&self) -> Vec<usize> {
        let rewards = self.rewards();
        let best_action = |state: usize| {
            let reward = |action: &usize| rewards[empty_devices(state)][*action];
            (0..ACTIONS)
                .max_by(|a, b| reward(a).total_cmp(&reward(b)))
                .expect("actions")
        };
        (0..STATES).map(best_action).collect()
    }

    fn energy(&self) -> EnergyModel {
        self.scenario.classes[0].energy
    }

    /// Returns the action of the learner with the tables of `entry` in each state, without exploration.
    fn learned_actions(&self, entry: &TableSet) -> Vec<usize> {
        let mut duty = duty_of(&self.scenario, entry, &self.points);
        let chosen_action = |state: usize| {
            let chosen = duty.choose(&energies_of(state));
            chosen.iter().map(|j| 1 << j.index()).sum()
        };
        (0..STATES).map(chosen_action).collect()
    }
}

/// Returns the scenario of a network with devices at `points` in `area` under `q-learning` from empty tables, with the
/// `fields` (`PATH=VALUE`). E_idle is 1, an arrival brings 1, the wake-up radio is free.
pub(super) fn scenario_of(area: Area, points: &[Point], fields: &[&str]) -> Scenario {
    let network_fields = [
        &format!("devices={}", points.len()),
        "policy.name=q-learning",
        "policy.q-learning.learn=true",
        "policy.q-learning.table=nothing",
        &format!("area.width={}", area.width),
        &format!("area.height={}", area.height),
        "energy.e_idle=1",
        "energy.e_wur=0",
        "harvest.e_b=1",
    ];
    let overrides = network_fields
        .iter()
        .chain(fields)
        .map(|text| Override::parse(text).expect("an override"));
    let mut scenario = load("paper", &overrides.collect::<Vec<_>>())
        .expect("a scenario")
        .scenario;
    scenario.layout = Layout::File(FileLayout {
        // A name for messages only; `three_devices` uses it too.
        path: "six-devices".into(),
        points: Arc::new(points.to_vec()),
        classes: None,
    });
    scenario
}

/// Returns the tables of a learner on `scenario`, trained from empty tables.
pub(super) fn train(scenario: &Scenario) -> TableSet {
    let training = QTrainingConfig {
        episodes: 12,
        ttis: 3000,
        epsilon: (0.1, 0.03),
        seed: 0,
    };
    let mut trainer = Trainer::new(scenario, &[scenario.run.devices], &[], &training).expect("a training");
    assert!(trainer.train(1, &|_| Ok(()), &()).expect("no file"));
    trainer.learned().entries.swap_remove(0)
}

/// Returns the duty rule with the tables of `entry`, for the devices of `scenario` at `points`.
pub(super) fn duty_of(scenario: &Scenario, entry: &TableSet, points: &[Point]) -> DutyLearner {
    let settings = scenario
        .policy
        .settings()
        .downcast_ref::<QLearningSettings>()
        .expect("q-learning");
    let parameters = DutyParameters {
        weights: settings.weights,
        schedule: settings.schedule,
        alpha: scenario.events.alpha,
        lookback: settings.lookback,
        loss_probability: 0.0,
    };
    let energies = vec![scenario.classes[0].energy; points.len()];
    DutyLearner::new(
        entry.duty.clone(),
        parameters,
        points,
        energies,
        scenario.area,
        &scenario.sensing,
    )
}

/// Returns the share of `area` without a device of `points` within d_max, in the cells of the learner. A device covers
/// a cell if it covers the four corners.
pub(super) fn uncovered_share(area: Area, points: &[Point]) -> f64 {
    let [columns, rows] = [area.width, area.height].map(|length| (length / D_MAX * CELLS_PER_RANGE).ceil() as u32);
    let (width, height) = (area.width / f64::from(columns), area.height / f64::from(rows));
    let mut uncovered_cells = 0;
    for cell in 0..columns * rows {
        let (column, row) = (cell % columns, cell / columns);
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)]
            .map(|(east, north)| Point::new(f64::from(column + east) * width, f64::from(row + north) * height));
        let is_covered = |point: &Point| corners.iter().all(|corner| corner.distance(*point) <= D_MAX);
        uncovered_cells += u32::from(!points.iter().any(is_covered));
    }
    f64::from(uncovered_cells) / f64::from(columns * rows)
}

/// Returns the energy of `level` units.
fn units(level: u64) -> Energy {
    Energy::from_micro(level * 1_000_000)
}

/// Returns the batteries of the devices in `state`.
fn energies_of(state: usize) -> Vec<Energy> {
    let energy = |j: u32| units((state / LEVELS.pow(j) % LEVELS) as u64);
    (0..N as u32).map(energy).collect()
}

/// Returns the set of devices whose batteries are empty in `state`.
fn empty_devices(state: usize) -> usize {
    (0..N)
        .filter(|&j| (state / LEVELS.pow(j as u32)).is_multiple_of(LEVELS))
        .map(|j| 1 << j)
        .sum()
}

#[test]
fn the_learner_comes_close_to_the_optimum() {
    let cross = [(1.5, 1.5), (6.0, 1.0), (2.0, 6.5), (6.5, 6.0), (4.0, 4.0), (3.0, 3.5)];
    let pairs = [(2.0, 3.0), (2.4, 2.5), (6.0, 3.2), (6.3, 2.6), (10.0, 3.0), (9.6, 3.4)];
    for (name, (width, height), points) in [("cross", (8.0, 8.0), cross), ("pairs", (12.0, 6.0), pairs)] {
        let (lambda, uncovered_weight) = (0.15, 2.0);
        let network = SixDevices::new(Area { width, height }, &points, lambda, uncovered_weight);
        let buckets: Vec<usize> = (0..LEVELS as u64)
            .map(|level| battery_bucket(units(level), &network.energy()))
            .collect();
        assert_eq!(buckets, [0, 2, 4, 6, 7], "each level has its own bucket in the learner");
        let learned = network.learned_actions(&train(&network.scenario));
        let greedy = network.greedy_actions();
        let policies = [None, Some(&learned[..]), Some(&greedy[..])];
        // The possible gain: r(k) above the reward of a sleeping network.
        let gain = |reward: f64| reward - (1.0 - network.uncovered_weight);
        let mean_gains = policies.map(|policy| gain(network.mean_reward(policy)));
        let discounted_gains = policies.map(|policy| gain(network.discounted_reward(policy)));
        let [best_mean, learned_mean, greedy_mean] = mean_gains;
        let [best_discounted, learned_discounted, _] = discounted_gains;
        let gains = format!("{name}: optimum, learner, greedy: mean {mean_gains:?}, discounted {discounted_gains:?}");
        println!("{gains}");
        assert!(
            learned_mean <= best_mean + SPAN && learned_discounted <= best_discounted + SPAN,
            "above the optimum: {gains}"
        );
        // Required of the learner, not measured: the printed gains are measured.
        assert!(learned_mean >= 0.98 * best_mean, "{gains}");
        assert!(learned_discounted >= 0.95 * best_discounted, "{gains}");
        // The network is not trivial: ignoring energy is much worse than the optimum.
        assert!(greedy_mean < 0.95 * best_mean, "{gains}");
    }
}
