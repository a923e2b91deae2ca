//! Markov chain of the battery level (Sec. III-B) under a fixed duty cycle, and its steady state.
//!
//! A state is a level on the [`Lattice`] at a phase of the duty cycle. A TTI follows the device machine, with which a
//! test compares the chain: the device harvests up to E_max and pays for δ. If it becomes active (a detection in S1, a
//! wake-up in S4), it pays for the transmission. A cost that it cannot pay empties the battery. There is a list of
//! transitions for each δ. The steady distribution at the start of a cycle is unchanged by t_DRX steps. Only
//! [`super::compare`] solves the chain.

use super::lattice::Lattice;
use crate::analysis::AnalysisError;

/// Residual below which a distribution counts as steady.
const STEADY_RESIDUAL: f64 = 1e-11;
/// Maximum number of transitions before the solver gives up.
const MAX_TRANSITIONS: u64 = 4_000_000;

/// Input of the chain for one device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChainInput {
    /// TTIs in S1 per cycle, `0 ..= t_drx`.
    pub t_on: u32,
    /// TTIs in a cycle, ≥ 1.
    pub t_drx: u32,
    /// Probability of an arrival in a TTI, `(0, 1)`.
    pub arrival: f64,
    /// Probability that the device becomes active in a TTI, in any state, `[0, 1]`: the paper's P_1,2 + P_4,2.
    pub activation: f64,
}

impl ChainInput {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// If a field is out of its range.
    pub fn check(&self) -> Result<(), AnalysisError> {
        const MAX_CYCLE_TTIS: u32 = 1 << 20;
        let Self { t_on, t_drx, .. } = *self;
        if t_drx == 0 || t_drx > MAX_CYCLE_TTIS {
            let requirement = format!("must be a number of TTIs from 1 to {MAX_CYCLE_TTIS}");
            return Err(AnalysisError::invalid("t_DRX", &t_drx, requirement));
        }
        if t_on > t_drx {
            let requirement =
                format!("must be at most t_DRX = {t_drx}, the length of the cycle that t_on is a part of");
            return Err(AnalysisError::invalid("t_on", &t_on, requirement));
        }
        if !(self.arrival > 0.0 && self.arrival < 1.0) {
            let requirement = "must be above 0 and below 1 for a steady state; change harvest.lambda";
            return Err(AnalysisError::invalid("Pr(arrival)", &self.arrival, requirement));
        }
        if !(0.0..=1.0).contains(&self.activation) {
            let requirement = "must be a probability, 0 to 1";
            return Err(AnalysisError::invalid("activation", &self.activation, requirement));
        }
        Ok(())
    }
}

/// Steady state of a chain.
#[derive(Clone, Debug)]
pub struct SteadyState {
    /// Probability of each level at the end of a TTI, over all phases of the cycle, from empty to full.
    pub level_probabilities: Vec<f64>,
    /// Number of transitions, one per TTI, that the iteration needed to reach the steady state.
    pub transitions_to_steady_state: u64,
    /// Σ |π P − π| over one cycle.
    pub residual: f64,
}

impl SteadyState {
    /// Probability of a level of at least `level`.
    pub(crate) fn probability_at_least(&self, level: usize) -> f64 {
        self.level_probabilities.iter().skip(level).sum()
    }
}

/// Computes the steady state of a battery on `lattice` under `input`, by power iteration.
///
/// # Errors
/// If `input` is out of range, or the chain mixes too slowly to be solved.
pub(crate) fn steady_state(lattice: &Lattice, input: &ChainInput) -> Result<SteadyState, AnalysisError> {
    input.check()?;
    let cycle = Cycle {
        s1: transitions(lattice, input, lattice.e_idle),
        s4: transitions(lattice, input, lattice.e_wur),
        input: *input,
    };
    let level_count = lattice.level_count();
    let mut distribution = vec![1.0 / level_count as f64; level_count];
    let mut buffer = vec![0.0; level_count];
    let mut transitions_to_steady_state = 0;
    loop {
        let previous = distribution.clone();
        cycle.advance_cycle(&mut distribution, &mut buffer, |_| {});
        transitions_to_steady_state += u64::from(input.t_drx);
        // Only whole cycles compare: within a cycle the distribution changes with the phase.
        let residual = distribution
            .iter()
            .zip(&previous)
            .map(|(new, old)| (new - old).abs())
            .sum();
        if residual <= STEADY_RESIDUAL {
            // Averages over the phases of another cycle, since the levels of devices are counted at the end of every
            // TTI.
            let mut level_probabilities = vec![0.0; level_count];
            cycle.advance_cycle(&mut distribution, &mut buffer, |at_tti_end| {
                for (mean, probability) in level_probabilities.iter_mut().zip(at_tti_end) {
                    *mean += probability / f64::from(input.t_drx);
                }
            });
            return Ok(SteadyState {
                level_probabilities,
                transitions_to_steady_state,
                residual,
            });
        }
        if transitions_to_steady_state > MAX_TRANSITIONS {
            let requirement = format!(
                "of one cycle should be at most {STEADY_RESIDUAL:e} after {MAX_TRANSITIONS} TTIs; the chain mixes \
                 too slowly"
            );
            return Err(AnalysisError::invalid("residual", &residual, requirement));
        }
    }
}

/// A transition between battery levels in one TTI.
struct Transition {
    /// Level at the start of the TTI.
    from: usize,
    /// Level at its end.
    to: usize,
    /// Probability of this transition at level `from`.
    probability: f64,
}

/// Transitions of one cycle.
struct Cycle {
    /// Transitions of a TTI in S1.
    s1: Vec<Transition>,
    /// Transitions of a TTI in S4.
    s4: Vec<Transition>,
    input: ChainInput,
}

impl Cycle {
    /// Advances the `distribution` over levels by one cycle, and passes it to `visit` at the end of each TTI. `buffer`
    /// has the same length; its content does not matter.
    fn advance_cycle(&self, distribution: &mut Vec<f64>, buffer: &mut Vec<f64>, mut visit: impl FnMut(&[f64])) {
        for phase in 0..self.input.t_drx {
            buffer.fill(0.0);
            let transitions = if phase < self.input.t_on { &self.s1 } else { &self.s4 };
            for transition in transitions {
                buffer[transition.to] += transition.probability * distribution[transition.from];
            }
            std::mem::swap(distribution, buffer);
            visit(distribution);
        }
    }
}

/// Returns the transitions of a TTI that costs `cost` quanta, by their first level. Several may have the same levels.
fn transitions(lattice: &Lattice, input: &ChainInput, cost: usize) -> Vec<Transition> {
    let mut transitions = Vec::new();
    for from in 0..lattice.level_count() {
        let mut add = |to, probability| transitions.push(Transition { from, to, probability });
        let after_arrival = (from + lattice.e_b).min(lattice.e_max);
        for (charged, probability) in [(after_arrival, input.arrival), (from, 1.0 - input.arrival)] {
            // A device that cannot pay for δ ends empty, and no detection or wake-up makes it active.
            let Some(remaining) = charged.checked_sub(cost) else {
                add(0, probability);
                continue;
            };
            // A transmission that the device cannot pay for empties the battery.
            add(remaining.saturating_sub(lattice.e_tx), probability * input.activation);
            add(remaining, probability * (1.0 - input.activation));
        }
    }
    transitions
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// Probability of an arrival in a TTI; p in the comments below.
    const ARRIVAL: f64 = 0.3;

    const TWO_LEVELS: Lattice = Lattice {
        quanta_per_unit: 1,
        e_max: 1,
        e_idle: 1,
        e_wur: 0,
        e_tx: 9,
        e_b: 1,
    };
    const E_IDLE_OF_14: Lattice = Lattice {
        e_max: 140,
        e_idle: 14,
        e_wur: 1,
        e_tx: 40,
        e_b: 35,
        ..TWO_LEVELS
    };

    fn input_of(t_on: u32, t_drx: u32, activation: f64) -> ChainInput {
        ChainInput {
            t_on,
            t_drx,
            arrival: ARRIVAL,
            activation,
        }
    }

    fn assert_steady_state(lattice: &Lattice, input: &ChainInput, expected: &[f64]) {
        let steady = steady_state(lattice, input).expect("a steady state");
        assert_eq!(steady.level_probabilities.len(), expected.len());
        let pairs = steady.level_probabilities.iter().zip(expected);
        for (level, (probability, expected_probability)) in pairs.enumerate() {
            assert!(
                (probability - expected_probability).abs() < 1e-9,
                "level {level} of {input:?}: {steady:?}, expected {expected:?}"
            );
        }
    }

    /// Entry (l, k) is the probability of level l after k.
    fn transition_matrix(lattice: &Lattice, input: &ChainInput, cost: usize) -> DMatrix<f64> {
        let mut matrix = DMatrix::zeros(lattice.level_count(), lattice.level_count());
        for transition in transitions(lattice, input, cost) {
            matrix[(transition.to, transition.from)] += transition.probability;
        }
        matrix
    }

    #[test]
    fn two_levels_equal_a_calculation_by_hand() {
        // S1 takes any charge; in S4, free of cost, an arrival fills the battery until the next S1.
        assert_steady_state(&TWO_LEVELS, &input_of(1, 2, 0.0), &[1.0 - ARRIVAL / 2.0, ARRIVAL / 2.0]);
        // One S1 in three: full after one S4 with p, after two with 1 − (1 − p)².
        let full = (ARRIVAL + 1.0 - (1.0 - ARRIVAL) * (1.0 - ARRIVAL)) / 3.0;
        assert_steady_state(&TWO_LEVELS, &input_of(1, 3, 0.0), &[1.0 - full, full]);
    }

    #[test]
    fn three_levels_equal_a_calculation_by_hand() {
        // Always in S1: an arrival of 2 pays for this TTI and the next, unless the next has its own arrival.
        let arrivals_of_two = Lattice {
            e_max: 2,
            e_b: 2,
            ..TWO_LEVELS
        };
        assert_steady_state(&arrivals_of_two, &input_of(1, 1, 0.0), &[1.0 - ARRIVAL, ARRIVAL, 0.0]);
        // Never in S1, no cost except E_Tx = 1: births with p (1 − a), deaths with (1 − p) a, from the full battery
        // with a.
        let a = 0.2;
        let (up, down) = (ARRIVAL * (1.0 - a), (1.0 - ARRIVAL) * a);
        let weights = [1.0, up / down, up / down * up / a];
        let sum: f64 = weights.iter().sum();
        let reports_of_one = Lattice {
            e_max: 2,
            e_tx: 1,
            ..TWO_LEVELS
        };
        assert_steady_state(&reports_of_one, &input_of(0, 1, a), &weights.map(|w| w / sum));
    }

    #[test]
    fn a_failed_transmission_empties_the_battery() {
        // With at most 3 quanta, E_Tx = 5 is never paid, so each activation empties the battery.
        let a = 0.4;
        let lattice = Lattice {
            e_max: 3,
            e_tx: 5,
            ..TWO_LEVELS
        };
        let matrix = transition_matrix(&lattice, &input_of(0, 1, a), 0);
        let probabilities_into = |to: usize| (0..4).map(|from| matrix[(to, from)]).collect::<Vec<f64>>();
        assert!(
            probabilities_into(0).iter().skip(1).all(|&p| (p - a).abs() < 1e-15),
            "{matrix}"
        );
        assert!(
            (probabilities_into(2)[1] - ARRIVAL * 0.6).abs() < 1e-15 && (probabilities_into(3)[3] - 0.6).abs() < 1e-15
        );
    }

    #[test]
    fn each_column_of_the_matrix_is_a_distribution() {
        let lattice = E_IDLE_OF_14;
        for cost in [lattice.e_idle, lattice.e_wur] {
            let matrix = transition_matrix(&lattice, &input_of(1, 4, 0.1), cost);
            for column in matrix.column_iter() {
                assert!((column.sum() - 1.0).abs() < 1e-14 && column.min() >= 0.0);
            }
        }
    }

    /// Compares with the solution of (C − 1) π = 0, Σ π = 1 for the chain of levels at the start of a cycle, where C is
    /// the matrix of a whole cycle.
    #[test]
    fn the_steady_state_equals_a_dense_solution() {
        let lattice = Lattice {
            e_max: 84,
            ..E_IDLE_OF_14
        };
        let chain_input = input_of(2, 5, 0.05);
        let matrix = |cost| transition_matrix(&lattice, &chain_input, cost);
        let (s1, s4) = (matrix(lattice.e_idle), matrix(lattice.e_wur));
        let cycle = &s4 * &s4 * &s4 * &s1 * &s1;
        let level_count = lattice.level_count();
        let mut system = cycle - DMatrix::identity(level_count, level_count);
        system.row_mut(level_count - 1).fill(1.0);
        let mut right_side = DVector::zeros(level_count);
        right_side[level_count - 1] = 1.0;
        let start = system.lu().solve(&right_side).expect("regular");
        let mut sum = DVector::zeros(level_count);
        let mut levels = start;
        for step in [&s1, &s1, &s4, &s4, &s4] {
            levels = step * levels;
            sum += &levels;
        }
        let steady = steady_state(&lattice, &chain_input).expect("a steady state");
        let difference: f64 = steady
            .level_probabilities
            .iter()
            .zip(sum.iter())
            .map(|(probability, total)| (probability - total / 5.0).abs())
            .sum();
        assert!(difference < 1e-9, "sum of differences {difference}");
        assert!(steady.residual <= STEADY_RESIDUAL && (steady.probability_at_least(0) - 1.0).abs() < 1e-9);
    }

    /// The paper's system is R b = c with c all ones and R row-stochastic, followed by Σ b = 1. Its first rows already
    /// give b = (1, …, 1), whose sum is the number of states. The test shows why the chain is not solved as printed; it
    /// calls no code of this file.
    #[test]
    fn the_printed_system_has_no_solution() {
        let r = DMatrix::<f64>::from_row_slice(3, 2, &[0.7, 0.3, 0.4, 0.6, 1.0, 1.0]);
        let ones = DVector::from_element(3, 1.0);
        let square = r.rows(0, 2).into_owned();
        let b = square.lu().solve(&ones.rows(0, 2)).expect("regular");
        assert!((b[0] - 1.0).abs() < 1e-12 && (b[1] - 1.0).abs() < 1e-12);
        assert!(((&r * b)[2] - 2.0).abs() < 1e-12);
    }

    #[test]
    fn invalid_inputs_are_refused_with_the_reason() {
        for (invalid, cause) in [
            (input_of(3, 2, 0.0), "t_on = 3: must be at most t_DRX = 2"),
            (input_of(0, 0, 0.0), "t_DRX = 0"),
            (input_of(1, 2, 1.5), "activation = 1.5"),
            (
                ChainInput {
                    arrival: 0.0,
                    ..input_of(1, 2, 0.0)
                },
                "Pr(arrival) = 0",
            ),
            (
                ChainInput {
                    arrival: 1.0,
                    ..input_of(1, 2, 0.0)
                },
                "Pr(arrival) = 1",
            ),
        ] {
            let message = steady_state(&TWO_LEVELS, &invalid).expect_err(cause).to_string();
            assert!(message.contains(cause), "{message}");
        }
    }
}
