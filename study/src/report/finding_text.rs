//! Text for the findings on a claim and for their deviation from it, for the rows of the report. [`super::distance`]
//! computes the deviation as a number; change both. docs/reproduction.md contains the texts.

use super::judge::Finding;
use super::phrasing::{format_estimate, format_number, join_names};
use crate::claims::{Claim, ClaimQuantity, Statement};

/// Describes the findings on `claim`, in ascending order of N: a value with its interval, or the ends over several N or
/// policies. Empty without findings, which [`super::search`] and [`super`] check.
pub(super) fn describe_findings(claim: &Claim, findings: &[Finding]) -> String {
    match (claim.statement, findings) {
        (_, []) => String::new(),
        (Statement::Largest(_), _) => describe_extreme(claim, findings, is_above),
        (Statement::Smallest(_), _) => describe_extreme(claim, findings, |a, b| is_above(b, a)),
        (_, [one]) => format_with_interval(claim, one),
        (_, _) if findings.iter().all(|f| f.metric_estimate.is_some() && f.value == 0.0) => describe_zeros(findings),
        (Statement::Falls | Statement::Rises, [first, .., last]) => {
            format!("{} to {}", format_with_n(claim, first), format_with_n(claim, last))
        }
        _ => {
            let least = findings.iter().min_by(|a, b| a.value.total_cmp(&b.value));
            let most = findings.iter().max_by(|a, b| a.value.total_cmp(&b.value));
            let ends = least.zip(most);
            let is_one_n = findings.iter().all(|f| f.n == findings[0].n);
            let text = |finding| {
                if is_one_n {
                    format_value(claim, finding)
                } else {
                    format_with_n(claim, finding)
                }
            };
            ends.map_or_else(String::new, |(least, most)| {
                format!("{} to {}", text(least), text(most))
            })
        }
    }
}

/// Describes the finding that comes before all others by `is_before`, with its N.
fn describe_extreme(claim: &Claim, findings: &[Finding], is_before: impl Fn(&Finding, &Finding) -> bool) -> String {
    let extreme = findings
        .iter()
        .reduce(|best, finding| if is_before(finding, best) { finding } else { best });
    extreme.map_or_else(String::new, |finding| {
        format!("{}, N = {}", format_with_interval(claim, finding), finding.n)
    })
}

/// Describes values that are 0 at all N, with the largest of their upper bounds.
fn describe_zeros(findings: &[Finding]) -> String {
    let bounds = findings.iter().filter_map(|f| f.metric_estimate?.upper_bound);
    let largest_bound = bounds.reduce(f64::max);
    largest_bound.map_or_else(
        || "0 at each N".to_owned(),
        |bound| format!("0 at each N, < {}", format_number(bound)),
    )
}

/// Formats a value with its interval.
fn format_with_interval(claim: &Claim, finding: &Finding) -> String {
    if let Some(metric_estimate) = &finding.metric_estimate {
        return format_estimate(metric_estimate);
    }
    let Finding { low, high, .. } = *finding;
    let interval = match (low > 0.0, high.is_finite()) {
        (_, true) => format!("{} to {}", format_number(low), format_number(high)),
        (true, false) => format!("> {}", format_number(low)),
        (false, false) => "no interval".to_owned(),
    };
    format!("{} ({interval})", format_value(claim, finding))
}

/// Formats a value without its interval, with the policy or N that it is relative to.
fn format_value(claim: &Claim, finding: &Finding) -> String {
    let value = if finding.value.is_infinite() {
        "∞".to_owned()
    } else {
        format_number(finding.value)
    };
    match (claim.quantity, finding.other_policy) {
        (ClaimQuantity::Ratio(_), Some(other)) => format!("{value} × {other}"),
        (ClaimQuantity::Growth(n), _) => format!("{value} × the value at N = {n}"),
        (ClaimQuantity::Mean | ClaimQuantity::Gap(_) | ClaimQuantity::Ratio(_), _) => value,
    }
}

fn format_with_n(claim: &Claim, finding: &Finding) -> String {
    format!("{} (N = {})", format_value(claim, finding), finding.n)
}

/// Describes the deviation of `findings` from the claim, if any.
pub(super) fn describe_deviation(claim: &Claim, findings: &[Finding]) -> Option<String> {
    match claim.statement {
        Statement::Falls => describe_step_against(findings, |earlier, later| later.value - earlier.value),
        Statement::Rises => describe_step_against(findings, |earlier, later| earlier.value - later.value),
        Statement::Constant => None,
        Statement::Largest(v) => describe_factor(
            findings.iter().max_by(|a, b| a.value.total_cmp(&b.value))?,
            v,
            v,
            "the paper's",
        ),
        Statement::Smallest(v) => describe_factor(
            findings.iter().min_by(|a, b| a.value.total_cmp(&b.value))?,
            v,
            v,
            "the paper's",
        ),
        Statement::Below(_) | Statement::Above(_) if matches!(claim.quantity, ClaimQuantity::Ratio(_)) => {
            describe_failures(claim, findings)
        }
        Statement::About(v) => describe_farthest(findings, v, v, "the paper's"),
        Statement::Between(low, high) => describe_farthest(findings, low, high, "the nearer end of the range"),
        Statement::Below(v) => describe_farthest(findings, f64::NEG_INFINITY, v, "the bound"),
        Statement::Above(v) => describe_farthest(findings, v, f64::INFINITY, "the bound"),
    }
}

/// Describes the finding farthest from `low` to `high`.
fn describe_farthest(findings: &[Finding], low: f64, high: f64, reference: &str) -> Option<String> {
    let log_factor = |f: &Finding| {
        let factor = f.value / f.value.clamp(low, high);
        // A quotient of 0 or below has no logarithm and counts as farthest.
        if factor > 0.0 {
            libm::log(factor).abs()
        } else {
            f64::INFINITY
        }
    };
    let farthest = findings.iter().max_by(|a, b| log_factor(a).total_cmp(&log_factor(b)))?;
    let text = describe_factor(farthest, low, high, reference)?;
    Some(if findings.len() > 1 {
        // The text begins with "Ours", whose first letter is one byte.
        format!("At N = {} o{}", farthest.n, &text[1..])
    } else {
        text
    })
}

/// Describes the factor between `finding` and the nearest value in `low` to `high`; `None` if it is not above 0. The
/// text must begin with "Ours": [`describe_farthest`] replaces its first letter.
fn describe_factor(finding: &Finding, low: f64, high: f64, reference: &str) -> Option<String> {
    let factor = finding.value / finding.value.clamp(low, high);
    (factor.is_finite() && factor > 0.0).then(|| format!("Ours is {} times {reference}.", format_number(factor)))
}

/// Lists the N and policies at which an order or a bound on a ratio fails; `None` if it holds everywhere.
fn describe_failures(claim: &Claim, findings: &[Finding]) -> Option<String> {
    let (low, high) = claim.statement.range()?;
    let fails = |f: &&Finding| !(low < f.value && f.value < high);
    let failure = |f: &Finding| match f.other_policy {
        Some(other) => format!("N = {} ({} × {other})", f.n, format_number(f.value)),
        None => format!("N = {} ({})", f.n, format_number(f.value)),
    };
    let failures: Vec<String> = findings.iter().filter(fails).map(failure).collect();
    (!failures.is_empty()).then(|| format!("It does not hold at {}.", join_names(&failures)))
}

/// Describes the largest step against a trend; `None` without such a step. `step` is measured from an earlier to a
/// later finding.
fn describe_step_against(findings: &[Finding], step: impl Fn(&Finding, &Finding) -> f64) -> Option<String> {
    let precedes_in_trend = |a: &Finding, b: &Finding| a.other_policy == b.other_policy && a.n < b.n;
    let pairs = findings.iter().flat_map(|a| findings.iter().map(move |b| (a, b)));
    let steps_against = pairs.filter(|(a, b)| precedes_in_trend(a, b) && step(a, b) > 0.0);
    let (from, to) = steps_against.max_by(|a, b| step(a.0, a.1).total_cmp(&step(b.0, b.1)))?;
    Some(format!(
        "The largest step against it is from {} at N = {} to {} at N = {}.",
        format_number(from.value),
        from.n,
        format_number(to.value),
        to.n
    ))
}

fn is_above(a: &Finding, b: &Finding) -> bool {
    a.value > b.value
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claims::{DeviceCounts, FIG_8};

    fn finding(n: u32, value: f64) -> Finding {
        Finding {
            n,
            other_policy: Some("random"),
            value,
            low: 0.9 * value,
            high: 1.1 * value,
            zero_limit: 0.0,
            metric_estimate: None,
        }
    }

    fn claim(quantity: ClaimQuantity, statement: Statement) -> Claim {
        Claim::new("knn", DeviceCounts::All, quantity, statement, FIG_8)
    }

    #[test]
    fn the_deviation_is_the_largest_over_n() {
        let range = claim(ClaimQuantity::Mean, Statement::Between(30.0, 45.0));
        let text = describe_deviation(&range, &[finding(10, 60.0), finding(250, 90.0)]).expect("a deviation");
        assert_eq!(text, "At N = 250 ours is 2.00 times the nearer end of the range.");
        let value = claim(ClaimQuantity::Mean, Statement::About(10.0));
        let text = describe_deviation(&value, &[finding(10, 5.0)]).expect("a deviation");
        assert_eq!(text, "Ours is 0.500 times the paper's.");
        assert_eq!(describe_deviation(&value, &[finding(10, 0.0)]), None);
    }

    #[test]
    fn a_violated_bound_names_its_n() {
        let below = claim(ClaimQuantity::Ratio(&["random"]), Statement::Below(1.0));
        let text = describe_deviation(&below, &[finding(10, 0.5), finding(50, 1.25), finding(250, 2.0)]);
        assert_eq!(
            text.expect("a deviation"),
            "It does not hold at N = 50 (1.25 × random) and N = 250 (2.00 × random)."
        );
        assert_eq!(describe_deviation(&below, &[finding(10, 0.5)]), None);
    }

    #[test]
    fn a_violated_trend_names_its_largest_opposite_step() {
        let falls = claim(ClaimQuantity::Mean, Statement::Falls);
        let row = [finding(10, 5.0), finding(50, 2.0), finding(100, 3.0), finding(250, 4.5)];
        let text = describe_deviation(&falls, &row).expect("a deviation");
        assert_eq!(
            text,
            "The largest step against it is from 2.00 at N = 50 to 4.50 at N = 250."
        );
        assert_eq!(describe_findings(&falls, &row), "5.00 (N = 10) to 4.50 (N = 250)");
        let rises = claim(ClaimQuantity::Mean, Statement::Rises);
        assert!(
            describe_deviation(&rises, &row)
                .expect("a deviation")
                .contains("from 5.00 at N = 10 to 2.00")
        );
    }

    #[test]
    fn findings_have_an_interval_or_the_values_at_both_ends() {
        let largest = claim(ClaimQuantity::Ratio(&["random"]), Statement::Largest(4.5));
        let row = [finding(10, 1.0), finding(50, 4.0), finding(250, 2.0)];
        assert_eq!(
            describe_findings(&largest, &row),
            "4.00 × random (3.60 to 4.40), N = 50"
        );
        let above = claim(ClaimQuantity::Ratio(&["random"]), Statement::Above(1.0));
        assert_eq!(
            describe_findings(&above, &row),
            "1.00 × random (N = 10) to 4.00 × random (N = 50)"
        );
        let without_interval = Finding {
            low: 0.0,
            high: f64::INFINITY,
            ..finding(10, 2.0)
        };
        assert_eq!(
            describe_findings(&above, &[without_interval]),
            "2.00 × random (no interval)"
        );
        assert_eq!(describe_findings(&above, &[]), "");
    }
}
