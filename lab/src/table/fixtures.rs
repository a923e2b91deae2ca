//! A small table for tests.

use std::sync::Arc;

use reveille_common::score::Metrics;

use super::{ColumnType, Hash, ResultRow, Schema, SweptValue, Table, TableMetadata};

/// Five runs of three cells; `info_per_event` is undefined in the first two.
pub(crate) fn table() -> Table {
    let row = |policy: &str, n, seed, lambda: f64, kind: &str| {
        let mut metrics = [0.0; Metrics::COUNT];
        for ((at, value), name) in metrics.iter_mut().enumerate().zip(Metrics::NAMES) {
            *value = match name {
                "info_p1" => seed as f64,
                "info_per_event" if n == 10 && policy == "knn" => f64::NAN,
                _ => seed as f64 * (0.1 + at as f64 / 3.0),
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
                SweptValue::Text(kind.to_owned()),
            ]),
            metrics,
            events: 100 + seed,
            digest: Hash([0xA0 + seed as u8; 32]),
        }
    };
    let path = |name: &str| name.to_owned();
    Table {
        metadata: TableMetadata {
            version: "0.1.0".to_owned(),
            experiment: "devices = [10, 50]\nname = \"a \\\"quoted\\\" one\"\n".to_owned(),
            grid: "00".repeat(32),
            shard: None,
        },
        schema: Schema {
            swept: vec![
                (path("harvest.lambda"), ColumnType::Float),
                (path("events.duration"), ColumnType::Int),
                (path("sensing.kind"), ColumnType::Text),
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
