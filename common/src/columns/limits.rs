//! What every form of a data file has in common.

use crate::declare::{listed, shortened};

/// Values that are taken from one file at the most.
pub(super) const MOST_VALUES: usize = 10_000_000;

/// The number of the one column called `name`.
pub(super) fn column_index<'h>(name: &str, header: impl Iterator<Item = &'h str> + Clone) -> Result<usize, String> {
    let mut found = header.clone().enumerate().filter(|(_, known)| *known == name);
    match (found.next(), found.next()) {
        (Some((index, _)), None) => Ok(index),
        (Some(_), Some(_)) => Err(format!("has more than one column `{}`", shortened(name))),
        (None, _) => Err(format!(
            "has no column `{}`; its columns are {}",
            shortened(name),
            listed(header.take(50))
        )),
    }
}

/// Refuses a file of more values than memory should hold.
pub(super) fn within_limit(rows: usize, columns: usize) -> Result<(), String> {
    if rows.saturating_mul(columns) > MOST_VALUES {
        return Err(format!("has more than {MOST_VALUES} values in {columns} columns"));
    }
    Ok(())
}
