//! Wake-up decisions of `q-learning`: candidates are woken one by one until waking the best is worth nothing, by a
//! table that learns from the answers. [`QLearning`](super::QLearning), in runs and trainings, calls for each candidate
//! [`WakeLearner::state`], `is_worth_it`, `record_wake_up`, `record_answer`, then [`WakeLearner::learn`] with the state
//! of the next candidate; without learning it omits the last call. Trained tables (`learned/shipped-*.json`) hold sums
//! of these rewards by these buckets, so a change of either needs new tables.

use super::learned::{
    INFORMATION_BUCKETS, LearningRates, QWeights, REPORT_BUCKETS, SCORE_BUCKETS, Schedule, WakeTable,
    information_bucket, score_bucket,
};

/// State of a wake-up decision: buckets of the candidate's score, of Î, and of the reports so far.
pub(crate) type WakeState = [usize; 3];

/// Learner of the wake-ups of a deployment.
#[derive(Clone, Debug)]
pub struct WakeLearner {
    table: WakeTable,
    rates: LearningRates,
    /// Copy of [`WakeTable::monotone_q`], by buckets of Î, of reports and of the score, in this order.
    monotone_q: [[[f64; SCORE_BUCKETS]; REPORT_BUCKETS]; INFORMATION_BUCKETS],
    /// μ2 N, the worth of one unit of information in N r*(k).
    information_worth: f64,
    /// Ψ, the unit of the buckets of scores and information.
    psi: f64,
    /// State and previous Î of the wake-up that waits for its answer.
    awaiting_answer: Option<(WakeState, f64)>,
    /// State and reward of the last answered wake-up, until it is known whether another follows.
    last_answered: Option<(WakeState, f64)>,
}

impl WakeLearner {
    /// Creates a learner with `table` for `devices` devices, whose reports carry at most the information `psi`.
    pub fn new(table: WakeTable, weights: &QWeights, schedule: &Schedule, devices: u32, psi: f64) -> Self {
        let by_reports = |information| std::array::from_fn(|reports| table.monotone_q(information, reports));
        Self {
            monotone_q: std::array::from_fn(by_reports),
            table,
            rates: schedule.rates(),
            information_worth: weights.mu2 * f64::from(devices),
            psi,
            awaiting_answer: None,
            last_answered: None,
        }
    }

    /// Current table.
    pub const fn table(&self) -> &WakeTable {
        &self.table
    }

    /// Returns the state of a candidate after `reports` reports, with `score` and `information` in the same unit.
    pub fn state(&self, score: f64, information: f64, reports: usize) -> WakeState {
        [
            score_bucket(score / self.psi),
            information_bucket(information / self.psi),
            reports.clamp(1, REPORT_BUCKETS) - 1,
        ]
    }

    /// Whether waking is worth more than stopping, which is worth 0.
    pub fn is_worth_it(&self, state: WakeState) -> bool {
        self.q_of(state) > 0.0
    }

    fn q_of(&self, [score, information, reports]: WakeState) -> f64 {
        self.monotone_q[information][reports][score]
    }

    /// Records that the candidate of `state` is woken, with Î at `information`.
    pub fn record_wake_up(&mut self, state: WakeState, information: f64) {
        self.awaiting_answer = Some((state, information));
    }

    /// Records the outcome of the wake-up, after which Î is `information`. Returns its reward N (μ2 ΔÎ − 1/N).
    pub fn record_answer(&mut self, information: f64) -> f64 {
        let Some((state, before)) = self.awaiting_answer.take() else {
            return 0.0;
        };
        let reward = self.information_worth * (information - before) - 1.0;
        self.last_answered = Some((state, reward));
        reward
    }

    /// Learns from the last answer. `next` is the state that followed, or `None` if no candidate is left.
    pub fn learn(&mut self, next: Option<WakeState>) {
        let Some((state, reward)) = self.last_answered.take() else {
            return;
        };
        // Stopping is always possible and worth 0.
        let later_value = next.map_or(0.0, |next| self.q_of(next).max(0.0));
        self.table.at_mut(state).learn(reward + later_value, self.rates);
        // Only this row of the table has changed.
        let [_, information, reports] = state;
        self.monotone_q[information][reports] = self.table.monotone_q(information, reports);
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::{DetectionKind, Fusion, Sensing};

    use super::*;

    #[test]
    fn rewards_add_up_to_the_reward_of_the_paper_in_every_event() {
        let mut stream = Stream::new(4, Purpose::Training, 0);
        let mut wake_up_count = 0;
        for event in 0..500 {
            let devices = 1 + stream.below(250) as u32;
            let psi = 0.5 + stream.unit();
            let sensing = Sensing {
                kind: DetectionKind::Range,
                d_max: 4.0,
                eta: 1.0,
                psi,
                g: if event % 2 == 0 {
                    Fusion::Max
                } else {
                    Fusion::SumSaturation
                },
            };
            let weights = QWeights {
                mu1: 1.0,
                mu2: 5.0 * stream.unit(),
                zeta: 0.9,
            };
            let mut learner =
                WakeLearner::new(WakeTable::optimistic(1.0), &weights, &Schedule::default(), devices, psi);
            // The information of the first report is not due to a wake-up.
            let mut distances = vec![4.0 * stream.unit()];
            let fused_information = |distances: &[f64]| {
                let reports = distances.iter().map(|d| psi * libm::exp(-d));
                match sensing.g {
                    Fusion::Max => reports.fold(0.0, f64::max),
                    Fusion::SumSaturation => reports.sum::<f64>().min(psi),
                }
            };
            let first_information = fused_information(&distances);
            assert!(
                learner.record_answer(first_information).abs() < 1e-12,
                "no device was woken"
            );
            let (mut reward_sum, wake_ups) = (0.0, stream.below(20));
            let mut received = first_information;
            for _ in 0..wake_ups {
                let state = learner.state(psi * stream.unit(), received, distances.len());
                learner.record_wake_up(state, received);
                // One in three fails: the device is too far away, or its battery is empty.
                if stream.unit() < 0.67 {
                    distances.push(4.0 * stream.unit());
                }
                received = distances[1..].iter().fold(first_information, |fused, &d| {
                    sensing.fuse(fused, sensing.information(d))
                });
                reward_sum += learner.record_answer(received);
                learner.learn(None);
            }
            let n = f64::from(devices);
            let gain = fused_information(&distances) - first_information;
            let expected = n * (weights.mu2 * gain - wake_ups as f64 / n);
            assert!(
                (reward_sum - expected).abs() < 1e-9 * n,
                "event {event}: rewards add up to {reward_sum}, not {expected}"
            );
            wake_up_count += wake_ups;
        }
        assert!(wake_up_count > 3000, "too few cases: {wake_up_count} wake-ups");
    }

    #[test]
    fn the_value_of_a_wake_up_includes_that_of_the_next_state() {
        let weights = QWeights {
            mu1: 1.0,
            mu2: 2.0,
            zeta: 0.9,
        };
        let mut wake = WakeLearner::new(WakeTable::optimistic(1.0), &weights, &Schedule::default(), 50, 1.0);
        let (valuable_state, worthless_state) = ([19, 0, 0], [0, 7, 3]);
        wake.monotone_q[0][0][19] = 5.0;
        wake.monotone_q[7][3][0] = -5.0;
        // Stopping is worth 0, so the next step is never worth less.
        for (next, next_value) in [(Some(valuable_state), 5.0), (Some(worthless_state), 0.0), (None, 0.0)] {
            let mut wake = wake.clone();
            let state = wake.state(0.3, 0.1, 1);
            let value_before = wake.table().at(state).value;
            wake.record_wake_up(state, 0.1);
            let reward = wake.record_answer(0.4);
            assert!((reward - 29.0).abs() < 1e-9, "50·2·0.3 − 1");
            wake.learn(next);
            // The first visit's rate is 5^-0.7.
            let expected = value_before + libm::pow(5.0, -0.7) * (29.0 + next_value - value_before);
            assert!((wake.table().at(state).value - expected).abs() < 1e-9);
            wake.learn(next);
            assert!(
                (wake.table().at(state).value - expected).abs() < 1e-9,
                "a reward is learned once"
            );
        }
    }

    #[test]
    fn a_candidate_better_than_a_woken_one_is_woken() {
        let weights = QWeights {
            mu1: 1.0,
            mu2: 2.0,
            zeta: 0.9,
        };
        let mut table = WakeTable::optimistic(1.0);
        // Values with many visits, among others without visits.
        *table.at_mut([4, 2, 1]) = (-3.0, 500).into();
        *table.at_mut([17, 2, 1]) = (6.0, 500).into();
        let mut wake = WakeLearner::new(table, &weights, &Schedule::default(), 50, 1.0);
        let woken_scores = |wake: &WakeLearner| {
            let scores = (0..SCORE_BUCKETS).filter(|&s| wake.is_worth_it([s, 2, 1]));
            scores.collect::<Vec<_>>()
        };
        assert_eq!(woken_scores(&wake), (5..SCORE_BUCKETS).collect::<Vec<_>>());
        assert!((0..SCORE_BUCKETS).all(|s| wake.is_worth_it([s, 2, 0]) && wake.is_worth_it([s, 3, 1])));
        // The learned value applies from the next candidate on.
        for _ in 0..40 {
            wake.record_wake_up([19, 2, 1], 0.0);
            wake.record_answer(-0.4);
            wake.learn(None);
        }
        let last_value = wake.table().at([19, 2, 1]).value;
        assert!(last_value < -30.0, "value after the failures: {last_value}");
        let values = wake.table().monotone_q(2, 1);
        // The mean of the three highest scores, weighted by visits + 1.
        let pooled_value = (501.0 * 6.0 + 1.0 + 41.0 * last_value) / 543.0;
        assert!(
            values[17..].iter().all(|value| (value - pooled_value).abs() < 1e-9),
            "not pooled to {pooled_value}: {values:?}"
        );
        let mut pairs = values.iter().zip(&wake.monotone_q[2][1]);
        assert!(pairs.all(|(learned, copied)| (learned - copied).abs() < 1e-12));
    }
}
