//! The result table: one row per run, as Parquet or CSV. `reveille sweep` writes it; reports, figures and the Python
//! package read it. The columns are a file format: raise `TABLE_VERSION` when one changes its name or meaning, or a
//! metric is added. `docs/results.md` lists them.
//!
//! | columns | content |
//! |---|---|
//! | `scenario_hash`, `preset`, `policy`, `n`, `ttis`, `seed` | the identity of the run |
//! | one per swept field, named by its path (`harvest.lambda`) | the swept value |
//! | one per metric of [`reveille_common::score`] | the metric; empty if it is not defined (no events) |
//! | `events`, `digest` | number of counted events; the run's digest |
//!
//! Rows are in the order of the experiment's cells, then of seeds; `sweep` relies on this order to merge shards. Equal
//! tables have the same bytes in a file.

mod columns;
mod csv;
mod error;
#[cfg(test)]
pub(crate) mod fixtures;
mod io;
mod metadata;
mod parquet;
mod row;
mod sidecar;

pub use columns::{ColumnType, Schema, SweptValue};
pub use error::TableError;
pub use io::Format;
pub use metadata::TableMetadata;
pub use row::{Hash, ResultRow};

/// A result table.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// The origin of the runs.
    pub metadata: TableMetadata,
    /// The columns.
    pub schema: Schema,
    /// One row per run.
    pub rows: Vec<ResultRow>,
}

#[cfg(test)]
mod tests;
