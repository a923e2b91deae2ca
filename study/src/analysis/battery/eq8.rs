//! Eq. (8), the paper's Pr(B ≥ E): as printed, by the incomplete beta function that it names, and by the one that its
//! sum is.
//!
//! With P = P_1,2 + P_4,2 and M = ⌈E_max/E_λ⌉, E_λ = E_B exp(-λ), Eq. (8) prints Σ_{B=E}^{M} C(B, E) P^E (1 − P)^{B−E}.
//! Each term is the probability of E successes in B trials, so a term of one distribution for each B: they are no
//! disjoint events and their sum is no probability. It is Pr(the (E+1)-th success comes within M + 1 trials) / P, which
//! tends to 1/P. It rises with P, the chance to *spend*; and a larger harvest makes M, hence the sum, smaller. The text
//! then names the regularized β_{1−P}(E + 1, E_max + 1), which lies in [0, 1] but is not that sum, and does not know
//! the harvest.

use statrs::function::beta::beta_reg;
use statrs::function::gamma::ln_gamma;

/// The largest M for which Eq. (8) is evaluated.
const MOST_STATES: u64 = 1_000_000;

/// Eq. (8) for one threshold and one P. All of it is NaN where P is no probability, as P_1,2 + P_4,2 need not be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eq8 {
    /// The sum as printed; NaN where E is not a whole number of units, for which it is not defined, and with more than
    /// 10⁶ states.
    pub sum: f64,
    /// The sum as I_P(E + 1, M − E + 1) / P, which it equals.
    pub sum_by_beta: f64,
    /// β_{1−P}(E + 1, E_max + 1), which the paper says it is.
    pub printed_beta: f64,
}

impl Eq8 {
    /// For the threshold `e` and the battery `e_max` (units), with M = `states` and P = `activation`.
    pub fn new(e: f64, e_max: f64, states: u64, activation: f64) -> Self {
        if !(0.0..=1.0).contains(&activation) {
            return Self {
                sum: f64::NAN,
                sum_by_beta: f64::NAN,
                printed_beta: f64::NAN,
            };
        }
        Self {
            sum: sum(e, states, activation),
            sum_by_beta: sum_by_beta(e, states, activation),
            printed_beta: beta_reg(e + 1.0, e_max + 1.0, 1.0 - activation),
        }
    }

    /// Whether the sum could be a probability at all.
    pub fn is_probability(&self) -> bool {
        (0.0..=1.0).contains(&self.sum)
    }
}

/// The number of the highest battery state, M = ⌈E_max/E_λ⌉ with E_λ = E_B exp(-λ); energies in units, `e_max` > 0.
pub fn states(e_max: f64, e_b: f64, lambda: f64) -> u64 {
    (e_max / (e_b * libm::exp(-lambda))).ceil() as u64
}

fn sum(e: f64, states: u64, p: f64) -> f64 {
    if e.fract() != 0.0 || e < 0.0 || states > MOST_STATES {
        return f64::NAN;
    }
    let e = e as u64;
    (e..=states).map(|b| binomial_term(b, e, p)).sum()
}

/// C(b, e) p^e (1 − p)^{b−e}.
fn binomial_term(b: u64, e: u64, p: f64) -> f64 {
    let ln_factorial = |n: u64| ln_gamma(n as f64 + 1.0);
    // 0⁰ is 1, as in the printed formula with P = 0 or 1.
    let power = |base: f64, n: u64| if n == 0 { 0.0 } else { n as f64 * libm::log(base) };
    let ln_choose = ln_factorial(b) - ln_factorial(e) - ln_factorial(b - e);
    libm::exp(ln_choose + power(p, e) + power(1.0 - p, b - e))
}

fn sum_by_beta(e: f64, states: u64, p: f64) -> f64 {
    let b = states as f64 - e + 1.0;
    if states > MOST_STATES {
        f64::NAN
    } else if b <= 0.0 {
        0.0
    } else if p <= 0.0 {
        if e > 0.0 { 0.0 } else { states as f64 + 1.0 }
    } else {
        beta_reg(e + 1.0, b, p) / p
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum in integers and powers, without logarithms.
    fn plain(e: u64, states: u64, p: f64) -> f64 {
        let mut total = 0.0;
        for b in e..=states {
            let choose = (0..e).fold(1.0, |c, i| c * (b - i) as f64 / (e - i) as f64);
            total += choose * p.powi(e as i32) * (1.0 - p).powi((b - e) as i32);
        }
        total
    }

    #[test]
    fn the_sum_is_its_incomplete_beta_form() {
        for (e, states_) in [(10, 111), (10, 23), (10, 12), (1, 111), (1, 12), (0, 5), (10, 9)] {
            for p in [1e-4, 0.01, 0.1, 0.37, 0.5, 0.9, 0.999] {
                let found = Eq8::new(e as f64, 100.0, states_, p);
                let expected = plain(e, states_, p);
                for value in [found.sum, found.sum_by_beta] {
                    assert!(
                        (value - expected).abs() <= 1e-9 * expected + 1e-300,
                        "{e} {states_} {p}: {found:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn it_is_not_a_probability() {
        // Towards 1/P, here 5 and 2.
        assert!((Eq8::new(10.0, 100.0, 1000, 0.2).sum - 5.0).abs() < 1e-9);
        let half = Eq8::new(10.0, 100.0, states(100.0, 1.0, 0.1), 0.5);
        assert!((half.sum - 2.0).abs() < 1e-9 && !half.is_probability());
        // More energy in an arrival, less of it.
        let by_e_b = [1.0, 5.0, 10.0].map(|e_b| Eq8::new(10.0, 100.0, states(100.0, e_b, 0.1), 0.3).sum);
        assert!(by_e_b[0] > by_e_b[1] && by_e_b[1] > by_e_b[2], "{by_e_b:?}");
        // And it is not the function that the text names.
        assert!((half.printed_beta - half.sum).abs() > 0.9);
    }

    #[test]
    fn the_ends_of_p_are_defined() {
        for p in [0.0, 1.0] {
            let end = Eq8::new(10.0, 100.0, 111, p);
            assert!(
                (end.sum - p).abs() < 1e-12 && (end.sum_by_beta - p).abs() < 1e-12,
                "{end:?}"
            );
        }
        assert!(Eq8::new(2.5, 100.0, 111, 0.1).sum.is_nan());
        for p in [-0.1, 1.1, f64::NAN] {
            assert!(Eq8::new(10.0, 100.0, 111, p).sum.is_nan());
        }
        // A source that all but never gives anything: E_λ next to nothing, or nothing.
        for endless in [states(100.0, 5.0, 40.0), states(100.0, 0.0, 0.1)] {
            assert!(Eq8::new(10.0, 100.0, endless, 0.1).sum.is_nan());
        }
        assert_eq!(states(100.0, 5.0, 0.1), 23);
    }
}
