//! Numbers and claims in words.

use super::judge::Finding;
use crate::claims::Relation;

/// A number with three significant digits, or none behind the point where it has more in front.
pub fn number(x: f64) -> String {
    if x == 0.0 {
        return "0".to_owned();
    }
    if !x.is_finite() {
        return "–".to_owned();
    }
    let magnitude = libm::floor(libm::log10(x.abs()) + 1e-12) as i32;
    let decimals = (2 - magnitude).clamp(0, 9) as usize;
    format!("{x:.decimals$}").replace('-', "−")
}

/// A mean with half the width of its interval.
pub fn plus_minus(mean: f64, half: f64) -> String {
    if half.is_nan() {
        format!("{} (one run)", number(mean))
    } else {
        format!("{} ± {}", number(mean), number_like(half, mean))
    }
}

/// `half` with as many decimals as [`number`] gives `mean`, and at least one digit.
fn number_like(half: f64, mean: f64) -> String {
    let text = number(mean);
    let decimals = text.split_once('.').map_or(0, |(_, decimals)| decimals.len());
    let same = format!("{half:.decimals$}");
    let is_zero = same.chars().all(|c| matches!(c, '0' | '.'));
    if is_zero && half > 0.0 {
        let magnitude = libm::floor(libm::log10(half) + 1e-12) as i32;
        format!("{half:.*}", (-magnitude).clamp(0, 9) as usize)
    } else {
        same
    }
}

/// What was found for a claim at one N.
pub fn found(relation: Relation, finding: &Finding) -> String {
    let Finding {
        value, half, unseen, ..
    } = *finding;
    match (relation, unseen) {
        (_, Some(events)) => format!("0 of {events} events, < {}", number(half)),
        (Relation::Times(_, other), None) if half.is_nan() => format!("{} × {other} (one run)", number(value)),
        (Relation::Times(_, other), None) => {
            format!("{} × {other} (± {})", number(value), number_like(half, value))
        }
        (_, None) => plus_minus(value, half),
    }
}

/// What a claim says.
pub fn relation(relation: Relation) -> String {
    match relation {
        Relation::About(0.0) => "≈ 0".to_owned(),
        Relation::About(v) => format!("≈ {}", number_as_stated(v)),
        Relation::Between(low, high) => format!("{} to {}", plain(low), plain(high)),
        Relation::Below(v) => format!("< {}", plain(v)),
        Relation::Above(v) => format!("> {}", plain(v)),
        Relation::Times(factor, other) => format!("{} × {other}", number(factor)),
    }
}

/// A stated value as it is stated; a quotient of two with three digits.
fn number_as_stated(x: f64) -> String {
    let text = plain(x);
    if text.len() > 8 { number(x) } else { text }
}

/// A stated value as it is stated.
pub fn plain(x: f64) -> String {
    x.to_string().replace('-', "−")
}

/// How far the worst of `findings` is from what is claimed.
pub fn distance(relation: Relation, findings: &[Finding]) -> Option<String> {
    let factor = |finding: &Finding| {
        let nearest = match relation {
            Relation::About(v) | Relation::Times(v, _) | Relation::Below(v) | Relation::Above(v) => v,
            Relation::Between(low, high) => finding.value.clamp(low, high),
        };
        finding.value / nearest
    };
    let size = |x: f64| if x > 0.0 { libm::log(x).abs() } else { f64::INFINITY };
    let worst = findings
        .iter()
        .max_by(|a, b| size(factor(a)).total_cmp(&size(factor(b))))?;
    let place = if findings.len() > 1 {
        format!(" at N = {}", worst.n)
    } else {
        String::new()
    };
    let factor = factor(worst);
    if !factor.is_finite() || factor <= 0.0 {
        return None;
    }
    Some(match relation {
        Relation::Between(..) => format!("Ours is {} times the nearer end of the range{place}.", number(factor)),
        Relation::About(_) | Relation::Times(..) => format!("Ours is {} times the paper's{place}.", number(factor)),
        Relation::Below(_) | Relation::Above(_) => format!("Ours is {} times the bound{place}.", number(factor)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_count() {
        for (x, text) in [
            (0.0, "0"),
            (0.146_23, "0.146"),
            (12.345, "12.3"),
            (1234.5, "1234"),
            (-0.001_234, "−0.00123"),
            (1.0, "1.00"),
            (99.96, "100.0"),
        ] {
            assert_eq!(number(x), text);
        }
        assert_eq!(number(f64::NAN), "–");
    }

    #[test]
    fn an_interval_has_the_decimals_of_its_mean_or_more() {
        assert_eq!(plus_minus(0.1462, 0.0123), "0.146 ± 0.012");
        assert_eq!(plus_minus(61.0, 0.004), "61.0 ± 0.004");
        assert_eq!(plus_minus(61.0, 0.0), "61.0 ± 0.0");
        assert_eq!(plus_minus(5.0, f64::NAN), "5.00 (one run)");
    }

    #[test]
    fn the_distance_is_that_of_the_worst() {
        let finding = |n, value| Finding {
            n,
            value,
            ..Finding::default()
        };
        let range = Relation::Between(30.0, 45.0);
        let text = distance(range, &[finding(10, 60.0), finding(250, 90.0)]).expect("a distance");
        assert!(
            text.contains("2.00 times the nearer end") && text.contains("N = 250"),
            "{text}"
        );
        let text = distance(Relation::About(10.0), &[finding(10, 5.0)]).expect("a distance");
        assert_eq!(text, "Ours is 0.500 times the paper's.");
        assert_eq!(distance(Relation::About(10.0), &[finding(10, 0.0)]), None);
    }
}
