//! Numbers as text with significant digits, so that small costs and harvests do not appear as zero, and numbers with
//! nouns. Messages, command output, figures and the committed page `docs/reproduction.md` show the texts, and tests
//! expect them.

use std::fmt::Display;

/// Smallest magnitude that is written without an exponent.
const MIN_PLAIN: f64 = 1e-9;
/// Smallest magnitude that is too large to be written without an exponent.
const PLAIN_LIMIT: f64 = 1e15;

/// Returns the number of decimals with which `x` has `digits` significant digits, ≥ 1; at most 12 decimals, and 0 for
/// zero and for numbers that are not finite. Rounding up to a power of ten can add one digit.
pub fn decimals_for(x: f64, digits: u32) -> usize {
    if x == 0.0 || !x.is_finite() {
        return 0;
    }
    // The logarithm of a power of ten may be slightly too small.
    let magnitude = libm::floor(libm::log10(x.abs()) + 1e-12) as i32;
    (digits.cast_signed() - 1 - magnitude).clamp(0, 12) as usize
}

/// Formats `x` with at most `digits` significant digits, without trailing zeros: 0.4524, 0.00003, 1400. The integer
/// part keeps all of its digits. Numbers below 1e-9 and from 1e15 on have an exponent. NaN is a dash.
pub fn format_significant(x: f64, digits: u32) -> String {
    if x.is_nan() {
        return "–".to_owned();
    }
    if x.is_infinite() {
        return if x > 0.0 { "∞" } else { "-∞" }.to_owned();
    }
    if x != 0.0 && !(MIN_PLAIN..PLAIN_LIMIT).contains(&x.abs()) {
        let text = format!("{x:.*e}", digits.saturating_sub(1) as usize);
        // An exponential form always contains the letter.
        return match text.split_once('e') {
            Some((mantissa, exponent)) => format!("{}e{exponent}", trim_zeros(mantissa)),
            None => text,
        };
    }
    let text = format!("{x:.*}", decimals_for(x, digits));
    trim_zeros(&text).to_owned()
}

/// Removes the zeros at the end of the decimals in `text`.
fn trim_zeros(text: &str) -> &str {
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.')
    } else {
        text
    }
}

/// Formats a number with its noun: `1 run`, `2 runs`.
pub fn count_noun<N: Copy + Display + PartialEq + From<u8>>(number: N, noun: &str) -> String {
    let plural = if number == N::from(1) { "" } else { "s" };
    format!("{number} {noun}{plural}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_their_significant_digits() {
        for (x, expected) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.452_418_7, "0.4524"),
            (0.000_03, "0.00003"),
            (0.000_031_239, "0.00003124"),
            (1e-9, "0.000000001"),
            (3.14159e-12, "3.142e-12"),
            (1.0 / 14.0, "0.07143"),
            (9.999_96, "10"),
            (1400.25, "1400"),
            (123_456.7, "123457"),
            (1e9, "1000000000"),
            (2.5e15, "2.5e15"),
            (-0.012_345, "-0.01235"),
            (f64::INFINITY, "∞"),
            (f64::NAN, "–"),
        ] {
            assert_eq!(format_significant(x, 4), expected, "{x}");
        }
    }

    /// The reference is the exponential format of the standard library.
    #[test]
    fn the_text_is_within_half_a_digit_of_the_number() {
        for exponent in -9..15 {
            for mantissa in [1.0, 1.234_56, 5.0, 9.994_9, 9.999_9] {
                let x = mantissa * libm::pow(10.0, f64::from(exponent));
                let [shown, expected]: [f64; 2] =
                    [format_significant(x, 4), format!("{x:.3e}")].map(|text| text.parse().expect("a number"));
                let digit = libm::pow(10.0, f64::from(exponent - 3));
                assert!((shown - expected).abs() <= 0.5 * digit, "{x}: {shown}, not {expected}");
            }
        }
    }
}
