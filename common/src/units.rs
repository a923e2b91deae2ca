//! Energy in integer micro-units.
//!
//! The paper counts energy in "units" (Table II: a transmission costs 10). Batteries, costs and harvests are stored as
//! whole micro-units, so that sums do not depend on the order of addition. `scenario/validate.rs` rejects scenarios
//! with sums that might not fit in 64 bits. A sum that overflows and a difference below 0 panic in every build and
//! never wrap. Messages, digests and `totals` in `summary.json` hold micro-units.

use std::fmt;
use std::iter::Sum;
use std::ops::{Add, AddAssign, Sub, SubAssign};

use serde::{Deserialize, Serialize};

use crate::digits::count_noun;

/// Number of micro-units in one unit of energy.
pub const MICRO_PER_UNIT: u64 = 1_000_000;

/// Maximum energy in a scenario, in units: 10¹⁵ micro-units. Up to there, micro-units are exact in double precision,
/// which files, figures and clients use, and a device's levels over a span of 2¹³ TTIs (`MAX_SPAN_TTIS` in
/// `device/src/machine/mod.rs`) add up within 64 bits. Sums over a run are checked when a scenario is loaded.
pub const MAX_UNITS: f64 = 1e9;

/// Whether rounding `units` of energy to `rounded` units changes them by more than 1 %.
pub fn is_changed_by_rounding(units: f64, rounded: f64) -> bool {
    (units - rounded).abs() > 0.01 * units.abs()
}

/// The reason of rounding, with the fix, for warnings.
pub const ROUNDING_RULE: &str = "energies are multiples of 0.000001; write all energies in a smaller unit";

/// An amount of energy, in whole micro-units (1 unit = 1 000 000 micro-units), never negative.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Energy(u64);

impl Energy {
    /// No energy.
    pub const ZERO: Self = Self(0);

    /// Returns `micro` micro-units.
    pub const fn from_micro(micro: u64) -> Self {
        Self(micro)
    }

    /// Converts `units`, rounded to the nearest micro-unit; `None` unless `units` is within `0 ..= `[`MAX_UNITS`].
    pub fn from_units(units: f64) -> Option<Self> {
        (0.0..=MAX_UNITS)
            .contains(&units)
            .then(|| Self((units * MICRO_PER_UNIT as f64).round() as u64))
    }

    /// Converts the `units` of a declared default, rounded to the nearest micro-unit. Unlike [`Self::from_units`], it
    /// does not check that `units` is within `0 ..= `[`MAX_UNITS`].
    pub(crate) const fn from_default(units: f64) -> Self {
        Self((units * MICRO_PER_UNIT as f64 + 0.5) as u64)
    }

    /// Returns the amount in micro-units.
    pub const fn micro(self) -> u64 {
        self.0
    }

    /// Returns the amount in units, for display and for metrics.
    pub fn units(self) -> f64 {
        self.0 as f64 / MICRO_PER_UNIT as f64
    }

    /// Formats the amount in units, exact to the micro-unit, with six decimals.
    pub fn decimal_units(self) -> String {
        // In whole numbers: an f64 would round a large energy.
        format!("{}.{:06}", self.0 / MICRO_PER_UNIT, self.0 % MICRO_PER_UNIT)
    }

    /// Returns `self - other`, or zero if `other` is larger.
    #[must_use]
    #[inline]
    pub const fn saturating_sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }

    /// Returns `self · n`.
    ///
    /// # Panics
    /// If the product does not fit in 64 bits.
    #[must_use]
    #[inline]
    pub const fn times(self, n: u64) -> Self {
        match self.0.checked_mul(n) {
            Some(product) => Self(product),
            None => panic_overflow(),
        }
    }
}

#[cold]
#[inline(never)]
const fn panic_overflow() -> ! {
    panic!("a sum of energy does not fit in 64 bits")
}

#[cold]
#[inline(never)]
const fn panic_underflow() -> ! {
    panic!("there is less energy than is taken")
}

impl Add for Energy {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        match self.0.checked_add(other.0) {
            Some(sum) => Self(sum),
            None => panic_overflow(),
        }
    }
}

impl AddAssign for Energy {
    #[inline]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sub for Energy {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        match self.0.checked_sub(other.0) {
            Some(difference) => Self(difference),
            None => panic_underflow(),
        }
    }
}

impl SubAssign for Energy {
    #[inline]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

impl Sum for Energy {
    fn sum<I: Iterator<Item = Self>>(iter: I) -> Self {
        iter.fold(Self::ZERO, Add::add)
    }
}

impl fmt::Display for Energy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&count_noun(self.units(), "unit"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_fourteenth_rounds_to_the_nearest_micro_unit() {
        assert_eq!(Energy::from_units(1.0 / 14.0), Some(Energy::from_micro(71_429)));
    }

    #[test]
    fn rounding_counts_from_a_hundredth() {
        let is_changed = |units| is_changed_by_rounding(units, Energy::from_units(units).expect("in range").units());
        for units in [4e-7, 1.5e-6, 1.02e-5] {
            assert!(is_changed(units), "{units}");
        }
        for units in [0.0, 1e-6, 1.005e-4, 1.0 / 14.0, MAX_UNITS] {
            assert!(!is_changed(units), "{units}");
        }
        let step = Energy::from_micro(1).decimal_units();
        assert!(ROUNDING_RULE.contains(&format!("multiples of {step};")), "{step}");
    }

    #[test]
    fn decimal_units_are_exact_to_the_micro_unit() {
        let texts = [0, 1, 999_999, 1_000_000, 12_345_678_901].map(|micro| Energy::from_micro(micro).decimal_units());
        assert_eq!(texts, ["0.000000", "0.000001", "0.999999", "1.000000", "12345.678901"]);
    }

    #[test]
    #[should_panic(expected = "does not fit in 64 bits")]
    fn an_overflowing_sum_panics() {
        let half = Energy::from_micro(1 << 63);
        assert_eq!(half.times(1) + Energy::ZERO, half);
        let _ = [half, half].into_iter().sum::<Energy>();
    }

    /// Files and clients hold units in double precision.
    #[test]
    fn micro_units_up_to_the_maximum_survive_double_precision() {
        let max = Energy::from_units(MAX_UNITS).expect("the maximum");
        assert_eq!(max.micro(), 1_000_000_000_000_000);
        for below in [0, 1, 2, 999_999, 123_456_789_012_345] {
            let energy = max - Energy::from_micro(below);
            assert_eq!(Energy::from_units(energy.units()), Some(energy));
        }
        // The longest span of a device, `MAX_SPAN_TTIS` in `device/src/machine/mod.rs`.
        assert_eq!(max.times(1 << 13).micro(), 8_192_000_000_000_000_000);
    }

    #[test]
    fn invalid_units_are_refused() {
        for units in [-1e-9, MAX_UNITS + 1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(Energy::from_units(units), None, "{units} units");
        }
    }
}
