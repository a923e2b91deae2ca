//! Runs that other sweeps have made already.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::error::SweepError;
use super::journal::Entry;
use crate::table::{Hash, Table};

/// The runs of some tables, by the hash of all that decides a run, its seed included.
#[derive(Debug, Default)]
pub struct Known(BTreeMap<Hash, Entry>);

impl Known {
    /// The runs of `tables`, each with where it was read from.
    ///
    /// # Errors
    /// A table was written by another version of the program, whose runs may have come out differently.
    pub fn of(tables: &[(PathBuf, Table)]) -> Result<Self, SweepError> {
        let mut runs = BTreeMap::new();
        for (path, table) in tables {
            if table.about.version != env!("CARGO_PKG_VERSION") {
                return Err(SweepError::Reuse {
                    path: path.clone(),
                    version: table.about.version.clone(),
                });
            }
            runs.extend(table.rows.iter().map(|row| (row.scenario_hash, Entry::from(row))));
        }
        Ok(Self(runs))
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The run whose scenario has this `hash`.
    pub(super) fn run(&self, hash: Hash) -> Option<&Entry> {
        self.0.get(&hash)
    }
}
