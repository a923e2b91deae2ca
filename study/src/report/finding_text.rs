//! Text for the figures found for a claim and for their distance from it.

use super::judge::Finding;
use super::phrasing::{format_estimate, list, number};
use crate::claims::{Claim, ClaimQuantity, Statement};

/// Describes the figures for `claim`: a figure with its interval, or the ends over several N or policies.
pub(super) fn found(claim: &Claim, findings: &[Finding]) -> String {
    match (claim.statement, findings) {
        (_, []) => String::new(),
        (Statement::Largest(_), _) => extreme(claim, findings, Finding::is_above),
        (Statement::Smallest(_), _) => extreme(claim, findings, |a, b| b.is_above(a)),
        (_, [one]) => alone(claim, one),
        (_, _) if findings.iter().all(|f| f.reading.is_some() && f.value == 0.0) => nothing(findings),
        (Statement::Falls | Statement::Rises, [first, .., last]) => {
            format!("{} to {}", with_place(claim, first), with_place(claim, last))
        }
        _ => {
            let least = findings.iter().min_by(|a, b| a.value.total_cmp(&b.value));
            let most = findings.iter().max_by(|a, b| a.value.total_cmp(&b.value));
            let ends = least.zip(most);
            let is_one_place = findings.iter().all(|f| f.n == findings[0].n);
            let text = |finding| {
                if is_one_place {
                    figure(claim, finding)
                } else {
                    with_place(claim, finding)
                }
            };
            ends.map_or_else(String::new, |(least, most)| {
                format!("{} to {}", text(least), text(most))
            })
        }
    }
}

/// Describes the finding that is `before` all others, with its N.
fn extreme(claim: &Claim, findings: &[Finding], before: impl Fn(&Finding, &Finding) -> bool) -> String {
    let first = findings
        .iter()
        .reduce(|best, one| if before(one, best) { one } else { best });
    first.map_or_else(String::new, |one| format!("{}, N = {}", alone(claim, one), one.n))
}

/// Describes figures that are 0 at all N, with their widest bound.
fn nothing(findings: &[Finding]) -> String {
    let bounds = findings.iter().filter_map(|f| f.reading?.upper);
    let widest = bounds.reduce(f64::max);
    widest.map_or_else(
        || "0 at each N".to_owned(),
        |bound| format!("0 at each N, < {}", number(bound)),
    )
}

/// Formats a figure with its interval.
fn alone(claim: &Claim, finding: &Finding) -> String {
    if let Some(reading) = &finding.reading {
        return format_estimate(reading);
    }
    let Finding { low, high, .. } = *finding;
    let interval = match (low > 0.0, high.is_finite()) {
        (_, true) => format!("{} to {}", number(low), number(high)),
        (true, false) => format!("> {}", number(low)),
        (false, false) => "no interval".to_owned(),
    };
    format!("{} ({interval})", figure(claim, finding))
}

/// Formats a figure without its interval.
fn figure(claim: &Claim, finding: &Finding) -> String {
    let value = if finding.value.is_infinite() {
        "∞".to_owned()
    } else {
        number(finding.value)
    };
    match (claim.quantity, finding.other) {
        (ClaimQuantity::Ratio(_), Some(other)) => format!("{value} × {other}"),
        (ClaimQuantity::Growth(n), _) => format!("{value} × the value at N = {n}"),
        (ClaimQuantity::Own | ClaimQuantity::Gap(_) | ClaimQuantity::Ratio(_), _) => value,
    }
}

fn with_place(claim: &Claim, finding: &Finding) -> String {
    format!("{} (N = {})", figure(claim, finding), finding.n)
}

/// Describes the distance of `findings` from the claim, if any.
pub(super) fn distance(claim: &Claim, findings: &[Finding]) -> Option<String> {
    match claim.statement {
        Statement::Falls => against(findings, |a, b| b.value - a.value),
        Statement::Rises => against(findings, |a, b| a.value - b.value),
        Statement::Level => None,
        Statement::Largest(v) => off(
            findings.iter().max_by(|a, b| a.value.total_cmp(&b.value))?,
            v,
            v,
            "the paper's",
        ),
        Statement::Smallest(v) => off(
            findings.iter().min_by(|a, b| a.value.total_cmp(&b.value))?,
            v,
            v,
            "the paper's",
        ),
        Statement::Below(_) | Statement::Above(_) if matches!(claim.quantity, ClaimQuantity::Ratio(_)) => {
            order(claim, findings)
        }
        Statement::About(v) => worst(findings, v, v, "the paper's"),
        Statement::Between(low, high) => worst(findings, low, high, "the nearer end of the range"),
        Statement::Below(v) => worst(findings, f64::NEG_INFINITY, v, "the bound"),
        Statement::Above(v) => worst(findings, v, f64::INFINITY, "the bound"),
    }
}

/// Describes the finding farthest from `low` to `high`.
fn worst(findings: &[Finding], low: f64, high: f64, what: &str) -> Option<String> {
    let size = |f: &Finding| {
        let factor = f.value / f.value.clamp(low, high);
        // A quotient of 0 or below has no logarithm and counts as farthest.
        if factor > 0.0 {
            libm::log(factor).abs()
        } else {
            f64::INFINITY
        }
    };
    let worst = findings.iter().max_by(|a, b| size(a).total_cmp(&size(b)))?;
    let text = off(worst, low, high, what)?;
    Some(if findings.len() > 1 {
        // `off` begins with "Ours", whose first letter is one byte.
        format!("At N = {} o{}", worst.n, &text[1..])
    } else {
        text
    })
}

fn off(finding: &Finding, low: f64, high: f64, what: &str) -> Option<String> {
    let factor = finding.value / finding.value.clamp(low, high);
    (factor.is_finite() && factor > 0.0).then(|| format!("Ours is {} times {what}.", number(factor)))
}

/// Lists the N and policies at which an order or a bound on a ratio fails.
fn order(claim: &Claim, findings: &[Finding]) -> Option<String> {
    let (low, high) = claim.statement.range()?;
    let fails = |f: &&Finding| !(low < f.value && f.value < high);
    let place = |f: &Finding| match f.other {
        Some(other) => format!("N = {} ({} × {other})", f.n, number(f.value)),
        None => format!("N = {} ({})", f.n, number(f.value)),
    };
    let places: Vec<String> = findings.iter().filter(fails).map(place).collect();
    (!places.is_empty()).then(|| format!("It does not hold at {}.", list(&places)))
}

/// Describes the largest step against a trend; `step` is measured from an earlier to a later finding.
fn against(findings: &[Finding], step: impl Fn(&Finding, &Finding) -> f64) -> Option<String> {
    let of_one = |a: &Finding, b: &Finding| a.other == b.other && a.n < b.n;
    let pairs = findings.iter().flat_map(|a| findings.iter().map(move |b| (a, b)));
    let against = pairs.filter(|(a, b)| of_one(a, b) && step(a, b) > 0.0);
    let (from, to) = against.max_by(|a, b| step(a.0, a.1).total_cmp(&step(b.0, b.1)))?;
    Some(format!(
        "The largest step against it is from {} at N = {} to {} at N = {}.",
        number(from.value),
        from.n,
        number(to.value),
        to.n
    ))
}

impl Finding {
    fn is_above(&self, other: &Self) -> bool {
        self.value > other.value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claims::{DeviceCounts, FIG_8};

    fn finding(n: u32, value: f64) -> Finding {
        Finding {
            n,
            other: Some("random"),
            value,
            low: 0.9 * value,
            high: 1.1 * value,
            zero: 0.0,
            reading: None,
        }
    }

    fn claim(quantity: ClaimQuantity, statement: Statement) -> Claim {
        Claim::new("knn", DeviceCounts::Everywhere, quantity, statement, FIG_8)
    }

    #[test]
    fn the_distance_is_the_largest() {
        let range = claim(ClaimQuantity::Own, Statement::Between(30.0, 45.0));
        let text = distance(&range, &[finding(10, 60.0), finding(250, 90.0)]).expect("a distance");
        assert_eq!(text, "At N = 250 ours is 2.00 times the nearer end of the range.");
        let value = claim(ClaimQuantity::Own, Statement::About(10.0));
        let text = distance(&value, &[finding(10, 5.0)]).expect("a distance");
        assert_eq!(text, "Ours is 0.500 times the paper's.");
        assert_eq!(distance(&value, &[finding(10, 0.0)]), None);
    }

    #[test]
    fn a_failed_order_names_its_places() {
        let below = claim(ClaimQuantity::Ratio(&["random"]), Statement::Below(1.0));
        let text = distance(&below, &[finding(10, 0.5), finding(50, 1.25), finding(250, 2.0)]);
        assert_eq!(
            text.expect("a distance"),
            "It does not hold at N = 50 (1.25 × random) and N = 250 (2.00 × random)."
        );
        assert_eq!(distance(&below, &[finding(10, 0.5)]), None);
    }

    #[test]
    fn a_trend_names_its_largest_step_against() {
        let falls = claim(ClaimQuantity::Own, Statement::Falls);
        let row = [finding(10, 5.0), finding(50, 2.0), finding(100, 3.0), finding(250, 4.5)];
        let text = distance(&falls, &row).expect("a distance");
        assert_eq!(
            text,
            "The largest step against it is from 2.00 at N = 50 to 4.50 at N = 250."
        );
        assert_eq!(found(&falls, &row), "5.00 (N = 10) to 4.50 (N = 250)");
        let rises = claim(ClaimQuantity::Own, Statement::Rises);
        assert!(
            distance(&rises, &row)
                .expect("a distance")
                .contains("from 5.00 at N = 10 to 2.00")
        );
    }

    #[test]
    fn findings_have_an_interval_or_ends() {
        let most = claim(ClaimQuantity::Ratio(&["random"]), Statement::Largest(4.5));
        let row = [finding(10, 1.0), finding(50, 4.0), finding(250, 2.0)];
        assert_eq!(found(&most, &row), "4.00 × random (3.60 to 4.40), N = 50");
        let above = claim(ClaimQuantity::Ratio(&["random"]), Statement::Above(1.0));
        assert_eq!(found(&above, &row), "1.00 × random (N = 10) to 4.00 × random (N = 50)");
        let open = Finding {
            low: 0.0,
            high: f64::INFINITY,
            ..finding(10, 2.0)
        };
        assert_eq!(found(&above, &[open]), "2.00 × random (no interval)");
        assert_eq!(found(&above, &[]), "");
    }
}
