//! Fit of figures to a statement, and its certainty under their intervals.

use super::finding::Finding;
use crate::claims::Statement;

/// Maximum deviation from a stated value that still counts as equal, as a share of the value.
const CLOSE: f64 = 0.05;
/// Maximum deviation from a stated value or range that counts as near, as a share of it. Also the maximum deviation
/// from the middle for a constant level.
const TOLERANCE: f64 = 0.2;
/// Maximum step against a trend, as a share of the range of all means.
const AGAINST: f64 = 0.1;
/// Allowance for binary rounding at the limit of 20 %.
const ROUNDING: f64 = 1e-9;

/// Level of a fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FitLevel {
    /// No fit.
    No,
    /// Within 20 % of the statement.
    Near,
    /// As stated.
    Yes,
}

/// Fit of the means, and the range of fits within their intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fit {
    /// Fit of the means.
    pub tier: FitLevel,
    /// Worst fit within the intervals.
    pub worst: FitLevel,
    /// Best fit within the intervals.
    pub best: FitLevel,
}

impl Fit {
    /// Computes the fit of `findings` to `statement`; `None` if there are too few findings.
    pub fn of(statement: Statement, findings: &[Finding]) -> Option<Self> {
        if statement.range().is_some() {
            return findings.iter().map(|one| Self::at(statement, one)).reduce(Self::and);
        }
        let mut others: Vec<Option<&str>> = Vec::new();
        for finding in findings {
            if !others.contains(&finding.other) {
                others.push(finding.other);
            }
        }
        let rows = others.into_iter().map(|other| -> Vec<Finding> {
            let own = findings.iter().filter(|finding| finding.other == other);
            own.copied().collect()
        });
        rows.filter(|row| row.len() > 1)
            .map(|row| Self::over(statement, &row))
            .reduce(Self::and)
    }

    /// Whether the fit is the same throughout the intervals.
    pub(crate) fn is_firm(self) -> bool {
        self.worst == self.best
    }

    fn and(self, other: Self) -> Self {
        Self {
            tier: self.tier.min(other.tier),
            worst: self.worst.min(other.worst),
            best: self.best.min(other.best),
        }
    }

    /// Computes the fit to a statement on each N.
    fn at(statement: Statement, finding: &Finding) -> Self {
        let Finding { value, low, high, .. } = *finding;
        let of = |x: f64| tier(statement, x, finding.zero);
        // Each statement here is a range: the point of the interval nearest to the range fits best, and an end fits
        // worst.
        let (from, to) = statement.range().unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        let nearest = if low > to { low } else { from.max(low).min(high) };
        Self {
            tier: of(value),
            worst: of(low).min(of(high)),
            best: of(nearest).max(of(low)).max(of(high)),
        }
    }

    /// Computes the fit to a statement on several N together.
    fn over(statement: Statement, row: &[Finding]) -> Self {
        match statement {
            Statement::Largest(v) => Self::at(Statement::About(v), &extreme(row, f64::max)),
            Statement::Smallest(v) => Self::at(Statement::About(v), &extreme(row, f64::min)),
            Statement::Level => Self::level(row),
            Statement::Falls => Self::trend(row, |x| x),
            Statement::Rises => Self::trend(row, |x| -x),
            Statement::About(_) | Statement::Between(..) | Statement::Below(_) | Statement::Above(_) => Self {
                tier: FitLevel::No,
                worst: FitLevel::No,
                best: FitLevel::No,
            },
        }
    }

    fn level(row: &[Finding]) -> Self {
        let over =
            |of: fn(&Finding) -> f64, pick: fn(f64, f64) -> f64, start: f64| row.iter().map(of).fold(start, pick);
        let largest = |of| over(of, f64::max, f64::NEG_INFINITY);
        let smallest = |of| over(of, f64::min, f64::INFINITY);
        let zero = smallest(|f| f.zero);
        let is_level = |least: f64, most: f64| {
            // Half the range over the middle; multiplied out, since the middle may be 0.
            let is_near = most.is_finite() && most - least <= (TOLERANCE + ROUNDING) * (most + least);
            most <= least || most <= zero || is_near
        };
        let fits = |yes| if yes { FitLevel::Yes } else { FitLevel::No };
        Self {
            tier: fits(is_level(smallest(|f| f.value), largest(|f| f.value))),
            worst: fits(is_level(smallest(|f| f.low), largest(|f| f.high))),
            best: fits(is_level(smallest(|f| f.high), largest(|f| f.low))),
        }
    }

    /// Computes the fit to a falling trend from the first to the last, after `sign` is applied to the values.
    fn trend(row: &[Finding], sign: fn(f64) -> f64) -> Self {
        let ends = |f: &Finding| {
            let (a, b) = (sign(f.low), sign(f.high));
            (a.min(b), a.max(b))
        };
        let values = || row.iter().map(|f| f.value);
        let range = values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min);
        let allowed = AGAINST * range + ROUNDING * range.abs();
        // The largest rise from an earlier to a later finding, with `of` and `before` as their values.
        let rise = |of: &dyn Fn(&Finding) -> f64, before: &dyn Fn(&Finding) -> f64| {
            let pairs = row
                .iter()
                .enumerate()
                .flat_map(|(i, later)| row[..i].iter().map(move |earlier| (earlier, later)));
            pairs
                .map(|(earlier, later)| of(later) - before(earlier))
                .fold(f64::NEG_INFINITY, f64::max)
        };
        let (Some(first), Some(last)) = (row.first(), row.last()) else {
            return Self {
                tier: FitLevel::No,
                worst: FitLevel::No,
                best: FitLevel::No,
            };
        };
        let fits = |yes| if yes { FitLevel::Yes } else { FitLevel::No };
        let mean = |f: &Finding| sign(f.value);
        let tier = fits(mean(last) < mean(first) && rise(&mean, &mean) <= allowed);
        let (low, high) = (|f: &Finding| ends(f).0, |f: &Finding| ends(f).1);
        Self {
            tier,
            // `allowed` follows from the means alone, so `worst` and `best` are clamped to their sides of `tier`.
            worst: fits(high(last) < low(first) && rise(&high, &low) <= allowed).min(tier),
            best: fits(low(last) < high(first) && rise(&low, &high) <= allowed).max(tier),
        }
    }
}

/// Largest or smallest of `row`, with the range of values that it can have.
fn extreme(row: &[Finding], pick: fn(f64, f64) -> f64) -> Finding {
    let of = |part: fn(&Finding) -> f64| row.iter().map(part).reduce(pick).unwrap_or(f64::NAN);
    let value = of(|f| f.value);
    let own = row.iter().find(|f| f.value.total_cmp(&value).is_eq());
    Finding {
        value,
        low: of(|f| f.low),
        high: of(|f| f.high),
        ..*own.unwrap_or(&row[0])
    }
}

/// Computes the level of fit of `x`. Values up to `zero` count as 0.
fn tier(statement: Statement, x: f64, zero: f64) -> FitLevel {
    match statement {
        Statement::About(0.0) => meets(x <= zero),
        Statement::About(v) => near(x, v, v, CLOSE),
        Statement::Between(low, high) => near(x, low, high, 0.0),
        Statement::Below(v) => meets(x < v),
        Statement::Above(v) => meets(x > v),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Level | Statement::Falls | Statement::Rises => {
            FitLevel::No
        }
    }
}

/// Computes the level of fit of `x` to the single stated value `stated`.
pub fn about(x: f64, stated: f64) -> FitLevel {
    near(x, stated, stated, CLOSE)
}

fn meets(yes: bool) -> FitLevel {
    if yes { FitLevel::Yes } else { FitLevel::No }
}

/// Checks `x` against `low` to `high`, widened by `close` or by [`TOLERANCE`] as a share of each end.
fn near(x: f64, low: f64, high: f64, close: f64) -> FitLevel {
    let within = |room: f64| {
        let room = room + ROUNDING;
        (low - room * low.abs()..=high + room * high.abs()).contains(&x)
    };
    if within(close) {
        FitLevel::Yes
    } else if within(TOLERANCE) {
        FitLevel::Near
    } else {
        FitLevel::No
    }
}
