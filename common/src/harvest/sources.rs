//! What the sources of a run have in common.

use std::sync::Arc;

use crate::rng::{GapTable, Geometric};
use crate::units::Energy;

/// The mean of `e_b` with probability `p`, to the nearest micro-unit.
pub(super) fn expected(p: f64, e_b: Energy) -> Energy {
    Energy::from_micro((p * e_b.micro() as f64).round() as u64)
}

/// What the sources of a run share: recorded energy, and the tables that gaps are drawn from.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    pub(super) traces: Vec<Arc<Vec<Energy>>>,
    /// The tables, by the bits of the probability of an arrival.
    tables: Vec<(u64, Arc<GapTable>)>,
}

impl Sources {
    /// What sources with arrivals of the `probabilities` need. `traces` are the run's traces, energy per TTI by row.
    pub(super) fn with_gaps(probabilities: impl IntoIterator<Item = f64>, traces: Vec<Arc<Vec<Energy>>>) -> Self {
        let mut tables: Vec<(u64, Arc<GapTable>)> = Vec::new();
        for p in probabilities {
            if tables.iter().all(|&(known, _)| known != p.to_bits()) {
                tables.push((p.to_bits(), Arc::new(GapTable::new(Geometric::new(p)))));
            }
        }
        Self { traces, tables }
    }

    /// The gaps between arrivals of probability `p`, from a table shared with other devices if there is one.
    pub(super) fn gaps(&self, p: f64) -> Arc<GapTable> {
        let known = self.tables.iter().find(|(bits, _)| *bits == p.to_bits());
        known.map_or_else(
            || Arc::new(GapTable::new(Geometric::new(p))),
            |(_, table)| Arc::clone(table),
        )
    }
}
