//! Text for numbers, intervals and claims, shared by all of the report. docs/reproduction.md contains the texts; no
//! code parses them.

use reveille_common::digits::decimals_for;
use reveille_lab::metric_estimate::{CaseCounts, MetricEstimate};

use crate::claims::{Claim, ClaimQuantity, DeviceCounts, Statement};

/// Formats a number with three significant digits, and without decimals if it has more than three integer digits.
pub(super) fn format_number(x: f64) -> String {
    if x == 0.0 {
        return "0".to_owned();
    }
    if !x.is_finite() {
        return "–".to_owned();
    }
    format!("{x:.*}", decimals_for(x, 3)).replace('-', "−")
}

/// Formats a mean with half the width of its interval.
pub(super) fn format_plus_minus(mean: f64, half_width: f64) -> String {
    if half_width.is_nan() {
        format!("{} (one run)", format_number(mean))
    } else {
        format!("{} ± {}", format_number(mean), format_half_width(half_width, mean))
    }
}

/// Formats `half_width` with as many decimals as [`format_number`] gives `mean`, and at least one significant digit.
fn format_half_width(half_width: f64, mean: f64) -> String {
    let mean_text = format_number(mean);
    let decimals = mean_text.split_once('.').map_or(0, |(_, decimals)| decimals.len());
    let text_like_mean = format!("{half_width:.decimals$}");
    let is_zero = text_like_mean.chars().all(|c| matches!(c, '0' | '.'));
    if is_zero && half_width > 0.0 {
        format!("{half_width:.*}", decimals_for(half_width, 1))
    } else {
        text_like_mean
    }
}

/// Formats the estimate of a metric: a mean with its interval, or a bound.
pub(super) fn format_estimate(estimate: &MetricEstimate) -> String {
    let (mean, half_width) = (estimate.mean_estimate.mean, estimate.mean_estimate.half_width);
    match (estimate.upper_bound, estimate.case_counts) {
        (Some(upper), Some(CaseCounts { cases: 0, events })) => {
            format!("0 in {events} events, < {}", format_number(upper))
        }
        (Some(upper), Some(CaseCounts { cases, events })) => {
            format!(
                "{}, {cases} in {events} events, < {}",
                format_number(mean),
                format_number(upper)
            )
        }
        (Some(upper), None) => format!("{}, < {}", format_number(mean), format_number(upper)),
        (None, Some(CaseCounts { events, .. })) if estimate.lower_bound.is_some() => {
            // Near 100 %, three digits would show 100. Rounding down keeps the bound valid.
            let bound = libm::floor(100.0 * estimate.lower_bound.unwrap_or(mean)) / 100.0;
            format!("{mean} in all {events} events, > {bound:.2}")
        }
        (None, _) if half_width == 0.0 => format!("{} in every run", format_number(mean)),
        (None, _) => format_plus_minus(mean, half_width),
    }
}

/// Formats the N of a claim.
pub(super) fn format_device_counts(device_counts: DeviceCounts) -> String {
    match device_counts {
        DeviceCounts::At(n) => format!("N = {n}"),
        DeviceCounts::Under(n) => format!("N < {n}"),
        DeviceCounts::UpTo(n) => format!("N ≤ {n}"),
        DeviceCounts::Over(n) => format!("N > {n}"),
        DeviceCounts::All => "all N".to_owned(),
    }
}

/// Formats the statement of a claim.
pub(super) fn format_statement(claim: &Claim) -> String {
    let statement = claim.statement;
    match claim.quantity {
        ClaimQuantity::Mean => statement_text(statement),
        ClaimQuantity::Ratio(others) => ratio_text(statement, &join_names(others)),
        ClaimQuantity::Gap(other) => format!("gap to {other} {}", statement_text(statement)),
        ClaimQuantity::Growth(n) => ratio_text(statement, &format!("its own at N = {n}")),
    }
}

fn statement_text(statement: Statement) -> String {
    match statement {
        Statement::About(v) => format!("≈ {}", format_exact(v)),
        Statement::Between(low, high) => format!("{} to {}", format_exact(low), format_exact(high)),
        Statement::Below(v) => format!("< {}", format_exact(v)),
        Statement::Above(v) => format!("> {}", format_exact(v)),
        Statement::Largest(v) => format!("up to {}", format_exact(v)),
        Statement::Smallest(v) => format!("down to {}", format_exact(v)),
        Statement::Constant => "about level over N".to_owned(),
        Statement::Falls => "falls with N".to_owned(),
        Statement::Rises => "rises with N".to_owned(),
    }
}

fn ratio_text(statement: Statement, others: &str) -> String {
    let is_one = |v: f64| (v - 1.0).abs() < 1e-12;
    match statement {
        Statement::About(v) if is_one(v) => format!("about as {others}"),
        Statement::Below(v) if is_one(v) => format!("less than {others}"),
        Statement::Above(v) if is_one(v) => format!("more than {others}"),
        Statement::About(v) => format!("{} × {others}", format_exact(v)),
        Statement::Between(low, high) => format!("{} to {} × {others}", format_exact(low), format_exact(high)),
        Statement::Below(_) | Statement::Above(_) | Statement::Largest(_) | Statement::Smallest(_) => {
            format!("{} × {others}", statement_text(statement))
        }
        Statement::Constant | Statement::Falls | Statement::Rises => {
            format!("share of {others} {}", statement_text(statement))
        }
    }
}

/// Joins names into a list.
pub(super) fn join_names<T: AsRef<str>>(names: &[T]) -> String {
    match names {
        [] => String::new(),
        [one] => one.as_ref().to_owned(),
        [all_but_last @ .., last] => {
            let all_but_last: Vec<&str> = all_but_last.iter().map(AsRef::as_ref).collect();
            format!("{} and {}", all_but_last.join(", "), last.as_ref())
        }
    }
}

/// Formats a stated value with all of its digits.
pub(super) fn format_exact(x: f64) -> String {
    x.to_string().replace('-', "−")
}

#[cfg(test)]
mod tests {
    use reveille_lab::stats::Estimate;

    use super::*;
    use crate::claims::FIG_8;

    #[test]
    fn numbers_have_three_significant_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.146_23, "0.146"),
            (12.345, "12.3"),
            (1234.5, "1234"),
            (-0.001_234, "−0.00123"),
            (1.0, "1.00"),
            (99.96, "100.0"),
        ] {
            assert_eq!(format_number(x), text);
        }
        assert_eq!(format_number(f64::NAN), "–");
    }

    #[test]
    fn an_interval_has_the_decimals_of_its_mean_or_more() {
        assert_eq!(format_plus_minus(0.1462, 0.0123), "0.146 ± 0.012");
        assert_eq!(format_plus_minus(61.0, 0.004), "61.0 ± 0.004");
        assert_eq!(format_plus_minus(61.0, 0.0), "61.0 ± 0.0");
        assert_eq!(format_plus_minus(5.0, f64::NAN), "5.00 (one run)");
    }

    #[test]
    fn values_near_zero_have_a_bound_instead_of_an_interval() {
        let estimate_of = |values: &[f64], cases: Option<u64>, upper| MetricEstimate {
            mean_estimate: Estimate::from_values_or_nan(values.iter().copied()),
            case_counts: cases.map(|cases| CaseCounts { cases, events: 600 }),
            upper_bound: upper,
            lower_bound: None,
        };
        assert_eq!(
            format_estimate(&estimate_of(&[0.0; 2], Some(0), Some(0.5))),
            "0 in 600 events, < 0.500"
        );
        assert_eq!(
            format_estimate(&estimate_of(&[0.0, 0.2], Some(1), Some(0.79))),
            "0.100, 1 in 600 events, < 0.790"
        );
        assert_eq!(
            format_estimate(&estimate_of(&[0.0, 0.026], None, Some(0.04))),
            "0.0130, < 0.0400"
        );
        assert_eq!(format_estimate(&estimate_of(&[0.0; 2], None, None)), "0 in every run");
        assert_eq!(
            format_estimate(&estimate_of(&[0.3, 0.5], Some(99), None)),
            "0.400 ± 1.271"
        );
    }

    #[test]
    fn claims_are_phrased_by_statement_and_quantity() {
        let phrase =
            |quantity, statement| format_statement(&Claim::new("knn", DeviceCounts::All, quantity, statement, FIG_8));
        for (statement, of_mean, of_ratio) in [
            (Statement::About(0.4), "≈ 0.4", "0.4 × adjusted and random"),
            (Statement::About(1.0), "≈ 1", "about as adjusted and random"),
            (Statement::Below(1.0), "< 1", "less than adjusted and random"),
            (Statement::Above(1.29), "> 1.29", "> 1.29 × adjusted and random"),
            (Statement::Largest(4.5), "up to 4.5", "up to 4.5 × adjusted and random"),
            (
                Statement::Smallest(0.77),
                "down to 0.77",
                "down to 0.77 × adjusted and random",
            ),
            (
                Statement::Between(8.0, 13.0),
                "8 to 13",
                "8 to 13 × adjusted and random",
            ),
            (
                Statement::Falls,
                "falls with N",
                "share of adjusted and random falls with N",
            ),
        ] {
            assert_eq!(phrase(ClaimQuantity::Mean, statement), of_mean);
            assert_eq!(
                phrase(ClaimQuantity::Ratio(&["adjusted", "random"]), statement),
                of_ratio
            );
        }
        assert_eq!(
            phrase(ClaimQuantity::Gap("genie"), Statement::Falls),
            "gap to genie falls with N"
        );
        assert_eq!(
            phrase(ClaimQuantity::Growth(10), Statement::About(0.5)),
            "0.5 × its own at N = 10"
        );
        assert_eq!(join_names(&["a", "b", "c"]), "a, b and c");
    }
}
