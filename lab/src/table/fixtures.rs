//! A small result table for the tests of `table`, `series`, `stats` and `metric_estimate`.
//!
//! Tests rely on the order of its rows, on an undefined metric, on texts that need quotes in CSV and TOML, on `info_p1`
//! being equal to the seed, and on the version 0.1.0. A new row changes the counts and means that they expect.

use std::sync::Arc;

use reveille_common::score::Metrics;

use super::{ColumnType, Hash, ResultRow, Schema, SweptValue, Table, TableMetadata};

/// Returns five runs of three cells, with one metric per column of [`Metrics`]. `info_per_event` is undefined in the
/// first cell. All other metrics grow with the seed and differ between columns, so that a swapped column shows; equal
/// seeds of different cells have equal metrics.
pub(crate) fn table() -> Table {
    let row = |policy: &str, n, seed, lambda: f64, sensing_kind: &str| {
        let mut metrics = [0.0; Metrics::COUNT];
        for ((index, value), name) in metrics.iter_mut().enumerate().zip(Metrics::NAMES) {
            *value = match name {
                "info_p1" => seed as f64,
                "info_per_event" if n == 10 && policy == "knn" => f64::NAN,
                _ => seed as f64 * (0.1 + index as f64 / 3.0),
            };
        }
        ResultRow {
            scenario_hash: Hash([seed as u8 + n as u8; 32]),
            preset: Arc::from("paper"),
            policy: Arc::from(policy),
            n,
            ttis: 1000,
            seed,
            swept: Arc::from([
                SweptValue::Float(lambda),
                SweptValue::Int(4),
                SweptValue::Text(sensing_kind.to_owned()),
            ]),
            metrics,
            events: 100 + seed,
            digest: Hash([0xA0 + seed as u8; 32]),
        }
    };
    Table {
        metadata: TableMetadata {
            version: "0.1.0".to_owned(),
            experiment: "devices = [10, 50]\nname = \"a \\\"quoted\\\" one\"\n".to_owned(),
            scenario_fields: Some("devices = 10\n".to_owned()),
            grid_hash: "00".repeat(32),
            shard: None,
        },
        schema: Schema {
            swept: vec![
                ("harvest.lambda".to_owned(), ColumnType::Float),
                ("events.duration".to_owned(), ColumnType::Int),
                ("sensing.kind".to_owned(), ColumnType::Text),
            ],
        },
        rows: vec![
            row("knn", 10, 1, 1.0, "range"),
            row("knn", 10, 2, 1.0, "range"),
            row("knn", 50, 1, 1.0, "range"),
            row("knn", 50, 2, 1.0, "range"),
            row("random", 10, 1, 0.05, "a, \"b\""),
        ],
    }
}
