//! Compares the tables of a learner with the exact optimum for a network of three devices, with two features that
//! [`super::six_devices`] lacks: reports that cost energy, and sensing that counts for two TTIs. Value iteration covers
//! all battery vectors, all sets of last sensing devices and all 2^3 actions. The learner then plays the same network.

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::units::Energy;

use super::six_devices::{duty_of, scenario_of, train, uncovered_share};

const N: usize = 3;
/// The number of sets of devices. An action is the set of devices that shall sense.
const SETS: usize = 1 << N;
/// E_max in units; E_idle is 1, an arrival brings 1.
const E_MAX: usize = 4;
/// The number of battery levels, from 0 to E_max.
const LEVELS: usize = E_MAX + 1;
/// The number of battery vectors: [`vector_number`] numbers them in base `LEVELS`, and [`levels_of`] is its inverse.
const VECTORS: usize = LEVELS.pow(N as u32);
const AREA: Area = Area {
    width: 9.0,
    height: 5.0,
};
const POINTS: [(f64, f64); N] = [(2.0, 2.5), (4.2, 2.5), (7.0, 2.5)];
/// The number of TTIs that a policy plays.
const PLAYED_TTIS: u64 = 60_000;

/// The parameters of a network.
#[derive(Clone, Copy)]
struct NetworkParameters {
    /// The probability of an event, which lasts one TTI.
    alpha: f64,
    /// The weight α μ1 of the uncovered share in r(k).
    uncovered_weight: f64,
    /// λ of the harvest.
    lambda: f64,
    /// E_Tx, the energy of a report, units.
    e_tx: usize,
    /// The number of TTIs for which sensing counts, 1 or 2.
    window: usize,
}

/// A network. Sets of devices and actions are numbers with a bit for each device.
struct ThreeDevices {
    parameters: NetworkParameters,
    /// The probability of an arrival of energy at a device in a TTI, λe^−λ.
    arrival_probability: f64,
    /// By set of devices, the share of the area where exactly these devices would detect an event.
    detected_shares: [f64; SETS],
    scenario: Scenario,
    points: Vec<Point>,
}

fn levels_of(vector_number: usize) -> [usize; N] {
    std::array::from_fn(|j| vector_number / LEVELS.pow(j as u32) % LEVELS)
}

fn vector_number(levels: [usize; N]) -> usize {
    (0..N).map(|j| levels[j] * LEVELS.pow(j as u32)).sum()
}

impl ThreeDevices {
    fn new(parameters: NetworkParameters) -> Self {
        let NetworkParameters {
            alpha,
            uncovered_weight,
            lambda,
            e_tx,
            window,
        } = parameters;
        let points: Vec<Point> = POINTS.iter().map(|&(x, y)| Point::new(x, y)).collect();
        let scenario = scenario_of(
            AREA,
            &points,
            &[
                &format!("policy.q-learning.window={window}"),
                &format!("policy.q-learning.mu1={}", uncovered_weight / alpha),
                "policy.q-learning.mu2=0",
                &format!("events.alpha={alpha}"),
                "events.duration=1",
                &format!("energy.e_max={E_MAX}"),
                &format!("energy.e_tx={e_tx}"),
                &format!("harvest.lambda={lambda}"),
            ],
        );
        let uncovered_by = |set: usize| {
            let sensing: Vec<Point> = (0..N).filter(|j| set >> j & 1 == 1).map(|j| points[j]).collect();
            uncovered_share(AREA, &sensing)
        };
        // By inclusion and exclusion: the share without a device outside a subset is the share where at most the
        // devices of the subset detect.
        let detected_shares = std::array::from_fn(|set: usize| {
            let subsets = (0..SETS).filter(|subset| subset & !set == 0);
            let sign = |subset: usize| {
                if (set & !subset).count_ones().is_multiple_of(2) {
                    1.0
                } else {
                    -1.0
                }
            };
            subsets
                .map(|subset| sign(subset) * uncovered_by(SETS - 1 - subset))
                .sum()
        });
        Self {
            parameters,
            arrival_probability: lambda * libm::exp(-lambda),
            detected_shares,
            scenario,
            points,
        }
    }

    /// Returns the share that the devices of `set` leave uncovered.
    fn uncovered_share_of(&self, set: usize) -> f64 {
        (0..SETS)
            .filter(|detecting_set| detecting_set & set == 0)
            .map(|detecting_set| self.detected_shares[detecting_set])
            .sum()
    }

    /// Applies `action` to batteries at `levels` if the devices of `arrived` harvest. Returns the levels, and the
    /// devices that sensed with enough energy for a report.
    fn sense(&self, mut levels: [usize; N], action: usize, arrived: usize) -> ([usize; N], usize) {
        let mut ready = 0;
        for (j, level) in levels.iter_mut().enumerate() {
            *level = (*level + (arrived >> j & 1)).min(E_MAX);
            if action >> j & 1 == 1 && *level > 0 {
                *level -= 1;
                ready |= usize::from(*level >= self.parameters.e_tx) << j;
            }
        }
        (levels, ready)
    }

    /// Returns the levels after the reports of `reporters`, each of which has the energy for one.
    fn report(&self, mut levels: [usize; N], reporters: usize) -> [usize; N] {
        for (j, level) in levels.iter_mut().enumerate() {
            *level -= if reporters >> j & 1 == 1 {
                self.parameters.e_tx
            } else {
                0
            };
        }
        levels
    }

    /// Returns r(k) if the devices `ready` sensed with enough energy for a report in this TTI, and the devices
    /// `ready_before` in the previous TTI; 0 with a window of one TTI.
    fn reward(&self, action: usize, ready: usize, ready_before: usize) -> f64 {
        let uncovered = self.uncovered_share_of(ready | ready_before);
        1.0 - f64::from(action.count_ones()) / N as f64 - self.parameters.uncovered_weight * uncovered
    }

    /// Returns the number of the next state: the batteries, and the devices `ready` of this TTI if the window still
    /// covers it then.
    fn next_state(&self, levels: [usize; N], ready: usize) -> usize {
        let ready_before = if self.parameters.window > 1 { ready } else { 0 };
        ready_before * VECTORS + vector_number(levels)
    }

    /// Returns the mean r(k) of the best policy by relative value iteration.
    fn optimal_mean(&self) -> f64 {
        let NetworkParameters { alpha, window, .. } = self.parameters;
        let states = VECTORS * if window > 1 { SETS } else { 1 };
        let probability_of = |arrived: usize| {
            let harvests = (0..N).map(|j| {
                if arrived >> j & 1 == 1 {
                    self.arrival_probability
                } else {
                    1.0 - self.arrival_probability
                }
            });
            harvests.product::<f64>()
        };
        // By state and action: the reward, and the next states with their probabilities.
        let mut steps: Vec<(f64, Vec<(usize, f64)>)> = Vec::new();
        for state in 0..states {
            for action in 0..SETS {
                let (mut reward, mut next) = (0.0, Vec::new());
                for arrived in 0..SETS {
                    let (levels, ready) = self.sense(levels_of(state % VECTORS), action, arrived);
                    let probability = probability_of(arrived);
                    reward += probability * self.reward(action, ready, state / VECTORS);
                    next.push((self.next_state(levels, ready), probability * (1.0 - alpha)));
                    for detecting_set in 0..SETS {
                        let after_report = self.report(levels, detecting_set & ready);
                        let with_event = probability * alpha * self.detected_shares[detecting_set];
                        next.push((self.next_state(after_report, ready), with_event));
                    }
                }
                steps.push((reward, next));
            }
        }
        let mut values = vec![0.0; states];
        for _ in 0..2000 {
            let expected_value = |(reward, next): &(f64, Vec<(usize, f64)>)| {
                reward
                    + next
                        .iter()
                        .map(|(state, probability)| probability * values[*state])
                        .sum::<f64>()
            };
            let best_value =
                |actions: &[(f64, Vec<(usize, f64)>)]| actions.iter().map(expected_value).fold(f64::MIN, f64::max);
            let new_values: Vec<f64> = steps.chunks(SETS).map(best_value).collect();
            let additions = new_values.iter().zip(&values).map(|(new, old)| new - old);
            let (least, most) = additions.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
            values = new_values;
            if most - least < 1e-6 {
                return 0.5 * (least + most);
            }
        }
        panic!("the values did not converge");
    }

    /// Returns the mean r(k) of `choose`, which maps the batteries of a TTI to the set of sensing devices.
    fn played_mean(&self, mut choose: impl FnMut(&[Energy]) -> usize) -> f64 {
        let NetworkParameters { alpha, window, .. } = self.parameters;
        let mut stream = Stream::new(5, Purpose::Harvest, 1);
        let (mut battery_levels, mut ready_before, mut reward_sum) = ([2; N], 0, 0.0);
        for _ in 0..PLAYED_TTIS {
            let energies = battery_levels.map(|level| Energy::from_micro(level as u64 * 1_000_000));
            let action = choose(&energies);
            let arrived = (0..N)
                .map(|j| usize::from(stream.unit() < self.arrival_probability) << j)
                .sum();
            let (levels, ready) = self.sense(battery_levels, action, arrived);
            reward_sum += self.reward(action, ready, if window > 1 { ready_before } else { 0 });
            // The epicentre of a possible event, drawn as the set of devices that would detect it.
            let mut remaining = stream.unit();
            let contains_epicentre = |share: &f64| {
                remaining -= share;
                remaining < 0.0
            };
            let detecting_set = self.detected_shares.iter().position(contains_epicentre).unwrap_or(0);
            let is_event = stream.unit() < alpha;
            battery_levels = self.report(levels, if is_event { detecting_set & ready } else { 0 });
            ready_before = ready;
        }
        reward_sum / PLAYED_TTIS as f64
    }

    /// Returns the mean r(k) of the learner, trained from empty tables.
    fn learned_mean(&self) -> f64 {
        let mut duty = duty_of(&self.scenario, &train(&self.scenario), &self.points);
        self.played_mean(|energies| duty.choose(energies).iter().map(|j| 1 << j.index()).sum())
    }
}

#[test]
fn the_learner_comes_close_to_the_optimum_with_reports_and_with_a_window_of_two_ttis() {
    let reports = NetworkParameters {
        alpha: 0.3,
        uncovered_weight: 2.0,
        lambda: 0.4,
        e_tx: 1,
        window: 1,
    };
    let expensive_reports = NetworkParameters {
        alpha: 0.6,
        uncovered_weight: 3.0,
        lambda: 0.6,
        e_tx: 2,
        window: 1,
    };
    let two_ttis = NetworkParameters {
        alpha: 0.01,
        uncovered_weight: 2.0,
        lambda: 0.25,
        e_tx: 0,
        window: 2,
    };
    for (name, parameters) in [
        ("reports", reports),
        ("expensive reports", expensive_reports),
        ("two TTIs", two_ttis),
    ] {
        let network = ThreeDevices::new(parameters);
        let total: f64 = network.detected_shares.iter().sum();
        assert!((total - 1.0).abs() < 1e-9, "shares of the area: {total}");
        // The possible gain: r(k) above the reward of a sleeping network.
        let sleep_reward = 1.0 - parameters.uncovered_weight;
        let best_gain = network.optimal_mean() - sleep_reward;
        let learned_gain = network.learned_mean() - sleep_reward;
        // Every device that could report senses, regardless of earlier sensing.
        let all_ready = |energies: &[Energy]| {
            let is_ready = |j: &usize| energies[*j].micro() >= (1 + parameters.e_tx as u64) * 1_000_000;
            (0..N).filter(is_ready).map(|j| 1 << j).sum()
        };
        let all_ready_gain = network.played_mean(all_ready) - sleep_reward;
        let gains = format!("{name}: optimum {best_gain:.4}, learner {learned_gain:.4}, all ready {all_ready_gain:.4}");
        println!("{gains}");
        // 1 % covers the noise of the played TTIs; the 95 % are required of the learner.
        assert!(learned_gain < 1.01 * best_gain, "above the optimum: {gains}");
        assert!(learned_gain > 0.95 * best_gain, "{gains}");
        assert!(all_ready_gain < 0.95 * best_gain, "the network is trivial: {gains}");
    }
}
