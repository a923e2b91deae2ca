//! Compares the tables of a learner with the exact optimum for a network of three devices, with two features that
//! [`super::six_devices`] lacks: reports that cost energy, and sensing that counts for two TTIs. Value iteration covers
//! all battery vectors, all sets of last sensing devices and all 2^3 actions. The learner then plays the same network.

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::{Area, Point};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::units::Energy;

use super::six_devices::{duty_of, scenario_of, train, uncovered_share};

const N: usize = 3;
const SETS: usize = 1 << N;
/// E_max in units; E_idle is 1, an arrival brings 1.
const E_MAX: usize = 4;
const LEVELS: usize = E_MAX + 1;
/// The number of battery vectors: [`vector`] numbers them in base `LEVELS`, and [`levels`] is its inverse.
const VECTORS: usize = LEVELS.pow(N as u32);
const AREA: Area = Area {
    width: 9.0,
    height: 5.0,
};
const PLACES: [(f64, f64); N] = [(2.0, 2.5), (4.2, 2.5), (7.0, 2.5)];
/// The number of TTIs that the learner plays.
const PLAYED: u64 = 60_000;

/// A network with sets of devices as bits.
struct ThreeDevices {
    /// The probability of an arrival.
    p: f64,
    /// The probability of an event, which lasts one TTI.
    alpha: f64,
    /// The weight α μ1.
    w: f64,
    /// E_Tx, the energy of a report, units.
    e_tx: usize,
    /// The number of TTIs for which sensing counts, 1 or 2.
    window: usize,
    /// By set of devices, the share of the area where exactly these devices detect an event.
    detecting: [f64; SETS],
    scenario: Scenario,
    points: Vec<Point>,
}

fn levels(vector: usize) -> [usize; N] {
    std::array::from_fn(|j| vector / LEVELS.pow(j as u32) % LEVELS)
}

fn vector(levels: [usize; N]) -> usize {
    (0..N).map(|j| levels[j] * LEVELS.pow(j as u32)).sum()
}

impl ThreeDevices {
    fn new(alpha: f64, w: f64, lambda: f64, e_tx: usize, window: usize) -> Self {
        let points: Vec<Point> = PLACES.iter().map(|&(x, y)| Point::new(x, y)).collect();
        let scenario = scenario_of(
            AREA,
            &points,
            &[
                &format!("policy.q-learning.window={window}"),
                &format!("policy.q-learning.mu1={}", w / alpha),
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
        let detecting = std::array::from_fn(|set: usize| {
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
            p: lambda * libm::exp(-lambda),
            alpha,
            w,
            e_tx,
            window,
            detecting,
            scenario,
            points,
        }
    }

    /// Returns the share that the devices of `set` leave uncovered.
    fn uncovered(&self, set: usize) -> f64 {
        (0..SETS)
            .filter(|detecting| detecting & set == 0)
            .map(|detecting| self.detecting[detecting])
            .sum()
    }

    /// Applies `action` to batteries at `levels` if the devices of `arrived` harvest. Returns the levels, and the
    /// devices that sensed with enough energy for a report.
    fn sense(&self, mut levels: [usize; N], action: usize, arrived: usize) -> ([usize; N], usize) {
        let mut able = 0;
        for (j, level) in levels.iter_mut().enumerate() {
            *level = (*level + (arrived >> j & 1)).min(E_MAX);
            if action >> j & 1 == 1 && *level > 0 {
                *level -= 1;
                able |= usize::from(*level >= self.e_tx) << j;
            }
        }
        (levels, able)
    }

    /// Returns the levels after the reports of `reporters`.
    fn report(&self, mut levels: [usize; N], reporters: usize) -> [usize; N] {
        for (j, level) in levels.iter_mut().enumerate() {
            *level -= if reporters >> j & 1 == 1 { self.e_tx } else { 0 };
        }
        levels
    }

    /// Returns r(k) if the devices `able` sensed with enough energy for a report in this TTI, and the devices
    /// `able_before` in the previous TTI.
    fn reward(&self, action: usize, able: usize, able_before: usize) -> f64 {
        1.0 - f64::from(action.count_ones()) / N as f64 - self.w * self.uncovered(able | able_before)
    }

    /// Returns the next state: the batteries, and the devices `able` of this TTI if the window still covers it then.
    fn state(&self, levels: [usize; N], able: usize) -> usize {
        let able_before = if self.window > 1 { able } else { 0 };
        able_before * VECTORS + vector(levels)
    }

    /// Returns the mean r(k) of the best policy by relative value iteration.
    fn optimal_mean(&self) -> f64 {
        let states = VECTORS * if self.window > 1 { SETS } else { 1 };
        let probability = |arrived: usize| {
            let harvests = (0..N).map(|j| if arrived >> j & 1 == 1 { self.p } else { 1.0 - self.p });
            harvests.product::<f64>()
        };
        // By state and action: the reward, and the next states with their probabilities.
        let mut steps: Vec<(f64, Vec<(usize, f64)>)> = Vec::new();
        for state in 0..states {
            for action in 0..SETS {
                let (mut reward, mut next) = (0.0, Vec::new());
                for arrived in 0..SETS {
                    let (levels, able) = self.sense(levels(state % VECTORS), action, arrived);
                    reward += probability(arrived) * self.reward(action, able, state / VECTORS);
                    next.push((self.state(levels, able), probability(arrived) * (1.0 - self.alpha)));
                    for detecting in 0..SETS {
                        let after_report = self.report(levels, detecting & able);
                        let by_event = probability(arrived) * self.alpha * self.detecting[detecting];
                        next.push((self.state(after_report, able), by_event));
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
        let mut stream = Stream::new(5, Purpose::Harvest, 1);
        let (mut battery_levels, mut able_before, mut sum) = ([2; N], 0, 0.0);
        for _ in 0..PLAYED {
            let energies = battery_levels.map(|level| Energy::from_micro(level as u64 * 1_000_000));
            let action = choose(&energies);
            let arrived = (0..N).map(|j| usize::from(stream.unit() < self.p) << j).sum();
            let (levels, able) = self.sense(battery_levels, action, arrived);
            sum += self.reward(action, able, if self.window > 1 { able_before } else { 0 });
            let mut place = stream.unit();
            let contains_place = |share: &f64| {
                place -= share;
                place < 0.0
            };
            let detecting = self.detecting.iter().position(contains_place).unwrap_or(0);
            let is_event = stream.unit() < self.alpha;
            battery_levels = self.report(levels, if is_event { detecting & able } else { 0 });
            able_before = able;
        }
        sum / PLAYED as f64
    }

    /// Returns the mean r(k) of the learner, trained from empty tables.
    fn learned_mean(&self) -> f64 {
        let mut duty = duty_of(&self.scenario, &train(&self.scenario), &self.points);
        self.played_mean(|energies| duty.choose(energies).iter().map(|j| 1 << j.index()).sum())
    }
}

#[test]
fn the_learner_comes_close_to_the_optimum_with_reports_and_with_a_window_of_two_ttis() {
    for (name, network) in [
        // α, the weight α μ1, λ, E_Tx in units, and the window in TTIs.
        ("reports", ThreeDevices::new(0.3, 2.0, 0.4, 1, 1)),
        ("expensive reports", ThreeDevices::new(0.6, 3.0, 0.6, 2, 1)),
        ("two TTIs", ThreeDevices::new(0.01, 2.0, 0.25, 0, 2)),
    ] {
        let total: f64 = network.detecting.iter().sum();
        assert!((total - 1.0).abs() < 1e-9, "shares of the area: {total}");
        // The possible gain: r(k) above the reward of a sleeping network.
        let sleep_reward = 1.0 - network.w;
        let best_gain = network.optimal_mean() - sleep_reward;
        let learned_gain = network.learned_mean() - sleep_reward;
        // Every device that could report senses, regardless of earlier sensing.
        let all_able = |energies: &[Energy]| {
            let is_able = |j: &usize| energies[*j].micro() >= (1 + network.e_tx as u64) * 1_000_000;
            (0..N).filter(is_able).map(|j| 1 << j).sum()
        };
        let all_able_gain = network.played_mean(all_able) - sleep_reward;
        let gains = format!("{name}: optimum {best_gain:.4}, learner {learned_gain:.4}, all able {all_able_gain:.4}");
        println!("{gains}");
        // 1 % covers the noise of the played TTIs.
        assert!(learned_gain < 1.01 * best_gain, "above the optimum: {gains}");
        assert!(learned_gain > 0.95 * best_gain, "{gains}");
        assert!(all_able_gain < 0.95 * best_gain, "the network is trivial: {gains}");
    }
}
