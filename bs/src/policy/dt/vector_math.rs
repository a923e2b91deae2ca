//! Exponentials and logarithms in single precision, which the compiler can compute side by side. Unlike a system
//! library, they return the same bits on every machine, and digests depend on these bits. A caller that is inlined into
//! [`VectorWidth::run`](crate::vector_width::VectorWidth::run) uses wide instructions.

/// Exponent below which e^x is treated as 0.
const MIN_EXPONENT: f32 = -87.0;

/// Returns e^x within two units in the last place, for x up to 88; 0 below [`MIN_EXPONENT`]. A polynomial allows many
/// values to be computed side by side.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    let clamped = x.max(MIN_EXPONENT);
    // Adding 3·2²² rounds to a whole number, which is then in the lowest bits.
    let rounded = clamped * std::f32::consts::LOG2_E + 12_582_912.0;
    let whole = rounded - 12_582_912.0;
    // ln 2 in two parts, the first with so few bits that its products are exact.
    let remainder = (clamped - whole * (355.0 / 512.0)) - whole * -2.121_944_4e-4;
    let series = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
    let mut sum = series[0];
    for term in &series[1..] {
        sum = sum * remainder + term;
    }
    // The whole number moves into the exponent bits, which are offset by 127.
    let power = f32::from_bits(rounded.to_bits().wrapping_add(127) << 23);
    let value = (sum * remainder + 1.0) * power;
    if x < MIN_EXPONENT { 0.0 } else { value }
}

/// Returns ln x within two units in the last place, for normal x above 0. `log(1.0)` is exactly 0. The coefficients
/// come from the Cephes library.
#[inline(always)]
pub(crate) fn log(x: f32) -> f32 {
    // The exponent by which the mantissa comes to lie between √½ and √2; 0x3F35_04F3 are the bits of √½.
    let bits = x.to_bits();
    let exponent = bits.wrapping_sub(0x3F35_04F3).cast_signed() >> 23;
    let fraction = f32::from_bits(bits.wrapping_sub(exponent.cast_unsigned() << 23)) - 1.0;
    let square = fraction * fraction;
    let series = [
        7.037_683_6e-2,
        -1.151_461e-1,
        1.167_699_9e-1,
        -1.242_014_1e-1,
        1.424_932_3e-1,
        -1.666_805_8e-1,
        2.000_071_5e-1,
        -2.499_999_4e-1,
        3.333_333e-1,
    ];
    let mut sum = series[0];
    for term in &series[1..] {
        sum = sum * fraction + term;
    }
    // ln 2 in two parts, the first with so few bits that its products are exact.
    let exponent = exponent as f32;
    let small = sum * fraction * square - exponent * 2.121_944_4e-4 - 0.5 * square;
    fraction + small + exponent * (355.0 / 512.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_accurate_to_single_precision() {
        for step in -87_000..=20_000 {
            let x = step as f32 / 1000.0;
            let exact = libm::exp(f64::from(x));
            assert!(
                (f64::from(exp(x)) / exact - 1.0).abs() < 2.5e-7,
                "exp({x}) = {}, not {exact}",
                exp(x)
            );
        }
        let bits = [0.0, -1000.0, f32::NEG_INFINITY].map(|x| exp(x).to_bits());
        assert_eq!(bits, [1.0_f32, 0.0, 0.0].map(f32::to_bits));
    }

    fn assert_log_is_near(x: f32, exact: f64) {
        let error = f64::from(log(x)) - exact;
        assert!(
            error.abs() <= 2.5e-7 * exact.abs(),
            "log({x}) = {}, not {exact}",
            log(x)
        );
    }

    #[test]
    fn log_is_accurate_to_single_precision() {
        for step in 1..=400_000 {
            let x = libm::expf(step as f32 * 1e-4 - 20.0);
            let exact = libm::log(f64::from(x));
            assert_log_is_near(x, exact);
        }
        for x in [
            1.0_f32.next_down(),
            1.0_f32.next_up(),
            0.5,
            2.0,
            f32::MIN_POSITIVE,
            f32::MAX,
        ] {
            assert_log_is_near(x, libm::log(f64::from(x)));
        }
        assert_eq!(log(1.0).to_bits(), 0.0_f32.to_bits());
    }
}
