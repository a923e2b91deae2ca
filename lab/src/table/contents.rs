//! A result table in memory.

use super::about::About;
use super::columns::Schema;
use super::row::Row;

/// A result table.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// The origin of the runs.
    pub about: About,
    /// Its columns.
    pub schema: Schema,
    /// One row per run.
    pub rows: Vec<Row>,
}
