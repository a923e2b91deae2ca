//! Conversion of irradiance, as weather stations record it, to units of energy per TTI.
//!
//! A panel of area A and efficiency η turns an irradiance of G W/m² into η·A·G watts. Irradiance is linear between two
//! rows of a record, and a TTI brings its integral. Rounding errors are carried over between TTIs, so that the
//! micro-units of a record add up to its energy. `harvest/trace/mod.rs` applies it. The scenario hash and digests
//! depend on the result, which the reference in `tests/src/` does not check. A test compares the help of the fields
//! with `docs/scenario.md`.

use crate::declare::{FieldSink, Range, Section, Visit, number};
use crate::digits::format_significant;
use crate::units::{Energy, MAX_UNITS, MICRO_PER_UNIT};

/// Maximum number of TTIs per column that are converted, which bounds the memory.
const MAX_TTIS_PER_COLUMN: f64 = 10_000_000.0;
/// Allowed relative deviation of a record from a whole number of TTIs, for rounding.
const ROUNDING_TOLERANCE: f64 = 1e-6;
/// Range of areas, energies and times.
const SIZE_RANGE: Range = Range::above(0.0, 1e9);

crate::declare! {
    /// Solar panel, time scale and energy unit of an irradiance trace.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Panel in "harvest.trace.panel" only with "harvest.trace.quantity" = &["irradiance"]; {
        /// Area of the panel.
        pub area_cm2: f64 = number(SIZE_RANGE, 1.0).unit("cm²").required(),
        /// Share of the light's energy that reaches the battery, converter losses included.
        pub efficiency: f64 = number(Range::above(0.0, 1.0), 1.0).required(),
        /// Energy that one unit represents. If E_Tx is 10 units, one unit is a tenth of the cost of a report.
        pub unit_mj: f64 = number(SIZE_RANGE, 1.0).unit("mJ").required(),
        /// Duration that a TTI represents.
        pub tti_seconds: f64 = number(SIZE_RANGE, 1.0).unit("seconds").required(),
        /// Time between two rows of the file.
        pub row_seconds: f64 = number(SIZE_RANGE, 3600.0).unit("seconds"),
    }
}

impl Panel {
    /// Units of energy per second and W/m².
    fn units_per_second(&self) -> f64 {
        let square_metres = self.area_cm2 * 1e-4;
        1000.0 * square_metres * self.efficiency / self.unit_mj
    }

    /// Energy per TTI of the rows `irradiance`, W/m²; row i is the value at time i·`row_seconds`. The caller has
    /// checked that there is a row, and that none is negative. After the last row the first one follows; with `stops`
    /// the last value holds for one more row. If the rows cover more than [`MAX_TTIS_PER_COLUMN`] TTIs, the result ends
    /// after `needed_ttis` TTIs.
    ///
    /// # Errors
    /// If the rows are not a whole number of TTIs, too many TTIs are needed, or the energy in a TTI exceeds the limit.
    pub(super) fn energies(&self, irradiance: &[f64], stops: bool, needed_ttis: u64) -> Result<Vec<Energy>, String> {
        let (row_count, row_seconds) = (irradiance.len() as f64, self.row_seconds);
        let ttis = row_count * row_seconds / self.tti_seconds;
        let tti_count = ttis.round();
        // Relative, since the rounding of the quotient grows with it.
        if tti_count < 1.0 || (ttis - tti_count).abs() > ROUNDING_TOLERANCE * tti_count.max(1.0) {
            return Err(format!(
                "its {row_count} rows of {row_seconds} s cover {ttis:.3} TTIs of {} s, not a whole number of TTIs; \
                 change harvest.trace.panel.tti_seconds or row_seconds, or the number of rows",
                self.tti_seconds
            ));
        }
        let converted_ttis = if tti_count > MAX_TTIS_PER_COLUMN {
            tti_count.min(needed_ttis as f64)
        } else {
            tti_count
        };
        if converted_ttis > MAX_TTIS_PER_COLUMN {
            return Err(format!(
                "the run needs {converted_ttis} TTIs of its {row_count} rows, and the limit is {MAX_TTIS_PER_COLUMN}; \
                 set a longer harvest.trace.panel.tti_seconds, or fewer ttis"
            ));
        }
        let after_last = if stops { irradiance.last() } else { irradiance.first() };
        let after_last = after_last.copied().unwrap_or(0.0);
        let irradiance_at = |row: usize| irradiance.get(row).copied().unwrap_or(after_last);
        // The integral up to each row, W/m² times rows.
        let mut integrals = Vec::with_capacity(irradiance.len() + 1);
        let mut integral = 0.0;
        for row in 0..=irradiance.len() {
            integrals.push(integral);
            integral += 0.5 * (irradiance_at(row) + irradiance_at(row + 1));
        }
        // Micro-units for 1 W/m² over the time between two rows.
        let micro_per_row = self.units_per_second() * row_seconds * MICRO_PER_UNIT as f64;
        let micro_until = |tti: u64| {
            // Rounding must not move the last position beyond the last row's end.
            let row_position = (tti as f64 / tti_count * row_count).min(row_count);
            let (row, part) = (row_position as usize, row_position.fract());
            let slope = irradiance_at(row + 1) - irradiance_at(row);
            micro_per_row * (integrals[row] + part * (irradiance_at(row) + 0.5 * part * slope))
        };
        let (mut energies, mut previous_sum) = (Vec::with_capacity(converted_ttis as usize), 0_u64);
        for tti in 0..converted_ttis as u64 {
            // The cast saturates; a sum that large exceeds MAX_UNITS below anyway.
            let sum = micro_until(tti + 1).round() as u64;
            let energy = Energy::from_micro(sum.saturating_sub(previous_sum));
            if energy.units() > MAX_UNITS {
                return Err(format!(
                    "TTI {tti} harvests {} units, and the limit is {MAX_UNITS}; set a larger \
                     harvest.trace.panel.unit_mj",
                    format_significant(energy.units(), 4)
                ));
            }
            energies.push(energy);
            previous_sum = sum;
        }
        Ok(energies)
    }
}

/// Passes the fields of `panel`, if given, to `sink`.
pub(super) fn visit(panel: Option<&Panel>, sink: &mut dyn FieldSink) {
    if let Some(panel) = panel {
        panel.visit(sink);
    }
}

pub(super) const SECTION: &Section = Panel::SECTION;

#[cfg(test)]
mod tests {
    use super::*;

    /// 50 cm² at 20 % and 1 mJ a unit: 1000 W/m² are 1000 units a second.
    const PANEL: Panel = Panel {
        area_cm2: 50.0,
        efficiency: 0.2,
        unit_mj: 1.0,
        tti_seconds: 1.0,
        row_seconds: 4.0,
    };

    /// Values of `stops`: after the last row, the first one follows or the last value holds.
    const CYCLES: bool = false;
    const STOPS: bool = true;

    fn units_by_tti(panel: &Panel, rows: &[f64], stops: bool) -> Vec<f64> {
        let energies = panel.energies(rows, stops, 1).expect("valid");
        energies.iter().map(|energy| energy.units()).collect()
    }

    #[test]
    fn irradiance_is_converted_by_area_efficiency_unit_and_time() {
        assert!((PANEL.units_per_second() - 1.0).abs() < 1e-12);
        assert_eq!(units_by_tti(&PANEL, &[7.0, 7.0], CYCLES), [7.0; 8]);
        let longer_ttis = Panel {
            tti_seconds: 8.0,
            unit_mj: 2.0,
            ..PANEL
        };
        assert_eq!(units_by_tti(&longer_ttis, &[7.0, 7.0], CYCLES), [28.0]);
    }

    #[test]
    fn irradiance_is_interpolated_linearly_between_rows() {
        // 0 at 0 s, 8 at 4 s; then back to 0 at 8 s, or constant at 8.
        assert_eq!(
            units_by_tti(&PANEL, &[0.0, 8.0], CYCLES),
            [1.0, 3.0, 5.0, 7.0, 7.0, 5.0, 3.0, 1.0]
        );
        assert_eq!(
            units_by_tti(&PANEL, &[0.0, 8.0], STOPS),
            [1.0, 3.0, 5.0, 7.0, 8.0, 8.0, 8.0, 8.0]
        );
        let unaligned = Panel {
            tti_seconds: 8.0 / 3.0,
            ..PANEL
        };
        // The triangle of 32 in thirds: (8/3)²·2/2 for each outer third, and the rest in the middle.
        let outer = (8.0_f64 / 3.0).powi(2);
        for (found, expected) in
            units_by_tti(&unaligned, &[0.0, 8.0], CYCLES)
                .iter()
                .zip([outer, 32.0 - 2.0 * outer, outer])
        {
            assert!((found - expected).abs() < 1e-5, "{found} units, not {expected}");
        }
    }

    /// The expected values come from the midpoint rule. The total must be exact to the micro-unit.
    #[test]
    fn energies_equal_the_integral_and_rounding_loses_nothing() {
        let rows: Vec<f64> = (0..48).map(|i| f64::from((i * 37) % 11) * 1.7e-6).collect();
        for (stops, tti_seconds) in [(false, 0.4), (true, 0.75), (false, 6.0), (true, 32.0)] {
            let panel = Panel { tti_seconds, ..PANEL };
            let energies = panel.energies(&rows, stops, 1).expect("valid");
            let irradiance_at = |second: f64| {
                let (i, part) = ((second / 4.0) as usize, (second / 4.0).fract());
                let row = |i: usize| match (rows.get(i), stops) {
                    (Some(&value), _) => value,
                    (None, true) => rows[47],
                    (None, false) => rows[0],
                };
                row(i) + part * (row(i + 1) - row(i))
            };
            let integral = |from: f64, end: f64| {
                let width = (end - from) / 400.0;
                (0..400)
                    .map(|i| width * irradiance_at(from + (f64::from(i) + 0.5) * width))
                    .sum::<f64>()
            };
            let mut total = 0.0;
            for (tti, energy) in energies.iter().enumerate() {
                let from = tti as f64 * tti_seconds;
                let expected = 1e6 * integral(from, from + tti_seconds);
                total += expected;
                assert!(
                    (energy.micro() as f64 - expected).abs() <= 1.1,
                    "TTI {tti} of {tti_seconds} s: {energy:?}, not {expected} micro-units"
                );
            }
            let sum: u64 = energies.iter().map(|energy| energy.micro()).sum();
            assert!(
                (sum as f64 - total).abs() <= 1.0,
                "TTIs of {tti_seconds} s: {sum} micro-units in total, not {total}"
            );
        }
    }

    #[test]
    fn a_long_record_is_converted_as_far_as_needed() {
        let rows: Vec<f64> = (0..30).map(|i| f64::from((i * 7) % 11)).collect();
        // 12 million TTIs of 10 µs, and the same energies summed over 1000 of them.
        let [long, short] = [1e-5, 1e-2].map(|tti_seconds| Panel { tti_seconds, ..PANEL });
        for stops in [false, true] {
            let part = long.energies(&rows, stops, 5_000).expect("valid");
            assert_eq!(part.len(), 5_000);
            let whole = short.energies(&rows, stops, 5).expect("valid");
            assert_eq!(whole.len(), 12_000);
            for (tti, energy) in whole[..5].iter().enumerate() {
                let sum: Energy = part[1000 * tti..1000 * (tti + 1)].iter().copied().sum();
                assert!(
                    sum.micro().abs_diff(energy.micro()) <= 1,
                    "TTI {tti}: {sum}, not {energy}"
                );
            }
        }
    }

    #[test]
    fn errors_name_the_cause_and_the_fix() {
        let reason = |panel: Panel| panel.energies(&[1e5; 3], CYCLES, 20_000_000).expect_err("not valid");
        let not_whole = reason(Panel {
            tti_seconds: 5.0,
            ..PANEL
        });
        assert!(
            not_whole.starts_with("its 3 rows of 4 s cover 2.400 TTIs of 5 s, not a whole number"),
            "{not_whole}"
        );
        let too_much_energy = reason(Panel {
            tti_seconds: 12.0,
            unit_mj: 1e-3,
            ..PANEL
        });
        assert!(
            too_much_energy.contains("TTI 0 harvests 1200000000 units")
                && too_much_energy.ends_with("a larger harvest.trace.panel.unit_mj"),
            "{too_much_energy}"
        );
        let too_many_ttis = reason(Panel {
            tti_seconds: 1e-6,
            ..PANEL
        });
        assert!(
            too_many_ttis.contains("needs 12000000 TTIs")
                && too_many_ttis.contains("longer harvest.trace.panel.tti_seconds"),
            "{too_many_ttis}"
        );
    }
}
