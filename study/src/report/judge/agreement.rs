//! Agreement of findings with a statement: rules 2 and 3 of [`super`], for the means and for all values in their
//! intervals. The tolerances are part of the rule; [`super`] lists the other places that state it.

use super::finding::Finding;
use crate::claims::Statement;

/// Maximum deviation from a stated value that still counts as equal, as a share of the value.
const EQUAL_TOLERANCE: f64 = 0.05;
/// Maximum deviation from a stated value or range that counts as near, as a share of it. Also the maximum deviation
/// from the middle for a constant level.
const NEAR_TOLERANCE: f64 = 0.2;
/// Maximum step against a trend, as a share of the range of all means.
const TREND_TOLERANCE: f64 = 0.1;
/// Allowance for binary rounding at the limit of 20 %.
const ROUNDING: f64 = 1e-9;

/// Level of an agreement, from the worst to the best: minima and maxima of levels rely on this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AgreementLevel {
    /// No agreement.
    No,
    /// Within 20 % of the statement.
    Near,
    /// As stated.
    Yes,
}

/// Agreement of the means, and the range of agreements within their intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Agreement {
    /// Agreement of the means.
    pub of_means: AgreementLevel,
    /// Worst agreement within the intervals.
    pub worst: AgreementLevel,
    /// Best agreement within the intervals.
    pub best: AgreementLevel,
}

impl Agreement {
    /// Computes the agreement of `findings` with `statement`; `None` if there are too few findings.
    pub fn of_findings(statement: Statement, findings: &[Finding]) -> Option<Self> {
        if statement.range().is_some() {
            return findings
                .iter()
                .map(|finding| Self::at_one_n(statement, finding))
                .reduce(Self::worse);
        }
        let mut others: Vec<Option<&str>> = Vec::new();
        for finding in findings {
            if !others.contains(&finding.other_policy) {
                others.push(finding.other_policy);
            }
        }
        let by_policy = others.into_iter().map(|other| -> Vec<Finding> {
            let of_policy = findings.iter().filter(|finding| finding.other_policy == other);
            of_policy.copied().collect()
        });
        by_policy
            .filter(|of_policy| of_policy.len() > 1)
            .map(|of_policy| Self::over_all_n(statement, &of_policy))
            .reduce(Self::worse)
    }

    /// Whether the agreement is the same throughout the intervals.
    pub(crate) fn is_firm(self) -> bool {
        self.worst == self.best
    }

    /// Agreement with both of two statements: the worse level of each field.
    fn worse(self, other: Self) -> Self {
        Self {
            of_means: self.of_means.min(other.of_means),
            worst: self.worst.min(other.worst),
            best: self.best.min(other.best),
        }
    }

    /// Computes the agreement of one finding with a statement on each N, which has a range.
    fn at_one_n(statement: Statement, finding: &Finding) -> Self {
        let Finding { value, low, high, .. } = *finding;
        let level = |x: f64| agreement_level(statement, x, finding.zero_limit);
        // Each statement here is a range: the point of the interval nearest to the range agrees best, and an end
        // agrees worst.
        let (from, to) = statement.range().unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        let nearest = if low > to { low } else { from.max(low).min(high) };
        Self {
            of_means: level(value),
            worst: level(low).min(level(high)),
            best: level(nearest).max(level(low)).max(level(high)),
        }
    }

    /// Computes the agreement with a statement on several N together, which has no range. `of_policy` are the findings
    /// against one policy, not empty and in ascending order of N.
    fn over_all_n(statement: Statement, of_policy: &[Finding]) -> Self {
        match statement {
            Statement::Largest(v) => Self::at_one_n(Statement::About(v), &extreme_finding(of_policy, f64::max)),
            Statement::Smallest(v) => Self::at_one_n(Statement::About(v), &extreme_finding(of_policy, f64::min)),
            Statement::Constant => Self::constancy(of_policy),
            Statement::Falls => Self::trend(of_policy, |x| x),
            Statement::Rises => Self::trend(of_policy, |x| -x),
            Statement::About(_) | Statement::Between(..) | Statement::Below(_) | Statement::Above(_) => Self {
                of_means: AgreementLevel::No,
                worst: AgreementLevel::No,
                best: AgreementLevel::No,
            },
        }
    }

    /// Computes the agreement with a constant level: [`AgreementLevel::Yes`] or [`AgreementLevel::No`].
    fn constancy(of_policy: &[Finding]) -> Self {
        let values = |value_of: fn(&Finding) -> f64| of_policy.iter().map(value_of);
        let largest = |value_of| values(value_of).fold(f64::NEG_INFINITY, f64::max);
        let smallest = |value_of| values(value_of).fold(f64::INFINITY, f64::min);
        let zero_limit = smallest(|f| f.zero_limit);
        let is_level = |least: f64, most: f64| {
            // Half the range over the middle; multiplied out, since the middle may be 0.
            let is_near = most.is_finite() && most - least <= (NEAR_TOLERANCE + ROUNDING) * (most + least);
            most <= least || most <= zero_limit || is_near
        };
        Self {
            of_means: agreement_if(is_level(smallest(|f| f.value), largest(|f| f.value))),
            worst: agreement_if(is_level(smallest(|f| f.low), largest(|f| f.high))),
            best: agreement_if(is_level(smallest(|f| f.high), largest(|f| f.low))),
        }
    }

    /// Computes the agreement with a falling trend from the first to the last, after `sign` is applied to the values:
    /// the identity for a falling trend, the negation for a rising one.
    fn trend(of_policy: &[Finding], sign: fn(f64) -> f64) -> Self {
        let signed_limits = |f: &Finding| {
            let (a, b) = (sign(f.low), sign(f.high));
            (a.min(b), a.max(b))
        };
        let values = || of_policy.iter().map(|f| f.value);
        let range = values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min);
        let allowed = TREND_TOLERANCE * range + ROUNDING * range.abs();
        // The largest rise from an earlier to a later finding, by the given value of each.
        let rise = |later_value: &dyn Fn(&Finding) -> f64, earlier_value: &dyn Fn(&Finding) -> f64| {
            let pairs = of_policy
                .iter()
                .enumerate()
                .flat_map(|(i, later)| of_policy[..i].iter().map(move |earlier| (earlier, later)));
            pairs
                .map(|(earlier, later)| later_value(later) - earlier_value(earlier))
                .fold(f64::NEG_INFINITY, f64::max)
        };
        let (Some(first), Some(last)) = (of_policy.first(), of_policy.last()) else {
            return Self {
                of_means: AgreementLevel::No,
                worst: AgreementLevel::No,
                best: AgreementLevel::No,
            };
        };
        let mean = |f: &Finding| sign(f.value);
        let of_means = agreement_if(mean(last) < mean(first) && rise(&mean, &mean) <= allowed);
        let (low, high) = (|f: &Finding| signed_limits(f).0, |f: &Finding| signed_limits(f).1);
        Self {
            of_means,
            // `allowed` follows from the means alone, so `worst` and `best` are clamped to their sides of `of_means`.
            worst: agreement_if(high(last) < low(first) && rise(&high, &low) <= allowed).min(of_means),
            best: agreement_if(low(last) < high(first) && rise(&low, &high) <= allowed).max(of_means),
        }
    }
}

/// Largest or smallest of `of_policy`, with the range of values that it can have.
///
/// # Panics
/// If there are no findings.
fn extreme_finding(of_policy: &[Finding], pick: fn(f64, f64) -> f64) -> Finding {
    let pick_of = |value_of: fn(&Finding) -> f64| of_policy.iter().map(value_of).reduce(pick).unwrap_or(f64::NAN);
    let value = pick_of(|f| f.value);
    let extreme = of_policy.iter().find(|f| f.value.total_cmp(&value).is_eq());
    Finding {
        value,
        low: pick_of(|f| f.low),
        high: pick_of(|f| f.high),
        ..*extreme.unwrap_or(&of_policy[0])
    }
}

/// Computes the level of agreement of `x` with a statement that has a range. Values up to `zero_limit` count as 0.
fn agreement_level(statement: Statement, x: f64, zero_limit: f64) -> AgreementLevel {
    match statement {
        Statement::About(0.0) => agreement_if(x <= zero_limit),
        Statement::About(v) => agreement_with_range(x, v, v, EQUAL_TOLERANCE),
        Statement::Between(low, high) => agreement_with_range(x, low, high, 0.0),
        Statement::Below(v) => agreement_if(x < v),
        Statement::Above(v) => agreement_if(x > v),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Constant | Statement::Falls | Statement::Rises => {
            AgreementLevel::No
        }
    }
}

/// Computes the level of agreement of `x` with the single stated value `stated`.
pub fn agreement_with_value(x: f64, stated: f64) -> AgreementLevel {
    agreement_with_range(x, stated, stated, EQUAL_TOLERANCE)
}

/// Returns the level of a statement that has no margin.
fn agreement_if(is_met: bool) -> AgreementLevel {
    if is_met {
        AgreementLevel::Yes
    } else {
        AgreementLevel::No
    }
}

/// Checks `x` against `low` to `high`, widened by `equal_tolerance` or by [`NEAR_TOLERANCE`] as a share of each end.
fn agreement_with_range(x: f64, low: f64, high: f64, equal_tolerance: f64) -> AgreementLevel {
    let within = |tolerance: f64| {
        let tolerance = tolerance + ROUNDING;
        (low - tolerance * low.abs()..=high + tolerance * high.abs()).contains(&x)
    };
    if within(equal_tolerance) {
        AgreementLevel::Yes
    } else if within(NEAR_TOLERANCE) {
        AgreementLevel::Near
    } else {
        AgreementLevel::No
    }
}
