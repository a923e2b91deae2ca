//! Recorded energy from files.

use std::sync::Arc;

use super::check::{Checker, NOT_NEGATIVE, Section};
use super::error::ScenarioError;
use super::model::{MAX_TTIS, Trace, TraceColumns};
use super::raw::RawTrace;
use super::table;
use crate::units::{Energy, MAX_UNITS};

/// The trace of the section `harvest`, its values read and scaled.
pub(super) fn trace(check: &Checker<'_>, harvest: &Section, raw: &RawTrace) -> Result<Trace, ScenarioError> {
    let file = check.need(harvest, "trace.file", raw.file.as_deref(), "kind")?;
    let columns = columns(check, harvest, raw)?;
    let scale = check.number(harvest, "trace.scale", raw.scale, NOT_NEGATIVE)?;
    let ttis_per_row = check.whole(harvest, "trace.ttis_per_row", raw.ttis_per_row, (1, MAX_TTIS))?;
    let end = Checker::set(harvest, "trace.end", raw.end)?;
    let file = check.file(harvest, "trace.file", file)?;
    let names = match &columns {
        TraceColumns::Shared(name) => std::slice::from_ref(name),
        TraceColumns::PerDevice(names) => names,
    };
    let values = table::read_columns(&file, names, usize::MAX).and_then(|numbers| energies(&numbers, names, scale));
    match values {
        Ok(values) => Ok(Trace {
            file,
            columns,
            scale,
            ttis_per_row,
            end,
            values: Arc::new(values),
        }),
        Err(reason) => Err(check.data(harvest, "trace.file", file, reason)),
    }
}

fn columns(check: &Checker<'_>, harvest: &Section, raw: &RawTrace) -> Result<TraceColumns, ScenarioError> {
    match (&raw.column, &raw.columns) {
        (Some(column), None) => Ok(TraceColumns::Shared(column.clone())),
        (None, Some(columns)) if !columns.is_empty() => Ok(TraceColumns::PerDevice(columns.clone())),
        (None, Some(_)) => Err(check.refuse(harvest, "trace.columns", "[]", "must name at least one column")),
        (Some(column), Some(_)) => {
            let allowed = "cannot be set together with harvest.trace.columns: all devices share one column, or each has \
                           its own";
            Err(check.refuse(harvest, "trace.column", column, allowed))
        }
        (None, None) => check.need(harvest, "trace.column (or trace.columns)", None, "kind"),
    }
}

/// `numbers` by column and row as energy per TTI.
fn energies(numbers: &[Vec<f64>], names: &[String], scale: f64) -> Result<Vec<Vec<Energy>>, String> {
    let energy = |name: &str, (row, &number): (usize, &f64)| {
        Energy::from_units(number * scale).ok_or_else(|| {
            format!(
                "row {}, column `{name}`: {number} times the scale {scale} must be at least 0 and at most {MAX_UNITS} \
                 units",
                row + 1
            )
        })
    };
    let column =
        |(numbers, name): (&Vec<f64>, &String)| numbers.iter().enumerate().map(|item| energy(name, item)).collect();
    numbers.iter().zip(names).map(column).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_scaled_to_micro_units() {
        let values = energies(&[vec![0.0, 500.0]], &["ghi".to_owned()], 0.002).expect("valid");
        assert_eq!(values, [[Energy::ZERO, Energy::from_micro(1_000_000)]]);
    }

    #[test]
    fn a_negative_row_is_named() {
        let reason = energies(&[vec![1.0, -3.0]], &["ghi".to_owned()], 1.0).expect_err("negative");
        assert!(reason.starts_with("row 2, column `ghi`: -3 times"), "{reason}");
    }
}
