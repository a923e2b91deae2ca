//! Axis scales: positions of values along an axis, and tick selection. Labels have no more decimals than their step.
//! Axes, colour keys and numbers in heat maps and captions follow these rules.

use libm::{floor, log10};

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// Linear scale.
    Linear {
        /// Value at the start.
        from: f64,
        /// Value at the end, > `from`.
        to: f64,
    },
    /// Logarithmic scale between any two ends.
    Log {
        /// Value at the start, > 0.
        from: f64,
        /// Value at the end, > `from`.
        to: f64,
    },
    /// Square-root scale from 0, for shares of which small and large ones matter.
    SquareRoot {
        /// Value at the end, > 0.
        to: f64,
    },
}

/// A tick of an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisTick {
    /// Value of the tick.
    pub value: f64,
    /// Label; empty for a minor tick.
    pub label: String,
}

/// Approximate upper limit on the number of labelled ticks of an axis.
const MAX_TICKS: f64 = 6.0;

impl Scale {
    /// Creates a linear axis that holds all of `values`, and 0 if `with_zero` is set, and ends on ticks. Infinities and
    /// NaN do not count; without any value it runs from 0 to 1.
    pub fn linear(values: impl IntoIterator<Item = f64>, with_zero: bool) -> Self {
        let Some((mut low, mut high)) = finite_range(values) else {
            return Self::Linear { from: 0.0, to: 1.0 };
        };
        if with_zero {
            (low, high) = (low.min(0.0), high.max(0.0));
        }
        if high <= low {
            let room = if low == 0.0 { 1.0 } else { 0.5 * low.abs() };
            (low, high) = (low - if low > 0.0 || !with_zero { room } else { 0.0 }, high + room);
        }
        let step = tick_spacing(high - low);
        Self::Linear {
            // The small terms keep a value that lies on a tick from being pushed to the next one by rounding.
            from: step * floor(low / step + 1e-9),
            to: -step * floor(-high / step + 1e-9),
        }
    }

    /// Creates a logarithmic axis over whole decades that holds all of `values` above zero. `None` without such a
    /// value.
    pub fn log(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let (low, high) = finite_range(values.into_iter().filter(|x| *x > 0.0))?;
        let from = floor(log10(low) + 1e-9);
        // At least a decade: without it, a single power of ten would have no axis.
        let to = (-floor(-log10(high) + 1e-9)).max(from + 1.0);
        Some(Self::Log {
            from: power_of_ten(from as i32),
            to: power_of_ten(to as i32),
        })
    }

    /// Creates a logarithmic axis that holds all of `values` above zero with a margin for their markers. `None` without
    /// such a value.
    pub fn tight_log(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        /// Smallest ratio of the ends without their margins.
        const MIN_RATIO: f64 = 1.5;
        let (low, high) = finite_range(values.into_iter().filter(|x| *x > 0.0))?;
        let widened = (MIN_RATIO / (high / low)).max(1.0).sqrt();
        let margin = widened * libm::pow(high / low, 0.04);
        Some(Self::Log {
            from: low / margin,
            to: high * margin,
        })
    }

    /// Creates a square-root axis from 0 that holds all of `values`, which are from 0 to 5·10⁶, and ends on 1, 2 or 5
    /// times a power of ten. With larger values it ends on 1 and does not hold them.
    pub fn square_root(values: impl IntoIterator<Item = f64>) -> Self {
        let high = finite_range(values).map_or(1.0, |(_, high)| high);
        let to = round_values().find(|value| *value >= high * (1.0 - 1e-9));
        Self::SquareRoot { to: to.unwrap_or(1.0) }
    }

    /// Ends of the axis.
    pub const fn ends(self) -> (f64, f64) {
        match self {
            Self::SquareRoot { to } => (0.0, to),
            Self::Linear { from, to } | Self::Log { from, to } => (from, to),
        }
    }

    /// Returns the position of `value` on the axis, 0 at its start and 1 at its end; values beyond are clamped.
    pub fn position(self, value: f64) -> f64 {
        let share = match self {
            Self::Linear { from, to } => (value - from) / (to - from),
            Self::Log { from, .. } if value <= from => 0.0,
            Self::Log { from, to } => log10(value / from) / log10(to / from),
            Self::SquareRoot { to } => (value.max(0.0) / to).sqrt(),
        };
        share.clamp(0.0, 1.0)
    }

    /// Ticks, from start to end.
    pub fn ticks(self) -> Vec<AxisTick> {
        match self {
            Self::Linear { from, to } => {
                let step = tick_spacing(to - from);
                let first_multiple = -floor(-from / step + 1e-6);
                let last_index = floor(to / step - first_multiple + 1e-6) as u32;
                (0..=last_index)
                    .map(|i| step * (first_multiple + f64::from(i)))
                    .map(|value| AxisTick {
                        value,
                        label: format_with_step(value, step),
                    })
                    .collect()
            }
            Self::Log { from, to } => log_ticks(from, to),
            Self::SquareRoot { to } => self.square_root_ticks(to),
        }
    }

    /// Ticks at 0 and at round values that leave room for their labels.
    fn square_root_ticks(self, to: f64) -> Vec<AxisTick> {
        /// Smallest distance between two ticks, as a share of the axis.
        const MIN_DISTANCE: f64 = 0.18;
        let mut values = vec![0.0];
        for value in round_values().take_while(|value| *value <= to * (1.0 + 1e-9)) {
            let previous = values[values.len() - 1];
            let is_end = value > to * (1.0 - 1e-9);
            let has_room = |from: f64, value: f64| self.position(value) - self.position(from) >= MIN_DISTANCE;
            if is_end || (has_room(previous, value) && has_room(value, to)) {
                values.push(value);
            }
        }
        let tick = |value: f64| AxisTick {
            value,
            label: format_with_step(value, value.clamp(MIN_PLAIN_STEP, 1.0)),
        };
        values.into_iter().map(tick).collect()
    }
}

/// The values 1, 2 and 5 times a power of ten from 10⁻³ to 10⁶, ascending.
fn round_values() -> impl Iterator<Item = f64> {
    (-3..=6).flat_map(|n| [1.0, 2.0, 5.0].map(|factor| factor * power_of_ten(n)))
}

/// Limits of tick spacing beyond which labels have an exponent.
const MAX_PLAIN_STEP: f64 = 1e7;
const MIN_PLAIN_STEP: f64 = 1e-4;
/// Number of steps from zero below which a value has at most three significant digits.
const MAX_SHORT_STEPS: f64 = 100.0;

/// Formats `value` with as many decimals as `step`, > 0, the distance of ticks. With a large or small step, values near
/// zero have an exponent.
pub fn format_with_step(value: f64, step: f64) -> String {
    let is_plain_step = (MIN_PLAIN_STEP * (1.0 - 1e-9)..MAX_PLAIN_STEP).contains(&step);
    if value != 0.0 && !is_plain_step && value.abs() < MAX_SHORT_STEPS * step {
        // A value is a multiple of the step, whose first digit is 1, 2 or 5.
        let text = format!("{value:.2e}");
        let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let mantissa = mantissa.trim_end_matches('0').trim_end_matches('.');
        return format!("{mantissa}e{exponent}").replace('-', "−");
    }
    let decimals = (0..9)
        .find(|&d| {
            let scaled = step * power_of_ten(d);
            (scaled - scaled.round()).abs() < 1e-6 * scaled
        })
        .unwrap_or(9);
    let text = format!("{value:.*}", decimals as usize);
    let is_zero = text.chars().all(|c| matches!(c, '-' | '0' | '.'));
    if is_zero {
        "0".to_owned()
    } else {
        text.replace('-', "−")
    }
}

/// Returns the smallest and the largest finite value; `None` without one.
fn finite_range(values: impl IntoIterator<Item = f64>) -> Option<(f64, f64)> {
    let finite = values.into_iter().filter(|x| x.is_finite());
    finite.fold(None, |range, x| match range {
        None => Some((x, x)),
        Some((low, high)) => Some((x.min(low), x.max(high))),
    })
}

/// Returns the tick spacing for a range of this length, > 0: 1, 2 or 5 times a power of ten.
fn tick_spacing(length: f64) -> f64 {
    let min_spacing = length / MAX_TICKS;
    let unit = power_of_ten(floor(log10(min_spacing)) as i32);
    let factors = [1.0, 2.0, 5.0];
    let factor = factors.into_iter().find(|f| f * unit >= min_spacing * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * unit
}

/// Returns the nearest `f64` to 10ⁿ.
fn power_of_ten(n: i32) -> f64 {
    libm::exp10(f64::from(n))
}

/// Returns the ticks of a logarithmic axis at multiples of powers of ten. It labels powers of ten. On a short axis it
/// also labels some multiples, and on a still shorter one round values at equal distances.
fn log_ticks(from: f64, to: f64) -> Vec<AxisTick> {
    const LABELLED: [&[i32]; 3] = [&[1], &[1, 2, 5], &[1, 2, 3, 4, 6, 8]];
    let (first, last) = (floor(log10(from) + 1e-9) as i32, floor(log10(to) + 1e-9) as i32);
    // With eight decades or more only some have labels.
    let label_interval = 1 + (last - first) / 8;
    let multiples = (first..=last)
        .flat_map(|n| (1..10).map(move |factor| (n, factor, f64::from(factor) * power_of_ten(n))))
        .filter(|(_, _, value)| (from * (1.0 - 1e-9)..=to * (1.0 + 1e-9)).contains(value));
    let multiples: Vec<(i32, i32, f64)> = multiples.collect();
    let label_count = |factors: &[i32]| {
        multiples
            .iter()
            .filter(|(_, factor, _)| factors.contains(factor))
            .count()
    };
    let labelled = LABELLED.into_iter().find(|factors| label_count(factors) >= 3);
    let labelled = labelled.unwrap_or(LABELLED[LABELLED.len() - 1]);
    if label_count(labelled) < 2 {
        let linear = Scale::Linear { from, to };
        return linear.ticks();
    }
    let tick = |(n, factor, value): (i32, i32, f64)| {
        let is_labelled = labelled.contains(&factor) && (last - n) % label_interval == 0;
        let label = if is_labelled {
            format_with_step(value, power_of_ten(n).min(1.0))
        } else {
            String::new()
        };
        AxisTick { value, label }
    };
    multiples.into_iter().map(tick).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale) -> Vec<String> {
        let ticks = scale.ticks();
        ticks
            .into_iter()
            .map(|tick| tick.label)
            .filter(|label| !label.is_empty())
            .collect()
    }

    #[test]
    fn linear_axes_end_at_round_numbers() {
        let axis = Scale::linear([0.145, 0.83], true);
        assert_eq!(axis, Scale::Linear { from: 0.0, to: 1.0 });
        assert_eq!(labels(axis), ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(
            labels(Scale::linear([10.0, 250.0], false)),
            ["0", "50", "100", "150", "200", "250"]
        );
        assert_eq!(
            labels(Scale::linear([-3.2, 4.1], false)),
            ["−4", "−2", "0", "2", "4", "6"]
        );
        let (from, to) = Scale::linear([61.0, 64.0], false).ends();
        assert!((from - 61.0).abs() < 1e-9 && (to - 64.0).abs() < 1e-9);
    }

    #[test]
    fn labels_of_small_steps_are_short_and_keep_their_digits() {
        for (values, with_zero, expected) in [
            ([0.0, 1e-6], true, &["0", "2e−7", "4e−7", "6e−7", "8e−7", "1e−6"][..]),
            (
                [0.0, 0.0003],
                true,
                &["0", "5e−5", "1e−4", "1.5e−4", "2e−4", "2.5e−4", "3e−4"],
            ),
            (
                [1.9e-5, 2.1e-5],
                false,
                &["1.9e−5", "1.95e−5", "2e−5", "2.05e−5", "2.1e−5"],
            ),
            ([60.0, 60.0003], false, &["60.00000", "60.00005", "60.00010"]),
        ] {
            let labels = labels(Scale::linear(values, with_zero));
            assert_eq!(labels[..expected.len()], *expected, "{labels:?}");
        }
    }

    #[test]
    fn an_axis_contains_all_values() {
        for values in [
            vec![],
            vec![0.0],
            vec![5.0],
            vec![-5.0],
            vec![f64::NAN, 2.0],
            vec![1e-9, 1e9],
            vec![3e15, 2.0],
            vec![-1e300, 1e300],
            vec![1e-300],
        ] {
            for with_zero in [true, false] {
                let axis = Scale::linear(values.iter().copied(), with_zero);
                let (from, to) = axis.ends();
                assert!(from < to, "{values:?}: {axis:?}");
                for value in values.iter().filter(|value| value.is_finite()) {
                    assert!(from <= *value + 1e-9 && *value <= to + 1e-9, "{value} on {axis:?}");
                }
                let ticks = axis.ticks();
                assert!((2..=12).contains(&ticks.len()), "{} ticks on {axis:?}", ticks.len());
                let mut labels: Vec<&str> = ticks.iter().map(|tick| tick.label.as_str()).collect();
                assert!(labels.iter().all(|label| label.chars().count() <= 11), "{labels:?}");
                labels.dedup();
                assert_eq!(labels.len(), ticks.len(), "{labels:?}");
            }
        }
    }

    #[test]
    fn logarithmic_axes_have_ticks_at_decades() {
        let axis = Scale::log([0.003, 77.0, 0.0, f64::NAN]).expect("two values above zero");
        assert_eq!(labels(axis), ["0.001", "0.01", "0.1", "1", "10", "100"]);
        assert!((axis.position(0.1) - 0.4).abs() < 1e-12);
        assert!(axis.position(0.0).abs() < 1e-12, "zero is at the start");
        assert_eq!(labels(Scale::log([2.0, 7.0]).expect("a scale")), ["1", "2", "5", "10"]);
        assert_eq!(Scale::log([0.0, -1.0]), None);
        assert_eq!(Scale::log([1.0]).map(Scale::ends), Some((1.0, 10.0)));
    }

    #[test]
    fn a_tight_logarithmic_axis_has_a_small_margin_and_labelled_ticks() {
        let axis = Scale::tight_log([0.03, 0.4, 0.0]).expect("two values above zero");
        let (from, to) = axis.ends();
        assert!((0.025..0.03).contains(&from) && (0.4..0.48).contains(&to), "{axis:?}");
        assert_eq!(labels(axis), ["0.05", "0.1", "0.2"]);
        for values in [
            [50.0, 50.0],
            [60.0, 64.0],
            [0.2, 0.4],
            [1.1, 4.8],
            [2.0, 9.0],
            [0.9, 1.8],
            [10.0, 250.0],
            [1e-4, 7e5],
        ] {
            let axis = Scale::tight_log(values).expect("values above zero");
            let labels = labels(axis);
            assert!((2..=8).contains(&labels.len()), "{values:?}: {labels:?}");
            assert!(
                values.iter().all(|value| (0.01..0.99).contains(&axis.position(*value))),
                "{values:?}"
            );
        }
        assert_eq!(Scale::tight_log([0.0]), None);
    }

    #[test]
    fn ticks_are_round_if_the_ends_are_not() {
        let axis = Scale::Linear { from: -15.0, to: 267.0 };
        assert_eq!(labels(axis), ["0", "50", "100", "150", "200", "250"]);
    }

    #[test]
    fn positions_are_linear_and_limited_to_the_axis() {
        let axis = Scale::Linear { from: -1.0, to: 3.0 };
        assert!((axis.position(0.0) - 0.25).abs() < 1e-15);
        assert!((axis.position(9.0) - 1.0).abs() < 1e-15);
    }

    #[test]
    fn a_square_root_axis_begins_at_zero_and_has_round_ticks() {
        for (values, expected) in [
            (&[0.0, 29.0][..], &["0", "2", "10", "20", "50"][..]),
            (&[0.3, 98.0], &["0", "5", "20", "50", "100"]),
            (&[0.0, 0.4], &["0", "0.02", "0.1", "0.2", "0.5"]),
            (&[], &["0", "0.05", "0.2", "0.5", "1"]),
        ] {
            let scale = Scale::square_root(values.iter().copied());
            assert_eq!(labels(scale), expected, "{values:?}");
            assert_eq!((scale.position(0.0), scale.position(scale.ends().1)), (0.0, 1.0));
            assert!((scale.position(0.25 * scale.ends().1) - 0.5).abs() < 1e-12);
        }
    }
}
