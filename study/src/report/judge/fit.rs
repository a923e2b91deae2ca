//! How well figures fit a statement, and whether all of their intervals say the same.

use super::finding::Finding;
use crate::claims::Statement;

/// How far from a stated value is still that value, as a share of it.
const CLOSE: f64 = 0.05;
/// How far from a stated value or range is still near it, as a share of it; and how far from the middle what stays
/// level may go.
const TOLERANCE: f64 = 0.2;
/// How far against it what falls or rises may go, as a share of the range of all means.
const AGAINST: f64 = 0.1;
/// For what binary fractions do to the last digit of 20 %.
const ROUNDING: f64 = 1e-9;

/// How well.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tier {
    /// Not.
    No,
    /// Within 20 % of it.
    Near,
    /// As stated.
    Yes,
}

/// How well figures fit, and what their intervals leave open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fit {
    /// The means.
    pub tier: Tier,
    /// The worst that the intervals leave open.
    pub worst: Tier,
    /// The best that they leave open.
    pub best: Tier,
}

impl Fit {
    /// How well `findings` fit `statement`; `None` where there are too few of them to say.
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

    /// Whether the intervals leave nothing open.
    pub fn is_firm(self) -> bool {
        self.worst == self.best
    }

    fn and(self, other: Self) -> Self {
        Self {
            tier: self.tier.min(other.tier),
            worst: self.worst.min(other.worst),
            best: self.best.min(other.best),
        }
    }

    /// For a statement on each N.
    fn at(statement: Statement, finding: &Finding) -> Self {
        let Finding { value, low, high, .. } = *finding;
        let of = |x: f64| tier(statement, x, finding.zero);
        // Whatever is stated is a range: no point of an interval fits better than that next to it, and none worse than
        // an end.
        let (from, to) = statement.range().unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        let nearest = if low > to { low } else { from.max(low).min(high) };
        Self {
            tier: of(value),
            worst: of(low).min(of(high)),
            best: of(nearest).max(of(low)).max(of(high)),
        }
    }

    /// For a statement on the figures of a row of N together.
    fn over(statement: Statement, row: &[Finding]) -> Self {
        match statement {
            Statement::Largest(v) => Self::at(Statement::About(v), &extreme(row, f64::max)),
            Statement::Smallest(v) => Self::at(Statement::About(v), &extreme(row, f64::min)),
            Statement::Level => Self::level(row),
            Statement::Falls => Self::trend(row, |x| x),
            Statement::Rises => Self::trend(row, |x| -x),
            Statement::About(_) | Statement::Between(..) | Statement::Below(_) | Statement::Above(_) => Self {
                tier: Tier::No,
                worst: Tier::No,
                best: Tier::No,
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
            let is_near = most.is_finite() && most - least <= (TOLERANCE + ROUNDING) * (most + least);
            most <= least || most <= zero || is_near
        };
        let fits = |yes| if yes { Tier::Yes } else { Tier::No };
        Self {
            tier: fits(is_level(smallest(|f| f.value), largest(|f| f.value))),
            worst: fits(is_level(smallest(|f| f.low), largest(|f| f.high))),
            best: fits(is_level(smallest(|f| f.high), largest(|f| f.low))),
        }
    }

    /// For what falls, seen through `sign`, from the first to the last.
    fn trend(row: &[Finding], sign: fn(f64) -> f64) -> Self {
        let ends = |f: &Finding| {
            let (a, b) = (sign(f.low), sign(f.high));
            (a.min(b), a.max(b))
        };
        let values = || row.iter().map(|f| f.value);
        let range = values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min);
        let allowed = AGAINST * range + ROUNDING * range.abs();
        // The largest rise from an earlier to a later one, by what of each counts.
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
                tier: Tier::No,
                worst: Tier::No,
                best: Tier::No,
            };
        };
        let fits = |yes| if yes { Tier::Yes } else { Tier::No };
        let mean = |f: &Finding| sign(f.value);
        let tier = fits(mean(last) < mean(first) && rise(&mean, &mean) <= allowed);
        let (low, high) = (|f: &Finding| ends(f).0, |f: &Finding| ends(f).1);
        Self {
            tier,
            worst: fits(high(last) < low(first) && rise(&high, &low) <= allowed).min(tier),
            best: fits(low(last) < high(first) && rise(&low, &high) <= allowed).max(tier),
        }
    }
}

/// The largest or smallest of `row`, with the ends that it may have.
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

/// How well `x` fits. `zero` is what counts as 0.
fn tier(statement: Statement, x: f64, zero: f64) -> Tier {
    match statement {
        Statement::About(0.0) => meets(x <= zero),
        Statement::About(v) => near(x, v, v, CLOSE),
        Statement::Between(low, high) => near(x, low, high, 0.0),
        Statement::Below(v) => meets(x < v),
        Statement::Above(v) => meets(x > v),
        Statement::Largest(_) | Statement::Smallest(_) | Statement::Level | Statement::Falls | Statement::Rises => {
            Tier::No
        }
    }
}

/// How well `x` fits the single stated value `stated`.
pub fn about(x: f64, stated: f64) -> Tier {
    near(x, stated, stated, CLOSE)
}

fn meets(yes: bool) -> Tier {
    if yes { Tier::Yes } else { Tier::No }
}

/// Whether `x` is between `low` and `high`, widened by `close` or by [`TOLERANCE`] as a share of each.
fn near(x: f64, low: f64, high: f64, close: f64) -> Tier {
    let within = |room: f64| {
        let room = room + ROUNDING;
        (low - room * low.abs()..=high + room * high.abs()).contains(&x)
    };
    if within(close) {
        Tier::Yes
    } else if within(TOLERANCE) {
        Tier::Near
    } else {
        Tier::No
    }
}
