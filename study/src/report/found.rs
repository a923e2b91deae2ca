//! What was found for a claim, and how far it is from it, in words.

use super::judge::Finding;
use super::words::{list, number, told};
use crate::claims::{Claim, Quantity, Statement};

/// What was found for `claim`: a figure with its interval, or over several N or policies the ends of them.
pub fn found(claim: &Claim, findings: &[Finding]) -> String {
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

/// The finding that is `before` all others, with its N.
fn extreme(claim: &Claim, findings: &[Finding], before: impl Fn(&Finding, &Finding) -> bool) -> String {
    let first = findings
        .iter()
        .reduce(|best, one| if before(one, best) { one } else { best });
    first.map_or_else(String::new, |one| format!("{}, N = {}", alone(claim, one), one.n))
}

/// What is nothing at all N, with the widest of the bounds on it.
fn nothing(findings: &[Finding]) -> String {
    let bounds = findings.iter().filter_map(|f| f.reading?.upper);
    let widest = bounds.reduce(f64::max);
    widest.map_or_else(
        || "0 at each N".to_owned(),
        |bound| format!("0 at each N, < {}", number(bound)),
    )
}

/// A figure with its interval.
fn alone(claim: &Claim, finding: &Finding) -> String {
    if let Some(reading) = &finding.reading {
        return told(reading);
    }
    let Finding { low, high, .. } = *finding;
    let interval = match (low > 0.0, high.is_finite()) {
        (_, true) => format!("{} to {}", number(low), number(high)),
        (true, false) => format!("> {}", number(low)),
        (false, false) => "no interval".to_owned(),
    };
    format!("{} ({interval})", figure(claim, finding))
}

/// A figure as such.
fn figure(claim: &Claim, finding: &Finding) -> String {
    let value = if finding.value.is_infinite() {
        "∞".to_owned()
    } else {
        number(finding.value)
    };
    match (claim.quantity, finding.other) {
        (Quantity::Ratio(_), Some(other)) => format!("{value} × {other}"),
        (Quantity::Growth(n), _) => format!("{value} × that at N = {n}"),
        (Quantity::Own | Quantity::Gap(_) | Quantity::Ratio(_), _) => value,
    }
}

fn with_place(claim: &Claim, finding: &Finding) -> String {
    format!("{} (N = {})", figure(claim, finding), finding.n)
}

/// How far `findings` are from what is claimed, if they are.
pub fn distance(claim: &Claim, findings: &[Finding]) -> Option<String> {
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
        Statement::Below(_) | Statement::Above(_) if matches!(claim.quantity, Quantity::Ratio(_)) => {
            order(claim, findings)
        }
        Statement::About(v) => worst(findings, v, v, "the paper's"),
        Statement::Between(low, high) => worst(findings, low, high, "the nearer end of the range"),
        Statement::Below(v) => worst(findings, f64::NEG_INFINITY, v, "the bound"),
        Statement::Above(v) => worst(findings, v, f64::INFINITY, "the bound"),
    }
}

/// The finding that is farthest from `low` to `high`.
fn worst(findings: &[Finding], low: f64, high: f64, what: &str) -> Option<String> {
    let size = |f: &Finding| {
        let factor = f.value / f.value.clamp(low, high);
        if factor > 0.0 {
            libm::log(factor).abs()
        } else {
            f64::INFINITY
        }
    };
    let worst = findings.iter().max_by(|a, b| size(a).total_cmp(&size(b)))?;
    let text = off(worst, low, high, what)?;
    Some(if findings.len() > 1 {
        format!("At N = {} o{}", worst.n, &text[1..])
    } else {
        text
    })
}

fn off(finding: &Finding, low: f64, high: f64, what: &str) -> Option<String> {
    let factor = finding.value / finding.value.clamp(low, high);
    (factor.is_finite() && factor > 0.0).then(|| format!("Ours is {} times {what}.", number(factor)))
}

/// Where and against whom an order or a bound on a ratio does not hold.
fn order(claim: &Claim, findings: &[Finding]) -> Option<String> {
    let (low, high) = claim.statement.range()?;
    let fails = |f: &&Finding| !(low < f.value && f.value < high);
    let place = |f: &Finding| match f.other {
        Some(other) => format!("N = {} ({} × {other})", f.n, number(f.value)),
        None => format!("N = {} ({})", f.n, number(f.value)),
    };
    let places: Vec<String> = findings.iter().filter(fails).map(place).collect();
    (!places.is_empty()).then(|| format!("Not so at {}.", list(&places)))
}

/// The largest step against a trend, `step` from an earlier to a later one.
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
    use crate::claims::{FIG_8, Sites};

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

    fn claim(quantity: Quantity, statement: Statement) -> Claim {
        Claim::new("knn", Sites::Everywhere, quantity, statement, FIG_8)
    }

    #[test]
    fn the_distance_is_that_of_the_worst() {
        let range = claim(Quantity::Own, Statement::Between(30.0, 45.0));
        let text = distance(&range, &[finding(10, 60.0), finding(250, 90.0)]).expect("a distance");
        assert_eq!(text, "At N = 250 ours is 2.00 times the nearer end of the range.");
        let value = claim(Quantity::Own, Statement::About(10.0));
        let text = distance(&value, &[finding(10, 5.0)]).expect("a distance");
        assert_eq!(text, "Ours is 0.500 times the paper's.");
        assert_eq!(distance(&value, &[finding(10, 0.0)]), None);
    }

    #[test]
    fn an_order_that_fails_says_where() {
        let below = claim(Quantity::Ratio(&["random"]), Statement::Below(1.0));
        let text = distance(&below, &[finding(10, 0.5), finding(50, 1.25), finding(250, 2.0)]);
        assert_eq!(
            text.expect("a distance"),
            "Not so at N = 50 (1.25 × random) and N = 250 (2.00 × random)."
        );
        assert_eq!(distance(&below, &[finding(10, 0.5)]), None);
    }

    #[test]
    fn a_trend_says_its_largest_step_against() {
        let falls = claim(Quantity::Own, Statement::Falls);
        let row = [finding(10, 5.0), finding(50, 2.0), finding(100, 3.0), finding(250, 4.5)];
        let text = distance(&falls, &row).expect("a distance");
        assert_eq!(
            text,
            "The largest step against it is from 2.00 at N = 50 to 4.50 at N = 250."
        );
        assert_eq!(found(&falls, &row), "5.00 (N = 10) to 4.50 (N = 250)");
        let rises = claim(Quantity::Own, Statement::Rises);
        assert!(
            distance(&rises, &row)
                .expect("a distance")
                .contains("from 5.00 at N = 10 to 2.00")
        );
    }

    #[test]
    fn what_is_found_has_its_interval_or_its_ends() {
        let most = claim(Quantity::Ratio(&["random"]), Statement::Largest(4.5));
        let row = [finding(10, 1.0), finding(50, 4.0), finding(250, 2.0)];
        assert_eq!(found(&most, &row), "4.00 × random (3.60 to 4.40), N = 50");
        let above = claim(Quantity::Ratio(&["random"]), Statement::Above(1.0));
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
