//! The result table: one row per run, as Parquet or CSV.
//!
//! | columns | what |
//! |---|---|
//! | `scenario_hash`, `preset`, `policy`, `n`, `ttis`, `seed` | which run |
//! | one per swept field, named by its path (`harvest.lambda`) | what the sweep set there |
//! | one per metric of [`reveille_common::score`] | what came out; empty where it is not defined (no events) |
//! | `events`, `digest` | events counted; the run's fingerprint |
//!
//! Rows are in the order of the experiment's cells, then of seeds. The same rows always give the same bytes.

mod about;
mod columns;
mod contents;
mod csv;
mod error;
#[cfg(test)]
pub(crate) mod fixtures;
mod io;
pub mod keys;
mod parquet;
mod row;
mod side_car;

pub use about::About;
pub use columns::{ColumnType, Schema, Value};
pub use contents::Table;
pub use error::TableError;
pub use io::Format;
pub use keys::TABLE_VERSION;
pub use row::{Hash, Row};

#[cfg(test)]
mod tests;
