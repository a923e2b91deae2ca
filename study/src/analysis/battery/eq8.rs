//! Eq. (8), the paper's Pr(B ≥ E), in three forms: as printed, by the incomplete beta function that the paper names,
//! and by the one that equals its sum.
//!
//! With P = P_1,2 + P_4,2 and M = ⌈E_max/E_λ⌉, E_λ = E_B exp(-λ), Eq. (8) prints Σ_{B=E}^{M} C(B, E) P^E (1 − P)^{B−E}.
//! Each term is the probability of E successes in B trials. The terms belong to a different distribution for each B, so
//! their events are not disjoint and the sum is not a probability. The sum is Pr(the (E+1)-th success comes within M +
//! 1 trials) / P, which tends to 1/P. It rises with P, the chance to *spend*. A larger harvest makes M, and hence the
//! sum, smaller. The text names the regularised β_{1−P}(E + 1, E_max + 1). That value lies in [0, 1], but it is not the
//! sum and does not depend on the harvest.
//!
//! [`super::compare`] evaluates it for `reveille analyse battery`, and `transitions` uses the sum as P_2,3.

use statrs::function::beta::beta_reg;
use statrs::function::gamma::ln_gamma;

/// Largest M for which Eq. (8) is evaluated; the fields of [`Eq8`] repeat it as 10⁶.
const MAX_M: u64 = 1_000_000;

/// Eq. (8) for one threshold and one P. The formulas are the paper's and must not be corrected. All values are NaN if P
/// is not a probability, which P_1,2 + P_4,2 need not be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eq8 {
    /// Sum as printed. NaN with M above 10⁶, and if E is not a whole number of units, for which the sum is undefined.
    pub sum: f64,
    /// The equal value I_P(E + 1, M − E + 1) / P. NaN with M above 10⁶.
    pub sum_by_beta: f64,
    /// β_{1−P}(E + 1, E_max + 1), which the paper equates with the sum.
    pub printed_beta: f64,
}

/// Values in Eq. (8).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eq8Input {
    /// Threshold E, units.
    pub e: f64,
    /// Capacity E_max of the battery, units.
    pub e_max: f64,
    /// M, of [`highest_state`].
    pub m: u64,
    /// P = P_1,2 + P_4,2.
    pub activation: f64,
}

impl Eq8 {
    /// Evaluates Eq. (8) for `input`.
    pub fn new(input: Eq8Input) -> Self {
        let Eq8Input {
            e,
            e_max,
            m,
            activation,
        } = input;
        if !(0.0..=1.0).contains(&activation) {
            return Self {
                sum: f64::NAN,
                sum_by_beta: f64::NAN,
                printed_beta: f64::NAN,
            };
        }
        Self {
            sum: printed_sum(e, m, activation),
            sum_by_beta: sum_by_beta(e, m, activation),
            printed_beta: beta_reg(e + 1.0, e_max + 1.0, 1.0 - activation),
        }
    }
}

/// Computes the number of the highest battery state, M = ⌈E_max/E_λ⌉ with E_λ = E_B exp(-λ); energies in units, `e_max`
/// > 0.
pub fn highest_state(e_max: f64, e_b: f64, lambda: f64) -> u64 {
    (e_max / (e_b * libm::exp(-lambda))).ceil() as u64
}

fn printed_sum(e: f64, m: u64, p: f64) -> f64 {
    if e.fract() != 0.0 || e < 0.0 || m > MAX_M {
        return f64::NAN;
    }
    let e = e as u64;
    (e..=m).map(|b| binomial_term(b, e, p)).sum()
}

/// Computes C(b, e) p^e (1 − p)^{b−e}.
fn binomial_term(b: u64, e: u64, p: f64) -> f64 {
    let ln_factorial = |n: u64| ln_gamma(n as f64 + 1.0);
    // 0⁰ is 1, as in the printed formula with P = 0 or 1; 0 · ln 0 would be NaN.
    let ln_power = |base: f64, n: u64| if n == 0 { 0.0 } else { n as f64 * libm::log(base) };
    // Uses logarithms, since the factorials overflow from 171! on.
    let ln_choose = ln_factorial(b) - ln_factorial(e) - ln_factorial(b - e);
    libm::exp(ln_choose + ln_power(p, e) + ln_power(1.0 - p, b - e))
}

fn sum_by_beta(e: f64, m: u64, p: f64) -> f64 {
    let b = m as f64 - e + 1.0;
    if m > MAX_M {
        f64::NAN
    } else if b <= 0.0 {
        0.0
    } else if p <= 0.0 {
        // Limit of the quotient for P → 0: with E = 0 each of the M + 1 terms is 1.
        if e > 0.0 { 0.0 } else { m as f64 + 1.0 }
    } else {
        beta_reg(e + 1.0, b, p) / p
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Evaluates Eq. (8) with E_max = 100 units.
    fn eq8_of(e: f64, m: u64, activation: f64) -> Eq8 {
        let e_max = 100.0;
        Eq8::new(Eq8Input {
            e,
            e_max,
            m,
            activation,
        })
    }

    /// Computes the sum with powers and binomial coefficients, without logarithms.
    fn direct_sum(e: u64, m: u64, p: f64) -> f64 {
        let mut total = 0.0;
        for b in e..=m {
            let choose = (0..e).fold(1.0, |c, i| c * (b - i) as f64 / (e - i) as f64);
            total += choose * p.powi(e as i32) * (1.0 - p).powi((b - e) as i32);
        }
        total
    }

    #[test]
    fn both_forms_equal_a_direct_sum() {
        for (e, m) in [(10, 111), (10, 23), (10, 12), (1, 111), (1, 12), (0, 5), (10, 9)] {
            for p in [1e-4, 0.01, 0.1, 0.37, 0.5, 0.9, 0.999] {
                let eq8 = eq8_of(e as f64, m, p);
                let expected = direct_sum(e, m, p);
                for value in [eq8.sum, eq8.sum_by_beta] {
                    assert!(
                        (value - expected).abs() <= 1e-9 * expected + 1e-300,
                        "E = {e}, M = {m}, P = {p}: {eq8:?}, expected {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_sum_of_eq_8_is_not_a_probability() {
        // The sum tends to 1/P, here 5 and 2.
        assert!((eq8_of(10.0, 1000, 0.2).sum - 5.0).abs() < 1e-9);
        let half = eq8_of(10.0, highest_state(100.0, 1.0, 0.1), 0.5);
        assert!((half.sum - 2.0).abs() < 1e-9, "{half:?}");
        // A larger arrival makes the sum smaller.
        let by_e_b = [1.0, 5.0, 10.0].map(|e_b| eq8_of(10.0, highest_state(100.0, e_b, 0.1), 0.3).sum);
        assert!(by_e_b[0] > by_e_b[1] && by_e_b[1] > by_e_b[2], "{by_e_b:?}");
        // The function that the text names has another value.
        assert!((half.printed_beta - half.sum).abs() > 0.9);
    }

    #[test]
    fn the_limits_of_p_are_defined_and_invalid_values_are_nan() {
        for p in [0.0, 1.0] {
            let at_limit = eq8_of(10.0, 111, p);
            assert!(
                (at_limit.sum - p).abs() < 1e-12 && (at_limit.sum_by_beta - p).abs() < 1e-12,
                "{at_limit:?}"
            );
        }
        assert!(eq8_of(2.5, 111, 0.1).sum.is_nan());
        for p in [-0.1, 1.1, f64::NAN] {
            assert!(eq8_of(10.0, 111, p).sum.is_nan());
        }
        // A source that almost never yields anything: E_λ is nearly or exactly 0.
        for m in [highest_state(100.0, 5.0, 40.0), highest_state(100.0, 0.0, 0.1)] {
            assert!(eq8_of(10.0, m, 0.1).sum.is_nan());
        }
        assert_eq!(highest_state(100.0, 5.0, 0.1), 23);
    }
}
